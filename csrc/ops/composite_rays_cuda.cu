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

  __device__ Opacity<T> operator()(int64_t at, int64_t i, int64_t count) const {
    if (i + 1 == count) return {a.last_opaque ? T(1) : T(0), a.last_opaque ? 0.0 : 1.0};
    const T sdf = a.source[at + i], next = a.source[at + i + 1];
    const PairAlpha<T> pair = pair_alpha(s, sdf, next, phi(s, next));
    return {pair.alpha, pair.alpha < T(0.5) ? 1.0 - double(pair.alpha) : double(pair.passed)};
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

template <bool kSource, bool kValues, int V, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(CompositeRaysArgs<S> a, CompositeSaved<T> saved, CompositeCotangents<S> grad,
                    CompositeGradients<S> out, int64_t num_rays) {
  __shared__ Tile<T> tiles[kThreads / kWarp];
  Tile<T>& tile = tiles[threadIdx.x / kWarp];
  const T inv_s = *a.inv_s;
  const ExpScale<T> s = exp_scale(inv_s);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    // Sums over what lies behind, of weights and of weights times cotangents. Transmittance is the former and what
    // remains: a sum of positive numbers, as exact where next to nothing is left as where all is.
    T light_behind = saved.remaining[ray], gain_behind = T(0), total = T(0);
    Sample<T> behind{};
    for (int64_t first = (count - 1) / kWarp * kWarp; count > 0 && first >= 0; first -= kWarp) {
      const int64_t i = first + lane_number();
      const bool there = i < count;
      const T weight = there ? saved.weights[at + i] : T(0);
      if (out.t && there) {
        const T before = i > 0 ? saved.weights[at + i - 1] : T(0);
        out.t[at + i] = position_gradient(a.depth_mid, grad.depth[ray], weight, before, i, count);
      }
      Sample<T> own{};
      if (kSource && there) own.cotangent = cotangent(a, grad, ray, at, i, count);
      if (grad.values) {
        const T dot =
            channel_gradients<V, kSource, kValues>(a, grad, out, weight, ray, at + first, count - first, tile);
        if (there) own.cotangent += dot;
      }
      if (!kSource) continue;
      own.sdf = there ? a.source[at + i] : T(0);
      const T next_sdf = from_behind(own.sdf, behind.sdf);
      own.falls = i + 1 < count && own.sdf > next_sdf;
      const T weights = suffix_sum(weight), gains = suffix_sum(there ? weight * own.cotangent : T(0));
      // T_{i+1} and S_i
      const T light_after = light_behind + from_behind(weights, T(0)),
              gain_after = gain_behind + from_behind(gains, T(0));
      own.h = own.falls ? light_after * own.cotangent - gain_after : T(0);
      const Sample<T> next = sample_behind(own, behind);
      if (i + 1 < count) {
        const T slope = slope_of_distance(phi(s, next.sdf).occupied, bool(own.falls), bool(next.falls), light_after,
                                          own.cotangent, next.cotangent, own.h, next.h);
        if (out.source) out.source[at + i + 1] = inv_s * slope;
        total += slope * next.sdf;
      }
      if (i == 0) {
        const T slope = phi(s, own.sdf).occupied * own.h;
        if (out.source) out.source[at] = inv_s * slope;
        total += slope * own.sdf;
      }
      light_behind += broadcast(weights, 0);
      gain_behind += broadcast(gains, 0);
      behind = first_sample(own);
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
      a.channels,
      [&](auto channels) {
        constexpr int V = decltype(channels)::value;
        const auto kernel = source   ? values ? backward_kernel<true, true, V, S> : backward_kernel<true, false, V, S>
                            : values ? backward_kernel<false, true, V, S>
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
