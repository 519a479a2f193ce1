// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Checked arguments of the bindings that search points around queries.
#pragma once

#include "ops/point_forest.h"
#include "ops/point_search.h"

namespace pred {

struct PointQueries {
  Tensor points, queries;               // [N, 3], or [3, N] for kernels that are launched, and [M, 3], contiguous
  Tensor batch_offsets, query_offsets;  // [B + 1], contiguous

  PointQueries(const char* op, const Tensor& points_in, const Tensor& batch_offsets_in, const Tensor& queries_in,
               const Tensor& query_offsets_in) {
    check_tensor(op, "points", points_in, 2, points_in.scalar_type());
    check_tensor(op, "queries", queries_in, 2, points_in.scalar_type());
    PRED_CHECK(points_in.size(1) == 3, op, ": points must have shape [N, 3], got ", shape_text(points_in));
    PRED_CHECK(queries_in.size(1) == 3, op, ": queries must have shape [M, 3], got ", shape_text(queries_in));
    points = torch::stable::contiguous(kLaunch ? torch::stable::transpose(points_in, 0, 1) : points_in);
    queries = torch::stable::contiguous(queries_in);
    batch_offsets = frame_offsets(op, "batch_offsets", batch_offsets_in, 'N', points_in.size(0));
    query_offsets = frame_offsets(op, "query_offsets", query_offsets_in, 'M', queries.size(0));
    check_sizes(op, "query_offsets", query_offsets, {batch_offsets.size(0)});
  }

  int64_t num_queries() const { return queries.size(0); }

#ifdef PRED_LAUNCH
  template <typename T>
  PointSearch<T> search() const {
    return {points.const_data_ptr<T>(),
            queries.const_data_ptr<T>(),
            {batch_offsets.const_data_ptr<int64_t>(), batch_offsets.size(0) - 1, points.size(1)},
            query_offsets.const_data_ptr<int64_t>(),
            num_queries()};
  }
#else
  // Calls body(tree, begin, end) for ranges of queries of one frame each.
  template <typename T, class Body>
  void search(const Body& body) const {
    const int64_t num_frames = batch_offsets.size(0) - 1;
    const PointForest<T> forest(points.const_data_ptr<T>(), batch_offsets.const_data_ptr<int64_t>(), num_frames);
    parallel(num_queries(), 64, [&](int64_t begin, int64_t end) {
      for_each_frame(query_offsets.const_data_ptr<int64_t>(), num_frames, begin, end,
                     [&](int64_t frame, int64_t first, int64_t last) { body(forest[frame], first, last); });
    });
  }
#endif
};

}  // namespace pred
