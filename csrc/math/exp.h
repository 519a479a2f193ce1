// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Exponentials without branches or library calls. V is float, double, or a vector of either (GCC's vector_size).
#pragma once

#include "common/host_device.h"
#include "common/intrinsics.h"

namespace pred {

// The scalar in V, and V's bits as unsigned integers (signed ones for vectors, whose shifts are defined).
template <typename V>
struct Lane {
  using Scalar = decltype(V{}[0] + V{}[0]);
  using Bits = decltype(V{} < V{});
};
template <>
struct Lane<float> {
  using Scalar = float;
  using Bits = uint32_t;
};
template <>
struct Lane<double> {
  using Scalar = double;
  using Bits = uint64_t;
};

template <typename T>
struct ExpConstants;

template <>
struct ExpConstants<float> {
  // 1.5 * 2^23, which when added leaves the nearest integer in the low bits, and the exponent's bias.
  static constexpr float round = 12582912.0f + 127.0f;
  static constexpr float ln2_high = 0.693145752f, ln2_low = 1.42860677e-6f;  // n * ln2_high is exact
  static constexpr float lowest = -87.0f;  // results below are 0, not subnormal
  static constexpr int mantissa_bits = 23;
};

template <>
struct ExpConstants<double> {
  static constexpr double round = 6755399441055744.0 + 1023.0;
  static constexpr double ln2_high = 0.69314718036912381649, ln2_low = 1.9082149292705877e-10;
  static constexpr double lowest = -708.0;
  static constexpr int mantissa_bits = 52;
};

// exp(f) - 1 for |f| <= log(2) / 2: the Taylor series, cut off below half a unit in the last place. Its terms are
// paired, and the pairs summed in f^2, to shorten the chain of dependent operations.
template <typename V>
PRED_HOST_DEVICE V expm1_reduced(V f) {
  const V f2 = f * f;
  if constexpr (sizeof(typename Lane<V>::Scalar) == 4) {
    const V p0 = f * (1.0f / 6) + 0.5f;
    const V p1 = f * (1.0f / 120) + 1.0f / 24;
    const V p2 = f * (1.0f / 5040) + 1.0f / 720;
    return ((p2 * f2 + p1) * f2 + p0) * f2 + f;
  } else {
    const V p0 = f * (1.0 / 6) + 0.5;
    const V p1 = f * (1.0 / 120) + 1.0 / 24;
    const V p2 = f * (1.0 / 5040) + 1.0 / 720;
    const V p3 = f * (1.0 / 362880) + 1.0 / 40320;
    const V p4 = f * (1.0 / 39916800) + 1.0 / 3628800;
    const V p5 = f * (1.0 / 6227020800) + 1.0 / 479001600;
    return (((((p5 * f2 + p4) * f2 + p3) * f2 + p2) * f2 + p1) * f2 + p0) * f2 + f;
  }
}

template <typename V>
struct Exp {
  V exp;
  V expm1;  // exp - 1, with full relative accuracy near 0
};

// exp(x + x_low) for x <= 0, |x_low| far below |x|, to about 1.5 units in the last place. NaN stays NaN.
template <typename V>
PRED_HOST_DEVICE Exp<V> exp_nonpositive(V x, V x_low) {
  using T = typename Lane<V>::Scalar;
  using Constants = ExpConstants<T>;
  const V lowest = Constants::lowest - V{};
  const V bounded = x < lowest ? lowest : x;
  const V shifted = bounded * T(1.44269504088896340736) + Constants::round;
  const V n = shifted - Constants::round;
  const V f = bounded - n * Constants::ln2_high - n * Constants::ln2_low + x_low;
  const V p = expm1_reduced(f);
  typename Lane<V>::Bits bits;
  __builtin_memcpy(&bits, &shifted, sizeof bits);
  bits = bits << Constants::mantissa_bits;  // leaves the low bits, n + bias, as the exponent
  V scale;                                  // 2^n
  __builtin_memcpy(&scale, &bits, sizeof scale);
  return {x < lowest ? V{} : scale * p + scale, scale * p + (scale - T(1))};
}

// -|x|
template <typename V>
PRED_HOST_DEVICE V negative_magnitude(V x) {
  using Bits = typename Lane<V>::Bits;
  Bits bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  const V minus_zero = -V{};
  Bits sign;
  __builtin_memcpy(&sign, &minus_zero, sizeof sign);
  bits = bits | sign;
  __builtin_memcpy(&x, &bits, sizeof x);
  return x;
}

// a * b - product, where product = a * b rounded: the rounding error, exactly.
template <typename V>
PRED_HOST_DEVICE V product_error(V a, V b, V product) {
  // Dekker: both factors are split into halves whose products are exact.
  constexpr auto split = sizeof(typename Lane<V>::Scalar) == 4 ? typename Lane<V>::Scalar(4097)
                                                               : typename Lane<V>::Scalar(134217729);
  const V a_split = a * split, b_split = b * split;
  const V a_high = a_split - (a_split - a), b_high = b_split - (b_split - b);
  const V a_low = a - a_high, b_low = b - b_high;
  return ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
}

#if defined(__FMA__) || defined(__CUDACC__)
PRED_HOST_DEVICE float product_error(float a, float b, float product) { return __builtin_fmaf(a, b, -product); }
PRED_HOST_DEVICE double product_error(double a, double b, double product) { return __builtin_fma(a, b, -product); }
#endif
#if defined(__FMA__) && !defined(__CUDACC__)
// The compiler has no fused product for its own vector types.
#define PRED_PRODUCT_ERROR(T, bytes, intrinsic)                                                          \
  typedef T Vector##bytes##T __attribute__((vector_size(bytes)));                                        \
  PRED_HOST_DEVICE Vector##bytes##T product_error(Vector##bytes##T a, Vector##bytes##T b, Vector##bytes##T product) { \
    return intrinsic(a, b, product);                                                                     \
  }
#if defined(__AVX512F__)
PRED_PRODUCT_ERROR(float, 64, _mm512_fmsub_ps)
PRED_PRODUCT_ERROR(double, 64, _mm512_fmsub_pd)
#endif
PRED_PRODUCT_ERROR(float, 32, _mm256_fmsub_ps)
PRED_PRODUCT_ERROR(double, 32, _mm256_fmsub_pd)
#undef PRED_PRODUCT_ERROR
#endif

}  // namespace pred
