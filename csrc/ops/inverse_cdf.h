// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What sample_pdf and resample_rays share: the cumulative distribution of a ray's weights, and its inverse. CPU kernels
// only.
#pragma once

#include "math/lanes.h"
#include "ops/sample_pdf.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kPad = 16;  // at least a vector, on both sides of every row

static inline int64_t padded(int64_t n) { return (n + kPad - 1) / kPad * kPad; }

// Scratch rows of one ray, with room for a vector on both sides. Sections are padded to whole vectors, by empty ones
// at the end.
template <typename T>
struct Row {
  int64_t sections, size;               // size: padded
  T *t, *mass, *cdf, *slope, *u, *out;  // out: room for S + num_new
  int32_t *low, *high;                  // of the search; resample_rays has another use for this room
};

template <typename T>
static int64_t scratch_size(const SamplePdfArgs<T>& a) {
  return kPad + 5 * (padded(a.num_edges) + 2 * kPad) + 2 * (a.num_new + 2 * kPad);
}

template <typename T>
static int64_t int_scratch_size(const SamplePdfArgs<T>& a) {
  const int64_t more = a.num_new > a.num_edges ? a.num_new - a.num_edges : 0;
  return padded(a.num_edges - 1) + a.num_edges + a.num_new + kPad + more;
}

template <typename T>
static Row<T> make_row(const SamplePdfArgs<T>& a, T* scratch, int32_t* int_scratch) {
  const int64_t sections = a.num_edges - 1, size = padded(sections), stride = size + 2 * kPad;
  T* first = (T*)((uintptr_t(scratch) + 63) / 64 * 64) + kPad;  // rows are aligned to 64 bytes
  T* u = first + 4 * stride;
  first[3 * stride + size] = T(0);  // the slope behind the last section
  return {sections,
          size,
          first,
          first + stride,
          first + 2 * stride,
          first + 3 * stride,
          u,
          u + a.num_new + kPad,
          int_scratch,
          int_scratch + a.num_new};
}

template <typename T>
static inline bool ascending(const T* x, int64_t n) {
  int32_t out_of_order = 0;
  for (int64_t i = 0; i + 1 < n; ++i) out_of_order |= x[i] <= x[i + 1] ? 0 : 1;
  return out_of_order == 0;  // false for NaN
}

// cumulative[i] = sum of mass[0..i), for i in [0, n]; summed in double.
template <typename T>
static inline void accumulate(const T* mass, int64_t n, T* cumulative) {
  constexpr int D = kWidth<double>;
  Vec<double, D> before{};
  cumulative[0] = T(0);
  for (int64_t i = 0; i < n; i += D) {
    const Vec<double, D> sums = prefix_sum<double, D>(load_wide(mass + i));
    store_narrow(cumulative + i + 1, before + sums);
    before += broadcast<D - 1, double, D>(sums);
  }
}

template <typename T>
static inline void read_ranges(const T* __restrict t, const Row<T>& row) {
  for (int64_t i = 0; i <= row.sections; ++i) row.t[i] = t[i];
  for (int64_t i = row.sections + 1; i <= row.size + 1; ++i) row.t[i] = t[row.sections];
}

// The cumulative distribution over sections, from 0 to exactly 1. False where there is none: a range is not finite.
template <typename T>
static inline bool distribution(const T* __restrict weights, const Row<T>& row) {
  const T* __restrict t = row.t;
  T* __restrict mass = row.mass;
  T* __restrict cdf = row.cdf;
  for (int64_t i = 0; i < row.sections; ++i) mass[i] = weights[i] <= T(0) ? T(0) : weights[i];
  for (int64_t i = row.sections; i < row.size; ++i) mass[i] = T(0);
  accumulate(mass, row.size, cdf);
  T total = cdf[row.size];
  if (!(total >= Limits<T>::smallest && total <= Limits<T>::largest)) {
    for (int64_t i = 0; i < row.size; ++i) mass[i] = t[i + 1] - t[i] <= T(0) ? T(0) : t[i + 1] - t[i];
    accumulate(mass, row.size, cdf);
    total = cdf[row.size];
    if (!(total <= Limits<T>::largest)) return false;
    if (total == T(0)) {  // all t are equal: any section will do
      for (int64_t i = row.sections; i <= row.size; ++i) cdf[i] = T(1);
      return true;
    }
  }
  for (int64_t i = 0; i < row.size; ++i) cdf[i] = cdf[i] / total;
  cdf[row.size] = T(1);
  return true;
}

