// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one sample (gathers) or one band of map rows (scatter). A band adds up its samples in the
// order of their cells, so results do not depend on the number of threads, and a cell's sums stay in cache.
#include "ops/sample_bev.h"

namespace pred::PRED_ISA {
namespace {

template <typename T>
struct Corners {
  const T* row[4];  // null outside the map
  bool all, any;
};

template <typename T>
static inline Corners<T> corners(const T* map, const BilinearStencil<T>& s, int64_t width, int64_t channels) {
  const bool inside[4] = {s.y.low_inside && s.x.low_inside, s.y.low_inside && s.x.high_inside,
                          s.y.high_inside && s.x.low_inside, s.y.high_inside && s.x.high_inside};
  Corners<T> c;
  c.all = true;
  c.any = false;
  for (int k = 0; k < 4; ++k) {
    const int64_t y = s.y.low + (k >> 1), x = s.x.low + (k & 1);
    c.row[k] = inside[k] ? map + (y * width + x) * channels : nullptr;
    c.all = c.all && inside[k];
    c.any = c.any || inside[k];
  }
  return c;
}

// out[c] (+)= sum_k weight[k] row_k[c]. A NaN weight reaches the output even when no corner is inside.
template <bool kAdd, typename T>
static inline void blend(const Corners<T>& c, const T weight[4], int64_t channels, T* __restrict out) {
  if (c.all) {
    const T* __restrict p0 = c.row[0], * __restrict p1 = c.row[1];
    const T* __restrict p2 = c.row[2], * __restrict p3 = c.row[3];
    const T w0 = weight[0], w1 = weight[1], w2 = weight[2], w3 = weight[3];
    for (int64_t i = 0; i < channels; ++i) {
      const T value = w0 * p0[i] + w1 * p1[i] + w2 * p2[i] + w3 * p3[i];
      out[i] = kAdd ? out[i] + value : value;
    }
    return;
  }
  const bool nan = weight[0] != weight[0];
  if (!kAdd || nan) {
    for (int64_t i = 0; i < channels; ++i) out[i] = nan ? weight[0] : T(0);
  }
  for (int k = 0; k < 4; ++k) {
    if (c.row[k] == nullptr) continue;
    const T w = weight[k];
    const T* __restrict p = c.row[k];
    for (int64_t i = 0; i < channels; ++i) out[i] += w * p[i];
  }
}

// dots[k] = sum_c grad[c] row_k[c]
template <typename T>
static inline void corner_dots(const Corners<T>& c, const T* __restrict grad, int64_t channels, T dots[4]) {
  // Independent partial sums: without -ffast-math the compiler may not split a single one.
  constexpr int64_t kLanes = 16;
  for (int k = 0; k < 4; ++k) {
    dots[k] = T(0);
    if (c.row[k] == nullptr) continue;
    const T* __restrict p = c.row[k];
    T partial[kLanes] = {};
    int64_t i = 0;
    for (; i + kLanes <= channels; i += kLanes) {
      for (int64_t lane = 0; lane < kLanes; ++lane) partial[lane] += grad[i + lane] * p[i + lane];
    }
    T sum = T(0);
    for (; i < channels; ++i) sum += grad[i] * p[i];
    for (int64_t half = kLanes / 2; half > 0; half /= 2) {
      for (int64_t lane = 0; lane < half; ++lane) partial[lane] += partial[lane + half];
    }
    dots[k] = sum + partial[0];
  }
}

template <typename T>
static void forward(const SampleBevArgs<T>& a, T* out, int64_t begin, int64_t end) {
  const int64_t map_size = a.height * a.width * a.channels;
  for (int64_t i = begin; i < end; ++i) {
    const auto s = bilinear_stencil(a.grid + 2 * i, a.height, a.width, a.border, a.align_corners);
    T weight[4];
    bilinear_weights(s, weight);
    const T* map = a.bev + i / a.num_samples * map_size;
    blend<false>(corners(map, s, a.width, a.channels), weight, a.channels, out + i * a.channels);
  }
}

template <typename T>
static int64_t pack(const SampleBevArgs<T>& a, const SampleBevOrder& order, uint64_t* items, int64_t begin,
                    int64_t end) {
  int64_t count = 0;
  for (int64_t i = begin; i < end; ++i) {
    const auto s = bilinear_stencil(a.grid + 2 * i, a.height, a.width, a.border, a.align_corners);
    if (!((s.y.low_inside || s.y.high_inside) && (s.x.low_inside || s.x.high_inside))) continue;
    uint64_t item = uint64_t(i / a.num_samples);
    item = item << order.row_bits | uint64_t(s.y.low + 1);
    item = item << order.column_bits | uint64_t(s.x.low + 1);
    items[count++] = item << order.number_bits | uint64_t(i);
  }
  return count;
}

// cell[c] += weight grad[c]; returns sum_c grad[c] corner[c] if kDot.
template <bool kDot, typename T>
static inline T add_to_cell(T weight, const T* __restrict grad, const T* __restrict corner, int64_t channels,
                            T* __restrict cell) {
  constexpr int64_t kLanes = 16;
  T partial[kLanes] = {};
  int64_t c = 0;
  for (; c + kLanes <= channels; c += kLanes) {
    for (int64_t lane = 0; lane < kLanes; ++lane) {
      cell[c + lane] += weight * grad[c + lane];
      if (kDot) partial[lane] += grad[c + lane] * corner[c + lane];
    }
  }
  T dot = T(0);
  for (; c < channels; ++c) {
    cell[c] += weight * grad[c];
    if (kDot) dot += grad[c] * corner[c];
  }
  if (kDot) {
    for (int64_t half = kLanes / 2; half > 0; half /= 2) {
      for (int64_t lane = 0; lane < half; ++lane) partial[lane] += partial[lane + half];
    }
  }
  return dot + partial[0];
}

template <bool kDot, typename T>
static void scatter_band_items(const SampleBevArgs<T>& a, const SampleBevOrder& order, const SampleBevBand<T>& band,
                               bool along_direction, T* grad_bev, T* grad_grid) {
  constexpr int64_t kAhead = 4, kLineBytes = 64;
  const int64_t row_size = a.width * a.channels;
  const int64_t map_offset = band.map * a.height * row_size;
  const uint64_t number_mask = (uint64_t(1) << order.number_bits) - 1;
  T* map_rows = grad_bev + map_offset;
  for (int64_t i = band.begin * row_size; i < band.end * row_size; ++i) map_rows[i] = T(0);
  for (int64_t i = 0; i < row_size; ++i) band.row_before[i] = T(0);
  for (int64_t j = band.first_item; j < band.last_item; ++j) {
    if (j + kAhead < band.last_item) {  // rows of `grad` are visited in the order of cells, not of memory
      const T* next = a.grad + int64_t(order.items[j + kAhead] & number_mask) * a.channels;
      for (int64_t c = 0; c < a.channels; c += kLineBytes / int64_t(sizeof(T))) __builtin_prefetch(next + c);
    }
    const int64_t i = int64_t(order.items[j] & number_mask);
    const auto s = bilinear_stencil(a.grid + 2 * i, a.height, a.width, a.border, a.align_corners);
    T weight[4], dots[4] = {};
    if (along_direction) {
      bilinear_directional(s, a.grad_grad_grid + 2 * i, weight);
    } else {
      bilinear_weights(s, weight);
    }
    for (int k = 0; k < 4; ++k) {
      if (!((k >> 1 ? s.y.high_inside : s.y.low_inside) && (k & 1 ? s.x.high_inside : s.x.low_inside))) continue;
      const int64_t y = s.y.low + (k >> 1), cell = (s.x.low + (k & 1)) * a.channels;
      T* row = y < band.begin ? band.row_before : map_rows + y * row_size;
      dots[k] = add_to_cell<kDot>(weight[k], a.grad + i * a.channels, a.bev + map_offset + y * row_size + cell,
                                  a.channels, row + cell);
    }
    if (kDot) {
      T gradient[2];
      bilinear_gradient(s, dots, gradient);
      grad_grid[2 * i] = gradient[0] * s.x.scale;
      grad_grid[2 * i + 1] = gradient[1] * s.y.scale;
    }
  }
}

template <typename T>
static void scatter_band(const SampleBevArgs<T>& a, const SampleBevOrder& order, const SampleBevBand<T>& band,
                         bool along_direction, T* grad_bev, T* grad_grid) {
  if (grad_grid) {
    scatter_band_items<true>(a, order, band, along_direction, grad_bev, grad_grid);
  } else {
    scatter_band_items<false>(a, order, band, along_direction, grad_bev, grad_grid);
  }
}

template <typename T>
static void backward_grid(const SampleBevArgs<T>& a, T* grad_grid, int64_t begin, int64_t end) {
  const int64_t map_size = a.height * a.width * a.channels;
  for (int64_t i = begin; i < end; ++i) {
    const auto s = bilinear_stencil(a.grid + 2 * i, a.height, a.width, a.border, a.align_corners);
    const T* map = a.bev + i / a.num_samples * map_size;
    const auto p = corners(map, s, a.width, a.channels);
    T dots[4], gradient[2] = {T(0), T(0)};
    if (p.any) {
      corner_dots(p, a.grad + i * a.channels, a.channels, dots);
      bilinear_gradient(s, dots, gradient);
    }
    grad_grid[2 * i] = gradient[0] * s.x.scale;
    grad_grid[2 * i + 1] = gradient[1] * s.y.scale;
  }
}

template <typename T>
static void double_backward(const SampleBevArgs<T>& a, T* grad_out, T* grad_grid, int64_t begin, int64_t end) {
  const int64_t map_size = a.height * a.width * a.channels;
  const T no_direction[2] = {T(0), T(0)};
  for (int64_t i = begin; i < end; ++i) {
    const auto s = bilinear_stencil(a.grid + 2 * i, a.height, a.width, a.border, a.align_corners);
    const int64_t offset = i / a.num_samples * map_size;
    const T* direction = a.grad_grad_grid ? a.grad_grad_grid + 2 * i : no_direction;
    const auto p = corners(a.bev + offset, s, a.width, a.channels);
    const auto u = corners((a.grad_grad_bev ? a.grad_grad_bev : a.bev) + offset, s, a.width, a.channels);
    if (grad_out) {
      T* out = grad_out + i * a.channels;
      T weight[4], slope[4];
      bilinear_directional(s, direction, slope);
      blend<false>(p, slope, a.channels, out);
      if (a.grad_grad_bev) {
        bilinear_weights(s, weight);
        blend<true>(u, weight, a.channels, out);
      }
    }
    if (grad_grid) {
      const T* grad = a.grad + i * a.channels;
      T dots[4], gradient[2] = {T(0), T(0)};
      if (p.any && a.grad_grad_bev) {
        corner_dots(u, grad, a.channels, dots);
        bilinear_gradient(s, dots, gradient);
      }
      if (p.any && a.grad_grad_grid) {
        corner_dots(p, grad, a.channels, dots);
        const T mixed = dots[0] - dots[1] - dots[2] + dots[3];
        gradient[0] += mixed * direction[1] * s.y.scale;
        gradient[1] += mixed * direction[0] * s.x.scale;
      }
      grad_grid[2 * i] = gradient[0] * s.x.scale;
      grad_grid[2 * i + 1] = gradient[1] * s.y.scale;
    }
  }
}

}  // namespace

const SampleBevKernels<float> sample_bev_f32 = {forward<float>, pack<float>, scatter_band<float>, backward_grid<float>,
                                                double_backward<float>};
const SampleBevKernels<double> sample_bev_f64 = {forward<double>, pack<double>, scatter_band<double>,
                                                 backward_grid<double>, double_backward<double>};

}  // namespace pred::PRED_ISA
