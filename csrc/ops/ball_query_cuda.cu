// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One warp owns one query and its row of the outputs, which it fills in the order of rows until it is full.
#include "ops/ball_query.h"
#include "ops/point_search_cuda.cuh"

namespace pred::PRED_ISA {
namespace {

template <typename T>
__global__ void __launch_bounds__(kThreads)
    search_kernel(PointSearch<T> a, T squared_radius, int64_t max_points, int64_t* index, int64_t* counts) {
  const int lane = lane_number();
  for (int64_t query = first_warp(); query < a.num_queries; query += warp_stride()) {
    const SearchedFrame<T> frame = frame_of_query(a, query);
    int64_t* rows = index + query * max_points;
    int64_t count = 0;
    for (int64_t first = frame.begin; first < frame.end && count < max_points; first += kSearchPoints) {
      const unsigned inside = closer_points(frame, first, squared_radius);
      if (!__any_sync(kWholeWarp, inside != 0)) continue;
      for (int step = 0; step < kSearchSteps; ++step) {
        const bool listed = inside >> step & 1;
        const unsigned votes = __ballot_sync(kWholeWarp, listed);
        const int64_t place = count + votes_below(votes);
        if (listed && place < max_points) rows[place] = first + row_of_step(step);
        count += __popc(votes);
      }
    }
    if (count > max_points) count = max_points;
    for (int64_t i = count + lane; i < max_points; i += kWarp) rows[i] = -1;
    if (lane == 0) counts[query] = count;
  }
}

template <typename T>
void search(const PointSearch<T>& a, T squared_radius, int64_t max_points, int64_t* index, int64_t* counts) {
  launch_warps(search_kernel<T>, a.num_queries, a, squared_radius, max_points, index, counts);
}

}  // namespace

const BallQueryKernels<float> ball_query_f32 = {search<float>};
const BallQueryKernels<double> ball_query_f64 = {search<double>};

}  // namespace pred::PRED_ISA
