// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's row only.
#include "ops/sdf_to_alpha.h"

namespace pred::PRED_ISA {
namespace {

template <typename T>
static void forward(const SdfToAlphaArgs<T>& a, T* alpha, int64_t begin, int64_t end) {
  const int64_t last = a.num_samples - 1;
  const ExpScale<T> s = exp_scale(a.inv_s);
  for (int64_t ray = begin; ray < end; ++ray) {
    const T* __restrict sdf = a.sdf + ray * a.num_samples;
    T* __restrict out = alpha + ray * a.num_samples;
    for (int64_t i = 0; i < last; ++i) {
      out[i] = pair_alpha(s, sdf[i], sdf[i + 1], phi(s, sdf[i + 1])).alpha;
    }
    out[last] = a.last_opaque ? T(1) : T(0);
  }
}

template <typename T>
static void backward(const SdfToAlphaArgs<T>& a, const T* grad, T* grad_sdf, double* grad_inv_s, T* scratch,
                     int64_t begin, int64_t end) {
  const int64_t last = a.num_samples - 1;
  const T inv_s = a.inv_s;
  const ExpScale<T> s = exp_scale(a.inv_s);
  T* __restrict here = scratch;                       // gradient of s d_i through alpha_i
  T* __restrict before = scratch + a.num_samples;     // and through alpha_{i-1}
  T* __restrict scale = scratch + 2 * a.num_samples;  // gradient of s through alpha_i
  for (int64_t ray = begin; ray < end; ++ray) {
    const T* __restrict sdf = a.sdf + ray * a.num_samples;
    const T* __restrict row = grad + ray * a.num_samples;
    before[0] = here[last] = T(0);
    for (int64_t i = 0; i < last; ++i) {
      const Phi<T> next = phi(s, sdf[i + 1]);
      const PairAlpha<T> pair = pair_alpha(s, sdf[i], sdf[i + 1], next);
      const T slope = sdf[i] > sdf[i + 1] ? row[i] * next.occupied : T(0);
      here[i] = slope * pair.decay;
      before[i + 1] = -slope * pair.passed;
      scale[i] = slope * (pair.decay * (sdf[i] - sdf[i + 1]) - next.free * pair.lost * sdf[i + 1]);
    }
    if (grad_sdf) {
      T* __restrict out = grad_sdf + ray * a.num_samples;
      for (int64_t i = 0; i <= last; ++i) out[i] = inv_s * (here[i] + before[i]);
    }
    if (grad_inv_s) {
      double sum = 0;
      for (int64_t i = 0; i < last; ++i) sum += double(scale[i]);
      grad_inv_s[ray] = sum;
    }
  }
}

}  // namespace

const SdfToAlphaKernels<float> sdf_to_alpha_f32 = {forward<float>, backward<float>};
const SdfToAlphaKernels<double> sdf_to_alpha_f64 = {forward<double>, backward<double>};

}  // namespace pred::PRED_ISA
