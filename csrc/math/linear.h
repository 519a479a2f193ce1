// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Linear interpolation on a regular grid of any number of axes (2 bilinear, 3 trilinear), with F.grid_sample's
// conventions. Axis 0 is x. Corner k of a stencil is the higher cell along axis a where bit a of k is set.
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

template <typename T, int Axes>
struct LinearStencil {
  LinearAxis<T> axis[Axes];
};

template <int Axes, typename T>
PRED_HOST_DEVICE LinearStencil<T, Axes> linear_stencil(const T* position, const int64_t* size, bool border,
                                                       bool align_corners) {
  LinearStencil<T, Axes> s;
  for (int a = 0; a < Axes; ++a) s.axis[a] = linear_axis(position[a], size[a], border, align_corners);
  return s;
}

template <typename T, int Axes>
PRED_HOST_DEVICE bool linear_inside(const LinearStencil<T, Axes>& s, int corner) {
  bool inside = true;
  for (int a = 0; a < Axes; ++a) inside = inside && (corner >> a & 1 ? s.axis[a].high_inside : s.axis[a].low_inside);
  return inside;
}

// The weights' mixed derivative by the normalised coordinates of all axes whose bits are set in `by`: 0 gives the
// weights, 1 << a their slopes along axis a. (They are linear along each axis, so that there are no others.)
template <typename T, int Axes>
PRED_HOST_DEVICE void linear_weights(const LinearStencil<T, Axes>& s, int by, T weight[1 << Axes]) {
  weight[0] = T(1);
  for (int a = 0; a < Axes; ++a) {
    const bool derived = by >> a & 1;
    const T low = derived ? -s.axis[a].scale : T(1) - s.axis[a].frac;
    const T high = derived ? s.axis[a].scale : s.axis[a].frac;
    for (int k = 0; k < 1 << a; ++k) {
      weight[k | 1 << a] = weight[k] * high;
      weight[k] *= low;
    }
  }
}

// The weights' derivative along a direction given in normalised coordinates.
template <typename T, int Axes>
PRED_HOST_DEVICE void linear_directional(const LinearStencil<T, Axes>& s, const T* direction, T slope[1 << Axes]) {
  for (int k = 0; k < 1 << Axes; ++k) slope[k] = T(0);
  for (int a = 0; a < Axes; ++a) {
    T along[1 << Axes];
    linear_weights(s, 1 << a, along);
    for (int k = 0; k < 1 << Axes; ++k) slope[k] += direction[a] * along[k];
  }
}

// The mixed derivative (`by` as above) of the interpolation of one value per corner.
template <typename T, int Axes>
PRED_HOST_DEVICE T linear_interpolate(const LinearStencil<T, Axes>& s, int by, const T corner[1 << Axes]) {
  T weight[1 << Axes], sum = T(0);
  linear_weights(s, by, weight);
  for (int k = 0; k < 1 << Axes; ++k) sum += weight[k] * corner[k];
  return sum;
}

}  // namespace pred
