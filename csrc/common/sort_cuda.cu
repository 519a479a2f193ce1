// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CUB's radix sort and scan, which come with nvcc. Emulated, the standard library's.
#include "common/launch.cuh"
#include "common/sort.h"

#ifdef __CUDACC__
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#else
#include <algorithm>
#include <numeric>
#include <vector>
#endif

namespace pred {

#ifdef __CUDACC__
namespace {

void check(cudaError_t error) {
  if (error != cudaSuccess) throw std::runtime_error(std::string("pred: CUDA: ") + cudaGetErrorString(error));
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

int64_t sort_rows_bytes(int64_t count, int key_bits) {
  size_t bytes = 0;
  const uint64_t* keys = nullptr;
  const int32_t* rows = nullptr;
  uint64_t* sorted_keys = nullptr;
  int32_t* sorted_rows = nullptr;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, sorted_keys, rows, sorted_rows, count, 0, key_bits));
  return int64_t(bytes);
}

void sort_rows(void* workspace, int64_t bytes, const uint64_t* keys, uint64_t* sorted_keys, const int32_t* rows,
               int32_t* sorted_rows, int64_t count, int key_bits) {
  if (count <= 0) return;
  size_t size = size_t(bytes);
  check(cub::DeviceRadixSort::SortPairs(workspace, size, keys, sorted_keys, rows, sorted_rows, count, 0, key_bits,
                                        static_cast<cudaStream_t>(current_stream())));
}

int64_t scan_bytes(int64_t count) {
  size_t bytes = 0;
  const int32_t* from = nullptr;
  int32_t* to = nullptr;
  check(cub::DeviceScan::InclusiveSum(nullptr, bytes, from, to, count));
  return int64_t(bytes);
}

void add_up(void* workspace, int64_t bytes, const int32_t* values, int32_t* sums, int64_t count) {
  if (count <= 0) return;
  size_t size = size_t(bytes);
  check(
      cub::DeviceScan::InclusiveSum(workspace, size, values, sums, count, static_cast<cudaStream_t>(current_stream())));
}

int32_t read_back(const int32_t* number) {
  int32_t value = 0;
  const cudaStream_t stream = static_cast<cudaStream_t>(current_stream());
  check(cudaMemcpyAsync(&value, number, sizeof value, cudaMemcpyDeviceToHost, stream));
  check(cudaStreamSynchronize(stream));
  return value;
}
#else
int64_t sort_bytes(int64_t, int, int) { return 1; }

void sort_items(void*, int64_t, const uint64_t* items, uint64_t* sorted, int64_t count, int begin_bit, int end_bit) {
  const uint64_t below = end_bit < 64 ? (uint64_t(1) << end_bit) - 1 : ~uint64_t(0);
  std::copy(items, items + count, sorted);
  std::stable_sort(sorted, sorted + count,
                   [&](uint64_t a, uint64_t b) { return (a & below) >> begin_bit < (b & below) >> begin_bit; });
}

int64_t sort_rows_bytes(int64_t, int) { return 1; }

void sort_rows(void*, int64_t, const uint64_t* keys, uint64_t* sorted_keys, const int32_t* rows, int32_t* sorted_rows,
               int64_t count, int) {
  std::vector<int64_t> order(count);
  std::iota(order.begin(), order.end(), int64_t(0));
  std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return keys[a] < keys[b]; });
  for (int64_t i = 0; i < count; ++i) {
    sorted_keys[i] = keys[order[i]];
    sorted_rows[i] = rows[order[i]];
  }
}

int64_t scan_bytes(int64_t) { return 1; }

void add_up(void*, int64_t, const int32_t* values, int32_t* sums, int64_t count) {
  std::partial_sum(values, values + count, sums);
}

int32_t read_back(const int32_t* number) { return *number; }
#endif

namespace {

// One thread per key.
__global__ void find_runs_kernel(const uint64_t* sorted, int64_t count, int number_bits, int64_t num_keys,
                                 int64_t* start) {
  for (int64_t key = first_thread(); key <= num_keys; key += thread_stride()) {
    int64_t low = 0, high = count;
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      if (int64_t(sorted[middle] >> number_bits) < key)
        low = middle + 1;
      else
        high = middle;
    }
    start[key] = low;
  }
}

}  // namespace

void find_runs(const uint64_t* sorted, int64_t count, int number_bits, int64_t num_keys, int64_t* start) {
  launch_threads(find_runs_kernel, num_keys + 1, sorted, count, number_bits, num_keys, start);
}

}  // namespace pred
