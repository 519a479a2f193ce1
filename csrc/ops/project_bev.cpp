// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/project_bev.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <tuple>

#include "common/allocate.h"
#include "common/blocks.h"
#include "common/check.h"

namespace pred {
namespace {

using torch::headeronly::MemoryFormat;

PRED_KERNELS_BY_FACTOR(ProjectKernels, project_bev)

template <typename S>
struct Projection {
  using T = Compute<S>;
  Tensor bev, weight;
  int64_t cells;
  std::unique_ptr<char[]> packed;
  ProjectArgs<S> args{};

  Projection(const char* op, const Tensor& bev_in, const Tensor& weight_in, bool backward, bool tf32) {
    check_tensor(op, "bev", bev_in, 4, bev_in.scalar_type());
    check_tensor(op, "weight", weight_in, 2, std::is_same_v<T, double> ? ScalarType::Double : ScalarType::Float);
    PRED_CHECK(weight_in.size(1) == bev_in.size(1) && weight_in.size(0) >= 1 && weight_in.size(1) >= 1, op,
               ": weight must have shape [hidden, ", bev_in.size(1), "], both at least 1, got ", shape_text(weight_in));
    bev = torch::stable::contiguous(bev_in, MemoryFormat::ChannelsLast);
    weight = torch::stable::contiguous(weight_in);
    args.inputs = weight.size(1);
    args.outputs = weight.size(0);
    args.rows = storage<S>(bev);
    args.tf32 = tf32;
    cells = bev.numel() / args.inputs;
    if constexpr (!kLaunch) pack_weight(backward);
  }

  // [B, channels, H, W] whose memory is [B, H, W, channels].
  Tensor new_map(int64_t channels) const {
    const Tensor made = torch::stable::new_empty(bev, {bev.size(0), bev.size(2), bev.size(3), channels});
    return torch::stable::transpose(torch::stable::transpose(made, 2, 3), 1, 2);
  }

  const T* weight_data() const { return weight.const_data_ptr<T>(); }

  // Of kernels that are launched.
  Tensor workspace() const {
    return torch::stable::new_empty(bev, {project_bev_kernels<S>().workspace_bytes(args, cells)}, ScalarType::Byte);
  }

 private:
  void pack_weight(bool backward) {
    const ProjectKernels<S>& k = project_bev_kernels<S>();
    const int64_t rows = backward ? args.outputs : args.inputs, columns = backward ? args.inputs : args.outputs;
    const int64_t size = k.packed_size(rows, columns);
    packed = allocate_array<char>(size * int64_t(sizeof(S)) + Arena::kAlignment);
    S* first = Arena(packed.get()).template take<S>(size);
    const T* data = weight.const_data_ptr<T>();
    k.pack(data, backward ? args.inputs : 1, backward ? 1 : args.inputs, rows, columns, first);
    args.packed = first;
  }
};

template <typename S>
Tensor forward(const Projection<S>& in) {
  Tensor out = in.new_map(in.args.outputs);
  S* data = mutable_storage<S>(out);
  const ProjectKernels<S>& k = project_bev_kernels<S>();
  if constexpr (kLaunch) {
    const Tensor workspace = in.workspace();
    k.forward(in.args, in.weight_data(), data, mutable_storage<char>(workspace), in.cells);
  } else {
    const Blocks tasks = product_tasks(in.cells);
    parallel(tasks.count(), 1, [&](int64_t first, int64_t last) {
      const auto scratch = allocate_array<char>(k.scratch_bytes(in.args));
      k.forward(in.args, data, scratch.get(), tasks.begin(first), tasks.end(last - 1));
    });
  }
  return out;
}

// Gradients of the map and of the weight; null where not wanted.
template <typename S, typename T = Compute<S>>
void backward(const Projection<S>& in, S* grad_rows, T* grad_weight) {
  const ProjectKernels<S>& k = project_bev_kernels<S>();
  if constexpr (kLaunch) {
    const Tensor workspace = in.workspace();
    k.backward(in.args, in.weight_data(), {grad_rows, grad_weight}, mutable_storage<char>(workspace), in.cells);
  } else {
    const int64_t columns = k.columns(in.args.inputs), sums_size = in.args.outputs * columns;
    const Blocks blocks = product_sums(in.cells, sums_size * int64_t(sizeof(T)));
    std::unique_ptr<T[]> sums;
    if (grad_weight) sums = allocate_array<T>(blocks.count() * sums_size);
    parallel(blocks.count(), 1, [&](int64_t first, int64_t last) {
      const auto scratch = allocate_array<char>(k.scratch_bytes(in.args));
      for (int64_t block = first; block < last; ++block) {
        T* part = sums ? sums.get() + block * sums_size : nullptr;
        if (part) std::fill(part, part + sums_size, T(0));
        k.backward(in.args, {grad_rows, part}, scratch.get(), blocks.begin(block), blocks.end(block));
      }
    });
    if (grad_weight) {
      add_blocks(sums.get(), blocks.count(), sums_size, in.args.outputs, columns, in.args.inputs, grad_weight);
    }
  }
}

Tensor project_bev(const Tensor& bev, const Tensor& weight, bool tf32) {
  const char* op = "project_bev";
  return PRED_DISPATCH_FACTOR(op, bev.scalar_type(),
                              [&] { return forward(Projection<S>(op, bev, weight, false, tf32)); });
}

std::tuple<Tensor, Tensor> project_bev_backward(const Tensor& grad_in, const Tensor& bev, const Tensor& weight,
                                                bool need_bev, bool need_weight, bool tf32) {
  const char* op = "project_bev_backward";
  return PRED_DISPATCH_FACTOR(op, bev.scalar_type(), [&] {
    Projection<S> in(op, bev, weight, true, tf32);
    check_tensor(op, "grad", grad_in, 4, bev.scalar_type());
    check_sizes(op, "grad", grad_in, {bev.size(0), weight.size(0), bev.size(2), bev.size(3)});
    const Tensor grad = torch::stable::contiguous(grad_in, MemoryFormat::ChannelsLast);
    in.args.grad = storage<S>(grad);
    Tensor out_bev = need_bev ? in.new_map(in.args.inputs) : torch::stable::new_empty(in.bev, {0});
    Tensor out_weight = torch::stable::new_empty(in.weight, {need_weight ? in.args.outputs : 0, in.args.inputs});
    backward(in, need_bev ? mutable_storage<S>(out_bev) : nullptr,
             need_weight ? out_weight.mutable_data_ptr<T>() : nullptr);
    return std::make_tuple(out_bev, out_weight);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "project_bev", &pred::project_bev);
  PRED_IMPL(m, "project_bev_backward", &pred::project_bev_backward);
}
