// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Softplus and its slope, without branches or library calls. V is T or a vector of T.
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

}  // namespace pred
