// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// nms_bev: greedy non-maximum suppression. A box is kept unless its IoU, seen from above, with one that is kept and
// comes before it is above the threshold.
//
// Candidates are taken in blocks, in their order. The boxes kept so far judge a whole block at once, by any number of
// threads; those that are left judge each other in turn. Memory is that of the boxes: of pairs, kernels that are
// launched store those of one block, others none.
#pragma once

#include "common/isa.h"
#include "math/rotated_box.h"

namespace pred {

#ifdef PRED_LAUNCH
struct NmsBevSizes {
  int64_t boxes, candidates, kept;  // the last two: at most
};

template <typename T>
struct NmsBevKernels {
  int64_t (*workspace_bytes)(const NmsBevSizes&);
  // boxes: [N, 7]; scores: [N]. Returns how many boxes are kept; the host waits for that.
  int64_t (*keep)(const T* boxes, const T* scores, double iou_threshold, const NmsBevSizes&, char* workspace);
  // Their rows, from the same workspace.
  void (*write)(const NmsBevSizes&, int64_t num_kept, int64_t* out, char* workspace);
};
#else
constexpr int64_t kNmsBlock = 256;

struct NmsBevKernels {
  // Candidates [begin, end): whether one of the first num_kept boxes suppresses them.
  void (*judge)(const BoxTable& candidates, const BoxTable& kept, int64_t num_kept, double iou_threshold,
                bool* suppressed, int64_t begin, int64_t end);
  // Candidates [begin, end) one after the other, against those that this call keeps: adds a candidate that stays to
  // `kept` and its number to `kept_candidates`, until there are max_kept. Returns how many there are now.
  int64_t (*keep)(const BoxTable& candidates, const bool* suppressed, double iou_threshold, int64_t begin, int64_t end,
                  const BoxTable& kept, int64_t* kept_candidates, int64_t num_kept, int64_t max_kept);
};
#endif

}  // namespace pred

#ifdef PRED_LAUNCH
PRED_DECLARE_KERNELS(NmsBevKernels<float>, nms_bev_f32)
PRED_DECLARE_KERNELS(NmsBevKernels<double>, nms_bev_f64)
#else
PRED_DECLARE_KERNELS(NmsBevKernels, nms_bev)
#endif
