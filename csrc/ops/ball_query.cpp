// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/ball_query.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <tuple>

#include "ops/point_queries.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(BallQueryKernels, ball_query)

std::tuple<Tensor, Tensor> ball_query(const Tensor& points, const Tensor& batch_offsets, const Tensor& queries,
                                      const Tensor& query_offsets, double radius, int64_t max_points) {
  const char* op = "ball_query";
  const PointQueries in(op, points, batch_offsets, queries, query_offsets);
  PRED_CHECK(radius > 0, op, ": radius must be positive, got ", radius);
  PRED_CHECK(max_points >= 0, op, ": max_points must not be negative, got ", max_points);
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor index = torch::stable::new_empty(in.batch_offsets, {in.num_queries(), max_points});
    Tensor counts = torch::stable::new_empty(in.batch_offsets, {in.num_queries()});
    int64_t* index_data = index.mutable_data_ptr<int64_t>();
    int64_t* counts_data = counts.mutable_data_ptr<int64_t>();
    const T squared_radius = T(radius) * T(radius);
    const BallQueryKernels<T>& kernel = ball_query_kernels<T>();
#ifdef PRED_LAUNCH
    kernel.search(in.search<T>(), squared_radius, max_points, index_data, counts_data);
#else
    const T* query_data = in.queries.const_data_ptr<T>();
    in.search<T>([&](const PointTree<T>& tree, int64_t begin, int64_t end) {
      kernel.search(tree, query_data, squared_radius, max_points, index_data, counts_data, begin, end);
    });
#endif
    return std::make_tuple(index, counts);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "ball_query", &pred::ball_query); }
