// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/box_iou.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include "ops/box_rows.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(BoxIouKernels, box_iou)

Tensor box_iou(const char* op, const Tensor& boxes_a, const Tensor& boxes_b, bool aligned, bool with_height) {
  const Tensor rows_a = read_box_rows(op, "boxes_a", boxes_a, boxes_a.scalar_type());
  const Tensor rows_b = read_box_rows(op, "boxes_b", boxes_b, boxes_a.scalar_type());
  const int64_t count_a = rows_a.size(0), count_b = rows_b.size(0);
  PRED_CHECK(!aligned || count_a == count_b, op, ": boxes_b must have as many rows as boxes_a, got ", count_b, " and ",
             count_a);
  return PRED_DISPATCH_FLOAT(op, boxes_a.scalar_type(), [&] {
    Tensor out =
        aligned ? torch::stable::new_empty(rows_a, {count_a}) : torch::stable::new_empty(rows_a, {count_a, count_b});
    if (count_a == 0 || count_b == 0) return out;
    const BoxColumns a = box_columns<T>(rows_a), b = box_columns<T>(rows_b);
    const BoxIouKernels<T>& kernel = box_iou_kernels<T>();
    T* data = out.mutable_data_ptr<T>();
    const int64_t groups = b.table().stride / kBoxLanes;
    parallel(aligned ? groups : count_a * groups, 32, [&](int64_t begin, int64_t end) {
      (aligned ? kernel.rows : kernel.all_pairs)(a.table(), b.table(), with_height, data, begin, end);
    });
    return out;
  });
}

Tensor box_iou_bev(const Tensor& boxes_a, const Tensor& boxes_b, bool aligned) {
  return box_iou("box_iou_bev", boxes_a, boxes_b, aligned, false);
}

Tensor box_iou_3d(const Tensor& boxes_a, const Tensor& boxes_b, bool aligned) {
  return box_iou("box_iou_3d", boxes_a, boxes_b, aligned, true);
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "box_iou_bev", &pred::box_iou_bev);
  PRED_IMPL(m, "box_iou_3d", &pred::box_iou_3d);
}
