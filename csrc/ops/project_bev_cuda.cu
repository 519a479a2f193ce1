// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Three products (math/product_cuda.cuh), whose results are written as they are. The weight's gradient is made in
// parts.
#include "common/workspace.h"
#include "math/product_cuda.cuh"
#include "ops/project_bev.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct StoreRows {
  S* out;
  int64_t stride;
  bool chunks = in_chunks(out, stride);

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const Compute<S>(&value)[kColumns<false>]) {
      store_columns(out + row * stride + column, chunks, stride - column, value);
    };
  }
};

template <typename S>
struct Space {
  S *rows, *grad, *weight;
  Compute<S>* parts;
  int splits;
  int64_t bytes;

  Space(const ProjectArgs<S>& a, int64_t cells, char* memory) {
    Workspace space(memory);
    const int64_t inputs = whole_chunks<S>(a.inputs), outputs = whole_chunks<S>(a.outputs);
    splits = outer_splits(a.outputs, a.inputs, cells);
    rows = space.take<S>(cells * inputs);
    grad = space.take<S>(cells * outputs);
    weight = space.take<S>(a.outputs * inputs > a.inputs * outputs ? a.outputs * inputs : a.inputs * outputs);
    parts = space.take<Compute<S>>(splits * a.outputs * a.inputs);
    bytes = space.bytes();
  }
};

template <typename S>
int64_t workspace_bytes(const ProjectArgs<S>& a, int64_t cells) {
  return Space<S>(a, cells, nullptr).bytes;
}

template <typename S, typename T = Compute<S>>
void forward(const ProjectArgs<S>& a, const T* weight, S* out, char* workspace, int64_t cells) {
  const Space<S> space(a, cells, workspace);
  const int64_t inputs = whole_chunks<S>(a.inputs);
  pack_rows(weight, a.inputs, int64_t(1), a.outputs, a.inputs, inputs, space.weight);
  launch_product<S, false>({cells, a.outputs, inputs, 1, 1, a.tf32, false},
                           readable_rows(a.rows, a.inputs, cells, space.rows),
                           ProductRows<S>{space.weight, inputs, a.outputs}, StoreRows<S>{out, a.outputs});
}

template <typename S, typename T = Compute<S>>
void backward(const ProjectArgs<S>& a, const T* weight, const ProjectGradients<S>& out, char* workspace,
              int64_t cells) {
  const Space<S> space(a, cells, workspace);
  const int64_t outputs = whole_chunks<S>(a.outputs);
  const ProductRows<S> grad = readable_rows(a.grad, a.outputs, cells, space.grad);
  if (out.rows) {
    pack_rows(weight, int64_t(1), a.inputs, a.inputs, a.outputs, outputs, space.weight);
    launch_product<S, false>({cells, a.inputs, outputs, 1, 1, a.tf32, false}, grad,
                             ProductRows<S>{space.weight, outputs, a.inputs}, StoreRows<S>{out.rows, a.inputs});
  }
  if (out.weight) {
    launch_product<S, true>({a.outputs, a.inputs, cells, 1, space.splits, a.tf32, false}, grad,
                            readable_rows(a.rows, a.inputs, cells, space.rows),
                            AddToParts<T>{space.parts, a.outputs, a.inputs, true});
    launch_threads(add_splits_kernel<T>, a.outputs * a.inputs, static_cast<const T*>(space.parts), a.outputs * a.inputs,
                   space.splits, out.weight);
  }
}

}  // namespace

const ProjectKernels<float> project_bev_f32 = {workspace_bytes<float>, forward<float>, backward<float>};
const ProjectKernels<double> project_bev_f64 = {workspace_bytes<double>, forward<double>, backward<double>};
const ProjectKernels<BFloat16> project_bev_bf16 = {workspace_bytes<BFloat16>, forward<BFloat16>, backward<BFloat16>};

}  // namespace pred::PRED_ISA
