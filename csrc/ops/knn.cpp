// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/knn.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <tuple>

#include "ops/point_queries.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(KnnKernels, knn)

std::tuple<Tensor, Tensor> knn(const Tensor& points, const Tensor& batch_offsets, const Tensor& queries,
                               const Tensor& query_offsets, int64_t k) {
  const char* op = "knn";
  const PointQueries in(op, points, batch_offsets, queries, query_offsets);
  PRED_CHECK(k >= 0, op, ": k must not be negative, got ", k);
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor index = torch::stable::new_empty(in.batch_offsets, {in.num_queries(), k});
    Tensor distance = torch::stable::new_empty(in.points, {in.num_queries(), k});
    int64_t* index_data = index.mutable_data_ptr<int64_t>();
    T* distance_data = distance.mutable_data_ptr<T>();
    const KnnKernels<T>& kernel = knn_kernels<T>();
#ifdef PRED_LAUNCH
    kernel.search(in.search<T>(), k, index_data, distance_data);
#else
    const T* query_data = in.queries.const_data_ptr<T>();
    in.search<T>([&](const PointTree<T>& tree, int64_t begin, int64_t end) {
      kernel.search(tree, query_data, k, index_data, distance_data, begin, end);
    });
#endif
    return std::make_tuple(index, distance);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "knn", &pred::knn); }
