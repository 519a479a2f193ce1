// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Opacity of the section between two neighbouring samples of a ray (PRED, Eq. 4), with Phi = sigmoid and s >= 0:
//   alpha = max(1 - Phi(s d_next) / Phi(s d), 0) = Phi(-s d_next) (1 - decay),  decay = exp(-s max(d - d_next, 0))
//   1 - alpha                                    = Phi(s d_next) + Phi(-s d_next) decay
// No subtraction of near-equal numbers, no division: exact towards both ends, 0 and 1.
// V is T or a vector of T.
#pragma once

#include "math/exp.h"

namespace pred {

template <typename V>
struct Phi {
  V free;      // Phi(s d): near 1 in front of the surface
  V occupied;  // Phi(-s d)
};

// 1 / x for 1 <= x <= 2, to a unit in the last place.
template <typename V>
PRED_HOST_DEVICE V reciprocal(V x) {
  if constexpr (std::is_same_v<V, float>) {
#ifdef __CUDA_ARCH__
    // Without the cases that a division looks for: an approximation and a step of Newton's.
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return __builtin_fmaf(__builtin_fmaf(-x, y, 1.0f), y, y);
#endif
  }
  return typename Lane<V>::Scalar(1) / x;
}

template <typename V, typename T>
PRED_HOST_DEVICE Phi<V> phi(const ExpScale<T>& s, V sdf) {
  const V e = exp_nonpositive(s, negative_magnitude(sdf)).exp;
  const V large = reciprocal(T(1) + e);
  const V small = e * large;
  return {sdf < V{} ? small : large, sdf < V{} ? large : small};
}

template <typename V>
struct PairAlpha {
  V alpha;
  V passed;  // 1 - alpha
  V decay;
  V lost;  // 1 - decay
};

// From rise = d_next - d itself, for those who know it better than the difference of d_next and d.
template <typename V, typename T>
PRED_HOST_DEVICE PairAlpha<V> alpha_of_rise(const ExpScale<T>& s, V rise, Phi<V> next) {
  const Exp<V> e = exp_nonpositive(s, rise >= V{} ? V{} : rise);  // NaN stays NaN
  return {next.occupied * -e.expm1, next.free + next.occupied * e.exp, e.exp, -e.expm1};
}

template <typename V, typename T>
PRED_HOST_DEVICE PairAlpha<V> pair_alpha(const ExpScale<T>& s, V sdf, V next_sdf, Phi<V> next) {
  return alpha_of_rise(s, next_sdf - sdf, next);
}

}  // namespace pred
