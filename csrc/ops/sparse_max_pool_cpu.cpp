// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one row of the result.
#include "ops/segment_reduce.h"
#include "ops/sparse_max_pool.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
static void forward(const S* features, int64_t source_rows, int64_t channels, const int32_t* table, int64_t taps,
                    S* out, int32_t* winner, int64_t begin, int64_t end) {
  for (int64_t row = begin; row < end; ++row) {
    S* __restrict best = out + row * channels;
    int32_t* __restrict from = winner + row * channels;
    for (int64_t c = 0; c < channels; ++c) {
      best[c] = S{};
      from[c] = -1;
    }
    for (int64_t tap = 0; tap < taps; ++tap) {
      const int64_t source = table[row * taps + tap];
      if (source < 0 || source >= source_rows) continue;
      const S* __restrict feature = features + source * channels;
      for (int64_t c = 0; c < channels; ++c) {
        const bool replace = (from[c] < 0) | replaces_maximum(widen(feature[c]), widen(best[c]));
        best[c] = replace ? feature[c] : best[c];
        from[c] = replace ? int32_t(source) : from[c];
      }
    }
  }
}

template <typename S>
static void backward(const S* grad, const int32_t* winner, int64_t source_rows, int64_t channels, const int32_t* table,
                     int64_t taps, S* out, int64_t begin, int64_t end) {
  using T = Compute<S>;
  constexpr int64_t kColumns = 64;
  T sum[kColumns];
  for (int64_t row = begin; row < end; ++row) {
    for (int64_t first = 0; first < channels; first += kColumns) {
      const int64_t count = channels - first < kColumns ? channels - first : kColumns;
      for (int64_t c = 0; c < count; ++c) sum[c] = T(0);
      for (int64_t tap = 0; tap < taps; ++tap) {
        const int64_t output = table[row * taps + tap];
        if (output < 0 || output >= source_rows) continue;
        const S* __restrict value = grad + output * channels + first;
        const int32_t* __restrict from = winner + output * channels + first;
        for (int64_t c = 0; c < count; ++c) sum[c] += from[c] == int32_t(row) ? widen(value[c]) : T(0);
      }
      for (int64_t c = 0; c < count; ++c) out[row * channels + first + c] = narrow<S>(sum[c]);
    }
  }
}

}  // namespace

const SparseMaxPoolKernels<float> sparse_max_pool_f32 = {forward<float>, backward<float>};
const SparseMaxPoolKernels<double> sparse_max_pool_f64 = {forward<double>, backward<double>};
const SparseMaxPoolKernels<BFloat16> sparse_max_pool_bf16 = {forward<BFloat16>, backward<BFloat16>};
const SparseMaxPoolKernels<Float16> sparse_max_pool_f16 = {forward<Float16>, backward<Float16>};

}  // namespace pred::PRED_ISA
