// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Samples go through all layers in chunks of kChunkRows, whose rows a large device's cache holds for the most part. A
// layer is one product (math/product_cuda.cuh) with bias, Softplus, slopes and cotangents in its epilogue. The slope of
// an activation is taken from the activation itself. Between products: one thread per angle (encodings), a group of
// lanes per sample (gathers), one warp per sample (gradients by the position).
#include "common/workspace.h"
#include "math/product_cuda.cuh"
#include "math/sine_cosine.h"
#include "math/softplus.h"
#include "ops/decode_field.h"
#include "ops/sample_grid_rows.cuh"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kChunkRows = 32768;

template <typename T>
struct Range {
  const T* points;  // [rows, 3]
  T centre[3], half_extent[3];

  __device__ void position(int64_t row, T (&position)[3]) const {
    for (int axis = 0; axis < 3; ++axis) position[axis] = (points[row * 3 + axis] - centre[axis]) / half_extent[axis];
  }
};

template <typename S>
Range<Compute<S>> range_of(const FieldArgs<S>& a, int64_t first) {
  Range<Compute<S>> range{a.points + 3 * first, {}, {}};
  for (int axis = 0; axis < 3; ++axis) {
    range.centre[axis] = a.centre[axis];
    range.half_extent[axis] = a.half_extent[axis];
  }
  return range;
}

// Memory of one call. Rows of a chunk but for the weights and the parts of their gradients.
template <typename S>
struct Space {
  using T = Compute<S>;
  int64_t width, columns, stride, angles, encoding_width, encoding_stride, rate_stride, output_stride, layers;
  S *encoding, *encoding_rate, *gathered, *output;
  S *activation[kMaxHidden], *chain[kMaxHidden], *rate[kMaxHidden], *back[kMaxHidden];
  T *few, *few_chain, *sine, *cosine, *direction;
  S *first, *up[kMaxHidden + 1], *down[kMaxHidden + 1];  // rows of outputs, and of inputs
  T *parts[kMaxHidden + 1], *bias_parts[kMaxHidden + 1], *row_parts;
  int splits[kMaxHidden + 1];
  int64_t bytes;

  int64_t inputs(int64_t layer) const { return layer == 0 ? encoding_width : width; }

  Space(const FieldArgs<S>& a, int64_t num_samples, bool backward, char* memory) {
    Workspace space(memory);
    const int64_t rows = num_samples < kChunkRows ? num_samples : kChunkRows;
    width = a.map.channels;
    columns = whole_chunks<S>(width);
    stride = field_stride(width);
    angles = 3 * a.octaves;
    encoding_width = 3 + 2 * angles;
    encoding_stride = whole_chunks<S>(kFieldParts<S> * encoding_width);
    rate_stride = whole_chunks<S>(encoding_width);
    output_stride = whole_chunks<S>(a.num_outputs);
    layers = a.num_hidden;
    encoding = space.take<S>(rows * encoding_stride);
    gathered = space.take<S>(rows * stride);
    few = space.take<T>(rows * encoding_width);
    sine = space.take<T>(rows * angles);
    cosine = space.take<T>(rows * angles);
    first = space.take<S>(width * encoding_stride);
    for (int64_t l = 0; l <= layers; ++l) {
      const int64_t in = inputs(l), out = l < layers ? width : a.num_outputs;
      up[l] = space.take<S>(out * whole_chunks<S>(in));
      down[l] = space.take<S>(in * whole_chunks<S>(out));
      splits[l] = outer_splits(out, in, rows);
      parts[l] = space.take<T>(backward ? splits[l] * out * in : 0);
      bias_parts[l] = space.take<T>(backward ? kSumSplits * out : 0);
      if (l == layers) break;
      activation[l] = space.take<S>(rows * stride);
      chain[l] = space.take<S>(rows * stride);
      rate[l] = space.take<S>(backward ? rows * stride : 0);
      back[l] = space.take<S>(backward ? rows * stride : 0);
    }
    encoding_rate = space.take<S>(backward ? rows * rate_stride : 0);
    output = space.take<S>(backward ? rows * output_stride : 0);
    few_chain = space.take<T>(backward ? rows * encoding_width : 0);
    direction = space.take<T>(backward ? rows * 3 : 0);
    row_parts = space.take<T>(backward ? kSumSplits * width : 0);
    bytes = space.bytes();
  }

  // Rows of the chunk in what the forward pass kept, in place of scratch.
  void use_saved(const FieldSaved<S>& saved, int64_t num_samples, int64_t begin, bool with_chain) {
    for (int64_t l = 0; l < layers; ++l) {
      activation[l] = saved.activation + (l * num_samples + begin) * stride;
      if (with_chain && l + 1 < layers) chain[l] = saved.chain + (l * num_samples + begin) * stride;
    }
  }

