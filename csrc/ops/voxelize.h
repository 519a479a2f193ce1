// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// voxelize: the occupied voxels of a ragged batch of point clouds, and the voxel of each point.
//
// A voxel's key has one field of bits per coordinate, b above z above y above x, so that keys ascend as
// (b, z, y, x) do and are taken apart by shifts. Points are packed with their keys, sorted
// (common/radix_sort.h), and each run of equal keys becomes one voxel.
#pragma once

#include "common/host_device.h"
#include "common/isa.h"
#include "math/half.h"

namespace pred {

template <typename T>
struct VoxelGrid {
  T low[3], high[3], size[3];  // x, y, z, rounded to the dtype of the points
  int32_t cells[3];            // at most 2^30 per axis
};

// Voxel along one axis, -1 outside [low, high). NaN fails both comparisons. The quotient of a value just below
// `high` may round up to `cells`; it belongs to the last voxel.
template <typename T>
PRED_HOST_DEVICE int32_t voxel_index(T value, T low, T high, T size, int32_t cells) {
  const bool inside = (value >= low) & (value < high);
  const T quotient = (inside ? value - low : T(0)) / size;  // not negative: truncation is floor
  const int32_t index = quotient < T(cells) ? int32_t(quotient) : cells - 1;
  return inside ? index : -1;
}

struct VoxelKeyBits {
  int x, y, z, row;  // an item is (b, z, y, x, row), from the highest bits to the lowest
};

// Whether item i of the sorted list is the first of its voxel.
template <typename Item>
PRED_HOST_DEVICE bool starts_voxel(const Item* items, int row_bits, int64_t i) {
  return i == 0 || (items[i] ^ items[i - 1]) >> row_bits != 0;
}

PRED_HOST_DEVICE int64_t low_bits(uint64_t value, int width) { return int64_t(value & ((uint64_t(1) << width) - 1)); }

template <typename Item>
PRED_HOST_DEVICE int64_t item_row(Item item, const VoxelKeyBits& bits) {
  return low_bits(uint64_t(item), bits.row);
}

// (b, z, y, x)
template <typename Item>
PRED_HOST_DEVICE void write_coords(Item item, const VoxelKeyBits& bits, int64_t* coords) {
  const uint64_t key = uint64_t(item >> bits.row);
  coords[0] = int64_t(key >> (bits.x + bits.y + bits.z));
  coords[1] = low_bits(key >> (bits.x + bits.y), bits.z);
  coords[2] = low_bits(key >> bits.x, bits.y);
  coords[3] = low_bits(key, bits.x);
}

// S: the type in which points are stored.
template <typename S>
struct VoxelizePoints {
  const S* points;  // [N, C], element strides below
  int64_t point_stride, axis_stride;
  VoxelGrid<Compute<S>> grid;
  VoxelKeyBits bits;
};

PRED_HOST_DEVICE uint64_t voxel_key(const VoxelKeyBits& bits, int64_t frame, int32_t x, int32_t y, int32_t z) {
  return ((((uint64_t(frame) << bits.z) | uint64_t(z)) << bits.y | uint64_t(y)) << bits.x) | uint64_t(x);
}

#ifdef PRED_LAUNCH
// Points by voxel, then by row. Keys, of at most 62 bits, stand apart from rows here; those of points outside have a
// bit above these, key_bits, and so come last. `rows` are all the rows, whatever the points are.
struct SortedPoints {
  const uint64_t* keys;
  const int32_t* rows;
  int64_t count;
  int key_bits;
};

PRED_HOST_DEVICE bool is_inside(const SortedPoints& points, int64_t i) {
  return points.keys[i] >> points.key_bits == 0;
}

PRED_HOST_DEVICE bool starts_voxel(const SortedPoints& points, int64_t i) {
  return is_inside(points, i) && starts_voxel(points.keys, 0, i);
}

// The first place behind i that is not of its voxel, or `limit`.
PRED_HOST_DEVICE int64_t voxel_end(const SortedPoints& points, int64_t i, int64_t limit) {
  int64_t end = i + 1;
  while (end < limit) {
    const int64_t middle = (end + limit) / 2;
    if (points.keys[middle] == points.keys[i])
      end = middle + 1;
    else
      limit = middle;
  }
  return end;
}

template <typename S>
struct VoxelizeKernels {
  int64_t (*sort_bytes)(int64_t num_points, int key_bits);
  // The result lies in the workspace.
  SortedPoints (*sort)(const VoxelizePoints<S>&, const int64_t* offsets, int64_t num_frames, int64_t num_points,
                       int key_bits, char* workspace);
  int64_t (*number_bytes)(int64_t num_points);
  // Numbers the voxels and returns how many there are; point_to_voxel gets the numbers.
  int64_t (*number)(const SortedPoints&, int64_t* point_to_voxel, char* workspace);
  // Writes them, from the same workspace.
  void (*write)(const SortedPoints&, const VoxelKeyBits&, int64_t* coords, int64_t* counts, char* workspace);
};
#else
template <typename S, typename Item>
struct VoxelizeKernels {
  // Packs the points [begin, end) of one frame that lie inside, from `items` on; returns how many. The others
  // get voxel -1.
  int64_t (*pack)(const VoxelizePoints<S>&, int64_t frame, int64_t begin, int64_t end, Item* items,
                  int64_t* point_to_voxel);
  // How many voxels have their first item in [begin, end).
  int64_t (*count)(const Item* items, int row_bits, int64_t begin, int64_t end);
  // Writes those voxels, of which the first has the number `first_voxel`, and the voxel of each item in [begin, end).
  void (*write)(const Item* items, int64_t num_items, const VoxelKeyBits&, int64_t first_voxel, int64_t begin,
                int64_t end, int64_t* coords, int64_t* counts, int64_t* point_to_voxel);
};
#endif

// Keys and row numbers that need more than 64 bits together are rare, but must work.
#ifndef PRED_LAUNCH
using WideItem = unsigned __int128;
using VoxelizeF32 = VoxelizeKernels<float, uint64_t>;
using VoxelizeF64 = VoxelizeKernels<double, uint64_t>;
using VoxelizeBF16 = VoxelizeKernels<BFloat16, uint64_t>;
using VoxelizeF16 = VoxelizeKernels<Float16, uint64_t>;
using VoxelizeWideF32 = VoxelizeKernels<float, WideItem>;
using VoxelizeWideF64 = VoxelizeKernels<double, WideItem>;
using VoxelizeWideBF16 = VoxelizeKernels<BFloat16, WideItem>;
using VoxelizeWideF16 = VoxelizeKernels<Float16, WideItem>;
#endif

}  // namespace pred

#ifdef PRED_LAUNCH
PRED_DECLARE_KERNELS(VoxelizeKernels<float>, voxelize_f32)
PRED_DECLARE_KERNELS(VoxelizeKernels<double>, voxelize_f64)
PRED_DECLARE_KERNELS(VoxelizeKernels<BFloat16>, voxelize_bf16)
PRED_DECLARE_KERNELS(VoxelizeKernels<Float16>, voxelize_f16)
#else
PRED_DECLARE_KERNELS(VoxelizeF32, voxelize_f32)
PRED_DECLARE_KERNELS(VoxelizeF64, voxelize_f64)
PRED_DECLARE_KERNELS(VoxelizeBF16, voxelize_bf16)
PRED_DECLARE_KERNELS(VoxelizeF16, voxelize_f16)
PRED_DECLARE_KERNELS(VoxelizeWideF32, voxelize_wide_f32)
PRED_DECLARE_KERNELS(VoxelizeWideF64, voxelize_wide_f64)
PRED_DECLARE_KERNELS(VoxelizeWideBF16, voxelize_wide_bf16)
PRED_DECLARE_KERNELS(VoxelizeWideF16, voxelize_wide_f16)
#endif
