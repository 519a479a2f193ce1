// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's rows only. A forward sweep in vectors of samples carries the
// transmittance, a backward sweep the sum of what lies behind. What one sweep leaves for the next is in scratch rows,
// which stay in the nearest cache. They are padded to whole vectors: the padding repeats the last distance, so that its
// opacity is 0.
#include "ops/composite_rays.h"

#include "math/lanes.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kBlock = 16;  // a multiple of every vector width

// Scratch rows of one ray; elements -1 and `size` exist in each.
template <typename T>
struct Ray {
  int64_t num_samples, size;  // size: padded
  T *sdf, *position, *weight, *transmittance, *occupied, *cotangent, *slope;
};

constexpr int64_t kRows = 7;

static inline int64_t padded(int64_t num_samples) { return (num_samples + kBlock - 1) / kBlock * kBlock; }

template <typename T>
static int64_t scratch_size(const CompositeRaysArgs<T>& a) {
  return kRows * (padded(a.num_samples) + 2 * kBlock) + kBlock;
}

template <typename T>
static Ray<T> make_ray(int64_t num_samples, T* scratch) {
  const int64_t size = padded(num_samples), stride = size + 2 * kBlock;
  T* first = (T*)((uintptr_t(scratch) + 63) / 64 * 64) + kBlock;  // aligned to 64 bytes
  for (int64_t row = 0; row < kRows; ++row) {
    first[row * stride - 1] = T(0);
    for (int64_t i = num_samples; i <= size; ++i) first[row * stride + i] = T(0);
  }
  return {num_samples, size, first, first + stride, first + 2 * stride, first + 3 * stride,
          first + 4 * stride, first + 5 * stride, first + 6 * stride};
}

template <typename T>
static inline void copy_row(const T* __restrict from, T* __restrict to, int64_t n) {
  for (int64_t i = 0; i < n; ++i) to[i] = from[i];
}

template <typename T>
static inline void prefetch_row(const T* row, int64_t n) {
  for (int64_t i = 0; i < n; i += 64 / int64_t(sizeof(T))) __builtin_prefetch(row + i);
}

// prod_{j<i} (1 - alpha_j) for the lanes i of a vector, and onwards. In double, so that small opacities count in full.
template <typename T>
struct Transmittance {
  static constexpr int W = kWidth<double>;
  using Wide = Vec<double, W>;
  Wide carry = splat<W>(1.0);

  inline __attribute__((always_inline)) Wide advance(Wide alpha, Wide passed) {
    const Wide one = splat<W>(1.0);
    const Wide product = prefix_product<double, W>(alpha < 0.5 ? one - alpha : passed);
    const Wide before = carry * shift_up<1, double, W>(product, one);
    carry = carry * broadcast<W - 1, double, W>(product);
    return before;
  }

  inline __attribute__((always_inline)) Vec<T, kWidth<T>> operator()(Vec<T, kWidth<T>> alpha,
                                                                     Vec<T, kWidth<T>> passed) {
    if constexpr (sizeof(T) == sizeof(double)) {
      return advance(alpha, passed);
    } else {
      const auto a = widen(alpha), p = widen(passed);
      const Wide low = advance(a.low, p.low);
      return narrow({low, advance(a.high, p.high)});
    }
  }
};

// Fills the ray's weights; for the backward pass transmittance and occupied too.
template <bool kBackward, typename T>
static inline void weigh(const CompositeRaysArgs<T>& a, int64_t index, const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  using V = Vec<T, W>;
  const int64_t last = ray.num_samples - 1;
  copy_row(a.sdf + index * ray.num_samples, ray.sdf, ray.num_samples);
  for (int64_t i = last + 1; i <= ray.size; ++i) ray.sdf[i] = ray.sdf[last];
  ray.sdf[-1] = ray.sdf[0];
  const T inv_s = a.inv_s;
  Transmittance<T> transmittance;
  for (int64_t i = 0; i < ray.size; i += W) {
    const V sdf = load<W>(ray.sdf + i), next_sdf = load<W>(ray.sdf + i + 1);
    const Phi<V> next = phi(inv_s, next_sdf);
    const PairAlpha<V> pair = pair_alpha(inv_s, sdf, next_sdf, next);
    const V before = transmittance(pair.alpha, pair.passed);
    store(ray.weight + i, before * pair.alpha);
    if (kBackward || i + W > last) store(ray.transmittance + i, before);
    if (kBackward) store(ray.occupied + i + 1, next.occupied);
  }
  if (kBackward) {
    ray.occupied[0] = phi(inv_s, ray.sdf[0]).occupied;
    ray.transmittance[ray.size] = T(transmittance.carry[0]);
  }
  ray.weight[last] = a.last_opaque ? ray.transmittance[last] : T(0) * ray.transmittance[last];
  for (int64_t i = last + 1; i < ray.size; ++i) ray.weight[i] = T(0);
}

