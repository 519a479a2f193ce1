// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One block. A thread owns every 256th part, a warp the sums of its threads, the first thread those of the warps.
#include "common/parts.h"
#include "common/warp.cuh"

namespace pred {
namespace {

constexpr int kAdders = 256;

template <typename T>
__global__ void add_parts_kernel(const double* parts, int64_t count, T* sum) {
  __shared__ double of_warp[kAdders / kWarp];
  double part = 0;
  for (int64_t i = threadIdx.x; i < count; i += kAdders) part += parts[i];
  part = sum_lanes(part);
  if (lane_number() == 0) of_warp[threadIdx.x / kWarp] = part;
  __syncthreads();
  if (threadIdx.x != 0) return;
  double total = 0;
  for (const double warp_sum : of_warp) total += warp_sum;
  *sum = T(total);
}

}  // namespace

void add_parts(const double* parts, int64_t count, float* sum) {
  launch_blocks(add_parts_kernel<float>, 1, kAdders, 0, parts, count, sum);
}
void add_parts(const double* parts, int64_t count, double* sum) {
  launch_blocks(add_parts_kernel<double>, 1, kAdders, 0, parts, count, sum);
}

}  // namespace pred
