// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The checked arguments of voxelize and voxelize_hard.
#pragma once

#include <vector>

#include "common/bits.h"
#include "common/check.h"
#include "common/clouds.h"
#include "ops/voxelize.h"

namespace pred {

struct VoxelizeInputs {
  Tensor points;   // [N, C]
  Tensor offsets;  // [B + 1], contiguous
  std::vector<double> voxel_size, point_range;
  std::vector<int64_t> grid_size;
  VoxelKeyBits bits;
  int key_bits;

  VoxelizeInputs(const char* op, const Tensor& points, const Tensor& batch_offsets, std::vector<double> voxel_size,
                 std::vector<double> point_range, std::vector<int64_t> grid_size)
      : points(points), voxel_size(voxel_size), point_range(point_range), grid_size(grid_size) {
    check_tensor(op, "points", points, 2, points.scalar_type());
    PRED_CHECK(points.size(1) >= 3, op, ": points must have shape [N, C] with C >= 3, got ", shape_text(points));
    PRED_CHECK(voxel_size.size() == 3 && point_range.size() == 6 && grid_size.size() == 3, op,
               ": voxel_size, point_range and grid_size must hold 3, 6 and 3 numbers, got ", voxel_size.size(), ", ",
               point_range.size(), " and ", grid_size.size());
    for (const double size : voxel_size) {
      PRED_CHECK(size > 0, op, ": voxel_size must be positive, got ", size);
    }
    for (const int64_t cells : grid_size) {
      PRED_CHECK(cells >= 1 && cells <= int64_t(1) << 30, op, ": grid_size must lie in [1, 2^30], got ", cells);
    }
    offsets = frame_offsets(op, "batch_offsets", batch_offsets, 'N', num_points());
    bits = {bits_for(grid_size[0]), bits_for(grid_size[1]), bits_for(grid_size[2]), bits_for(num_points())};
    key_bits = bits_for(num_frames()) + bits.x + bits.y + bits.z;
    PRED_CHECK(key_bits <= 62, op, ": grid_size must give at most 2^62 voxels in all frames, got 2^", key_bits);
  }

  int64_t num_points() const { return points.size(0); }
  int64_t num_frames() const { return offsets.size(0) - 1; }

  template <typename S>
  VoxelizePoints<S> arguments() const {
    using T = Compute<S>;
    VoxelizePoints<S> a{storage<S>(points), points.stride(0), points.stride(1), {}, bits};
    for (int axis = 0; axis < 3; ++axis) {
      a.grid.low[axis] = T(point_range[axis]);
      a.grid.high[axis] = T(point_range[axis + 3]);
      a.grid.size[axis] = T(voxel_size[axis]);
      a.grid.cells[axis] = int32_t(grid_size[axis]);
    }
    return a;
  }
};

}  // namespace pred
