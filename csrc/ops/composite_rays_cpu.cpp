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
constexpr int64_t kChunk = 64;  // samples between turns of computing opacities and of using them on channels

// Scratch rows of one ray; elements -1 and `size` exist in each.
template <typename T>
struct Ray {
  int64_t num_samples, size;  // size: padded
  T *sdf, *position, *weight, *transmittance, *occupied, *cotangent, *slope, *alpha, *passed;
  T* channels;  // [C] in blocks of a vector's width
  T* buffer;    // [kBlock, C]
};

constexpr int64_t kRows = 9;

static inline int64_t padded(int64_t num_samples) { return (num_samples + kBlock - 1) / kBlock * kBlock; }

template <typename T>
static int64_t scratch_size(const CompositeRaysArgs<T>& a) {
  return kRows * (padded(a.num_samples) + 2 * kBlock) + padded(a.channels + kBlock) + kBlock * a.channels + 2 * kBlock;
}

template <typename T>
static Ray<T> make_ray(const CompositeRaysArgs<T>& a, T* scratch) {
  const int64_t size = padded(a.num_samples), stride = size + 2 * kBlock;
  T* row = (T*)((uintptr_t(scratch) + 63) / 64 * 64) + kBlock;  // aligned to 64 bytes
  Ray<T> ray;
  ray.num_samples = a.num_samples;
  ray.size = size;
  for (T** at : {&ray.sdf, &ray.position, &ray.weight, &ray.transmittance, &ray.occupied, &ray.cotangent, &ray.slope,
                 &ray.alpha, &ray.passed}) {
    row[-1] = T(0);
    for (int64_t i = a.num_samples; i <= size; ++i) row[i] = T(0);
    *at = row;
    row += stride;
  }
  ray.channels = row;
  ray.buffer = row + padded(a.channels + kBlock);
  return ray;
}

template <typename T>
static inline void copy_row(const T* __restrict from, T* __restrict to, int64_t n) {
  for (int64_t i = 0; i < n; ++i) to[i] = from[i];
}

// What the memory system fetches while opacities are computed, a little with each vector: the values that the next chunk
// needs, and the next ray's rows. Addresses past a tensor's end do no harm.
template <typename T>
struct Ahead {
  const T *next_sdf, *next_t;  // [S]
  const T* output;             // [S], to be written
  const T* values;             // [S, channels], a chunk ahead
  int64_t channels;

  inline __attribute__((always_inline)) void fetch(int64_t i, int64_t count) const {
    constexpr int64_t line = 64 / int64_t(sizeof(T));
    __builtin_prefetch(next_sdf + i);
    __builtin_prefetch(next_t + i);
    __builtin_prefetch(output + i, 1);
    for (int64_t k = i * channels; k < (i + count) * channels; k += line) __builtin_prefetch(values + k);
  }
};

template <typename T>
static inline Ahead<T> look_ahead(const CompositeRaysArgs<T>& a, int64_t index, int64_t end, const T* output) {
  const int64_t next = index + 1 < end ? index + 1 : index;
  const T* values = (const T*)(uintptr_t(a.values) + (index * a.num_samples + kChunk) * a.channels * sizeof(T));
  return {a.sdf + next * a.num_samples, a.t + next * a.num_samples, output, values, a.channels};
}

// prod_{j<i} (1 - alpha_j) for the lanes i of a vector, and onwards. In double, so that small opacities count in full.
template <typename T>
struct Transmittance {
  static constexpr int W = kWidth<double>;
  using Wide = Vec<double, W>;
  using V = Vec<T, kWidth<T>>;
  Wide carry = splat<W>(1.0);

  static inline __attribute__((always_inline)) Wide factor(Wide alpha, Wide passed) {
    return alpha < 0.5 ? 1.0 - alpha : passed;
  }

