// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sdf_to_alpha: the opacities of math/pair_alpha.h as a tensor, and their gradient. With next = s d_{i+1}:
//   dalpha_i / d(s d_i)     =  Phi(-next) decay
//   dalpha_i / d(s d_{i+1}) = -Phi(-next) (1 - alpha)
//   dalpha_i / ds           =  Phi(-next) (decay (d_i - d_{i+1}) - Phi(next) (1 - decay) d_{i+1})
// and all three are 0 where the distance does not fall.
#pragma once

#include "common/isa.h"
#include "math/pair_alpha.h"

namespace pred {

template <typename T>
struct SdfToAlphaArgs {
  const T* sdf;  // [R, S]
  T inv_s;
  int64_t num_samples;
  bool last_opaque;
};

// Ranges count rays.
template <typename T>
struct SdfToAlphaKernels {
  void (*forward)(const SdfToAlphaArgs<T>&, T* alpha, int64_t begin, int64_t end);
  // grad, grad_sdf [R, S]; grad_inv_s [R] holds each ray's part; scratch [3, S]. Either output may be null.
  void (*backward)(const SdfToAlphaArgs<T>&, const T* grad, T* grad_sdf, double* grad_inv_s, T* scratch, int64_t begin,
                   int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SdfToAlphaKernels<float>, sdf_to_alpha_f32)
PRED_DECLARE_KERNELS(SdfToAlphaKernels<double>, sdf_to_alpha_f64)