// The published rules: the cumulative distribution starts at 0 and ends near 1.
template <typename T>
static inline void published_distribution(const PdfRule<T>& rule, const T* __restrict weights, const Row<T>& row) {
  const bool neus = rule.mode == PdfMode::kNeus;
  const T added = neus ? rule.eps : rule.histogram_padding;
  T* __restrict mass = row.mass;
  T* __restrict cdf = row.cdf;
  for (int64_t i = 0; i < row.sections; ++i) mass[i] = weights[i] + added;
  for (int64_t i = row.sections; i < row.size; ++i) mass[i] = T(0);
  accumulate(mass, row.size, cdf);
  T total = cdf[row.sections];
  if (!neus) {
    const T missing = rule.eps - total <= T(0) ? T(0) : rule.eps - total;
    const T part = missing / T(row.sections);
    for (int64_t i = 0; i < row.sections; ++i) mass[i] += part;
    total += missing;
  }
  for (int64_t i = 0; i < row.sections; ++i) mass[i] = mass[i] / total;
  accumulate(mass, row.size, cdf);
  if (neus) return;
  for (int64_t i = 1; i <= row.sections; ++i) cdf[i] = cdf[i] > T(1) ? T(1) : cdf[i];
}

// row.low[k] = number of entries of the cdf that are not above u_k, by bisection of all k at once: vectors of gathers,
// where the machine has them, and no branch to mispredict. NaN, in u or in the cdf, is above nothing.
template <typename T>
static inline void search(int64_t num_new, const Row<T>& row) {
  const T* __restrict cdf = row.cdf, * __restrict u = row.u;
  int32_t* __restrict low = row.low, * __restrict high = row.high;
  const int32_t entries = int32_t(row.sections) + 1;
  for (int64_t k = 0; k < num_new; ++k) low[k] = 0;
  for (int64_t k = 0; k < num_new; ++k) high[k] = entries;
  for (int32_t left = entries; left > 0; left /= 2) {
    for (int64_t k = 0; k < num_new; ++k) {
      const int32_t middle = (low[k] + high[k]) >> 1;
      const bool open = low[k] < high[k], up = !(cdf[middle] > u[k]);
      low[k] = open && up ? middle + 1 : low[k];
      high[k] = open && !up ? middle : high[k];
    }
  }
}

// Samples in the order of u, whatever that is. Takes the row by value, and so leaves its caller's in registers.
template <typename T>
static __attribute__((noinline)) void exact_samples(bool has_cdf, int64_t num_new, Row<T> row, T* __restrict samples) {
  search(num_new, row);
  const T* __restrict t = row.t, * __restrict cdf = row.cdf, * __restrict u = row.u;
  const int32_t* __restrict above = row.low;
  const int32_t last = int32_t(row.sections) - 1;
  for (int64_t k = 0; k < num_new; ++k) {
    const int32_t before = above[k] - 1, positive = before > 0 ? before : 0, i = positive < last ? positive : last;
    const T x = exact_sample(u[k], cdf[i], cdf[i + 1], t[i], t[i + 1]);
    samples[k] = has_cdf ? x : T(__builtin_nan(""));
  }
}

template <typename T>
static inline void published_samples(const PdfRule<T>& rule, int64_t num_new, const Row<T>& row,
                                     T* __restrict samples) {
  search(num_new, row);
  const T* __restrict t = row.t, * __restrict cdf = row.cdf, * __restrict u = row.u;
  const int32_t* __restrict above = row.low;
  const int32_t last = int32_t(row.sections);
  for (int64_t k = 0; k < num_new; ++k) {
    const int32_t low = above[k] > 1 ? above[k] - 1 : 0, high = above[k] < last ? above[k] : last;
    samples[k] = published_sample(rule, u[k], cdf[low], cdf[high], t[low], t[high]);
  }
}

}  // namespace
}  // namespace pred::PRED_ISA
