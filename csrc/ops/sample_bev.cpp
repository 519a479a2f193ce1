// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_bev.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <optional>
#include <tuple>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"

namespace pred {
namespace {

using torch::headeronly::MemoryFormat;

template <typename T>
const SampleBevKernels<T>& kernels() {
  if constexpr (std::is_same_v<T, float>)
    return PRED_KERNELS(sample_bev_f32);
  else
    return PRED_KERNELS(sample_bev_f64);
}

// Samples per task, such that a task moves some 64 kB.
int64_t sample_grain(int64_t channels) { return 1 + 16384 / (channels + 16); }

// Contiguous copies of the arguments and the pointers into them.
template <typename T>
struct Inputs {
  Tensor bev, grid, grad, grad_grad_bev, grad_grad_grid;
  SampleBevArgs<T> args;
  int64_t batch;

  Inputs(const char* op, const Tensor& bev_in, const Tensor& grid_in, bool border, bool align_corners)
      : batch(bev_in.size(0)) {
    check_cpu_tensor(op, "bev", bev_in, 4, bev_in.scalar_type());
    check_cpu_tensor(op, "grid", grid_in, 3, bev_in.scalar_type());
    PRED_CHECK(grid_in.size(0) == batch && grid_in.size(2) == 2, op, ": grid must have shape [", batch, ", N, 2], got ",
               shape_text(grid_in));
    PRED_CHECK(bev_in.size(2) < (int64_t(1) << 31) - 2 && grid_in.size(1) < (int64_t(1) << 31), op,
               ": a map must have fewer than 2^31 rows and samples, got ", bev_in.size(2), " and ", grid_in.size(1));
    bev = torch::stable::contiguous(bev_in, MemoryFormat::ChannelsLast);
    grid = torch::stable::contiguous(grid_in);
    args = {bev.const_data_ptr<T>(),
            grid.const_data_ptr<T>(),
            bev.size(1),
            bev.size(2),
            bev.size(3),
            grid.size(1),
            border,
            align_corners,
            nullptr,
            nullptr,
            nullptr};
  }

  void set_grad(const char* op, const Tensor& value) {
    check_cpu_tensor(op, "grad", value, 3, bev.scalar_type());
    PRED_CHECK(value.size(0) == batch && value.size(1) == args.num_samples && value.size(2) == args.channels, op,
               ": grad must have shape [", batch, ", ", args.num_samples, ", ", args.channels, "], got ",
               shape_text(value));
    grad = torch::stable::contiguous(value);
    args.grad = grad.const_data_ptr<T>();
  }

  void set_cotangents(const char* op, const std::optional<Tensor>& of_bev, const std::optional<Tensor>& of_grid) {
    if (of_bev) {
      check_cpu_tensor(op, "grad_grad_bev", *of_bev, 4, bev.scalar_type());
      for (int64_t dim = 0; dim < 4; ++dim) {
        PRED_CHECK(of_bev->size(dim) == bev.size(dim), op, ": grad_grad_bev must have shape ", shape_text(bev),
                   ", got ", shape_text(*of_bev));
      }
      grad_grad_bev = torch::stable::contiguous(*of_bev, MemoryFormat::ChannelsLast);
      args.grad_grad_bev = grad_grad_bev.const_data_ptr<T>();
    }
    if (of_grid) {
      check_cpu_tensor(op, "grad_grad_grid", *of_grid, 3, bev.scalar_type());
      for (int64_t dim = 0; dim < 3; ++dim) {
        PRED_CHECK(of_grid->size(dim) == grid.size(dim), op, ": grad_grad_grid must have shape ", shape_text(grid),
                   ", got ", shape_text(*of_grid));
      }
      grad_grad_grid = torch::stable::contiguous(*of_grid);
      args.grad_grad_grid = grad_grad_grid.const_data_ptr<T>();
    }
  }

