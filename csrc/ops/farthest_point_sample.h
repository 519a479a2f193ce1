// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// farthest_point_sample: each sample is the point farthest from all samples before it.
//
//   distance[i] = min over the samples s so far of |p_i - p_s|^2,   next sample = argmax_i distance[i], lowest row
//   first
//
// A new sample changes the distances of few points. On the CPU each box of the frame's tree (ops/point_tree.h) keeps
// the largest distance of its points; a box that is at least so far from the sample is skipped, with equal results.
#pragma once

#include "common/frames.h"
#include "common/isa.h"
#include "ops/point_tree.h"

namespace pred {

#ifdef PRED_LAUNCH
template <typename T>
struct FarthestPointSampleArgs {
  const T* points;  // [3, N]
  FrameRows frames;
  int64_t start, num_samples;
};

template <typename T>
struct FarthestPointSampleKernels {
  // All frames: out [B, num_samples], with distance [N] as scratch.
  void (*sample)(const FarthestPointSampleArgs<T>&, T* distance, int64_t* out);
};
#else
template <typename T>
struct FarthestPointScratch {
  T* distance;              // [leaves, 32], -1 where there is no point
  T* largest[kTreeLevels];  // [groups, 16], -1 where there is no child
};

template <typename T>
struct FarthestPointSampleKernels {
  // One frame: the rows of num_samples samples, the first of which is `first`. The frame has at least so many finite
  // points and one of them is in row `first`. xyz: [N, 3].
  void (*sample)(const PointTree<T>&, const FarthestPointScratch<T>&, const T* xyz, int64_t num_leaves, int64_t first,
                 int64_t num_samples, int64_t* out);
};
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(FarthestPointSampleKernels<float>, farthest_point_sample_f32)
PRED_DECLARE_KERNELS(FarthestPointSampleKernels<double>, farthest_point_sample_f64)
