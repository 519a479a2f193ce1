// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/farthest_point_sample.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>

#include "common/allocate.h"
#include "ops/point_forest.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(FarthestPointSampleKernels, farthest_point_sample)

#ifdef PRED_LAUNCH
template <typename T>
void sample_frames(const Tensor& points, const Tensor& offsets, int64_t start, const Tensor& out) {
  const Tensor columns = torch::stable::contiguous(torch::stable::transpose(points, 0, 1));
  Tensor distance = torch::stable::new_empty(columns, {points.size(0)});
  const FrameRows frames{offsets.const_data_ptr<int64_t>(), out.size(0), points.size(0)};
  farthest_point_sample_kernels<T>().sample({columns.const_data_ptr<T>(), frames, start, out.size(1)},
                                            distance.mutable_data_ptr<T>(), out.mutable_data_ptr<int64_t>());
}
#else
template <typename T>
void sample_frame(const PointForest<T>& forest, int64_t frame, const T* xyz, int64_t first, int64_t num_samples,
                  int64_t* out) {
  const PointTree<T>& tree = forest[frame];
  FarthestPointScratch<T> scratch{};
  const std::unique_ptr<T[]> distance = allocate_array<T>(forest.num_leaves(frame) * kLeafPoints);
  scratch.distance = distance.get();
  std::unique_ptr<T[]> largest[kTreeLevels];
  for (int level = 0; level < tree.num_levels; ++level) {
    largest[level] = allocate_array<T>(forest.num_groups(frame, level) * kTreeFan);
    scratch.largest[level] = largest[level].get();
  }
  farthest_point_sample_kernels<T>().sample(tree, scratch, xyz, forest.num_leaves(frame), first, num_samples, out);
}

template <typename T>
void sample_frames(const Tensor& points_in, const Tensor& offsets, int64_t start, const Tensor& out) {
  const Tensor points = torch::stable::contiguous(points_in);
  const int64_t* offset = offsets.const_data_ptr<int64_t>();
  const int64_t num_frames = out.size(0), num_samples = out.size(1);
  const T* xyz = points.const_data_ptr<T>();
  const PointForest<T> forest(xyz, offset, num_frames);
  int64_t* data = out.mutable_data_ptr<int64_t>();
  parallel(num_frames, 1, [&](int64_t begin, int64_t end) {
    for (int64_t frame = begin; frame < end; ++frame) {
      int64_t* row = data + frame * num_samples;
      const PointTree<T>& tree = forest[frame];
      const int64_t count = std::min(num_samples, tree.num_points);
      std::fill(row + count, row + num_samples, -1);
      if (count == 0) continue;
      int64_t first = offset[frame + 1] - offset[frame] > start ? offset[frame] + start : -1;
      if (first < 0 || !is_finite(xyz + 3 * first)) {
        const int32_t* rows = tree.levels[tree.num_levels - 1].first_rows;
        first = *std::min_element(rows, rows + kTreeFan);
      }
      sample_frame(forest, frame, xyz, first, count, row);
    }
  });
}
#endif

Tensor farthest_point_sample(const Tensor& points, const Tensor& batch_offsets, int64_t num_samples, int64_t start) {
  const char* op = "farthest_point_sample";
  check_tensor(op, "points", points, 2, points.scalar_type());
  PRED_CHECK(points.size(1) == 3, op, ": points must have shape [N, 3], got ", shape_text(points));
  PRED_CHECK(num_samples >= 0, op, ": num_samples must not be negative, got ", num_samples);
  PRED_CHECK(start >= 0, op, ": start must not be negative, got ", start);
  const Tensor offsets = frame_offsets(op, "batch_offsets", batch_offsets, 'N', points.size(0));
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(offsets, {offsets.size(0) - 1, num_samples});
    sample_frames<T>(points, offsets, start, out);
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "farthest_point_sample", &pred::farthest_point_sample); }
