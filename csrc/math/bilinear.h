// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Bilinear interpolation on a regular grid with F.grid_sample's conventions.
#pragma once

#include "common/host_device.h"

namespace pred {

// One axis of a sample: the cells `low` and `low + 1` with weights 1 - frac and frac.
template <typename T>
struct LinearAxis {
  int64_t low;
  T frac;
  T scale;  // d(position in cells) / d(normalised coordinate); 0 where border padding clips
  bool low_inside;
  bool high_inside;
};

// coordinate in [-1, 1] -> axis. NaN gives frac = NaN and no cell inside, so that it is read as NaN
// and written nowhere.
template <typename T>
PRED_HOST_DEVICE LinearAxis<T> linear_axis(T coordinate, int64_t size, bool border, bool align_corners) {
  LinearAxis<T> axis;
  T cell;
  if (align_corners) {
    axis.scale = T(0.5) * T(size - 1);
    cell = (coordinate + T(1)) * axis.scale;
  } else {
    axis.scale = T(0.5) * T(size);
    cell = (coordinate + T(1)) * axis.scale - T(0.5);
  }
  const T last = T(size - 1);
  if (border) {
    if (cell <= T(0)) {
      cell = T(0);
      axis.scale = T(0);
    }
    if (cell >= last) {
      cell = last;
      axis.scale = T(0);
    }
  } else {
    // Far outside nothing is read: keep the conversion to int64 defined.
    if (cell < T(-2)) cell = T(-2);
    if (cell > last + T(2)) cell = last + T(2);
  }
  const bool finite = cell == cell;
  // Truncation and a correction, since floor() is a library call at the baseline level. cell >= -2.
  const int64_t low = finite ? int64_t(cell + T(2)) - 2 : 0;
  axis.low = low;
  axis.frac = cell - T(low);
  axis.low_inside = finite && low >= 0 && low < size;
  axis.high_inside = finite && low + 1 >= 0 && low + 1 < size;
  return axis;
}

// Corners in the order (y low, x low), (y low, x high), (y high, x low), (y high, x high).
template <typename T>
struct BilinearStencil {
  LinearAxis<T> x;
  LinearAxis<T> y;
};

template <typename T>
PRED_HOST_DEVICE BilinearStencil<T> bilinear_stencil(const T* grid_xy, int64_t height, int64_t width, bool border,
                                                     bool align_corners) {
  return {linear_axis(grid_xy[0], width, border, align_corners),
          linear_axis(grid_xy[1], height, border, align_corners)};
}

template <typename T>
PRED_HOST_DEVICE void bilinear_weights(const BilinearStencil<T>& s, T weight[4]) {
  weight[0] = (T(1) - s.y.frac) * (T(1) - s.x.frac);
  weight[1] = (T(1) - s.y.frac) * s.x.frac;
  weight[2] = s.y.frac * (T(1) - s.x.frac);
  weight[3] = s.y.frac * s.x.frac;
}

// Derivative of the four weights along a direction given in normalised coordinates.
template <typename T>
PRED_HOST_DEVICE void bilinear_directional(const BilinearStencil<T>& s, const T direction_xy[2], T slope[4]) {
  const T dx = direction_xy[0] * s.x.scale;
  const T dy = direction_xy[1] * s.y.scale;
  slope[0] = -(T(1) - s.y.frac) * dx - (T(1) - s.x.frac) * dy;
  slope[1] = (T(1) - s.y.frac) * dx - s.x.frac * dy;
  slope[2] = -s.y.frac * dx + (T(1) - s.x.frac) * dy;
  slope[3] = s.y.frac * dx + s.x.frac * dy;
}

// d/d(x, y in cells) of sum_k weight[k] * corner[k].
template <typename T>
PRED_HOST_DEVICE void bilinear_gradient(const BilinearStencil<T>& s, const T corner[4], T gradient_xy[2]) {
  gradient_xy[0] = (T(1) - s.y.frac) * (corner[1] - corner[0]) + s.y.frac * (corner[3] - corner[2]);
  gradient_xy[1] = (T(1) - s.x.frac) * (corner[2] - corner[0]) + s.x.frac * (corner[3] - corner[1]);
}

}  // namespace pred
