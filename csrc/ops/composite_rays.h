// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// composite_rays: volume rendering of depth, opacity and channels from signed distances, and its gradient.
//
// With the opacities alpha_i of math/pair_alpha.h, the sums and A_i of ops/composite.h and passed_i = 1 - alpha_i:
//   S_i = sum_{j>i} w_j A_j
//   T_i = sum_{j>=i} w_j + T_end, from the saved weights
//   H_i = -dL/dlog(1 - alpha_i) = T_{i+1} A_i - S_i where the distance falls from i to i + 1, else 0
//   dL/d(s d_i) = Phi(-s d_i) (H_i - H_{i-1})
// since log(1 - alpha_i) = log Phi(s d_{i+1}) - log Phi(s d_i). Nothing is divided, so opacities of 0 and 1 are exact.
// Where the distance falls on both sides of i, H_i - H_{i-1} = T_i (A_i - A_{i-1}) is free of cancellation.
#pragma once

#include "math/pair_alpha.h"
#include "ops/composite.h"

namespace pred {

template <typename S>
struct CompositeRaysArgs : CompositeArgs<S> {
  const Compute<S>* inv_s;
  bool last_opaque;
};

// dL/d(s d_i), from Phi(-s d_i), T_i, A_{i-1}, A_i, H_{i-1} and H_i; falls: the distance does from i - 1 to i, to i
// + 1.
template <typename V, typename M>
PRED_HOST_DEVICE V slope_of_distance(V occupied, M falls_before, M falls_after, V light, V cotangent_before,
                                     V cotangent, V h_before, V h) {
  const V both = light * (cotangent - cotangent_before), one = h - h_before;
  return occupied * ((falls_before & falls_after) ? both : one);
}

template <typename S>
using CompositeRaysKernels = CompositeKernels<CompositeRaysArgs<S>>;

}  // namespace pred

PRED_DECLARE_KERNELS(CompositeRaysKernels<float>, composite_rays_f32)
PRED_DECLARE_KERNELS(CompositeRaysKernels<double>, composite_rays_f64)
PRED_DECLARE_KERNELS(CompositeRaysKernels<BFloat16>, composite_rays_bf16)
PRED_DECLARE_KERNELS(CompositeRaysKernels<Float16>, composite_rays_f16)
