// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The bindings of sample_bev and sample_volume. `Op` names one of them:
//   static constexpr int kAxes;                     // 2 or 3
//   static constexpr const char *kName, *kMap;      // the op and its first argument
//   template <typename S> static const SampleGridKernels<S, kAxes>& table();
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "common/allocate.h"
#include "common/check.h"
#include "common/parallel.h"
#include "common/radix_sort.h"
#include "ops/sample_grid.h"

namespace pred {
namespace {

using torch::headeronly::MemoryFormat;

template <class Op>
struct SampleGrid {
  static constexpr int kAxes = Op::kAxes;
  static constexpr MemoryFormat kChannelsLast = kAxes == 2 ? MemoryFormat::ChannelsLast : MemoryFormat::ChannelsLast3d;

  // Contiguous copies of the arguments and the pointers into them.
  template <typename S>
  struct Inputs {
    using T = Compute<S>;
    const std::string op;
    Tensor map, grid, grad, grad_slopes, grad_grad_map, grad_grad_grid;
    std::unique_ptr<S[]> zeros;
    SampleGridArgs<S, kAxes> args{};
    int64_t batch;

    Inputs(const char* suffix, const Tensor& map_in, const Tensor& grid_in, bool border, bool align_corners)
        : op(concat(Op::kName, suffix)) {
      check_tensor(op.c_str(), Op::kMap, map_in, 2 + kAxes, map_in.scalar_type());
      batch = map_in.size(0);
      check_geometry("grid", grid_in);
      PRED_CHECK(grid_in.size(0) == batch && grid_in.size(2) == kAxes, op, ": grid must have shape [", batch, ", N, ",
                 kAxes, "], got ", shape_text(grid_in));
      map = torch::stable::contiguous(map_in, kChannelsLast);
      grid = torch::stable::contiguous(grid_in);
      args.map = storage<S>(map);
      args.grid = grid.const_data_ptr<T>();
      args.channels = map.size(1);
      args.num_samples = grid.size(1);
      args.stride[0] = args.channels;
      for (int axis = 0; axis < kAxes; ++axis) {
        args.size[axis] = map.size(1 + kAxes - axis);
        PRED_CHECK(args.size[axis] >= 1, op, ": ", Op::kMap, " must have at least one cell along each axis, got ",
                   shape_text(map_in));
        args.stride[axis + 1] = args.stride[axis] * args.size[axis];
      }
      args.border = border;
      args.align_corners = align_corners;
      zeros = allocate_zeros<S>(num_samples() > 0 && !kLaunch ? args.channels : 0);
      args.zeros = zeros.get();
    }

    // The gradients of the op's outputs. One alone is enough with grad_slopes.
    void set_grads(const std::optional<Tensor>& of_values, const std::optional<Tensor>& of_slopes) {
      if (of_values) {
        check_tensor(op.c_str(), "grad", *of_values, 3, map.scalar_type());
        check_sizes(op.c_str(), "grad", *of_values, {batch, args.num_samples, args.channels});
        grad = torch::stable::contiguous(*of_values);
        args.grad = storage<S>(grad);
      }
      if (of_slopes) {
        check_tensor(op.c_str(), "grad_grads", *of_slopes, 4, map.scalar_type());
        check_sizes(op.c_str(), "grad_grads", *of_slopes, {batch, args.num_samples, kAxes, args.channels});
        grad_slopes = torch::stable::contiguous(*of_slopes);
        args.grad_slopes = storage<S>(grad_slopes);
      }
    }

    void set_cotangents(const std::optional<Tensor>& of_map, const std::optional<Tensor>& of_grid) {
      if (of_map) {
        const std::string name = concat("grad_grad_", Op::kMap);
        check_tensor(op.c_str(), name.c_str(), *of_map, 2 + kAxes, map.scalar_type());
        check_sizes(op.c_str(), name.c_str(), *of_map, sizes(map));
        grad_grad_map = torch::stable::contiguous(*of_map, kChannelsLast);
        args.grad_grad_map = storage<S>(grad_grad_map);
      }
      if (of_grid) {
        check_geometry("grad_grad_grid", *of_grid);
        check_sizes(op.c_str(), "grad_grad_grid", *of_grid, sizes(grid));
        grad_grad_grid = torch::stable::contiguous(*of_grid);
        args.grad_grad_grid = grad_grad_grid.const_data_ptr<T>();
      }
    }

    int64_t num_samples() const { return batch * args.num_samples; }

    // Samples per task, such that a task moves some 64 kB.
    int64_t grain() const { return 1 + 16384 / (args.channels + 16); }

   private:
    void check_geometry(const char* name, const Tensor& tensor) const {
      check_tensor(op.c_str(), name, tensor, 3, tensor.scalar_type());
      constexpr ScalarType dtype = std::is_same_v<T, double> ? ScalarType::Double : ScalarType::Float;
      PRED_CHECK(tensor.scalar_type() == dtype, op, ": ", name, " must be ",
                 dtype == ScalarType::Double ? "float64 with a float64 " : "float32 with a float32 or half ", Op::kMap);
    }
  };

