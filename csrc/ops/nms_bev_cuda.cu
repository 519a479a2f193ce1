// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Candidates are sorted, then taken in rounds. In a round a block of kTile threads, one per candidate, compares a tile
// of candidates with a tile of boxes in shared memory: with those kept in earlier rounds, which drop the candidate,
// then with candidates of the same round, which gives a word of bits, one per box that would suppress it. A single
// block decides by these words, tile by tile: a warp gathers what kept boxes of earlier tiles say of a candidate, one
// thread what those of its own tile say.
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/nms_bev.h"

namespace pred::PRED_ISA {
namespace {

constexpr int kTile = 64;  // bits of a word
constexpr int64_t kRound = 4096, kRoundTiles = kRound / kTile;
constexpr int kDeciders = 512;

int64_t tiles_of(int64_t count) { return (count + kTile - 1) / kTile; }

struct Space {
  uint64_t *keys, *sorted;
  int32_t *rows, *sorted_rows;
  char* sort_work;
  int64_t sort_size;
  BoxTable candidates, kept;  // by falling score
  bool* dropped;              // of candidates: no candidate, or suppressed by a box kept in an earlier round
  uint64_t* overlaps;         // [kRound, kRoundTiles]
  int64_t* kept_rows;
  int32_t* num_kept;
  int64_t bytes;

  Space(const NmsBevSizes& sizes, int key_bits, char* memory) {
    sort_size = sort_rows_bytes(sizes.boxes, key_bits);
    Workspace space(memory);
    keys = space.take<uint64_t>(sizes.boxes);
    sorted = space.take<uint64_t>(sizes.boxes);
    rows = space.take<int32_t>(sizes.boxes);
    sorted_rows = space.take<int32_t>(sizes.boxes);
    sort_work = space.take<char>(sort_size);
    candidates = take_table(space, sizes.candidates);
    kept = take_table(space, sizes.kept);
    dropped = space.take<bool>(sizes.candidates);
    overlaps = space.take<uint64_t>((sizes.candidates < kRound ? sizes.candidates : kRound) * kRoundTiles);
    kept_rows = space.take<int64_t>(sizes.kept);
    num_kept = space.take<int32_t>(1);
    bytes = space.bytes();
  }