// Where each weight is counted.
template <typename T>
static inline void place(const CompositeRaysArgs<T>& a, int64_t index, const Ray<T>& ray) {
  const T* __restrict t = a.t + index * ray.num_samples;
  copy_row(t, ray.position, ray.num_samples);
  if (!a.depth_mid) return;
  constexpr int W = kWidth<T>;
  const int64_t last = ray.num_samples - 1;
  for (int64_t i = 0; i < last; i += W) {
    store(ray.position + i, T(0.5) * (load<W>(ray.position + i) + load<W>(ray.position + i + 1)));
  }
  for (int64_t i = last + 1; i < ray.size; ++i) ray.position[i] = T(0);
  ray.position[last] = t[last];
}

// --- Channels, in blocks of W columns ------------------------------------------------------------
// The last block of a row is moved left to end with it, so that no load crosses the row's end; columns that two
// blocks share are computed twice and, in sums over columns, counted once.
constexpr int kMaxBlocks = 4;

template <int W, int kBlocks, typename T>
static inline void render_blocks(const T* weight, const T* values, int64_t num_samples, int64_t channels,
                                 const int64_t* offset, T* out) {
  Vec<T, W> acc[kBlocks] = {};
  for (int64_t i = 0; i < num_samples; ++i) {
    const T* row = values + i * channels;
    for (int b = 0; b < kBlocks; ++b) acc[b] += load<W>(row + offset[b]) * weight[i];
  }
  for (int b = 0; b < kBlocks; ++b) store(out + offset[b], acc[b]);
}

// One block of kSamples samples: cotangent[i] += values[i] . grad_once and grad_values[i] = weight[i] grad.
template <int W, int kBlocks, bool kDot, bool kOuter, typename T>
static inline __attribute__((always_inline)) void channel_gradient_tile(
    const T* weight, const T* values, int count, int64_t channels, const int64_t* offset, const Vec<T, W>* grad,
    const Vec<T, W>* grad_once, T* cotangent, T* grad_values) {
  Vec<T, W> rows[W];
  for (int i = 0; i < W; ++i) {
    rows[i] = Vec<T, W>{};
    if (i >= count) continue;
    for (int b = 0; b < kBlocks; ++b) {
      if (kDot) rows[i] += load<W>(values + i * channels + offset[b]) * grad_once[b];
      if (kOuter) store(grad_values + i * channels + offset[b], grad[b] * weight[i]);
    }
  }
  if (kDot) store(cotangent, load<W>(cotangent) + row_sums<T, W>(rows));
}

template <int W, int kBlocks, bool kDot, bool kOuter, typename T>
static inline void channel_gradient_blocks(const T* weight, const T* values, int64_t num_samples, int64_t channels,
                                           const int64_t* offset, const int64_t* fresh, const T* grad, T* cotangent,
                                           T* grad_values) {
  Vec<T, W> full[kBlocks], once[kBlocks];
  for (int b = 0; b < kBlocks; ++b) {
    full[b] = load<W>(grad + offset[b]);
    T lane[W];
    for (int c = 0; c < W; ++c) lane[c] = offset[b] + c < fresh[b] ? T(0) : grad[offset[b] + c];
    once[b] = load<W>(lane);
  }
  int64_t i = 0;
  for (; i + W <= num_samples; i += W) {
    channel_gradient_tile<W, kBlocks, kDot, kOuter>(weight + i, values + i * channels, W, channels, offset, full, once,
                                                    cotangent + i, grad_values + i * channels);
  }
  if (i < num_samples) {
    channel_gradient_tile<W, kBlocks, kDot, kOuter>(weight + i, values + i * channels, int(num_samples - i), channels,
                                                    offset, full, once, cotangent + i, grad_values + i * channels);
  }
}

// Offsets of up to kMaxBlocks blocks from column `begin` on; fresh[b] is the first column that no earlier block holds.
template <int W>
static inline int plan_blocks(int64_t begin, int64_t channels, int64_t* offset, int64_t* fresh) {
  int count = 0;
  for (int64_t column = begin; column < channels && count < kMaxBlocks; column += W, ++count) {
    offset[count] = column + W <= channels ? column : channels - W;
    fresh[count] = column;
  }
  return count;
}

