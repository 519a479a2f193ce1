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

PRED_HOST_DEVICE float float_of_bits(uint32_t bits) {
  float value;
  __builtin_memcpy(&value, &bits, sizeof value);
  return value;
}

PRED_HOST_DEVICE uint32_t bits_of_float(float value) {
  uint32_t bits;
  __builtin_memcpy(&bits, &value, sizeof bits);
  return bits;
}

PRED_HOST_DEVICE float widen(float value) { return value; }
PRED_HOST_DEVICE double widen(double value) { return value; }
PRED_HOST_DEVICE float widen(BFloat16 value) { return float_of_bits(uint32_t(value.bits) << 16); }

PRED_HOST_DEVICE float widen(Float16 value) {
  const uint32_t sign = uint32_t(value.bits & 0x8000) << 16, magnitude = value.bits & 0x7fff;
  // As the upper bits of a float whose exponent is 112 too small; the product also makes subnormals normal.
  const float scaled = float_of_bits(magnitude << 13) * 0x1p112f;
  const uint32_t special = 0x7f800000u | magnitude << 13;  // infinity, NaN
  return float_of_bits(sign | (magnitude >= 0x7c00 ? special : bits_of_float(scaled)));
}

PRED_HOST_DEVICE void narrow_to(float& to, float value) { to = value; }
PRED_HOST_DEVICE void narrow_to(double& to, double value) { to = value; }

PRED_HOST_DEVICE void narrow_to(BFloat16& to, float value) {
  const uint32_t bits = bits_of_float(value), rounded = bits + 0x7fffu + (bits >> 16 & 1u);
  to.bits = uint16_t(value != value ? (bits >> 16 | 0x40u) : rounded >> 16);
}

PRED_HOST_DEVICE void narrow_to(Float16& to, float value) {
  const uint32_t bits = bits_of_float(value), sign = bits >> 16 & 0x8000u, magnitude = bits & 0x7fffffffu;
  // Normal results: rounds away 13 bits of the mantissa and moves the exponent.
  const uint32_t normal = (magnitude + 0xfffu + (magnitude >> 13 & 1u) - 0x38000000u) >> 13;
  // Below 2^-14 an addition leaves the mantissa, rounded, in the lowest bits.
  const uint32_t subnormal = bits_of_float(float_of_bits(magnitude) + 0.5f) - 0x3f000000u;
  uint32_t half = magnitude < 0x38800000u ? subnormal : normal;
  half = magnitude >= 0x477ff000u ? 0x7c00u : half;  // 65520 and more round to infinity
  half = magnitude > 0x7f800000u ? 0x7e00u | (magnitude >> 13 & 0x3ffu) : half;
  to.bits = uint16_t(sign | half);
}

// To storage, rounded to nearest even: narrow<BFloat16>(x). NaN stays NaN.
template <typename Storage>
PRED_HOST_DEVICE Storage narrow(Compute<Storage> value) {
  Storage stored;
  narrow_to(stored, value);
  return stored;
}

}  // namespace pred
