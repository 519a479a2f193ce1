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

Tensor farthest_point_sample(const Tensor& points_in, const Tensor& batch_offsets, int64_t num_samples, int64_t start) {
  const char* op = "farthest_point_sample";
  check_tensor(op, "points", points_in, 2, points_in.scalar_type());
  PRED_CHECK(points_in.size(1) == 3, op, ": points must have shape [N, 3], got ", shape_text(points_in));
  PRED_CHECK(num_samples >= 0, op, ": num_samples must not be negative, got ", num_samples);
  PRED_CHECK(start >= 0, op, ": start must not be negative, got ", start);
  const Tensor points = torch::stable::contiguous(points_in);
  const Tensor offsets = frame_offsets(op, "batch_offsets", batch_offsets, 'N', points.size(0));
  const int64_t* offset = offsets.const_data_ptr<int64_t>();
  const int64_t num_frames = offsets.size(0) - 1;
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    const T* xyz = points.const_data_ptr<T>();
    const PointForest<T> forest(xyz, offset, num_frames);
    Tensor out = torch::stable::new_empty(offsets, {num_frames, num_samples});
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
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) { m.impl("farthest_point_sample", TORCH_BOX(&pred::farthest_point_sample)); }
