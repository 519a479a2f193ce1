// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Ragged batches: frame b owns the rows offsets[b] .. offsets[b + 1] of a tensor.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <algorithm>

#include "common/check.h"

namespace pred {

// Checked and contiguous; `letter` names the number of rows in the message.
inline Tensor read_offsets(const char* op, const char* name, const Tensor& offsets_in, char letter, int64_t num_rows) {
  check_tensor(op, name, offsets_in, 1, ScalarType::Long);
  const Tensor offsets = torch::stable::contiguous(offsets_in);
  if (kLaunch) {
    PRED_CHECK(offsets.size(0) >= 1, op, ": ", name, " must have at least one entry");
    return offsets;
  }
  const int64_t* offset = offsets.const_data_ptr<int64_t>();
  const int64_t num_frames = offsets.size(0) - 1;
  PRED_CHECK(num_frames >= 0 && offset[0] == 0 && std::is_sorted(offset, offset + num_frames + 1) &&
                 offset[num_frames] == num_rows,
             op, ": ", name, " must ascend from 0 to ", letter, "=", num_rows);
  return offsets;
}

// The same for points, whose rows are numbered in 31 bits.
inline Tensor frame_offsets(const char* op, const char* name, const Tensor& offsets_in, char letter, int64_t num_rows) {
  PRED_CHECK(num_rows < int64_t(1) << 31, op, ": ", name, " must divide fewer than 2^31 rows, got ", num_rows);
  return read_offsets(op, name, offsets_in, letter, num_rows);
}

// Calls body(frame, begin, end) for the pieces of [begin, end) that belong to one frame each, in order.
template <class Body>
void for_each_frame(const int64_t* offset, int64_t num_frames, int64_t begin, int64_t end, const Body& body) {
  int64_t frame = std::upper_bound(offset, offset + num_frames + 1, begin) - offset - 1;
  for (; begin < end; ++frame) {
    const int64_t stop = std::min(end, offset[frame + 1]);
    if (begin < stop) body(frame, begin, stop);
    begin = stop;
  }
}

}  // namespace pred
