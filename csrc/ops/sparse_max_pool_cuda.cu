// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one channel of one row of the result. Neighbouring threads have neighbouring channels.
#include "common/launch.cuh"
#include "ops/segment_reduce.h"
#include "ops/sparse_max_pool.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
__global__ void forward_kernel(const S* features, int64_t source_rows, int64_t channels, const int32_t* table,
                               int64_t taps, S* out, int32_t* winner, int64_t rows) {
  for (int64_t i = first_thread(); i < rows * channels; i += thread_stride()) {
    const int64_t row = divide(i, channels), c = i - row * channels;
    S best{};
    int32_t from = -1;
    for (int64_t tap = 0; tap < taps; ++tap) {
      const int64_t source = table[row * taps + tap];
      if (source < 0 || source >= source_rows) continue;
      const S feature = features[source * channels + c];
      if (from >= 0 && !replaces_maximum(widen(feature), widen(best))) continue;
      best = feature;
      from = int32_t(source);
    }
    out[i] = best;
    winner[i] = from;
  }
}

template <typename S>
__global__ void backward_kernel(const S* grad, const int32_t* winner, int64_t source_rows, int64_t channels,
                                const int32_t* table, int64_t taps, S* out, int64_t rows) {
  using T = Compute<S>;
  for (int64_t i = first_thread(); i < rows * channels; i += thread_stride()) {
    const int64_t row = divide(i, channels), c = i - row * channels;
    T sum = T(0);
    for (int64_t tap = 0; tap < taps; ++tap) {
      const int64_t output = table[row * taps + tap];
      if (output < 0 || output >= source_rows) continue;
      if (winner[output * channels + c] == int32_t(row)) sum += widen(grad[output * channels + c]);
    }
    narrow_to(out[i], sum);
  }
}

template <typename S>
void forward(const S* features, int64_t source_rows, int64_t channels, const int32_t* table, int64_t taps, S* out,
             int32_t* winner, int64_t, int64_t rows) {
  launch_threads(forward_kernel<S>, rows * channels, features, source_rows, channels, table, taps, out, winner, rows);
}

template <typename S>
void backward(const S* grad, const int32_t* winner, int64_t source_rows, int64_t channels, const int32_t* table,
              int64_t taps, S* out, int64_t, int64_t rows) {
  launch_threads(backward_kernel<S>, rows * channels, grad, winner, source_rows, channels, table, taps, out, rows);
}

}  // namespace

const SparseMaxPoolKernels<float> sparse_max_pool_f32 = {forward<float>, backward<float>};
const SparseMaxPoolKernels<double> sparse_max_pool_f64 = {forward<double>, backward<double>};
const SparseMaxPoolKernels<BFloat16> sparse_max_pool_bf16 = {forward<BFloat16>, backward<BFloat16>};
const SparseMaxPoolKernels<Float16> sparse_max_pool_f16 = {forward<Float16>, backward<Float16>};

}  // namespace pred::PRED_ISA
