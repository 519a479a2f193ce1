// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Opacity of a section from one signed distance d and the angle at which the ray meets the surface (NeuS, Eq. 13 and
// its code). The distance is taken to fall along the section at the rate
//   fall = relu(1/2 - cosine / 2) (1 - anneal) + relu(-cosine) anneal
// from d + fall length / 2 to d - fall length / 2, and then, with Phi = sigmoid,
//   alpha = 1 - Phi(s d_end) / Phi(s d_start)                                       (eps = 0; see pair_alpha.h)
//   alpha = clip((Phi(s d_start) - Phi(s d_end) + eps) / (Phi(s d_start) + eps), 0, 1)    (eps > 0, as published)
// The derivative of relu at 0 is 0, that of clip on its bounds 1.
#pragma once

#include "math/pair_alpha.h"

namespace pred {

template <typename T>
struct SectionShape {
  T anneal, eps;
};

template <typename T>
struct SectionSlopes {
  T of_sdf, of_cosine, of_length, of_inv_s;  // derivatives of alpha
};

template <typename T>
PRED_HOST_DEVICE T relu(T x) {
  return x <= T(0) ? T(0) : x;  // NaN stays NaN
}

template <typename T>
PRED_HOST_DEVICE T section_fall(T anneal, T cosine) {
  return relu(-cosine * T(0.5) + T(0.5)) * (T(1) - anneal) + relu(-cosine) * anneal;
}

// d fall / d cosine
template <typename T>
PRED_HOST_DEVICE T section_fall_slope(T anneal, T cosine) {
  const T flat = -cosine * T(0.5) + T(0.5) > T(0) ? T(-0.5) * (T(1) - anneal) : T(0);
  return flat + (-cosine > T(0) ? -anneal : T(0));
}

template <typename T>
PRED_HOST_DEVICE T clip01(T x) {
  const T low = x < T(0) ? T(0) : x;
  return low > T(1) ? T(1) : low;
}

// kPublished: eps > 0.
template <bool kPublished, typename T>
PRED_HOST_DEVICE T section_alpha(const ExpScale<T>& s, SectionShape<T> shape, T sdf, T cosine, T length) {
  const T fall = section_fall(shape.anneal, cosine) * length, half = fall * T(0.5);
  const Phi<T> end = phi(s, sdf - half);
  if constexpr (!kPublished) return alpha_of_rise(s, -fall, end).alpha;
  const T start = phi(s, sdf + half).free;
  return clip01((start - end.free + shape.eps) / (start + shape.eps));
}

template <bool kPublished, typename T>
PRED_HOST_DEVICE SectionSlopes<T> section_alpha_slopes(const ExpScale<T>& s, T inv_s, SectionShape<T> shape, T sdf,
                                                       T cosine, T length) {
  const T fall = section_fall(shape.anneal, cosine), total = fall * length, half = total * T(0.5);
  const T start_sdf = sdf + half, end_sdf = sdf - half;
  const Phi<T> end = phi(s, end_sdf);
  SectionSlopes<T> out;
  T of_sdf, of_half, of_inv_s;  // derivatives in s d, in s half, and in s
  if constexpr (kPublished) {
    const Phi<T> start = phi(s, start_sdf);
    const T scale = T(1) / (start.free + shape.eps), ratio = (start.free - end.free + shape.eps) * scale;
    const bool free = ratio >= T(0) && ratio <= T(1);
    const T of_start = free ? start.free * start.occupied * scale * (end.free * scale) : T(0);
    const T of_end = free ? -(end.free * end.occupied * scale) : T(0);
    of_sdf = of_start + of_end;
    of_half = of_start - of_end;
    of_inv_s = of_start * start_sdf + of_end * end_sdf;
  } else {
    const PairAlpha<T> pair = alpha_of_rise(s, -total, end);
    const T of_total = total < T(0) ? T(0) : end.occupied * pair.decay;
    const T of_end = -(end.occupied * end.free * pair.lost);
    of_sdf = of_end;
    of_half = T(2) * of_total - of_end;
    of_inv_s = of_total * total + of_end * end_sdf;
  }
  const T of_product = inv_s * of_half * T(0.5);  // of fall times length
  out.of_sdf = inv_s * of_sdf;
  out.of_cosine = of_product * length * section_fall_slope(shape.anneal, cosine);
  out.of_length = of_product * fall;
  out.of_inv_s = of_inv_s;
  return out;
}

}  // namespace pred
