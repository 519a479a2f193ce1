// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// knn: the k points of a query's frame with the smallest squared distances, lowest row first among equal ones.
//
// On the CPU, boxes of the frame's tree (ops/point_tree.h) are visited in the order of their distances and as long as
// they may hold something better than the worst of the k best so far, which a heap holds in the output rows.
#pragma once

#include "common/isa.h"
#include "ops/point_search.h"
#include "ops/point_tree.h"

namespace pred {

#ifdef PRED_LAUNCH
template <typename T>
struct KnnKernels {
  // index and distance: [M, k].
  void (*search)(const PointSearch<T>&, int64_t k, int64_t* index, T* distance);
};
#else
template <typename T>
struct KnnKernels {
  // Queries [begin, end) of one frame. queries: [M, 3]; index and distance: [M, k].
  void (*search)(const PointTree<T>&, const T* queries, int64_t k, int64_t* index, T* distance, int64_t begin,
                 int64_t end);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(KnnKernels<float>, knn_f32)
PRED_DECLARE_KERNELS(KnnKernels<double>, knn_f64)
