// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// A tile of samples goes through all layers before the next one, so that its rows stay in cache; bias, Softplus and its
// derivatives are epilogues of the products. One iteration owns the samples of its range.
#include "common/allocate.h"
#include "common/tile.h"
#include "math/product.h"
#include "math/sine_cosine.h"
#include "math/softplus.h"
#include "ops/decode_field.h"
#include "ops/sample_grid_cpu.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct Tile {
  using T = Compute<S>;
  int64_t width, columns, stride, encoding_width, encoding_columns, encoding_stride, rate_stride, output_stride,
      few_stride, angles, layers;
  S *encoding, *encoding_rate, *gathered, *output;
  S *activation[kMaxHidden], *slope[kMaxHidden], *chain[kMaxHidden], *rate[kMaxHidden], *back[kMaxHidden];
  S* interleaved[2];
  T *few, *few_chain;  // products with few columns
  T *sine, *cosine, *direction;
  LinearStencil<T, 2>* stencil;
  SoftplusScale<T> beta;
  T beta_value;
  uintptr_t end;

  Tile(const FieldArgs<S>& a, bool backward, char* memory) {
    Arena arena(memory);
    width = a.map.channels;
    columns = panel_columns<T>(width);  // of hidden rows that products write
    stride = field_stride(width);
    angles = 3 * a.octaves;
    encoding_width = 3 + 2 * angles;
    encoding_columns = kFieldParts<S> * encoding_width;
    encoding_stride = panel_columns<T>(encoding_columns);
    rate_stride = panel_columns<T>(encoding_width);
    output_stride = panel_columns<T>(a.num_outputs);
    few_stride = rate_stride > output_stride ? rate_stride : output_stride;
    layers = a.num_hidden;
    beta = softplus_scale(a.beta);
    beta_value = a.beta;
    const int64_t rows = kRowTile * stride;
    encoding = arena.take<S>(kRowTile * encoding_stride);
    gathered = arena.take<S>(rows);
    few = arena.take<T>(kRowTile * few_stride);
    sine = arena.take<T>(kRowTile * angles);
    cosine = arena.take<T>(kRowTile * angles);
    stencil = arena.take<LinearStencil<T, 2>>(kRowTile);
    for (int64_t l = 0; l < layers; ++l) {
      activation[l] = arena.take<S>(rows);
      slope[l] = arena.take<S>(rows);
      chain[l] = arena.take<S>(rows);
    }
    if (backward) {
      for (int64_t l = 0; l < layers; ++l) {
        rate[l] = arena.take<S>(rows);
        back[l] = arena.take<S>(rows);
      }
      encoding_rate = arena.take<S>(kRowTile * rate_stride);
      output = arena.take<S>(kRowTile * output_stride);
      few_chain = arena.take<T>(kRowTile * few_stride);
      direction = arena.take<T>(kRowTile * 3);
      const int64_t wide = few_stride > stride ? few_stride : stride;
      const int64_t widest = encoding_stride > wide ? encoding_stride : wide;
      for (S*& buffer : interleaved) buffer = arena.take<S>(kPair<S> > 1 ? kRowTile * widest : 0);
    }
    end = arena.at;
  }

  // Rows of the tile in what the forward pass kept, in place of scratch.
  void use_saved(const FieldSaved<S>& saved, int64_t num_samples, int64_t begin, bool with_chain) {
    for (int64_t l = 0; l < layers; ++l) {
      activation[l] = saved.activation + (l * num_samples + begin) * stride;
      if (with_chain && l + 1 < layers) chain[l] = saved.chain + (l * num_samples + begin) * stride;
    }
  }
};

template <typename S>
static int64_t scratch_bytes(const FieldArgs<S>& a, bool backward) {
  return int64_t(Tile<S>(a, backward, nullptr).end) + Arena::kAlignment;
}

// --- Encoding and map ----------------------------------------------------------------------------
// Part of an encoding's row, in all of its parts.
template <typename S, typename T = Compute<S>>
static inline void put(S* __restrict row, int64_t encoding_width, int64_t count, const T* __restrict values) {
  for (int64_t i = 0; i < count; ++i) narrow_to(row[i], values[i]);
  if constexpr (kFieldParts<S> == 3) {
    for (int64_t i = 0; i < count; ++i) narrow_to(row[encoding_width + i], values[i] - widen(row[i]));
    for (int64_t i = 0; i < count; ++i) row[2 * encoding_width + i] = row[i];
  }
}

