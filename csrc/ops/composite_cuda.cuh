// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What the kernels of composite_rays and composite_alpha share.
//
// One warp owns one ray and writes that ray's rows only; 32 of its samples at a time (a turn) have a lane each. Scans
// over samples are shuffles, in double where light is multiplied up, and are carried from turn to turn. The channels of
// a sample lie side by side in memory: there, lanes are columns, as many groups of them as fit into a warp.
#pragma once

#include <type_traits>

#include "common/warp.cuh"
#include "ops/composite.h"

namespace pred::PRED_ISA {
namespace {

// Lanes as rows of `group` columns, the smallest power of 2 that holds the channels from `first` on.
struct Columns {
  int group, rows, row, column;
  bool there;

  __device__ Columns(int64_t channels, int64_t first) {
    const int64_t left = channels - first;
    group = 1;
    while (group < kWarp && group < left) group *= 2;
    rows = kWarp / group;
    row = lane_number() / group;
    column = lane_number() % group;
    there = column < left;
  }
};

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

constexpr int kLoads = 8;

// values[c] = sum_i weights[i] values[i, c], of one ray.
template <typename S, typename T>
PRED_DEVICE_ONLY void render_channels(const T* weights, const S* values, int64_t count, int64_t channels, S* rendered) {
  for (int64_t first = 0; first < channels; first += kWarp) {
    const Columns lane(channels, first);
    T sum = T(0);
    const S* value = values + first + lane.column;
    // As many loads at a time, or each would wait for the sum before it.
    for (int64_t begin = lane.row; begin - lane.row < count; begin += kLoads * lane.rows) {
      T weight[kLoads], here[kLoads];
#pragma unroll
      for (int k = 0; k < kLoads; ++k) {
        const int64_t i = begin + k * lane.rows;
        const bool there = lane.there && i < count;
        weight[k] = there ? weights[i] : T(0);
        here[k] = there ? widen(value[i * channels]) : T(0);
      }
#pragma unroll
      for (int k = 0; k < kLoads; ++k) {
        if (lane.there && begin + k * lane.rows < count) sum += weight[k] * here[k];
      }
    }
    for (int distance = lane.group; distance < kWarp; distance *= 2) {
      sum += __shfl_xor_sync(kWholeWarp, sum, distance);
    }
    if (lane.there && lane.row == 0) rendered[first + lane.column] = narrow<S>(sum);
  }
}

template <class Field, class Args, typename S, typename T>
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
    render_channels(out.weights + at, a.values + at * a.channels, count, a.channels, out.values + ray * a.channels);
  }
}

// One warp's values of 32 samples and 32 channels, turned from a row of lanes per sample to a lane per sample.
template <typename T>
using Tile = T[kWarp][kWarp + 1];

// The samples of a turn, from row `at` on, where the ray has `left` more: returns sum_c values[i, c] grad[c] to the
// lane of sample i (kDot), and writes the gradient of values, weight_i grad[c] (kOuter).
template <bool kDot, bool kOuter, typename S, typename T = Compute<S>>
PRED_DEVICE_ONLY T channel_gradients(const CompositeArgs<S>& a, const CompositeCotangents<S>& grad,
                                     const CompositeGradients<S>& out, T weight, int64_t ray, int64_t at, int64_t left,
                                     Tile<T>& tile) {
  const int64_t channels = a.channels;
  const int count = left < kWarp ? int(left) : kWarp;
  T dot = T(0);
  for (int64_t first = 0; first < channels; first += kWarp) {
    const Columns lane(channels, first);
    const T of_channel = lane.there ? widen(grad.values[ray * channels + first + lane.column]) : T(0);
    const int64_t from = at * channels + first + lane.column;
    for (int begin = lane.row; begin < kWarp; begin += kLoads * lane.rows) {  // as often in each lane
      T value[kLoads];
#pragma unroll
      for (int k = 0; k < kLoads; ++k) {  // ahead of the stores
        const int i = begin + k * lane.rows;
        value[k] = kDot && i < count && lane.there ? widen(a.values[from + i * channels]) : T(0);
      }
#pragma unroll
      for (int k = 0; k < kLoads; ++k) {
        const int i = begin + k * lane.rows;
        const T weight_here = broadcast(weight, i % kWarp);
        if (i >= count || !lane.there) continue;
        if (kDot) tile[i][lane.column] = value[k] * of_channel;
        if (kOuter) out.values[from + i * channels] = narrow<S>(weight_here * of_channel);
      }
    }
    if (!kDot) continue;
    __syncwarp();
    const int columns = channels - first < kWarp ? int(channels - first) : kWarp;
    if (lane_number() < count) {
      for (int c = 0; c < columns; ++c) dot += tile[lane_number()][c];
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

template <class Field, class Args, typename S = typename Args::Storage, typename T = Compute<S>>
void forward(const Args& a, const CompositeOutputs<S>& out, T*, int64_t, int64_t, int64_t num_rays) {
  launch_warps(forward_kernel<Field, Args, S, T>, num_rays, a, out, num_rays);
}

}  // namespace
}  // namespace pred::PRED_ISA
