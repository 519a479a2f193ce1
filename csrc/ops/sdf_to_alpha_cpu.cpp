// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one sample. Pair: a range of rays is one row, as if the samples behind a ray's last one were its
// next ones; then the last sample of each ray is set right. Short rays cost no more than long ones that way.
#include "ops/sdf_to_alpha.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kBlock = 512;  // samples whose gradients stay in the nearest cache

// In a fixed order, with as many sums as hide the latency of an addition.
template <typename T>
static inline double sum(const T* __restrict x, int64_t n) {
  constexpr int64_t lanes = 16;
  double sums[lanes] = {};
  int64_t i = 0;
  for (; i + lanes <= n; i += lanes) {
    for (int64_t k = 0; k < lanes; ++k) sums[k] += double(x[i + k]);
  }
  for (; i < n; ++i) sums[0] += double(x[i]);
  double total = 0;
  for (const double part : sums) total += part;
  return total;
}

template <typename T>
static void pair(const PairAlphaArgs<T>& a, T* alpha, int64_t begin, int64_t end) {
  const int64_t first = ray_begin(a.rows, begin), count = ray_begin(a.rows, end) - first;
  const ExpScale<T> s = exp_scale(*a.inv_s);
  const T* __restrict sdf = a.sdf + first;
  T* __restrict out = alpha + first;
  for (int64_t i = 0; i < count - 1; ++i) {
    out[i] = pair_alpha(s, sdf[i], sdf[i + 1], phi(s, sdf[i + 1])).alpha;
  }
  for (int64_t ray = begin; ray < end; ++ray) {
    if (ray_count(a.rows, ray) == 0) continue;
    alpha[ray_begin(a.rows, ray + 1) - 1] = a.last_opaque ? T(1) : T(0);
  }
}

template <typename T>
static void pair_backward(const PairAlphaArgs<T>& a, const T* grad, T* grad_sdf, double* grad_inv_s, T* scratch,
                          int64_t begin, int64_t end) {
  const int64_t first = ray_begin(a.rows, begin), count = ray_begin(a.rows, end) - first;
  if (count == 0) return;
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  const T* __restrict sdf = a.sdf + first;
  const T* __restrict row = grad + first;
  T* __restrict here = scratch;               // gradient of s d_i through alpha_i
  T* __restrict before = scratch + count;     // and through alpha_{i-1}
  T* __restrict scale = scratch + 2 * count;  // gradient of s through alpha_i
  for (int64_t i = 0; i < count - 1; ++i) {
    const Phi<T> next = phi(s, sdf[i + 1]);
    const PairAlpha<T> pair = pair_alpha(s, sdf[i], sdf[i + 1], next);
    const T slope = sdf[i] > sdf[i + 1] ? row[i] * next.occupied : T(0);
    here[i] = slope * pair.decay;
    before[i + 1] = -slope * pair.passed;
    scale[i] = slope * (pair.decay * (sdf[i] - sdf[i + 1]) - next.free * pair.lost * sdf[i + 1]);
  }
  for (int64_t ray = begin; ray < end; ++ray) {
    if (ray_count(a.rows, ray) == 0) continue;
    const int64_t last = ray_begin(a.rows, ray + 1) - first - 1;
    before[ray_begin(a.rows, ray) - first] = here[last] = scale[last] = T(0);
  }
  if (grad_sdf) {
    T* __restrict out = grad_sdf + first;
    for (int64_t i = 0; i < count; ++i) out[i] = inv_s * (here[i] + before[i]);
  }
  if (grad_inv_s) *grad_inv_s = sum(scale, count);
}

template <bool kPublished, typename T>
static inline void section_range(const SectionAlphaArgs<T>& a, T* __restrict alpha, int64_t begin, int64_t end) {
  const ExpScale<T> s = exp_scale(*a.inv_s);
  const SectionShape<T> shape{*a.anneal, a.eps};
  const T* __restrict sdf = a.sdf, * __restrict cosine = a.cosine, * __restrict length = a.length;
  for (int64_t i = begin; i < end; ++i) alpha[i] = section_alpha<kPublished>(s, shape, sdf[i], cosine[i], length[i]);
}

