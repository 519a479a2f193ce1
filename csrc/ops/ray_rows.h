// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Rays of equal or of different lengths. The samples of ray r are rows [ray_begin, ray_begin + ray_count) of all arrays
// over samples ("P" in shapes).
#pragma once

#include "common/host_device.h"

namespace pred {

struct RayRows {
  const int64_t* offsets;  // [R + 1], or null: every ray has num_samples
  int64_t num_samples;
  int64_t num_rows;  // P
};

// Rows exist, whatever the offsets are: not everyone can check them beforehand.
PRED_HOST_DEVICE int64_t ray_begin(const RayRows& rows, int64_t ray) {
  if (!rows.offsets) return ray * rows.num_samples;
  const int64_t begin = rows.offsets[ray] < 0 ? 0 : rows.offsets[ray];
  return begin < rows.num_rows ? begin : rows.num_rows;
}

PRED_HOST_DEVICE int64_t ray_count(const RayRows& rows, int64_t ray) {
  if (!rows.offsets) return rows.num_samples;
  const int64_t count = ray_begin(rows, ray + 1) - ray_begin(rows, ray);
  return count < 0 ? 0 : count;
}

}  // namespace pred
