// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One warp owns one query and its row of the outputs. Points that are closer than the worst of the k best so far wait
// in shared memory; 32 of them at a time are sorted and merged into the sorted list of the best, which is in shared
// memory too, or in the row of the outputs if it is long. Points come in the order of rows: among equal distances, what
// is in the list already stays in front.
#include "ops/knn.h"
#include "ops/point_search_cuda.cuh"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kShortList = 128;
constexpr int kWarps = kThreads / kWarp;

// Ascending. Fewer than 2^31, as there are points.
template <typename T>
struct Neighbors {
  T* distance;
  int64_t* row;
  uint32_t count;
};

// How many entries of an ascending list are less than a value, or not greater.
template <bool kOrEqual, typename T>
PRED_DEVICE_ONLY uint32_t count_below(const T* list, uint32_t count, T value) {
  uint32_t low = 0;
  while (low < count) {
    const uint32_t middle = (low + count) / 2;
    if (kOrEqual ? list[middle] <= value : list[middle] < value)
      low = middle + 1;
    else
      count = middle;
  }
  return low;
}

// Puts up to 32 candidates into the list, of which at most `most` entries stay. `distance` is sorted on the way.
template <typename T>
PRED_DEVICE_ONLY void merge(Neighbors<T>& best, uint32_t most, T* distance, const int32_t* row, uint32_t count) {
  __syncwarp();
  const uint32_t lane = uint32_t(lane_number());
  const bool has = lane < count;
  const T mine = has ? distance[lane] : T(0);
  const int32_t my_row = has ? row[lane] : 0;
  uint32_t place = 0;  // among the candidates
  for (uint32_t i = 0; i < count; ++i) place += distance[i] < mine || (distance[i] == mine && i < lane);
  const uint32_t my_place = place + count_below<true>(best.distance, best.count, mine);
  __syncwarp();
  if (has) distance[place] = mine;
  __syncwarp();
  // Entries move up by the number of candidates before them: those at the end first.
  for (uint32_t end = (best.count + kWarp - 1) / kWarp * kWarp; end > 0; end -= kWarp) {
    const uint32_t i = end - kWarp + lane;
    T entry{};
    int64_t entry_row = 0;
    uint32_t to = i;
    if (i < best.count) {
      entry = best.distance[i];
      entry_row = best.row[i];
      to += count_below<false>(distance, count, entry);
    }
    __syncwarp();
    if (!__any_sync(kWholeWarp, to > i)) break;
    if (to > i && to < most) {
      best.distance[to] = entry;
      best.row[to] = entry_row;
    }
  }
  if (has && my_place < most) {
    best.distance[my_place] = mine;
    best.row[my_place] = my_row;
  }
  best.count = best.count + count < most ? best.count + count : most;
  __syncwarp();
}

template <typename T>
__global__ void __launch_bounds__(kThreads) search_kernel(PointSearch<T> a, int64_t k, int64_t* index, T* distance) {
  __shared__ T all_waiting[kWarps][kWarp];
  __shared__ int32_t all_waiting_rows[kWarps][kWarp];
  const int lane = lane_number(), warp = int(threadIdx.x) / kWarp;
  T* waiting = all_waiting[warp];
  int32_t* waiting_rows = all_waiting_rows[warp];
  const bool is_short = k <= kShortList;
  const uint32_t most = uint32_t(k < a.frames.num_rows ? k : a.frames.num_rows);
  for (int64_t query = first_warp(); query < a.num_queries; query += warp_stride()) {
    const SearchedFrame<T> frame = frame_of_query(a, query);
    int64_t* out_rows = index + query * k;
    T* out_distance = distance + query * k;
    Neighbors<T> best{out_distance, out_rows, 0};
    if (is_short) {
      int64_t* rows = static_cast<int64_t*>(dynamic_shared());
      best.row = rows + warp * k;
      best.distance = reinterpret_cast<T*>(rows + kWarps * k) + warp * k;
    }
    T worst = T(__builtin_inf());
    uint32_t num_waiting = 0;
    for (int64_t first = frame.begin; first < frame.end; first += kSearchPoints) {
      const unsigned closer = closer_points(frame, first, worst);
      if (!__any_sync(kWholeWarp, closer != 0)) continue;
      for (int step = 0; step < kSearchSteps; ++step) {
        const int64_t row = first + row_of_step(step);
        const T to_point = closer >> step & 1 ? distance_to(frame, row) : T(__builtin_inf());
        unsigned votes = __ballot_sync(kWholeWarp, to_point < worst);
        if (num_waiting + uint32_t(__popc(votes)) > kWarp) {
          merge(best, most, waiting, waiting_rows, num_waiting);
          num_waiting = 0;
          if (best.count == most) worst = best.distance[most - 1];
          votes = __ballot_sync(kWholeWarp, to_point < worst);
        }
        if (to_point < worst) {
          waiting[num_waiting + votes_below(votes)] = to_point;
          waiting_rows[num_waiting + votes_below(votes)] = int32_t(row);
        }
        num_waiting += uint32_t(__popc(votes));
      }
    }
    merge(best, most, waiting, waiting_rows, num_waiting);
    for (int64_t i = lane; i < k; i += kWarp) {
      if (!is_short && i < best.count) continue;  // it is there
      out_rows[i] = i < best.count ? best.row[i] : -1;
      out_distance[i] = i < best.count ? best.distance[i] : T(__builtin_inf());
    }
  }
}

template <typename T>
void search(const PointSearch<T>& a, int64_t k, int64_t* index, T* distance) {
  if (k == 0) return;
  const int64_t shared = k <= kShortList ? kWarps * k * int64_t(sizeof(int64_t) + sizeof(T)) : 0;
  launch_blocks(search_kernel<T>, (a.num_queries + kWarps - 1) / kWarps, kThreads, shared, a, k, index, distance);
}

}  // namespace

const KnnKernels<float> knn_f32 = {search<float>};
const KnnKernels<double> knn_f64 = {search<double>};

}  // namespace pred::PRED_ISA
