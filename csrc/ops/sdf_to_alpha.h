// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sdf_to_alpha: opacities as a tensor, and their gradient.
//
// Pair: the opacities of math/pair_alpha.h. With next = s d_{i+1}:
//   dalpha_i / d(s d_i)     =  Phi(-next) decay
//   dalpha_i / d(s d_{i+1}) = -Phi(-next) (1 - alpha)
//   dalpha_i / ds           =  Phi(-next) (decay (d_i - d_{i+1}) - Phi(next) (1 - decay) d_{i+1})
// and all three are 0 where the distance does not fall.
// Section: those of math/section_alpha.h, element by element.
// Density: alpha = 1 - exp(-density length), element by element.
#pragma once

#include "common/isa.h"
#include "math/section_alpha.h"
#include "ops/ray_rows.h"

namespace pred {

template <typename T>
struct PairAlphaArgs {
  RayRows rows;
  const T* sdf;    // [P]
  const T* inv_s;  // one
  bool last_opaque;
};

template <typename T>
struct SectionAlphaArgs {
  const T *sdf, *cosine, *length;  // [P]
  const T *inv_s, *anneal;         // one each
  T eps;
};

// Gradients of the inputs; null where not wanted.
template <typename T>
struct SectionAlphaGradients {
  T *sdf, *cosine, *length;  // [P]
};

template <typename T>
struct DensityAlphaArgs {
  const T *density, *length;  // [P]
};

// exp(-x) and 1 - exp(-x) for any x; the latter with full relative accuracy near 0.
template <typename T>
struct Decay {
  T kept, lost;
};

template <typename T>
PRED_HOST_DEVICE Decay<T> decay(const ExpScale<T>& one, T x) {
  const Exp<T> e = exp_nonpositive(one, negative_magnitude(x));
  const T inverse = T(1) / e.exp;
  return {x < T(0) ? inverse : e.exp, x < T(0) ? e.expm1 * inverse : -e.expm1};
}

// Samples whose parts of the gradient of inv_s are added up before the parts are.
constexpr int64_t kAlphaGroup = 1024;

template <typename T>
struct SdfToAlphaKernels {
  // Ranges count rays; loops work on them as one row.
  void (*pair)(const PairAlphaArgs<T>&, T* alpha, int64_t begin, int64_t end);
  // grad, grad_sdf [P]. Either output may be null. Loops: grad_inv_s is the range's part, scratch holds 3 times the
  // samples of the range. Launched: grad_inv_s [R].
  void (*pair_backward)(const PairAlphaArgs<T>&, const T* grad, T* grad_sdf, double* grad_inv_s, T* scratch,
                        int64_t begin, int64_t end);
  // Ranges count samples.
  void (*section)(const SectionAlphaArgs<T>&, T* alpha, int64_t begin, int64_t end);
  // parts of the gradient of inv_s: that of the range, or, launched, of each group.
  void (*section_backward)(const SectionAlphaArgs<T>&, const T* grad, const SectionAlphaGradients<T>&, double* parts,
                           int64_t begin, int64_t end);
  void (*density)(const DensityAlphaArgs<T>&, T* alpha, int64_t begin, int64_t end);
  // Either output may be null.
  void (*density_backward)(const DensityAlphaArgs<T>&, const T* grad, T* grad_density, T* grad_length, int64_t begin,
                           int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SdfToAlphaKernels<float>, sdf_to_alpha_f32)
PRED_DECLARE_KERNELS(SdfToAlphaKernels<double>, sdf_to_alpha_f64)
