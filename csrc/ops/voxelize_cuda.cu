// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one point, then one place in the list of points sorted by voxel. Voxels are numbered by a sum over
// the places that start one.
#include "common/frames.h"
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/voxelize.h"

namespace pred::PRED_ISA {
namespace {

struct SortSpace {
  uint64_t *keys, *sorted;
  int32_t *rows, *sorted_rows;
  char* work;
  int64_t work_size, bytes;

  SortSpace(int64_t num_points, int key_bits, char* memory) {
    work_size = sort_rows_bytes(num_points, key_bits + 1);
    Workspace space(memory);
    keys = space.take<uint64_t>(num_points);
    sorted = space.take<uint64_t>(num_points);
    rows = space.take<int32_t>(num_points);
    sorted_rows = space.take<int32_t>(num_points);
    work = space.take<char>(work_size);
    bytes = space.bytes();
  }
};

struct NumberSpace {
  int32_t *starts, *numbers;  // whether a place starts a voxel; how many have started with it
  char* work;
  int64_t work_size, bytes;

  NumberSpace(int64_t num_points, char* memory) {
    work_size = scan_bytes(num_points);
    Workspace space(memory);
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
    const int64_t frame = frame_of_row(offsets, num_frames, i);
    keys[i] = voxel_key(a.bits, frame, cell[0], cell[1], cell[2]);
  }
}

__global__ void starts_kernel(SortedPoints points, int32_t* starts) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) starts[i] = starts_voxel(points, i);
}

__global__ void number_kernel(SortedPoints points, const int32_t* numbers, int64_t* point_to_voxel) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) {
    point_to_voxel[points.rows[i]] = is_inside(points, i) ? numbers[i] - 1 : -1;
  }
}

// `bits` has no row.
__global__ void write_kernel(SortedPoints points, const int32_t* starts, const int32_t* numbers, VoxelKeyBits bits,
                             int64_t* coords, int64_t* counts) {
  for (int64_t i = first_thread(); i < points.count; i += thread_stride()) {
    if (!starts[i]) continue;
    const int64_t voxel = numbers[i] - 1;
    write_coords(points.keys[i], bits, coords + 4 * voxel);
    counts[voxel] = voxel_end(points, i, points.count) - i;
  }
}

int64_t sort_workspace(int64_t num_points, int key_bits) { return SortSpace(num_points, key_bits, nullptr).bytes; }

template <typename S>
SortedPoints sort(const VoxelizePoints<S>& a, const int64_t* offsets, int64_t num_frames, int64_t num_points,
                  int key_bits, char* workspace) {
  const SortSpace space(num_points, key_bits, workspace);
  launch_threads(pack_kernel<S>, num_points, a, offsets, num_frames, num_points, key_bits, space.keys, space.rows);
  sort_rows(space.work, space.work_size, space.keys, space.sorted, space.rows, space.sorted_rows, num_points,
            key_bits + 1);
  return {space.sorted, space.sorted_rows, num_points, key_bits};
}

int64_t number_workspace(int64_t num_points) { return NumberSpace(num_points, nullptr).bytes; }

int64_t number(const SortedPoints& points, int64_t* point_to_voxel, char* workspace) {
  if (points.count == 0) return 0;
  const NumberSpace space(points.count, workspace);
  launch_threads(starts_kernel, points.count, points, space.starts);
  add_up(space.work, space.work_size, space.starts, space.numbers, points.count);
  launch_threads(number_kernel, points.count, points, static_cast<const int32_t*>(space.numbers), point_to_voxel);
  return read_back(space.numbers + points.count - 1);
}

void write(const SortedPoints& points, const VoxelKeyBits& bits, int64_t* coords, int64_t* counts, char* workspace) {
  const NumberSpace space(points.count, workspace);
  launch_threads(write_kernel, points.count, points, static_cast<const int32_t*>(space.starts),
                 static_cast<const int32_t*>(space.numbers), VoxelKeyBits{bits.x, bits.y, bits.z, 0}, coords, counts);
}

template <typename S>
constexpr VoxelizeKernels<S> table() {
  return {sort_workspace, sort<S>, number_workspace, number, write};
}

}  // namespace

const VoxelizeKernels<float> voxelize_f32 = table<float>();
const VoxelizeKernels<double> voxelize_f64 = table<double>();
const VoxelizeKernels<BFloat16> voxelize_bf16 = table<BFloat16>();
const VoxelizeKernels<Float16> voxelize_f16 = table<Float16>();

}  // namespace pred::PRED_ISA
