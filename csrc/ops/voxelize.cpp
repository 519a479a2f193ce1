// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/voxelize.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"
#include "common/radix_sort.h"

namespace pred {
namespace {

template <typename T, typename Item>
const VoxelizeKernels<T, Item>& kernels() {
  constexpr bool wide = !std::is_same_v<Item, uint64_t>;
  if constexpr (std::is_same_v<T, float> && !wide)
    return PRED_KERNELS(voxelize_f32);
  else if constexpr (std::is_same_v<T, float>)
    return PRED_KERNELS(voxelize_wide_f32);
  else if constexpr (!wide)
    return PRED_KERNELS(voxelize_f64);
  else
    return PRED_KERNELS(voxelize_wide_f64);
}

// The three outputs, for items of one width.
template <typename T, typename Item>
std::tuple<Tensor, Tensor, Tensor> voxelize_items(const VoxelizePoints<T>& a, const Tensor& offsets, int key_bits,
                                                  int64_t num_points) {
  const VoxelizeKernels<T, Item>& k = kernels<T, Item>();
  Tensor point_to_voxel = torch::stable::new_empty(offsets, {num_points});
  int64_t* voxel_of = point_to_voxel.mutable_data_ptr<int64_t>();
  const int64_t* offset = offsets.const_data_ptr<int64_t>();
  const int64_t num_frames = offsets.size(0) - 1;
  const auto sorted = sort_rows<Item>(num_points, a.bits.row, key_bits, [&](Item* items, int64_t begin, int64_t end) {
    int64_t packed = 0;
    int64_t frame = std::upper_bound(offset, offset + num_frames + 1, begin) - offset - 1;
    for (; begin < end; ++frame) {
      const int64_t stop = std::min(end, offset[frame + 1]);
      packed += k.pack(a, frame, begin, stop, items + packed, voxel_of);
      begin = stop;
    }
    return packed;
  });
  const Item* items = sorted.items.get();
  std::vector<int64_t> first_voxel(sorted.num_blocks + 1);
  parallel(sorted.num_blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      first_voxel[block + 1] = k.count(items, a.bits.row, sorted.block_begin(block), sorted.block_begin(block + 1));
    }
  });
  for (int64_t block = 0; block < sorted.num_blocks; ++block) first_voxel[block + 1] += first_voxel[block];
  const int64_t num_voxels = first_voxel[sorted.num_blocks];
  Tensor coords = torch::stable::new_empty(offsets, {num_voxels, 4});
  Tensor counts = torch::stable::new_empty(offsets, {num_voxels});
  int64_t* coords_data = coords.mutable_data_ptr<int64_t>();
  int64_t* counts_data = counts.mutable_data_ptr<int64_t>();
  parallel(sorted.num_blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      k.write(items, sorted.count, a.bits, first_voxel[block], sorted.block_begin(block), sorted.block_begin(block + 1),
              coords_data, counts_data, voxel_of);
    }
  });
  return {coords, point_to_voxel, counts};
}

std::tuple<Tensor, Tensor, Tensor> voxelize(const Tensor& points, const Tensor& batch_offsets,
                                            std::vector<double> voxel_size, std::vector<double> point_range,
                                            std::vector<int64_t> grid_size) {
  const char* op = "voxelize";
  check_cpu_tensor(op, "points", points, 2, points.scalar_type());
  check_cpu_tensor(op, "batch_offsets", batch_offsets, 1, ScalarType::Long);
  PRED_CHECK(points.size(1) >= 3, op, ": points must have shape [N, D] with D >= 3, got ", shape_text(points));
  PRED_CHECK(voxel_size.size() == 3 && point_range.size() == 6 && grid_size.size() == 3, op,
             ": voxel_size, point_range and grid_size must hold 3, 6 and 3 numbers, got ", voxel_size.size(), ", ",
             point_range.size(), " and ", grid_size.size());
  for (const int64_t cells : grid_size) {
    PRED_CHECK(cells >= 1 && cells <= int64_t(1) << 30, op, ": grid_size must lie in [1, 2^30], got ", cells);
  }
  const Tensor offsets = torch::stable::contiguous(batch_offsets);
  const int64_t num_points = points.size(0), num_frames = offsets.size(0) - 1;
  const int64_t* offset = offsets.const_data_ptr<int64_t>();
  PRED_CHECK(num_frames >= 0 && offset[0] == 0 && std::is_sorted(offset, offset + num_frames + 1) &&
                 offset[num_frames] == num_points,
             op, ": batch_offsets must ascend from 0 to N=", num_points);
  const int x_bits = bits_for(grid_size[0]), y_bits = bits_for(grid_size[1]), z_bits = bits_for(grid_size[2]);
  const int row_bits = bits_for(num_points), key_bits = bits_for(num_frames) + x_bits + y_bits + z_bits;
  PRED_CHECK(key_bits <= 62, op, ": the frames' grids must have at most 2^62 voxels");
  return PRED_DISPATCH_FLOAT(op, points.scalar_type(), [&] {
    VoxelizePoints<T> a{
        points.const_data_ptr<T>(), points.stride(0), points.stride(1), {}, {x_bits, y_bits, z_bits, row_bits}};
    for (int axis = 0; axis < 3; ++axis) {
      a.grid.low[axis] = T(point_range[axis]);
      a.grid.high[axis] = T(point_range[axis + 3]);
      a.grid.size[axis] = T(voxel_size[axis]);
      a.grid.cells[axis] = int32_t(grid_size[axis]);
    }
    return key_bits + row_bits <= 64 ? voxelize_items<T, uint64_t>(a, offsets, key_bits, num_points)
                                     : voxelize_items<T, WideItem>(a, offsets, key_bits, num_points);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) { m.impl("voxelize", TORCH_BOX(&pred::voxelize)); }
