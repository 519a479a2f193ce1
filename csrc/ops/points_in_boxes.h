// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// points_in_boxes, points_in_boxes_mask: which points lie in which boxes (math/rotated_box.h).
//
// On the CPU points are taken in tiles of a few that follow each other, as a scanner's firings do. A box that lies
// apart from the bounds of a tile is skipped.
#pragma once

#include "common/isa.h"
#include "math/rotated_box.h"

namespace pred {

#ifdef PRED_LAUNCH
// Frame f owns the points from point_offsets[f] on, and the boxes from box_offsets[f] on. Null: one frame.
struct BoxFrames {
  const int64_t *point_offsets, *box_offsets;  // [count + 1]
  int64_t count;
};

template <typename T>
struct PointsInBoxesKernels {
  // points: [N, 3]; out: [N], the first box or -1.
  void (*first)(const BoxTable& boxes, const BoxFrames& frames, const T* points, int64_t num_points, int64_t* out);
  // mask: [M, N], 0 or 1.
  void (*mask)(const BoxTable& boxes, const T* points, int64_t num_points, uint8_t* mask);
};
#else
template <typename T>
struct PointsInBoxesKernels {
  // Points [begin, end) and boxes [first_box, last_box) of one frame. points: [N, 3]; out: [N], the first box or -1.
  void (*first)(const BoxTable& boxes, int64_t first_box, int64_t last_box, const T* points, int64_t* out,
                int64_t begin, int64_t end);
  // mask: [M, N], 0 or 1.
  void (*mask)(const BoxTable& boxes, const T* points, int64_t num_points, uint8_t* mask, int64_t begin, int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(PointsInBoxesKernels<float>, points_in_boxes_f32)
PRED_DECLARE_KERNELS(PointsInBoxesKernels<double>, points_in_boxes_f64)