  static Tensor forward(const Tensor& map, const Tensor& grid, bool border, bool align_corners) {
    return PRED_DISPATCH_STORAGE(Op::kName, map.scalar_type(), [&] {
      const Inputs<S> in("", map, grid, border, align_corners);
      Tensor out = torch::stable::new_empty(map, {in.batch, in.args.num_samples, in.args.channels});
      S* data = mutable_storage<S>(out);
      const auto& k = Op::template table<S>();
      parallel(in.num_samples(), in.grain(),
               [&](int64_t begin, int64_t end) { k.forward(in.args, data, nullptr, begin, end); });
      return out;
    });
  }

  static std::tuple<Tensor, Tensor> with_grad(const Tensor& map, const Tensor& grid, bool border, bool align_corners) {
    return PRED_DISPATCH_STORAGE(concat(Op::kName, "_with_grad"), map.scalar_type(), [&] {
      const Inputs<S> in("_with_grad", map, grid, border, align_corners);
      const int64_t samples = in.args.num_samples, channels = in.args.channels;
      Tensor out = torch::stable::new_empty(map, {in.batch, samples, channels});
      Tensor slopes = torch::stable::new_empty(map, {in.batch, samples, kAxes, channels});
      S* data = mutable_storage<S>(out);
      S* slope_data = mutable_storage<S>(slopes);
      const auto& k = Op::template table<S>();
      parallel(in.num_samples(), in.grain(),
               [&](int64_t begin, int64_t end) { k.forward(in.args, data, slope_data, begin, end); });
      return std::make_tuple(out, slopes);
    });
  }

  static std::tuple<Tensor, Tensor> backward(const Tensor& grad, const Tensor& map, const Tensor& grid, bool border,
                                             bool align_corners, bool need_map, bool need_grid, bool deterministic) {
    return first_order("_backward", grad, std::nullopt, map, grid, border, align_corners, need_map, need_grid,
                       deterministic);
  }

  static std::tuple<Tensor, Tensor> with_grad_backward(std::optional<Tensor> grad_values,
                                                       std::optional<Tensor> grad_grads, const Tensor& map,
                                                       const Tensor& grid, bool border, bool align_corners,
                                                       bool need_map, bool need_grid, bool deterministic) {
    PRED_CHECK(grad_values || grad_grads, Op::kName, "_with_grad_backward: one gradient must be given");
    return first_order("_with_grad_backward", grad_values, grad_grads, map, grid, border, align_corners, need_map,
                       need_grid, deterministic);
  }

  static std::tuple<Tensor, Tensor, Tensor> double_backward(std::optional<Tensor> grad_grad_map,
                                                            std::optional<Tensor> grad_grad_grid, const Tensor& grad,
                                                            const Tensor& map, const Tensor& grid, bool border,
                                                            bool align_corners, bool need_grad, bool need_map,
                                                            bool need_grid, bool deterministic) {
    return PRED_DISPATCH_STORAGE(concat(Op::kName, "_double_backward"), map.scalar_type(), [&] {
      Inputs<S> in("_double_backward", map, grid, border, align_corners);
      in.set_grads(grad, std::nullopt);
      in.set_cotangents(grad_grad_map, grad_grad_grid);
      const auto& a = in.args;
      Tensor out_grad = no_tensor(map), out_map = no_tensor(map), out_grid = no_tensor(grid);
      if (need_grad) out_grad = torch::stable::new_empty(map, {in.batch, a.num_samples, a.channels});
      if (need_grid) out_grid = torch::stable::new_empty(grid, {in.batch, a.num_samples, kAxes});
      S* grad_data = need_grad ? mutable_storage<S>(out_grad) : nullptr;
      T* grid_data = need_grid ? mutable_storage<T>(out_grid) : nullptr;
      if (need_grad || need_grid) {
        const auto& k = Op::template table<S>();
        parallel(in.num_samples(), in.grain(),
                 [&](int64_t begin, int64_t end) { k.double_backward(a, grad_data, grid_data, begin, end); });
      }
      if (need_map && a.grad_grad_grid) {
        out_map = scatter<S>(in.op.c_str(), in.map, in.args, true, deterministic, nullptr);
      } else if (need_map) {  // the map enters only through the grid's gradient
        out_map = new_channels_last(in.map);
        torch::stable::zero_(out_map);
      }
      return std::make_tuple(out_grad, out_map, out_grid);
    });
  }

