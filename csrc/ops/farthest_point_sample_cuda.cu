// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One block owns one frame, one thread every so many points of it. A sample is one pass over all of the frame's points,
// which lowers their distances, and one search among the threads' farthest. Not contracted (-fmad=false): the samples
// are the CPU's.
#include "common/warp.cuh"
#include "ops/farthest_point_sample.h"

namespace pred::PRED_ISA {
namespace {

constexpr int kMostThreads = 1024;

template <typename T>
struct Candidate {
  T distance;  // less than 0 where there is none
  int32_t row;
};

template <typename T>
PRED_DEVICE_ONLY Candidate<T> farther(Candidate<T> a, Candidate<T> b) {
  return a.distance > b.distance || (a.distance == b.distance && a.row < b.row) ? a : b;
}

// Every lane gets it.
template <typename T>
PRED_DEVICE_ONLY Candidate<T> farthest_of_lanes(Candidate<T> mine) {
  for (int step = kWarp / 2; step > 0; step /= 2) {
    const T distance = __shfl_xor_sync(kWholeWarp, mine.distance, step);
    const int32_t row = __shfl_xor_sync(kWholeWarp, mine.row, step);
    mine = farther(mine, {distance, row});
  }
  return mine;
}

template <typename T>
__global__ void __launch_bounds__(kMostThreads)
    sample_kernel(FarthestPointSampleArgs<T> a, T* __restrict__ distance, int64_t* out) {
  __shared__ int32_t num_finite, first_finite;
  __shared__ Candidate<T> of_warp[2][kMostThreads / kWarp];  // in turn, so that a sample takes one barrier
  const T* __restrict__ x = a.points, * __restrict__ y = x + a.frames.num_rows, * __restrict__ z = y + a.frames.num_rows;
  const int lane = lane_number(), warp = int(threadIdx.x) / kWarp, num_warps = int(blockDim.x) / kWarp;
  for (int64_t frame = blockIdx.x; frame < a.frames.num_frames; frame += gridDim.x) {
    const int64_t begin = frame_begin(a.frames, frame), end = frame_end(a.frames, frame);
    __syncthreads();  // all are done with the frame before
    if (threadIdx.x == 0) {
      num_finite = 0;
      first_finite = kNoRow;
    }
    __syncthreads();
    int32_t finite = 0, first = kNoRow;
    for (int64_t i = begin + threadIdx.x; i < end; i += blockDim.x) {
      const T position[3] = {x[i], y[i], z[i]};
      const bool counts = is_finite(position);
      distance[i] = counts ? T(__builtin_inf()) : T(-1);
      if (counts && finite++ == 0) first = int32_t(i);
    }
    if (finite > 0) {
      atomicAdd(&num_finite, finite);
      atomicMin(&first_finite, first);
    }
    __syncthreads();
    const int64_t count = num_finite < a.num_samples ? num_finite : a.num_samples;
    int64_t* samples = out + frame * a.num_samples;
    for (int64_t n = count + threadIdx.x; n < a.num_samples; n += blockDim.x) samples[n] = -1;
    int64_t row = first_finite;
    if (a.start < end - begin) {
      const int64_t i = begin + a.start;
      const T position[3] = {x[i], y[i], z[i]};
      if (is_finite(position)) row = i;
    }
    for (int64_t n = 0; n < count; ++n) {
      if (threadIdx.x == 0) samples[n] = row;
      if (n == count - 1) break;
      const T sample_x = x[row], sample_y = y[row], sample_z = z[row];
      Candidate<T> farthest{T(-1), kNoRow};
#pragma unroll 4
      for (int64_t i = begin + threadIdx.x; i < end; i += blockDim.x) {
        const T before = distance[i], to_sample = squared_length(x[i] - sample_x, y[i] - sample_y, z[i] - sample_z);
        const T now = to_sample < before ? to_sample : before;
        if (to_sample < before) distance[i] = now;
        if (now > farthest.distance) farthest = {now, int32_t(i)};
      }
      farthest = farthest_of_lanes(farthest);
      if (lane == 0) of_warp[n % 2][warp] = farthest;
      __syncthreads();
      farthest = lane < num_warps ? of_warp[n % 2][lane] : Candidate<T>{T(-1), kNoRow};
      row = farthest_of_lanes(farthest).row;
    }
  }
}

template <typename T>
void sample(const FarthestPointSampleArgs<T>& a, T* distance, int64_t* out) {
  const int64_t rows = a.frames.num_rows, threads = (rows + kWarp - 1) / kWarp * kWarp;
  launch_blocks(sample_kernel<T>, a.frames.num_frames,
                int(threads < kWarp          ? kWarp
                    : threads < kMostThreads ? threads
                                             : kMostThreads),
                0, a, distance, out);
}

}  // namespace

const FarthestPointSampleKernels<float> farthest_point_sample_f32 = {sample<float>};
const FarthestPointSampleKernels<double> farthest_point_sample_f64 = {sample<double>};

}  // namespace pred::PRED_ISA
