// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Sums and scans over the lanes of a warp, all of which take part. Each is the same sequence of roundings every time.
#pragma once

#include "common/launch.cuh"

namespace pred {

// Of lane `from`.
template <typename T>
PRED_DEVICE_ONLY T broadcast(T value, int from) {
  return __shfl_sync(kWholeWarp, value, from);
}

// Every lane gets the sum over groups of `width` neighbouring lanes, a power of 2.
template <typename T>
PRED_DEVICE_ONLY T sum_lanes(T value, int width = kWarp) {
  for (int distance = width / 2; distance > 0; distance /= 2) value += __shfl_xor_sync(kWholeWarp, value, distance);
  return value;
}

// Lane i gets value_0 ... value_i.
template <typename T>
PRED_DEVICE_ONLY T prefix_product(T value) {
  for (int distance = 1; distance < kWarp; distance *= 2) {
    const T other = __shfl_up_sync(kWholeWarp, value, distance);
    if (lane_number() >= distance) value *= other;
  }
  return value;
}

template <typename T>
PRED_DEVICE_ONLY T prefix_sum(T value) {
  for (int distance = 1; distance < kWarp; distance *= 2) {
    const T other = __shfl_up_sync(kWholeWarp, value, distance);
    if (lane_number() >= distance) value += other;
  }
  return value;
}

// Lane i gets value_i + ... + value_31.
template <typename T>
PRED_DEVICE_ONLY T suffix_sum(T value) {
  for (int distance = 1; distance < kWarp; distance *= 2) {
    const T other = __shfl_down_sync(kWholeWarp, value, distance);
    if (lane_number() + distance < kWarp) value += other;
  }
  return value;
}

// Lane i gets lane i - 1's value, lane 0 gets `first`.
template <typename T>
PRED_DEVICE_ONLY T from_before(T value, T first) {
  const T other = __shfl_up_sync(kWholeWarp, value, 1);
  return lane_number() == 0 ? first : other;
}

// Lane i gets lane i + 1's value, lane 31 gets `last`.
template <typename T>
PRED_DEVICE_ONLY T from_behind(T value, T last) {
  const T other = __shfl_down_sync(kWholeWarp, value, 1);
  return lane_number() == kWarp - 1 ? last : other;
}

}  // namespace pred
