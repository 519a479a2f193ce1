// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// CUDA kernels of sample_pdf and resample_rays, which instantiate inverse_cdf_kernels<T, kMerged>.
//
// One warp owns one ray and writes that ray's row only. Its sections, their cumulative distribution and, to be merged,
// its new samples are in scratch rows, in shared memory where they fit. Sums over sections are scans in double. Lanes
// are sections or samples; each sample looks its section up by bisection. To merge, each number counts the numbers of
// the other list that come before it; where a list is out of order, of both lists.
#pragma once

#include "common/warp.cuh"
#include "ops/sample_pdf.h"

namespace pred::PRED_ISA {
namespace {

constexpr int kRaysPerBlock = kThreads / kWarp;

// Scratch of one ray.
template <typename T>
struct Row {
  T *t, *mass, *cdf, *added;  // [S], [S], [S], [num_new]
};

template <typename T>
int64_t row_size(const SamplePdfArgs<T>& a) {
  return 3 * a.num_edges + a.num_new;
}

// Whether x[i] <= x[i + 1] throughout; not with NaN.
template <typename T>
PRED_DEVICE_ONLY bool ascending(const T* x, int64_t n) {
  bool in_order = true;
  for (int64_t i = lane_number(); i + 1 < n; i += kWarp) in_order = in_order && x[i] <= x[i + 1];
  return __all_sync(kWholeWarp, in_order);
}

// cumulative[i] = sum of mass[0..i), for i in [0, n].
template <typename T>
PRED_DEVICE_ONLY void accumulate(const T* mass, int64_t n, T* cumulative) {
  double before = 0;
  if (lane_number() == 0) cumulative[0] = T(0);
  for (int64_t first = 0; first < n; first += kWarp) {
    const int64_t i = first + lane_number();
    const double sums = prefix_sum(i < n ? double(mass[i]) : 0.0);
    if (i < n) cumulative[i + 1] = T(before + sums);
    before += broadcast(sums, kWarp - 1);
  }
  __syncwarp();
}

// The cumulative distribution over sections, from 0 to exactly 1. False where there is none: a range is not finite.
template <typename T>
PRED_DEVICE_ONLY bool distribution(const T* weights, int64_t sections, const Row<T>& row) {
  const auto write_mass = [&](auto mass_of) {
    for (int64_t i = lane_number(); i < sections; i += kWarp) {
      const T mass = mass_of(i);
      row.mass[i] = mass <= T(0) ? T(0) : mass;  // NaN stays NaN
    }
    __syncwarp();
    accumulate(row.mass, sections, row.cdf);
  };
  write_mass([&](int64_t i) { return weights[i]; });
  T total = row.cdf[sections];
  if (!(total >= Limits<T>::smallest && total <= Limits<T>::largest)) {
    __syncwarp();
    write_mass([&](int64_t i) { return row.t[i + 1] - row.t[i]; });
    total = row.cdf[sections];
    if (!(total <= Limits<T>::largest)) return false;
  }
  __syncwarp();  // all have read the total
  for (int64_t i = lane_number(); i <= sections; i += kWarp) {
    // All t are equal: any section will do.
    row.cdf[i] = i == sections ? T(1) : total == T(0) ? T(0) : row.cdf[i] / total;
  }
  __syncwarp();
  return true;
}

// The published rules: the cumulative distribution starts at 0 and ends near 1.
template <typename T>
PRED_DEVICE_ONLY void published_distribution(const PdfRule<T>& rule, const T* weights, int64_t sections,
                                             const Row<T>& row) {
  const bool neus = rule.mode == PdfMode::kNeus;
  const T added = neus ? rule.eps : rule.histogram_padding;
  for (int64_t i = lane_number(); i < sections; i += kWarp) row.mass[i] = weights[i] + added;
  __syncwarp();
  accumulate(row.mass, sections, row.cdf);
  const T sum = row.cdf[sections], lacking = rule.eps - sum <= T(0) ? T(0) : rule.eps - sum;
  const T missing = neus ? T(0) : lacking, part = missing / T(sections), total = sum + missing;
  __syncwarp();
  for (int64_t i = lane_number(); i < sections; i += kWarp) {
    row.mass[i] = (neus ? row.mass[i] : row.mass[i] + part) / total;
  }
  __syncwarp();
  accumulate(row.mass, sections, row.cdf);
  for (int64_t i = lane_number(); !neus && i <= sections; i += kWarp)
    row.cdf[i] = row.cdf[i] > T(1) ? T(1) : row.cdf[i];
  __syncwarp();
}

// How many of x[0..n), which ascends, are before `value`, or, with kEqual, not behind it. NaN counts as not behind.
template <bool kEqual, typename T>
PRED_DEVICE_ONLY int64_t count_before(const T* x, int64_t n, T value) {
  int64_t low = 0, high = n;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (kEqual ? !(x[middle] > value) : x[middle] < value)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

// The new samples, to `samples`. kMerged: kept from passing the end of their section by a rounding, so that they are
// in order where u is.
template <bool kMerged, typename T>
PRED_DEVICE_ONLY void draw(const SamplePdfArgs<T>& a, const T* weights, const T* u, const Row<T>& row, T* samples) {
  const int64_t sections = a.num_edges - 1;
  if (a.rule.mode == PdfMode::kExact) {
    const bool has_cdf = distribution(weights, sections, row);
    for (int64_t k = lane_number(); k < a.num_new; k += kWarp) {
      const T position = clip_position(u[k]);
      const int64_t before = count_before<true>(row.cdf, a.num_edges, position) - 1;
      const int64_t i = before < 0 ? 0 : before < sections ? before : sections - 1;
      const T end = row.t[i + 1], x = exact_sample(position, row.cdf[i], row.cdf[i + 1], row.t[i], end);
      samples[k] = !has_cdf ? T(__builtin_nan("")) : kMerged && x > end && end >= row.t[i] ? end : x;
    }
  } else {
    published_distribution(a.rule, weights, sections, row);
    for (int64_t k = lane_number(); k < a.num_new; k += kWarp) {
      const int64_t above = count_before<true>(row.cdf, a.num_edges, u[k]);
      const int64_t low = above > 1 ? above - 1 : 0, high = above < sections ? above : sections;
      samples[k] = published_sample(a.rule, u[k], row.cdf[low], row.cdf[high], row.t[low], row.t[high]);
    }
  }
  __syncwarp();
}

// Whether a comes before b; NaN comes last.
template <typename T>
PRED_DEVICE_ONLY bool comes_before(T a, T b) {
  return a < b || (b != b && a == a);
}

// The place of a number among n others, of which those before number `own` go first where they are equal to it.
template <typename T>
PRED_DEVICE_ONLY int64_t rank(const T* x, int64_t n, T value, int64_t own) {
  int64_t before = 0;
  for (int64_t i = 0; i < n; ++i) before += comes_before(x[i], value) || (i < own && !comes_before(value, x[i]));
  return before;
}

template <typename T>
PRED_DEVICE_ONLY void merge(const SamplePdfArgs<T>& a, const Row<T>& row, T* merged) {
  const int64_t old = a.num_edges, added = a.num_new;
  const bool in_order = ascending(row.t, old) && ascending(row.added, added) && row.t[old - 1] == row.t[old - 1] &&
                        (added == 0 || row.added[0] == row.added[0]);
  for (int64_t i = lane_number(); i < old; i += kWarp) {
    const T x = row.t[i];
    const int64_t place =
        in_order ? i + count_before<false>(row.added, added, x) : rank(row.t, old, x, i) + rank(row.added, added, x, 0);
    merged[place] = x;
  }
  for (int64_t k = lane_number(); k < added; k += kWarp) {
    const T x = row.added[k];
    const int64_t place =
        in_order ? k + count_before<true>(row.t, old, x) : rank(row.t, old, x, old) + rank(row.added, added, x, k);
    merged[place] = x;
  }
}

// `scratch`: rows for each warp of the grid, or null, and they are in shared memory.
template <typename T, bool kMerged>
__global__ void __launch_bounds__(kThreads)
    inverse_cdf_kernel(SamplePdfArgs<T> a, T* out, T* scratch, int64_t row_elements, int64_t num_rays) {
  T* rows = scratch ? scratch + first_warp() * row_elements
                    : static_cast<T*>(dynamic_shared()) + threadIdx.x / kWarp * row_elements;
  const Row<T> row{rows, rows + a.num_edges, rows + 2 * a.num_edges, rows + 3 * a.num_edges};
  for (int64_t ray = first_warp(); ray < num_rays; ray += warp_stride()) {
    __syncwarp();  // the ray before has been merged
    for (int64_t i = lane_number(); i < a.num_edges; i += kWarp) row.t[i] = a.edges[ray * a.num_edges + i];
    __syncwarp();
    const T *weights = a.weights + ray * a.weight_stride, *u = a.u + ray * a.u_stride;
    if (kMerged) {
      draw<true>(a, weights, u, row, row.added);
      merge(a, row, out + ray * (a.num_edges + a.num_new));
    } else {
      draw<false>(a, weights, u, row, out + ray * a.num_new);
    }
  }
}

constexpr int64_t kSharedBytes = 48 * 1024;

template <typename T>
int64_t block_bytes(const SamplePdfArgs<T>& a) {
  return kRaysPerBlock * row_size(a) * int64_t(sizeof(T));
}

// Blocks whose rows are in global memory: as many as 256 MiB hold, or one.
template <typename T>
int64_t blocks_in_scratch(const SamplePdfArgs<T>& a) {
  const int64_t blocks = (int64_t(256) << 20) / block_bytes(a);
  return blocks < 1 ? 1 : blocks < 1024 ? blocks : 1024;
}

template <typename T>
int64_t scratch_size(const SamplePdfArgs<T>& a) {
  return block_bytes(a) <= kSharedBytes ? 0 : blocks_in_scratch(a) * kRaysPerBlock * row_size(a);
}

template <typename T, bool kMerged>
void sample(const SamplePdfArgs<T>& a, T* out, T* scratch, int32_t*, int64_t, int64_t num_rays) {
  const int64_t needed = (num_rays + kRaysPerBlock - 1) / kRaysPerBlock;
  if (block_bytes(a) <= kSharedBytes) {
    launch_blocks(inverse_cdf_kernel<T, kMerged>, needed, kThreads, block_bytes(a), a, out, static_cast<T*>(nullptr),
                  row_size(a), num_rays);
  } else {
    const int64_t most = blocks_in_scratch(a);
    launch_blocks(inverse_cdf_kernel<T, kMerged>, needed < most ? needed : most, kThreads, 0, a, out, scratch,
                  row_size(a), num_rays);
  }
}

template <typename T, bool kMerged>
constexpr SamplePdfKernels<T> inverse_cdf_kernels() {
  return {scratch_size<T>, nullptr, sample<T, kMerged>};
}

}  // namespace
}  // namespace pred::PRED_ISA