  static BoxTable take_table(Workspace& space, int64_t count) {
    const int64_t stride = BoxTable::stride_of(count);
    return {space.take<double>(kBoxColumns * stride), stride, count};
  }
};

template <typename T>
constexpr int kKeyBits = 8 * sizeof(T);

// Comes behind the keys of all scores.
template <typename T>
constexpr uint64_t kNoCandidate = ~uint64_t(0) >> (64 - kKeyBits<T>);

// Ascends as scores fall.
template <typename T>
PRED_DEVICE_ONLY uint64_t key_of(T score) {
  constexpr uint64_t sign = uint64_t(1) << (kKeyBits<T> - 1);
  score = score == T(0) ? T(0) : score;  // -0 is 0
  uint64_t bits = 0;
  __builtin_memcpy(&bits, &score, sizeof score);
  return bits & sign ? bits : bits ^ (sign - 1);
}

template <typename T>
__global__ void keys_kernel(const T* boxes, const T* scores, int64_t count, uint64_t* keys, int32_t* rows) {
  for (int64_t row = first_thread(); row < count; row += thread_stride()) {
    const T score = scores[row];
    keys[row] = score == score && is_box(boxes + 7 * row) ? key_of(score) : kNoCandidate<T>;
    rows[row] = int32_t(row);
  }
}

template <typename T>
__global__ void candidates_kernel(Space s, const T* boxes) {
  if (first_thread() == 0) *s.num_kept = 0;
  for (int64_t n = first_thread(); n < s.candidates.count; n += thread_stride()) {
    const bool is_candidate = s.sorted[n] != kNoCandidate<T>;
    s.dropped[n] = !is_candidate;
    put_box(s.candidates, n, is_candidate ? read_box(boxes + 7 * int64_t(s.sorted_rows[n])) : no_box());
  }
}

PRED_DEVICE_ONLY bool is_full(const Space& s) { return *s.num_kept >= s.kept.count; }

// Which of the first boxes of a tile suppress the box; one of them will do for `some`.
template <bool some>
PRED_DEVICE_ONLY uint64_t suppressors(const Box* tile, int count, const Box& box, double iou_threshold) {
  uint64_t near = 0, found = 0;
  for (int i = 0; i < count; ++i) near |= uint64_t(is_near(tile[i], box)) << i;
  while (near != 0) {  // few are
    const int i = 63 - __clzll((long long)near);
    const uint64_t bit = uint64_t(1) << i;
    near ^= bit;
    if (!(iou_bev(tile[i], box) > iou_threshold)) continue;
    found |= bit;
    if (some) break;
  }
  return found;
}

// Candidates [first, last) beside the boxes kept so far.
__global__ void __launch_bounds__(kTile) drop_kernel(Space s, double iou_threshold, int64_t first, int64_t last) {
  __shared__ Box tile[kTile];
  if (is_full(s)) return;
  const int64_t num_kept = *s.num_kept, tiles = (last - first + kTile - 1) / kTile;
  const int64_t items = tiles * ((num_kept + kTile - 1) / kTile);
  for (int64_t item = blockIdx.x; item < items; item += gridDim.x) {
    const int64_t tile_begin = item / tiles * kTile, n = first + item % tiles * kTile + threadIdx.x;
    const int count = int(num_kept - tile_begin < kTile ? num_kept - tile_begin : kTile);
    if (int(threadIdx.x) < count) tile[threadIdx.x] = box_at(s.kept, tile_begin + threadIdx.x);
    __syncthreads();
    if (n < last && !s.dropped[n] && suppressors<true>(tile, count, box_at(s.candidates, n), iou_threshold) != 0)
      s.dropped[n] = true;
    __syncthreads();
  }
}

// Candidates [first, last) beside those before them.
__global__ void __launch_bounds__(kTile) overlaps_kernel(Space s, double iou_threshold, int64_t first, int64_t last) {
  __shared__ Box tile[kTile];
  if (is_full(s)) return;
  const int64_t tiles = (last - first + kTile - 1) / kTile;
  for (int64_t item = blockIdx.x; item < tiles * tiles; item += gridDim.x) {
    const int64_t later = item / tiles, earlier = item % tiles;
    if (earlier > later) continue;
    const int64_t other = first + earlier * kTile + threadIdx.x, n = first + later * kTile + threadIdx.x;
    tile[threadIdx.x] = other < last && !s.dropped[other] ? box_at(s.candidates, other) : no_box();
    __syncthreads();
    if (n < last && !s.dropped[n]) {
      s.overlaps[(n - first) * kRoundTiles + earlier] =
          suppressors<false>(tile, earlier < later ? kTile : int(threadIdx.x), box_at(s.candidates, n), iou_threshold);
    }
    __syncthreads();
  }
}

__global__ void __launch_bounds__(kDeciders) decide_kernel(Space s, int64_t first, int64_t last) {
  __shared__ uint64_t kept_bits[kRoundTiles], own_tile[kTile];
  __shared__ bool is_left[kTile];   // by the boxes of earlier tiles
  __shared__ int32_t place[kTile];  // among the kept boxes, or -1
  __shared__ int32_t num_kept;
  if (is_full(s)) return;
  if (threadIdx.x == 0) num_kept = *s.num_kept;
  __syncthreads();
  const int thread = int(threadIdx.x), lane = lane_number();
  const int64_t tiles = (last - first + kTile - 1) / kTile;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    const int64_t begin = first + tile * kTile;
    for (int i = thread / kWarp; i < kTile; i += kDeciders / kWarp) {
      const int64_t n = begin + i;
      const bool is_here = n < last && !s.dropped[n];
      const uint64_t* words = s.overlaps + (n - first) * kRoundTiles;
      uint64_t found = 0;
      if (is_here) {
        for (int64_t earlier = lane; earlier < tile; earlier += kWarp) found |= words[earlier] & kept_bits[earlier];
      }
      const bool is_suppressed = __any_sync(kWholeWarp, found != 0);
      if (lane == 0) {
        is_left[i] = is_here && !is_suppressed;
        own_tile[i] = is_here ? words[tile] : 0;
      }
    }
    __syncthreads();
    if (thread == 0) {
      uint64_t bits = 0;
      for (int i = 0; i < kTile; ++i) {
        const bool stays = is_left[i] && (own_tile[i] & bits) == 0 && num_kept < s.kept.count;
        bits |= uint64_t(stays) << i;
        place[i] = stays ? num_kept++ : -1;
      }
      kept_bits[tile] = bits;
    }
    __syncthreads();
    if (thread < kTile && place[thread] >= 0) {
      put_box(s.kept, place[thread], box_at(s.candidates, begin + thread));
      s.kept_rows[place[thread]] = s.sorted_rows[begin + thread];
    }
    if (num_kept >= s.kept.count) break;
  }
  if (thread == 0) *s.num_kept = num_kept;
}

__global__ void write_kernel(const int64_t* kept_rows, int64_t num_kept, int64_t* out) {
  for (int64_t n = first_thread(); n < num_kept; n += thread_stride()) out[n] = kept_rows[n];
}

template <typename T>
int64_t workspace_bytes(const NmsBevSizes& sizes) {
  return Space(sizes, kKeyBits<T>, nullptr).bytes;
}

template <typename T>
int64_t keep(const T* boxes, const T* scores, double iou_threshold, const NmsBevSizes& sizes, char* workspace) {
  const Space s(sizes, kKeyBits<T>, workspace);
  launch_threads(keys_kernel<T>, sizes.boxes, boxes, scores, sizes.boxes, s.keys, s.rows);
  sort_rows(s.sort_work, s.sort_size, s.keys, s.sorted, s.rows, s.sorted_rows, sizes.boxes, kKeyBits<T>);
  launch_threads(candidates_kernel<T>, sizes.candidates, s, boxes);
  for (int64_t first = 0; first < sizes.candidates; first += kRound) {
    const int64_t last = first + kRound < sizes.candidates ? first + kRound : sizes.candidates;
    const int64_t tiles = tiles_of(last - first), kept_tiles = tiles_of(first < sizes.kept ? first : sizes.kept);
    constexpr int64_t kMostAtOnce = 64;  // of the tiles of kept boxes, of which there may be fewer
    launch_blocks(drop_kernel, tiles * (kept_tiles < kMostAtOnce ? kept_tiles : kMostAtOnce), kTile, 0, s,
                  iou_threshold, first, last);
    launch_blocks(overlaps_kernel, tiles * tiles, kTile, 0, s, iou_threshold, first, last);
    launch_blocks(decide_kernel, 1, kDeciders, 0, s, first, last);
  }
  return read_back(s.num_kept);
}

template <typename T>
void write(const NmsBevSizes& sizes, int64_t num_kept, int64_t* out, char* workspace) {
  const int64_t* kept_rows = Space(sizes, kKeyBits<T>, workspace).kept_rows;
  launch_threads(write_kernel, num_kept, kept_rows, num_kept, out);
}

template <typename T>
constexpr NmsBevKernels<T> table() {
  return {workspace_bytes<T>, keep<T>, write<T>};
}

}  // namespace

const NmsBevKernels<float> nms_bev_f32 = table<float>();
const NmsBevKernels<double> nms_bev_f64 = table<double>();

}  // namespace pred::PRED_ISA
