// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The loops of composite_rays and composite_alpha, but for what they know of opacities. CPU kernels only.
//
// One iteration owns one ray and writes that ray's rows only. Loops over vectors of samples are short, and hand over
// through scratch rows in the nearest cache: with fewer instructions per vector, more vectors are in flight at once.
// Rows are padded to whole vectors; the padding's opacities, weights, positions and cotangents are 0.
//
// What an op knows is its `Field`, made of its arguments once per range of rays:
//   start(ray, at) -> alpha                     before a ray, whose first sample is `at`: where its opacities will be
//   opacities(ray, begin, end, ahead)           fills them for samples [begin, end), padding included
//   passed(ray, alpha, i)                       what is left of the light behind samples i, i + 1, ..., in double
//   start_backward(ray, at, saved, need) -> w   before a ray: where its weights will be; need: the source's gradient
//   backward_chunk(ray, begin, end, need, ahead)
//   backward_end(ray, remaining, weight, gradient) -> gradient of inv_s; from ray.cotangent to that of the source
#pragma once

#include <type_traits>

#include "math/lanes.h"
#include "ops/composite.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kBlock = 16;  // a multiple of every vector width
constexpr int64_t kChunk = 64;  // samples between turns of computing opacities and of using them on channels
constexpr int64_t kLead = 2 * kChunk;
constexpr int64_t kRows = 10;

// Scratch rows of one ray; elements -1 and `size` exist in each. Where a tensor's rows need no padding, they are used
// in their place.
template <typename T>
struct Ray {
  int64_t num_samples, size;  // size: padded
  bool whole;                 // they are equal
  T *position, *weight, *alpha, *cotangent, *gradient;
  T *sdf, *free, *occupied, *passed;  // of composite_rays
  T* transmittance;                   // of composite_alpha
  T *rows, *channels, *row, *buffer, *widened, *narrowed;
  // rows: all of the above; channels: [C] in blocks of a vector's width; row: [C]; the others: [kBlock, C]
  int64_t stride;  // of rows
};

static inline int64_t padded(int64_t num_samples) { return (num_samples + kBlock - 1) / kBlock * kBlock; }

template <class Args>
static int64_t scratch_size(const Args& a, int64_t longest) {
  return kRows * (padded(longest) + 2 * kBlock) + 2 * padded(a.channels + kBlock) + 3 * kBlock * a.channels +
         2 * kBlock;
}

template <typename T>
static Ray<T> make_ray(int64_t channels, int64_t longest, T* scratch) {
  Ray<T> ray;
  ray.num_samples = ray.size = -1;
  ray.stride = padded(longest) + 2 * kBlock;
  T* row = (T*)((uintptr_t(scratch) + 63) / 64 * 64) + kBlock;  // aligned to 64 bytes
  ray.rows = row;
  for (T** at : {&ray.position, &ray.weight, &ray.alpha, &ray.cotangent, &ray.gradient, &ray.sdf, &ray.free,
                 &ray.occupied, &ray.passed, &ray.transmittance}) {
    row[-1] = T(0);
    *at = row;
    row += ray.stride;
  }
  for (T** at : {&ray.channels, &ray.row}) {
    *at = row;
    row += padded(channels + kBlock);
  }
  for (T** at : {&ray.buffer, &ray.widened, &ray.narrowed}) {
    *at = row;
    row += kBlock * channels;
  }
  return ray;
}

// Makes the rows those of a ray with so many samples: clears their padding.
template <typename T>
static inline void set_length(Ray<T>& ray, int64_t num_samples) {
  if (ray.num_samples == num_samples) return;
  ray.num_samples = num_samples;
  ray.size = padded(num_samples);
  ray.whole = ray.size == num_samples;
  for (int64_t k = 0; k < kRows; ++k) {
    for (int64_t i = num_samples; i <= ray.size; ++i) ray.rows[k * ray.stride + i] = T(0);
  }
}

template <typename T>
static inline void copy_row(const T* __restrict from, T* __restrict to, int64_t n) {
  for (int64_t i = 0; i < n; ++i) to[i] = from[i];
}

// What the memory system fetches meanwhile: the next ray's rows, and values some chunks ahead. A few lines with each
// vector of each loop, since requests that come too fast are lost. Addresses past a tensor's end do no harm.
template <typename T>
struct Ahead {
  const T *next_source, *next_t;  // [count]
  const T* output;                // [count], to be written
  uintptr_t values;               // the next line
  int64_t lines;                  // at a time