  static constexpr int kSumSplits = 256;
};

// --- Parameters ----------------------------------------------------------------------------------
// [W_1, W_1, W_1 - rounded W_1], or W_1.
template <typename S, typename T = Compute<S>>
__global__ void pack_first_kernel(const T* weight, int64_t outputs, int64_t inputs, int64_t stride, S* to) {
  for (int64_t i = first_thread(); i < outputs * stride; i += thread_stride()) {
    const int64_t row = i / stride, column = i - row * stride, part = column / inputs;
    T value = T(0);
    if (part < kFieldParts<S>) {
      value = weight[row * inputs + column - part * inputs];
      if (part == 2) {
        S rounded;
        narrow_to(rounded, value);
        value -= widen(rounded);
      }
    }
    narrow_to(to[i], value);
  }
}

// The layers' parameters, one after the other: W_l [outputs, inputs], b_l [outputs].
template <typename T>
struct Parameters {
  const T *weight[kMaxHidden + 1], *bias[kMaxHidden + 1];
  int64_t offset[kMaxHidden + 1];

  template <typename S>
  Parameters(const FieldArgs<S>& a, const Space<S>& space, const T* data) {
    for (int64_t l = 0, at = 0; l <= space.layers; ++l) {
      const int64_t out = l < space.layers ? space.width : a.num_outputs;
      offset[l] = at;
      weight[l] = data + at;
      bias[l] = data + at + out * space.inputs(l);
      at += out * (space.inputs(l) + 1);
    }
  }
};

template <typename S, typename T = Compute<S>>
void pack_parameters(const FieldArgs<S>& a, const Space<S>& space, const Parameters<T>& parameters) {
  launch_threads(pack_first_kernel<S>, space.width * space.encoding_stride, parameters.weight[0], space.width,
                 space.encoding_width, space.encoding_stride, space.first);
  for (int64_t l = 0; l <= space.layers; ++l) {
    const int64_t in = space.inputs(l), out = l < space.layers ? space.width : a.num_outputs;
    pack_rows(parameters.weight[l], in, int64_t(1), out, in, whole_chunks<S>(in), space.up[l]);
    pack_rows(parameters.weight[l], int64_t(1), in, in, out, whole_chunks<S>(out), space.down[l]);
  }
}

// --- Encoding and map ----------------------------------------------------------------------------
template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY void put(S* row, int64_t encoding_width, int64_t i, T value) {
  narrow_to(row[i], value);
  if constexpr (kFieldParts<S> == 3) {
    narrow_to(row[encoding_width + i], value - widen(row[i]));
    row[2 * encoding_width + i] = row[i];
  }
}

// One thread per angle, or per coordinate.
template <typename S, typename T = Compute<S>>
__global__ void encode_kernel(Range<T> range, Space<S> space, int64_t rows) {
  const int64_t per_row = 3 + space.angles, used = kFieldParts<S> * space.encoding_width;
  for (int64_t i = first_thread(); i < rows * per_row; i += thread_stride()) {
    const int64_t r = divide(i, per_row), part = i - r * per_row;
    S* row = space.encoding + r * space.encoding_stride;
    T position[3];
    range.position(r, position);
    if (part < 3) {
      put(row, space.encoding_width, part, part == 0 ? position[0] : part == 1 ? position[1] : position[2]);
      for (int64_t c = used + part; c < space.encoding_stride; c += 3) narrow_to(row[c], T(0));
      continue;
    }
    const int64_t angle = part - 3, octave = angle / 3, axis = angle - 3 * octave;
    const T along = axis == 0 ? position[0] : axis == 1 ? position[1] : position[2];
    const SineCosine both = sine_cosine(double(along * T(int64_t(1) << octave)));
    space.sine[r * space.angles + angle] = T(both.sine);
    space.cosine[r * space.angles + angle] = T(both.cosine);
    put(row, space.encoding_width, 3 + angle, T(both.sine));
    put(row, space.encoding_width, 3 + space.angles + angle, T(both.cosine));
  }
}

// Rows J v: the encoding's derivative along `direction`.
template <typename S, typename T = Compute<S>>
__global__ void encode_rate_kernel(Space<S> space, int64_t rows) {
  const int64_t per_row = 3 + space.angles;
  for (int64_t i = first_thread(); i < rows * per_row; i += thread_stride()) {
    const int64_t r = divide(i, per_row), part = i - r * per_row;
    S* row = space.encoding_rate + r * space.rate_stride;
    if (part < 3) {
      narrow_to(row[part], space.direction[3 * r + part]);
      for (int64_t c = space.encoding_width + part; c < space.rate_stride; c += 3) narrow_to(row[c], T(0));
      continue;
    }
    const int64_t angle = part - 3, octave = angle / 3, at = r * space.angles + angle;
    const T rate = space.direction[3 * r + angle - 3 * octave] * T(int64_t(1) << octave);
    narrow_to(row[3 + angle], rate * space.cosine[at]);
    narrow_to(row[3 + space.angles + angle], -(rate * space.sine[at]));
  }
}

