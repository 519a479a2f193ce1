// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One warp owns one ray, as in composite_cuda.cuh. The backward pass goes along the ray for the light that arrives, and
// comes back for D, in double.
#include "ops/composite_alpha.h"
#include "ops/composite_cuda.cuh"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct GivenField {
  using T = Compute<S>;
  const CompositeAlphaArgs<S>& a;

  __device__ explicit GivenField(const CompositeAlphaArgs<S>& args) : a(args) {}

  template <int K>
  __device__ void operator()(int64_t row, int left, Opacity<T> (&here)[K]) const {
    T alpha[K];
    load_samples(a.source + row, left, alpha);
#pragma unroll
    for (int k = 0; k < K; ++k) here[k] = {alpha[k], k < left ? (1.0 - double(alpha[k])) + a.eps : 1.0};
  }
};

// V: channels to a lane; 0: there are none, and a lane has several samples.
template <bool kSource, bool kValues, int V, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(CompositeAlphaArgs<S> a, CompositeCotangents<S> grad, CompositeGradients<S> out, int64_t num_rays) {
  constexpr int K = V > 0 ? 1 : kSamples<T>;
  __shared__ Tile<T> tiles[kThreads / kWarp];
  [[maybe_unused]] Tile<T>& tile = tiles[threadIdx.x / kWarp];
  const GivenField<S> field(a);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    double transmittance = 1;
    T weight_before = T(0);  // of the sample before the turn
    for (int64_t first = 0; first < count; first += kWarp * K) {
      const int64_t row = at + first + lane_number() * K;
      const int left = lane_samples<K>(count - first);
      Opacity<T> here[K];
      field(row, left, here);
      double light[K];
      arriving_light(here, transmittance, light);
      T arriving[K], weight[K];
#pragma unroll
      for (int k = 0; k < K; ++k) {
        arriving[k] = T(light[k]);
        weight[k] = k < left ? T(light[k] * double(here[k].alpha)) : T(0);
      }
      if (kSource) store_samples(out.source + row, 0, left, arriving);  // kept there for the way back
      if (out.t) {
        const T before = from_before(weight[K - 1], weight_before);
        position_gradients(a.depth_mid, grad.depth[ray], weight, before, left, out.t + row);
        weight_before = broadcast(weight[K - 1], kWarp - 1);
      }
      if constexpr (kValues) {
        channel_gradients<V, false, true>(a, grad, out, weight[0], ray, at + first, count - first, tile);
      }
    }
    if (!kSource) continue;
    double d_behind = 0, passed_behind = 1;
    T cotangent_behind = T(0);
    for (int64_t first = (count - 1) / (kWarp * K) * (kWarp * K); count > 0 && first >= 0; first -= kWarp * K) {
      const int64_t row = at + first + lane_number() * K;
      const int left = lane_samples<K>(count - first);
      T own[K];
      cotangents(a, grad, ray, row, left, own);
      if constexpr (V > 0) {
        const T dot = channel_gradients<V, true, false>(a, grad, out, T(0), ray, at + first, count - first, tile);
        if (left > 0) own[0] += dot;
      }
      Opacity<T> here[K];
      field(row, left, here);
      // D_i = value_i + factor_i D_{i+1}; of this lane, from the first sample of the lane behind on.
      const double next_passed = from_behind(here[0].passed, passed_behind);
      const T next_own = from_behind(own[0], cotangent_behind);
      double value[K], factor[K];
#pragma unroll
      for (int k = K - 1; k >= 0; --k) {
        const double mine = double(own[k]), next = double(k + 1 < K ? own[k + 1] : next_own);
        factor[k] = k + 1 < K ? here[k + 1].passed : next_passed;
        value[k] = k < left ? (mine - next) - a.eps * next : 0.0;
        if (k + 1 < K) {
          value[k] += factor[k] * value[k + 1];
          factor[k] *= factor[k + 1];
        }
      }
      double lane_value = value[0], lane_factor = factor[0];
      for (int distance = 1; distance < kWarp; distance *= 2) {
        const double other_value = __shfl_down_sync(kWholeWarp, lane_value, distance);
        const double other_factor = __shfl_down_sync(kWholeWarp, lane_factor, distance);
        if (lane_number() + distance >= kWarp) continue;
        lane_value += lane_factor * other_value;
        lane_factor *= other_factor;
      }
      lane_value += lane_factor * d_behind;
      const double next_d = from_behind(lane_value, d_behind);
      T gradient[K];
      load_samples<true>(out.source + row, left, gradient);
#pragma unroll
      for (int k = 0; k < K; ++k) gradient[k] = T(double(gradient[k]) * (value[k] + factor[k] * next_d));
      store_samples(out.source + row, 0, left, gradient);
      d_behind = broadcast(lane_value, 0);
      passed_behind = broadcast(here[0].passed, 0);
      cotangent_behind = broadcast(own[0], 0);
    }
  }
}

template <typename S, typename T = Compute<S>>
void backward(const CompositeAlphaArgs<S>& a, const CompositeSaved<T>&, const CompositeCotangents<S>& grad,
              const CompositeGradients<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  const bool source = out.source != nullptr, values = out.values != nullptr;
  by_channels<S>(
      grad.values ? a.channels : 0,
      [&](auto channels) {
        constexpr int V = decltype(channels)::value;
        const auto kernel = source   ? values ? backward_kernel<true, V != 0, V, S> : backward_kernel<true, false, V, S>
                            : values ? backward_kernel<false, V != 0, V, S>
                                     : backward_kernel<false, false, V, S>;
        launch_warps(kernel, num_rays, a, grad, out, num_rays);
      },
      a.values, grad.values, out.values);
}

}  // namespace

#define PRED_TABLE(S, name)                                                                                        \
  const CompositeAlphaKernels<S> composite_alpha_##name = {nullptr, forward<GivenField<S>, CompositeAlphaArgs<S>>, \
                                                           backward<S>};
PRED_TABLE(float, f32)
PRED_TABLE(double, f64)
PRED_TABLE(BFloat16, bf16)
PRED_TABLE(Float16, f16)
#undef PRED_TABLE

}  // namespace pred::PRED_ISA
