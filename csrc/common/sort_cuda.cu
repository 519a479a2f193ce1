// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CUB's radix sort, which comes with nvcc. Emulated, the standard library's.
#include "common/launch.cuh"
#include "common/sort.h"

#ifdef __CUDACC__
#include <cub/device/device_radix_sort.cuh>
#else
#include <algorithm>
#endif

namespace pred {

#ifdef __CUDACC__
namespace {

void check(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(std::string("pred: CUDA sort: ") + cudaGetErrorString(error));
}

}  // namespace

int64_t sort_bytes(int64_t count, int begin_bit, int end_bit) {
  size_t bytes = 0;
  const uint64_t* from = nullptr;
  uint64_t* to = nullptr;
  check(cub::DeviceRadixSort::SortKeys(nullptr, bytes, from, to, count, begin_bit, end_bit));
  return int64_t(bytes);
}

void sort_items(void* workspace, int64_t bytes, const uint64_t* items, uint64_t* sorted, int64_t count, int begin_bit,
                int end_bit) {
  if (count <= 0) return;
  size_t size = size_t(bytes);
  check(cub::DeviceRadixSort::SortKeys(workspace, size, items, sorted, count, begin_bit, end_bit,
                                       static_cast<cudaStream_t>(current_stream())));
}
#else
int64_t sort_bytes(int64_t, int, int) { return 1; }

void sort_items(void*, int64_t, const uint64_t* items, uint64_t* sorted, int64_t count, int begin_bit, int end_bit) {
  const uint64_t below = end_bit < 64 ? (uint64_t(1) << end_bit) - 1 : ~uint64_t(0);
  std::copy(items, items + count, sorted);
  std::stable_sort(sorted, sorted + count,
                   [&](uint64_t a, uint64_t b) { return (a & below) >> begin_bit < (b & below) >> begin_bit; });
}
#endif

}  // namespace pred