template <typename S, typename T = Compute<S>>
static void encode(const FieldArgs<S>& a, const Tile<S>& tile, int64_t begin, int64_t count) {
  const int64_t octaves = a.octaves, angles = tile.angles;
  for (int64_t r = 0; r < count; ++r) {
    T position[3];
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] = (a.points[(begin + r) * 3 + axis] - a.centre[axis]) / a.half_extent[axis];
    }
    tile.stencil[r] = linear_stencil<2>(position, a.map.size, a.map.border, a.map.align_corners);
    T* __restrict sine = tile.sine + r * angles, * __restrict cosine = tile.cosine + r * angles;
    T frequency = 1;
    for (int64_t k = 0; k < octaves; ++k, frequency *= T(2)) {
      for (int axis = 0; axis < 3; ++axis) sine[3 * k + axis] = position[axis] * frequency;
    }
    for (int64_t i = 0; i < angles; ++i) {
      const SineCosine both = sine_cosine(double(sine[i]));
      sine[i] = T(both.sine);
      cosine[i] = T(both.cosine);
    }
    S* __restrict row = tile.encoding + r * tile.encoding_stride;
    put(row, tile.encoding_width, 3, position);
    put(row + 3, tile.encoding_width, angles, sine);
    put(row + 3 + angles, tile.encoding_width, angles, cosine);
    for (int64_t i = tile.encoding_columns; i < tile.encoding_stride; ++i) narrow_to(row[i], T(0));
  }
}

// Rows J v: the encoding's derivative along `direction`.
template <typename S, typename T = Compute<S>>
static void encode_rate(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count) {
  for (int64_t r = 0; r < count; ++r) {
    const T *v = tile.direction + 3 * r, *sine = tile.sine + r * tile.angles, *cosine = tile.cosine + r * tile.angles;
    S* row = tile.encoding_rate + r * tile.rate_stride;
    for (int axis = 0; axis < 3; ++axis) narrow_to(row[axis], v[axis]);
    T frequency = 1;
    for (int64_t k = 0, i = 0; k < a.octaves; ++k, frequency *= T(2)) {
      for (int axis = 0; axis < 3; ++axis, ++i) {
        narrow_to(row[3 + i], v[axis] * frequency * cosine[i]);
        narrow_to(row[3 + tile.angles + i], -(v[axis] * frequency * sine[i]));
      }
    }
    for (int64_t i = tile.encoding_width; i < tile.rate_stride; ++i) narrow_to(row[i], T(0));
  }
}

// J^T row, for a gradient of the encoding.
template <typename S, typename T = Compute<S>>
static void encoding_gradient(const FieldArgs<S>& a, const Tile<S>& tile, int64_t r, const T* row, T* gradient) {
  const T *sine = tile.sine + r * tile.angles, *cosine = tile.cosine + r * tile.angles;
  for (int axis = 0; axis < 3; ++axis) gradient[axis] = row[axis];
  T frequency = 1;
  for (int64_t k = 0, i = 0; k < a.octaves; ++k, frequency *= T(2)) {
    for (int axis = 0; axis < 3; ++axis, ++i) {
      gradient[axis] += frequency * (cosine[i] * row[3 + i] - sine[i] * row[3 + tile.angles + i]);
    }
  }
}

// Adds the derivative in the position of J v times `row`.
template <typename S, typename T = Compute<S>>
static void encoding_bend(const FieldArgs<S>& a, const Tile<S>& tile, int64_t r, const T* row, const T* v,
                          T* gradient) {
  const T *sine = tile.sine + r * tile.angles, *cosine = tile.cosine + r * tile.angles;
  T frequency = 1;
  for (int64_t k = 0, i = 0; k < a.octaves; ++k, frequency *= T(2)) {
    for (int axis = 0; axis < 3; ++axis, ++i) {
      gradient[axis] -= v[axis] * frequency * frequency * (sine[i] * row[3 + i] + cosine[i] * row[3 + tile.angles + i]);
    }
  }
}

