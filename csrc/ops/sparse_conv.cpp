// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sparse_conv.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <tuple>

#include "common/allocate.h"
#include "common/blocks.h"
#include "common/check.h"
#include "ops/sparse_tables.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(SparseConvKernels, sparse_conv)

// Sizes and contiguous arguments of both ops.
struct Problem {
  Tensor features, weight, out_to_in, in_to_out;  // [M, C], [O, K, C], [M', K], [M, K]
  int64_t rows_in, rows_out, inputs, outputs, taps;
  bool tf32;

  Problem(const char* op, const Tensor& features_in, const Tensor& weight_in, const Tensor& out_to_in_in,
          const Tensor& in_to_out_in, bool tf32_in)
      : tf32(tf32_in) {
    check_tensor(op, "features", features_in, 2, features_in.scalar_type());
    check_tensor(op, "weight", weight_in, 3, features_in.scalar_type());
    inputs = features_in.size(1), outputs = weight_in.size(0), taps = weight_in.size(1);
    PRED_CHECK(weight_in.size(2) == inputs, op, ": weight must have shape [O, K, ", inputs, "], got ",
               shape_text(weight_in));
    rows_in = features_in.size(0), rows_out = table_rows(op, "out_to_in", out_to_in_in);
    out_to_in = checked_table(op, "out_to_in", out_to_in_in, rows_out, taps, rows_in);
    in_to_out = checked_table(op, "in_to_out", in_to_out_in, rows_in, taps, rows_out);
    features = torch::stable::contiguous(features_in);
    weight = torch::stable::contiguous(weight_in);
  }
};

#ifdef PRED_LAUNCH
// The same functions for kernels that are launched.
template <typename S>
Tensor workspace_for(const Problem& in, const SparseConvArgs<S>& a, bool of_weight, int64_t rows, int64_t source_rows) {
  const int64_t bytes = sparse_conv_kernels<S>().workspace_bytes(a, of_weight, rows, source_rows);
  return torch::stable::new_empty(in.features, {bytes}, ScalarType::Byte);
}

template <typename S>
void product(const Problem& in, const Tensor& table, const S* source, bool transposed, const S* bias, S* out) {
  SparseConvArgs<S> a{
      table.const_data_ptr<int32_t>(), in.taps, in.inputs, in.outputs, source, nullptr, 0, bias, nullptr, in.tf32};
  if (transposed) std::swap(a.inputs, a.outputs);
  const int64_t rows = transposed ? in.rows_in : in.rows_out, source_rows = transposed ? in.rows_out : in.rows_in;
  const Tensor workspace = workspace_for(in, a, false, rows, source_rows);
  sparse_conv_kernels<S>().product(a, storage<S>(in.weight), transposed, out, mutable_storage<char>(workspace), rows,
                                   source_rows);
}

template <typename S>
void weight_gradient(const Problem& in, const S* grad, S* out) {
  const SparseConvArgs<S> a{in.out_to_in.const_data_ptr<int32_t>(),
                            in.taps,
                            in.inputs,
                            in.outputs,
                            storage<S>(in.features),
                            nullptr,
                            0,
                            nullptr,
                            grad,
                            in.tf32};
  const Tensor workspace = workspace_for(in, a, true, in.rows_out, in.rows_in);
  sparse_conv_kernels<S>().weight(a, out, mutable_storage<char>(workspace), in.rows_out, in.rows_in);
}
#else
// out [rows, outputs] of a product along a table, whose matrices are W_k, or W_k^T if `transposed`.
template <typename S>
void product(const Problem& in, const Tensor& table, const S* source, bool transposed, const S* bias, S* out) {
  using T = Compute<S>;
  const SparseConvKernels<S>& k = sparse_conv_kernels<S>();
  SparseConvArgs<S> a{
      table.const_data_ptr<int32_t>(), in.taps, in.inputs, in.outputs, source, nullptr, 0, bias, nullptr, in.tf32};
  if (transposed) std::swap(a.inputs, a.outputs);
  a.packed_size = k.packed_size(a.inputs, a.outputs);
  const auto packed = allocate_array<char>(in.taps * a.packed_size * int64_t(sizeof(Factor<S>)) + Arena::kAlignment);
  Factor<S>* matrices = Arena(packed.get()).template take<Factor<S> >(in.taps * a.packed_size);
  const S* weight = storage<S>(in.weight);
  const int64_t tap_stride = in.inputs, output_stride = in.taps * in.inputs;
  parallel(in.taps, 1, [&](int64_t begin, int64_t end) {
    const auto scratch = allocate_array<T>(a.inputs * a.outputs);
    for (int64_t tap = begin; tap < end; ++tap) {
      k.pack(weight + tap * tap_stride, transposed ? output_stride : 1, transposed ? 1 : output_stride, a.inputs,
             a.outputs, scratch.get(), matrices + tap * a.packed_size);
    }
  });
  a.packed = matrices;
  const Blocks tiles{table.size(0), kSparseTile};
  parallel(tiles.count(), 1, [&](int64_t first, int64_t last) {
    const auto scratch = allocate_array<char>(k.scratch_bytes(a));
    k.product(a, out, scratch.get(), tiles.begin(first), tiles.end(last - 1));
  });
}

