// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_bev.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <tuple>

#include "common/check.h"
#include "common/parallel.h"
#include "common/radix_sort.h"

namespace pred {
namespace {

using torch::headeronly::MemoryFormat;

PRED_KERNELS_BY_TYPE(SampleBevKernels, sample_bev)

// Samples per task, such that a task moves some 64 kB.
int64_t sample_grain(int64_t channels) { return 1 + 16384 / (channels + 16); }

// Contiguous copies of the arguments and the pointers into them.
template <typename T>
struct Inputs {
  Tensor bev, grid, grad, grad_grad_bev, grad_grad_grid;
  SampleBevArgs<T> args;
  int64_t batch;

  Inputs(const char* op, const Tensor& bev_in, const Tensor& grid_in, bool border, bool align_corners) {
    check_cpu_tensor(op, "bev", bev_in, 4, bev_in.scalar_type());
    batch = bev_in.size(0);
    check_cpu_tensor(op, "grid", grid_in, 3, bev_in.scalar_type());
    PRED_CHECK(grid_in.size(0) == batch && grid_in.size(2) == 2, op, ": grid must have shape [", batch, ", N, 2], got ",
               shape_text(grid_in));
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

// Adds every sample's gradient to its cells; grad_grid, where not null, gets the samples' grid gradients on the way.
template <typename T>
Tensor scatter(const Inputs<T>& in, bool along_direction, T* grad_grid) {
  constexpr int64_t kBandRows = 8;
  const SampleBevArgs<T>& a = in.args;
  const auto& k = kernels<T>();
  SampleBevOrder order{nullptr, bits_for(in.num_samples()), bits_for(a.width + 1), bits_for(a.height + 1)};
  const int key_bits = bits_for(in.batch) + order.row_bits + order.column_bits;
  PRED_CHECK(key_bits + order.number_bits < 64, "sample_bev: the maps have too many cells and samples to number");
  const auto sorted = sort_rows<uint64_t>(
      in.num_samples(), order.number_bits, key_bits,
      [&](uint64_t* items, int64_t begin, int64_t end) { return k.pack(a, order, items, begin, end); });
  order.items = sorted.items.get();

  // First item whose lower corner lies in row `low` (from -1 on) of a map, or behind it.
  const auto find = [&](int64_t map, int64_t low) {
    const uint64_t key = (uint64_t(map) << order.row_bits) + uint64_t(low + 1);  // may carry: the next map
    const uint64_t item = key << order.column_bits << order.number_bits;
    return std::lower_bound(order.items, order.items + sorted.count, item) - order.items;
  };
  const int64_t num_bands = (a.height + kBandRows - 1) / kBandRows, row_size = a.width * a.channels;
  Tensor grad_bev = new_channels_last(in.bev);
  T* out = const_cast<T*>(grad_bev.const_data_ptr<T>());
  const std::unique_ptr<T[]> rows_before(new T[in.batch * num_bands * row_size]);
  parallel(in.batch * num_bands, 1, [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      SampleBevBand<T> band{
          task / num_bands, task % num_bands * kBandRows, 0, 0, 0, rows_before.get() + task * row_size};
      band.end = std::min(band.begin + kBandRows, a.height);
      band.first_item = find(band.map, band.begin - 1);
      // The last row of a map is also the lower row of samples that hang over its edge.
      band.last_item = find(band.map, band.end == a.height ? a.height : band.end - 1);
      k.scatter_band(a, order, band, along_direction, out, grad_grid);
    }
  });
  parallel(in.batch * num_bands, 1, [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      if (task % num_bands == 0) continue;
      const T* from = rows_before.get() + task * row_size;
      T* to = out + (task / num_bands * a.height + task % num_bands * kBandRows - 1) * row_size;
      for (int64_t i = 0; i < row_size; ++i) to[i] += from[i];
    }
  });
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
    Tensor grad_bev = no_tensor(bev), grad_grid = no_tensor(bev);
    T* data = nullptr;
    if (need_grid) {
      grad_grid = torch::stable::new_empty(grid, {in.batch, a.num_samples, 2});
      data = grad_grid.mutable_data_ptr<T>();
    }
    if (need_bev) {
      if (need_grid) torch::stable::zero_(grad_grid);  // samples that touch nothing are not visited
      grad_bev = scatter(in, false, data);
    } else if (need_grid) {
      const auto& k = kernels<T>();
      parallel(in.num_samples(), sample_grain(a.channels),
               [&](int64_t begin, int64_t end) { k.backward_grid(a, data, begin, end); });
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
      const auto& k = kernels<T>();
      parallel(in.num_samples(), sample_grain(a.channels),
               [&](int64_t begin, int64_t end) { k.double_backward(a, grad_data, grid_data, begin, end); });
    }
    if (need_bev && a.grad_grad_grid) {
      out_bev = scatter<T>(in, true, nullptr);
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