template <int W, typename T>
static void render_channels(const T* weight, const T* values, int64_t num_samples, int64_t channels, T* out) {
  if constexpr (W > 1) {
    if (channels < W) return render_channels<W / 2>(weight, values, num_samples, channels, out);
  }
  for (int64_t begin = 0; begin < channels; begin += kMaxBlocks * W) {
    int64_t offset[kMaxBlocks], fresh[kMaxBlocks];
    switch (plan_blocks<W>(begin, channels, offset, fresh)) {
      case 1: render_blocks<W, 1>(weight, values, num_samples, channels, offset, out); break;
      case 2: render_blocks<W, 2>(weight, values, num_samples, channels, offset, out); break;
      case 3: render_blocks<W, 3>(weight, values, num_samples, channels, offset, out); break;
      default: render_blocks<W, 4>(weight, values, num_samples, channels, offset, out);
    }
  }
}

template <int W, bool kDot, bool kOuter, typename T>
static void channel_gradients(const T* weight, const T* values, int64_t num_samples, int64_t channels, const T* grad,
                              T* cotangent, T* grad_values) {
  if constexpr (W > 1) {
    if (channels < W) {
      return channel_gradients<W / 2, kDot, kOuter>(weight, values, num_samples, channels, grad, cotangent,
                                                    grad_values);
    }
  }
  for (int64_t begin = 0; begin < channels; begin += kMaxBlocks * W) {
    int64_t offset[kMaxBlocks], fresh[kMaxBlocks];
#define PRED_BLOCKS(n)                                                                                         \
  channel_gradient_blocks<W, n, kDot, kOuter>(weight, values, num_samples, channels, offset, fresh, grad, cotangent, \
                                              grad_values)
    switch (plan_blocks<W>(begin, channels, offset, fresh)) {
      case 1: PRED_BLOCKS(1); break;
      case 2: PRED_BLOCKS(2); break;
      case 3: PRED_BLOCKS(3); break;
      default: PRED_BLOCKS(4);
    }
#undef PRED_BLOCKS
  }
}

// --- Rays ----------------------------------------------------------------------------------------
template <typename T>
static void forward(const CompositeRaysArgs<T>& a, const CompositeRaysOutputs<T>& out, T* scratch, int64_t begin,
                    int64_t end) {
  constexpr int W = kWidth<T>;
  const Ray<T> ray = make_ray(a.num_samples, scratch);
  for (int64_t index = begin; index < end; ++index) {
    if (index + 1 < end) {
      prefetch_row(a.sdf + (index + 1) * ray.num_samples, ray.num_samples);
      prefetch_row(a.t + (index + 1) * ray.num_samples, ray.num_samples);
    }
    weigh<false>(a, index, ray);
    place(a, index, ray);
    copy_row(ray.weight, out.weights + index * ray.num_samples, ray.num_samples);
    Vec<T, W> depth{}, opacity{};
    for (int64_t i = 0; i < ray.size; i += W) {
      const Vec<T, W> weight = load<W>(ray.weight + i);
      depth += weight * load<W>(ray.position + i);
      opacity += weight;
    }
    out.depth[index] = sum<T, W>(depth);
    out.opacity[index] = sum<T, W>(opacity);
    if (a.values) {
      render_channels<W>(ray.weight, a.values + index * ray.num_samples * a.channels, ray.num_samples, a.channels,
                         out.values + index * a.channels);
    }
  }
}

// ray.cotangent = dL/dweight; fills grad_values on the way.
template <typename T>
static inline void backward_outputs(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad,
                                    int64_t index, const Ray<T>& ray, bool need_cotangent, T* grad_values) {
  constexpr int W = kWidth<T>;
  if (need_cotangent) {
    const T opacity = grad.opacity ? grad.opacity[index] : T(0);
    if (grad.weights) {
      copy_row(grad.weights + index * ray.num_samples, ray.cotangent, ray.num_samples);
    } else {
      for (int64_t i = 0; i < ray.size; i += W) store(ray.cotangent + i, Vec<T, W>{});
    }
    const T depth = grad.depth ? grad.depth[index] : T(0);
    for (int64_t i = 0; i < ray.size; i += W) {
      Vec<T, W> total = load<W>(ray.cotangent + i) + opacity;
      if (grad.depth) total += depth * load<W>(ray.position + i);
      store(ray.cotangent + i, total);
    }
  }
  if (!grad.values) return;
  const int64_t at = index * ray.num_samples * a.channels;
  const T* channel_grad = grad.values + index * a.channels;
  if (need_cotangent && grad_values) {
    channel_gradients<W, true, true>(ray.weight, a.values + at, ray.num_samples, a.channels, channel_grad,
                                     ray.cotangent, grad_values + at);
  } else if (need_cotangent) {
    channel_gradients<W, true, false>(ray.weight, a.values + at, ray.num_samples, a.channels, channel_grad,
                                      ray.cotangent, (T*)nullptr);
  } else if (grad_values) {
    channel_gradients<W, false, true>(ray.weight, (const T*)nullptr, ray.num_samples, a.channels, channel_grad,
                                      ray.cotangent, grad_values + at);
  }
}

