// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/decode_field.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <limits>
#include <memory>
#include <optional>
#include <tuple>
#include <vector>

#include "common/allocate.h"
#include "common/blocks.h"
#include "common/check.h"
#include "ops/sample_bev.h"

namespace pred {
namespace {

PRED_KERNELS_BY_FACTOR(FieldKernels, decode_field)

template <typename S>
struct Field {
  using T = Compute<S>;
  const char* op;
  Tensor map, points, parameters;
  std::vector<int64_t> widths;  // encoding, hidden ..., outputs
  std::unique_ptr<S[]> zeros;
  std::unique_ptr<char[]> packed;
  std::vector<std::vector<T>> padded;  // biases and the row of the distance
  Tensor grid;                         // [B N, 2], made where wanted
  int64_t batch, num_samples, stride;
  FieldArgs<S> args{};

  Field(const char* name, const Tensor& map_in, const Tensor& points_in, const Tensor& parameters_in,
        const std::vector<int64_t>& widths_in, const std::vector<double>& point_range, int64_t octaves, double beta,
        double sdf_scale, bool tf32)
      : op(name), widths(widths_in) {
    constexpr ScalarType dtype = std::is_same_v<T, double> ? ScalarType::Double : ScalarType::Float;
    check_tensor(op, "projected", map_in, 4, map_in.scalar_type());
    check_tensor(op, "points", points_in, 3, dtype);
    check_tensor(op, "parameters", parameters_in, 1, dtype);
    batch = map_in.size(0);
    PRED_CHECK(points_in.size(0) == batch && points_in.size(2) == 3, op, ": points must have shape [", batch,
               ", N, 3], got ", shape_text(points_in));
    num_samples = points_in.numel() / 3;
    const int64_t layers = int64_t(widths.size()) - 1, width = map_in.size(1);
    PRED_CHECK(width >= 1 && width <= 4096, op, ": projected must have 1 to 4096 channels, got ", width);
    PRED_CHECK(layers >= 2 && layers <= kMaxHidden + 1, op, ": widths must name 2 to ", kMaxHidden + 1, " layers, got ",
               layers);
    PRED_CHECK(octaves >= 0 && octaves <= 16 && widths[0] == 3 + 6 * octaves, op,
               ": widths must start with 3 + 6 octaves, octaves in [0, 16], got ", widths[0]);
    int64_t expected = 0;
    for (int64_t l = 0; l < layers; ++l) {
      const bool fits = l + 1 < layers ? widths[l + 1] == width : widths[l + 1] >= 1 && widths[l + 1] < 1 << 20;
      PRED_CHECK(fits, op, ": widths must be those of projected in hidden layers, and positive, got ", widths[l + 1]);
      expected += widths[l + 1] * (widths[l] + 1);
    }
    PRED_CHECK(parameters_in.size(0) == expected, op, ": parameters must have ", expected, " elements, got ",
               parameters_in.size(0));
    PRED_CHECK(point_range.size() == 6, op, ": point_range must hold 6 numbers, got ", point_range.size());

    map = torch::stable::contiguous(map_in, torch::headeronly::MemoryFormat::ChannelsLast);
    points = torch::stable::contiguous(points_in);
    parameters = torch::stable::contiguous(parameters_in);
    stride = field_stride(width);
    read_geometry(point_range);
    args.octaves = octaves;
    args.beta = positive("beta", beta);
    args.sdf_scale = positive("sdf_scale", sdf_scale);
    args.tf32 = tf32;
    args.num_hidden = layers - 1;
    args.num_outputs = widths[layers];
    if constexpr (!kLaunch) pack_parameters();
  }

  int64_t columns(int64_t layer) const { return decode_field_kernels<S>().columns(widths[layer]); }

  // Of kernels that are launched.
  Tensor workspace(bool backward) const {
    const int64_t bytes = decode_field_kernels<S>().workspace_bytes(args, num_samples, backward);
    return torch::stable::new_empty(map, {bytes}, ScalarType::Byte);
  }

  // Nothing kept has no rows either: torch cannot copy some shapes of no elements.
  std::vector<int64_t> saved_shape(int64_t layers) const {
    return layers > 0 ? std::vector<int64_t>{layers, num_samples, stride} : std::vector<int64_t>{0, 0, 0};
  }

  // Positions in the map, as sample_bev takes them.
  void make_grid() {
    grid = torch::stable::new_empty(points, {2 * num_samples});
    T* to = grid.template mutable_data_ptr<T>();
    if constexpr (kLaunch) {
      decode_field_kernels<S>().positions(args, to, num_samples);
    } else {
      parallel(num_samples, 16384, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          for (int axis = 0; axis < 2; ++axis) {
            to[2 * i + axis] = (args.points[3 * i + axis] - args.centre[axis]) / args.half_extent[axis];
          }
        }
      });
    }
    args.map.grid = to;
  }

