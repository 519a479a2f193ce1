// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray, as in composite_cpu.h. The padding of distances repeats the last one, so that its
// opacity is 0.
#include "ops/composite_cpu.h"
#include "ops/composite_rays.h"

namespace pred::PRED_ISA {
namespace {

template <typename S>
struct DistanceField {
  using T = Compute<S>;
  static constexpr int kForwardLoops = 3, kBackwardLoops = 2;

  const CompositeRaysArgs<S>& a;
  const ExpScale<T> s;

  explicit DistanceField(const CompositeRaysArgs<S>& args) : a(args), s(exp_scale(*args.inv_s)) {}

  inline void read_distances(const Ray<T>& ray, int64_t at) const {
    const int64_t last = ray.num_samples - 1;
    copy_row(a.source + at, ray.sdf, ray.num_samples);
    for (int64_t i = last + 1; i <= ray.size; ++i) ray.sdf[i] = ray.sdf[last];
    ray.sdf[-1] = ray.sdf[0];
  }

  inline const T* start(const Ray<T>& ray, int64_t at) const {
    read_distances(ray, at);
    return ray.alpha;
  }

  inline void opacities(const Ray<T>& ray, int64_t begin, int64_t end, Ahead<T>& ahead) const {
    constexpr int W = kWidth<T>;
    using V = Vec<T, W>;
    for (int64_t i = begin; i < end; i += W) {
      ahead.fetch_rows(i);
      ahead.fetch_values();
      const Phi<V> next = phi(s, load<W>(ray.sdf + i + 1));
      store(ray.free + i, next.free);
      store(ray.occupied + i, next.occupied);
    }
    for (int64_t i = begin; i < end; i += W) {
      ahead.fetch_values();
      const Phi<V> next{load<W>(ray.free + i), load<W>(ray.occupied + i)};
      const PairAlpha<V> pair = pair_alpha(s, load<W>(ray.sdf + i), load<W>(ray.sdf + i + 1), next);
      store(ray.alpha + i, pair.alpha);
      store(ray.passed + i, pair.passed);
    }
    const int64_t last = ray.num_samples - 1;
    if (end <= last) return;
    ray.alpha[last] = a.last_opaque ? T(1) : T(0);
    ray.passed[last] = a.last_opaque ? T(0) : T(1);
    for (int64_t i = last + 1; i < end; ++i) ray.alpha[i] = T(0);
  }

  static inline void fetch_in_scan(int64_t i, Ahead<T>& ahead) {
    if (i % kWidth<T> == 0) ahead.fetch_values();
  }

  template <class Wide>
  static inline Wide passed(const Ray<T>& ray, Wide alpha, int64_t i) {
    return alpha < 0.5 ? 1.0 - alpha : load_wide(ray.passed + i);
  }

  inline const T* start_backward(const Ray<T>& ray, int64_t at, const CompositeSaved<T>& saved, bool need) const {
    if (need) read_distances(ray, at);
    if (ray.whole) return saved.weights + at;
    copy_row(saved.weights + at, ray.weight, ray.num_samples);
    return ray.weight;
  }

  inline void backward_chunk(const Ray<T>& ray, int64_t begin, int64_t end, bool need, Ahead<T>& ahead) const {
    constexpr int W = kWidth<T>;
    for (int64_t i = begin; need && i < end; i += W) {
      ahead.fetch_rows(i);
      ahead.fetch_values();
      store(ray.occupied + i, phi(s, load<W>(ray.sdf + i)).occupied);
    }
  }

  inline T backward_end(const Ray<T>& ray, T remaining, const T* weight, T* grad_sdf) const {
    constexpr int W = kWidth<T>;
    using V = Vec<T, W>;
    const T inv_s = *a.inv_s;
    // Sums over what lies behind, of weights and of weights times cotangents. Transmittance is the former and what
    // remains: a sum of positive numbers, as exact where next to nothing is left as where all is.
    V transmittance_behind = splat<W>(remaining), gain_behind{}, total{};
    for (int64_t i = ray.size - W; i >= 0; i -= W) {
      const V sdf = load<W>(ray.sdf + i);
      const V cotangent = load<W>(ray.cotangent + i), cotangent_before = load<W>(ray.cotangent + i - 1);
      const V weights = suffix_sum<T, W>(load<W>(weight + i)),
              gains = suffix_sum<T, W>(load<W>(weight + i) * cotangent);
      const V transmittance = transmittance_behind + weights;
      const V transmittance_after = transmittance_behind + shift_down<1, T, W>(weights, V{});
      const auto falls_before = load<W>(ray.sdf + i - 1) > sdf, falls_after = sdf > load<W>(ray.sdf + i + 1);
      // H_i and H_{i-1}; S_{i-1} is the sum from here on.
      const V after = transmittance_after * cotangent - (gain_behind + shift_down<1, T, W>(gains, V{}));
      const V before = transmittance * cotangent_before - (gain_behind + gains);
      const V slope =
          slope_of_distance(load<W>(ray.occupied + i), falls_before, falls_after, transmittance, cotangent_before,
                            cotangent, falls_before ? before : V{}, falls_after ? after : V{});
      store(grad_sdf + i, inv_s * slope);
      total += slope * sdf;
      transmittance_behind += broadcast<0, T, W>(weights);
      gain_behind += broadcast<0, T, W>(gains);
    }
    return sum<T, W>(total);
  }
};

}  // namespace

#define PRED_TABLE(S, name)                               \
  const CompositeRaysKernels<S> composite_rays_##name = { \
      scratch_size<CompositeRaysArgs<S>>, composite_forward<DistanceField<S>>, composite_backward<DistanceField<S>>};
PRED_TABLE(float, f32)
PRED_TABLE(double, f64)
PRED_TABLE(BFloat16, bf16)
PRED_TABLE(Float16, f16)
#undef PRED_TABLE

}  // namespace pred::PRED_ISA
