// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// ball_query: the points of a query's frame with |p - q|^2 < radius^2, at most so many, lowest rows first.
//
// On the CPU, boxes of the frame's tree (ops/point_tree.h) are skipped if they are too far away, or if the smallest row
// among their points is larger than the largest of a full list, which a heap holds in the output row.
#pragma once

#include "common/isa.h"
#include "ops/point_search.h"
#include "ops/point_tree.h"

namespace pred {

#ifdef PRED_LAUNCH
template <typename T>
struct BallQueryKernels {
  // index: [M, max_points]; counts: [M].
  void (*search)(const PointSearch<T>&, T squared_radius, int64_t max_points, int64_t* index, int64_t* counts);
};
#else
template <typename T>
struct BallQueryKernels {
  // Queries [begin, end) of one frame. queries: [M, 3]; index: [M, max_points]; counts: [M].
  void (*search)(const PointTree<T>&, const T* queries, T squared_radius, int64_t max_points, int64_t* index,
                 int64_t* counts, int64_t begin, int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(BallQueryKernels<float>, ball_query_f32)
PRED_DECLARE_KERNELS(BallQueryKernels<double>, ball_query_f64)
