// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// box_iou_bev, box_iou_3d: intersection over union of boxes, of all pairs or row by row (math/rotated_box.h).
#pragma once

#include "common/isa.h"
#include "math/rotated_box.h"

namespace pred {

template <typename T>
struct BoxIouKernels {  // those that are launched do everything, whatever the range
  // Groups of kBoxLanes boxes b, those of row 0 of a first: number n is group n % groups of row n / groups. out: [N,
  // M].
  void (*all_pairs)(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t begin, int64_t end);
  // Groups of rows. out: [N].
  void (*rows)(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(BoxIouKernels<float>, box_iou_f32)
PRED_DECLARE_KERNELS(BoxIouKernels<double>, box_iou_f64)
