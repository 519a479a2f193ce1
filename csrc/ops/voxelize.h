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

template <typename T>
struct VoxelizePoints {
  const T* points;  // [N, D], element strides below
  int64_t point_stride, axis_stride;
  VoxelGrid<T> grid;
  VoxelKeyBits bits;
};

template <typename T, typename Item>
struct VoxelizeKernels {
  // Packs the points [begin, end) of one frame that lie inside, from `items` on; returns how many. The others
  // get voxel -1.
  int64_t (*pack)(const VoxelizePoints<T>&, int64_t frame, int64_t begin, int64_t end, Item* items,
                  int64_t* point_to_voxel);
  // How many voxels have their first item in [begin, end).
  int64_t (*count)(const Item* items, int row_bits, int64_t begin, int64_t end);
  // Writes those voxels, of which the first has the number `first_voxel`, and the voxel of each item in [begin, end).
  void (*write)(const Item* items, int64_t num_items, const VoxelKeyBits&, int64_t first_voxel, int64_t begin,
                int64_t end, int64_t* coords, int64_t* counts, int64_t* point_to_voxel);
};

// Keys and row numbers that need more than 64 bits together are rare, but must work.
using WideItem = unsigned __int128;
using VoxelizeF32 = VoxelizeKernels<float, uint64_t>;
using VoxelizeF64 = VoxelizeKernels<double, uint64_t>;
using VoxelizeWideF32 = VoxelizeKernels<float, WideItem>;
using VoxelizeWideF64 = VoxelizeKernels<double, WideItem>;

}  // namespace pred

PRED_DECLARE_KERNELS(VoxelizeF32, voxelize_f32)
PRED_DECLARE_KERNELS(VoxelizeF64, voxelize_f64)
PRED_DECLARE_KERNELS(VoxelizeWideF32, voxelize_wide_f32)
PRED_DECLARE_KERNELS(VoxelizeWideF64, voxelize_wide_f64)