template <typename S>
PRED_DEVICE_ONLY LinearStencil<Compute<S>, 2> map_stencil(const SampleGridArgs<S, 2>& map,
                                                          const Range<Compute<S>>& range, int64_t row) {
  Compute<S> position[3];
  range.position(row, position);
  return linear_stencil<2>(position, map.size, map.border, map.align_corners);
}

// Rows of the map: F, or along the direction F' v. `first` is the number of row 0 among all samples.
template <bool kAlong, int V, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    gather_kernel(SampleGridArgs<S, 2> map, Range<T> range, const T* direction, int64_t first, int64_t rows,
                  int64_t columns, int64_t stride, S* out, int lanes) {
  const Group group(lanes);
  for (int64_t r = group.first(); r < rows; r += group.stride()) {
    const auto s = map_stencil(map, range, r);
    T weight[4];
    if constexpr (kAlong) {
      linear_directional(s, direction + 3 * r, weight);
    } else {
      linear_weights(s, 0, weight);
    }
    const Corners<S, 2> p(map.map + divide(first + r, map.num_samples) * map.stride[2], map, s);
    for (int64_t c = group.lane * V; c < columns; c += group.size * V) {
      T sum[V] = {};
#pragma unroll
      for (int k = 0; k < 4; ++k) {
        T value[V];
        load_pack<V>(p.row[k] && c < map.channels ? p.row[k] + c : nullptr, value);
        for (int v = 0; v < V; ++v) sum[v] += value[v] * weight[k];
      }
      store_pack<V>(out + r * stride + c, sum);
    }
  }
}

template <bool kAlong, typename S>
void gather(const FieldArgs<S>& a, const Space<S>& space, int64_t first, int64_t rows) {
  by_pack<S>(in_packs<S>(a.map.channels, a.map.map), space.columns, [&](auto pack, int lanes) {
    constexpr int V = decltype(pack)::value;
    launch_threads(gather_kernel<kAlong, V, S>, rows * lanes, a.map, range_of(a, first), space.direction, first, rows,
                   space.columns, space.stride, space.gathered, lanes);
  });
}

// --- Epilogues -----------------------------------------------------------------------------------
// 2^x for x <= 0, to 3e-7 of it; 0 below 2^-126.
PRED_DEVICE_ONLY float approximate_exp2(float x) {
#ifdef __CUDA_ARCH__
  float value;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(value) : "f"(x));
  return value;
#else
  return __builtin_exp2f(x);
#endif
}

// What is stored as bfloat16 needs no more than this: relative errors below 1e-4, and of the slope absolute ones of
// 3e-7.
template <typename S>
constexpr bool kApproximate = std::is_same_v<S, BFloat16>;

// log(1 + exp(beta z)) / beta. Approximate: minimax fit of log(1 + e) / e, relative error 6e-5.
template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY T softplus_of(const SoftplusScale<T>& beta, T z) {
  if constexpr (kApproximate<S>) {
    const float e = approximate_exp2(negative_magnitude(z) * beta.beta.high);
    float sum = e * 0.041347265f - 0.15742713f;
    sum = sum * e + 0.30630088f;
    sum = sum * e - 0.49697781f;
    sum = sum * e + 0.99994326f;
    return (z < 0.0f ? 0.0f : z) + sum * e * beta.inverse;  // NaN stays NaN
  } else {
    return softplus(beta, z).value;
  }
}

// The slope s = 1 - exp(-beta a) of an activation a, and 1 - s.
template <typename T>
struct Slope {
  T value, rest;
};

template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY Slope<T> slope_of(const ExpScale<T>& beta, T activation) {
  if constexpr (kApproximate<S>) {
    const float e = approximate_exp2(-activation * beta.high);
    return {1.0f - e, e};
  } else {
    const auto e = exp_nonpositive(beta, -activation);
    return {-e.expm1, e.exp};
  }
}

// Values of a row that an epilogue takes at once.
template <typename S>
using Columns = Compute<S>[kColumns<false>];

// value[v] = from[v], but 0 from `count` on, in whole chunks; of memory that the kernel does not write, or does.
template <bool kConstant, typename S>
PRED_DEVICE_ONLY void load_columns(const S* from, int64_t count, Columns<S>& value) {
  constexpr int V = kChunk<S>;
#pragma unroll
  for (int first = 0; first < kColumns<false>; first += V) {
    Compute<S> part[V];
    const S* chunk = first < count ? from + first : nullptr;
    if constexpr (kConstant) {
      load_constant_pack<V>(chunk, part);
    } else {
      load_pack<V>(chunk, part);
    }
#pragma unroll
    for (int v = 0; v < V; ++v) value[first + v] = part[v];
  }
}