template <typename S>
static inline Corners<S, 2> map_corners(const FieldArgs<S>& a, const Tile<S>& tile, int64_t begin, int64_t r) {
  return corners(a.map.map + (begin + r) / a.map.num_samples * a.map.stride[2], a.map, tile.stencil[r]);
}

// Rows of the map: F, or along tile.direction F' v.
template <bool kAlong, typename S, typename T = Compute<S>>
static void gather(const FieldArgs<S>& a, const Tile<S>& tile, int64_t begin, int64_t count) {
  for (int64_t r = 0; r < count; ++r) {
    T weight[1][4];
    if constexpr (kAlong) {
      linear_directional(tile.stencil[r], tile.direction + 3 * r, weight[0]);
    } else {
      linear_weights(tile.stencil[r], 0, weight[0]);
    }
    S* const out[1] = {tile.gathered + r * tile.stride};
    blend(map_corners(a, tile, begin, r).row, weight, tile.width, out);
    for (int64_t c = tile.width; c < tile.columns; ++c) narrow_to(out[0][c], T(0));
  }
}

// --- Forward -------------------------------------------------------------------------------------
template <typename S, typename T = Compute<S>>
static void activations(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count) {
  constexpr int W = kWidth<T>;
  const int64_t stride = tile.stride;
  const SoftplusScale<T> beta = tile.beta;
  for (int64_t l = 0; l < tile.layers; ++l) {
    const T* bias = a.bias[l];
    const S* gathered = l == 0 ? tile.gathered : nullptr;
    S *out = tile.activation[l], *slope = tile.slope[l];
    const auto epilogue = [=](int64_t row, int64_t column, Vec<T, W> sum) __attribute__((always_inline)) {
      const int64_t at = row * stride + column;
      const Vec<T, W> z = sum + load<W>(bias + column);
      const auto a = softplus(beta, gathered ? z + load_values<W>(gathered + at) : z);
      store_factors<W>(out + at, a.value);
      store_factors<W>(slope + at, a.slope);
    };
    if (l == 0) {
      product(tile.encoding, tile.encoding_stride, count, tile.encoding_columns, a.first, tile.width, epilogue);
    } else {
      product(tile.activation[l - 1], stride, count, tile.width, a.up[l], tile.width, epilogue);
    }
  }
}

// s_l from a_l that was kept: 1 - exp(-beta a).
template <typename S, typename T = Compute<S>>
static void slopes(const Tile<S>& tile, int64_t count) {
  constexpr int W = kWidth<T>;
  for (int64_t l = 0; l < tile.layers; ++l) {
    for (int64_t r = 0; r < count; ++r) {
      for (int64_t c = 0; c < tile.columns; c += W) {
        const int64_t at = r * tile.stride + c;
        const auto value = load_values<W>(tile.activation[l] + at);
        store_factors<W>(tile.slope[l] + at, -exp_nonpositive(tile.beta.beta, -value).expm1);
      }
    }
  }
}

// g_L
template <typename S, typename T = Compute<S>>
static void last_of_chain(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count) {
  constexpr int W = kWidth<T>;
  const S* slope = tile.slope[tile.layers - 1];
  S* out = tile.chain[tile.layers - 1];
  for (int64_t r = 0; r < count; ++r) {
    for (int64_t c = 0; c < tile.columns; c += W) {
      const int64_t at = r * tile.stride + c;
      store_factors<W>(out + at, load_values<W>(slope + at) * load<W>(a.sdf_row + c));
    }
  }
}

// g_{L-1} .. g_1
template <typename S, typename T = Compute<S>>
static void chain(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count) {
  constexpr int W = kWidth<T>;
  const int64_t stride = tile.stride;
  for (int64_t l = tile.layers - 1; l > 0; --l) {
    const S* slope = tile.slope[l - 1];
    S* out = tile.chain[l - 1];
    product(tile.chain[l], stride, count, tile.width, a.down[l], tile.width,
            [=](int64_t row, int64_t column, Vec<T, W> sum) __attribute__((always_inline)) {
              const int64_t at = row * stride + column;
              store_factors<W>(out + at, sum * load_values<W>(slope + at));
            });
  }
}