  inline __attribute__((always_inline)) void fetch_rows(int64_t i) const {
    __builtin_prefetch(next_source + i);
    __builtin_prefetch(next_t + i);
    __builtin_prefetch(output + i, 1);
  }

  inline __attribute__((always_inline)) void fetch_values() {
    for (int64_t k = 0; k < lines; ++k, values += 64) __builtin_prefetch((const void*)values);
  }
};

// `loops`: how often per vector of samples fetch_values is called.
template <typename S>
static inline Ahead<Compute<S>> look_ahead(const CompositeArgs<S>& a, int64_t index, int64_t end,
                                           const Compute<S>* output, int64_t loops) {
  const int64_t next = ray_begin(a.rows, index + 1 < end ? index + 1 : index);
  const int64_t vector_bytes = kWidth<Compute<S>> * int64_t(sizeof(S)) * a.channels;
  const uintptr_t values = uintptr_t(a.values) + (ray_begin(a.rows, index) + kLead) * a.channels * sizeof(S);
  return {a.source + next, (a.t ? a.t : a.source) + next, output, values, (vector_bytes / 64 + loops - 1) / loops};
}

// Fills the weights of samples [begin, end), and of padding: w_i = alpha_i prod_{j<i} passed_j, in double, so that
// small opacities count in full. `transmittance` is that of sample `begin`, then of `end`.
template <bool kKeepTransmittance, class Field, typename T>
static inline void weigh(const Field& field, const Ray<T>& ray, const T* alpha, int64_t begin, int64_t end,
                         Ahead<T>& ahead, double& transmittance, T* weight) {
  constexpr int D = kWidth<double>;
  using Wide = Vec<double, D>;
  const Wide one = splat<D>(1.0);
  Wide before = splat<D>(transmittance);
  for (int64_t i = begin; i < end; i += D) {
    field.fetch_in_scan(i, ahead);
    const Wide opacity = load_wide(alpha + i);
    const Wide product = prefix_product<double, D>(field.passed(ray, opacity, i));
    const Wide here = before * shift_up<1, double, D>(product, one);
    if (kKeepTransmittance) store_narrow(ray.transmittance + i, here);
    store_narrow(weight + i, here * opacity);
    before = before * broadcast<D - 1, double, D>(product);
  }
  transmittance = before[0];
  for (int64_t i = ray.num_samples; i < end; ++i) weight[i] = T(0);  // 0 times NaN
}