  inline __attribute__((always_inline)) Wide advance(Wide factors) {
    const Wide product = prefix_product<double, W>(factors);
    const Wide before = carry * shift_up<1, double, W>(product, splat<W>(1.0));
    carry = carry * broadcast<W - 1, double, W>(product);
    return before;
  }

  inline __attribute__((always_inline)) V operator()(V alpha, V passed) {
    if constexpr (sizeof(T) == sizeof(double)) {
      return advance(factor(alpha, passed));
    } else {
      const auto a = widen(alpha), p = widen(passed);
      const Wide low = advance(factor(a.low, p.low));
      return narrow({low, advance(factor(a.high, p.high))});
    }
  }
};

template <typename T>
static inline void read_distances(const CompositeRaysArgs<T>& a, int64_t index, const Ray<T>& ray) {
  const int64_t last = ray.num_samples - 1;
  copy_row(a.sdf + index * ray.num_samples, ray.sdf, ray.num_samples);
  for (int64_t i = last + 1; i <= ray.size; ++i) ray.sdf[i] = ray.sdf[last];
  ray.sdf[-1] = ray.sdf[0];
}

// Fills the weights of samples [begin, end); for the backward pass their transmittance and `occupied` too.
template <bool kBackward, typename T>
static inline void weigh(const CompositeRaysArgs<T>& a, const Ray<T>& ray, int64_t begin, int64_t end,
                         const Ahead<T>& ahead, Transmittance<T>& transmittance) {
  constexpr int W = kWidth<T>;
  using V = Vec<T, W>;
  const T inv_s = a.inv_s;
  // Two loops: one chain of both would hold so many instructions that few vectors are in flight at once.
  for (int64_t i = begin; i < end; i += W) {
    ahead.fetch(i, W);
    const V sdf = load<W>(ray.sdf + i), next_sdf = load<W>(ray.sdf + i + 1);
    const Phi<V> next = phi(inv_s, next_sdf);
    const PairAlpha<V> pair = pair_alpha(inv_s, sdf, next_sdf, next);
    store(ray.alpha + i, pair.alpha);
    store(ray.passed + i, pair.passed);
    if (kBackward) store(ray.occupied + i + 1, next.occupied);
  }
  const int64_t last = ray.num_samples - 1;
  if (end > last) {
    ray.alpha[last] = a.last_opaque ? T(1) : T(0);
    for (int64_t i = last + 1; i < end; ++i) ray.alpha[i] = T(0);
  }
  for (int64_t i = begin; i < end; i += W) {
    const V alpha = load<W>(ray.alpha + i), before = transmittance(alpha, load<W>(ray.passed + i));
    store(ray.weight + i, before * alpha);
    if (kBackward) store(ray.transmittance + i, before);
  }
  if (end > last) {
    for (int64_t i = last + 1; i < end; ++i) ray.weight[i] = T(0);  // 0 times NaN
  }
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

template <int W>
static inline int64_t num_blocks(int64_t channels) {
  return (channels + W - 1) / W;
}

template <int W>
static inline int64_t block_offset(int64_t block, int64_t channels) {
  return (block + 1) * W <= channels ? block * W : channels - W;
}

template <int W, int kBlocks, typename T>
static inline void render_blocks(const T* weight, const T* values, int64_t num_samples, int64_t channels,
                                 int64_t first, T* sum) {
  Vec<T, W> even[kBlocks], odd[kBlocks] = {};  // two chains of sums are faster than one
  int64_t offset[kBlocks];
  for (int b = 0; b < kBlocks; ++b) {
    offset[b] = block_offset<W>(first + b, channels);
    even[b] = load<W>(sum + (first + b) * W);
  }
  for (int64_t i = 0; i + 1 < num_samples; i += 2) {
    const T *row = values + i * channels, *next = row + channels;
    for (int b = 0; b < kBlocks; ++b) {
      even[b] += load<W>(row + offset[b]) * weight[i];
      odd[b] += load<W>(next + offset[b]) * weight[i + 1];
    }
  }
  const T* row = values + (num_samples - 1) * channels;
  for (int b = 0; b < kBlocks; ++b) {
    if (num_samples % 2 != 0) even[b] += load<W>(row + offset[b]) * weight[num_samples - 1];
    store(sum + (first + b) * W, even[b] + odd[b]);
  }
}

// sum += sum_i weight[i] values[i], block by block
template <int W, typename T>
static void render_channels(const T* weight, const T* values, int64_t num_samples, int64_t channels, T* sum) {
  if constexpr (W > 1) {
    if (channels < W) return render_channels<W / 2>(weight, values, num_samples, channels, sum);
  }
  const int64_t blocks = num_blocks<W>(channels);
  for (int64_t first = 0; first < blocks; first += kMaxBlocks) {
    switch (blocks - first) {
      case 1: render_blocks<W, 1>(weight, values, num_samples, channels, first, sum); break;
      case 2: render_blocks<W, 2>(weight, values, num_samples, channels, first, sum); break;
      case 3: render_blocks<W, 3>(weight, values, num_samples, channels, first, sum); break;
      default: render_blocks<W, 4>(weight, values, num_samples, channels, first, sum);
    }
  }
}

// From blocks to columns and back; to_blocks puts 0 where an earlier block has the column.
template <int W, typename T>
static void from_blocks(const T* blocks, int64_t channels, T* out) {
  if constexpr (W > 1) {
    if (channels < W) return from_blocks<W / 2>(blocks, channels, out);
  }
  for (int64_t block = 0; block < num_blocks<W>(channels); ++block) {
    store(out + block_offset<W>(block, channels), load<W>(blocks + block * W));
  }
}

template <int W, typename T>
static void to_blocks(const T* in, int64_t channels, T* blocks) {
  if constexpr (W > 1) {
    if (channels < W) return to_blocks<W / 2>(in, channels, blocks);
  }
  for (int64_t block = 0; block < num_blocks<W>(channels); ++block) {
    const int64_t offset = block_offset<W>(block, channels);
    for (int c = 0; c < W; ++c) blocks[block * W + c] = offset + c < block * W ? T(0) : in[offset + c];
  }
}

// W samples (fewer where !kFull), a few blocks: cotangent[i] += values[i] . grad and grad_values[i] = weight[i] grad.
// `once` holds grad block by block, with 0 for columns that an earlier block has.
template <int W, int kBlocks, bool kDot, bool kOuter, bool kFull, typename T>
static inline void channel_gradient_tile(const T* weight, const T* values, int64_t count, int64_t channels,
                                         int64_t first, const T* grad, const T* once, T* cotangent, T* grad_values) {
  Vec<T, W> rows[W], full[kBlocks], part[kBlocks];
  int64_t offset[kBlocks];
  for (int b = 0; b < kBlocks; ++b) {
    offset[b] = block_offset<W>(first + b, channels);
    full[b] = load<W>(grad + offset[b]);
    part[b] = load<W>(once + (first + b) * W);
  }
#pragma GCC unroll 16
  for (int i = 0; i < W; ++i) {
    rows[i] = Vec<T, W>{};
    if (!kFull && i >= count) continue;
    for (int b = 0; b < kBlocks; ++b) {
      if (kDot) rows[i] += load<W>(values + i * channels + offset[b]) * part[b];
      if (kOuter) store(grad_values + i * channels + offset[b], full[b] * weight[i]);
    }
  }
  if (kDot) store(cotangent, load<W>(cotangent) + row_sums<T, W>(rows));
}

// All blocks of up to kBlock samples.
template <int W, bool kDot, bool kOuter, typename T>
static inline void channel_gradient_block(const T* weight, const T* values, int64_t count, int64_t channels,
                                          const T* grad, const T* once, T* cotangent, T* grad_values) {
  const int64_t blocks = num_blocks<W>(channels);
  for (int64_t i = 0; i < count; i += W) {
    for (int64_t first = 0; first < blocks; first += kMaxBlocks) {
#define PRED_TILE(n, full)                                                                                     \
  channel_gradient_tile<W, n, kDot, kOuter, full>(weight + i, values + i * channels, count - i, channels, first, grad, \
                                                  once, cotangent + i, grad_values + i * channels)
      const int64_t left = blocks - first;
      if (i + W <= count) {
        if (left == 1) PRED_TILE(1, true);
        else if (left == 2) PRED_TILE(2, true);
        else if (left == 3) PRED_TILE(3, true);
        else PRED_TILE(4, true);
      } else {
        if (left == 1) PRED_TILE(1, false);
        else if (left == 2) PRED_TILE(2, false);
        else if (left == 3) PRED_TILE(3, false);
        else PRED_TILE(4, false);
      }
#undef PRED_TILE
    }
  }
}

// A chunk. `buffer` has room for kBlock samples; `stream`: store grad_values past the caches.
template <int W, bool kDot, bool kOuter, typename T>
static void channel_gradients(const T* weight, const T* values, int64_t num_samples, int64_t channels, const T* grad,
                              const T* once, T* cotangent, T* grad_values, T* buffer, bool stream) {
  if constexpr (W > 1) {
    if (channels < W) {
      return channel_gradients<W / 2, kDot, kOuter>(weight, values, num_samples, channels, grad, once, cotangent,
                                                    grad_values, buffer, stream);
    }
  }
  for (int64_t i = 0; i < num_samples; i += kBlock) {
    const int64_t count = num_samples - i < kBlock ? num_samples - i : kBlock, at = i * channels;
    T* out = stream ? buffer : grad_values + at;
    channel_gradient_block<W, kDot, kOuter>(weight + i, values + at, count, channels, grad, once, cotangent + i, out);
    if (kOuter && stream) stream_row(buffer, grad_values + at, count * channels);
  }
}

// --- Rays ----------------------------------------------------------------------------------------
template <typename T>
static void forward(const CompositeRaysArgs<T>& a, const CompositeRaysOutputs<T>& out, T* scratch, int64_t begin,
                    int64_t end) {
  constexpr int W = kWidth<T>;
  const Ray<T> ray = make_ray(a, scratch);
  const int64_t chunk = a.values ? kChunk : ray.size;
  for (int64_t index = begin; index < end; ++index) {
    T* weights = out.weights + index * ray.num_samples;
    const T* values = a.values + index * ray.num_samples * a.channels;
    const Ahead<T> ahead = look_ahead(a, index, end, (const T*)weights);
    Transmittance<T> transmittance;
    read_distances(a, index, ray);
    for (int64_t c = 0; a.values && c < a.channels + kBlock; ++c) ray.channels[c] = T(0);
    for (int64_t first = 0; first < ray.num_samples; first += chunk) {
      const int64_t left = ray.num_samples - first, count = left < chunk ? left : chunk;
      weigh<false>(a, ray, first, first + padded(count), ahead, transmittance);
      if (a.values) render_channels<W>(ray.weight + first, values + first * a.channels, count, a.channels, ray.channels);
    }
    copy_row(ray.weight, weights, ray.num_samples);
    place(a, index, ray);
    Vec<T, W> depth{}, opacity{};
    for (int64_t i = 0; i < ray.size; i += W) {
      const Vec<T, W> weight = load<W>(ray.weight + i);
      depth += weight * load<W>(ray.position + i);
      opacity += weight;
    }
    out.depth[index] = sum<T, W>(depth);
    out.opacity[index] = sum<T, W>(opacity);
    if (a.values) from_blocks<W>(ray.channels, a.channels, out.values + index * a.channels);
  }
}

// ray.cotangent = dL/dweight, but for what comes through the channels.
template <typename T>
static inline void backward_sums(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad, int64_t index,
                                 const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  place(a, index, ray);
  if (grad.weights) {
    copy_row(grad.weights + index * ray.num_samples, ray.cotangent, ray.num_samples);
  } else {
    for (int64_t i = 0; i < ray.size; i += W) store(ray.cotangent + i, Vec<T, W>{});
  }
  const T opacity = grad.opacity ? grad.opacity[index] : T(0), depth = grad.depth ? grad.depth[index] : T(0);
  for (int64_t i = 0; i < ray.size; i += W) {
    Vec<T, W> total = load<W>(ray.cotangent + i) + opacity;
    if (grad.depth) total += depth * load<W>(ray.position + i);
    store(ray.cotangent + i, total);
  }
}

// Samples [first, first + count): adds to ray.cotangent what comes through the channels; the gradient of values.
template <typename T>
static inline void backward_channels(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad,
                                     int64_t index, const Ray<T>& ray, int64_t first, int64_t count,
                                     bool need_cotangent, const CompositeRaysGradients<T>& out) {
  const int64_t at = (index * ray.num_samples + first) * a.channels;
#define PRED_CHANNEL_GRADIENTS(dot, outer)                                                                       \
  channel_gradients<kWidth<T>, dot, outer>(ray.weight + first, a.values + at, count, a.channels,                 \
                                           grad.values + index * a.channels, ray.channels, ray.cotangent + first, \
                                           out.values + at, ray.buffer, out.stream_values)
  if (need_cotangent && out.values) PRED_CHANNEL_GRADIENTS(true, true);
  else if (need_cotangent) PRED_CHANNEL_GRADIENTS(true, false);
  else if (out.values) PRED_CHANNEL_GRADIENTS(false, true);
#undef PRED_CHANNEL_GRADIENTS
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
  constexpr int W = kWidth<T>;
  const Ray<T> ray = make_ray(a, scratch);
  const bool need_cotangent = out.sdf || out.inv_s;
  const int64_t chunk = grad.values ? kChunk : ray.size;
  for (int64_t index = begin; index < end; ++index) {
    const Ahead<T> ahead = look_ahead(a, index, end, (out.sdf ? out.sdf : a.sdf) + index * ray.num_samples);
    Transmittance<T> transmittance;
    if (need_cotangent) {
      read_distances(a, index, ray);
      ray.occupied[0] = phi(a.inv_s, ray.sdf[0]).occupied;
      backward_sums(a, grad, index, ray);
    } else {
      copy_row(weights + index * ray.num_samples, ray.weight, ray.num_samples);
    }
    if (grad.values) to_blocks<W>(grad.values + index * a.channels, a.channels, ray.channels);
    for (int64_t first = 0; first < ray.num_samples; first += chunk) {
      const int64_t left = ray.num_samples - first, count = left < chunk ? left : chunk;
      if (need_cotangent) weigh<true>(a, ray, first, first + padded(count), ahead, transmittance);
      if (grad.values) backward_channels(a, grad, index, ray, first, count, need_cotangent, out);
    }
    if (out.t) backward_positions(a, grad.depth[index], ray, out.t + index * ray.num_samples);
    if (!need_cotangent) continue;
    ray.transmittance[ray.size] = T(transmittance.carry[0]);
    const T grad_inv_s = backward_distances(ray);
    if (out.inv_s) out.inv_s[index] = double(grad_inv_s);
    if (out.sdf) {
      T* __restrict grad_sdf = out.sdf + index * ray.num_samples;
      for (int64_t i = 0; i < ray.num_samples; ++i) grad_sdf[i] = a.inv_s * ray.slope[i];
    }
  }
  if (out.stream_values) fence_stream();
}

}  // namespace

const CompositeRaysKernels<float> composite_rays_f32 = {scratch_size<float>, forward<float>, backward<float>};
const CompositeRaysKernels<double> composite_rays_f64 = {scratch_size<double>, forward<double>, backward<double>};

}  // namespace pred::PRED_ISA
