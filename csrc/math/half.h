// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Half-precision storage: bfloat16 and float16 as plain bits, widened to float for arithmetic and rounded to nearest
// even when stored. Without branches or library calls, so that loops over them vectorise at every level.
#pragma once

#include "common/host_device.h"

namespace pred {

struct BFloat16 {
  uint16_t bits;
};

struct Float16 {
  uint16_t bits;
};

// The type in which values of a storage type are computed.
template <typename Storage>
struct ComputeOf {
  using type = Storage;
};
template <>
struct ComputeOf<BFloat16> {
  using type = float;
};
template <>
struct ComputeOf<Float16> {
  using type = float;
};
template <typename Storage>
using Compute = typename ComputeOf<Storage>::type;

// The bits of one value as another type of the same size.
template <typename To, typename From>
PRED_HOST_DEVICE To bits_as(From from) {
  To to;
  __builtin_memcpy(&to, &from, sizeof to);
  return to;
}

// The conversions between float F and the half's bits, in the lower half of U. F and U are float and uint32_t, or
// vectors of them (math/half_lanes.h).
template <typename F, typename U>
PRED_HOST_DEVICE F widen_bfloat16(U bits) {
  return bits_as<F>(bits << 16);
}

template <typename U, typename F>
PRED_HOST_DEVICE U narrow_bfloat16(F value) {
  const U bits = bits_as<U>(value), rounded = bits + 0x7fffu + (bits >> 16 & 1u);
  return value != value ? (bits >> 16 | 0x40u) : rounded >> 16;
}

template <typename F, typename U>
PRED_HOST_DEVICE F widen_float16(U bits) {
  const U sign = (bits & 0x8000u) << 16, magnitude = bits & 0x7fffu;
  // As the upper bits of a float whose exponent is 112 too small; the product also makes subnormals normal.
  const F scaled = bits_as<F>(magnitude << 13) * 0x1p112f;
  const U special = 0x7f800000u | magnitude << 13;  // infinity, NaN
  return bits_as<F>(sign | (magnitude >= 0x7c00u ? special : bits_as<U>(scaled)));
}

template <typename U, typename F>
PRED_HOST_DEVICE U narrow_float16(F value) {
  const U bits = bits_as<U>(value), sign = bits >> 16 & 0x8000u, magnitude = bits & 0x7fffffffu;
  // Normal results: rounds away 13 bits of the mantissa and moves the exponent.
  const U normal = (magnitude + 0xfffu + (magnitude >> 13 & 1u) - 0x38000000u) >> 13;
  // Below 2^-14 an addition leaves the mantissa, rounded, in the lowest bits.
  const U subnormal = bits_as<U>(bits_as<F>(magnitude) + 0.5f) - 0x3f000000u;
  const U infinity = (magnitude & 0u) + 0x7c00u, nan = 0x7e00u | (magnitude >> 13 & 0x3ffu);
  U half = magnitude < 0x38800000u ? subnormal : normal;
  half = magnitude >= 0x477ff000u ? infinity : half;  // 65520 and more round to infinity
  half = magnitude > 0x7f800000u ? nan : half;
  return sign | half;
}

PRED_HOST_DEVICE float widen(float value) { return value; }
PRED_HOST_DEVICE double widen(double value) { return value; }
PRED_HOST_DEVICE float widen(BFloat16 value) { return widen_bfloat16<float>(uint32_t(value.bits)); }
PRED_HOST_DEVICE float widen(Float16 value) {
#ifdef __CUDA_ARCH__
  float wide;
  asm("cvt.f32.f16 %0, %1;" : "=f"(wide) : "h"(value.bits));
  return wide;
#else
  return widen_float16<float>(uint32_t(value.bits));
#endif
}

PRED_HOST_DEVICE void narrow_to(float& to, float value) { to = value; }
PRED_HOST_DEVICE void narrow_to(double& to, double value) { to = value; }
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
// Both rounded, `low` in the lower bits: what the instructions take at full rate is a pair.
__device__ inline uint32_t narrow_pair(BFloat16, float low, float high) {
  uint32_t both;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
  return both;
}
__device__ inline uint32_t narrow_pair(Float16, float low, float high) {
  uint32_t both;
  asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
  return both;
}
PRED_HOST_DEVICE void narrow_to(BFloat16& to, float value) { to.bits = uint16_t(narrow_pair(BFloat16{}, value, 0)); }
PRED_HOST_DEVICE void narrow_to(Float16& to, float value) { to.bits = uint16_t(narrow_pair(Float16{}, value, 0)); }
#else
PRED_HOST_DEVICE void narrow_to(BFloat16& to, float value) { to.bits = uint16_t(narrow_bfloat16<uint32_t>(value)); }
PRED_HOST_DEVICE void narrow_to(Float16& to, float value) { to.bits = uint16_t(narrow_float16<uint32_t>(value)); }
#endif

// To storage, rounded to nearest even: narrow<BFloat16>(x). NaN stays NaN.
template <typename Storage>
PRED_HOST_DEVICE Storage narrow(Compute<Storage> value) {
  Storage stored;
  narrow_to(stored, value);
  return stored;
}

}  // namespace pred