 private:
  // Numbers that are divided by: normal ones of T.
  T positive(const char* name, double value) const {
    using Limits = std::numeric_limits<T>;
    PRED_CHECK(value >= Limits::min() && value <= Limits::max(), op, ": ", name, " must lie in [", Limits::min(), ", ",
               Limits::max(), "], got ", value);
    return T(value);
  }

  void read_geometry(const std::vector<double>& point_range) {
    args.points = points.const_data_ptr<T>();
    for (int axis = 0; axis < 3; ++axis) {
      args.centre[axis] = T((point_range[axis] + point_range[axis + 3]) / 2);
      args.half_extent[axis] =
          positive("half of the extent of point_range", (point_range[axis + 3] - point_range[axis]) / 2);
    }
    auto& m = args.map;
    m.map = storage<S>(map);
    m.channels = m.stride[0] = map.size(1);
    m.num_samples = points.size(1);
    for (int axis = 0; axis < 2; ++axis) {
      m.size[axis] = map.size(3 - axis);
      m.stride[axis + 1] = m.stride[axis] * m.size[axis];
      PRED_CHECK(m.size[axis] >= 1, op, ": projected must have at least one cell along each axis, got ",
                 shape_text(map));
    }
    if (kLaunch) return;
    zeros = allocate_zeros<S>(m.channels);
    m.zeros = zeros.get();
  }

  // [W_1, W_1, W_1 - rounded W_1], transposed.
  std::vector<T> split_first(const T* weight) const {
    const int64_t in = widths[0], out = widths[1];
    std::vector<T> parts(kFieldParts<S> * in * out);
    for (int64_t i = 0; i < in; ++i) {
      for (int64_t o = 0; o < out; ++o) {
        const T whole = weight[o * in + i];
        S rounded;
        narrow_to(rounded, whole);
        parts[i * out + o] = parts[(in + i) * out + o] = whole;
        parts[(2 * in + i) * out + o] = whole - widen(rounded);
      }
    }
    return parts;
  }

  void pack_parameters() {
    const FieldKernels<S>& k = decode_field_kernels<S>();
    const int64_t layers = args.num_hidden + 1, parts = kFieldParts<S> * widths[0];
    int64_t size = kFieldParts<S> > 1 ? k.packed_size(parts, widths[1]) : 0;
    for (int64_t l = 0; l < layers; ++l) {
      size += k.packed_size(widths[l], widths[l + 1]) + k.packed_size(widths[l + 1], widths[l]);
    }
    packed = allocate_array<char>(size * int64_t(sizeof(S)) + (2 * layers + 2) * Arena::kAlignment);
    Arena arena(packed.get());
    const T* data = parameters.const_data_ptr<T>();
    S *up[kMaxHidden + 1], *down[kMaxHidden + 1];
    int64_t from[kMaxHidden + 1];
    for (int64_t l = 0, at = 0; l < layers; ++l) {
      args.up[l] = up[l] = arena.template take<S>(k.packed_size(widths[l], widths[l + 1]));
      args.down[l] = down[l] = arena.template take<S>(k.packed_size(widths[l + 1], widths[l]));
      from[l] = at;
      at += widths[l + 1] * (widths[l] + 1);
    }
    args.first = up[0];
    if constexpr (kFieldParts<S> > 1) {
      S* first = arena.template take<S>(k.packed_size(parts, widths[1]));
      k.pack(split_first(data).data(), widths[1], 1, parts, widths[1], first);
      args.first = first;
    }
    parallel(2 * layers, 1, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        const int64_t l = i / 2, in = widths[l], out = widths[l + 1];
        if (i % 2 == 0)
          k.pack(data + from[l], 1, in, in, out, up[l]);
        else
          k.pack(data + from[l], in, 1, out, in, down[l]);
      }
    });
    padded.resize(layers + 1);
    for (int64_t l = 0; l < layers; ++l) {
      const T* bias = data + from[l] + widths[l + 1] * widths[l];
      padded[l].assign(std::max(stride, columns(l + 1)), T(0));
      std::copy(bias, bias + widths[l + 1], padded[l].begin());
      args.bias[l] = padded[l].data();
    }
    const T* row = data + from[layers - 1];
    padded[layers].assign(stride, T(0));
    for (int64_t c = 0; c < widths[1]; ++c) padded[layers][c] = row[c] * args.sdf_scale;
    args.sdf_row = padded[layers].data();
  }
};

using Outputs = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