// few = rows times the packed matrix, of at most few_stride columns.
template <typename S, typename T = Compute<S>>
static void few_columns(const Tile<S>& tile, const S* rows, int64_t row_stride, int64_t count, int64_t inputs,
                        const S* packed, int64_t columns, T* few) {
  constexpr int W = kWidth<T>;
  const int64_t stride = tile.few_stride;
  product(rows, row_stride, count, inputs, packed, columns,
          [=](int64_t row, int64_t column, Vec<T, W> sum)
              __attribute__((always_inline)) { store(few + row * stride + column, sum); });
}

template <typename S, typename T = Compute<S>>
static void write_outputs(const FieldArgs<S>& a, const Tile<S>& tile, const FieldOutputs<S>& out, int64_t begin,
                          int64_t count) {
  const int64_t last = tile.layers, classes = a.num_outputs - 1;
  few_columns(tile, tile.activation[last - 1], tile.stride, count, tile.width, a.up[last], a.num_outputs, tile.few);
  for (int64_t r = 0; r < count; ++r) {
    const T* row = tile.few + r * tile.few_stride;
    out.sdf[begin + r] = (row[0] + a.bias[last][0]) * a.sdf_scale;
    for (int64_t k = 0; k < classes; ++k) {
      out.semantics[(begin + r) * classes + k] = row[1 + k] + a.bias[last][1 + k];
    }
  }
}

template <typename S, typename T = Compute<S>>
static void write_gradient(const FieldArgs<S>& a, const Tile<S>& tile, T* out, int64_t begin, int64_t count) {
  few_columns(tile, tile.chain[0], tile.stride, count, tile.width, a.down[0], tile.encoding_width, tile.few);
  for (int64_t r = 0; r < count; ++r) {
    T gradient[3], along_map[2];
    encoding_gradient(a, tile, r, tile.few + r * tile.few_stride, gradient);
    const S* const source[1] = {tile.chain[0] + r * tile.stride};
    grid_gradient<1>(tile.stencil[r], map_corners(a, tile, begin, r), source, tile.width, along_map);
    for (int axis = 0; axis < 2; ++axis) gradient[axis] += along_map[axis];
    for (int axis = 0; axis < 3; ++axis) out[(begin + r) * 3 + axis] = gradient[axis] / a.half_extent[axis];
  }
}

template <typename S>
static void forward(const FieldArgs<S>& a, const FieldSaved<S>& saved, const FieldOutputs<S>& out, char* scratch,
                    int64_t begin, int64_t end, int64_t num_samples) {
  Tile<S> tile(a, false, scratch);
  for (int64_t first = begin; first < end; first += kRowTile) {
    const int64_t count = end - first < kRowTile ? end - first : kRowTile;
    if (saved.activation) tile.use_saved(saved, num_samples, first, out.gradient != nullptr);
    encode(a, tile, first, count);
    gather<false>(a, tile, first, count);
    activations(a, tile, count);
    write_outputs(a, tile, out, first, count);
    if (!out.gradient) continue;
    last_of_chain(a, tile, count);
    chain(a, tile, count);
    write_gradient(a, tile, out.gradient, first, count);
  }
}

// --- Backward ------------------------------------------------------------------------------------
// y_l of all layers: rate = s y, and in `back` q.
template <typename S, typename T = Compute<S>>
static void tangents(const FieldArgs<S>& a, const Tile<S>& tile, int64_t begin, int64_t count) {
  constexpr int W = kWidth<T>;
  const int64_t stride = tile.stride;
  const T beta_value = tile.beta_value;
  encode_rate(a, tile, count);
  gather<true>(a, tile, begin, count);
  for (int64_t l = 0; l < tile.layers; ++l) {
    const S *slope = tile.slope[l], *chain = tile.chain[l], *gathered = l == 0 ? tile.gathered : nullptr;
    S *rate = tile.rate[l], *back = tile.back[l];
    const auto epilogue = [=](int64_t row, int64_t column, Vec<T, W> sum) __attribute__((always_inline)) {
      const int64_t at = row * stride + column;
      const Vec<T, W> y = gathered ? sum + load_values<W>(gathered + at) : sum;
      const Vec<T, W> s = load_values<W>(slope + at);
      store_factors<W>(rate + at, s * y);
      store_factors<W>(back + at, load_values<W>(chain + at) * y * (beta_value - beta_value * s));
    };
    if (l == 0) {
      product(tile.encoding_rate, tile.rate_stride, count, tile.encoding_width, a.up[0], tile.width, epilogue);
    } else {
      product(tile.rate[l - 1], stride, count, tile.width, a.up[l], tile.width, epilogue);
    }
  }
}

