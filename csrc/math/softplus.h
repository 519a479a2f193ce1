// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Softplus, its slope, and sine with cosine, without branches or library calls. V is T or a vector of T.
#pragma once

#include "math/exp.h"

namespace pred {

// log(1 + e) for 0 <= e <= 1. float: minimax fit of log(1 + e) / e, relative error 5e-9; double: the odd series of
// 2 atanh(u), u = e / (2 + e) <= 1/3, truncated below half a unit in the last place.
template <typename V>
PRED_HOST_DEVICE V log1p_unit(V e) {
  using T = typename Lane<V>::Scalar;
  if constexpr (sizeof(T) == 4) {
    // Powers of e would be subnormal, and slow, where e is small.
    V sum = e * -0.0032440242f + 0.019851457f;
    sum = sum * e - 0.056959525f;
    sum = sum * e + 0.10603654f;
    sum = sum * e - 0.15305592f;
    sum = sum * e + 0.19675939f;
    sum = sum * e - 0.24954134f;
    sum = sum * e + 0.33329964f;
    sum = sum * e - 0.49999902f;
    sum = sum * e + 1.0f;
    return sum * e;
  } else {
    constexpr int terms = 17;
    const V u = e / (e + T(2)), u2 = u * u;
    V sum = V{} + T(2) / T(2 * terms - 1);
#ifndef __CUDACC__
#pragma GCC unroll 16
#endif
    for (int k = terms - 2; k >= 0; --k) sum = sum * u2 + T(2) / T(2 * k + 1);
    return sum * u;
  }
}

// The sharpness beta of a Softplus, ready for use.
template <typename T>
struct SoftplusScale {
  ExpScale<T> beta;
  T inverse;
};

template <typename T>
PRED_HOST_DEVICE SoftplusScale<T> softplus_scale(T beta) {
  return {exp_scale(beta), T(1) / beta};
}

template <typename V>
struct Softplus {
  V value;  // log(1 + exp(beta z)) / beta
  V slope;  // sigmoid(beta z)
};

template <typename V, typename T>
__attribute__((always_inline)) PRED_HOST_DEVICE Softplus<V> softplus(const SoftplusScale<T>& s, V z) {
  const V e = exp_nonpositive(s.beta, negative_magnitude(z)).exp, large = T(1) / (e + T(1));
  const V positive = z < V{} ? V{} : z;  // NaN stays NaN
  return {positive + log1p_unit(e) * s.inverse, z < V{} ? e * large : large};
}

struct SineCosine {
  double sine, cosine;
};

// To 1e-12 for |x| < 2^20, with an error that grows as x beyond; NaN from 2^40 on.
PRED_HOST_DEVICE SineCosine sine_cosine(double x) {
  // x = q pi/2 + r, |r| <= pi/4; q times the first part of pi/2, of 33 bits, is exact.
  constexpr double round = 6755399441055744.0;
  const double near = x < 0x1p40 && x > -0x1p40 ? x : __builtin_nan("");
  const double shifted = near * 0.6366197723675814 + round, q = shifted - round;
  const double r = (near - q * 1.57079632673412561417) - q * 6.07710050650619224932e-11, r2 = r * r;
  double sine = -1.0 / 1307674368000.0, cosine = 1.0 / 20922789888000.0;  // 1/15!, 1/16!
  sine = sine * r2 + 1.0 / 6227020800.0;
  sine = sine * r2 - 1.0 / 39916800.0;
  sine = sine * r2 + 1.0 / 362880.0;
  sine = sine * r2 - 1.0 / 5040.0;
  sine = sine * r2 + 1.0 / 120.0;
  sine = sine * r2 - 1.0 / 6.0;
  sine = sine * r2 * r + r;
  cosine = cosine * r2 - 1.0 / 87178291200.0;
  cosine = cosine * r2 + 1.0 / 479001600.0;
  cosine = cosine * r2 - 1.0 / 3628800.0;
  cosine = cosine * r2 + 1.0 / 40320.0;
  cosine = cosine * r2 - 1.0 / 720.0;
  cosine = cosine * r2 + 1.0 / 24.0;
  cosine = cosine * r2 - 0.5;
  cosine = cosine * r2 + 1.0;
  uint64_t quadrant;
  __builtin_memcpy(&quadrant, &shifted, sizeof quadrant);
  const bool odd = quadrant & 1, falls = quadrant & 2, turns = (quadrant + 1) & 2;
  const double s = odd ? cosine : sine, c = odd ? sine : cosine;
  return {falls ? -s : s, turns ? -c : c};
}

}  // namespace pred
