// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One warp owns one ray, as in composite_cuda.cuh. The backward pass takes its turns from the last one on; the slope at
// a sample is worked out by the lane of the one before it, which is the last to know what it takes.
#include "ops/composite_cuda.cuh"
#include "ops/composite_rays.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct DistanceField {
  using T = Compute<S>;
  const CompositeRaysArgs<S>& a;
  const ExpScale<T> s;

  __device__ explicit DistanceField(const CompositeRaysArgs<S>& args) : a(args), s(exp_scale(*args.inv_s)) {}

  template <int K>
  __device__ void operator()(int64_t row, int left, Opacity<T> (&here)[K]) const {
    T sdf[K];
    load_samples(a.source + row, left, sdf);
    const T behind = first_behind<K>(a.source + row, left, sdf[0]);
#pragma unroll
    for (int k = 0; k < K; ++k) {
      const T next = k + 1 < K ? sdf[k + 1] : behind;
      // Behind the last one nothing rises, and all light passes.
      const PairAlpha<T> pair = alpha_of_rise(s, k + 1 < left ? next - sdf[k] : T(0), phi(s, next));
      here[k] = {pair.alpha, pair.alpha < T(0.5) ? 1.0 - double(pair.alpha) : double(pair.passed)};
    }
    if (!a.last_opaque) return;
#pragma unroll
    for (int k = 0; k < K; ++k) {
      if (k + 1 == left) here[k] = {T(1), 0.0};
    }
  }
};

// What the lane before needs to know of a sample.
template <typename T>
struct Sample {
  T sdf, cotangent, h;
  int falls;  // the distance does, to the next sample
};

template <typename T>
PRED_DEVICE_ONLY Sample<T> sample_behind(const Sample<T>& own, const Sample<T>& last) {
  return {from_behind(own.sdf, last.sdf), from_behind(own.cotangent, last.cotangent), from_behind(own.h, last.h),
          from_behind(own.falls, last.falls)};
}

template <typename T>
PRED_DEVICE_ONLY Sample<T> first_sample(const Sample<T>& own) {
  return {broadcast(own.sdf, 0), broadcast(own.cotangent, 0), broadcast(own.h, 0), broadcast(own.falls, 0)};
}