// Results for rows of hidden width, those that fill up a row being 0.
template <typename S>
PRED_DEVICE_ONLY void store_hidden(S* to, int64_t left, Columns<S>& value) {
#pragma unroll
  for (int v = 1; v < kColumns<false>; ++v) value[v] = v < left ? value[v] : Compute<S>(0);
  store_columns(to, true, left, value);
}

template <typename S, typename T = Compute<S>>
struct Activate {
  SoftplusScale<T> beta;
  const T* bias;
  const S* gathered;  // or null
  int64_t width, stride;
  S* out;

  __device__ auto at(int64_t column, int) const {
    const int64_t left = width - column;
    Columns<S> add;
#pragma unroll
    for (int v = 0; v < kColumns<false>; ++v) add[v] = v < left ? bias[column + v] : T(0);
    return [this, column, left, add](int64_t row, const Columns<S>& value) {
      const int64_t at = row * stride + column;
      Columns<S> result, from_map = {};
      if (gathered) load_columns<true>(gathered + at, left, from_map);
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) {
        const T z = value[v] + add[v];
        result[v] = softplus_of<S>(beta, gathered ? z + from_map[v] : z);
      }
      store_hidden(out + at, left, result);
    };
  }
};

// g_{l-1} from W_l^T g_l.
template <typename S, typename T = Compute<S>>
struct Chain {
  ExpScale<T> beta;
  const S* activation;
  int64_t width, stride;
  S* out;

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const Columns<S>& value) {
      const int64_t at = row * stride + column, left = width - column;
      Columns<S> result, a;
      load_columns<true>(activation + at, left, a);
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) result[v] = value[v] * slope_of<S>(beta, a[v]).value;
      store_hidden(out + at, left, result);
    };
  }
};

// s y and q from y.
template <typename S, typename T = Compute<S>>
struct Tangent {
  ExpScale<T> beta;
  T beta_value;
  const S *activation, *chain, *gathered;  // the last may be null
  int64_t width, stride;
  S *rate, *back;

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const Columns<S>& value) {
      const int64_t at = row * stride + column, left = width - column;
      Columns<S> y, q, a, g, from_map = {};
      load_columns<true>(activation + at, left, a);
      load_columns<true>(chain + at, left, g);
      if (gathered) load_columns<true>(gathered + at, left, from_map);
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) {
        y[v] = gathered ? value[v] + from_map[v] : value[v];
        const Slope<T> s = slope_of<S>(beta, a[v]);
        q[v] = g[v] * y[v] * (beta_value * s.rest);
        y[v] *= s.value;
      }
      store_hidden(rate + at, left, y);
      store_hidden(back + at, left, q);
    };
  }
};

// x_{l-1} from W_l^T x_l, where `back` holds q_{l-1}, if there are tangents.
template <typename S, typename T = Compute<S>>
struct Reverse {
  ExpScale<T> beta;
  const S* activation;
  bool has_tangents;
  int64_t width, stride;
  S* back;

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const Columns<S>& value) {
      const int64_t at = row * stride + column, left = width - column;
      Columns<S> x, a, q = {};
      load_columns<true>(activation + at, left, a);
      if (has_tangents) load_columns<false>(back + at, left, q);
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) {
        x[v] = value[v] * slope_of<S>(beta, a[v]).value;
        x[v] = has_tangents ? x[v] + q[v] : x[v];
      }
      store_hidden(back + at, left, x);
    };
  }
};

// Few columns, as they are.
template <typename T>
struct StoreFew {
  T* out;
  int64_t columns;

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const T(&value)[kColumns<false>]) {
      store_columns(out + row * columns + column, false, columns - column, value);
    };
  }
};

template <typename T>
struct StoreOutputs {
  const T* bias;
  T sdf_scale, *sdf, *semantics;
  int64_t classes;

  __device__ auto at(int64_t column, int) const {
    return [this, column](int64_t row, const T(&value)[kColumns<false>]) {
#pragma unroll
      for (int v = 0; v < kColumns<false>; ++v) {
        const int64_t c = column + v;
        if (c == 0)
          sdf[row] = (value[v] + bias[0]) * sdf_scale;
        else if (c <= classes)
          semantics[row * classes + c - 1] = value[v] + bias[c];
      }
    };
  }
};

// --- Forward -------------------------------------------------------------------------------------
template <typename S, typename T = Compute<S>>
void encode(const FieldArgs<S>& a, const Space<S>& space, int64_t first, int64_t rows) {
  launch_threads(encode_kernel<S>, rows * (3 + space.angles), range_of(a, first), space, rows);
}

