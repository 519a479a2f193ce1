// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// exp(s x) without branches or library calls. V is float, double, or a vector of either (GCC's vector_size).
#pragma once

#include <type_traits>

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

// The vector of doubles with as many lanes as V, a vector of floats.
template <typename V>
struct Doubles {
  typedef double Type __attribute__((vector_size(2 * sizeof(V))));
};

// With an exact product. double: for |a|, |b| < 2^995.
template <typename V>
PRED_HOST_DEVICE V fused_multiply_subtract(V a, V b, V c) {
  if constexpr (std::is_same_v<V, float>) {
    return float(double(a) * double(b) - double(c));  // the product is exact
  } else if constexpr (sizeof(typename Lane<V>::Scalar) == 4) {
    using Wide = typename Doubles<V>::Type;
    return __builtin_convertvector(
        __builtin_convertvector(a, Wide) * __builtin_convertvector(b, Wide) - __builtin_convertvector(c, Wide), V);
  } else {
    // Dekker: both factors are split into halves whose products are exact.
    constexpr double split = 134217729;
    const V a_split = a * split, b_split = b * split;
    const V a_high = a_split - (a_split - a), b_high = b_split - (b_split - b);
    const V a_low = a - a_high, b_low = b - b_high;
    const V product = a * b;
    const V error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
    return (product - c) + error;
  }
}

#if defined(__FMA__) || defined(__CUDACC__)
constexpr bool kFused = true;
PRED_HOST_DEVICE float fused_multiply_subtract(float a, float b, float c) { return __builtin_fmaf(a, b, -c); }
PRED_HOST_DEVICE double fused_multiply_subtract(double a, double b, double c) { return __builtin_fma(a, b, -c); }
#else
constexpr bool kFused = false;
#endif
#if defined(__FMA__) && !defined(__CUDACC__)
// The compiler has no fused product for its own vector types.
#define PRED_FUSED(T, bytes, intrinsic)                                                             \
  typedef T Vector##bytes##T __attribute__((vector_size(bytes)));                                   \
  PRED_HOST_DEVICE Vector##bytes##T fused_multiply_subtract(Vector##bytes##T a, Vector##bytes##T b, \
                                                            Vector##bytes##T c) {                   \
    return intrinsic(a, b, c);                                                                      \
  }
#if defined(__AVX512F__)
PRED_FUSED(float, 64, _mm512_fmsub_ps)
PRED_FUSED(double, 64, _mm512_fmsub_pd)
#endif
PRED_FUSED(float, 32, _mm256_fmsub_ps)
PRED_FUSED(double, 32, _mm256_fmsub_pd)
#undef PRED_FUSED
#endif

template <typename T>
struct ExpConstants;

template <>
struct ExpConstants<float> {
  // 1.5 * 2^23, which when added leaves the nearest integer in the low bits, and the exponent's bias.
  static constexpr float round = 12582912.0f + 127.0f;
  static constexpr float lowest = -126.0f;  // results below 2^lowest are 0, not subnormal
  static constexpr int mantissa_bits = 23;
};

template <>
struct ExpConstants<double> {
  static constexpr double round = 6755399441055744.0 + 1023.0;
  static constexpr double lowest = -1022.0;
  static constexpr int mantissa_bits = 52;
};

// 2^f - 1 for |f| <= 1/2 to half a unit in the last place. float: minimax fit of (2^f - 1) / f, relative error 2e-8;
// double: log(2)^k / k!. Terms are paired, and the pairs summed in f^2, to shorten the chain of operations.
template <typename V>
PRED_HOST_DEVICE V exp2m1_reduced(V f) {
  const V f2 = f * f;
  if constexpr (sizeof(typename Lane<V>::Scalar) == 4) {
    const V p0 = f * 0.24022649f + 0.6931472f;
    const V p1 = f * 0.009618238f + 0.055503573f;
    const V p2 = f * 0.00015403512f + 0.0013390849f;
    return ((p2 * f2 + p1) * f2 + p0) * f;
  } else {
    const V p0 = f * 0.24022650695910072 + 0.6931471805599453;
    const V p1 = f * 0.009618129107628477 + 0.05550410866482158;
    const V p2 = f * 0.0001540353039338161 + 0.0013333558146428443;
    const V p3 = f * 1.321548679014431e-06 + 1.5252733804059841e-05;
    const V p4 = f * 7.054911620801123e-09 + 1.01780860092397e-07;
    const V p5 = f * 2.5678435993488206e-11 + 4.4455382718708116e-10;
    const V p6 = f * 6.778726354822545e-14 + 1.3691488853904128e-12;
    return ((((((p6 * f2 + p5) * f2 + p4) * f2 + p3) * f2 + p2) * f2 + p1) * f2 + p0) * f;
  }
}

// A factor s of exponents: s * log2(e) in two parts, and the x below which exp(s x) is 0. Factors whose product with
// log2(e) would not be finite (double: beyond 2^994) count as the largest for which it is.
template <typename T>
struct ExpScale {
  T high, low, lowest;
  T shrink, grown;  // powers of 2 apart: x shrink and high / shrink, whose product is split where it is not fused
};

template <typename T>
PRED_HOST_DEVICE ExpScale<T> exp_scale(T s) {
  constexpr double log2e = 1.4426950408889634, log2e_low = 2.0355273740931033e-17;
  constexpr T largest = sizeof(T) == 4 ? T(0x1p127) : T(0x1p994);
  s = s < largest ? s : largest;
  if constexpr (sizeof(T) == 4) {
    const double exact = double(s) * log2e;
    const T high = T(exact);
    return {high, T(exact - double(high)), ExpConstants<T>::lowest / high, T(1), high};
  } else {
    const T high = s * log2e;
    const T shrink = s < T(1) ? T(0x1p-64) : T(1);  // x may be large where s is small
    return {high, fused_multiply_subtract(s, log2e, high) + s * log2e_low, ExpConstants<T>::lowest / high, shrink,
            high / shrink};
  }
}

template <typename V>
struct Exp {
  V exp;
  V expm1;  // exp - 1, with full relative accuracy near 0
};

// exp(s x) for s x <= 0, to about 1.5 units in the last place, as if s x were not rounded. NaN stays NaN.
template <typename V, typename T>
PRED_HOST_DEVICE Exp<V> exp_nonpositive(const ExpScale<T>& s, V x) {
  using Constants = ExpConstants<T>;
  const V lowest = s.lowest - V{};
  const V bounded = x < lowest ? lowest : x;
  const V shifted = bounded * s.high + Constants::round;
  const V n = shifted - Constants::round;
  const bool splits = sizeof(T) == 8 && !kFused;
  const V product = splits ? fused_multiply_subtract(bounded * s.shrink, s.grown - V{}, n)
                           : fused_multiply_subtract(bounded, s.high - V{}, n);
  const V f = product + bounded * s.low;
  const V p = exp2m1_reduced(f);
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
  const V minus_zero = -V{};
  typename Lane<V>::Bits bits, sign;
  __builtin_memcpy(&bits, &x, sizeof bits);
  __builtin_memcpy(&sign, &minus_zero, sizeof sign);
  bits = bits | sign;
  __builtin_memcpy(&x, &bits, sizeof x);
  return x;
}

}  // namespace pred
