// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounding boxes in levels over the points of one frame, for exact searches that skip what is too far away.
//
// Points are stored in leaves of 32 that lie together in space; 16 leaves form a group of level 0, 16 groups of one
// level a group of the next, up to one root group. A group holds the boxes of its children side by side, so that one
// vector loop tests all of them.
//
// A distance to a box never exceeds the distances to the points inside: both are sums of squared differences in the
// same order, and rounding is monotone. Skipping a box therefore never changes a result, not by a bit, provided that
// products and sums are not contracted (-ffp-contract=off).
#pragma once

#include "common/host_device.h"

namespace pred {

constexpr int64_t kTreeFan = 16, kLeafPoints = 32;
constexpr int kTreeLevels = 7;  // enough for 2^31 points
constexpr int32_t kNoRow = 0x7fffffff;

template <typename T>
struct PointTree {
  int64_t num_points;   // finite ones
  int num_levels;       // 0: no points
  const T* points;      // [leaves, 3, 32], NaN where a leaf has fewer
  const int32_t* rows;  // [leaves, 32], rows of the batch, kNoRow where a leaf has fewer
  struct Level {
    const T* boxes;             // [groups, 6, 16]: lower x, y, z, upper x, y, z; (inf, -inf) where there is no child
    const int32_t* first_rows;  // [groups, 16]: the smallest row below a child, else kNoRow
  } levels[kTreeLevels];
};

template <typename T>
PRED_HOST_DEVICE T squared_length(T dx, T dy, T dz) {
  return (dx * dx + dy * dy) + dz * dz;
}

// To the points of a leaf; NaN where it has fewer.
template <typename T>
PRED_HOST_DEVICE void leaf_distances(const PointTree<T>& tree, int64_t leaf, const T position[3], T* __restrict out) {
  const T* __restrict points = tree.points + leaf * 3 * kLeafPoints;
  const T x = position[0], y = position[1], z = position[2];
  for (int64_t i = 0; i < kLeafPoints; ++i) {
    const T dx = points[i] - x, dy = points[kLeafPoints + i] - y, dz = points[2 * kLeafPoints + i] - z;
    out[i] = squared_length(dx, dy, dz);
  }
}

template <typename T>
PRED_HOST_DEVICE T gap(T low, T high, T value) {
  const T below = low - value, above = value - high;
  const T outside = below > above ? below : above;
  return outside > T(0) ? outside : T(0);
}

// To the boxes of a group's children; infinite where there is no child.
template <typename T>
PRED_HOST_DEVICE void box_distances(const PointTree<T>& tree, int level, int64_t group, const T position[3],
                                    T* __restrict out) {
  const T* __restrict boxes = tree.levels[level].boxes + group * 6 * kTreeFan;
  const T x = position[0], y = position[1], z = position[2];
  for (int64_t c = 0; c < kTreeFan; ++c) {
    const T dx = gap(boxes[c], boxes[3 * kTreeFan + c], x);
    const T dy = gap(boxes[kTreeFan + c], boxes[4 * kTreeFan + c], y);
    const T dz = gap(boxes[2 * kTreeFan + c], boxes[5 * kTreeFan + c], z);
    out[c] = squared_length(dx, dy, dz);
  }
}

template <typename T>
PRED_HOST_DEVICE bool is_finite(const T position[3]) {  // v - v is 0 or NaN
  const T sum = (position[0] - position[0]) + (position[1] - position[1]) + (position[2] - position[2]);
  return sum == T(0);
}

}  // namespace pred
