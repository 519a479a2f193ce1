// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sparse_max_pool.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <tuple>

#include "common/check.h"
#include "common/parallel.h"
#include "ops/sparse_tables.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(SparseMaxPoolKernels, sparse_max_pool)

// Rows per task, such that a task reads some 64 kB.
int64_t row_grain(int64_t channels, int64_t taps) { return 1 + 16384 / (channels * taps + 4); }

std::tuple<Tensor, Tensor> sparse_max_pool(const Tensor& features_in, const Tensor& out_to_in,
                                           const Tensor& in_to_out) {
  const char* op = "sparse_max_pool";
  check_tensor(op, "features", features_in, 2, features_in.scalar_type());
  const int64_t rows_in = features_in.size(0), rows_out = table_rows(op, "out_to_in", out_to_in);
  const int64_t taps = out_to_in.size(1), channels = features_in.size(1);
  const Tensor table = checked_table(op, "out_to_in", out_to_in, rows_out, taps, rows_in);
  checked_table(op, "in_to_out", in_to_out, rows_in, taps, rows_out);
  const Tensor features = torch::stable::contiguous(features_in);
  return PRED_DISPATCH_STORAGE(op, features.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(features, {rows_out, channels});
    Tensor winner = torch::stable::new_empty(features, {rows_out, channels}, ScalarType::Int);
    const auto& k = sparse_max_pool_kernels<S>();
    S* data = mutable_storage<S>(out);
    int32_t* winners = winner.mutable_data_ptr<int32_t>();
    parallel(rows_out, row_grain(channels, taps), [&](int64_t begin, int64_t end) {
      k.forward(storage<S>(features), rows_in, channels, table.const_data_ptr<int32_t>(), taps, data, winners, begin,
                end);
    });
    return std::make_tuple(out, winner);
  });
}

Tensor sparse_max_pool_backward(const Tensor& grad_in, const Tensor& winner_in, const Tensor& in_to_out) {
  const char* op = "sparse_max_pool_backward";
  check_tensor(op, "grad", grad_in, 2, grad_in.scalar_type());
  const int64_t rows_out = grad_in.size(0), channels = grad_in.size(1);
  check_tensor(op, "winner", winner_in, 2, ScalarType::Int);
  check_sizes(op, "winner", winner_in, {rows_out, channels});
  const int64_t rows_in = table_rows(op, "in_to_out", in_to_out), taps = in_to_out.size(1);
  const Tensor table = checked_table(op, "in_to_out", in_to_out, rows_in, taps, rows_out);
  const Tensor grad = torch::stable::contiguous(grad_in), winner = torch::stable::contiguous(winner_in);
  return PRED_DISPATCH_STORAGE(op, grad.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(grad, {rows_in, channels});
    const auto& k = sparse_max_pool_kernels<S>();
    S* data = mutable_storage<S>(out);
    parallel(rows_in, row_grain(channels, taps), [&](int64_t begin, int64_t end) {
      k.backward(storage<S>(grad), winner.const_data_ptr<int32_t>(), rows_out, channels,
                 table.const_data_ptr<int32_t>(), taps, data, begin, end);
    });
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "sparse_max_pool", &pred::sparse_max_pool);
  PRED_IMPL(m, "sparse_max_pool_backward", &pred::sparse_max_pool_backward);
}
