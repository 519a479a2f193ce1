// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Upright boxes (x, y, z, length, width, height, yaw): which points lie in one, and what two of them share. All in
// float64, whatever the boxes are stored in, and relative to one box's centre, so that far away or huge boxes lose
// nothing. A row with a NaN, an infinity or a negative size is no box: it has NaN in place of x and shares nothing.
#pragma once

#include "common/host_device.h"
#include "math/sine_cosine.h"

namespace pred {

struct Box {
  double x, y, z;  // of the centre
  double half_length, half_width, half_height;
  double cos, sin;  // of the yaw
  double reach;     // of a circle around it, seen from above
};

// Boxes as columns, so that loops over them become vectors. The last group is filled up with rows that are no box.
constexpr int64_t kBoxLanes = 8;
constexpr int64_t kBoxColumns = 9;

struct BoxTable {
  double* columns;  // [kBoxColumns, stride]
  int64_t stride;   // a multiple of kBoxLanes
  int64_t count;

  static int64_t stride_of(int64_t count) { return (count + kBoxLanes - 1) / kBoxLanes * kBoxLanes; }
};

PRED_HOST_DEVICE Box box_at(const BoxTable& table, int64_t row) {
  const double* at = table.columns + row;
  const int64_t s = table.stride;
  return {at[0], at[s], at[2 * s], at[3 * s], at[4 * s], at[5 * s], at[6 * s], at[7 * s], at[8 * s]};
}

PRED_HOST_DEVICE void put_box(const BoxTable& table, int64_t row, const Box& box) {
  double* at = table.columns + row;
  const double values[kBoxColumns] = {box.x,           box.y,   box.z,   box.half_length, box.half_width,
                                      box.half_height, box.cos, box.sin, box.reach};
  for (int64_t column = 0; column < kBoxColumns; ++column) at[column * table.stride] = values[column];
}

template <typename T>
PRED_HOST_DEVICE bool is_box(const T row[7]) {  // v - v is 0 or NaN
  T sum = 0;
  for (int i = 0; i < 7; ++i) sum += row[i] - row[i];
  return sum == T(0) && row[3] >= T(0) && row[4] >= T(0) && row[5] >= T(0);
}

PRED_HOST_DEVICE Box no_box() {
  Box box{};
  box.x = __builtin_nan("");
  return box;
}

PRED_HOST_DEVICE double lesser(double a, double b) { return a < b ? a : b; }
PRED_HOST_DEVICE double greater(double a, double b) { return a > b ? a : b; }

// The same bits on every machine, but for a yaw of 2^20 and more: that is left to the library.
template <typename T>
PRED_HOST_DEVICE Box read_box(const T row[7]) {
  if (!is_box(row)) return no_box();
  const double half_length = double(row[3]) / 2, half_width = double(row[4]) / 2, yaw = double(row[6]);
  const bool is_usual = __builtin_fabs(yaw) < 0x1p20;
  const SineCosine turn = is_usual ? sine_cosine(yaw) : SineCosine{__builtin_sin(yaw), __builtin_cos(yaw)};
  const double longer = greater(half_length, half_width), ratio = lesser(half_length, half_width) / longer;
  const double reach = longer > 0 ? longer * __builtin_sqrt(1 + ratio * ratio) : 0;
  return {double(row[0]),     double(row[1]), double(row[2]), half_length, half_width,
          double(row[5]) / 2, turn.cosine,    turn.sine,      reach};
}

// Faces belong to the box. False for a point or a box that is not finite.
PRED_HOST_DEVICE bool contains(const Box& box, double x, double y, double z) {
  const double dx = x - box.x, dy = y - box.y, dz = z - box.z;
  const double along = dx * box.cos + dy * box.sin, across = dy * box.cos - dx * box.sin;
  return (__builtin_fabs(along) <= box.half_length) & (__builtin_fabs(across) <= box.half_width) &
         (__builtin_fabs(dz) <= box.half_height);
}

// Whether the circles around two boxes meet, seen from above, with a margin for roundings; true where numbers overflow.
PRED_HOST_DEVICE bool is_near(const Box& a, const Box& b) {
  const double dx = b.x - a.x, dy = b.y - a.y, reach = a.reach + b.reach;
  return dx * dx + dy * dy <= reach * reach * (1 + 1e-12);
}

// Between 0 and 1; 0 for NaN.
PRED_HOST_DEVICE double share(double value) {
  value = value > 0 ? value : 0;
  return value < 1 ? value : 1;
}

struct Rectangle {
  double x_low, x_high, y_low, y_high;
};

// The integral of x dy along the edge from (x0, y0) to (x1, y1) after every point has moved to the nearest one of the
// rectangle. Above and below it y stands still; of the rest, the parts left and right of it run along its sides.
PRED_HOST_DEVICE double clamped_edge(const Rectangle& r, double x0, double y0, double x1, double y1) {
  const double rise = y1 - y0;
  const double y_from = lesser(greater(y0, r.y_low), r.y_high), y_to = lesser(greater(y1, r.y_low), r.y_high);
  const double x_from = x0 + share((y_from - y0) / rise) * (x1 - x0);
  const double x_to = x0 + share((y_to - y0) / rise) * (x1 - x0);
  const double run = x_to - x_from;
  const double to_low = share((r.x_low - x_from) / run), to_high = share((r.x_high - x_from) / run);
  const double first = lesser(to_low, to_high), last = greater(to_low, to_high);
  const double from = lesser(greater(x_from, r.x_low), r.x_high), to = lesser(greater(x_to, r.x_low), r.x_high);
  return (y_to - y_from) * (from * first + (from + to) / 2 * (last - first) + to * (1 - last));
}

// Area that two boxes share seen from above, by Green's theorem. The map that moves every point to the nearest one of
// a rectangle keeps the area inside of it and leaves none outside; so what is sought is the area that the outline of
// one box encloses after the map to the other. There is no case of touching, nested or equal boxes to tell apart.
// The outline is that of the smaller box, around its own centre, so that roundings are those of its size.
PRED_HOST_DEVICE double shared_area(const Box& a, const Box& b) {
  const double dx = b.x - a.x, dy = b.y - a.y;
  const double cos = a.cos * b.cos + a.sin * b.sin, sin = b.sin * a.cos - b.cos * a.sin;  // of b's yaw less a's
  const double cos_size = __builtin_fabs(cos), sin_size = __builtin_fabs(sin);
  // The centre of b in the frame of a, and that of a, with its sign changed, in the frame of b.
  const double in_a_x = dx * a.cos + dy * a.sin, in_a_y = dy * a.cos - dx * a.sin;
  const double in_b_x = dx * b.cos + dy * b.sin, in_b_y = dy * b.cos - dx * b.sin;
  // Convex shapes are apart if their shadows on the direction of some side are; boxes that touch are.
  const bool meet = (__builtin_fabs(in_a_x) < a.half_length + (cos_size * b.half_length + sin_size * b.half_width)) &
                    (__builtin_fabs(in_a_y) < a.half_width + (sin_size * b.half_length + cos_size * b.half_width)) &
                    (__builtin_fabs(in_b_x) < b.half_length + (cos_size * a.half_length + sin_size * a.half_width)) &
                    (__builtin_fabs(in_b_y) < b.half_width + (sin_size * a.half_length + cos_size * a.half_width));
  const bool b_is_smaller = b.reach < a.reach;
  const double length = b_is_smaller ? b.half_length : a.half_length;
  const double width = b_is_smaller ? b.half_width : a.half_width;
  const double around_length = b_is_smaller ? a.half_length : b.half_length;
  const double around_width = b_is_smaller ? a.half_width : b.half_width;
  const double turn_sin = b_is_smaller ? sin : -sin;
  const double x = b_is_smaller ? in_a_x : -in_b_x, y = b_is_smaller ? in_a_y : -in_b_y;
  const Rectangle around{-around_length - x, around_length - x, -around_width - y, around_width - y};
  // Corners 2 and 3 lie opposite of 0 and 1.
  const double ux = length * cos, uy = length * turn_sin, vx = -width * turn_sin, vy = width * cos;
  const double x0 = ux + vx, y0 = uy + vy, x1 = vx - ux, y1 = vy - uy;
  const double area = (clamped_edge(around, x0, y0, x1, y1) + clamped_edge(around, -x0, -y0, -x1, -y1)) +
                      (clamped_edge(around, x1, y1, -x0, -y0) + clamped_edge(around, -x1, -y1, x0, y0));
  const double most = 4 * lesser(a.half_length * a.half_width, b.half_length * b.half_width);
  return meet ? lesser(greater(area, 0), most) : 0;
}

// Height that two boxes share.
PRED_HOST_DEVICE double shared_height(const Box& a, const Box& b) {
  const double dz = b.z - a.z;
  const double top = lesser(a.half_height, dz + b.half_height), bottom = greater(-a.half_height, dz - b.half_height);
  return lesser(greater(top - bottom, 0), 2 * lesser(a.half_height, b.half_height));
}

PRED_HOST_DEVICE double over_union(double shared, double size_a, double size_b) {
  const double all = size_a + size_b - shared;
  return (shared > 0) & (all <= __DBL_MAX__) ? shared / all : 0;
}

// 0 where nothing is shared or a box has no area, or where an area is beyond float64.
PRED_HOST_DEVICE double iou_bev(const Box& a, const Box& b) {
  return over_union(shared_area(a, b), 4 * a.half_length * a.half_width, 4 * b.half_length * b.half_width);
}

PRED_HOST_DEVICE double iou_3d(const Box& a, const Box& b) {
  return over_union(shared_area(a, b) * shared_height(a, b), 8 * a.half_length * a.half_width * a.half_height,
                    8 * b.half_length * b.half_width * b.half_height);
}

}  // namespace pred