// Rows times W_l, or its transpose; all of them with rows of hidden width as results but where n says otherwise.
template <typename S, class Epilogue>
void multiply(const FieldArgs<S>& a, const S* rows, int64_t row_stride, int64_t count, const S* weight, int64_t k,
              int64_t outputs, int64_t n, const Epilogue& epilogue) {
  launch_product<S, false>({count, n, k, 1, 1, a.tf32, false}, ProductRows<S>{rows, row_stride, count},
                           ProductRows<S>{weight, k, outputs}, epilogue);
}

template <typename S, typename T = Compute<S>>
void activations(const FieldArgs<S>& a, const Space<S>& space, const Parameters<T>& parameters, int64_t rows) {
  const SoftplusScale<T> beta = softplus_scale(a.beta);
  for (int64_t l = 0; l < space.layers; ++l) {
    const Activate<S> epilogue{beta,        parameters.bias[l], l == 0 ? space.gathered : nullptr,
                               space.width, space.stride,       space.activation[l]};
    if (l == 0) {
      multiply(a, space.encoding, space.encoding_stride, rows, space.first, space.encoding_stride, space.width,
               space.columns, epilogue);
    } else {
      multiply(a, space.activation[l - 1], space.stride, rows, space.up[l], space.columns, space.width, space.columns,
               epilogue);
    }
  }
}

// g_L
template <typename S, typename T = Compute<S>>
__global__ void last_of_chain_kernel(ExpScale<T> beta, const T* sdf_row, T sdf_scale, const S* activation,
                                     int64_t width, int64_t columns, int64_t stride, int64_t rows, S* out) {
  for (int64_t i = first_thread(); i < rows * columns; i += thread_stride()) {
    const int64_t row = divide(i, columns), c = i - row * columns, at = row * stride + c;
    narrow_to(out[at], c < width ? slope_of<S>(beta, widen(activation[at])).value * (sdf_row[c] * sdf_scale) : T(0));
  }
}

// g_L and, where they are not known, g_{L-1} .. g_1.
template <typename S, typename T = Compute<S>>
void chain(const FieldArgs<S>& a, const Space<S>& space, const Parameters<T>& parameters, int64_t rows, bool known) {
  const ExpScale<T> beta = exp_scale(a.beta);
  const int64_t last = space.layers - 1;
  launch_threads(last_of_chain_kernel<S>, rows * space.columns, beta, parameters.weight[space.layers], a.sdf_scale,
                 static_cast<const S*>(space.activation[last]), space.width, space.columns, space.stride, rows,
                 space.chain[last]);
  for (int64_t l = last; l > 0 && !known; --l) {
    multiply(a, space.chain[l], space.stride, rows, space.down[l], space.columns, space.width, space.columns,
             Chain<S>{beta, space.activation[l - 1], space.width, space.stride, space.chain[l - 1]});
  }
}

// The lane's share of J^T row, for a gradient of the encoding of row r.
template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY void add_encoding_gradient(const Space<S>& space, int64_t r, const T* row, T (&gradient)[3]) {
  const T *sine = space.sine + r * space.angles, *cosine = space.cosine + r * space.angles;
  for (int64_t i = lane_number(); i < 3 + space.angles; i += kWarp) {
    const int64_t angle = i - 3, octave = angle / 3;
    const int axis = int(i < 3 ? i : angle - 3 * octave);
    const T share = i < 3 ? row[i]
                          : T(int64_t(1) << octave) *
                                (cosine[angle] * row[3 + angle] - sine[angle] * row[3 + space.angles + angle]);
#pragma unroll
    for (int other = 0; other < 3; ++other) gradient[other] += other == axis ? share : T(0);
  }
}

// The lane's share of the derivative in the position of J v times `row`.
template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY void add_encoding_bend(const Space<S>& space, int64_t r, const T* row, T (&gradient)[3]) {
  const T *sine = space.sine + r * space.angles, *cosine = space.cosine + r * space.angles;
  for (int64_t angle = lane_number(); angle < space.angles; angle += kWarp) {
    const int64_t octave = angle / 3;
    const int axis = int(angle - 3 * octave);
    const T frequency = T(int64_t(1) << octave);
    const T share = space.direction[3 * r + axis] * frequency * frequency *
                    (sine[angle] * row[3 + angle] + cosine[angle] * row[3 + space.angles + angle]);
#pragma unroll
    for (int other = 0; other < 3; ++other) gradient[other] -= other == axis ? share : T(0);
  }
}

// The lane's share of row . p_k, for the corners p_k of a sample.
template <typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY void corner_dots(const Corners<S, 2>& p, const S* row, int64_t channels, T (&dots)[4]) {
  for (int k = 0; k < 4; ++k) dots[k] = T(0);
  for (int64_t c = lane_number(); c < channels; c += kWarp) {
    const T value = widen(row[c]);
#pragma unroll
    for (int k = 0; k < 4; ++k) dots[k] += p.row[k] ? value * widen(p.row[k][c]) : T(0);
  }
}

