// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns kBoxLanes pairs, in the lanes of vectors, and their results.
#include "ops/box_iou.h"

namespace pred::PRED_ISA {
namespace {

template <bool kWithHeight>
static inline double iou(const Box& a, const Box& b) {
  return kWithHeight ? iou_3d(a, b) : iou_bev(a, b);
}

template <typename T>
static inline void write(const double iou[kBoxLanes], int64_t count, T* __restrict out) {
  for (int64_t lane = 0; lane < (count < kBoxLanes ? count : kBoxLanes); ++lane) out[lane] = T(iou[lane]);
}

template <typename T, bool kWithHeight>
static void pairs_of(const BoxTable& a, const BoxTable& b, T* out, int64_t begin, int64_t end) {
  const int64_t groups = b.stride / kBoxLanes;
  for (int64_t n = begin; n < end; ++n) {
    const int64_t row = n / groups, first = n % groups * kBoxLanes;
    const Box box = box_at(a, row);
    bool near[kBoxLanes], any = false;
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) near[lane] = is_near(box, box_at(b, first + lane));
    for (int64_t lane = 0; lane < kBoxLanes; ++lane) any |= near[lane];
    double found[kBoxLanes] = {};
    if (any) {
      for (int64_t lane = 0; lane < kBoxLanes; ++lane) found[lane] = iou<kWithHeight>(box, box_at(b, first + lane));
    }
    write(found, b.count - first, out + row * b.count + first);
  }
}

template <typename T, bool kWithHeight>
static void rows_of(const BoxTable& a, const BoxTable& b, T* out, int64_t begin, int64_t end) {
  for (int64_t n = begin; n < end; ++n) {
    const int64_t first = n * kBoxLanes;
    double found[kBoxLanes];
    for (int64_t lane = 0; lane < kBoxLanes; ++lane)
      found[lane] = iou<kWithHeight>(box_at(a, first + lane), box_at(b, first + lane));
    write(found, b.count - first, out + first);
  }
}

template <typename T>
static void all_pairs(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t begin, int64_t end) {
  (with_height ? pairs_of<T, true> : pairs_of<T, false>)(a, b, out, begin, end);
}

template <typename T>
static void rows(const BoxTable& a, const BoxTable& b, bool with_height, T* out, int64_t begin, int64_t end) {
  (with_height ? rows_of<T, true> : rows_of<T, false>)(a, b, out, begin, end);
}

}  // namespace

const BoxIouKernels<float> box_iou_f32 = {all_pairs<float>, rows<float>};
const BoxIouKernels<double> box_iou_f64 = {all_pairs<double>, rows<double>};

}  // namespace pred::PRED_ISA