// From ray.cotangent to ray.slope, the gradient of inv_s * sdf. Returns sum(slope * sdf), the gradient of inv_s.
template <typename T>
static inline T backward_distances(const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  using V = Vec<T, W>;
  V carry{}, total{};
  for (int64_t i = ray.size - W; i >= 0; i -= W) {
    const V sdf = load<W>(ray.sdf + i);
    const V cotangent = load<W>(ray.cotangent + i), cotangent_before = load<W>(ray.cotangent + i - 1);
    const V transmittance = load<W>(ray.transmittance + i), transmittance_after = load<W>(ray.transmittance + i + 1);
    const V sums = suffix_sum<T, W>(load<W>(ray.weight + i) * cotangent);
    const V from_here = carry + sums, behind = carry + shift_down<1, T, W>(sums, V{});
    carry += broadcast<0, T, W>(sums);
    const auto falls_before = load<W>(ray.sdf + i - 1) > sdf, falls_after = sdf > load<W>(ray.sdf + i + 1);
    // H_i and H_{i-1}; S_{i-1} is the sum from here on.
    const V after = falls_after ? transmittance_after * cotangent - behind : V{};
    const V before = falls_before ? transmittance * cotangent_before - from_here : V{};
    const V both = transmittance * (cotangent - cotangent_before);
    const V slope = load<W>(ray.occupied + i) * ((falls_before & falls_after) ? both : after - before);
    store(ray.slope + i, slope);
    total += slope * sdf;
  }
  return sum<T, W>(total);
}

template <typename T>
static inline void backward_positions(const CompositeRaysArgs<T>& a, T grad_depth, const Ray<T>& ray,
                                      T* __restrict grad_t) {
  const T* __restrict weight = ray.weight;
  const int64_t last = ray.num_samples - 1;
  if (!a.depth_mid) {
    for (int64_t i = 0; i <= last; ++i) grad_t[i] = grad_depth * weight[i];
    return;
  }
  // Sample i ends section i - 1 and starts section i; the last sample counts at itself. weight[-1] = 0.
  for (int64_t i = 0; i < last; ++i) grad_t[i] = T(0.5) * grad_depth * (weight[i - 1] + weight[i]);
  grad_t[last] = grad_depth * (T(0.5) * weight[last - 1] + weight[last]);
}

template <typename T>
static void backward(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad, const T* weights,
                     const CompositeRaysGradients<T>& out, T* scratch, int64_t begin, int64_t end) {
  const Ray<T> ray = make_ray(a.num_samples, scratch);
  const bool need_cotangent = out.sdf || out.inv_s;
  for (int64_t index = begin; index < end; ++index) {
    if (weights) {
      copy_row(weights + index * ray.num_samples, ray.weight, ray.num_samples);
    } else {
      if (index + 1 < end) {
        prefetch_row(a.sdf + (index + 1) * ray.num_samples, ray.num_samples);
        prefetch_row(a.t + (index + 1) * ray.num_samples, ray.num_samples);
      }
      weigh<true>(a, index, ray);
      place(a, index, ray);
    }
    backward_outputs(a, grad, index, ray, need_cotangent, out.values);
    if (out.t) backward_positions(a, grad.depth[index], ray, out.t + index * ray.num_samples);
    if (!need_cotangent) continue;
    const T grad_inv_s = backward_distances(ray);
    if (out.inv_s) out.inv_s[index] = double(grad_inv_s);
    if (out.sdf) {
      T* __restrict grad_sdf = out.sdf + index * ray.num_samples;
      for (int64_t i = 0; i < ray.num_samples; ++i) grad_sdf[i] = a.inv_s * ray.slope[i];
    }
  }
}

}  // namespace

const CompositeRaysKernels<float> composite_rays_f32 = {scratch_size<float>, forward<float>, backward<float>};
const CompositeRaysKernels<double> composite_rays_f64 = {scratch_size<double>, forward<double>, backward<double>};

}  // namespace pred::PRED_ISA