// V: channels to a lane; 0: there are none, and a lane has several samples.
template <bool kSource, bool kValues, int V, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(CompositeRaysArgs<S> a, CompositeSaved<T> saved, CompositeCotangents<S> grad,
                    CompositeGradients<S> out, int64_t num_rays) {
  constexpr int K = V > 0 ? 1 : kSamples<T>;
  __shared__ Tile<T> tiles[kThreads / kWarp];
  [[maybe_unused]] Tile<T>& tile = tiles[threadIdx.x / kWarp];
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    // Sums over what lies behind, of weights and of weights times cotangents. Transmittance is the former and what
    // remains: a sum of positive numbers, as exact where next to nothing is left as where all is.
    T light_behind = saved.remaining[ray], gain_behind = T(0), total = T(0);
    Sample<T> behind{};
    for (int64_t first = (count - 1) / (kWarp * K) * (kWarp * K); count > 0 && first >= 0; first -= kWarp * K) {
      const int64_t row = at + first + lane_number() * K;
      const int left = lane_samples<K>(count - first);
      const bool first_lane = lane_number() == 0;
      T weight[K];
      load_samples(saved.weights + row, left, weight);
      if (out.t) {
        const T before = from_before(weight[K - 1], first_lane && first > 0 ? saved.weights[row - 1] : T(0));
        position_gradients(a.depth_mid, grad.depth[ray], weight, before, left, out.t + row);
      }
      T own[K];
      if (kSource) cotangents(a, grad, ray, row, left, own);
      if constexpr (V > 0) {
        const T dot =
            channel_gradients<V, kSource, kValues>(a, grad, out, weight[0], ray, at + first, count - first, tile);
        if (kSource && left > 0) own[0] += dot;
      }
      if (!kSource) continue;
      T sdf[K];
      load_samples(a.source + row, left, sdf);
      const T next_sdf = from_behind(sdf[0], behind.sdf);
      // Of each sample, T_{i+1} and S_i: first what this lane has of them.
      T light_after[K], gain_after[K], weights = T(0), gains = T(0);
#pragma unroll
      for (int k = K - 1; k >= 0; --k) {
        light_after[k] = weights;
        gain_after[k] = gains;
        weights += weight[k];
        gains += weight[k] * own[k];
      }
      weights = suffix_sum(weights);
      gains = suffix_sum(gains);
      const T later_light = light_behind + from_behind(weights, T(0)),
              later_gain = gain_behind + from_behind(gains, T(0));
      T h[K];
      int falls[K];
#pragma unroll
      for (int k = 0; k < K; ++k) {
        light_after[k] += later_light;
        gain_after[k] += later_gain;
        falls[k] = k + 1 < left && sdf[k] > (k + 1 < K ? sdf[k + 1] : next_sdf);
        h[k] = falls[k] ? light_after[k] * own[k] - gain_after[k] : T(0);
      }
      const Sample<T> mine{sdf[0], own[0], h[0], falls[0]}, next = sample_behind(mine, behind);
      T slope[K];  // at the sample behind each
#pragma unroll
      for (int k = 0; k < K; ++k) {
        const Sample<T> after = k + 1 < K ? Sample<T>{sdf[k + 1], own[k + 1], h[k + 1], falls[k + 1]} : next;
        slope[k] = slope_of_distance(phi(s, after.sdf).occupied, bool(falls[k]), bool(after.falls), light_after[k],
                                     own[k], after.cotangent, h[k], after.h);
        if (k + 1 >= left) slope[k] = T(0);
        total += slope[k] * after.sdf;
      }
      T first_slope = T(0);
      if (first_lane && first == 0) {
        first_slope = phi(s, sdf[0]).occupied * h[0];
        total += first_slope * sdf[0];
      }
      const T before = from_before(slope[K - 1], first_slope);
      if (out.source) {
        T gradient[K];
#pragma unroll
        for (int k = 0; k < K; ++k) gradient[k] = inv_s * (k > 0 ? slope[k - 1] : before);
        // A turn's first sample is known in the turn before it only.
        store_samples(out.source + row, first_lane && first > 0 ? 1 : 0, left, gradient);
        if (lane_number() == kWarp - 1 && left > K) out.source[row + K] = inv_s * slope[K - 1];
      }
      light_behind += broadcast(weights, 0);
      gain_behind += broadcast(gains, 0);
      behind = first_sample(mine);
    }
    if (!kSource || !out.inv_s) continue;
    total = sum_lanes(total);
    if (lane_number() == 0) out.inv_s[ray] = double(total);
  }
}

template <typename S, typename T = Compute<S>>
void backward(const CompositeRaysArgs<S>& a, const CompositeSaved<T>& saved, const CompositeCotangents<S>& grad,
              const CompositeGradients<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  const bool source = out.source || out.inv_s, values = out.values != nullptr;
  by_channels<S>(
      grad.values ? a.channels : 0,
      [&](auto channels) {
        constexpr int V = decltype(channels)::value;
        const auto kernel = source   ? values ? backward_kernel<true, V != 0, V, S> : backward_kernel<true, false, V, S>
                            : values ? backward_kernel<false, V != 0, V, S>
                                     : backward_kernel<false, false, V, S>;
        launch_warps(kernel, num_rays, a, saved, grad, out, num_rays);
      },
      a.values, grad.values, out.values);
}

}  // namespace

#define PRED_TABLE(S, name)                                                                                        \
  const CompositeRaysKernels<S> composite_rays_##name = {nullptr, forward<DistanceField<S>, CompositeRaysArgs<S>>, \
                                                         backward<S>};
PRED_TABLE(float, f32)
PRED_TABLE(double, f64)
PRED_TABLE(BFloat16, bf16)
PRED_TABLE(Float16, f16)
#undef PRED_TABLE

}  // namespace pred::PRED_ISA
