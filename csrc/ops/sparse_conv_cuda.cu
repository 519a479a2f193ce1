// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// A convolution is one product (math/product_cuda.cuh) with as many segments as there are taps: the rows that a tap
// reads are gathered into shared memory, and taps that a tile of outputs does not have are left out. Nothing is
// scattered. The weight's gradient is an outer product per tap, of the same gathered rows, all in one launch.
#include "common/workspace.h"
#include "math/product_cuda.cuh"
#include "ops/sparse_conv.h"

namespace pred::PRED_ISA {
namespace {

// Row i of tap `segment`: the one that the table names.
template <typename S>
struct TableRows {
  static constexpr bool kSparse = true;
  const S* data;
  int64_t stride, numbers;
  const int32_t* table;
  int64_t taps, rows;

  __device__ const S* row(int64_t i, int segment) const {
    if (i >= rows) return nullptr;
    const int64_t number = table[i * taps + segment];
    return number >= 0 && number < numbers ? data + number * stride : nullptr;
  }
};

// Matrices [taps, outputs, stride] side by side.
template <typename S>
struct TapRows {
  const S* data;
  int64_t stride, outputs;

  __device__ const S* row(int64_t i, int segment) const {
    return i < outputs ? data + (segment * outputs + i) * stride : nullptr;
  }
};

template <typename S>
struct StoreWithBias {
  const S* bias;  // or null
  S* out;
  int64_t columns;
  bool chunks = in_chunks(out, columns);

  __device__ auto at(int64_t column, int) const {
    using T = Compute<S>;
    T add[kColumns<false>] = {};
#pragma unroll
    for (int v = 0; v < kColumns<false>; ++v) {
      if (bias && column + v < columns) add[v] = widen(bias[column + v]);
    }
    return [this, column, add](int64_t row, const T(&value)[kColumns<false>]) {
      T result[kColumns<false>];
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) result[v] = bias ? value[v] + add[v] : value[v];
      store_columns(out + row * columns + column, chunks, columns - column, result);
    };
  }
};

// to[tap, n, k] = weight[n, tap, k], or weight[k, tap, n] if transposed; 0 in columns that fill up a row.
template <typename S>
__global__ void pack_taps_kernel(const S* weight, int64_t taps, int64_t inputs, int64_t outputs, int64_t stride,
                                 bool transposed, S* to) {
  for (int64_t i = first_thread(); i < taps * outputs * stride; i += thread_stride()) {
    const int64_t row = i / stride, k = i - row * stride, tap = row / outputs, n = row - tap * outputs;
    const int64_t from = transposed ? (k * taps + tap) * outputs + n : (n * taps + tap) * inputs + k;
    to[i] = k < inputs ? weight[from] : S{};
  }
}

// grad[o, tap, c] = the sum of parts[tap, split, o, c] over splits, in order.
template <typename S, typename T = Compute<S>>
__global__ void write_weight_kernel(const T* parts, int splits, int64_t taps, int64_t outputs, int64_t inputs,
                                    S* grad) {
  const int64_t size = outputs * inputs;
  for (int64_t i = first_thread(); i < taps * size; i += thread_stride()) {
    const int64_t tap = i / size, at = i - tap * size, o = at / inputs, c = at - o * inputs;
    double sum = 0;  // there may be many
    for (int split = 0; split < splits; ++split) sum += double(parts[(tap * splits + split) * size + at]);
    narrow_to(grad[(o * taps + tap) * inputs + c], T(sum));
  }
}

template <typename S>
struct Space {
  S *source, *grad, *weight;
  Compute<S>* parts;
  int splits;
  int64_t bytes;

  Space(const SparseConvArgs<S>& a, bool of_weight, int64_t rows, int64_t source_rows, char* memory) {
    Workspace space(memory);
    const int64_t inputs = whole_chunks<S>(a.inputs);
    splits = outer_splits(a.outputs, a.inputs, rows, a.taps);
    source = space.take<S>(source_rows * inputs);
    grad = space.take<S>(of_weight ? rows * whole_chunks<S>(a.outputs) : 0);
    weight = space.take<S>(of_weight ? 0 : a.taps * a.outputs * inputs);
    parts = space.take<Compute<S>>(of_weight ? a.taps * splits * a.outputs * a.inputs : 0);
    bytes = space.bytes();
  }
};

template <typename S>
int64_t workspace_bytes(const SparseConvArgs<S>& a, bool of_weight, int64_t rows, int64_t source_rows) {
  return Space<S>(a, of_weight, rows, source_rows, nullptr).bytes;
}

template <typename S>
TableRows<S> table_rows(const SparseConvArgs<S>& a, const ProductRows<S>& source, int64_t rows) {
  return {source.data, source.stride, source.rows, a.table, a.taps, rows};
}

template <typename S>
void product(const SparseConvArgs<S>& a, const S* weight, bool transposed, S* out, char* workspace, int64_t rows,
             int64_t source_rows) {
  const Space<S> space(a, false, rows, source_rows, workspace);
  const int64_t stride = whole_chunks<S>(a.inputs);
  launch_threads(pack_taps_kernel<S>, a.taps * a.outputs * stride, weight, a.taps, a.inputs, a.outputs, stride,
                 transposed, space.weight);
  const ProductRows<S> source = readable_rows(a.source, a.inputs, source_rows, space.source);
  launch_product<S, false>({rows, a.outputs, stride, int(a.taps), 1, a.tf32, false}, table_rows(a, source, rows),
                           TapRows<S>{space.weight, stride, a.outputs}, StoreWithBias<S>{a.bias, out, a.outputs});
}

template <typename S>
void weight(const SparseConvArgs<S>& a, S* grad_weight, char* workspace, int64_t rows, int64_t source_rows) {
  using T = Compute<S>;
  const Space<S> space(a, true, rows, source_rows, workspace);
  const ProductRows<S> source = readable_rows(a.source, a.inputs, source_rows, space.source);
  const ProductRows<S> grad = readable_rows(a.grad, a.outputs, rows, space.grad);
  launch_product<S, true>({a.outputs, a.inputs, rows, int(a.taps), space.splits, a.tf32, true}, grad,
                          table_rows(a, source, rows), AddToParts<T>{space.parts, a.outputs, a.inputs, true});
  launch_threads(write_weight_kernel<S>, a.taps * a.outputs * a.inputs, static_cast<const T*>(space.parts),
                 space.splits, a.taps, a.outputs, a.inputs, grad_weight);
}

template <typename S>
constexpr SparseConvKernels<S> table() {
  return {workspace_bytes<S>, product<S>, weight<S>};
}

}  // namespace

const SparseConvKernels<float> sparse_conv_f32 = table<float>();
const SparseConvKernels<double> sparse_conv_f64 = table<double>();
const SparseConvKernels<BFloat16> sparse_conv_bf16 = table<BFloat16>();
const SparseConvKernels<Float16> sparse_conv_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
