// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/points_in_boxes.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <optional>

#include "common/clouds.h"
#include "ops/box_rows.h"

namespace pred {
namespace {

constexpr int64_t kGrain = 2048;

PRED_KERNELS_BY_TYPE(PointsInBoxesKernels, points_in_boxes)

Tensor read_points(const char* op, const Tensor& points) {
  check_tensor(op, "points", points, 2, points.scalar_type());
  PRED_CHECK(points.size(1) == 3, op, ": points must have shape [N, 3], got ", shape_text(points));
  return torch::stable::contiguous(points);
}

Tensor points_in_boxes(const Tensor& points_in, const Tensor& boxes, const std::optional<Tensor>& batch_offsets,
                       const std::optional<Tensor>& box_offsets) {
  const char* op = "points_in_boxes";
  const Tensor points = read_points(op, points_in), rows = read_box_rows(op, "boxes", boxes, points.scalar_type());
  const int64_t num_points = points.size(0);
  PRED_CHECK(batch_offsets.has_value() == box_offsets.has_value(), op,
             ": box_offsets must come with batch_offsets, got one of the two");
  std::optional<Tensor> point_parts, box_parts;
  const int64_t point_bounds[2] = {0, num_points}, box_bounds[2] = {0, rows.size(0)};
  const int64_t *point_offset = point_bounds, *box_offset = box_bounds;
  int64_t num_frames = 1;
  if (batch_offsets.has_value()) {
    point_parts = read_offsets(op, "batch_offsets", *batch_offsets, 'N', num_points);
    box_parts = read_offsets(op, "box_offsets", *box_offsets, 'M', rows.size(0));
    check_sizes(op, "box_offsets", *box_parts, {point_parts->size(0)});
    point_offset = point_parts->const_data_ptr<int64_t>();
    box_offset = box_parts->const_data_ptr<int64_t>();
    num_frames = point_parts->size(0) - 1;
  }
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(points, {num_points}, ScalarType::Long);
    const BoxColumns columns = box_columns<T>(rows);
    const T* data = points.const_data_ptr<T>();
    int64_t* out_data = out.mutable_data_ptr<int64_t>();
    parallel(num_points, kGrain, [&](int64_t begin, int64_t end) {
      for_each_frame(point_offset, num_frames, begin, end, [&](int64_t frame, int64_t first, int64_t last) {
        points_in_boxes_kernels<T>().first(columns.table(), box_offset[frame], box_offset[frame + 1], data, out_data,
                                           first, last);
      });
    });
    return out;
  });
}

Tensor points_in_boxes_mask(const Tensor& points_in, const Tensor& boxes) {
  const char* op = "points_in_boxes_mask";
  const Tensor points = read_points(op, points_in), rows = read_box_rows(op, "boxes", boxes, points.scalar_type());
  const int64_t num_points = points.size(0);
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(points, {rows.size(0), num_points}, ScalarType::Bool);
    const BoxColumns columns = box_columns<T>(rows);
    const T* data = points.const_data_ptr<T>();
    uint8_t* out_data = static_cast<uint8_t*>(out.mutable_data_ptr());
    parallel(num_points, kGrain, [&](int64_t begin, int64_t end) {
      points_in_boxes_kernels<T>().mask(columns.table(), data, num_points, out_data, begin, end);
    });
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) {
  m.impl("points_in_boxes", TORCH_BOX(&pred::points_in_boxes));
  m.impl("points_in_boxes_mask", TORCH_BOX(&pred::points_in_boxes_mask));
}
