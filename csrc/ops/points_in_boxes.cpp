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

[[maybe_unused]] constexpr int64_t kGrain = 2048;

PRED_KERNELS_BY_TYPE(PointsInBoxesKernels, points_in_boxes)

Tensor read_points(const char* op, const Tensor& points) {
  check_tensor(op, "points", points, 2, points.scalar_type());
  PRED_CHECK(points.size(1) == 3, op, ": points must have shape [N, 3], got ", shape_text(points));
  return torch::stable::contiguous(points);
}

// out: [N]
template <typename T>
void first_boxes(const Tensor& points, const Tensor& rows, const std::optional<Tensor>& point_parts,
                 const std::optional<Tensor>& box_parts, int64_t* out) {
  const int64_t num_points = points.size(0);
  const T* data = points.const_data_ptr<T>();
  const BoxColumns boxes = box_columns<T>(rows);
#ifdef PRED_LAUNCH
  BoxFrames frames{nullptr, nullptr, 1};
  if (point_parts.has_value()) {
    frames = {point_parts->const_data_ptr<int64_t>(), box_parts->const_data_ptr<int64_t>(), point_parts->size(0) - 1};
  }
  points_in_boxes_kernels<T>().first(boxes.table(), frames, data, num_points, out);
#else
  const int64_t point_bounds[2] = {0, num_points}, box_bounds[2] = {0, rows.size(0)};
  const int64_t *point_offset = point_bounds, *box_offset = box_bounds;
  int64_t num_frames = 1;
  if (point_parts.has_value()) {
    point_offset = point_parts->const_data_ptr<int64_t>();
    box_offset = box_parts->const_data_ptr<int64_t>();
    num_frames = point_parts->size(0) - 1;
  }
  parallel(num_points, kGrain, [&](int64_t begin, int64_t end) {
    for_each_frame(point_offset, num_frames, begin, end, [&](int64_t frame, int64_t first, int64_t last) {
      points_in_boxes_kernels<T>().first(boxes.table(), box_offset[frame], box_offset[frame + 1], data, out, first,
                                         last);
    });
  });
#endif
}

Tensor points_in_boxes(const Tensor& points_in, const Tensor& boxes, const std::optional<Tensor>& batch_offsets,
                       const std::optional<Tensor>& box_offsets) {
  const char* op = "points_in_boxes";
  const Tensor points = read_points(op, points_in), rows = read_box_rows(op, "boxes", boxes, points.scalar_type());
  const int64_t num_points = points.size(0);
  PRED_CHECK(batch_offsets.has_value() == box_offsets.has_value(), op,
             ": box_offsets must come with batch_offsets, got one of the two");
  std::optional<Tensor> point_parts, box_parts;
  if (batch_offsets.has_value()) {
    point_parts = read_offsets(op, "batch_offsets", *batch_offsets, 'N', num_points);
    box_parts = read_offsets(op, "box_offsets", *box_offsets, 'M', rows.size(0));
    check_sizes(op, "box_offsets", *box_parts, {point_parts->size(0)});
  }
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(points, {num_points}, ScalarType::Long);
    first_boxes<T>(points, rows, point_parts, box_parts, out.mutable_data_ptr<int64_t>());
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
#ifdef PRED_LAUNCH
    points_in_boxes_kernels<T>().mask(columns.table(), data, num_points, out_data);
#else
    parallel(num_points, kGrain, [&](int64_t begin, int64_t end) {
      points_in_boxes_kernels<T>().mask(columns.table(), data, num_points, out_data, begin, end);
    });
#endif
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "points_in_boxes", &pred::points_in_boxes);
  PRED_IMPL(m, "points_in_boxes_mask", &pred::points_in_boxes_mask);
}