// Where each weight is counted, 0 in the padding.
template <typename S, typename T = Compute<S>>
static inline const T* positions(const CompositeArgs<S>& a, int64_t at, const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  const T* t = a.t + at;
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

// --- Storage -------------------------------------------------------------------------------------
// From storage: the numbers themselves, or widened to `buffer`.
template <typename S, typename T>
static inline const T* widen_row(const S* __restrict from, int64_t n, [[maybe_unused]] T* __restrict buffer) {
  if constexpr (std::is_same_v<S, T>) {
    return from;
  } else {
    for (int64_t i = 0; i < n; ++i) buffer[i] = widen(from[i]);
    return buffer;
  }
}

template <typename S, typename T>
static inline void narrow_row(const T* __restrict from, int64_t n, S* __restrict to) {
  for (int64_t i = 0; i < n; ++i) narrow_to(to[i], from[i]);
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

// sum += sum_i weight[i] values[i] for values in storage.
template <typename S, typename T>
static inline void render_rows(const Ray<T>& ray, const T* weight, const S* values, int64_t num_samples,
                               int64_t channels) {
  constexpr int W = kWidth<T>;
  if constexpr (std::is_same_v<S, T>) {
    render_channels<W>(weight, values, num_samples, channels, ray.channels);
  } else {
    for (int64_t i = 0; i < num_samples; i += kBlock) {
      const int64_t count = num_samples - i < kBlock ? num_samples - i : kBlock;
      const T* rows = widen_row(values + i * channels, count * channels, ray.widened);
      render_channels<W>(weight + i, rows, count, channels, ray.channels);
    }
  }
}

// A chunk. `stream`: store grad_values past the caches.
template <int W, bool kDot, bool kOuter, typename S, typename T>
static void channel_gradients(const Ray<T>& ray, const T* weight, const S* values, int64_t num_samples,
                              int64_t channels, const T* grad, T* cotangent, S* grad_values, bool stream,
                              Ahead<T>& ahead) {
  if constexpr (W > 1) {
    if (channels < W) {
      return channel_gradients<W / 2, kDot, kOuter>(ray, weight, values, num_samples, channels, grad, cotangent,
                                                    grad_values, stream, ahead);
    }
  }
  constexpr bool kDirect = std::is_same_v<S, T>;
  for (int64_t i = 0; i < num_samples; i += kBlock) {
    const int64_t count = num_samples - i < kBlock ? num_samples - i : kBlock, at = i * channels, n = count * channels;
    const T* rows = nullptr;
    T* out = ray.buffer;
    if constexpr (kDot) rows = widen_row(values + at, n, ray.widened);
    if constexpr (kOuter && kDirect) out = stream ? ray.buffer : grad_values + at;
    channel_gradient_block<W, kDot, kOuter>(weight + i, rows, count, channels, grad, ray.channels, cotangent + i, out,
                                            ahead);
    if constexpr (kOuter && kDirect) {
      if (stream) stream_row(out, grad_values + at, n);
    } else if constexpr (kOuter) {
      narrow_row(out, n, stream ? (S*)ray.narrowed : grad_values + at);
      if (stream) stream_row((const uint16_t*)ray.narrowed, (uint16_t*)(grad_values + at), n);
    }
  }
}

// --- Rays ----------------------------------------------------------------------------------------
template <class Field, class Args, typename S = typename Args::Storage, typename T = Compute<S>>
static void composite_forward(const Args& a, const CompositeOutputs<S>& out, T* scratch, int64_t longest, int64_t begin,
                              int64_t end) {
  constexpr int W = kWidth<T>;
  Field field(a);
  Ray<T> ray = make_ray(a.channels, longest, scratch);
  for (int64_t index = begin; index < end; ++index) {
    const int64_t at = ray_begin(a.rows, index), num_samples = ray_count(a.rows, index);
    double transmittance = 1;
    Vec<T, W> depth{}, opacity{};
    for (int64_t c = 0; out.values && c < a.channels + kBlock; ++c) ray.channels[c] = T(0);
    if (num_samples > 0) {
      set_length(ray, num_samples);
      T* weights = out.weights + at;
      T* weight = ray.whole ? weights : ray.weight;
      Ahead<T> ahead = look_ahead(a, index, end, (const T*)weights, Field::kForwardLoops);
      const T* alpha = field.start(ray, at);
      const int64_t chunk = out.values ? kChunk : ray.size;
      for (int64_t first = 0; first < num_samples; first += chunk) {
        const int64_t left = num_samples - first, count = left < chunk ? left : chunk, last = first + padded(count);
        field.opacities(ray, first, last, ahead);
        weigh<false>(field, ray, alpha, first, last, ahead, transmittance, weight);
        if (out.values) render_rows(ray, weight + first, a.values + (at + first) * a.channels, count, a.channels);
      }
      if (!ray.whole) copy_row(weight, weights, num_samples);
      if (out.depth) {
        const T* position = positions(a, at, ray);
        for (int64_t i = 0; i < ray.size; i += W) depth += load<W>(weight + i) * load<W>(position + i);
      }
      for (int64_t i = 0; i < ray.size; i += W) opacity += load<W>(weight + i);
    }
    if (out.depth) out.depth[index] = sum<T, W>(depth);
    out.opacity[index] = sum<T, W>(opacity);
    if (out.remaining) out.remaining[index] = T(transmittance);
    if (!out.values) continue;
    S* rendered = out.values + index * a.channels;
    if constexpr (std::is_same_v<S, T>) {
      from_blocks<W>(ray.channels, a.channels, rendered);
    } else {
      from_blocks<W>(ray.channels, a.channels, ray.row);
      narrow_row(ray.row, a.channels, rendered);
    }
  }
}

// ray.cotangent = dL/dweight, but for what comes through the channels.
template <typename S, typename T = Compute<S>>
static inline void backward_sums(const CompositeArgs<S>& a, const CompositeCotangents<S>& grad, int64_t index,
                                 int64_t at, const Ray<T>& ray) {
  constexpr int W = kWidth<T>;
  const Vec<T, W> opacity = splat<W>(grad.opacity ? grad.opacity[index] : T(0));
  if (grad.depth) {
    const T* position = positions(a, at, ray);
    for (int64_t i = 0; i < ray.size; i += W) {
      store(ray.cotangent + i, opacity + grad.depth[index] * load<W>(position + i));
    }
  } else {
    for (int64_t i = 0; i < ray.size; i += W) store(ray.cotangent + i, opacity);
  }
  if (grad.weights) {
    const T* __restrict weights = grad.weights + at;
    for (int64_t i = 0; i < ray.num_samples; ++i) ray.cotangent[i] += weights[i];
  }
  for (int64_t i = ray.num_samples; i <= ray.size; ++i) ray.cotangent[i] = T(0);
}

// Samples [at, at + count): adds to `cotangent` what comes through the channels, where needed; the gradient of values,
// where wanted. `row`: the incoming gradient.
template <typename S, typename T = Compute<S>>
static inline void backward_channels(const CompositeArgs<S>& a, const T* row, const Ray<T>& ray, const T* weight,
                                     int64_t at, int64_t count, T* cotangent, bool need_cotangent,
                                     const CompositeGradients<S>& out, Ahead<T>& ahead) {
#define PRED_CHANNEL_GRADIENTS(dot, outer)                                                                             \
  channel_gradients<kWidth<T>, dot, outer>(ray, weight, a.values + at * a.channels, count, a.channels, row, cotangent, \
                                           out.values + at * a.channels, out.stream_values, ahead)
  if (need_cotangent && out.values)
    PRED_CHANNEL_GRADIENTS(true, true);
  else if (need_cotangent)
    PRED_CHANNEL_GRADIENTS(true, false);
  else if (out.values)
    PRED_CHANNEL_GRADIENTS(false, true);
#undef PRED_CHANNEL_GRADIENTS
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

template <class Field, class Args, typename S = typename Args::Storage, typename T = Compute<S>>
static void composite_backward(const Args& a, const CompositeSaved<T>& saved, const CompositeCotangents<S>& grad,
                               const CompositeGradients<S>& out, T* scratch, int64_t longest, int64_t begin,
                               int64_t end) {
  constexpr int W = kWidth<T>;
  Field field(a);
  Ray<T> ray = make_ray(a.channels, longest, scratch);
  const bool need_source = out.source || out.inv_s;
  for (int64_t index = begin; index < end; ++index) {
    const int64_t at = ray_begin(a.rows, index), num_samples = ray_count(a.rows, index);
    if (out.inv_s) out.inv_s[index] = 0;
    if (num_samples == 0) continue;
    set_length(ray, num_samples);
    Ahead<T> ahead = look_ahead(a, index, end, (out.source ? out.source : a.source) + at, Field::kBackwardLoops);
    const T* weight = field.start_backward(ray, at, saved, need_source);
    if (need_source) backward_sums(a, grad, index, at, ray);
    const T* row = nullptr;
    if (grad.values) {
      row = widen_row(grad.values + index * a.channels, a.channels, ray.row);
      to_blocks<W>(row, a.channels, ray.channels);
    }
    const int64_t chunk = grad.values ? kChunk : ray.size;
    for (int64_t first = 0; first < num_samples; first += chunk) {
      const int64_t left = num_samples - first, count = left < chunk ? left : chunk;
      field.backward_chunk(ray, first, first + padded(count), need_source, ahead);
      if (grad.values) {
        backward_channels(a, row, ray, weight + first, at + first, count, ray.cotangent + first, need_source, out,
                          ahead);
      }
    }
    if (out.t) backward_positions(a.depth_mid, grad.depth[index], weight, num_samples, out.t + at);
    if (!need_source) continue;
    T* gradient = ray.whole && out.source ? out.source + at : ray.gradient;
    const T grad_inv_s = field.backward_end(ray, saved.remaining ? saved.remaining[index] : T(0), weight, gradient);
    if (out.inv_s) out.inv_s[index] = double(grad_inv_s);
    if (out.source && !ray.whole) copy_row(gradient, out.source + at, num_samples);
  }
  if (out.stream_values) fence_stream();
}

}  // namespace
}  // namespace pred::PRED_ISA