// Goes along the table of fewer rows, as both hold the same pairs: of the inputs' one, it makes the transposed sums.
template <typename S>
void weight_gradient(const Problem& in, const S* grad, S* out) {
  using T = Compute<S>;
  const SparseConvKernels<S>& k = sparse_conv_kernels<S>();
  SparseConvArgs<S> a{in.out_to_in.const_data_ptr<int32_t>(),
                      in.taps,
                      in.inputs,
                      in.outputs,
                      storage<S>(in.features),
                      nullptr,
                      0,
                      nullptr,
                      grad,
                      in.tf32};
  const bool transposed = in.rows_in < in.rows_out;
  if (transposed) {
    a.table = in.in_to_out.const_data_ptr<int32_t>();
    std::swap(a.inputs, a.outputs);
    std::swap(a.source, a.grad);
  }
  const int64_t columns = k.columns(a.inputs), size = a.outputs * columns;
  const Blocks blocks = product_sums(std::min(in.rows_in, in.rows_out), in.taps * size * int64_t(sizeof(T)));
  const int64_t count = blocks.count();
  const auto sums = allocate_array<T>(in.taps * count * size);
  parallel(in.taps * count, 1, [&](int64_t first, int64_t last) {
    const auto scratch = allocate_array<char>(k.scratch_bytes(a));
    for (int64_t task = first; task < last; ++task) {
      T* part = sums.get() + task * size;
      std::fill_n(part, size, T(0));
      const int64_t block = task / in.taps;  // whose rows stay in cache from tap to tap
      k.weight(a, task % in.taps, part, scratch.get(), blocks.begin(block), blocks.end(block));
    }
  });
  const auto total = allocate_array<T>(in.taps * size);
  add_blocks(sums.get(), count, in.taps * size, in.taps * a.outputs, columns, columns, total.get());
  const int64_t output_stride = transposed ? 1 : columns, input_stride = transposed ? columns : 1;
  for (int64_t tap = 0; tap < in.taps; ++tap) {
    for (int64_t o = 0; o < in.outputs; ++o) {
      const T* from = total.get() + tap * size + o * output_stride;
      S* to = out + (o * in.taps + tap) * in.inputs;
      for (int64_t c = 0; c < in.inputs; ++c) to[c] = narrow<S>(from[c * input_stride]);
    }
  }
}
#endif

Tensor sparse_conv(const Tensor& features, const Tensor& weight, const std::optional<Tensor>& bias_in,
                   const Tensor& out_to_in, const Tensor& in_to_out, bool tf32) {
  const char* op = "sparse_conv";
  return PRED_DISPATCH_STORAGE(op, features.scalar_type(), [&] {
    const Problem in(op, features, weight, out_to_in, in_to_out, tf32);
    Tensor bias;
    if (bias_in) {
      check_tensor(op, "bias", *bias_in, 1, features.scalar_type());
      check_sizes(op, "bias", *bias_in, {in.outputs});
      bias = torch::stable::contiguous(*bias_in);
    }
    Tensor out = torch::stable::new_empty(in.features, {in.rows_out, in.outputs});
    if (in.outputs == 0) return out;
    product<S>(in, in.out_to_in, storage<S>(in.features), false, bias_in ? storage<S>(bias) : nullptr,
               mutable_storage<S>(out));
    return out;
  });
}

std::tuple<Tensor, Tensor> sparse_conv_backward(const Tensor& grad_in, const Tensor& features, const Tensor& weight,
                                                const Tensor& out_to_in, const Tensor& in_to_out, bool need_features,
                                                bool need_weight, bool tf32) {
  const char* op = "sparse_conv_backward";
  return PRED_DISPATCH_STORAGE(op, features.scalar_type(), [&] {
    const Problem in(op, features, weight, out_to_in, in_to_out, tf32);
    check_tensor(op, "grad", grad_in, 2, features.scalar_type());
    check_sizes(op, "grad", grad_in, {in.rows_out, in.outputs});
    const Tensor grad = torch::stable::contiguous(grad_in);
    Tensor out_features = torch::stable::new_empty(in.features, {need_features ? in.rows_in : 0, in.inputs});
    Tensor out_weight = torch::stable::new_empty(in.weight, {need_weight ? in.outputs : 0, in.taps, in.inputs});
    if (need_features && in.inputs > 0) {
      product<S>(in, in.in_to_out, storage<S>(grad), true, nullptr, mutable_storage<S>(out_features));
    }
    if (need_weight && out_weight.numel() > 0) {
      weight_gradient<S>(in, storage<S>(grad), mutable_storage<S>(out_weight));
    }
    return std::make_tuple(out_features, out_weight);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "sparse_conv", &pred::sparse_conv);
  PRED_IMPL(m, "sparse_conv_backward", &pred::sparse_conv_backward);
}