  // Adds every sample's gradient to its cells. grad_grid, where not null, gets the samples' grid gradients on the way;
  // not from kernels that are launched.
  template <typename S>
  static Tensor scatter(const char* op, const Tensor& map, const SampleGridArgs<S, kAxes>& a, bool along_direction,
                        bool deterministic, Compute<S>* grad_grid) {
    constexpr int64_t kBandRows = 8;
    const int64_t batch = map.size(0), num_samples = batch * a.num_samples;
    const auto& k = Op::template table<S>();
    if (map.numel() == 0) return new_channels_last(map);  // whatever its other sizes are
    if (kLaunch && !deterministic && k.scatter_atomically) {
      Tensor grad_map = new_channels_last(map);
      torch::stable::zero_(grad_map);
      k.scatter_atomically(a, batch, along_direction, mutable_storage<S>(grad_map));
      return grad_map;
    }
    PRED_CHECK(num_samples < int64_t(1) << 31, op,
               ": samples must be fewer than 2^31 where the gradient of the map is wanted, got ", num_samples);
    SampleGridOrder order{nullptr, bits_for(num_samples), {}};
    int cell_bits = 0;
    for (int axis = 0; axis < kAxes; ++axis) {
      order.size_bits[axis] = bits_for(a.size[axis] + 1);
      cell_bits += order.size_bits[axis];
    }
    const int key_bits = bits_for(batch) + cell_bits;
    PRED_CHECK(key_bits + order.number_bits < 64, op,
               ": cells times samples of the map, both rounded up to powers of 2, must be fewer than 2^64, got 2^",
               key_bits + order.number_bits);
    Tensor grad_map = new_channels_last(map);
    S* out = mutable_storage<S>(grad_map);
    if constexpr (kLaunch) {
      const Tensor workspace = torch::stable::new_empty(map, {k.scatter_bytes(a, batch)}, ScalarType::Byte);
      k.scatter(a, batch, along_direction, out, mutable_storage<char>(workspace));
      return grad_map;
    }
    const auto sorted = sort_rows<uint64_t>(
        num_samples, order.number_bits, key_bits,
        [&](uint64_t* items, int64_t begin, int64_t end) { return k.pack(a, order, items, begin, end); });
    order.items = sorted.items.get();

    // First item whose lower corner lies in row `low` (from -1 on) of a map, or behind it.
    const auto find = [&](int64_t map, int64_t low) {
      const uint64_t key = (uint64_t(map) << order.size_bits[1]) + uint64_t(low + 1);  // may carry: the next map
      const uint64_t item = key << (cell_bits - order.size_bits[1]) << order.number_bits;
      return std::lower_bound(order.items, order.items + sorted.count, item) - order.items;
    };
    const int64_t height = a.size[1], num_bands = (height + kBandRows - 1) / kBandRows;
    const int64_t depth = kAxes == 3 ? a.size[kAxes - 1] : 1;
    parallel(batch * num_bands, 1, [&](int64_t begin, int64_t end) {
      std::unique_ptr<Compute<S>[]> sums;
      if (!std::is_same_v<S, Compute<S>>) sums = allocate_array<Compute<S>>(depth * kBandRows * a.stride[1]);
      for (int64_t task = begin; task < end; ++task) {
        SampleGridBand<S> band{task / num_bands, task % num_bands * kBandRows, 0, 0, 0, sums.get()};
        band.end = std::min(band.begin + kBandRows, height);
        band.first_item = find(band.map, band.begin - 1);
        band.last_item = find(band.map, band.end);
        k.scatter_band(a, order, band, along_direction, out, grad_grid);
      }
    });
    return grad_map;
  }

  // A [B, C, (D,) H, W] tensor whose memory is [B, (D,) H, W, C].
  static Tensor new_channels_last(const Tensor& like) {
    std::vector<int64_t> memory_sizes = sizes(like);
    std::rotate(memory_sizes.begin() + 1, memory_sizes.begin() + 2, memory_sizes.end());
    Tensor tensor = torch::stable::new_empty(like, memory_sizes);
    for (int64_t dim = kAxes; dim > 0; --dim) tensor = torch::stable::transpose(tensor, dim, dim + 1);
    return tensor;
  }

 private:
  static Tensor no_tensor(const Tensor& like) { return torch::stable::new_empty(like, {0}); }

  static std::tuple<Tensor, Tensor> first_order(const char* suffix, const std::optional<Tensor>& grad,
                                                const std::optional<Tensor>& grad_slopes, const Tensor& map,
                                                const Tensor& grid, bool border, bool align_corners, bool need_map,
                                                bool need_grid, bool deterministic) {
    return PRED_DISPATCH_STORAGE(concat(Op::kName, suffix), map.scalar_type(), [&] {
      Inputs<S> in(suffix, map, grid, border, align_corners);
      in.set_grads(grad, grad_slopes);
      Tensor grad_map = no_tensor(map), grad_grid = no_tensor(grid);
      T* data = nullptr;
      if (need_grid) {
        grad_grid = torch::stable::new_empty(grid, {in.batch, in.args.num_samples, kAxes});
        data = mutable_storage<T>(grad_grid);
      }
      if (need_map) {
        if (need_grid && !kLaunch) torch::stable::zero_(grad_grid);  // samples that touch nothing are not visited
        grad_map = scatter<S>(in.op.c_str(), in.map, in.args, false, deterministic, data);
      }
      if (need_grid && (kLaunch || !need_map)) {
        const auto& k = Op::template table<S>();
        parallel(in.num_samples(), in.grain(),
                 [&](int64_t begin, int64_t end) { k.backward_grid(in.args, data, begin, end); });
      }
      return std::make_tuple(grad_map, grad_grid);
    });
  }
};

}  // namespace
}  // namespace pred
