// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sparse_conv: a convolution at the active sites alone, and its gradients. With the tables of build_rulebook,
//   out[o]      = bias + sum over taps k, i = out_to_in[o, k], of W_k features[i]
//   grad_in[i]  = sum over taps k, o = in_to_out[i, k], of W_k^T grad[o]
//   grad_W_k    = sum over outputs o, i = out_to_in[o, k], of grad[o] features[i]^T
// The first two are one product along a table; a table's -1 is left out. Rows are stored as S, on the CPU multiplied as
// Factor<S>, and added up as Compute<S>.
#pragma once

#include <type_traits>

#include "common/isa.h"
#include "math/half.h"

namespace pred {

// The CPU has no products of float16: its rows are widened when they are gathered.
template <typename S>
using Factor = std::conditional_t<std::is_same_v<S, Float16>, float, S>;

// Sizes that the sums of rows of one tile do not outgrow the cache with.
constexpr int64_t kSparseTile = 384;

template <typename S>
struct SparseConvArgs {
  const int32_t* table;  // [rows, K]
  int64_t taps, inputs, outputs;
  const S* source;          // [*, inputs], which the table's numbers are rows of
  const Factor<S>* packed;  // K matrices [inputs, outputs]; of the product alone
  int64_t packed_size;      // of each
  const S* bias;            // [outputs] or null; of the product alone
  const S* grad;            // [rows, outputs]; of the weight's gradient alone
  bool tf32;                // where kernels are launched
};

#ifdef PRED_LAUNCH
// A table's number that is no row counts as -1.
template <typename S>
struct SparseConvKernels {
  int64_t (*workspace_bytes)(const SparseConvArgs<S>&, bool of_weight, int64_t rows, int64_t source_rows);
  // weight: [outputs, K, inputs], or [inputs, K, outputs] where the product is with the transposed matrices.
  void (*product)(const SparseConvArgs<S>&, const S* weight, bool transposed, S* out, char* workspace, int64_t rows,
                  int64_t source_rows);
  // grad_weight: [outputs, K, inputs].
  void (*weight)(const SparseConvArgs<S>&, S* grad_weight, char* workspace, int64_t rows, int64_t source_rows);
};
#else
template <typename S>
struct SparseConvKernels {
  using T = Compute<S>;
  int64_t (*packed_size)(int64_t inputs, int64_t outputs);
  // B[k, n] = widened from[k row_stride + n column_stride]; scratch: [rows, columns].
  void (*pack)(const S* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns, T* scratch,
               Factor<S>* to);
  int64_t (*columns)(int64_t columns);  // whole panels
  int64_t (*scratch_bytes)(const SparseConvArgs<S>&);
  // Rows [begin, end) of `out` [rows, outputs].
  void (*product)(const SparseConvArgs<S>&, S* out, char* scratch, int64_t begin, int64_t end);
  // Adds the part of rows [begin, end) to the gradient of tap `tap`, [outputs, columns(inputs)].
  void (*weight)(const SparseConvArgs<S>&, int64_t tap, T* sums, char* scratch, int64_t begin, int64_t end);
  // Whether a table's numbers [begin, end) lie in [-1, rows).
  bool (*is_valid)(const int32_t* table, int64_t rows, int64_t begin, int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(SparseConvKernels<float>, sparse_conv_f32)
PRED_DECLARE_KERNELS(SparseConvKernels<double>, sparse_conv_f64)
PRED_DECLARE_KERNELS(SparseConvKernels<BFloat16>, sparse_conv_bf16)
PRED_DECLARE_KERNELS(SparseConvKernels<Float16>, sparse_conv_f16)
