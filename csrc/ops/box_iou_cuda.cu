// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one pair and its result; neighbouring threads have neighbouring boxes b.
#include "common/launch.cuh"
#include "ops/box_iou.h"

namespace pred::PRED_ISA {
namespace {

template <bool kWithHeight>
PRED_DEVICE_ONLY double iou(const Box& a, const Box& b) {
  if (!is_near(a, b)) return 0;
  return kWithHeight ? iou_3d(a, b) : iou_bev(a, b);
}

template <typename T, bool kWithHeight>
__global__ void __launch_bounds__(kThreads) pairs_kernel(BoxTable a, BoxTable b, T* out) {
  const int64_t pairs = a.count * b.count;
  for (int64_t n = first_thread(); n < pairs; n += thread_stride()) {
    const int64_t row = n / b.count;
    out[n] = T(iou<kWithHeight>(box_at(a, row), box_at(b, n - row * b.count)));
  }
}

template <typename T, bool kWithHeight>
__global__ void __launch_bounds__(kThreads) rows_kernel(BoxTable a, BoxTable b, T* out) {
  for (int64_t row = first_thread(); row < b.count; row += thread_stride())
    out[row] = T(iou<kWithHeight>(box_at(a, row), box_at(b, row)));
}

template <typename T>
void all_pairs(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t, int64_t) {
  launch_threads(with_height ? pairs_kernel<T, true> : pairs_kernel<T, false>, a.count * b.count, a, b, out);
}

template <typename T>
void rows(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t, int64_t) {
  launch_threads(with_height ? rows_kernel<T, true> : rows_kernel<T, false>, b.count, a, b, out);
}

}  // namespace

const BoxIouKernels<float> box_iou_f32 = {all_pairs<float>, rows<float>};
const BoxIouKernels<double> box_iou_f64 = {all_pairs<double>, rows<double>};

}  // namespace pred::PRED_ISA
