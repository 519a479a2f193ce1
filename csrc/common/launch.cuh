// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Launching kernels on the current stream, and numbering their threads and warps in 64 bits. Kernels loop over their
// items with a stride, so that any number of items goes with any number of blocks.
#pragma once

#include <stdexcept>
#include <string>

#include "common/host_device.h"
#ifdef __CUDACC__
#include "common/stream.h"
#else
#include "emulation/cuda.h"
#endif

namespace pred {

constexpr int kWarp = 32;
constexpr unsigned kWholeWarp = 0xffffffffu;

// Threads that launch() starts for items, and for warps' items.
constexpr int kThreads = 128;

// Blocks of `threads` threads (whole warps) with `shared` bytes of dynamic shared memory.
template <class... Parameters, class... Arguments>
void launch_blocks(void (*kernel)(Parameters...), int64_t blocks, int threads, int64_t shared, Arguments... arguments) {
  constexpr int64_t kMostBlocks = (int64_t(1) << 31) - 1;
  if (blocks <= 0) return;
  const unsigned grid = unsigned(blocks < kMostBlocks ? blocks : kMostBlocks);
#ifdef __CUDACC__
  constexpr int64_t kAlwaysThere = 48 * 1024;
  cudaError_t error = cudaSuccess;
  if (shared > kAlwaysThere) {
    error = cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shared));
  }
  if (error == cudaSuccess) {
    kernel<<<grid, threads, size_t(shared), static_cast<cudaStream_t>(current_stream())>>>(arguments...);
    error = cudaGetLastError();
  }
  if (error != cudaSuccess) throw std::runtime_error(std::string("pred: CUDA launch: ") + cudaGetErrorString(error));
#else
  emulation::run(grid, unsigned(threads), shared, [&] { kernel(arguments...); });
#endif
}

// One thread per item.
template <class... Parameters, class... Arguments>
void launch_threads(void (*kernel)(Parameters...), int64_t items, Arguments... arguments) {
  launch_blocks(kernel, (items + kThreads - 1) / kThreads, kThreads, 0, arguments...);
}

// One warp per item.
template <class... Parameters, class... Arguments>
void launch_warps(void (*kernel)(Parameters...), int64_t items, Arguments... arguments) {
  constexpr int kWarps = kThreads / kWarp;
  launch_blocks(kernel, (items + kWarps - 1) / kWarps, kThreads, 0, arguments...);
}

#define PRED_DEVICE_ONLY static __device__ __forceinline__

PRED_DEVICE_ONLY int64_t first_thread() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }
PRED_DEVICE_ONLY int64_t thread_stride() { return int64_t(gridDim.x) * blockDim.x; }
PRED_DEVICE_ONLY int64_t first_warp() { return first_thread() / kWarp; }
PRED_DEVICE_ONLY int64_t warp_stride() { return thread_stride() / kWarp; }
// What launch_blocks was asked for.
PRED_DEVICE_ONLY void* dynamic_shared() {
#ifdef __CUDACC__
  extern __shared__ __align__(16) unsigned char pred_dynamic_shared[];
  return pred_dynamic_shared;
#else
  return emulation::dynamic_shared_memory();
#endif
}

// a / b of numbers that are not negative, which mostly have 32 bits: others take some 100 instructions.
PRED_DEVICE_ONLY int64_t divide(int64_t a, int64_t b) {
  return ((a | b) >> 32) == 0 ? int64_t(uint32_t(a) / uint32_t(b)) : a / b;
}

PRED_DEVICE_ONLY int lane_number() { return int(threadIdx.x % kWarp); }

}  // namespace pred
