// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray, as in composite_cpu.h. The backward pass has the transmittance again from the opacities,
// in double, going along the ray, and D, in double too, coming back.
#include "ops/composite_alpha.h"
#include "ops/composite_cpu.h"

namespace pred::PRED_ISA {
namespace {

// Scan from the last lane on: lane i gets value_i + factor_i (value_{i+1} + factor_{i+1} (...)), and the product of
// factors from i on.
template <int N, int K = 1>
inline __attribute__((always_inline)) void suffix_affine(Vec<double, N>& factor, Vec<double, N>& value) {
  if constexpr (K < N) {
    value += factor * shift_down<K, double, N>(value, Vec<double, N>{});
    factor *= shift_down<K, double, N>(factor, splat<N>(1.0));
    suffix_affine<N, 2 * K>(factor, value);
  }
}

template <typename S>
struct GivenField {
  using T = Compute<S>;
  static constexpr int D = kWidth<double>;
  using Wide = Vec<double, D>;
  static constexpr int kForwardLoops = kWidth<T> / D, kBackwardLoops = kForwardLoops + 1;

  const CompositeAlphaArgs<S>& a;
  double transmittance = 1;

  explicit GivenField(const CompositeAlphaArgs<S>& args) : a(args) {}

  inline const T* start(const Ray<T>& ray, int64_t at) const {
    if (ray.whole) return a.source + at;
    copy_row(a.source + at, ray.alpha, ray.num_samples);
    return ray.alpha;
  }

  static inline void opacities(const Ray<T>&, int64_t, int64_t, Ahead<T>&) {}

  static inline void fetch_in_scan(int64_t i, Ahead<T>& ahead) {
    if (i % kWidth<T> == 0) ahead.fetch_rows(i);
    ahead.fetch_values();
  }

  inline Wide passed(const Ray<T>&, Wide alpha, int64_t) const { return (1.0 - alpha) + a.eps; }

  inline const T* start_backward(const Ray<T>& ray, int64_t at, const CompositeSaved<T>&, bool) {
    copy_row(a.source + at, ray.alpha, ray.num_samples);  // where element `size` can be read
    transmittance = 1;
    return ray.weight;
  }

  inline void backward_chunk(const Ray<T>& ray, int64_t begin, int64_t end, bool, Ahead<T>& ahead) {
    weigh<true>(*this, ray, ray.alpha, begin, end, ahead, transmittance, ray.weight);
  }

  inline T backward_end(const Ray<T>& ray, T, const T*, T* grad_alpha) const {
    Wide behind{};
    for (int64_t i = ray.size - D; i >= 0; i -= D) {
      const Wide here = load_wide(ray.cotangent + i), next = load_wide(ray.cotangent + i + 1);
      Wide factor = (1.0 - load_wide(ray.alpha + i + 1)) + a.eps;
      Wide value = (here - next) - a.eps * next;
      suffix_affine<D>(factor, value);
      value += factor * behind;
      store_narrow(grad_alpha + i, load_wide(ray.transmittance + i) * value);
      behind = broadcast<0, double, D>(value);
    }
    return T(0);
  }
};

}  // namespace

#define PRED_TABLE(S, name)                                 \
  const CompositeAlphaKernels<S> composite_alpha_##name = { \
      scratch_size<CompositeAlphaArgs<S>>, composite_forward<GivenField<S>>, composite_backward<GivenField<S>>};
PRED_TABLE(float, f32)
PRED_TABLE(double, f64)
PRED_TABLE(BFloat16, bf16)
PRED_TABLE(Float16, f16)
#undef PRED_TABLE

}  // namespace pred::PRED_ISA