// x_l of all layers, in `back`.
template <typename S, typename T = Compute<S>>
static void reverse(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count, bool has_tangents) {
  constexpr int W = kWidth<T>;
  const int64_t stride = tile.stride;
  for (int64_t l = tile.layers; l > 0; --l) {
    const S* slope = tile.slope[l - 1];
    S* back = tile.back[l - 1];
    const auto epilogue = [=](int64_t row, int64_t column, Vec<T, W> sum) __attribute__((always_inline)) {
      const int64_t at = row * stride + column;
      const Vec<T, W> x = sum * load_values<W>(slope + at);
      store_factors<W>(back + at, has_tangents ? x + load_values<W>(back + at) : x);
    };
    if (l == tile.layers) {
      product(tile.output, tile.output_stride, count, a.num_outputs, a.down[l], tile.width, epilogue);
    } else {
      product(tile.back[l], stride, count, tile.width, a.down[l], tile.width, epilogue);
    }
  }
}

template <typename S, typename T = Compute<S>>
static void add_outer(const Tile<S>& tile, const S* a, int64_t a_stride, int64_t rows, const S* b, int64_t b_stride,
                      int64_t columns, int64_t count, T* sum) {
  outer_product(interleave(a, a_stride, count, tile.interleaved[0]), a_stride, rows,
                interleave(b, b_stride, count, tile.interleaved[1]), b_stride, columns, count, sum, columns);
}

template <typename S, typename T = Compute<S>>
static void add_rows(const S* rows, int64_t stride, int64_t columns, int64_t count, T factor, T* __restrict sum) {
  for (int64_t r = 0; r < count; ++r) {
    const S* __restrict row = rows + r * stride;
    for (int64_t c = 0; c < columns; ++c) sum[c] += factor * widen(row[c]);
  }
}

template <typename S, typename T = Compute<S>>
static void add_parameters(const FieldArgs<S>& a, const Tile<S>& tile, int64_t count, bool has_tangents, T* sum) {
  const int64_t width = tile.width, stride = tile.stride, last = tile.layers;
  for (int64_t l = 0; l < last; ++l) {
    const int64_t columns = l == 0 ? tile.rate_stride : tile.columns;
    const S* input = l == 0 ? tile.encoding : tile.activation[l - 1];
    add_outer(tile, tile.back[l], stride, width, input, l == 0 ? tile.encoding_stride : stride, columns, count, sum);
    if (has_tangents) {
      const S* rate = l == 0 ? tile.encoding_rate : tile.rate[l - 1];
      add_outer(tile, tile.chain[l], stride, width, rate, l == 0 ? tile.rate_stride : stride, columns, count, sum);
    }
    sum += width * columns;
    add_rows(tile.back[l], stride, width, count, T(1), sum);
    sum += width;
  }
  add_outer(tile, tile.output, tile.output_stride, a.num_outputs, tile.activation[last - 1], stride, tile.columns,
            count, sum);
  if (has_tangents) add_rows(tile.rate[last - 1], stride, width, count, a.sdf_scale, sum);
  sum += a.num_outputs * tile.columns;
  add_rows(tile.output, tile.output_stride, a.num_outputs, count, T(1), sum);
}

