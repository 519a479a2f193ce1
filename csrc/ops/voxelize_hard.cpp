// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/voxelize_hard.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <memory>
#include <tuple>
#include <vector>

#include "common/allocate.h"
#include "ops/voxelize_sort.h"

namespace pred {
namespace {

using Outputs = std::tuple<Tensor, Tensor, Tensor, Tensor>;

#ifdef PRED_LAUNCH
PRED_KERNELS_BY_STORAGE(VoxelizeHardKernels, voxelize_hard)

template <typename S>
Outputs hard_voxels(const VoxelizeInputs& in, const Tensor& points, const Tensor& point_to_slot, int64_t max_points,
                    int64_t max_voxels) {
  const VoxelizeHardKernels<S>& k = voxelize_hard_kernels<S>();
  const SortedTensor sorted = sort_by_voxel<S>(in);
  const Tensor workspace =
      torch::stable::new_empty(point_to_slot, {k.workspace_bytes(in.num_points())}, ScalarType::Byte);
  char* space = mutable_storage<char>(workspace);
  int64_t* slot_of = point_to_slot.mutable_data_ptr<int64_t>();
  const int64_t num_voxels =
      k.number(sorted.points, in.bits, in.offsets.const_data_ptr<int64_t>(), max_voxels, slot_of, space);
  Tensor voxels = torch::stable::new_empty(points, {num_voxels, max_points, points.size(1)});
  Tensor coords = torch::stable::new_empty(point_to_slot, {num_voxels, 4});
  Tensor counts = torch::stable::new_empty(point_to_slot, {num_voxels});
  k.write({sorted.points, in.bits, storage<S>(points), points.size(1), max_points}, num_voxels,
          mutable_storage<S>(voxels), coords.mutable_data_ptr<int64_t>(), counts.mutable_data_ptr<int64_t>(), slot_of,
          space);
  return {voxels, coords, counts, point_to_slot};
}

template <typename S>
void backward(const Tensor& grad, int64_t num_slots, const int64_t* slot_of, const Tensor& out) {
  voxelize_hard_kernels<S>().backward(storage<S>(grad), num_slots, grad.size(2), slot_of, mutable_storage<S>(out),
                                      out.size(0));
}
#else
// How values of a storage type are moved.
template <typename S>
using Moved = std::conditional_t<sizeof(S) == 2, uint16_t, S>;

template <typename M, typename Item>
const VoxelizeHardKernels<M, Item>& voxelize_hard_kernels() {
  constexpr bool wide = !std::is_same_v<Item, uint64_t>;
  if constexpr (std::is_same_v<M, float>)
    if constexpr (wide)
      return PRED_KERNELS(voxelize_hard_wide_f32);
    else
      return PRED_KERNELS(voxelize_hard_f32);
  else if constexpr (std::is_same_v<M, double>)
    if constexpr (wide)
      return PRED_KERNELS(voxelize_hard_wide_f64);
    else
      return PRED_KERNELS(voxelize_hard_f64);
  else if constexpr (wide)
    return PRED_KERNELS(voxelize_hard_wide_bits16);
  else
    return PRED_KERNELS(voxelize_hard_bits16);
}

// Rows of one frame, and the voxels that have their first points there and are kept.
struct Piece {
  int64_t frame, begin, end;
  int64_t first_voxel, num_voxels;
};

std::vector<Piece> pieces_of_rows(const int64_t* offset, int64_t num_frames, int64_t num_rows) {
  constexpr int64_t kRows = 32768;
  std::vector<Piece> pieces;
  for (int64_t begin = 0; begin < num_rows; begin += kRows) {
    for_each_frame(offset, num_frames, begin, std::min(begin + kRows, num_rows),
                   [&](int64_t frame, int64_t first, int64_t last) { pieces.push_back({frame, first, last, 0, 0}); });
  }
  return pieces;
}

// Numbers the voxels, at most max_voxels per frame; returns how many there are.
int64_t number_voxels(std::vector<Piece>& pieces, int64_t max_voxels) {
  int64_t num_voxels = 0, frame = -1, left = 0;
  for (Piece& piece : pieces) {
    if (piece.frame != frame) left = max_voxels;
    frame = piece.frame;
    piece.num_voxels = std::min(piece.num_voxels, left);
    piece.first_voxel = num_voxels;
    num_voxels += piece.num_voxels;
    left -= piece.num_voxels;
  }
  return num_voxels;
}

template <typename M, typename Item>
Outputs fill_voxels(const VoxelizeInputs& in, const Tensor& points, const SortedItems<Item>& sorted,
                    const Tensor& point_to_slot, int64_t max_points, int64_t max_voxels) {
  const VoxelizeHardKernels<M, Item>& k = voxelize_hard_kernels<M, Item>();
  const int64_t num_points = in.num_points(), columns = points.size(1);
  const VoxelizeHardArgs<M, Item> a{sorted.items.get(), sorted.count, in.bits, storage<M>(points), columns, max_points};
  int64_t* slot_of = point_to_slot.mutable_data_ptr<int64_t>();

  std::unique_ptr<int32_t[]> run_of_row = allocate_array<int32_t>(num_points);
  parallel(num_points, 32768, [&](int64_t begin, int64_t end) {
    std::fill(run_of_row.get() + begin, run_of_row.get() + end, -1);
    std::fill(slot_of + begin, slot_of + end, -1);
  });
  parallel(sorted.count, 16384,
           [&](int64_t begin, int64_t end) { k.list_runs(a.items, in.bits.row, run_of_row.get(), begin, end); });
  std::vector<Piece> pieces = pieces_of_rows(in.offsets.const_data_ptr<int64_t>(), in.num_frames(), num_points);
  const auto for_each_piece = [&](const auto& body) {
    parallel(int64_t(pieces.size()), 1, [&](int64_t first, int64_t last) {
      for (int64_t i = first; i < last; ++i) body(pieces[i]);
    });
  };
  for_each_piece([&](Piece& p) { p.num_voxels = k.count_runs(run_of_row.get(), p.begin, p.end); });
  const int64_t num_voxels = number_voxels(pieces, max_voxels);
  std::unique_ptr<int32_t[]> run_of_voxel = allocate_array<int32_t>(num_voxels);
  for_each_piece([&](const Piece& p) {
    k.gather_runs(run_of_row.get(), p.begin, p.end, p.num_voxels, run_of_voxel.get() + p.first_voxel);
  });

  Tensor voxels = torch::stable::new_empty(points, {num_voxels, max_points, columns});
  Tensor coords = torch::stable::new_empty(point_to_slot, {num_voxels, 4});
  Tensor counts = torch::stable::new_empty(point_to_slot, {num_voxels});
  M* voxels_data = mutable_storage<M>(voxels);
  int64_t* coords_data = coords.mutable_data_ptr<int64_t>();
  int64_t* counts_data = counts.mutable_data_ptr<int64_t>();
  parallel(num_voxels, 1 + 16384 / (max_points * columns), [&](int64_t begin, int64_t end) {
    k.write(a, run_of_voxel.get(), voxels_data, coords_data, counts_data, slot_of, begin, end);
  });
  return {voxels, coords, counts, point_to_slot};
}

template <typename S>
Outputs hard_voxels(const VoxelizeInputs& in, const Tensor& points, const Tensor& point_to_slot, int64_t max_points,
                    int64_t max_voxels) {
  using M = Moved<S>;
  return with_sorted_points<S>(in, point_to_slot.mutable_data_ptr<int64_t>(), [&](const auto&, const auto& sorted) {
    return fill_voxels<M>(in, points, sorted, point_to_slot, max_points, max_voxels);
  });
}

template <typename S>
void backward(const Tensor& grad, int64_t num_slots, const int64_t* slot_of, const Tensor& out) {
  using M = Moved<S>;
  const int64_t num_points = out.size(0), columns = out.size(1);
  parallel(num_points, 32768, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      PRED_CHECK(slot_of[row] < num_slots, "voxelize_hard_backward: point_to_slot must be less than ", num_slots,
                 ", got ", slot_of[row]);
    }
  });
  M* data = mutable_storage<M>(out);
  const auto& k = voxelize_hard_kernels<M, uint64_t>();
  parallel(num_points, 1 + 16384 / std::max<int64_t>(columns, 1),
           [&](int64_t begin, int64_t end) { k.backward(storage<M>(grad), columns, slot_of, data, begin, end); });
}
#endif

