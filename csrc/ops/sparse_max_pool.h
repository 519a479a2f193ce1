// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sparse_max_pool: per channel the maximum over the active sites that an output reads, and its gradient. With the
// tables of build_rulebook,
//   out[o, c]     = max over taps k, i = out_to_in[o, k], of features[i, c]; 0 where there is none
//   winner[o, c]  = the row i it came from, the first tap's of equal ones; -1 where there is none
//   grad_in[i, c] = sum over taps k, o = in_to_out[i, k], of grad[o, c] if winner[o, c] = i
#pragma once

#include "common/isa.h"
#include "math/half.h"

namespace pred {

template <typename S>
struct SparseMaxPoolKernels {
  // Rows [begin, end) of out and winner, [rows, channels]; table: [rows, taps], whose numbers are rows of `features`
  // (of `grad`), of which there are source_rows, or count as -1.
  void (*forward)(const S* features, int64_t source_rows, int64_t channels, const int32_t* table, int64_t taps, S* out,
                  int32_t* winner, int64_t begin, int64_t end);
  void (*backward)(const S* grad, const int32_t* winner, int64_t source_rows, int64_t channels, const int32_t* table,
                   int64_t taps, S* out, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SparseMaxPoolKernels<float>, sparse_max_pool_f32)
PRED_DECLARE_KERNELS(SparseMaxPoolKernels<double>, sparse_max_pool_f64)
PRED_DECLARE_KERNELS(SparseMaxPoolKernels<BFloat16>, sparse_max_pool_bf16)
PRED_DECLARE_KERNELS(SparseMaxPoolKernels<Float16>, sparse_max_pool_f16)