template <typename S>
void forward(const Field<S>& in, const FieldSaved<S>& saved, const FieldOutputs<S>& out) {
  const FieldKernels<S>& k = decode_field_kernels<S>();
  if constexpr (kLaunch) {
    const Tensor workspace = in.workspace(false);
    k.forward(in.args, in.parameters.template const_data_ptr<Compute<S>>(), saved, out,
              mutable_storage<char>(workspace), in.num_samples);
  } else {
    const Blocks tasks = product_tasks(in.num_samples);
    parallel(tasks.count(), 1, [&](int64_t first, int64_t last) {
      const auto scratch = allocate_array<char>(k.scratch_bytes(in.args, false));
      k.forward(in.args, saved, out, scratch.get(), tasks.begin(first), tasks.end(last - 1), in.num_samples);
    });
  }
}

Outputs decode_field(const Tensor& projected, const Tensor& points, const Tensor& parameters,
                     std::vector<int64_t> widths, std::vector<double> point_range, int64_t octaves, double beta,
                     double sdf_scale, bool with_gradient, bool keep, bool tf32) {
  return PRED_DISPATCH_FACTOR("decode_field", projected.scalar_type(), [&] {
    const Field<S> in("decode_field", projected, points, parameters, widths, point_range, octaves, beta, sdf_scale,
                      tf32);
    const int64_t frames = in.batch, count = points.size(1), classes = in.args.num_outputs - 1;
    Tensor sdf = torch::stable::new_empty(in.points, {frames, count});
    Tensor semantics = torch::stable::new_empty(in.points, {frames, count, classes});
    Tensor gradient = torch::stable::new_empty(in.points, {frames, with_gradient ? count : 0, 3});
    const int64_t layers = in.args.num_hidden;
    const auto kept = [&](int64_t rows) {
      Tensor tensor = torch::stable::new_empty(in.map, in.saved_shape(keep ? rows : 0));
      if (!kLaunch) prefer_large_pages(tensor.mutable_data_ptr(), tensor.numel() * int64_t(sizeof(S)));
      return tensor;
    };
    Tensor activation = kept(layers), chain = kept(with_gradient ? layers - 1 : 0);
    const FieldSaved<S> saved{keep ? mutable_storage<S>(activation) : nullptr,
                              keep && with_gradient ? mutable_storage<S>(chain) : nullptr};
    forward<S>(in, saved,
               {sdf.mutable_data_ptr<T>(), semantics.mutable_data_ptr<T>(),
                with_gradient ? gradient.mutable_data_ptr<T>() : nullptr});
    return Outputs(sdf, semantics, gradient, activation, chain);
  });
}

// What becomes of the gradient of the map, [B N, width] and [B N, 2]; without elements where it is not wanted.
struct AlongMap {
  Tensor rows, slopes, directions;
};

// Gradients of the points and of the parameters; null where not wanted.
template <typename S, typename T = Compute<S>>
void backward(const Field<S>& in, const FieldSaved<S>& saved, const FieldCotangents<S>& grad, const AlongMap& along,
              T* grad_points, T* grad_parameters) {
  const FieldKernels<S>& k = decode_field_kernels<S>();
  const auto pointer = [](const Tensor& tensor, auto type) {
    return tensor.numel() > 0 ? mutable_storage<decltype(type)>(tensor) : nullptr;
  };
  FieldGradients<S> out{grad_parameters, pointer(along.rows, S()), pointer(along.slopes, S()),
                        pointer(along.directions, T()), grad_points};
  if constexpr (kLaunch) {
    const Tensor workspace = in.workspace(true);
    k.backward(in.args, in.parameters.template const_data_ptr<T>(), saved, grad, out, mutable_storage<char>(workspace),
               in.num_samples);
  } else {
    // Each block's sums: dW [outputs, columns] and db of one layer after the other.
    const int64_t layers = in.args.num_hidden + 1;
    int64_t block_sums = 0;
    for (int64_t l = 0; l < layers; ++l) block_sums += in.widths[l + 1] * (in.columns(l) + 1);
    const Blocks blocks = product_sums(in.num_samples, block_sums * int64_t(sizeof(T)));
    std::unique_ptr<T[]> sums;
    if (grad_parameters) sums = allocate_array<T>(blocks.count() * block_sums);
    parallel(blocks.count(), 1, [&](int64_t first, int64_t last) {
      const auto scratch = allocate_array<char>(k.scratch_bytes(in.args, true));
      for (int64_t block = first; block < last; ++block) {
        FieldGradients<S> block_out = out;
        block_out.parameters = sums ? sums.get() + block * block_sums : nullptr;
        if (sums) std::fill(block_out.parameters, block_out.parameters + block_sums, T(0));
        k.backward(in.args, saved, grad, block_out, scratch.get(), blocks.begin(block), blocks.end(block),
                   in.num_samples);
      }
    });
    const T* from = sums.get();
    for (int64_t l = 0; grad_parameters && l < layers; ++l) {
      const int64_t outputs = in.widths[l + 1], inputs = in.widths[l], columns = in.columns(l);
      add_blocks(from, blocks.count(), block_sums, outputs, columns, inputs, grad_parameters);
      from += outputs * columns;
      grad_parameters += outputs * inputs;
      add_blocks(from, blocks.count(), block_sums, 1, 0, outputs, grad_parameters);
      from += outputs;
      grad_parameters += outputs;
    }
  }
}