template <typename T>
static void section(const SectionAlphaArgs<T>& a, T* alpha, int64_t begin, int64_t end) {
  a.eps > T(0) ? section_range<true>(a, alpha, begin, end) : section_range<false>(a, alpha, begin, end);
}

template <typename T>
static inline void copy(const T* __restrict from, T* __restrict to, int64_t n) {
  for (int64_t i = 0; i < n; ++i) to[i] = from[i];
}

template <bool kPublished, typename T>
static inline double section_backward_range(const SectionAlphaArgs<T>& a, const T* grad,
                                            const SectionAlphaGradients<T>& out, int64_t begin, int64_t end) {
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  const SectionShape<T> shape{*a.anneal, a.eps};
  alignas(64) T of_sdf[kBlock], of_cosine[kBlock], of_length[kBlock], of_inv_s[kBlock];
  double total = 0;
  for (int64_t block = begin; block < end; block += kBlock) {
    const int64_t count = end - block < kBlock ? end - block : kBlock;
    const T* __restrict sdf = a.sdf + block, * __restrict cosine = a.cosine + block, * __restrict length = a.length + block;
    const T* __restrict row = grad + block;
    for (int64_t i = 0; i < count; ++i) {
      const SectionSlopes<T> slopes = section_alpha_slopes<kPublished>(s, inv_s, shape, sdf[i], cosine[i], length[i]);
      of_sdf[i] = row[i] * slopes.of_sdf;
      of_cosine[i] = row[i] * slopes.of_cosine;
      of_length[i] = row[i] * slopes.of_length;
      of_inv_s[i] = row[i] * slopes.of_inv_s;
    }
    if (out.sdf) copy(of_sdf, out.sdf + block, count);
    if (out.cosine) copy(of_cosine, out.cosine + block, count);
    if (out.length) copy(of_length, out.length + block, count);
    total += sum(of_inv_s, count);
  }
  return total;
}

template <typename T>
static void section_backward(const SectionAlphaArgs<T>& a, const T* grad, const SectionAlphaGradients<T>& out,
                             double* part, int64_t begin, int64_t end) {
  *part = a.eps > T(0) ? section_backward_range<true>(a, grad, out, begin, end)
                       : section_backward_range<false>(a, grad, out, begin, end);
}

template <typename T>
static void density(const DensityAlphaArgs<T>& a, T* alpha, int64_t begin, int64_t end) {
  const ExpScale<T> one = exp_scale(T(1));
  const T* __restrict density = a.density, * __restrict length = a.length;
  T* __restrict out = alpha;
  for (int64_t i = begin; i < end; ++i) out[i] = decay(one, density[i] * length[i]).lost;
}

template <typename T>
static void density_backward(const DensityAlphaArgs<T>& a, const T* grad, T* grad_density, T* grad_length,
                             int64_t begin, int64_t end) {
  const ExpScale<T> one = exp_scale(T(1));
  alignas(64) T kept[kBlock];
  for (int64_t block = begin; block < end; block += kBlock) {
    const int64_t count = end - block < kBlock ? end - block : kBlock;
    const T* __restrict density = a.density + block, * __restrict length = a.length + block;
    const T* __restrict row = grad + block;
    for (int64_t i = 0; i < count; ++i) kept[i] = row[i] * decay(one, density[i] * length[i]).kept;
    if (grad_density) {
      T* __restrict out = grad_density + block;
      for (int64_t i = 0; i < count; ++i) out[i] = kept[i] * length[i];
    }
    if (grad_length) {
      T* __restrict out = grad_length + block;
      for (int64_t i = 0; i < count; ++i) out[i] = kept[i] * density[i];
    }
  }
}

}  // namespace

const SdfToAlphaKernels<float> sdf_to_alpha_f32 = {pair<float>,    pair_backward<float>,
                                                   section<float>, section_backward<float>,
                                                   density<float>, density_backward<float>};
const SdfToAlphaKernels<double> sdf_to_alpha_f64 = {pair<double>,    pair_backward<double>,
                                                    section<double>, section_backward<double>,
                                                    density<double>, density_backward<double>};

}  // namespace pred::PRED_ISA