  int64_t num_samples() const { return batch * args.num_samples; }
};

Tensor no_tensor(const Tensor& like) { return torch::stable::new_empty(like, {0}); }

// A [B, C, H, W] tensor whose memory is [B, H, W, C].
Tensor new_channels_last(const Tensor& like) {
  const Tensor memory = torch::stable::new_empty(like, {like.size(0), like.size(2), like.size(3), like.size(1)});
  return torch::stable::transpose(torch::stable::transpose(memory, 2, 3), 1, 2);
}

// Adds every sample's gradient to its cells, map row by map row.
template <typename T>
Tensor scatter(const Inputs<T>& in, bool along_direction) {
  const SampleBevArgs<T>& a = in.args;
  const auto& k = kernels<T>();
  const int64_t num_keys = a.height + 2;
  Tensor grad_bev = new_channels_last(in.bev);
  std::vector<int32_t> key(in.num_samples()), order(in.num_samples());
  std::vector<int64_t> row_begin(in.batch * num_keys + 1);
  parallel(in.num_samples(), 8192, [&](int64_t begin, int64_t end) { k.row_keys(a, key.data(), begin, end); });
  for (int64_t map = 0; map < in.batch; ++map) {  // counting sort
    const int32_t* map_key = key.data() + map * a.num_samples;
    int64_t* start = row_begin.data() + map * num_keys;
    std::vector<int64_t> count(num_keys);
    for (int64_t n = 0; n < a.num_samples; ++n) ++count[map_key[n]];
    start[0] = map * a.num_samples;
    for (int64_t j = 0; j < num_keys; ++j) start[j + 1] = start[j] + count[j];
    std::vector<int64_t> next(start, start + num_keys);
    for (int64_t n = 0; n < a.num_samples; ++n) order[next[map_key[n]]++] = int32_t(n);
  }
  const SampleBevRows rows{row_begin.data(), order.data()};
  T* out = const_cast<T*>(grad_bev.const_data_ptr<T>());
  parallel(in.batch * a.height, 1,
           [&](int64_t begin, int64_t end) { k.scatter_rows(a, rows, along_direction, out, begin, end); });
  return grad_bev;
}

Tensor sample_bev(const Tensor& bev, const Tensor& grid, bool border, bool align_corners) {
  return PRED_DISPATCH_FLOAT("sample_bev", bev.scalar_type(), [&] {
    const Inputs<T> in("sample_bev", bev, grid, border, align_corners);
    const SampleBevArgs<T>& a = in.args;
    Tensor out = torch::stable::new_empty(bev, {in.batch, a.num_samples, a.channels});
    T* data = out.mutable_data_ptr<T>();
    parallel(in.num_samples(), sample_grain(a.channels),
             [&](int64_t begin, int64_t end) { kernels<T>().forward(a, data, begin, end); });
    return out;
  });
}

std::tuple<Tensor, Tensor> sample_bev_backward(const Tensor& grad, const Tensor& bev, const Tensor& grid, bool border,
                                               bool align_corners, bool need_bev, bool need_grid) {
  return PRED_DISPATCH_FLOAT("sample_bev_backward", bev.scalar_type(), [&] {
    const char* op = "sample_bev_backward";
    Inputs<T> in(op, bev, grid, border, align_corners);
    in.set_grad(op, grad);
    const SampleBevArgs<T>& a = in.args;
    Tensor grad_bev = need_bev ? scatter(in, false) : no_tensor(bev);
    Tensor grad_grid = no_tensor(bev);
    if (need_grid) {
      grad_grid = torch::stable::new_empty(grid, {in.batch, a.num_samples, 2});
      T* data = grad_grid.mutable_data_ptr<T>();
      parallel(in.num_samples(), sample_grain(a.channels),
               [&](int64_t begin, int64_t end) { kernels<T>().backward_grid(a, data, begin, end); });
    }
    return std::make_tuple(grad_bev, grad_grid);
  });
}

std::tuple<Tensor, Tensor, Tensor> sample_bev_double_backward(std::optional<Tensor> grad_grad_bev,
                                                              std::optional<Tensor> grad_grad_grid, const Tensor& grad,
                                                              const Tensor& bev, const Tensor& grid, bool border,
                                                              bool align_corners, bool need_grad, bool need_bev,
                                                              bool need_grid) {
  return PRED_DISPATCH_FLOAT("sample_bev_double_backward", bev.scalar_type(), [&] {
    const char* op = "sample_bev_double_backward";
    Inputs<T> in(op, bev, grid, border, align_corners);
    in.set_grad(op, grad);
    in.set_cotangents(op, grad_grad_bev, grad_grad_grid);
    const SampleBevArgs<T>& a = in.args;
    Tensor out_grad = no_tensor(bev), out_bev = no_tensor(bev), out_grid = no_tensor(bev);
    if (need_grad) out_grad = torch::stable::new_empty(bev, {in.batch, a.num_samples, a.channels});
    if (need_grid) out_grid = torch::stable::new_empty(bev, {in.batch, a.num_samples, 2});
    T* grad_data = need_grad ? out_grad.mutable_data_ptr<T>() : nullptr;
    T* grid_data = need_grid ? out_grid.mutable_data_ptr<T>() : nullptr;
    if (need_grad || need_grid) {
      parallel(in.num_samples(), sample_grain(a.channels),
               [&](int64_t begin, int64_t end) { kernels<T>().double_backward(a, grad_data, grid_data, begin, end); });
    }
    if (need_bev && a.grad_grad_grid) {
      out_bev = scatter(in, true);
    } else if (need_bev) {  // the map enters only through the grid's gradient
      out_bev = new_channels_last(bev);
      torch::stable::zero_(out_bev);
    }
    return std::make_tuple(out_grad, out_bev, out_grid);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) {
  m.impl("sample_bev", TORCH_BOX(&pred::sample_bev));
  m.impl("sample_bev_backward", TORCH_BOX(&pred::sample_bev_backward));
  m.impl("sample_bev_double_backward", TORCH_BOX(&pred::sample_bev_double_backward));
}
