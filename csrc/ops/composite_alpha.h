// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// composite_alpha: volume rendering of depth, opacity and channels from given opacities, and its gradient.
//
// With the sums and A_i of ops/composite.h and passed_i = 1 - alpha_i + eps, what lies behind sample i - 1 is worth
//   B_i = alpha_i A_i + passed_i B_{i+1},  B_S = 0,  per unit of light that arrives there, and
//   dL/dalpha_i = T_i D_i,  D_i = A_i - B_{i+1}
// D has a recurrence of its own, in which equal A's cancel before anything is rounded:
//   D_i = A_i - (1 + eps) A_{i+1} + passed_{i+1} D_{i+1},  D_{S-1} = A_{S-1}
// Nothing is divided: exact for opacities of 0 and 1, and for any others.
#pragma once

#include "ops/composite.h"

namespace pred {

template <typename S>
struct CompositeAlphaArgs : CompositeArgs<S> {
  double eps;
};

template <typename S>
using CompositeAlphaKernels = CompositeKernels<CompositeAlphaArgs<S>>;

}  // namespace pred

PRED_DECLARE_KERNELS(CompositeAlphaKernels<float>, composite_alpha_f32)
PRED_DECLARE_KERNELS(CompositeAlphaKernels<double>, composite_alpha_f64)
PRED_DECLARE_KERNELS(CompositeAlphaKernels<BFloat16>, composite_alpha_bf16)
PRED_DECLARE_KERNELS(CompositeAlphaKernels<Float16>, composite_alpha_f16)
