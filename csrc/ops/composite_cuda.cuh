// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What the kernels of composite_rays and composite_alpha share.
//
// One warp owns one ray and writes that ray's rows only. In a turn each lane has K neighbouring samples, of which it
// knows the first of the lane behind, too. Scans over lanes are shuffles, in double where light is multiplied up, and
// are carried from turn to turn. The channels of a sample lie side by side in memory: there, a lane has some
// neighbouring ones, and a warp as many samples as fit.
#pragma once

#include <type_traits>

#include "common/pack.cuh"
#include "common/warp.cuh"
#include "ops/composite.h"

namespace pred::PRED_ISA {
namespace {

// Lanes as rows, each of them one sample: V neighbouring channels to a lane, from `first` on.
template <int V>
struct Columns {
  int lanes, rows;  // of a row, and of the warp
  int row, column;  // of this lane
  bool there;       // lanes that are left over do as those of row 0 do

  __device__ Columns(int64_t channels, int64_t first) {
    const int64_t packs = (channels - first) / V;
    lanes = packs < kWarp ? int(packs) : kWarp;
    rows = kWarp / lanes;
    there = lane_number() < rows * lanes;
    row = there ? lane_number() / lanes : 0;
    column = lane_number() % lanes * V;
  }

  // Row 0 gets the sums over rows.
  template <typename T>
  __device__ void sum_rows(T (&value)[V]) const {
    for (int count = rows; count > 1;) {
      const int half = (count + 1) / 2;
#pragma unroll
      for (int v = 0; v < V; ++v) {
        const T other = __shfl_down_sync(kWholeWarp, value[v], unsigned(half * lanes));
        if (there && row + half < count) value[v] += other;
      }
      count = half;
    }
  }
};

// Channels to a lane; one where rows do not consist of such packs.
template <typename S>
constexpr int kChannels = sizeof(S) == 8 ? 2 : 4;

// Samples to a lane: 16 bytes.
template <typename T>
constexpr int kSamples = 16 / int(sizeof(T));

// Samples of a ray from this lane's first on, where `left` are left from the turn's first on; more than K where there
// are any behind this lane's.
template <int K>
PRED_DEVICE_ONLY int lane_samples(int64_t left) {
  constexpr int kMost = kWarp * K + 1;
  return (left < kMost ? int(left) : kMost) - lane_number() * K;
}

// x[k] = from[k], and 0 past the `left` that are there. kWritten: by this lane before.
template <bool kWritten = false, int K, typename T>
PRED_DEVICE_ONLY void load_samples(const T* from, int left, T (&x)[K]) {
  if (K > 1 && left >= K && reinterpret_cast<uintptr_t>(from) % sizeof(x) == 0) {
    if constexpr (kWritten) {
      load_pack<K>(from, x);
    } else {
      read_pack<K>(from, x);
    }
  } else {
#pragma unroll
    for (int k = 0; k < K; ++k) x[k] = k < left ? from[k] : T(0);
  }
}

// to[k] = x[k] for begin <= k < left.
template <int K, typename T>
PRED_DEVICE_ONLY void store_samples(T* to, int begin, int left, const T (&x)[K]) {
  if (K > 1 && begin <= 0 && left >= K && reinterpret_cast<uintptr_t>(to) % sizeof(x) == 0) {
    store_pack<K>(to, x);
  } else {
#pragma unroll
    for (int k = 0; k < K; ++k) {
      if (k >= begin && k < left) to[k] = x[k];
    }
  }
}

// Sample K of this lane, which has `first` as its own first one.
template <int K, typename T>
PRED_DEVICE_ONLY T first_behind(const T* from, int left, T first) {
  return from_behind(first, lane_number() == kWarp - 1 && left > K ? from[K] : T(0));
}

// Where samples are counted, from row `row` on.
template <int K, typename S, typename T>
PRED_DEVICE_ONLY void positions(const CompositeArgs<S>& a, int64_t row, int left, T (&position)[K]) {
  load_samples(a.t + row, left, position);
  if (!a.depth_mid) return;
  const T behind = first_behind<K>(a.t + row, left, position[0]);
#pragma unroll
  for (int k = 0; k < K; ++k) {
    if (k + 1 < left) position[k] = T(0.5) * (position[k] + (k + 1 < K ? position[k + 1] : behind));
  }
}

template <typename T>
struct Opacity {
  T alpha;
  double passed;  // what is left of the light
};

// Loads that do not wait for one another, or each would for the sum before it.
template <int V>
constexpr int kLoads = V == 1 ? 8 : 4;

// rendered[c] = sum over samples of weights[i] values[i, c]
template <int V, typename S, typename T>
PRED_DEVICE_ONLY void render_channels(const T* weights, const S* values, int64_t count, int64_t channels, S* rendered) {
  for (int64_t first = 0; first < channels; first += kWarp * V) {
    const Columns<V> lane(channels, first);
    const int64_t step = lane.rows * channels;
    const T* weight = weights + lane.row;
    const S* value = values + lane.row * channels + first + lane.column;
    T sum[V] = {};
    int64_t left = count;
    for (; left >= kLoads<V> * lane.rows; left -= kLoads<V> * lane.rows) {
      T own[kLoads<V>], here[kLoads<V>][V];
#pragma unroll
      for (int k = 0; k < kLoads<V>; ++k) {
        own[k] = *weight;
        read_pack<V>(value, here[k]);
        weight += lane.rows;
        value += step;
      }
#pragma unroll
      for (int k = 0; k < kLoads<V>; ++k) {
        for (int v = 0; v < V; ++v) sum[v] += own[k] * here[k][v];
      }
    }
    for (; left > 0; left -= lane.rows) {
      if (lane.row < left) {
        T here[V];
        read_pack<V>(value, here);
        for (int v = 0; v < V; ++v) sum[v] += *weight * here[v];
      }
      weight += lane.rows;
      value += step;
    }
    lane.sum_rows(sum);
    if (lane.there && lane.row == 0) store_pack<V>(rendered + first + lane.column, sum);
  }
}

// The light that arrives at each of a lane's samples, where `transmittance` arrives at the turn; and then behind it.
template <int K, typename T>
PRED_DEVICE_ONLY void arriving_light(const Opacity<T> (&here)[K], double& transmittance, double (&light)[K]) {
  double product[K];
#pragma unroll
  for (int k = 0; k < K; ++k) product[k] = k > 0 ? product[k - 1] * here[k].passed : here[k].passed;
  const double products = prefix_product(product[K - 1]);
  light[0] = transmittance * from_before(products, 1.0);
#pragma unroll
  for (int k = 1; k < K; ++k) light[k] = light[0] * product[k - 1];
  transmittance *= broadcast(products, kWarp - 1);
}

// V: channels to a lane; 0: there are none. Field: field(row, left, here) finds the opacities of a lane's samples, and
// {0, 1} where there are none; all lanes take part.
template <class Field, int V, class Args, typename S, typename T>
__global__ void __launch_bounds__(kThreads) forward_kernel(Args a, CompositeOutputs<S> out, int64_t num_rays) {
  constexpr int K = kSamples<T>;
  const Field field(a);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    double transmittance = 1;
    T depth = T(0), opacity = T(0);
    for (int64_t first = 0; first < count; first += kWarp * K) {
      const int64_t row = at + first + lane_number() * K;
      const int left = lane_samples<K>(count - first);
      Opacity<T> here[K];
      field(row, left, here);
      double light[K];
      arriving_light(here, transmittance, light);
      T weight[K];
#pragma unroll
      for (int k = 0; k < K; ++k) {
        weight[k] = k < left ? T(light[k] * double(here[k].alpha)) : T(0);
        opacity += weight[k];
      }
      store_samples(out.weights + row, 0, left, weight);
      if (!out.depth) continue;
      T position[K];
      positions(a, row, left, position);
#pragma unroll
      for (int k = 0; k < K; ++k) depth += weight[k] * position[k];
    }
    opacity = sum_lanes(opacity);
    depth = sum_lanes(depth);
    if (lane_number() == 0) {
      out.opacity[ray] = opacity;
      if (out.depth) out.depth[ray] = depth;
      if (out.remaining) out.remaining[ray] = T(transmittance);
    }
    if constexpr (V > 0) {
      __syncwarp();  // all lanes read the weights
      render_channels<V>(out.weights + at, a.values + at * a.channels, count, a.channels,
                         out.values + ray * a.channels);
    }
  }
}

// One warp's sums over the channels of a lane, turned from a row of lanes per sample to a lane per sample.
template <typename T>
using Tile = T[kWarp][kWarp + 1];

// The samples of a turn, from row `at` on, where the ray has `left` more: returns sum_c values[i, c] grad[c] to the
// lane of sample i (kDot), and writes the gradient of values, weight_i grad[c] (kOuter).
template <int V, bool kDot, bool kOuter, typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY T channel_gradients(const CompositeArgs<S>& a, const CompositeCotangents<S>& grad,
                                     const CompositeGradients<S>& out, T weight, int64_t ray, int64_t at, int64_t left,
                                     Tile<T>& tile) {
  const int64_t channels = a.channels;
  const int count = left < kWarp ? int(left) : kWarp;
  T dot = T(0);
  for (int64_t first = 0; first < channels; first += kWarp * V) {
    const Columns<V> lane(channels, first);
    T of_channel[V];
    read_pack<V>(grad.values + ray * channels + first + lane.column, of_channel);
    int64_t from = (at + lane.row) * channels + first + lane.column;
    for (int begin = 0; begin < count; begin += kLoads<V> * lane.rows) {
      T share[kLoads<V>];
#pragma unroll
      for (int k = 0; k < kLoads<V>; ++k) {  // ahead of the stores
        T value[V];
        const bool there = kDot && begin + k * lane.rows + lane.row < count;
        load_constant_pack<V>(there ? a.values + from + k * lane.rows * channels : nullptr, value);
        share[k] = T(0);
        for (int v = 0; v < V; ++v) share[k] += value[v] * of_channel[v];
      }
#pragma unroll
      for (int k = 0; k < kLoads<V>; ++k) {
        const int turn = begin + k * lane.rows, i = turn + lane.row;
        if (turn >= count) break;  // all lanes do
        const T factor = kOuter ? broadcast(weight, i < kWarp ? i : 0) : T(0);
        if (i >= count || !lane.there) continue;
        if (kDot) tile[i][lane.column / V] = share[k];
        if (kOuter) {
          T product[V];
          for (int v = 0; v < V; ++v) product[v] = factor * of_channel[v];
          store_pack<V>(out.values + from + k * lane.rows * channels, product);
        }
      }
      from += kLoads<V> * lane.rows * channels;
    }
    if (!kDot) continue;
    __syncwarp();
    if (lane_number() < count) {
      for (int c = 0; c < lane.lanes; ++c) dot += tile[lane_number()][c];
    }
    __syncwarp();
  }
  return dot;
}

// dL/dweight of samples from row `row` on, but for what comes through the channels.
template <int K, typename S, typename T>
PRED_DEVICE_ONLY void cotangents(const CompositeArgs<S>& a, const CompositeCotangents<S>& grad, int64_t ray,
                                 int64_t row, int left, T (&sum)[K]) {
  const T of_opacity = grad.opacity ? grad.opacity[ray] : T(0);
#pragma unroll
  for (int k = 0; k < K; ++k) sum[k] = of_opacity;
  T x[K];
  if (grad.depth) {
    const T of_depth = grad.depth[ray];
    positions(a, row, left, x);
#pragma unroll
    for (int k = 0; k < K; ++k) sum[k] += of_depth * x[k];
  }
  if (grad.weights) {
    load_samples(grad.weights + row, left, x);
#pragma unroll
    for (int k = 0; k < K; ++k) sum[k] += x[k];
  }
#pragma unroll
  for (int k = 0; k < K; ++k) sum[k] = k < left ? sum[k] : T(0);
}

// The gradient of t of samples from row `row` on, from their weights and the one before them (0 where there is none).
template <int K, typename T>
PRED_DEVICE_ONLY void position_gradients(bool depth_mid, T grad_depth, const T (&weight)[K], T before, int left,
                                         T* to) {
  T x[K];
#pragma unroll
  for (int k = 0; k < K; ++k) {
    x[k] = grad_depth * weight[k];
    if (!depth_mid) continue;
    // A sample ends a section and starts another; the last one counts at itself.
    if (k + 1 < left) x[k] *= T(0.5);
    x[k] += T(0.5) * grad_depth * (k > 0 ? weight[k - 1] : before);
  }
  store_samples(to, 0, left, x);
}

// Calls body(std::integral_constant<int, V>) with the channels of a lane, of rows of values; 0 where there are none.
template <typename S, class Body, typename... Rows>
void by_channels(int64_t channels, const Body& body, const Rows*... rows) {
  constexpr int64_t kBytes = kChannels<S> * sizeof(S);
  const bool aligned = ((reinterpret_cast<uintptr_t>(rows) | ...) % kBytes) == 0;
  if (channels == 0) {
    body(std::integral_constant<int, 0>{});
  } else if (channels % kChannels<S> == 0 && aligned) {
    body(std::integral_constant<int, kChannels<S>>{});
  } else {
    body(std::integral_constant<int, 1>{});
  }
}

template <class Field, class Args, typename S = typename Args::Storage, typename T = Compute<S>>
void forward(const Args& a, const CompositeOutputs<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  by_channels<S>(
      out.values ? a.channels : 0,
      [&](auto channels) {
        launch_warps(forward_kernel<Field, decltype(channels)::value, Args, S, T>, num_rays, a, out, num_rays);
      },
      a.values, out.values);
}

}  // namespace
}  // namespace pred::PRED_ISA
