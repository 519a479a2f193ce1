// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one point (pack) or one item of the sorted list (count, write). A voxel is written by the
// range that holds its first item.
#include "ops/voxelize.h"

namespace pred::PRED_ISA {
namespace {

template <typename S, typename Item>
static int64_t pack(const VoxelizePoints<S>& a, int64_t frame, int64_t begin, int64_t end, Item* items,
                    int64_t* point_to_voxel) {
  using T = Compute<S>;
  constexpr int64_t kChunk = 256;
  T value[3][kChunk];
  int32_t index[3][kChunk];
  const VoxelKeyBits& bits = a.bits;
  int64_t count = 0;
  for (int64_t start = begin; start < end; start += kChunk) {
    const int64_t size = end - start < kChunk ? end - start : kChunk;
    // Separate loops: the divisions below vectorise, the strided reads do not.
    for (int64_t i = 0; i < size; ++i) {
      const S* point = a.points + (start + i) * a.point_stride;
      value[0][i] = widen(point[0]);
      value[1][i] = widen(point[a.axis_stride]);
      value[2][i] = widen(point[2 * a.axis_stride]);
    }
    for (int axis = 0; axis < 3; ++axis) {
      const T low = a.grid.low[axis], high = a.grid.high[axis], edge = a.grid.size[axis];
      const int32_t cells = a.grid.cells[axis];
      for (int64_t i = 0; i < size; ++i) index[axis][i] = voxel_index(value[axis][i], low, high, edge, cells);
    }
    for (int64_t i = 0; i < size; ++i) {
      const int32_t x = index[0][i], y = index[1][i], z = index[2][i];
      if ((x | y | z) < 0) {
        point_to_voxel[start + i] = -1;
        continue;
      }
      items[count++] = (Item(voxel_key(bits, frame, x, y, z)) << bits.row) | Item(start + i);
    }
  }
  return count;
}

template <typename Item>
static int64_t count(const Item* items, int row_bits, int64_t begin, int64_t end) {
  int64_t voxels = 0;
  for (int64_t i = begin; i < end; ++i) voxels += starts_voxel(items, row_bits, i);
  return voxels;
}

template <typename Item>
static void write(const Item* items, int64_t num_items, const VoxelKeyBits& bits, int64_t first_voxel, int64_t begin,
                  int64_t end, int64_t* coords, int64_t* counts, int64_t* point_to_voxel) {
  int64_t voxel = first_voxel - 1, voxel_begin = -1;
  for (int64_t i = begin; i < end; ++i) {
    if (starts_voxel(items, bits.row, i)) {
      if (voxel_begin >= 0) counts[voxel] = i - voxel_begin;
      ++voxel;
      voxel_begin = i;
      write_coords(items[i], bits, coords + 4 * voxel);
    }
    point_to_voxel[item_row(items[i], bits)] = voxel;
  }
  if (voxel_begin < 0) return;
  int64_t voxel_end = end;
  while (voxel_end < num_items && !starts_voxel(items, bits.row, voxel_end)) ++voxel_end;
  counts[voxel] = voxel_end - voxel_begin;
}

}  // namespace

const VoxelizeF32 voxelize_f32 = {pack<float, uint64_t>, count<uint64_t>, write<uint64_t>};
const VoxelizeF64 voxelize_f64 = {pack<double, uint64_t>, count<uint64_t>, write<uint64_t>};
const VoxelizeBF16 voxelize_bf16 = {pack<BFloat16, uint64_t>, count<uint64_t>, write<uint64_t>};
const VoxelizeF16 voxelize_f16 = {pack<Float16, uint64_t>, count<uint64_t>, write<uint64_t>};
const VoxelizeWideF32 voxelize_wide_f32 = {pack<float, WideItem>, count<WideItem>, write<WideItem>};
const VoxelizeWideF64 voxelize_wide_f64 = {pack<double, WideItem>, count<WideItem>, write<WideItem>};
const VoxelizeWideBF16 voxelize_wide_bf16 = {pack<BFloat16, WideItem>, count<WideItem>, write<WideItem>};
const VoxelizeWideF16 voxelize_wide_f16 = {pack<Float16, WideItem>, count<WideItem>, write<WideItem>};

}  // namespace pred::PRED_ISA
