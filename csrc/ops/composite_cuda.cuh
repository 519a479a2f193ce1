// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What the kernels of composite_rays and composite_alpha share.
//
// One warp owns one ray and writes that ray's rows only; 32 of its samples at a time (a turn) have a lane each. Scans
// over samples are shuffles, in double where light is multiplied up, and are carried from turn to turn. The channels of
// a sample lie side by side in memory: there, a lane has some neighbouring ones, and a warp as many samples as fit.
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

// Where sample i of a ray is counted.
template <typename S>
PRED_DEVICE_ONLY Compute<S> position(const CompositeArgs<S>& a, int64_t at, int64_t i, int64_t count) {
  using T = Compute<S>;
  const T here = a.t[at + i];
  return a.depth_mid && i + 1 < count ? T(0.5) * (here + a.t[at + i + 1]) : here;
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

template <class Field, int V, class Args, typename S, typename T>
__global__ void __launch_bounds__(kThreads) forward_kernel(Args a, CompositeOutputs<S> out, int64_t num_rays) {
  const Field field(a);
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    const int64_t at = ray_begin(a.rows, ray), count = ray_count(a.rows, ray);
    double transmittance = 1;
    T depth = T(0), opacity = T(0);
    for (int64_t first = 0; first < count; first += kWarp) {
      const int64_t i = first + lane_number();
      const bool there = i < count;
      Opacity<T> here{T(0), 1.0};
      if (there) here = field(at, i, count);
      const double product = prefix_product(here.passed);
      const T weight = T(transmittance * from_before(product, 1.0) * double(here.alpha));
      transmittance *= broadcast(product, kWarp - 1);
      if (!there) continue;
      out.weights[at + i] = weight;
      opacity += weight;
      if (out.depth) depth += weight * position(a, at, i, count);
    }
    opacity = sum_lanes(opacity);
    depth = sum_lanes(depth);
    if (lane_number() == 0) {
      out.opacity[ray] = opacity;
      if (out.depth) out.depth[ray] = depth;
      if (out.remaining) out.remaining[ray] = T(transmittance);
    }
    if (!out.values) continue;
    __syncwarp();  // all lanes read the weights
    render_channels<V>(out.weights + at, a.values + at * a.channels, count, a.channels, out.values + ray * a.channels);
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

// dL/dweight of sample i, but for what comes through the channels.
template <typename S>
PRED_DEVICE_ONLY Compute<S> cotangent(const CompositeArgs<S>& a, const CompositeCotangents<S>& grad, int64_t ray,
                                      int64_t at, int64_t i, int64_t count) {
  using T = Compute<S>;
  T sum = grad.opacity ? grad.opacity[ray] : T(0);
  if (grad.depth) sum += grad.depth[ray] * position(a, at, i, count);
  if (grad.weights) sum += grad.weights[at + i];
  return sum;
}

// The gradient of t_i, from the weights of samples i and i - 1.
template <typename T>
PRED_DEVICE_ONLY T position_gradient(bool depth_mid, T grad_depth, T weight, T weight_before, int64_t i,
                                     int64_t count) {
  if (!depth_mid) return grad_depth * weight;
  // Sample i ends section i - 1 and starts section i; the last sample counts at itself.
  const T own = i + 1 < count ? T(0.5) * (grad_depth * weight) : grad_depth * weight;
  return i > 0 ? own + T(0.5) * grad_depth * weight_before : own;
}

// Calls body(std::integral_constant<int, V>) with the channels of a lane, of rows of values.
template <typename S, class Body, typename... Rows>
void by_channels(int64_t channels, const Body& body, const Rows*... rows) {
  constexpr int64_t kBytes = kChannels<S> * sizeof(S);
  const bool aligned = ((reinterpret_cast<uintptr_t>(rows) | ...) % kBytes) == 0;
  if (channels % kChannels<S> == 0 && aligned) {
    body(std::integral_constant<int, kChannels<S>>{});
  } else {
    body(std::integral_constant<int, 1>{});
  }
}

template <class Field, class Args, typename S = typename Args::Storage, typename T = Compute<S>>
void forward(const Args& a, const CompositeOutputs<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  by_channels<S>(
      a.channels,
      [&](auto channels) {
        launch_warps(forward_kernel<Field, decltype(channels)::value, Args, S, T>, num_rays, a, out, num_rays);
      },
      a.values, out.values);
}

}  // namespace
}  // namespace pred::PRED_ISA