// J^T few + F'^T rows, over half_extent, and with kBend the second-order part by few_chain, chain and the direction.
// One warp per row.
template <bool kBend, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    position_gradient_kernel(SampleGridArgs<S, 2> map, Range<T> range, Space<S> space, const S* source,
                             const S* chain_rows, int64_t first, int64_t rows, T* out) {
  for (int64_t r = first_warp(); r < rows; r += warp_stride()) {
    const auto s = map_stencil(map, range, r);
    const Corners<S, 2> p(map.map + divide(first + r, map.num_samples) * map.stride[2], map, s);
    T gradient[3] = {};
    add_encoding_gradient(space, r, space.few + r * space.encoding_width, gradient);
    if (kBend) add_encoding_bend(space, r, space.few_chain + r * space.encoding_width, gradient);
    if (p.any) {
      T dots[4];
      corner_dots(p, source + r * space.stride, space.width, dots);
      for (int axis = 0; axis < 2; ++axis) gradient[axis] += linear_interpolate(s, 1 << axis, dots);
      if (kBend) {
        corner_dots(p, chain_rows + r * space.stride, space.width, dots);
        const T mixed = linear_interpolate(s, 3, dots);
        gradient[0] += space.direction[3 * r + 1] * mixed;
        gradient[1] += space.direction[3 * r] * mixed;
      }
    }
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      const T sum = sum_lanes(gradient[axis]);
      if (lane_number() == 0) out[r * 3 + axis] = sum / range.half_extent[axis];
    }
  }
}

// few = rows W_1
template <typename S, typename T = Compute<S>>
void encoding_columns(const FieldArgs<S>& a, const Space<S>& space, const S* rows, int64_t count, T* few) {
  multiply(a, rows, space.stride, count, space.down[0], space.columns, space.encoding_width, space.encoding_width,
           StoreFew<T>{few, space.encoding_width});
}

template <typename S, typename T = Compute<S>>
void forward(const FieldArgs<S>& a, const T* parameter_data, const FieldSaved<S>& saved, const FieldOutputs<S>& out,
             char* workspace, int64_t num_samples) {
  Space<S> space(a, num_samples, false, workspace);
  const Parameters<T> parameters(a, space, parameter_data);
  pack_parameters(a, space, parameters);
  const int64_t classes = a.num_outputs - 1;
  for (int64_t first = 0; first < num_samples; first += kChunkRows) {
    const int64_t rows = num_samples - first < kChunkRows ? num_samples - first : kChunkRows;
    if (saved.activation) space.use_saved(saved, num_samples, first, saved.chain != nullptr);
    encode(a, space, first, rows);
    gather<false>(a, space, first, rows);
    activations(a, space, parameters, rows);
    const int64_t last = space.layers;
    multiply(
        a, space.activation[last - 1], space.stride, rows, space.up[last], space.columns, a.num_outputs, a.num_outputs,
        StoreOutputs<T>{parameters.bias[last], a.sdf_scale, out.sdf + first, out.semantics + first * classes, classes});
    if (!out.gradient) continue;
    chain(a, space, parameters, rows, false);
    encoding_columns(a, space, space.chain[0], rows, space.few);
    launch_warps(position_gradient_kernel<false, S>, rows, a.map, range_of(a, first), space,
                 static_cast<const S*>(space.chain[0]), static_cast<const S*>(nullptr), first, rows,
                 out.gradient + 3 * first);
  }
}

// --- Backward ------------------------------------------------------------------------------------
// Rows of cotangents, and their directions. One thread per column.
template <typename S, typename T = Compute<S>>
__global__ void read_cotangents_kernel(FieldCotangents<S> grad, Range<T> range, T sdf_scale, int64_t classes,
                                       Space<S> space, int64_t first, int64_t rows, T* directions) {
  for (int64_t i = first_thread(); i < rows * space.output_stride; i += thread_stride()) {
    const int64_t row = divide(i, space.output_stride), c = i - row * space.output_stride, sample = first + row;
    T value = T(0);
    if (c == 0 && grad.sdf) value = grad.sdf[sample] * sdf_scale;
    if (c > 0 && c <= classes && grad.semantics) value = grad.semantics[sample * classes + c - 1];
    narrow_to(space.output[i], value);
    if (c > 0 || !grad.gradient) continue;
    for (int axis = 0; axis < 3; ++axis) {
      const T v = grad.gradient[sample * 3 + axis] / range.half_extent[axis];
      space.direction[3 * row + axis] = v;
      if (directions && axis < 2) directions[2 * sample + axis] = v;
    }
  }
}

