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

  __device__ Opacity<T> operator()(int64_t at, int64_t i, int64_t) const {
    const T alpha = a.source[at + i];
    return {alpha, (1.0 - double(alpha)) + a.eps};
  }
};

template <bool kSource, bool kValues, int V, typename S, typename T = Compute<S>>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(CompositeAlphaArgs<S> a, CompositeCotangents<S> grad, CompositeGradients<S> out, int64_t num_rays) {
  __shared__ Tile<T> tiles[kThreads / kWarp];
  Tile<T>& tile = tiles[threadIdx.x / kWarp];
  const GivenField<S> field(a);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    double transmittance = 1;
    T weight_before = T(0);  // of the sample before the turn
    for (int64_t first = 0; first < count; first += kWarp) {
      const int64_t i = first + lane_number();
      const bool there = i < count;
      Opacity<T> here{T(0), 1.0};
      if (there) here = field(at, i, count);
      const double product = prefix_product(here.passed);
      const double light = transmittance * from_before(product, 1.0);
      const T weight = T(light * double(here.alpha)), before = from_before(weight, weight_before);
      if (kSource && there) out.source[at + i] = T(light);  // kept there for the way back
      if (out.t && there) {
        out.t[at + i] = position_gradient(a.depth_mid, grad.depth[ray], weight, before, i, count);
      }
      if (kValues) channel_gradients<V, false, true>(a, grad, out, weight, ray, at + first, count - first, tile);
      transmittance *= broadcast(product, kWarp - 1);
      weight_before = broadcast(weight, kWarp - 1);
    }
    if (!kSource) continue;
    double d_behind = 0, passed_behind = 1;
    T cotangent_behind = T(0);
    for (int64_t first = (count - 1) / kWarp * kWarp; count > 0 && first >= 0; first -= kWarp) {
      const int64_t i = first + lane_number();
      const bool there = i < count;
      T own = there ? cotangent(a, grad, ray, at, i, count) : T(0);
      if (grad.values) {
        const T dot = channel_gradients<V, true, false>(a, grad, out, T(0), ray, at + first, count - first, tile);
        if (there) own += dot;
      }
      // D_i = value + factor D_{i+1}
      const double passed = there ? field(at, i, count).passed : 1.0;
      const double here = double(own), next = double(from_behind(own, cotangent_behind));
      double factor = from_behind(passed, passed_behind), value = there ? (here - next) - a.eps * next : 0.0;
      for (int distance = 1; distance < kWarp; distance *= 2) {
        const double other_value = __shfl_down_sync(kWholeWarp, value, distance);
        const double other_factor = __shfl_down_sync(kWholeWarp, factor, distance);
        if (lane_number() + distance >= kWarp) continue;
        value += factor * other_value;
        factor *= other_factor;
      }
      value += factor * d_behind;
      if (there) out.source[at + i] = T(double(out.source[at + i]) * value);
      d_behind = broadcast(value, 0);
      passed_behind = broadcast(passed, 0);
      cotangent_behind = broadcast(own, 0);
    }
  }
}

template <typename S, typename T = Compute<S>>
void backward(const CompositeAlphaArgs<S>& a, const CompositeSaved<T>&, const CompositeCotangents<S>& grad,
              const CompositeGradients<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  const bool source = out.source != nullptr, values = out.values != nullptr;
  by_channels<S>(
      a.channels,
      [&](auto channels) {
        constexpr int V = decltype(channels)::value;
        const auto kernel = source   ? values ? backward_kernel<true, true, V, S> : backward_kernel<true, false, V, S>
                            : values ? backward_kernel<false, true, V, S>
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
