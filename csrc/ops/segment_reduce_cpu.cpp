// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// A range of segments (forward) or rows (backward) is owned by one thread. Forward, every thread reads the whole index
// and takes the rows of its own segments in ascending order, so that results do not depend on the number of threads.
// That costs a fraction of a nanosecond per row and thread: less than sorting the rows by segment first, and features
// are read in the order of memory.
#include "ops/segment_reduce.h"

namespace pred::PRED_ISA {
namespace {

static bool is_valid(const int64_t* index, int64_t num_segments, int64_t begin, int64_t end) {
  int64_t wrong = 0;
  for (int64_t i = begin; i < end; ++i) wrong |= int64_t(index[i] < -1) | int64_t(index[i] >= num_segments);
  return wrong == 0;
}

// Rows of other arrays are reached through the index: they are asked for this many rows early.
constexpr int64_t kAhead = 8;

template <typename T>
static inline void prefetch(const T* row, int64_t channels) {
  constexpr int64_t kCacheLine = 64;
  for (int64_t c = 0; c < channels; c += kCacheLine / int64_t(sizeof(T))) __builtin_prefetch(row + c);
}

template <typename S, SegmentReduction kReduction>
static void forward(const SegmentReduceArgs<S>& a, Compute<S>* out, int32_t* saved, int64_t begin, int64_t end) {
  using T = Compute<S>;
  constexpr bool kMean = kReduction == SegmentReduction::kMean, kMax = kReduction == SegmentReduction::kMax;
  const int64_t channels = a.channels;
  for (int64_t i = begin * channels; i < end * channels; ++i) out[i] = T(0);
  if (kMean) {
    for (int64_t segment = begin; segment < end; ++segment) saved[segment] = 0;
  }
  if (kMax) {
    for (int64_t i = begin * channels; i < end * channels; ++i) saved[i] = -1;
  }
  for (int64_t row = 0; row < a.num_rows; ++row) {
    const int64_t segment = a.index[row];
    if (segment < begin || segment >= end) continue;
    const int64_t next = a.index[row + kAhead < a.num_rows ? row + kAhead : row];
    if (next >= begin && next < end) {
      prefetch(out + next * channels, channels);
      if (kMax) prefetch(saved + next * channels, channels);
    }
    const S* __restrict feature = a.features + row * channels;
    T* __restrict result = out + segment * channels;
    if (kMax) {
      int32_t* __restrict winner = saved + segment * channels;
      for (int64_t c = 0; c < channels; ++c) {
        const T value = widen(feature[c]);
        const bool replace = (winner[c] < 0) | replaces_maximum(value, result[c]);
        result[c] = replace ? value : result[c];
        winner[c] = replace ? int32_t(row) : winner[c];
      }
    } else {
      for (int64_t c = 0; c < channels; ++c) result[c] += widen(feature[c]);
    }
    if (kMean) ++saved[segment];
  }
  if (kMean) {
    for (int64_t segment = begin; segment < end; ++segment) {
      const T count = T(saved[segment] > 0 ? saved[segment] : 1);
      for (int64_t c = 0; c < channels; ++c) out[segment * channels + c] /= count;
    }
  }
}

template <typename S>
static void round(const Compute<S>* values, S* out, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) out[i] = narrow<S>(values[i]);
}

template <typename S, SegmentReduction kReduction>
static void backward(const S* grad, int64_t channels, const int64_t* index, const int32_t* saved, S* out, int64_t begin,
                     int64_t end) {
  using T = Compute<S>;
  for (int64_t row = begin; row < end; ++row) {
    const int64_t next = index[row + kAhead < end ? row + kAhead : row];
    if (next >= 0) {
      prefetch(grad + next * channels, channels);
      if (kReduction == SegmentReduction::kMax) prefetch(saved + next * channels, channels);
    }
    S* __restrict result = out + row * channels;
    const int64_t segment = index[row];
    if (segment < 0) {
      for (int64_t c = 0; c < channels; ++c) result[c] = S{};
      continue;
    }
    const S* __restrict value = grad + segment * channels;
    if (kReduction == SegmentReduction::kSum) {
      for (int64_t c = 0; c < channels; ++c) result[c] = value[c];
    } else if (kReduction == SegmentReduction::kMean) {
      const T count = T(saved[segment]);
      for (int64_t c = 0; c < channels; ++c) result[c] = narrow<S>(widen(value[c]) / count);
    } else {
      const int32_t* __restrict winner = saved + segment * channels;
      for (int64_t c = 0; c < channels; ++c) result[c] = winner[c] == int32_t(row) ? value[c] : S{};
    }
  }
}

template <typename S>
constexpr SegmentReduceKernels<S> table() {
  using R = SegmentReduction;
  return {is_valid,
          {forward<S, R::kSum>, forward<S, R::kMean>, forward<S, R::kMax>},
          round<S>,
          {backward<S, R::kSum>, backward<S, R::kMean>, backward<S, R::kMax>}};
}

}  // namespace

const SegmentReduceKernels<float> segment_reduce_f32 = table<float>();
const SegmentReduceKernels<double> segment_reduce_f64 = table<double>();
const SegmentReduceKernels<BFloat16> segment_reduce_bf16 = table<BFloat16>();
const SegmentReduceKernels<Float16> segment_reduce_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
