// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What kernels that are launched search: queries, and the points of their frames.
#pragma once

#include "common/frames.h"

namespace pred {

template <typename T>
struct PointSearch {
  const T* points;               // [3, N]
  const T* queries;              // [M, 3]
  FrameRows frames;              // of the points
  const int64_t* query_offsets;  // [B + 1], not checked either
  int64_t num_queries;           // M
};

}  // namespace pred
