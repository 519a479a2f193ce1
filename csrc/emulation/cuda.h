// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CUDA kernels on the CPU: what the kernels of ops/<op>_cuda.cu use of CUDA's language and library, for a C++ compiler
// that knows nothing of it. Tests run the kernels themselves this way where there is no GPU, under sanitizers too. It
// checks what they compute and that they finish; it says nothing about their speed or about what nvcc makes of them.
//
// Every thread of a block has a stack of its own, and runs until it ends or waits at a barrier, of its warp or of its
// block: nothing holds the lanes of a warp in step, as nothing does on a GPU since Volta. In what order they run is set
// by PRED_EMULATION_ORDER=forward|backward|shuffled, so that a missing barrier shows. Blocks run one after the other.
// Whole warps take part in warps' operations; a barrier that some thread does not reach is an error.
#pragma once

#include <stdint.h>
#include <string.h>

#include <functional>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static  // one block runs at a time

namespace pred::emulation {

struct Index {
  unsigned x, y = 0, z = 0;
};

struct Place {
  Index thread, block, block_size, grid_size;
};
extern Place place;  // of the running thread

// Calls `kernel` for every thread of every block. Throws std::runtime_error where threads wait for ever.
void run(unsigned blocks, unsigned threads, int64_t shared_bytes, const std::function<void()>& kernel);

void* dynamic_shared_memory();
void wait_for_block();
void wait_for_warp();

// Gives the warp's lanes to each other: entry i of the result is lane i's `value`. Good until the next call but one.
const uint64_t* exchange(uint64_t value);

template <typename T>
inline uint64_t to_bits(T value) {
  static_assert(sizeof(T) <= 8);
  uint64_t bits = 0;
  memcpy(&bits, &value, sizeof value);
  return bits;
}

template <typename T>
inline T from_bits(uint64_t bits) {
  T value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

// The value of lane `from` of the running thread's group of `width` lanes, or its own where there is none.
template <typename T>
inline T shuffle(T value, int from, int width, bool there) {
  const uint64_t* lanes = exchange(to_bits(value));
  const int lane = int(place.thread.x % 32);
  return there ? from_bits<T>(lanes[lane / width * width + from % width]) : value;
}

inline int lane_in(int width) { return int(place.thread.x % 32) % width; }

}  // namespace pred::emulation

#define threadIdx (::pred::emulation::place.thread)
#define blockIdx (::pred::emulation::place.block)
#define blockDim (::pred::emulation::place.block_size)
#define gridDim (::pred::emulation::place.grid_size)

inline void __syncthreads() { ::pred::emulation::wait_for_block(); }
inline void __syncwarp(unsigned = 0xffffffffu) { ::pred::emulation::wait_for_warp(); }

template <typename T>
inline T __shfl_sync(unsigned, T value, int from, int width = 32) {
  return ::pred::emulation::shuffle(value, from, width, true);
}
template <typename T>
inline T __shfl_up_sync(unsigned, T value, unsigned distance, int width = 32) {
  const int from = ::pred::emulation::lane_in(width) - int(distance);
  return ::pred::emulation::shuffle(value, from, width, from >= 0);
}
template <typename T>
inline T __shfl_down_sync(unsigned, T value, unsigned distance, int width = 32) {
  const int from = ::pred::emulation::lane_in(width) + int(distance);
  return ::pred::emulation::shuffle(value, from, width, from < width);
}
template <typename T>
inline T __shfl_xor_sync(unsigned, T value, int bits, int width = 32) {
  const int from = ::pred::emulation::lane_in(width) ^ bits;
  return ::pred::emulation::shuffle(value, from, width, from < width);
}
inline unsigned __ballot_sync(unsigned, int condition) {
  const uint64_t* lanes = ::pred::emulation::exchange(condition != 0);
  unsigned votes = 0;
  for (int lane = 0; lane < 32; ++lane) votes |= unsigned(lanes[lane]) << lane;
  return votes;
}
inline int __any_sync(unsigned mask, int condition) { return __ballot_sync(mask, condition) != 0; }
inline int __all_sync(unsigned mask, int condition) { return __ballot_sync(mask, condition) == 0xffffffffu; }

inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __clz(int x) { return x ? __builtin_clz(unsigned(x)) : 32; }
inline int __clzll(long long x) { return x ? __builtin_clzll((unsigned long long)x) : 64; }

// One thread runs at a time.
template <typename T>
inline T atomicAdd(T* at, T value) {
  const T before = *at;
  *at = before + value;
  return before;
}
template <typename T>
inline T atomicMax(T* at, T value) {
  const T before = *at;
  if (before < value) *at = value;
  return before;
}
template <typename T>
inline T atomicMin(T* at, T value) {
  const T before = *at;
  if (value < before) *at = value;
  return before;
}
template <typename T>
inline T atomicCAS(T* at, T expected, T value) {
  const T before = *at;
  if (before == expected) *at = value;
  return before;
}
