// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CPU loops of sample_bev and sample_volume, which instantiate sample_grid_kernels<S, Axes>.
//
// One iteration owns one sample (gathers) or one band of cells (scatter). A band adds up its samples in the order of
// their cells, so results do not depend on the number of threads, and a cell's sums stay in cache. A sample that lies
// between two bands is visited by both: each adds to its own cells, and the band of the lower corner, or the one that
// is nearest to it, writes the sample's grid gradient.
#pragma once

#include <type_traits>

#include "math/half_lanes.h"
#include "ops/sample_grid.h"

namespace pred::PRED_ISA {
namespace {

#define PRED_INLINE inline __attribute__((always_inline))

template <typename T>
constexpr int kNarrowWidth = kWidth<T> < 4 ? kWidth<T> : 4;

// Calls body(width, c) for consecutive pieces of [0, channels) of kWidth<T>, then kNarrowWidth<T>, then 1 elements.
template <typename T, class Body>
PRED_INLINE void for_channels(int64_t channels, const Body& body) {
  int64_t c = 0;
  for (; c + kWidth<T> <= channels; c += kWidth<T>) body(std::integral_constant<int, kWidth<T>>(), c);
  if constexpr (kNarrowWidth<T> < kWidth<T>) {
    for (; c + kNarrowWidth<T> <= channels; c += kNarrowWidth<T>) {
      body(std::integral_constant<int, kNarrowWidth<T>>(), c);
    }
  }
  for (; c < channels; ++c) body(std::integral_constant<int, 1>(), c);
}

// The rows of the map between which a sample lies. Outside the map a row of zeros is read.
template <typename S, int Axes>
struct Corners {
  const S* row[1 << Axes];
  bool any;  // of them is inside
};

template <typename S, int Axes>
PRED_INLINE Corners<S, Axes> corners(const S* map, const SampleGridArgs<S, Axes>& a,
                                     const LinearStencil<Compute<S>, Axes>& s) {
  Corners<S, Axes> p;
  p.any = false;
  for (int k = 0; k < 1 << Axes; ++k) {
    int64_t offset = 0;
    for (int axis = 0; axis < Axes; ++axis) offset += (s.axis[axis].low + (k >> axis & 1)) * a.stride[axis];
    const bool inside = linear_inside(s, k);
    p.row[k] = inside ? map + offset : a.zeros;
    p.any = p.any || inside;
  }
  return p;
}

template <typename S, int Axes>
PRED_INLINE LinearStencil<Compute<S>, Axes> stencil(const SampleGridArgs<S, Axes>& a, int64_t sample) {
  return linear_stencil<Axes>(a.grid + sample * Axes, a.size, a.border, a.align_corners);
}

// out_m[c] = sum_r weight[m][r] row_r[c]
template <int Outs, int Rows, typename S>
PRED_INLINE void blend(const S* const (&row)[Rows], const Compute<S> (&weight)[Outs][Rows], int64_t channels,
                       S* const (&out)[Outs]) {
  using T = Compute<S>;
  for_channels<T>(channels, [&](auto width, int64_t c) __attribute__((always_inline)) {
    constexpr int N = decltype(width)::value;
    Vec<T, N> sum[Outs];
    for (int r = 0; r < Rows; ++r) {
      const auto value = load_values<N>(row[r] + c);
      for (int m = 0; m < Outs; ++m) sum[m] = r ? sum[m] + value * weight[m][r] : value * weight[m][r];
    }
    for (int m = 0; m < Outs; ++m) store_values<N>(out[m] + c, sum[m]);
  });
}

// Vectors, as many as divide their width, to one whose lane r, for r < Rows, holds the sum of rows[r]'s lanes, by
// folding pairs of rows. Overwrites rows.
template <typename T, int N, int Rows, int H = 1>
PRED_INLINE Vec<T, N> fold_rows(Vec<T, N>* rows) {
  if constexpr (H < Rows) {
    for (int r = 0; r < Rows / (2 * H); ++r) {
      rows[r] = fold<H, T, N>(rows[2 * r], rows[2 * r + 1], std::make_integer_sequence<int, N>());
    }
    return fold_rows<T, N, Rows, 2 * H>(rows);
  } else if constexpr (H < N) {  // lanes whose numbers differ by a multiple of Rows belong together
    rows[0] += shift_down<H, T, N>(rows[0], rows[0]);
    return fold_rows<T, N, Rows, 2 * H>(rows);
  } else {
    return rows[0];
  }
}

// to[r] = the sum of the lanes of rows[r]. Overwrites rows.
template <typename T, int N, int Rows>
PRED_INLINE void sum_lanes(Vec<T, N>* rows, T* to) {
  if constexpr (Rows > N) {
    sum_lanes<T, N, Rows / 2>(rows, to);
    sum_lanes<T, N, Rows / 2>(rows + Rows / 2, to + Rows / 2);
  } else {
    const auto all = fold_rows<T, N, Rows>(rows);
    for (int r = 0; r < Rows; ++r) to[r] = all[r];
  }
}

// dots[r] = sum_c source[c] row_r[c]
template <int Rows, typename S>
PRED_INLINE void dot_rows(const S* source, const S* const (&row)[Rows], int64_t channels, Compute<S>* dots) {
  using T = Compute<S>;
  constexpr int W = kWidth<T>, H = kNarrowWidth<T>;
  Vec<T, W> wide[Rows] = {};
  Vec<T, H> half[Rows] = {};
  T rest[Rows] = {};
  for_channels<T>(channels, [&](auto width, int64_t c) __attribute__((always_inline)) {
    constexpr int N = decltype(width)::value;
    const auto from = load_values<N>(source + c);
    for (int r = 0; r < Rows; ++r) {
      const auto product = from * load_values<N>(row[r] + c);
      if constexpr (N == W) {
        wide[r] += product;
      } else if constexpr (N == H) {
        half[r] += product;
      } else {
        rest[r] += product;
      }
    }
  });
  sum_lanes<T, W, Rows>(wide, dots);
  if (channels % W >= H) {
    T more[Rows];
    sum_lanes<T, H, Rows>(half, more);
    for (int r = 0; r < Rows; ++r) dots[r] += more[r];
  }
  for (int r = 0; r < Rows; ++r) dots[r] += rest[r];
}

template <int kRows, typename S, int Axes>
PRED_INLINE void gradient_rows(const SampleGridArgs<S, Axes>& a, int64_t sample, const S* (&row)[kRows]) {
  row[0] = a.grad ? a.grad + sample * a.channels : a.zeros;
  if constexpr (kRows == kAlong) {
    row[1] = a.grad_along + sample * a.channels;
  } else {
    for (int m = 1; m < kRows; ++m) row[m] = a.grad_slopes + (sample * Axes + m - 1) * a.channels;
  }
}

// The grid gradient of one sample.
template <int kRows, typename S, int Axes>
PRED_INLINE void grid_gradient(const LinearStencil<Compute<S>, Axes>& s, const Corners<S, Axes>& p,
                               const S* const (&source)[kRows], int64_t channels, Compute<S>* gradient) {
  using T = Compute<S>;
  T dots[kRows][1 << Axes];
  for (int m = 0; m < kRows; ++m) dot_rows(source[m], p.row, channels, dots[m]);
  for (int axis = 0; axis < Axes; ++axis) {
    T sum = linear_interpolate(s, 1 << axis, dots[0]);
    for (int other = 0; other + 1 < kRows; ++other) {
      if (other != axis) sum += linear_interpolate(s, 1 << axis | 1 << other, dots[1 + other]);
    }
    gradient[axis] = sum;
  }
}

template <int kOuts, typename S, int Axes>
void forward_rows(const SampleGridArgs<S, Axes>& a, S* out, S* slopes, int64_t begin, int64_t end) {
  using T = Compute<S>;
  for (int64_t i = begin; i < end; ++i) {
    const auto s = stencil(a, i);
    T weight[kOuts][1 << Axes];
    S* row[kOuts];
    forward_weights<kOuts>(s, weight);
    row[0] = out + i * a.channels;
    for (int m = 1; m < kOuts; ++m) row[m] = slopes + (i * Axes + m - 1) * a.channels;
    blend(corners(a.map + i / a.num_samples * a.stride[Axes], a, s).row, weight, a.channels, row);
  }
}

template <typename S, int Axes>
void forward(const SampleGridArgs<S, Axes>& a, S* out, S* slopes, int64_t begin, int64_t end) {
  if (slopes) {
    forward_rows<1 + Axes>(a, out, slopes, begin, end);
  } else {
    forward_rows<1>(a, out, slopes, begin, end);
  }
}

template <typename S, int Axes>
int64_t pack(const SampleGridArgs<S, Axes>& a, const SampleGridOrder& order, uint64_t* items, int64_t begin,
             int64_t end) {
  int64_t count = 0;
  for (int64_t i = begin; i < end; ++i) {
    const auto s = stencil(a, i);
    bool touches = true;
    for (const auto& axis : s.axis) touches = touches && (axis.low_inside || axis.high_inside);
    if (!touches) continue;
    uint64_t item = uint64_t(i / a.num_samples);
    item = item << order.size_bits[1] | uint64_t(s.axis[1].low + 1);
    if constexpr (Axes == 3) item = item << order.size_bits[2] | uint64_t(s.axis[2].low + 1);
    item = item << order.size_bits[0] | uint64_t(s.axis[0].low + 1);
    items[count++] = item << order.number_bits | uint64_t(i);
  }
  return count;
}

// Samples between the same cells, one after the other in the order of items.
constexpr int kRun = 16;

template <typename S, int Axes, int kRows>
struct Run {
  using T = Compute<S>;
  int size;
  int64_t sample[kRun];
  LinearStencil<T, Axes> stencil[kRun];
  const S* source[kRun][kRows];  // [C] each
  T weight[kRun][kRows][1 << Axes];
};

// cell_k[c] += sum_i sum_m weight[i][m][first + k] source[i][m][c]
template <int kCells, typename S, int Axes, int kRows>
PRED_INLINE void add_run(const Run<S, Axes, kRows>& run, int first, Compute<S>* const (&cell)[kCells],
                         int64_t channels) {
  using T = Compute<S>;
  for_channels<T>(channels, [&](auto width, int64_t c) __attribute__((always_inline)) {
    constexpr int N = decltype(width)::value;
    Vec<T, N> sum[kCells];
    for (int k = 0; k < kCells; ++k) sum[k] = load<N>(cell[k] + c);
    for (int i = 0; i < run.size; ++i) {
      for (int m = 0; m < kRows; ++m) {
        const auto grad = load_values<N>(run.source[i][m] + c);
        for (int k = 0; k < kCells; ++k) sum[k] += grad * run.weight[i][m][first + k];
      }
    }
    for (int k = 0; k < kCells; ++k) store(cell[k] + c, sum[k]);
  });
}

template <int kRows, bool kGrid, typename S, int Axes>
void scatter_items(const SampleGridArgs<S, Axes>& a, const SampleGridOrder& order, const SampleGridBand<S>& band,
                   bool along_direction, S* grad_map, Compute<S>* grad_grid) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  constexpr int64_t kAhead = 8, kLineBytes = 64;
  const uint64_t number_mask = (uint64_t(1) << order.number_bits) - 1;
  const int64_t row = a.stride[1], band_rows = band.end - band.begin, depth = Axes == 3 ? a.size[Axes - 1] : 1;
  // Where the band's sums are: cell (x, y, z) at sums + x C + y row + z layer.
  T* sums;
  int64_t layer;
  if constexpr (std::is_same_v<S, T>) {
    sums = grad_map + band.map * a.stride[Axes];
    layer = a.stride[Axes - 1];
  } else {
    sums = band.sums - band.begin * row;
    layer = band_rows * row;
  }
  for (int64_t z = 0; z < depth; ++z) {
    T* from = sums + z * layer + band.begin * row;
    for (int64_t i = 0; i < band_rows * row; ++i) from[i] = T(0);
  }
  for (int64_t j = band.first_item; j < band.last_item;) {
    Run<S, Axes, kRows> run;
    const uint64_t key = order.items[j] >> order.number_bits;
    for (run.size = 0; run.size < kRun && j < band.last_item && order.items[j] >> order.number_bits == key; ++j) {
      if (j + kAhead < band.last_item) {  // gradients are visited in the order of cells, not of memory
        const S* next[kRows];
        gradient_rows(a, int64_t(order.items[j + kAhead] & number_mask), next);
        for (const S* from : next) {
          for (int64_t c = 0; c < a.channels; c += kLineBytes / int64_t(sizeof(S))) __builtin_prefetch(from + c);
        }
      }
      const int i = run.size++;
      const int64_t sample = int64_t(order.items[j] & number_mask);
      run.sample[i] = sample;
      run.stencil[i] = stencil(a, sample);
      gradient_rows(a, sample, run.source[i]);
      if (along_direction) {
        linear_directional(run.stencil[i], a.grad_grad_grid + sample * Axes, run.weight[i][0]);
      } else {
        linear_weights(run.stencil[i], 0, run.weight[i][0]);
      }
      if constexpr (kRows == kAlong) {
        linear_directional(run.stencil[i], a.grad_grad_grid + sample * Axes, run.weight[i][1]);
      } else {
        for (int m = 1; m < kRows; ++m) linear_weights(run.stencil[i], 1 << (m - 1), run.weight[i][m]);
      }
    }

    const auto& s = run.stencil[0];
    T* cell[kCorners];
    bool all = true;
    for (int k = 0; k < kCorners; ++k) {
      const int64_t x = s.axis[0].low + (k & 1), y = s.axis[1].low + (k >> 1 & 1);
      const int64_t z = Axes == 3 ? s.axis[Axes - 1].low + (k >> 2) : 0;
      const bool own = linear_inside(s, k) && y >= band.begin && y < band.end;
      cell[k] = own ? sums + x * a.channels + y * row + z * layer : nullptr;
      all = all && own;
    }
    if (all) {
      add_run(run, 0, cell, a.channels);
    } else {
      for (int k = 0; k < kCorners; ++k) {
        if (cell[k] != nullptr) add_run<1>(run, k, {cell[k]}, a.channels);
      }
    }
    if (kGrid && (s.axis[1].low >= band.begin || band.begin == 0)) {
      const auto p = corners(a.map + band.map * a.stride[Axes], a, s);
      for (int i = 0; i < run.size; ++i) {
        grid_gradient(run.stencil[i], p, run.source[i], a.channels, grad_grid + run.sample[i] * Axes);
      }
    }
  }
  if constexpr (!std::is_same_v<S, T>) {
    for (int64_t z = 0; z < depth; ++z) {
      const T* from = sums + z * layer + band.begin * row;
      S* to = grad_map + band.map * a.stride[Axes] + z * a.stride[Axes - 1] + band.begin * row;
      for_channels<T>(band_rows * row, [&](auto width, int64_t i) __attribute__((always_inline)) {
        constexpr int N = decltype(width)::value;
        store_values<N>(to + i, load<N>(from + i));
      });
    }
  }
}

template <typename S, int Axes>
void scatter_band(const SampleGridArgs<S, Axes>& a, const SampleGridOrder& order, const SampleGridBand<S>& band,
                  bool along_direction, S* grad_map, Compute<S>* grad_grid) {
  constexpr int kAll = 1 + Axes;
  if (a.grad_along) {
    scatter_items<kAlong, false>(a, order, band, false, grad_map, grad_grid);
  } else if (a.grad_slopes) {
    if (grad_grid) {
      scatter_items<kAll, true>(a, order, band, along_direction, grad_map, grad_grid);
    } else {
      scatter_items<kAll, false>(a, order, band, along_direction, grad_map, grad_grid);
    }
  } else if (grad_grid) {
    scatter_items<1, true>(a, order, band, along_direction, grad_map, grad_grid);
  } else {
    scatter_items<1, false>(a, order, band, along_direction, grad_map, grad_grid);
  }
}

template <int kRows, typename S, int Axes>
void backward_grid_rows(const SampleGridArgs<S, Axes>& a, Compute<S>* grad_grid, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    const auto s = stencil(a, i);
    const auto p = corners(a.map + i / a.num_samples * a.stride[Axes], a, s);
    if (p.any) {
      const S* source[kRows];
      gradient_rows(a, i, source);
      grid_gradient(s, p, source, a.channels, grad_grid + i * Axes);
    } else {
      for (int axis = 0; axis < Axes; ++axis) grad_grid[i * Axes + axis] = 0;
    }
  }
}

