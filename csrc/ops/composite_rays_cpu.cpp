// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's rows only. Loops over vectors of samples are short, and hand over
// through scratch rows in the nearest cache: with fewer instructions per vector, more vectors are in flight at once.
// Rows are padded to whole vectors; the padding repeats the last distance, so that its opacity is 0.
#include "math/lanes.h"
#include "ops/composite_rays.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kBlock = 16;  // a multiple of every vector width
constexpr int64_t kChunk = 64;  // samples between turns of computing opacities and of using them on channels
constexpr int64_t kLead = 2 * kChunk;

// Scratch rows of one ray; elements -1 and `size` exist in each. Where a tensor's rows need no padding, they are used
// in their place.
template <typename T>
struct Ray {
  int64_t num_samples, size;  // size: padded
  bool whole;                 // they are equal
  T *sdf, *position, *weight, *free, *occupied, *alpha, *passed, *cotangent, *slope;
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
  ray.whole = size == a.num_samples;
  for (T** at : {&ray.sdf, &ray.position, &ray.weight, &ray.free, &ray.occupied, &ray.alpha, &ray.passed,
                 &ray.cotangent, &ray.slope}) {
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

// What the memory system fetches meanwhile: the next ray's rows, and values some chunks ahead. A few lines with each
// vector of each loop, since requests that come too fast are lost. Addresses past a tensor's end do no harm.
template <typename T>
struct Ahead {
  const T *next_sdf, *next_t;  // [S]
  const T* output;             // [S], to be written
  uintptr_t values;            // the next line
  int64_t lines;               // at a time

  inline __attribute__((always_inline)) void fetch_rows(int64_t i) const {
    __builtin_prefetch(next_sdf + i);
    __builtin_prefetch(next_t + i);
    __builtin_prefetch(output + i, 1);
  }

  inline __attribute__((always_inline)) void fetch_values() {
    for (int64_t k = 0; k < lines; ++k, values += 64) __builtin_prefetch((const void*)values);
  }
};

// `loops`: how many loops over a ray's vectors call fetch_values.
template <typename T>
static inline Ahead<T> look_ahead(const CompositeRaysArgs<T>& a, int64_t index, int64_t end, const T* output,
                                  int64_t loops) {
  const int64_t next = index + 1 < end ? index + 1 : index, vector_bytes = kVectorBytes * a.channels;
  const uintptr_t values = uintptr_t(a.values) + (index * a.num_samples + kLead) * a.channels * sizeof(T);
  return {a.sdf + next * a.num_samples, a.t + next * a.num_samples, output, values,
          (vector_bytes / 64 + loops - 1) / loops};
}

template <typename T>
static inline void read_distances(const CompositeRaysArgs<T>& a, int64_t index, const Ray<T>& ray) {
  const int64_t last = ray.num_samples - 1;
  copy_row(a.sdf + index * ray.num_samples, ray.sdf, ray.num_samples);
  for (int64_t i = last + 1; i <= ray.size; ++i) ray.sdf[i] = ray.sdf[last];
  ray.sdf[-1] = ray.sdf[0];
}

// Fills the weights of samples [begin, end), and of padding. `transmittance` is that of sample `begin`, then of `end`.
template <typename T>
static inline void weigh(const ExpScale<T>& s, bool last_opaque, const Ray<T>& ray, int64_t begin, int64_t end,
                         Ahead<T>& ahead, double& transmittance, T* weight) {
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
  if (end > last) {
    ray.alpha[last] = last_opaque ? T(1) : T(0);
    ray.passed[last] = last_opaque ? T(0) : T(1);
    for (int64_t i = last + 1; i < end; ++i) ray.alpha[i] = T(0);
  }
  // w_i = alpha_i prod_{j<i} (1 - alpha_j), in double, so that small opacities count in full.
  constexpr int D = kWidth<double>;
  using Wide = Vec<double, D>;
  const Wide one = splat<D>(1.0);
  Wide before = splat<D>(transmittance);
  for (int64_t i = begin; i < end; i += D) {
    if (i % W == 0) ahead.fetch_values();
    const Wide alpha = load_wide(ray.alpha + i), passed = load_wide(ray.passed + i);
    const Wide product = prefix_product<double, D>(alpha < 0.5 ? one - alpha : passed);
    store_narrow(weight + i, before * shift_up<1, double, D>(product, one) * alpha);
    before = before * broadcast<D - 1, double, D>(product);
  }
  transmittance = before[0];
  if (end > last) {
    for (int64_t i = last + 1; i < end; ++i) weight[i] = T(0);  // 0 times NaN
  }
}

// Where each weight is counted, 0 in the padding.
template <typename T>
static inline const T* positions(const CompositeRaysArgs<T>& a, int64_t index, const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  const T* t = a.t + index * ray.num_samples;
  if (ray.whole && !a.depth_mid) return t;
  copy_row(t, ray.position, ray.num_samples);
  if (a.depth_mid) {
    const int64_t last = ray.num_samples - 1;
    for (int64_t i = 0; i < last; i += W) {
      store(ray.position + i, T(0.5) * (load<W>(ray.position + i) + load<W>(ray.position + i + 1)));
    }
    ray.position[last] = t[last];
    for (int64_t i = last + 1; i < ray.size; ++i) ray.position[i] = T(0);
  }
  return ray.position;
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
static inline void render_blocks(const T* weight, const T* values, int64_t num_samples, int64_t channels, int64_t first,
                                 T* sum) {
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
      case 1:
        render_blocks<W, 1>(weight, values, num_samples, channels, first, sum);
        break;
      case 2:
        render_blocks<W, 2>(weight, values, num_samples, channels, first, sum);
        break;
      case 3:
        render_blocks<W, 3>(weight, values, num_samples, channels, first, sum);
        break;
      default:
        render_blocks<W, 4>(weight, values, num_samples, channels, first, sum);
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
                                          const T* grad, const T* once, T* cotangent, T* grad_values, Ahead<T>& ahead) {
  const int64_t blocks = num_blocks<W>(channels);
  for (int64_t i = 0; i < count; i += W) {
    if (kDot) ahead.fetch_values();
    for (int64_t first = 0; first < blocks; first += kMaxBlocks) {
#define PRED_TILE(n, full)                                                                                             \
  channel_gradient_tile<W, n, kDot, kOuter, full>(weight + i, values + i * channels, count - i, channels, first, grad, \
                                                  once, cotangent + i, grad_values + i * channels)
      const int64_t left = blocks - first;
      if (i + W <= count) {
        if (left == 1)
          PRED_TILE(1, true);
        else if (left == 2)
          PRED_TILE(2, true);
        else if (left == 3)
          PRED_TILE(3, true);
        else
          PRED_TILE(4, true);
      } else {
        if (left == 1)
          PRED_TILE(1, false);
        else if (left == 2)
          PRED_TILE(2, false);
        else if (left == 3)
          PRED_TILE(3, false);
        else
          PRED_TILE(4, false);
      }
#undef PRED_TILE
    }
  }
}

// A chunk. `buffer` has room for kBlock samples; `stream`: store grad_values past the caches.
template <int W, bool kDot, bool kOuter, typename T>
static void channel_gradients(const T* weight, const T* values, int64_t num_samples, int64_t channels, const T* grad,
                              const T* once, T* cotangent, T* grad_values, T* buffer, bool stream, Ahead<T>& ahead) {
  if constexpr (W > 1) {
    if (channels < W) {
      return channel_gradients<W / 2, kDot, kOuter>(weight, values, num_samples, channels, grad, once, cotangent,
                                                    grad_values, buffer, stream, ahead);
    }
  }
  for (int64_t i = 0; i < num_samples; i += kBlock) {
    const int64_t count = num_samples - i < kBlock ? num_samples - i : kBlock, at = i * channels;
    T* out = stream ? buffer : grad_values + at;
    channel_gradient_block<W, kDot, kOuter>(weight + i, values + at, count, channels, grad, once, cotangent + i, out,
                                            ahead);
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
  const ExpScale<T> s = exp_scale(a.inv_s);
  for (int64_t index = begin; index < end; ++index) {
    T* weights = out.weights + index * ray.num_samples;
    T* weight = ray.whole ? weights : ray.weight;
    const T* values = a.values + index * ray.num_samples * a.channels;
    Ahead<T> ahead = look_ahead(a, index, end, (const T*)weights, 3);
    double transmittance = 1;
    read_distances(a, index, ray);
    for (int64_t c = 0; a.values && c < a.channels + kBlock; ++c) ray.channels[c] = T(0);
    for (int64_t first = 0; first < ray.num_samples; first += chunk) {
      const int64_t left = ray.num_samples - first, count = left < chunk ? left : chunk;
      weigh(s, a.last_opaque, ray, first, first + padded(count), ahead, transmittance, weight);
      if (a.values) render_channels<W>(weight + first, values + first * a.channels, count, a.channels, ray.channels);
    }
    if (!ray.whole) copy_row(weight, weights, ray.num_samples);
    const T* position = positions(a, index, ray);
    Vec<T, W> depth{}, opacity{};
    for (int64_t i = 0; i < ray.size; i += W) {
      depth += load<W>(weight + i) * load<W>(position + i);
      opacity += load<W>(weight + i);
    }
    out.depth[index] = sum<T, W>(depth);
    out.opacity[index] = sum<T, W>(opacity);
    out.remaining[index] = T(transmittance);
    if (a.values) from_blocks<W>(ray.channels, a.channels, out.values + index * a.channels);
  }
}

// ray.cotangent = dL/dweight, but for what comes through the channels.
template <typename T>
static inline void backward_sums(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad, int64_t index,
                                 const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  const Vec<T, W> opacity = splat<W>(grad.opacity ? grad.opacity[index] : T(0));
  if (grad.depth) {
    const T* position = positions(a, index, ray);
    for (int64_t i = 0; i < ray.size; i += W) {
      store(ray.cotangent + i, opacity + grad.depth[index] * load<W>(position + i));
    }
  } else {
    for (int64_t i = 0; i < ray.size; i += W) store(ray.cotangent + i, opacity);
  }
  if (grad.weights) {
    const T* __restrict weights = grad.weights + index * ray.num_samples;
    for (int64_t i = 0; i < ray.num_samples; ++i) ray.cotangent[i] += weights[i];
  }
}

// Samples [first, first + count): adds to ray.cotangent what comes through the channels, where needed; the gradient of
// values, where wanted.
template <typename T>
static inline void backward_channels(const CompositeRaysArgs<T>& a, const CompositeRaysCotangents<T>& grad,
                                     int64_t index, const Ray<T>& ray, const T* weight, int64_t first, int64_t count,
                                     bool need_cotangent, const CompositeRaysGradients<T>& out, Ahead<T>& ahead) {
  const int64_t at = (index * ray.num_samples + first) * a.channels;
#define PRED_CHANNEL_GRADIENTS(dot, outer)                                                                        \
  channel_gradients<kWidth<T>, dot, outer>(weight + first, a.values + at, count, a.channels,                      \
                                           grad.values + index * a.channels, ray.channels, ray.cotangent + first, \
                                           out.values + at, ray.buffer, out.stream_values, ahead)
  if (need_cotangent && out.values)
    PRED_CHANNEL_GRADIENTS(true, true);
  else if (need_cotangent)
    PRED_CHANNEL_GRADIENTS(true, false);
  else if (out.values)
    PRED_CHANNEL_GRADIENTS(false, true);
#undef PRED_CHANNEL_GRADIENTS
}

// From ray.cotangent to the gradient of sdf. Returns the gradient of inv_s.
template <typename T>
static inline T backward_distances(const Ray<T>& ray, T inv_s, const T* weight, T remaining, T* grad_sdf) {
  constexpr int W = kWidth<T>;
  using V = Vec<T, W>;
  // Sums over what lies behind, of weights and of weights times cotangents. Transmittance is the former and what
  // remains: a sum of positive numbers, as exact where next to nothing is left as where all is.
  V transmittance_behind = splat<W>(remaining), gain_behind{}, total{};
  for (int64_t i = ray.size - W; i >= 0; i -= W) {
    const V sdf = load<W>(ray.sdf + i);
    const V cotangent = load<W>(ray.cotangent + i), cotangent_before = load<W>(ray.cotangent + i - 1);
    const V weights = suffix_sum<T, W>(load<W>(weight + i)), gains = suffix_sum<T, W>(load<W>(weight + i) * cotangent);
    const V transmittance = transmittance_behind + weights;
    const V transmittance_after = transmittance_behind + shift_down<1, T, W>(weights, V{});
    const auto falls_before = load<W>(ray.sdf + i - 1) > sdf, falls_after = sdf > load<W>(ray.sdf + i + 1);
    // H_i and H_{i-1}; S_{i-1} is the sum from here on.
    const V after = transmittance_after * cotangent - (gain_behind + shift_down<1, T, W>(gains, V{}));
    const V before = transmittance * cotangent_before - (gain_behind + gains);
    const V both = transmittance * (cotangent - cotangent_before);
    const V one = (falls_after ? after : V{}) - (falls_before ? before : V{});
    const V slope = load<W>(ray.occupied + i) * ((falls_before & falls_after) ? both : one);  // of inv_s * sdf
    store(grad_sdf + i, inv_s * slope);
    total += slope * sdf;
    transmittance_behind += broadcast<0, T, W>(weights);
    gain_behind += broadcast<0, T, W>(gains);
  }
  return sum<T, W>(total);
}

template <typename T>
static inline void backward_positions(bool depth_mid, T grad_depth, const T* __restrict weight, int64_t num_samples,
                                      T* __restrict grad_t) {
  for (int64_t i = 0; i < num_samples; ++i) grad_t[i] = grad_depth * weight[i];
  if (!depth_mid) return;
  // Sample i ends section i - 1 and starts section i; the last sample counts at itself.
  const int64_t last = num_samples - 1;
  for (int64_t i = 0; i < last; ++i) grad_t[i] *= T(0.5);
  for (int64_t i = 1; i <= last; ++i) grad_t[i] += T(0.5) * grad_depth * weight[i - 1];
}

template <typename T>
static void backward(const CompositeRaysArgs<T>& a, const CompositeRaysSaved<T>& saved,
                     const CompositeRaysCotangents<T>& grad, const CompositeRaysGradients<T>& out, T* scratch,
                     int64_t begin, int64_t end) {
  constexpr int W = kWidth<T>;
  const Ray<T> ray = make_ray(a, scratch);
  const bool need_cotangent = out.sdf || out.inv_s;
  const int64_t chunk = grad.values ? kChunk : ray.size;
  const ExpScale<T> s = exp_scale(a.inv_s);
  for (int64_t index = begin; index < end; ++index) {
    const int64_t at = index * ray.num_samples;
    Ahead<T> ahead = look_ahead(a, index, end, (out.sdf ? out.sdf : a.sdf) + at, 2);
    const T* weight = saved.weights + at;
    if (!ray.whole) {
      copy_row(weight, ray.weight, ray.num_samples);
      weight = ray.weight;
    }
    if (need_cotangent) {
      read_distances(a, index, ray);
      backward_sums(a, grad, index, ray);
    }
    if (grad.values) to_blocks<W>(grad.values + index * a.channels, a.channels, ray.channels);
    for (int64_t first = 0; first < ray.num_samples; first += chunk) {
      const int64_t left = ray.num_samples - first, count = left < chunk ? left : chunk;
      for (int64_t i = first; need_cotangent && i < first + padded(count); i += W) {
        ahead.fetch_rows(i);
        ahead.fetch_values();
        store(ray.occupied + i, phi(s, load<W>(ray.sdf + i)).occupied);
      }
      if (grad.values) backward_channels(a, grad, index, ray, weight, first, count, need_cotangent, out, ahead);
    }
    if (out.t) backward_positions(a.depth_mid, grad.depth[index], weight, ray.num_samples, out.t + at);
    if (!need_cotangent) continue;
    T* grad_sdf = ray.whole && out.sdf ? out.sdf + at : ray.slope;
    const T grad_inv_s = backward_distances(ray, a.inv_s, weight, saved.remaining[index], grad_sdf);
    if (out.inv_s) out.inv_s[index] = double(grad_inv_s);
    if (out.sdf && !ray.whole) copy_row(grad_sdf, out.sdf + at, ray.num_samples);
  }
  if (out.stream_values) fence_stream();
}

}  // namespace

const CompositeRaysKernels<float> composite_rays_f32 = {scratch_size<float>, forward<float>, backward<float>};
const CompositeRaysKernels<double> composite_rays_f64 = {scratch_size<double>, forward<double>, backward<double>};

}  // namespace pred::PRED_ISA
