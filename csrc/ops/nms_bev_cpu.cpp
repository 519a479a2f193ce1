// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// judge: one iteration owns one candidate. keep: one thread. Both compare a box with kBoxLanes kept ones at a time.
#include "ops/nms_bev.h"

namespace pred::PRED_ISA {
namespace {

// Whether one of the kept boxes [first, num_kept) suppresses the box; `first` may be rounded down to a whole group.
static inline bool is_suppressed(const Box& box, const BoxTable& kept, int64_t first, int64_t num_kept,
                                 double iou_threshold) {
  for (int64_t group = first / kBoxLanes * kBoxLanes; group < num_kept; group += kBoxLanes) {
    bool near[kBoxLanes], any = false;
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) near[lane] = is_near(box, box_at(kept, group + lane));
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) any |= near[lane];
    if (!any) continue;
    double iou[kBoxLanes];
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) iou[lane] = iou_bev(box_at(kept, group + lane), box);
    any = false;
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) any |= iou[lane] > iou_threshold;
    if (any) return true;
  }
  return false;
}

static void judge(const BoxTable& candidates, const BoxTable& kept, int64_t num_kept, double iou_threshold,
                  bool* suppressed, int64_t begin, int64_t end) {
  for (int64_t n = begin; n < end; ++n)
    suppressed[n] = is_suppressed(box_at(candidates, n), kept, 0, num_kept, iou_threshold);
}

static int64_t keep(const BoxTable& candidates, const bool* suppressed, double iou_threshold, int64_t begin,
                    int64_t end, const BoxTable& kept, int64_t* kept_candidates, int64_t num_kept, int64_t max_kept) {
  const int64_t first = num_kept;
  for (int64_t n = begin; n < end && num_kept < max_kept; ++n) {
    const Box box = box_at(candidates, n);
    if (suppressed[n] || is_suppressed(box, kept, first, num_kept, iou_threshold)) continue;
    put_box(kept, num_kept, box);
    kept_candidates[num_kept++] = n;
  }
  return num_kept;
}

}  // namespace

const NmsBevKernels nms_bev = {judge, keep};

}  // namespace pred::PRED_ISA
