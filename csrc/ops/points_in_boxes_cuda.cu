// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one point, and its results: in `first` with the boxes of its frame, in `mask` with a tile of all
// boxes. A block's threads copy the boxes of a tile into shared memory together.
#include "common/launch.cuh"
#include "ops/points_in_boxes.h"

namespace pred::PRED_ISA {
namespace {

constexpr int kTileBoxes = 64;

struct Range {
  int64_t begin, end;
};

PRED_DEVICE_ONLY int64_t between(int64_t value, int64_t low, int64_t high) {
  return value < low ? low : value < high ? value : high;
}

// The boxes of a point's frame, the last one that begins at the point or before. Offsets are not checked.
PRED_DEVICE_ONLY Range boxes_of(const BoxFrames& frames, int64_t point, int64_t num_boxes) {
  if (frames.point_offsets == nullptr) return {0, num_boxes};
  if (frames.count <= 0) return {0, 0};
  int64_t frame = 0, high = frames.count - 1;
  while (frame < high) {
    const int64_t middle = (frame + high + 1) / 2;
    if (frames.point_offsets[middle] <= point)
      frame = middle;
    else
      high = middle - 1;
  }
  return {between(frames.box_offsets[frame], 0, num_boxes), between(frames.box_offsets[frame + 1], 0, num_boxes)};
}

PRED_DEVICE_ONLY void copy_tile(const BoxTable& boxes, int64_t begin, int count, Box* tile) {
  for (int i = int(threadIdx.x); i < count; i += kThreads) tile[i] = box_at(boxes, begin + i);
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    first_kernel(BoxTable boxes, BoxFrames frames, const T* points, int64_t num_points, int64_t* out) {
  __shared__ Box tile[kTileBoxes];
  __shared__ int64_t block_begin, block_end;
  for (int64_t start = int64_t(blockIdx.x) * kThreads; start < num_points; start += thread_stride()) {
    const int64_t n = start + threadIdx.x;
    Range own{0, 0};
    double x = 0, y = 0, z = 0;
    if (n < num_points) {
      own = boxes_of(frames, n, boxes.count);
      x = double(points[3 * n]), y = double(points[3 * n + 1]), z = double(points[3 * n + 2]);
    }
    // Frames ascend: boxes from the first point's to the last one's are those of all.
    if (threadIdx.x == 0) block_begin = own.begin;
    if (n == num_points - 1 || (n < num_points && threadIdx.x == kThreads - 1)) block_end = own.end;
    __syncthreads();
    const int64_t begin = block_begin, end = block_end;
    int64_t found = -1;
    for (int64_t tile_begin = begin; tile_begin < end; tile_begin += kTileBoxes) {
      const int64_t tile_end = tile_begin + kTileBoxes < end ? tile_begin + kTileBoxes : end;
      copy_tile(boxes, tile_begin, int(tile_end - tile_begin), tile);
      __syncthreads();
      const int64_t last = own.end < tile_end ? own.end : tile_end;
      for (int64_t b = own.begin > tile_begin ? own.begin : tile_begin; b < last && found < 0; ++b)
        if (contains(tile[b - tile_begin], x, y, z)) found = b;
      __syncthreads();
    }
    if (n < num_points) out[n] = found;
    if (begin >= end) __syncthreads();  // all have read the bounds before others are written
  }
}

template <typename T>
__global__ void __launch_bounds__(kThreads)
    mask_kernel(BoxTable boxes, const T* points, int64_t num_points, uint8_t* mask) {
  __shared__ Box tile[kTileBoxes];
  const int64_t parts = (num_points + kThreads - 1) / kThreads, tiles = (boxes.count + kTileBoxes - 1) / kTileBoxes;
  for (int64_t item = blockIdx.x; item < parts * tiles; item += gridDim.x) {
    const int64_t first = item / parts * kTileBoxes, n = item % parts * kThreads + threadIdx.x;
    const int count = int(boxes.count - first < kTileBoxes ? boxes.count - first : kTileBoxes);
    copy_tile(boxes, first, count, tile);
    __syncthreads();
    if (n < num_points) {
      const double x = double(points[3 * n]), y = double(points[3 * n + 1]), z = double(points[3 * n + 2]);
      for (int i = 0; i < count; ++i) mask[(first + i) * num_points + n] = contains(tile[i], x, y, z);
    }
    __syncthreads();
  }
}

template <typename T>
void first(const BoxTable& boxes, const BoxFrames& frames, const T* points, int64_t num_points, int64_t* out) {
  launch_threads(first_kernel<T>, num_points, boxes, frames, points, num_points, out);
}

template <typename T>
void mask(const BoxTable& boxes, const T* points, int64_t num_points, uint8_t* mask) {
  const int64_t parts = (num_points + kThreads - 1) / kThreads, tiles = (boxes.count + kTileBoxes - 1) / kTileBoxes;
  launch_blocks(mask_kernel<T>, parts * tiles, kThreads, 0, boxes, points, num_points, mask);
}

}  // namespace

const PointsInBoxesKernels<float> points_in_boxes_f32 = {first<float>, mask<float>};
const PointsInBoxesKernels<double> points_in_boxes_f64 = {first<double>, mask<double>};

}  // namespace pred::PRED_ISA
