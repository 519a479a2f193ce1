// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// segment_reduce: sum, mean or maximum of the feature rows that share a segment, and its gradient.
//
//   forward    out[s, c]  = reduce over the rows i of segment s, in ascending order, of features[i, c]; 0 if none
//   backward   out[i, c]  = grad[s, c]             (sum)          with s = index[i]; 0 if s is -1
//                         = grad[s, c] / count[s]  (mean)
//                         = grad[s, c]             (max) if winner[s, c] = i, else 0
//
// S is the type in which features and gradients are stored. Sums are made in Compute<S> and rounded once.
#pragma once

#include "common/host_device.h"
#include "common/isa.h"
#include "math/half.h"

namespace pred {

enum class SegmentReduction { kSum, kMean, kMax };

// Whether `value` replaces the maximum `best` of earlier rows: the first of equal values stays, and the first NaN.
template <typename T>
PRED_HOST_DEVICE bool replaces_maximum(T value, T best) {
  return (value > best) | ((value != value) & (best == best));
}

template <typename S>
struct SegmentReduceArgs {
  const S* features;     // [N, C]
  const int64_t* index;  // [N] in [-1, S)
  int64_t num_rows, channels;
};

#ifdef PRED_LAUNCH
// An index outside of [-1, num_segments) counts as -1.
template <typename S>
struct SegmentReduceKernels {
  int64_t (*workspace_bytes)(int64_t num_rows, int64_t num_segments);
  // saved: as below.
  void (*forward)(SegmentReduction, const SegmentReduceArgs<S>&, int64_t num_segments, S* out, int32_t* saved,
                  char* workspace);
  void (*backward)(SegmentReduction, const S* grad, int64_t num_segments, int64_t channels, const int64_t* index,
                   const int32_t* saved, S* out, int64_t num_rows);
};
#else
template <typename S>
struct SegmentReduceKernels {
  using T = Compute<S>;
  // Whether index[begin .. end) lies in [-1, num_segments).
  bool (*is_valid)(const int64_t* index, int64_t num_segments, int64_t begin, int64_t end);
  // Segments [begin, end). saved: row counts [S] (mean), winning rows [S, C] or -1 (max), unused (sum).
  void (*forward[3])(const SegmentReduceArgs<S>&, T* out, int32_t* saved, int64_t begin, int64_t end);
  // Elements [begin, end).
  void (*round)(const T* values, S* out, int64_t begin, int64_t end);
  // Rows [begin, end).
  void (*backward[3])(const S* grad, int64_t channels, const int64_t* index, const int32_t* saved, S* out,
                      int64_t begin, int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(SegmentReduceKernels<float>, segment_reduce_f32)
PRED_DECLARE_KERNELS(SegmentReduceKernels<double>, segment_reduce_f64)
PRED_DECLARE_KERNELS(SegmentReduceKernels<BFloat16>, segment_reduce_bf16)
PRED_DECLARE_KERNELS(SegmentReduceKernels<Float16>, segment_reduce_f16)
