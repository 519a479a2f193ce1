// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one row of the table.
#include "common/launch.cuh"
#include "ops/box_table.h"

namespace pred {
namespace {

template <typename T>
__global__ void put_boxes_kernel(const T* rows, BoxTable table) {
  for (int64_t row = first_thread(); row < table.stride; row += thread_stride())
    put_box(table, row, row < table.count ? read_box(rows + 7 * row) : no_box());
}

}  // namespace

void put_boxes(const float* rows, const BoxTable& table) {
  launch_threads(put_boxes_kernel<float>, table.stride, rows, table);
}
void put_boxes(const double* rows, const BoxTable& table) {
  launch_threads(put_boxes_kernel<double>, table.stride, rows, table);
}

}  // namespace pred
