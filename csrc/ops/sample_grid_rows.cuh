// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Rows of channels on the device: a group of lanes moves a row, 16 bytes to an access where rows allow it.
#pragma once

#include "common/pack.cuh"
#include "common/warp.cuh"
#include "ops/sample_grid.h"

namespace pred::PRED_ISA {
namespace {

// Lanes that share one sample, a power of 2.
struct Group {
  int size, shift, lane;

  // In the body: the host's compiler sees initializers of device constructors, but knows no intrinsics.
  __device__ explicit Group(int lanes) {
    size = lanes;
    shift = __ffs(lanes) - 1;
    lane = lane_number() & (lanes - 1);
  }
  // Samples are numbered so that the groups of a warp have neighbouring ones.
  __device__ int64_t first() const { return first_thread() >> shift; }
  __device__ int64_t stride() const { return thread_stride() >> shift; }
  // Among those of the warp, and how many there are.
  __device__ int number() const { return lane_number() >> shift; }
  __device__ int per_warp() const { return kWarp >> shift; }
};

// The rows of the map between which a sample lies; null outside of it.
template <typename S, int Axes>
struct Corners {
  const S* row[1 << Axes];
  bool any;

  __device__ Corners(const S* map, const SampleGridArgs<S, Axes>& a, const LinearStencil<Compute<S>, Axes>& s) {
    any = false;
#pragma unroll
    for (int k = 0; k < 1 << Axes; ++k) {
      int64_t offset = 0;
      for (int axis = 0; axis < Axes; ++axis) offset += (s.axis[axis].low + (k >> axis & 1)) * a.stride[axis];
      const bool inside = linear_inside(s, k);
      row[k] = inside ? map + offset : nullptr;
      any = any || inside;
    }
  }
};

// Channels of an access: 16 bytes where rows allow it.
template <typename S, class... Rows>
bool in_packs(int64_t channels, const Rows*... rows) {
  constexpr int64_t kBytes = 16;
  return channels * int64_t(sizeof(S)) % kBytes == 0 && ((reinterpret_cast<uintptr_t>(rows) | ...) % kBytes) == 0;
}

template <typename S>
constexpr int kPack = 16 / int(sizeof(S));

inline int lanes_for(int64_t pieces) {
  int lanes = 1;
  while (lanes < kWarp && lanes < pieces) lanes *= 2;
  return lanes;
}

// Calls body(std::integral_constant<int, V>, lanes of a group) with V channels to an access.
template <typename S, class Body>
void by_pack(bool packs, int64_t channels, const Body& body) {
  if (packs) {
    body(std::integral_constant<int, kPack<S>>(), lanes_for(channels / kPack<S>));
  } else {
    body(std::integral_constant<int, 1>(), lanes_for(channels));
  }
}

}  // namespace
}  // namespace pred::PRED_ISA
