// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Frames of a ragged batch for kernels that are launched, where nobody has checked the offsets: frame b owns the rows
// [frame_begin, frame_end), which exist whatever the offsets are.
#pragma once

#include "common/host_device.h"

namespace pred {

struct FrameRows {
  const int64_t* offsets;  // [B + 1]
  int64_t num_frames, num_rows;
};

PRED_HOST_DEVICE int64_t frame_begin(const FrameRows& frames, int64_t frame) {
  const int64_t begin = frames.offsets[frame] < 0 ? 0 : frames.offsets[frame];
  return begin < frames.num_rows ? begin : frames.num_rows;
}

PRED_HOST_DEVICE int64_t frame_end(const FrameRows& frames, int64_t frame) {
  const int64_t begin = frame_begin(frames, frame), end = frame_begin(frames, frame + 1);
  return begin < end ? end : begin;
}

// The last frame that starts at this row or before, else frame 0.
PRED_HOST_DEVICE int64_t frame_of_row(const int64_t* offsets, int64_t num_frames, int64_t row) {
  int64_t frame = 0, high = num_frames - 1;
  while (frame < high) {
    const int64_t middle = (frame + high + 1) / 2;
    if (offsets[middle] <= row)
      frame = middle;
    else
      high = middle - 1;
  }
  return frame;
}

}  // namespace pred