template <typename S, int Axes>
void backward_grid(const SampleGridArgs<S, Axes>& a, Compute<S>* grad_grid, int64_t begin, int64_t end) {
  if (a.grad_slopes) {
    backward_grid_rows<1 + Axes>(a, grad_grid, begin, end);
  } else {
    backward_grid_rows<1>(a, grad_grid, begin, end);
  }
}

template <typename S, int Axes>
void double_backward(const SampleGridArgs<S, Axes>& a, S* grad_out, Compute<S>* grad_grid, int64_t begin, int64_t end) {
  using T = Compute<S>;
  constexpr int kCorners = 1 << Axes;
  const T no_direction[Axes] = {};
  for (int64_t i = begin; i < end; ++i) {
    const auto s = stencil(a, i);
    const int64_t offset = i / a.num_samples * a.stride[Axes];
    const T* direction = a.grad_grad_grid ? a.grad_grad_grid + i * Axes : no_direction;
    const auto p = corners(a.map + offset, a, s);
    const auto u = corners((a.grad_grad_map ? a.grad_grad_map : a.map) + offset, a, s);
    if (grad_out) {
      S* const out[1] = {grad_out + i * a.channels};
      if (a.grad_grad_map) {
        const S* row[2 * kCorners];
        T weight[1][2 * kCorners];
        linear_directional(s, direction, weight[0]);
        linear_weights(s, 0, weight[0] + kCorners);
        for (int k = 0; k < kCorners; ++k) {
          row[k] = p.row[k];
          row[kCorners + k] = u.row[k];
        }
        blend(row, weight, a.channels, out);
      } else {
        T weight[1][kCorners];
        linear_directional(s, direction, weight[0]);
        blend(p.row, weight, a.channels, out);
      }
    }
    if (grad_grid) {
      const S* grad = a.grad + i * a.channels;
      T dots[kCorners], gradient[Axes] = {};
      if (p.any && a.grad_grad_map) {
        dot_rows(grad, u.row, a.channels, dots);
        for (int axis = 0; axis < Axes; ++axis) gradient[axis] = linear_interpolate(s, 1 << axis, dots);
      }
      if (p.any && a.grad_grad_grid) {
        dot_rows(grad, p.row, a.channels, dots);
        for (int axis = 1; axis < Axes; ++axis) {
          for (int other = 0; other < axis; ++other) {
            const T mixed = linear_interpolate(s, 1 << axis | 1 << other, dots);
            gradient[axis] += mixed * direction[other];
            gradient[other] += mixed * direction[axis];
          }
        }
      }
      for (int axis = 0; axis < Axes; ++axis) grad_grid[i * Axes + axis] = gradient[axis];
    }
  }
}

template <typename S, int Axes>
constexpr SampleGridKernels<S, Axes> sample_grid_kernels() {
  return {
      forward<S, Axes>, pack<S, Axes>, scatter_band<S, Axes>, backward_grid<S, Axes>, double_backward<S, Axes>, nullptr,
      nullptr,          nullptr};
}

#undef PRED_INLINE

}  // namespace
}  // namespace pred::PRED_ISA