// y_l of all layers: rate = s y, and in `back` q.
template <typename S, typename T = Compute<S>>
void tangents(const FieldArgs<S>& a, const Space<S>& space, int64_t first, int64_t rows) {
  const ExpScale<T> beta = exp_scale(a.beta);
  launch_threads(encode_rate_kernel<S>, rows * (3 + space.angles), space, rows);
  gather<true>(a, space, first, rows);
  for (int64_t l = 0; l < space.layers; ++l) {
    const Tangent<S> epilogue{
        beta,        a.beta,       space.activation[l], space.chain[l], l == 0 ? space.gathered : nullptr,
        space.width, space.stride, space.rate[l],       space.back[l]};
    if (l == 0) {
      multiply(a, space.encoding_rate, space.rate_stride, rows, space.up[0], space.rate_stride, space.width,
               space.columns, epilogue);
    } else {
      multiply(a, space.rate[l - 1], space.stride, rows, space.up[l], space.columns, space.width, space.columns,
               epilogue);
    }
  }
}

// x_l of all layers, in `back`.
template <typename S, typename T = Compute<S>>
void reverse(const FieldArgs<S>& a, const Space<S>& space, int64_t rows, bool has_tangents) {
  const ExpScale<T> beta = exp_scale(a.beta);
  for (int64_t l = space.layers; l > 0; --l) {
    const Reverse<S> epilogue{beta,         space.activation[l - 1], has_tangents, space.width,
                              space.stride, space.back[l - 1]};
    if (l == space.layers) {
      multiply(a, space.output, space.output_stride, rows, space.down[l], space.output_stride, space.width,
               space.columns, epilogue);
    } else {
      multiply(a, space.back[l], space.stride, rows, space.down[l], space.columns, space.width, space.columns,
               epilogue);
    }
  }
}

// Two factors one after the other.
template <typename S>
struct TwoRows {
  static constexpr bool kSparse = false;
  ProductRows<S> of[2];

  __device__ const S* row(int64_t i, int segment) const { return segment ? of[1].row(i, 0) : of[0].row(i, 0); }
};

// parts[split, column] gets, or is given, the sum over the split's rows; one thread per column and split.
template <typename S, typename T = Compute<S>>
__global__ void column_sums_kernel(const S* rows, int64_t stride, int64_t columns, int64_t count, int splits, bool set,
                                   T* parts) {
  for (int64_t i = first_thread(); i < splits * columns; i += thread_stride()) {
    const int64_t split = i / columns, c = i - split * columns;
    T sum = T(0);
    const int64_t end = count * (split + 1) / splits;
#pragma unroll 8
    for (int64_t r = count * split / splits; r < end; ++r) sum += widen(rows[r * stride + c]);
    parts[i] = set ? sum : parts[i] + sum;
  }
}

template <typename S, typename T = Compute<S>>
void add_columns(const S* rows, int64_t stride, int64_t columns, int64_t count, bool set, T* parts) {
  constexpr int kSplits = Space<S>::kSumSplits;
  launch_threads(column_sums_kernel<S>, kSplits * columns, rows, stride, columns, count, kSplits, set, parts);
}

template <typename S, typename T = Compute<S>>
void add_parameters(const FieldArgs<S>& a, const Space<S>& space, int64_t rows, bool has_tangents, bool set) {
  const int64_t last = space.layers;
  const auto rows_of = [&](const S* data, int64_t stride) { return ProductRows<S>{data, stride, rows}; };
  for (int64_t l = 0; l <= last; ++l) {
    const int64_t in = space.inputs(l), out = l < last ? space.width : a.num_outputs;
    const S* left = l < last ? space.back[l] : space.output;
    const int64_t left_stride = l < last ? space.stride : space.output_stride;
    const bool two = has_tangents && l < last;
    const TwoRows<S> lefts{{rows_of(left, left_stride), rows_of(two ? space.chain[l] : left, left_stride)}};
    const TwoRows<S> rights{
        {l == 0 ? rows_of(space.encoding, space.encoding_stride) : rows_of(space.activation[l - 1], space.stride),
         l == 0 ? rows_of(space.encoding_rate, space.rate_stride) : rows_of(space.rate[l - 1], space.stride)}};
    launch_product<S, true>({out, in, rows, two ? 2 : 1, space.splits[l], a.tf32, false}, lefts, rights,
                            AddToParts<T>{space.parts[l], out, in, set});
    add_columns(left, left_stride, out, rows, set, space.bias_parts[l]);
  }
  if (has_tangents) {
    add_columns(static_cast<const S*>(space.rate[last - 1]), space.stride, space.width, rows, set, space.row_parts);
  }
}

// to[c] += factor times the sum over splits.
template <typename T>
__global__ void add_row_kernel(const T* parts, int64_t columns, int splits, T factor, T* to) {
  for (int64_t c = first_thread(); c < columns; c += thread_stride()) {
    T sum = T(0);
    for (int split = 0; split < splits; ++split) sum += parts[split * columns + c];
    to[c] += factor * sum;
  }
}

