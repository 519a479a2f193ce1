// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one point, then one place in the list of points sorted by voxel. Voxels are numbered by a sum over
// the places that start one. Keys of points outside have a bit above those of voxels, and so come last.
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/voxelize.h"

namespace pred::PRED_ISA {
namespace {

struct Space {
  uint64_t *keys, *sorted;
  int32_t *rows, *sorted_rows;
  int32_t *starts, *numbers;  // whether a place starts a voxel; how many have started with it
  char* work;
  int64_t work_size, bytes;

  Space(int64_t num_points, int key_bits, char* memory) {
    const int64_t sort = sort_rows_bytes(num_points, key_bits + 1), scan = scan_bytes(num_points);
    work_size = sort > scan ? sort : scan;
    Workspace space(memory);
    keys = space.take<uint64_t>(num_points);
    sorted = space.take<uint64_t>(num_points);
    rows = space.take<int32_t>(num_points);
    sorted_rows = space.take<int32_t>(num_points);
    starts = space.take<int32_t>(num_points);
    numbers = space.take<int32_t>(num_points);
    work = space.take<char>(work_size);
    bytes = space.bytes();
  }
};

template <typename S>
__global__ void pack_kernel(VoxelizePoints<S> a, const int64_t* offsets, int64_t num_frames, int64_t num_points,
                            int key_bits, uint64_t* keys, int32_t* rows) {
  for (int64_t i = first_thread(); i < num_points; i += thread_stride()) {
    rows[i] = int32_t(i);
    const S* point = a.points + i * a.point_stride;
    int32_t cell[3];
    for (int axis = 0; axis < 3; ++axis) {
      cell[axis] = voxel_index(widen(point[axis * a.axis_stride]), a.grid.low[axis], a.grid.high[axis],
                               a.grid.size[axis], a.grid.cells[axis]);
    }
    if ((cell[0] | cell[1] | cell[2]) < 0) {
      keys[i] = uint64_t(1) << key_bits;
      continue;
    }
    int64_t frame = 0, high = num_frames - 1;  // the last that starts at i or before
    while (frame < high) {
      const int64_t middle = (frame + high + 1) / 2;
      if (offsets[middle] <= i)
        frame = middle;
      else
        high = middle - 1;
    }
    keys[i] = voxel_key(a.bits, frame, cell[0], cell[1], cell[2]);
  }
}

__global__ void starts_kernel(const uint64_t* sorted, int64_t num_points, int key_bits, int32_t* starts) {
  for (int64_t i = first_thread(); i < num_points; i += thread_stride()) {
    starts[i] = sorted[i] >> key_bits == 0 && starts_voxel(sorted, 0, i);
  }
}

__global__ void number_kernel(const uint64_t* sorted, const int32_t* rows, const int32_t* numbers, int64_t num_points,
                              int key_bits, int64_t* point_to_voxel) {
  for (int64_t i = first_thread(); i < num_points; i += thread_stride()) {
    point_to_voxel[rows[i]] = sorted[i] >> key_bits == 0 ? numbers[i] - 1 : -1;
  }
}

// `bits` has no row.
__global__ void write_kernel(const uint64_t* sorted, const int32_t* starts, const int32_t* numbers, int64_t num_points,
                             VoxelKeyBits bits, int64_t* coords, int64_t* counts) {
  for (int64_t i = first_thread(); i < num_points; i += thread_stride()) {
    if (!starts[i]) continue;
    const int64_t voxel = numbers[i] - 1;
    write_coords(sorted[i], bits, coords + 4 * voxel);
    int64_t end = i + 1, high = num_points;  // the first place of another voxel
    while (end < high) {
      const int64_t middle = (end + high) / 2;
      if (sorted[middle] == sorted[i])
        end = middle + 1;
      else
        high = middle;
    }
    counts[voxel] = end - i;
  }
}

int64_t workspace_bytes(int64_t num_points, int key_bits) { return Space(num_points, key_bits, nullptr).bytes; }

template <typename S>
int64_t number(const VoxelizePoints<S>& a, const int64_t* offsets, int64_t num_frames, int64_t num_points, int key_bits,
               int64_t* point_to_voxel, char* workspace) {
  if (num_points == 0) return 0;
  const Space space(num_points, key_bits, workspace);
  const uint64_t* sorted = space.sorted;
  launch_threads(pack_kernel<S>, num_points, a, offsets, num_frames, num_points, key_bits, space.keys, space.rows);
  sort_rows(space.work, space.work_size, space.keys, space.sorted, space.rows, space.sorted_rows, num_points,
            key_bits + 1);
  launch_threads(starts_kernel, num_points, sorted, num_points, key_bits, space.starts);
  add_up(space.work, space.work_size, space.starts, space.numbers, num_points);
  launch_threads(number_kernel, num_points, sorted, static_cast<const int32_t*>(space.sorted_rows),
                 static_cast<const int32_t*>(space.numbers), num_points, key_bits, point_to_voxel);
  return read_back(space.numbers + num_points - 1);
}

void write(const VoxelKeyBits& bits, int64_t num_points, int key_bits, int64_t* coords, int64_t* counts,
           char* workspace) {
  const Space space(num_points, key_bits, workspace);
  launch_threads(write_kernel, num_points, static_cast<const uint64_t*>(space.sorted),
                 static_cast<const int32_t*>(space.starts), static_cast<const int32_t*>(space.numbers), num_points,
                 VoxelKeyBits{bits.x, bits.y, bits.z, 0}, coords, counts);
}

}  // namespace

const VoxelizeKernels<float> voxelize_f32 = {workspace_bytes, number<float>, write};
const VoxelizeKernels<double> voxelize_f64 = {workspace_bytes, number<double>, write};
const VoxelizeKernels<BFloat16> voxelize_bf16 = {workspace_bytes, number<BFloat16>, write};
const VoxelizeKernels<Float16> voxelize_f16 = {workspace_bytes, number<Float16>, write};

}  // namespace pred::PRED_ISA
