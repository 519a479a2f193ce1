// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Sine with cosine, without branches or library calls: the same on every machine, where products and sums are not
// fused.
#pragma once

#include "common/host_device.h"

namespace pred {

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