template <typename S, typename T = Compute<S>>
void write_parameters(const FieldArgs<S>& a, const Space<S>& space, const Parameters<T>& parameters, bool has_tangents,
                      T* out) {
  constexpr int kSplits = Space<S>::kSumSplits;
  for (int64_t l = 0; l <= space.layers; ++l) {
    const int64_t in = space.inputs(l), outputs = l < space.layers ? space.width : a.num_outputs;
    T* weight = out + parameters.offset[l];
    launch_threads(add_splits_kernel<T>, outputs * in, static_cast<const T*>(space.parts[l]), outputs * in,
                   space.splits[l], weight);
    launch_threads(add_splits_kernel<T>, outputs, static_cast<const T*>(space.bias_parts[l]), outputs, kSplits,
                   weight + outputs * in);
  }
  if (has_tangents) {
    launch_threads(add_row_kernel<T>, space.width, static_cast<const T*>(space.row_parts), space.width, kSplits,
                   a.sdf_scale, out + parameters.offset[space.layers]);
  }
}

template <typename S, typename T = Compute<S>>
void backward(const FieldArgs<S>& a, const T* parameter_data, const FieldSaved<S>& saved,
              const FieldCotangents<S>& grad, const FieldGradients<S>& out, char* workspace, int64_t num_samples) {
  Space<S> space(a, num_samples, true, workspace);
  const Parameters<T> parameters(a, space, parameter_data);
  pack_parameters(a, space, parameters);
  const bool has_tangents = grad.gradient != nullptr;
  for (int64_t first = 0; first == 0 || first < num_samples;
       first += kChunkRows) {  // once for the gradients of nothing
    const int64_t rows = num_samples - first < kChunkRows ? num_samples - first : kChunkRows;
    if (saved.activation) space.use_saved(saved, num_samples, first, saved.chain != nullptr);
    const bool in_place = out.along_map && space.stride == space.width;
    if (in_place) space.back[0] = out.along_map + first * space.width;
    encode(a, space, first, rows);
    launch_threads(read_cotangents_kernel<S>, rows * space.output_stride, grad, range_of(a, first), a.sdf_scale,
                   a.num_outputs - 1, space, first, rows, out.directions);
    if (!saved.activation) {
      gather<false>(a, space, first, rows);
      activations(a, space, parameters, rows);
    }
    if (has_tangents) {
      chain(a, space, parameters, rows, saved.chain != nullptr);
      tangents(a, space, first, rows);
    }
    reverse(a, space, rows, has_tangents);
    if (out.parameters) add_parameters(a, space, rows, has_tangents, first == 0);
    if (out.points) {
      encoding_columns(a, space, space.back[0], rows, space.few);
      if (has_tangents) encoding_columns(a, space, space.chain[0], rows, space.few_chain);
      launch_warps(has_tangents ? position_gradient_kernel<true, S> : position_gradient_kernel<false, S>, rows, a.map,
                   range_of(a, first), space, static_cast<const S*>(space.back[0]),
                   static_cast<const S*>(space.chain[0]), first, rows, out.points + 3 * first);
    }
    const auto copy_out = [&](const S* from, S* to) {
      pack_rows(from, space.stride, int64_t(1), rows, space.width, space.width, to + first * space.width);
    };
    if (out.along_map && !in_place) copy_out(space.back[0], out.along_map);
    if (out.along_slope) copy_out(space.chain[0], out.along_slope);
  }
  if (out.parameters) write_parameters(a, space, parameters, has_tangents, out.parameters);
}

template <typename S>
int64_t workspace_bytes(const FieldArgs<S>& a, int64_t num_samples, bool backward) {
  return Space<S>(a, num_samples, backward, nullptr).bytes;
}

// Positions in the map, as sample_bev takes them.
template <typename T>
__global__ void positions_kernel(Range<T> range, int64_t count, T* grid) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    T position[3];
    range.position(i, position);
    grid[2 * i] = position[0];
    grid[2 * i + 1] = position[1];
  }
}

template <typename S, typename T = Compute<S>>
void positions(const FieldArgs<S>& a, T* grid, int64_t num_samples) {
  launch_threads(positions_kernel<T>, num_samples, range_of(a, 0), num_samples, grid);
}

template <typename S>
constexpr FieldKernels<S> field_kernels() {
  return {workspace_bytes<S>, forward<S>, backward<S>, positions<S>};
}

}  // namespace

const FieldKernels<float> decode_field_f32 = field_kernels<float>();
const FieldKernels<double> decode_field_f64 = field_kernels<double>();
const FieldKernels<BFloat16> decode_field_bf16 = field_kernels<BFloat16>();

}  // namespace pred::PRED_ISA
