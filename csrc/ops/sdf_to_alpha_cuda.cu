// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Pair: one warp owns one ray. Section: one block owns a group of samples, for the sum over it. Others: one thread owns
// one sample.
#include "common/warp.cuh"
#include "ops/sdf_to_alpha.h"

namespace pred::PRED_ISA {
namespace {

template <typename T>
__global__ void pair_kernel(PairAlphaArgs<T> a, T* alpha, int64_t num_rays) {
  const ExpScale<T> s = exp_scale(*a.inv_s);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    for (int64_t i = lane_number(); i < count; i += kWarp) {
      if (i + 1 == count) {
        alpha[at + i] = a.last_opaque ? T(1) : T(0);
      } else {
        const T sdf = a.sdf[at + i], next = a.sdf[at + i + 1];
        alpha[at + i] = pair_alpha(s, sdf, next, phi(s, next)).alpha;
      }
    }
  }
}

// Gradients through the opacity between two samples.
template <typename T>
struct PairSlopes {
  T here, next, inv_s;  // the former two of s d
};

template <typename T>
PRED_DEVICE_ONLY PairSlopes<T> pair_slopes(const ExpScale<T>& s, T grad, T sdf, T next_sdf) {
  const Phi<T> next = phi(s, next_sdf);
  const PairAlpha<T> pair = pair_alpha(s, sdf, next_sdf, next);
  const T slope = sdf > next_sdf ? grad * next.occupied : T(0);
  return {slope * pair.decay, -slope * pair.passed,
          slope * (pair.decay * (sdf - next_sdf) - next.free * pair.lost * next_sdf)};
}

template <typename T>
__global__ void pair_backward_kernel(PairAlphaArgs<T> a, const T* grad, T* grad_sdf, double* grad_inv_s,
                                     int64_t num_rays) {
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    T carried = T(0);  // gradient of the turn's first sample through the opacity before it
    double total = 0;
    for (int64_t first = 0; first < count; first += kWarp) {
      const int64_t i = first + lane_number();
      PairSlopes<T> slopes{};
      if (i + 1 < count) slopes = pair_slopes(s, grad[at + i], a.sdf[at + i], a.sdf[at + i + 1]);
      const T before = from_before(slopes.next, carried);
      carried = broadcast(slopes.next, kWarp - 1);
      if (grad_sdf && i < count) grad_sdf[at + i] = inv_s * (slopes.here + before);
      total += double(slopes.inv_s);
    }
    if (!grad_inv_s) continue;
    total = sum_lanes(total);
    if (lane_number() == 0) grad_inv_s[ray] = total;
  }
}

template <bool kPublished, typename T>
__global__ void section_kernel(SectionAlphaArgs<T> a, T* alpha, int64_t count) {
  const ExpScale<T> s = exp_scale(*a.inv_s);
  const SectionShape<T> shape{*a.anneal, a.eps};
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    alpha[i] = section_alpha<kPublished>(s, shape, a.sdf[i], a.cosine[i], a.length[i]);
  }
}

template <bool kPublished, typename T>
__global__ void section_backward_kernel(SectionAlphaArgs<T> a, const T* grad, SectionAlphaGradients<T> out,
                                        double* parts, int64_t count) {
  __shared__ double of_warp[kThreads / kWarp];
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  const SectionShape<T> shape{*a.anneal, a.eps};
  for (int64_t group = blockIdx.x; group * kAlphaGroup < count; group += gridDim.x) {
    const int64_t end = (group + 1) * kAlphaGroup < count ? (group + 1) * kAlphaGroup : count;
    double total = 0;
    for (int64_t i = group * kAlphaGroup + threadIdx.x; i < end; i += kThreads) {
      const SectionSlopes<T> slopes =
          section_alpha_slopes<kPublished>(s, inv_s, shape, a.sdf[i], a.cosine[i], a.length[i]);
      if (out.sdf) out.sdf[i] = grad[i] * slopes.of_sdf;
      if (out.cosine) out.cosine[i] = grad[i] * slopes.of_cosine;
      if (out.length) out.length[i] = grad[i] * slopes.of_length;
      total += double(grad[i] * slopes.of_inv_s);
    }
    total = sum_lanes(total);
    if (lane_number() == 0) of_warp[threadIdx.x / kWarp] = total;
    __syncthreads();
    if (threadIdx.x == 0) {
      total = 0;
      for (const double part : of_warp) total += part;
      parts[group] = total;
    }
    __syncthreads();
  }
}

template <typename T>
__global__ void density_kernel(DensityAlphaArgs<T> a, T* alpha, int64_t count) {
  const ExpScale<T> one = exp_scale(T(1));
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    alpha[i] = decay(one, a.density[i] * a.length[i]).lost;
  }
}

template <typename T>
__global__ void density_backward_kernel(DensityAlphaArgs<T> a, const T* grad, T* grad_density, T* grad_length,
                                        int64_t count) {
  const ExpScale<T> one = exp_scale(T(1));
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    const T density = a.density[i], length = a.length[i], kept = grad[i] * decay(one, density * length).kept;
    if (grad_density) grad_density[i] = kept * length;
    if (grad_length) grad_length[i] = kept * density;
  }
}

template <typename T>
void pair(const PairAlphaArgs<T>& a, T* alpha, int64_t, int64_t num_rays) {
  launch_warps(pair_kernel<T>, num_rays, a, alpha, num_rays);
}

template <typename T>
void pair_backward(const PairAlphaArgs<T>& a, const T* grad, T* grad_sdf, double* grad_inv_s, T*, int64_t,
                   int64_t num_rays) {
  launch_warps(pair_backward_kernel<T>, num_rays, a, grad, grad_sdf, grad_inv_s, num_rays);
}

template <typename T>
void section(const SectionAlphaArgs<T>& a, T* alpha, int64_t, int64_t count) {
  launch_threads(a.eps > T(0) ? section_kernel<true, T> : section_kernel<false, T>, count, a, alpha, count);
}

template <typename T>
void section_backward(const SectionAlphaArgs<T>& a, const T* grad, const SectionAlphaGradients<T>& out, double* parts,
                      int64_t, int64_t count) {
  launch_blocks(a.eps > T(0) ? section_backward_kernel<true, T> : section_backward_kernel<false, T>,
                (count + kAlphaGroup - 1) / kAlphaGroup, kThreads, 0, a, grad, out, parts, count);
}

template <typename T>
void density(const DensityAlphaArgs<T>& a, T* alpha, int64_t, int64_t count) {
  launch_threads(density_kernel<T>, count, a, alpha, count);
}

template <typename T>
void density_backward(const DensityAlphaArgs<T>& a, const T* grad, T* grad_density, T* grad_length, int64_t,
                      int64_t count) {
  launch_threads(density_backward_kernel<T>, count, a, grad, grad_density, grad_length, count);
}

}  // namespace

const SdfToAlphaKernels<float> sdf_to_alpha_f32 = {pair<float>,    pair_backward<float>,
                                                   section<float>, section_backward<float>,
                                                   density<float>, density_backward<float>};
const SdfToAlphaKernels<double> sdf_to_alpha_f64 = {pair<double>,    pair_backward<double>,
                                                    section<double>, section_backward<double>,
                                                    density<double>, density_backward<double>};

}  // namespace pred::PRED_ISA
