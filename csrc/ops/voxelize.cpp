// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/voxelize.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <tuple>
#include <vector>

#include "ops/voxelize_sort.h"

namespace pred {
namespace {

#ifdef PRED_LAUNCH
template <typename S>
std::tuple<Tensor, Tensor, Tensor> voxels(const VoxelizeInputs& in, const Tensor& point_to_voxel) {
  const VoxelizeKernels<S>& k = voxelize_kernels<S>();
  const SortedTensor sorted = sort_by_voxel<S>(in);
  const Tensor workspace =
      torch::stable::new_empty(point_to_voxel, {k.number_bytes(in.num_points())}, ScalarType::Byte);
  char* space = mutable_storage<char>(workspace);
  const int64_t num_voxels = k.number(sorted.points, point_to_voxel.mutable_data_ptr<int64_t>(), space);
  Tensor coords = torch::stable::new_empty(point_to_voxel, {num_voxels, 4});
  Tensor counts = torch::stable::new_empty(point_to_voxel, {num_voxels});
  k.write(sorted.points, in.bits, coords.mutable_data_ptr<int64_t>(), counts.mutable_data_ptr<int64_t>(), space);
  return {coords, point_to_voxel, counts};
}
#else
// The three outputs, for items of one width.
template <typename S, typename Item>
std::tuple<Tensor, Tensor, Tensor> number_voxels(const VoxelizePoints<S>& a, const SortedItems<Item>& sorted,
                                                 const Tensor& point_to_voxel) {
  const VoxelizeKernels<S, Item>& k = voxelize_kernels<S, Item>();
  const Item* items = sorted.items.get();
  std::vector<int64_t> first_voxel(sorted.num_blocks + 1);
  parallel(sorted.num_blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      first_voxel[block + 1] = k.count(items, a.bits.row, sorted.block_begin(block), sorted.block_begin(block + 1));
    }
  });
  for (int64_t block = 0; block < sorted.num_blocks; ++block) first_voxel[block + 1] += first_voxel[block];
  const int64_t num_voxels = first_voxel[sorted.num_blocks];
  Tensor coords = torch::stable::new_empty(point_to_voxel, {num_voxels, 4});
  Tensor counts = torch::stable::new_empty(point_to_voxel, {num_voxels});
  int64_t* coords_data = coords.mutable_data_ptr<int64_t>();
  int64_t* counts_data = counts.mutable_data_ptr<int64_t>();
  int64_t* voxel_of = point_to_voxel.mutable_data_ptr<int64_t>();
  parallel(sorted.num_blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      k.write(items, sorted.count, a.bits, first_voxel[block], sorted.block_begin(block), sorted.block_begin(block + 1),
              coords_data, counts_data, voxel_of);
    }
  });
  return {coords, point_to_voxel, counts};
}

template <typename S>
std::tuple<Tensor, Tensor, Tensor> voxels(const VoxelizeInputs& in, const Tensor& point_to_voxel) {
  return with_sorted_points<S>(in, point_to_voxel.mutable_data_ptr<int64_t>(), [&](const auto& a, const auto& sorted) {
    return number_voxels(a, sorted, point_to_voxel);
  });
}
#endif

std::tuple<Tensor, Tensor, Tensor> voxelize(const Tensor& points, const Tensor& batch_offsets,
                                            std::vector<double> voxel_size, std::vector<double> point_range,
                                            std::vector<int64_t> grid_size) {
  const char* op = "voxelize";
  const VoxelizeInputs in(op, points, batch_offsets, voxel_size, point_range, grid_size);
  return PRED_DISPATCH_STORAGE(op, points.scalar_type(), [&] {
    Tensor point_to_voxel = torch::stable::new_empty(in.offsets, {in.num_points()});
    return voxels<S>(in, point_to_voxel);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "voxelize", &pred::voxelize); }
