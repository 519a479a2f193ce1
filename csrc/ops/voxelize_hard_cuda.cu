// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Numbering: one thread owns one place in the list of points sorted by voxel, and writes what belongs to its row. A sum
// over rows numbers the voxels by their first rows; those beyond max_voxels of their frame fall out, and a second sum
// numbers the rest. Writing: one warp owns one voxel, its lanes neighbouring elements. Backward: one thread owns one
// column of one row. Values are only moved.
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/voxelize_hard.h"

namespace pred::PRED_ISA {
namespace {

struct Space {
  int32_t *starts, *ranks;  // of rows: whether it is the first of a voxel; how many rows up to it are
  int32_t *kept, *numbers;  // the same for voxels that are kept
  int32_t* runs;            // of voxels that are kept: the place of the first point
  char* work;
  int64_t work_size, bytes;

  Space(int64_t num_points, char* memory) {
    work_size = scan_bytes(num_points);
    Workspace space(memory);
    starts = space.take<int32_t>(num_points);
    ranks = space.take<int32_t>(num_points);
    kept = space.take<int32_t>(num_points);
    numbers = space.take<int32_t>(num_points);
    runs = space.take<int32_t>(num_points);
    work = space.take<char>(work_size);
    bytes = space.bytes();
  }
};

__global__ void starts_kernel(SortedPoints points, int32_t* starts, int64_t* point_to_slot) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) {
    const int64_t row = points.rows[i];
    starts[row] = starts_voxel(points, i);
    point_to_slot[row] = -1;
  }
}

__global__ void keep_kernel(SortedPoints points, int frame_shift, const int64_t* offsets, int64_t max_voxels,
                            const int32_t* starts, const int32_t* ranks, int32_t* kept) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) {
    const int64_t row = points.rows[i];
    kept[row] = 0;
    if (!starts[row]) continue;
    const int64_t frame_begin = offsets[points.keys[i] >> frame_shift];
    const int64_t begin = frame_begin < row ? frame_begin : row;  // offsets are not checked
    const int32_t before = begin > 0 ? ranks[begin - 1] : 0;
    kept[row] = ranks[row] - before <= max_voxels;
  }
}

__global__ void list_kernel(SortedPoints points, const int32_t* kept, const int32_t* numbers, int32_t* runs) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) {
    const int64_t row = points.rows[i];
    if (kept[row]) runs[numbers[row] - 1] = int32_t(i);
  }
}

template <typename S>
__global__ void __launch_bounds__(kThreads)
    write_kernel(VoxelizeHardArgs<S> a, const int32_t* runs, int64_t num_voxels, S* voxels, int64_t* coords,
                 int64_t* counts, int64_t* point_to_slot) {
  // The lane's element is column `column` of point `point`; kWarp elements on, these many further.
  const int lane = lane_number();
  const int64_t first_point = lane < a.columns ? 0 : lane / int(a.columns);
  const int64_t first_column = lane - first_point * a.columns;
  const int64_t more_points = kWarp < a.columns ? 0 : kWarp / int(a.columns);
  const int64_t more_columns = kWarp - more_points * a.columns;
  for (int64_t voxel = first_warp(); voxel < num_voxels; voxel += warp_stride()) {
    const int64_t run = runs[voxel];
    const int64_t most = a.max_points < a.sorted.count - run ? a.max_points : a.sorted.count - run;
    const int64_t count = voxel_end(a.sorted, run, run + most) - run;
    if (lane == 0) {
      write_coords(a.sorted.keys[run], a.bits, coords + 4 * voxel);
      counts[voxel] = count;
    }
    const int32_t* rows = a.sorted.rows + run;
    const int64_t first_slot = voxel * a.max_points;
    for (int64_t i = lane; i < count; i += kWarp) point_to_slot[rows[i]] = first_slot + i;
    S* out = voxels + first_slot * a.columns;
    int64_t point = first_point, column = first_column;
    for (int64_t i = lane; i < a.max_points * a.columns; i += kWarp) {
      out[i] = point < count ? a.points[rows[point] * a.columns + column] : S{};
      point += more_points;
      column += more_columns;
      if (column >= a.columns) {
        column -= a.columns;
        ++point;
      }
    }
  }
}

template <typename S>
__global__ void backward_kernel(const S* grad, int64_t num_slots, int64_t columns, const int64_t* point_to_slot, S* out,
                                int64_t count) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    const int64_t row = i / columns, slot = point_to_slot[row];
    out[i] = slot >= 0 && slot < num_slots ? grad[slot * columns + i - row * columns] : S{};
  }
}

int64_t workspace_bytes(int64_t num_points) { return Space(num_points, nullptr).bytes; }

int64_t number(const SortedPoints& points, const VoxelKeyBits& bits, const int64_t* offsets, int64_t max_voxels,
               int64_t* point_to_slot, char* workspace) {
  const int64_t count = points.count;
  if (count == 0) return 0;
  const Space space(count, workspace);
  const int32_t *starts = space.starts, *ranks = space.ranks, *kept = space.kept, *numbers = space.numbers;
  launch_threads(starts_kernel, count, points, space.starts, point_to_slot);
  add_up(space.work, space.work_size, starts, space.ranks, count);
  launch_threads(keep_kernel, count, points, bits.x + bits.y + bits.z, offsets, max_voxels, starts, ranks, space.kept);
  add_up(space.work, space.work_size, kept, space.numbers, count);
  launch_threads(list_kernel, count, points, kept, numbers, space.runs);
  return read_back(numbers + count - 1);
}

template <typename S>
void write(const VoxelizeHardArgs<S>& a, int64_t num_voxels, S* voxels, int64_t* coords, int64_t* counts,
           int64_t* point_to_slot, char* workspace) {
  VoxelizeHardArgs<S> keys = a;
  keys.bits.row = 0;  // rows stand apart
  const int32_t* runs = Space(a.sorted.count, workspace).runs;
  launch_warps(write_kernel<S>, num_voxels, keys, runs, num_voxels, voxels, coords, counts, point_to_slot);
}

template <typename S>
void backward(const S* grad, int64_t num_slots, int64_t columns, const int64_t* point_to_slot, S* out,
              int64_t num_points) {
  launch_threads(backward_kernel<S>, num_points * columns, grad, num_slots, columns, point_to_slot, out,
                 num_points * columns);
}

template <typename S>
constexpr VoxelizeHardKernels<S> table() {
  return {workspace_bytes, number, write<S>, backward<S>};
}

}  // namespace

const VoxelizeHardKernels<float> voxelize_hard_f32 = table<float>();
const VoxelizeHardKernels<double> voxelize_hard_f64 = table<double>();
const VoxelizeHardKernels<BFloat16> voxelize_hard_bf16 = table<BFloat16>();
const VoxelizeHardKernels<Float16> voxelize_hard_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
