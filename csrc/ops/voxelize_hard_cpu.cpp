// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one item (list_runs), one row (count_runs, gather_runs, backward) or one voxel (write), whose
// points it copies in one sweep over the output. Values are only moved, so half types are plain 16 bits here.
#include "ops/voxelize_hard.h"

namespace pred::PRED_ISA {
namespace {

template <typename Item>
static void list_runs(const Item* items, int row_bits, int32_t* run_of_row, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    if (starts_voxel(items, row_bits, i)) run_of_row[low_bits(uint64_t(items[i]), row_bits)] = int32_t(i);
  }
}

static int64_t count_runs(const int32_t* run_of_row, int64_t begin, int64_t end) {
  int64_t count = 0;
  for (int64_t row = begin; row < end; ++row) count += run_of_row[row] >= 0;
  return count;
}

static void gather_runs(const int32_t* run_of_row, int64_t begin, int64_t end, int64_t limit, int32_t* run_of_voxel) {
  for (int64_t row = begin, count = 0; row < end && count < limit; ++row) {
    run_of_voxel[count] = run_of_row[row];  // overwritten by the next row unless this one has a run
    count += run_of_row[row] >= 0;
  }
}

template <typename S>
static inline void copy_row(const S* __restrict from, S* __restrict to, int64_t columns) {
  for (int64_t c = 0; c < columns; ++c) to[c] = from[c];
}

// kColumns: D where it is known at compile time, else 0.
template <int kColumns, typename S, typename Item>
static void write_voxels(const VoxelizeHardArgs<S, Item>& a, const int32_t* run_of_voxel, S* voxels, int64_t* coords,
                         int64_t* counts, int64_t* point_to_slot, int64_t begin, int64_t end) {
  constexpr int64_t kAhead = 16;  // runs are visited in no order of memory
  const VoxelKeyBits bits = a.bits;
  const int64_t columns = kColumns ? kColumns : a.columns;
  for (int64_t voxel = begin; voxel < end; ++voxel) {
    if (voxel + kAhead < end) __builtin_prefetch(a.items + run_of_voxel[voxel + kAhead]);
    const int64_t run = run_of_voxel[voxel];
    write_coords(a.items[run], bits, coords + 4 * voxel);
    S* out = voxels + voxel * a.max_points * columns;
    int64_t count = 0;
    do {
      const int64_t row = item_row(a.items[run + count], bits);
      copy_row(a.points + row * columns, out + count * columns, columns);
      point_to_slot[row] = voxel * a.max_points + count;
      ++count;
    } while (count < a.max_points && run + count < a.num_items && !starts_voxel(a.items, bits.row, run + count));
    counts[voxel] = count;
    __builtin_memset(out + count * columns, 0, uint64_t((a.max_points - count) * columns) * sizeof(S));
  }
}

template <typename S, typename Item>
static void write(const VoxelizeHardArgs<S, Item>& a, const int32_t* run_of_voxel, S* voxels, int64_t* coords,
                  int64_t* counts, int64_t* point_to_slot, int64_t begin, int64_t end) {
  const auto call = a.columns == 3   ? write_voxels<3, S, Item>
                    : a.columns == 4 ? write_voxels<4, S, Item>
                    : a.columns == 5 ? write_voxels<5, S, Item>
                                     : write_voxels<0, S, Item>;
  call(a, run_of_voxel, voxels, coords, counts, point_to_slot, begin, end);
}

template <typename S>
static void backward(const S* grad, int64_t columns, const int64_t* point_to_slot, S* out, int64_t begin, int64_t end) {
  for (int64_t row = begin; row < end; ++row) {
    const int64_t slot = point_to_slot[row];
    if (slot >= 0) {
      copy_row(grad + slot * columns, out + row * columns, columns);
    } else {
      for (int64_t c = 0; c < columns; ++c) out[row * columns + c] = S(0);
    }
  }
}

template <typename S, typename Item>
constexpr VoxelizeHardKernels<S, Item> table() {
  return {list_runs<Item>, count_runs, gather_runs, write<S, Item>, backward<S>};
}

}  // namespace

const VoxelizeHardF32 voxelize_hard_f32 = table<float, uint64_t>();
const VoxelizeHardF64 voxelize_hard_f64 = table<double, uint64_t>();
const VoxelizeHardBits16 voxelize_hard_bits16 = table<uint16_t, uint64_t>();
const VoxelizeHardWideF32 voxelize_hard_wide_f32 = table<float, WideItem>();
const VoxelizeHardWideF64 voxelize_hard_wide_f64 = table<double, WideItem>();
const VoxelizeHardWideBits16 voxelize_hard_wide_bits16 = table<uint16_t, WideItem>();

}  // namespace pred::PRED_ISA
