// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/nms_bev.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <vector>

#include "ops/box_rows.h"

namespace pred {
namespace {

#ifdef PRED_LAUNCH
PRED_KERNELS_BY_TYPE(NmsBevKernels, nms_bev)

template <typename T>
Tensor nms_rows(const Tensor& boxes, const Tensor& scores, double iou_threshold, int64_t pre_max, int64_t post_max) {
  NmsBevSizes sizes{boxes.size(0), std::min(boxes.size(0), pre_max), 0};
  sizes.kept = std::min(sizes.candidates, post_max);
  PRED_CHECK(sizes.boxes < int64_t(1) << 31, "nms_bev: boxes must have fewer than 2^31 rows, got ", sizes.boxes);
  if (sizes.kept == 0) return torch::stable::new_empty(boxes, {0}, ScalarType::Long);
  const NmsBevKernels<T>& k = nms_bev_kernels<T>();
  const Tensor workspace = torch::stable::new_empty(boxes, {k.workspace_bytes(sizes)}, ScalarType::Byte);
  char* space = mutable_storage<char>(workspace);
  const int64_t num_kept = k.keep(boxes.const_data_ptr<T>(), scores.const_data_ptr<T>(), iou_threshold, sizes, space);
  Tensor out = torch::stable::new_empty(boxes, {num_kept}, ScalarType::Long);
  k.write(sizes, num_kept, out.mutable_data_ptr<int64_t>(), space);
  return out;
}
#else
// The candidates: rows of boxes with a score, at most `most` of them, highest scores first, then lowest rows.
template <typename T>
std::vector<int64_t> ordered_rows(const T* boxes, const T* scores, int64_t count, int64_t most) {
  std::vector<int64_t> rows;
  for (int64_t row = 0; row < count; ++row) {
    if (scores[row] == scores[row] && is_box(boxes + 7 * row)) rows.push_back(row);
  }
  const auto before = [scores](int64_t a, int64_t b) {
    return scores[a] > scores[b] || (scores[a] == scores[b] && a < b);
  };
  if (most < int64_t(rows.size())) {
    std::nth_element(rows.begin(), rows.begin() + most, rows.end(), before);
    rows.resize(most);
  }
  std::sort(rows.begin(), rows.end(), before);
  return rows;
}

template <typename T>
Tensor nms_rows(const Tensor& boxes, const Tensor& scores, double iou_threshold, int64_t pre_max, int64_t post_max) {
  const T* data = boxes.const_data_ptr<T>();
  const std::vector<int64_t> rows = ordered_rows(data, scores.const_data_ptr<T>(), boxes.size(0), pre_max);
  const int64_t count = int64_t(rows.size());
  const BoxColumns candidates(boxes, count), kept(boxes, std::min(count, post_max));
  parallel(count, 512, [&](int64_t begin, int64_t end) {
    for (int64_t n = begin; n < end; ++n) put_box(candidates.table(), n, read_box(data + 7 * rows[n]));
  });
  const std::unique_ptr<bool[]> suppressed = allocate_array<bool>(count);
  const std::unique_ptr<int64_t[]> kept_candidates = allocate_array<int64_t>(kept.table().count);
  const NmsBevKernels& kernel = PRED_KERNELS(nms_bev);
  int64_t num_kept = 0;
  for (int64_t first = 0; first < count && num_kept < kept.table().count; first += kNmsBlock) {
    const int64_t last = std::min(count, first + kNmsBlock);
    parallel(last - first, 16, [&](int64_t begin, int64_t end) {
      kernel.judge(candidates.table(), kept.table(), num_kept, iou_threshold, suppressed.get(), first + begin,
                   first + end);
    });
    num_kept = kernel.keep(candidates.table(), suppressed.get(), iou_threshold, first, last, kept.table(),
                           kept_candidates.get(), num_kept, kept.table().count);
  }
  Tensor out = torch::stable::new_empty(boxes, {num_kept}, ScalarType::Long);
  int64_t* out_data = out.mutable_data_ptr<int64_t>();
  for (int64_t n = 0; n < num_kept; ++n) out_data[n] = rows[kept_candidates[n]];
  return out;
}
#endif

Tensor nms_bev(const Tensor& boxes, const Tensor& scores, double iou_threshold, std::optional<int64_t> pre_max,
               std::optional<int64_t> post_max) {
  const char* op = "nms_bev";
  const Tensor rows = read_box_rows(op, "boxes", boxes, boxes.scalar_type());
  check_tensor(op, "scores", scores, 1, boxes.scalar_type());
  check_sizes(op, "scores", scores, {rows.size(0)});
  PRED_CHECK(iou_threshold >= 0 && iou_threshold <= 1, op, ": iou_threshold must be in [0, 1], got ", iou_threshold);
  const int64_t most = rows.size(0);
  PRED_CHECK(pre_max.value_or(0) >= 0, op, ": pre_max must not be negative, got ", *pre_max);
  PRED_CHECK(post_max.value_or(0) >= 0, op, ": post_max must not be negative, got ", *post_max);
  return PRED_DISPATCH_FLOAT(op, boxes.scalar_type(), [&] {
    return nms_rows<T>(rows, torch::stable::contiguous(scores), iou_threshold, pre_max.value_or(most),
                       post_max.value_or(most));
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "nms_bev", &pred::nms_bev); }
