// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Points sorted by voxel and then by row, for voxelize and voxelize_hard.
#pragma once

#include <torch/csrc/stable/ops.h>

#include "common/parallel.h"
#include "common/radix_sort.h"
#include "ops/voxelize_inputs.h"

namespace pred {

#ifdef PRED_LAUNCH
PRED_KERNELS_BY_STORAGE(VoxelizeKernels, voxelize)

// With the memory in which they lie.
struct SortedTensor {
  Tensor workspace;
  SortedPoints points;
};

template <typename S>
SortedTensor sort_by_voxel(const VoxelizeInputs& in) {
  const VoxelizeKernels<S>& k = voxelize_kernels<S>();
  const int64_t num_points = in.num_points();
  const Tensor workspace =
      torch::stable::new_empty(in.offsets, {k.sort_bytes(num_points, in.key_bits)}, ScalarType::Byte);
  return {workspace, k.sort(in.arguments<S>(), in.offsets.const_data_ptr<int64_t>(), in.num_frames(), num_points,
                            in.key_bits, mutable_storage<char>(workspace))};
}
#else
template <typename S, typename Item>
const VoxelizeKernels<S, Item>& voxelize_kernels() {
  constexpr bool wide = !std::is_same_v<Item, uint64_t>;
  if constexpr (std::is_same_v<S, float>)
    if constexpr (wide)
      return PRED_KERNELS(voxelize_wide_f32);
    else
      return PRED_KERNELS(voxelize_f32);
  else if constexpr (std::is_same_v<S, double>)
    if constexpr (wide)
      return PRED_KERNELS(voxelize_wide_f64);
    else
      return PRED_KERNELS(voxelize_f64);
  else if constexpr (std::is_same_v<S, BFloat16>)
    if constexpr (wide)
      return PRED_KERNELS(voxelize_wide_bf16);
    else
      return PRED_KERNELS(voxelize_bf16);
  else if constexpr (wide)
    return PRED_KERNELS(voxelize_wide_f16);
  else
    return PRED_KERNELS(voxelize_f16);
}

template <typename S, typename Item>
SortedItems<Item> sort_by_voxel(const VoxelizeInputs& in, const VoxelizePoints<S>& a, int64_t* point_to_voxel) {
  const auto& k = voxelize_kernels<S, Item>();
  const int64_t* offset = in.offsets.const_data_ptr<int64_t>();
  return sort_rows<Item>(in.num_points(), a.bits.row, in.key_bits, [&](Item* items, int64_t begin, int64_t end) {
    int64_t packed = 0;
    for_each_frame(offset, in.num_frames(), begin, end, [&](int64_t frame, int64_t first, int64_t last) {
      packed += k.pack(a, frame, first, last, items + packed, point_to_voxel);
    });
    return packed;
  });
}

// Calls body(arguments, items) with the points inside, sorted by voxel and then by row. point_to_voxel gets -1 for the
// points outside.
template <typename S, class Body>
auto with_sorted_points(const VoxelizeInputs& in, int64_t* point_to_voxel, const Body& body) {
  const VoxelizePoints<S> a = in.arguments<S>();
  if (in.key_bits + in.bits.row <= 64) return body(a, sort_by_voxel<S, uint64_t>(in, a, point_to_voxel));
  return body(a, sort_by_voxel<S, WideItem>(in, a, point_to_voxel));
}
#endif

}  // namespace pred
