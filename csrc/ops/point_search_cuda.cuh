// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One warp searches for one query: its lanes look at neighbouring points of the query's frame, all of them in the order
// of rows. Not contracted (-fmad=false): distances are the CPU's.
#pragma once

#include "common/warp.cuh"
#include "ops/point_search.h"
#include "ops/point_tree.h"

namespace pred {

constexpr int kSearchSteps = 8, kSearchPoints = kSearchSteps * kWarp;  // per lane and per warp, between two votes

template <typename T>
struct SearchedFrame {
  const T *x, *y, *z;  // of the points
  T query_x, query_y, query_z;
  int64_t begin, end;  // rows of the frame
};

template <typename T>
PRED_DEVICE_ONLY SearchedFrame<T> frame_of_query(const PointSearch<T>& a, int64_t query) {
  const int64_t num_points = a.frames.num_rows;
  const T *x = a.points, *position = a.queries + 3 * query;
  SearchedFrame<T> frame{x, x + num_points, x + 2 * num_points, position[0], position[1], position[2], 0, 0};
  if (a.frames.num_frames > 0) {
    const int64_t number = frame_of_row(a.query_offsets, a.frames.num_frames, query);
    frame.begin = frame_begin(a.frames, number);
    frame.end = frame_end(a.frames, number);
  }
  return frame;
}

template <typename T>
PRED_DEVICE_ONLY T distance_to(const SearchedFrame<T>& frame, int64_t row) {
  return squared_length(frame.x[row] - frame.query_x, frame.y[row] - frame.query_y, frame.z[row] - frame.query_z);
}

// The lane's points: number s, of kSearchSteps, is row first + row_of_step(s).
PRED_DEVICE_ONLY int row_of_step(int step) { return step * kWarp + lane_number(); }

// Bit s: whether the lane's point number s is closer than the bound. Those with a distance that is not finite are not.
template <typename T>
PRED_DEVICE_ONLY unsigned closer_points(const SearchedFrame<T>& frame, int64_t first, T bound) {
  unsigned closer = 0;
#pragma unroll
  for (int step = 0; step < kSearchSteps; ++step) {
    const int64_t row = first + row_of_step(step);
    const bool exists = row < frame.end;
    closer |= unsigned(exists & (distance_to(frame, exists ? row : frame.end - 1) < bound)) << step;
  }
  return closer;
}

// How many of the lanes below this one have voted.
PRED_DEVICE_ONLY int votes_below(unsigned votes) { return __popc(votes & ((1u << lane_number()) - 1)); }

}  // namespace pred