Outputs voxelize_hard(const Tensor& points_in, const Tensor& batch_offsets, std::vector<double> voxel_size,
                      std::vector<double> point_range, std::vector<int64_t> grid_size, int64_t max_points,
                      int64_t max_voxels) {
  const char* op = "voxelize_hard";
  check_tensor(op, "points", points_in, 2, points_in.scalar_type());
  PRED_CHECK(max_points >= 1, op, ": max_points must be at least 1, got ", max_points);
  PRED_CHECK(max_voxels >= 1, op, ": max_voxels must be at least 1, got ", max_voxels);
  int64_t voxel_elements;
  PRED_CHECK(!__builtin_mul_overflow(max_points, points_in.size(1), &voxel_elements), op,
             ": max_points must be less than 2^63 / C with C=", points_in.size(1), ", got ", max_points);
  const Tensor points = torch::stable::contiguous(points_in);
  const VoxelizeInputs in(op, points, batch_offsets, voxel_size, point_range, grid_size);
  return PRED_DISPATCH_STORAGE(op, points.scalar_type(), [&] {
    Tensor point_to_slot = torch::stable::new_empty(in.offsets, {in.num_points()});
    return hard_voxels<S>(in, points, point_to_slot, max_points, max_voxels);
  });
}

Tensor voxelize_hard_backward(const Tensor& grad_in, const Tensor& point_to_slot_in) {
  const char* op = "voxelize_hard_backward";
  check_tensor(op, "grad", grad_in, 3, grad_in.scalar_type());
  check_tensor(op, "point_to_slot", point_to_slot_in, 1, ScalarType::Long);
  const Tensor grad = torch::stable::contiguous(grad_in);
  const Tensor point_to_slot = torch::stable::contiguous(point_to_slot_in);
  const int64_t* slot_of = point_to_slot.const_data_ptr<int64_t>();
  int64_t num_slots;
  PRED_CHECK(!__builtin_mul_overflow(grad.size(0), grad.size(1), &num_slots), op,
             ": grad must have fewer than 2^63 slots, got shape ", shape_text(grad));
  return PRED_DISPATCH_STORAGE(op, grad.scalar_type(), [&] {
    Tensor out = torch::stable::new_empty(grad, {point_to_slot.size(0), grad.size(2)});
    backward<S>(grad, num_slots, slot_of, out);
    return out;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "voxelize_hard", &pred::voxelize_hard);
  PRED_IMPL(m, "voxelize_hard_backward", &pred::voxelize_hard_backward);
}