std::tuple<Tensor, Tensor, Tensor> decode_field_backward(
    std::optional<Tensor> grad_sdf, std::optional<Tensor> grad_semantics, std::optional<Tensor> grad_gradient,
    const Tensor& projected, const Tensor& points, const Tensor& parameters, const Tensor& activation,
    const Tensor& chain, std::vector<int64_t> widths, std::vector<double> point_range, int64_t octaves, double beta,
    double sdf_scale, bool need_projected, bool need_points, bool need_parameters, bool deterministic, bool tf32) {
  const char* op = "decode_field_backward";
  return PRED_DISPATCH_FACTOR(op, projected.scalar_type(), [&] {
    Field<S> in(op, projected, points, parameters, widths, point_range, octaves, beta, sdf_scale, tf32);
    const int64_t frames = in.batch, count = points.size(1), classes = in.args.num_outputs - 1;
    std::vector<Tensor> kept;
    const auto cotangent = [&](const char* name, const std::optional<Tensor>& tensor,
                               const std::vector<int64_t>& shape) -> const T* {
      if (!tensor) return nullptr;
      check_tensor(op, name, *tensor, int64_t(shape.size()), in.points.scalar_type());
      check_sizes(op, name, *tensor, shape);
      kept.push_back(torch::stable::contiguous(*tensor));
      return kept.back().template const_data_ptr<T>();
    };
    const FieldCotangents<S> grad{cotangent("grad_sdf", grad_sdf, {frames, count}),
                                  cotangent("grad_semantics", grad_semantics, {frames, count, classes}),
                                  cotangent("grad_gradient", grad_gradient, {frames, count, 3})};
    const auto saved_rows = [&](const char* name, const Tensor& tensor, int64_t layers) -> S* {
      check_tensor(op, name, tensor, 3, projected.scalar_type());
      if (tensor.size(0) == 0) return nullptr;
      check_sizes(op, name, tensor, in.saved_shape(layers));
      kept.push_back(torch::stable::contiguous(tensor));
      return mutable_storage<S>(kept.back());
    };
    const FieldSaved<S> saved{saved_rows("activation", activation, in.args.num_hidden),
                              saved_rows("chain", chain, in.args.num_hidden - 1)};
    PRED_CHECK(saved.activation || !saved.chain, op, ": activation must be given with chain, got none");

    const int64_t width = in.args.map.channels;
    const bool slopes = need_projected && grad.gradient;
    // What kernels that are launched kept of the chain is read as it is, where its rows have the map's width.
    const bool chain_serves = kLaunch && slopes && saved.chain && in.stride == width;
    const AlongMap along{torch::stable::new_empty(in.map, {need_projected ? in.num_samples : 0, width}),
                         torch::stable::new_empty(in.map, {slopes && !chain_serves ? in.num_samples : 0, width}),
                         torch::stable::new_empty(in.points, {slopes ? in.num_samples : 0, 2})};
    Tensor out_points = torch::stable::new_empty(in.points, {need_points ? frames : 0, count, 3});
    Tensor out_parameters = torch::stable::new_empty(in.parameters, {need_parameters ? parameters.size(0) : 0});
    backward<S>(in, saved, grad, along, need_points ? out_points.mutable_data_ptr<T>() : nullptr,
                need_parameters ? out_parameters.mutable_data_ptr<T>() : nullptr);
    Tensor out_map = torch::stable::new_empty(in.map, {0});
    if (need_projected) {
      in.make_grid();
      in.args.map.grad = storage<S>(along.rows);
      in.args.map.grad_along = chain_serves ? saved.chain : slopes ? storage<S>(along.slopes) : nullptr;
      in.args.map.grad_grad_grid = slopes ? storage<T>(along.directions) : nullptr;
      out_map = SampleBev::scatter<S>(op, in.map, in.args.map, false, deterministic, nullptr);
    }
    return std::make_tuple(out_map, out_points, out_parameters);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "decode_field", &pred::decode_field);
  PRED_IMPL(m, "decode_field_backward", &pred::decode_field_backward);
}
