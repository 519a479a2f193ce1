// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// voxelize_hard: voxels of at most P points, at most so many per frame, in the order in which their first points
// appear.
//
// The points are sorted by voxel as in voxelize (ops/voxelize.h); within a voxel they stay in the order of their rows.
// The first item of each voxel's run therefore is its first point: the runs are listed at the rows of their first
// points, and reading that list in the order of rows gives the voxels in order of first appearance.
//
//   forward    voxels[m, p] = points[p-th row of voxel m], 0 beyond counts[m];   slot(row) = m P + p, -1 if dropped
//   backward   grad_points[row] = grad_voxels[slot(row)], 0 if dropped
#pragma once

#include "ops/voxelize.h"

namespace pred {

#ifdef PRED_LAUNCH
template <typename S>
struct VoxelizeHardArgs {
  SortedPoints sorted;
  VoxelKeyBits bits;
  const S* points;              // [N, C], contiguous
  int64_t columns, max_points;  // C, max_points
};

template <typename S>
struct VoxelizeHardKernels {
  int64_t (*workspace_bytes)(int64_t num_points);
  // Numbers the voxels, at most max_voxels per frame, and returns how many there are. All points get slot -1.
  int64_t (*number)(const SortedPoints&, const VoxelKeyBits&, const int64_t* offsets, int64_t max_voxels,
                    int64_t* point_to_slot, char* workspace);
  // Everything of them, from the same workspace, and the slots of the points kept in them.
  void (*write)(const VoxelizeHardArgs<S>&, int64_t num_voxels, S* voxels, int64_t* coords, int64_t* counts,
                int64_t* point_to_slot, char* workspace);
  // A slot outside of [0, num_slots) counts as -1.
  void (*backward)(const S* grad, int64_t num_slots, int64_t columns, const int64_t* point_to_slot, S* out,
                   int64_t num_points);
};
#else
template <typename S, typename Item>
struct VoxelizeHardArgs {
  const Item* items;  // sorted
  int64_t num_items;
  VoxelKeyBits bits;
  const S* points;              // [N, C], contiguous
  int64_t columns, max_points;  // C, max_points
};

template <typename S, typename Item>
struct VoxelizeHardKernels {
  // run_of_row[row] = i for the items i in [begin, end) that are the first of their voxel, row being theirs.
  void (*list_runs)(const Item* items, int row_bits, int32_t* run_of_row, int64_t begin, int64_t end);
  // How many of the rows [begin, end) have a run (are not -1).
  int64_t (*count_runs)(const int32_t* run_of_row, int64_t begin, int64_t end);
  // The runs of those rows, in order, but no more than `limit`.
  void (*gather_runs)(const int32_t* run_of_row, int64_t begin, int64_t end, int64_t limit, int32_t* run_of_voxel);
  // Everything of the voxels [begin, end), and the slots of the points kept in them.
  void (*write)(const VoxelizeHardArgs<S, Item>&, const int32_t* run_of_voxel, S* voxels, int64_t* coords,
                int64_t* counts, int64_t* point_to_slot, int64_t begin, int64_t end);
  // Rows [begin, end).
  void (*backward)(const S* grad, int64_t columns, const int64_t* point_to_slot, S* out, int64_t begin, int64_t end);
};

using VoxelizeHardF32 = VoxelizeHardKernels<float, uint64_t>;
using VoxelizeHardF64 = VoxelizeHardKernels<double, uint64_t>;
using VoxelizeHardBits16 = VoxelizeHardKernels<uint16_t, uint64_t>;
using VoxelizeHardWideF32 = VoxelizeHardKernels<float, WideItem>;
using VoxelizeHardWideF64 = VoxelizeHardKernels<double, WideItem>;
using VoxelizeHardWideBits16 = VoxelizeHardKernels<uint16_t, WideItem>;
#endif

}  // namespace pred

#ifdef PRED_LAUNCH
PRED_DECLARE_KERNELS(VoxelizeHardKernels<float>, voxelize_hard_f32)
PRED_DECLARE_KERNELS(VoxelizeHardKernels<double>, voxelize_hard_f64)
PRED_DECLARE_KERNELS(VoxelizeHardKernels<BFloat16>, voxelize_hard_bf16)
PRED_DECLARE_KERNELS(VoxelizeHardKernels<Float16>, voxelize_hard_f16)
#else
PRED_DECLARE_KERNELS(VoxelizeHardF32, voxelize_hard_f32)
PRED_DECLARE_KERNELS(VoxelizeHardF64, voxelize_hard_f64)
PRED_DECLARE_KERNELS(VoxelizeHardBits16, voxelize_hard_bits16)
PRED_DECLARE_KERNELS(VoxelizeHardWideF32, voxelize_hard_wide_f32)
PRED_DECLARE_KERNELS(VoxelizeHardWideF64, voxelize_hard_wide_f64)
PRED_DECLARE_KERNELS(VoxelizeHardWideBits16, voxelize_hard_wide_bits16)
#endif
