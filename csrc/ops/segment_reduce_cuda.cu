// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Rows are sorted by segment. Forward, one thread owns one channel of one segment and takes its rows in ascending
// order, as the CPU does; backward, one channel of one row. Neighbouring threads have neighbouring channels.
#include "common/bits.h"
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/segment_reduce.h"

namespace pred::PRED_ISA {
namespace {

struct Space {
  uint64_t *items, *sorted;  // segment above row
  int64_t* start;
  char* sort;
  int row_bits, key_bits;
  int64_t sort_size, bytes;

  Space(int64_t num_rows, int64_t num_segments, char* memory) {
    row_bits = bits_for(num_rows);
    key_bits = bits_for(num_segments + 1);
    sort_size = sort_bytes(num_rows, row_bits, row_bits + key_bits);
    Workspace space(memory);
    items = space.take<uint64_t>(num_rows);
    sorted = space.take<uint64_t>(num_rows);
    start = space.take<int64_t>(num_segments + 1);
    sort = space.take<char>(sort_size);
    bytes = space.bytes();
  }
};

__global__ void pack_kernel(const int64_t* index, int64_t num_rows, int64_t num_segments, int row_bits,
                            uint64_t* items) {
  for (int64_t row = first_thread(); row < num_rows; row += thread_stride()) {
    const int64_t segment = index[row];
    const int64_t key = segment >= 0 && segment < num_segments ? segment : num_segments;
    items[row] = uint64_t(key) << row_bits | uint64_t(row);
  }
}

template <typename S, SegmentReduction kReduction>
__global__ void forward_kernel(SegmentReduceArgs<S> a, const uint64_t* sorted, const int64_t* start, int row_bits,
                               int64_t num_segments, S* out, int32_t* saved) {
  using T = Compute<S>;
  const uint64_t row_mask = (uint64_t(1) << row_bits) - 1;
  for (int64_t i = first_thread(); i < num_segments * a.channels; i += thread_stride()) {
    const int64_t segment = divide(i, a.channels), c = i - segment * a.channels, first = start[segment];
    const int64_t last = start[segment + 1];
    T result = T(0);
    int32_t winner = -1;
    for (int64_t item = first; item < last; ++item) {
      const int64_t row = int64_t(sorted[item] & row_mask);
      const T value = widen(a.features[row * a.channels + c]);
      if (kReduction != SegmentReduction::kMax) {
        result += value;
      } else if (winner < 0 || replaces_maximum(value, result)) {
        result = value;
        winner = int32_t(row);
      }
    }
    if (kReduction == SegmentReduction::kMean) result /= T(last > first ? last - first : 1);
    narrow_to(out[i], result);
    if (kReduction == SegmentReduction::kMax) saved[i] = winner;
  }
}

// Row counts.
__global__ void count_kernel(const int64_t* start, int64_t num_segments, int32_t* counts) {
  for (int64_t i = first_thread(); i < num_segments; i += thread_stride()) counts[i] = int32_t(start[i + 1] - start[i]);
}

template <typename S, SegmentReduction kReduction>
__global__ void backward_kernel(const S* grad, int64_t num_segments, int64_t channels, const int64_t* index,
                                const int32_t* saved, S* out, int64_t num_rows) {
  for (int64_t i = first_thread(); i < num_rows * channels; i += thread_stride()) {
    const int64_t row = divide(i, channels), c = i - row * channels, segment = index[row];
    S value{};
    if (segment >= 0 && segment < num_segments) {
      const int64_t from = segment * channels + c;
      if (kReduction == SegmentReduction::kSum) {
        value = grad[from];
      } else if (kReduction == SegmentReduction::kMean) {
        value = narrow<S>(widen(grad[from]) / Compute<S>(saved[segment]));
      } else if (saved[from] == int32_t(row)) {
        value = grad[from];
      }
    }
    out[i] = value;
  }
}

template <typename S>
void forward(SegmentReduction how, const SegmentReduceArgs<S>& a, int64_t num_segments, S* out, int32_t* saved,
             char* workspace) {
  using R = SegmentReduction;
  const Space space(a.num_rows, num_segments, workspace);
  launch_threads(pack_kernel, a.num_rows, a.index, a.num_rows, num_segments, space.row_bits, space.items);
  sort_items(space.sort, space.sort_size, space.items, space.sorted, a.num_rows, space.row_bits,
             space.row_bits + space.key_bits);
  find_runs(space.sorted, a.num_rows, space.row_bits, num_segments, space.start);
  const auto kernel = how == R::kSum    ? forward_kernel<S, R::kSum>
                      : how == R::kMean ? forward_kernel<S, R::kMean>
                                        : forward_kernel<S, R::kMax>;
  launch_threads(kernel, num_segments * a.channels, a, static_cast<const uint64_t*>(space.sorted),
                 static_cast<const int64_t*>(space.start), space.row_bits, num_segments, out, saved);
  if (how == R::kMean) {
    launch_threads(count_kernel, num_segments, static_cast<const int64_t*>(space.start), num_segments, saved);
  }
}

template <typename S>
void backward(SegmentReduction how, const S* grad, int64_t num_segments, int64_t channels, const int64_t* index,
              const int32_t* saved, S* out, int64_t num_rows) {
  using R = SegmentReduction;
  const auto kernel = how == R::kSum    ? backward_kernel<S, R::kSum>
                      : how == R::kMean ? backward_kernel<S, R::kMean>
                                        : backward_kernel<S, R::kMax>;
  launch_threads(kernel, num_rows * channels, grad, num_segments, channels, index, saved, out, num_rows);
}

int64_t workspace_bytes(int64_t num_rows, int64_t num_segments) { return Space(num_rows, num_segments, nullptr).bytes; }

template <typename S>
constexpr SegmentReduceKernels<S> table() {
  return {workspace_bytes, forward<S>, backward<S>};
}

}  // namespace

const SegmentReduceKernels<float> segment_reduce_f32 = table<float>();
const SegmentReduceKernels<double> segment_reduce_f64 = table<double>();
const SegmentReduceKernels<BFloat16> segment_reduce_bf16 = table<BFloat16>();
const SegmentReduceKernels<Float16> segment_reduce_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
