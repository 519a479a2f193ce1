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
};

PRED_HOST_DEVICE int64_t ray_begin(const RayRows& rows, int64_t ray) {
  return rows.offsets ? rows.offsets[ray] : ray * rows.num_samples;
}

PRED_HOST_DEVICE int64_t ray_count(const RayRows& rows, int64_t ray) {
  return rows.offsets ? rows.offsets[ray + 1] - rows.offsets[ray] : rows.num_samples;
}

}  // namespace pred
