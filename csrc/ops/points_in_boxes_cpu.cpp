// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one tile of points and their results.
#include "ops/points_in_boxes.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kTilePoints = 64;

struct Tile {
  double x[kTilePoints], y[kTilePoints], z[kTilePoints];  // NaN behind the last point
  double low[3], high[3];                                 // of the numbers that are not NaN
};

template <typename T>
static inline void read_tile(const T* points, int64_t count, Tile& tile) {
  const double nan = __builtin_nan("");
  double* axes[3] = {tile.x, tile.y, tile.z};
  for (int axis = 0; axis < 3; ++axis) {
    double* __restrict values = axes[axis];
    for (int64_t i = 0; i < count; ++i) values[i] = double(points[3 * i + axis]);
    for (int64_t i = count; i < kTilePoints; ++i) values[i] = nan;
    double low[kBoxLanes], high[kBoxLanes];
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) low[lane] = __builtin_inf(), high[lane] = -__builtin_inf();
    for (int64_t i = 0; i < kTilePoints; i += kBoxLanes) {
      for (int64_t lane = 0; lane < kBoxLanes; ++lane) {
        low[lane] = values[i + lane] < low[lane] ? values[i + lane] : low[lane];
        high[lane] = values[i + lane] > high[lane] ? values[i + lane] : high[lane];
      }
    }
    tile.low[axis] = low[0], tile.high[axis] = high[0];
    for (int64_t lane = 1; lane < kBoxLanes; ++lane) {
      tile.low[axis] = lesser(tile.low[axis], low[lane]);
      tile.high[axis] = greater(tile.high[axis], high[lane]);
    }
  }
}

// Whether the box may hold a point of the tile; the margin is larger than the roundings of `contains`. False for what
// is no box.
static inline bool is_near(const Box& box, const Tile& tile) {
  const double cos = __builtin_fabs(box.cos), sin = __builtin_fabs(box.sin), margin = 1e-12 * box.reach;
  const double extent_x = cos * box.half_length + sin * box.half_width + margin;
  const double extent_y = sin * box.half_length + cos * box.half_width + margin;
  return (tile.low[0] - box.x <= extent_x) & (box.x - tile.high[0] <= extent_x) & (tile.low[1] - box.y <= extent_y) &
         (box.y - tile.high[1] <= extent_y) & (tile.low[2] - box.z <= box.half_height) &
         (box.z - tile.high[2] <= box.half_height);
}

template <typename T>
static void first(const BoxTable& boxes, int64_t first_box, int64_t last_box, const T* points, int64_t* out,
                  int64_t begin, int64_t end) {
  for (; begin < end; begin += kTilePoints) {
    const int64_t count = end - begin < kTilePoints ? end - begin : kTilePoints;
    Tile tile;
    read_tile(points + 3 * begin, count, tile);
    int64_t found[kTilePoints];
    for (int64_t i = 0; i < kTilePoints; ++i) found[i] = -1;
    for (int64_t b = last_box - 1; b >= first_box; --b) {  // the first one is the last to write
      const Box box = box_at(boxes, b);
      if (!is_near(box, tile)) continue;
      for (int64_t i = 0; i < kTilePoints; ++i)
        found[i] = contains(box, tile.x[i], tile.y[i], tile.z[i]) ? b : found[i];
    }
    for (int64_t i = 0; i < count; ++i) out[begin + i] = found[i];
  }
}

template <typename T>
static void mask(const BoxTable& boxes, const T* points, int64_t num_points, uint8_t* mask, int64_t begin,
                 int64_t end) {
  for (; begin < end; begin += kTilePoints) {
    const int64_t count = end - begin < kTilePoints ? end - begin : kTilePoints;
    Tile tile;
    read_tile(points + 3 * begin, count, tile);
    for (int64_t b = 0; b < boxes.count; ++b) {
      uint8_t* __restrict row = mask + b * num_points + begin;
      const Box box = box_at(boxes, b);
      uint8_t inside[kTilePoints] = {};
      if (is_near(box, tile)) {
        for (int64_t i = 0; i < kTilePoints; ++i) inside[i] = contains(box, tile.x[i], tile.y[i], tile.z[i]);
      }
      __builtin_memcpy(row, inside, uint64_t(count));
    }
  }
}

}  // namespace

const PointsInBoxesKernels<float> points_in_boxes_f32 = {first<float>, mask<float>};
const PointsInBoxesKernels<double> points_in_boxes_f64 = {first<double>, mask<double>};

}  // namespace pred::PRED_ISA