template <typename S, typename T = Compute<S>>
static void write_points(const FieldArgs<S>& a, const Tile<S>& tile, int64_t begin, int64_t count, bool has_tangents,
                         T* out) {
  few_columns(tile, tile.back[0], tile.stride, count, tile.width, a.down[0], tile.encoding_width, tile.few);
  if (has_tangents) {
    few_columns(tile, tile.chain[0], tile.stride, count, tile.width, a.down[0], tile.encoding_width, tile.few_chain);
  }
  for (int64_t r = 0; r < count; ++r) {
    const auto& stencil = tile.stencil[r];
    const auto p = map_corners(a, tile, begin, r);
    T gradient[3], along_map[2];
    encoding_gradient(a, tile, r, tile.few + r * tile.few_stride, gradient);
    const S* const source[1] = {tile.back[0] + r * tile.stride};
    grid_gradient<1>(stencil, p, source, tile.width, along_map);
    if (has_tangents) {
      const T* v = tile.direction + 3 * r;
      T dots[4];
      dot_rows(tile.chain[0] + r * tile.stride, p.row, tile.width, dots);
      const T mixed = linear_interpolate(stencil, 3, dots);
      along_map[0] += v[1] * mixed;
      along_map[1] += v[0] * mixed;
      encoding_bend(a, tile, r, tile.few_chain + r * tile.few_stride, v, gradient);
    }
    for (int axis = 0; axis < 2; ++axis) gradient[axis] += along_map[axis];
    for (int axis = 0; axis < 3; ++axis) out[(begin + r) * 3 + axis] = gradient[axis] / a.half_extent[axis];
  }
}

template <typename S, typename T = Compute<S>>
static void read_cotangents(const FieldArgs<S>& a, const Tile<S>& tile, const FieldCotangents<S>& grad, int64_t begin,
                            int64_t count) {
  const int64_t classes = a.num_outputs - 1;
  for (int64_t r = 0; r < count; ++r) {
    S* row = tile.output + r * tile.output_stride;
    narrow_to(row[0], grad.sdf ? grad.sdf[begin + r] * a.sdf_scale : T(0));
    for (int64_t k = 0; k < classes; ++k) {
      narrow_to(row[1 + k], grad.semantics ? grad.semantics[(begin + r) * classes + k] : T(0));
    }
    for (int64_t k = a.num_outputs; k < tile.output_stride; ++k) narrow_to(row[k], T(0));
    if (!grad.gradient) continue;
    for (int axis = 0; axis < 3; ++axis) {
      tile.direction[3 * r + axis] = grad.gradient[(begin + r) * 3 + axis] / a.half_extent[axis];
    }
  }
}

template <typename S>
static void backward(const FieldArgs<S>& a, const FieldSaved<S>& saved, const FieldCotangents<S>& grad,
                     const FieldGradients<S>& out, char* scratch, int64_t begin, int64_t end, int64_t num_samples) {
  Tile<S> tile(a, true, scratch);
  const bool has_tangents = grad.gradient != nullptr;
  for (int64_t first = begin; first < end; first += kRowTile) {
    const int64_t count = end - first < kRowTile ? end - first : kRowTile;
    encode(a, tile, first, count);
    read_cotangents(a, tile, grad, first, count);
    if (saved.activation) {
      tile.use_saved(saved, num_samples, first, saved.chain != nullptr);
      slopes(tile, count);
    } else {
      gather<false>(a, tile, first, count);
      activations(a, tile, count);
    }
    if (has_tangents) {
      last_of_chain(a, tile, count);
      if (!saved.chain) chain(a, tile, count);
      tangents(a, tile, first, count);
    }
    reverse(a, tile, count, has_tangents);
    if (out.parameters) add_parameters(a, tile, count, has_tangents, out.parameters);
    if (out.points) write_points(a, tile, first, count, has_tangents, out.points);
    for (int64_t r = 0; r < count; ++r) {
      const int64_t at = (first + r) * tile.width;
      for (int64_t c = 0; out.along_map && c < tile.width; ++c)
        out.along_map[at + c] = tile.back[0][r * tile.stride + c];
      for (int64_t c = 0; out.along_slope && c < tile.width; ++c) {
        out.along_slope[at + c] = tile.chain[0][r * tile.stride + c];
      }
      for (int axis = 0; out.directions && axis < 2; ++axis) {
        out.directions[(first + r) * 2 + axis] = tile.direction[3 * r + axis];
      }
    }
  }
}

template <typename S>
constexpr FieldKernels<S> field_kernels() {
  return {packed_size<S>, pack<S>, panel_columns<Compute<S>>, scratch_bytes<S>, forward<S>, backward<S>};
}

}  // namespace

const FieldKernels<float> decode_field_f32 = field_kernels<float>();
const FieldKernels<double> decode_field_f64 = field_kernels<double>();
const FieldKernels<BFloat16> decode_field_bf16 = field_kernels<BFloat16>();

}  // namespace pred::PRED_ISA
