// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's row only.
//
// t_i comes after exactly the c_i samples with u_k < cdf_i, so that the exact rule needs no comparison of ranges to
// merge: it emits t_0, c_1 samples, t_1, c_2 - c_1 samples, and so on. The row is assembled in scratch as whole
// vectors: section by section, each overwriting the surplus of the one before, or vector by vector where lanes can be
// permuted. Rays whose t or u are out of order or not finite, and other rules than the exact one, take the slow path:
// search, then merge or sort.
#include "math/heap.h"
#include "ops/inverse_cdf.h"

namespace pred::PRED_ISA {
namespace {

// How a row of u lies.
enum class Spread {
  kRegular,  // u_k = (k + shift) / n: midpoints, jittered as a whole
  kEven,     // u_k is in [k, k + 1] / n: stratified
  kAscending,
  kOther,
};

template <typename T>
struct Positions {
  Spread spread;
  T shift;
};

template <typename T>
static inline Positions<T> read_positions(const T* __restrict from, int64_t n, T* __restrict to) {
  for (int64_t i = 0; i < n; ++i) to[i] = clip_position(from[i]);
  to[-1] = -__builtin_inf();  // ends every search
  to[n] = __builtin_inf();
  if (!ascending(to, n + 1)) return {Spread::kOther, T(0)};  // with its end, so that a single NaN is noticed
  const T shift = to[0] * T(n), slack = T(n) * (T(1) - Limits<T>::below_one) * T(8);
  int32_t uneven = 0, irregular = 0;
  for (int32_t k = 0; k < int32_t(n); ++k) {
    const T place = to[k] * T(n) - T(k);
    uneven |= place >= -slack && place <= T(1) + slack ? 0 : 1;
    irregular |= place - shift >= -slack && place - shift <= slack ? 0 : 1;
  }
  if (uneven != 0 || slack > T(0.25) || n == 0) return {Spread::kAscending, T(0)};
  return {irregular == 0 ? Spread::kRegular : Spread::kEven, shift};
}

// row.low[i] = c_{i+1}, the number of samples with u < cdf_{i+1}; the last is num_new. Up to rounding: a sample that
// rounding puts into the neighbouring section is clipped to the end they share, and where rounding makes the sums fall
// so may these; whoever walks along them keeps the largest so far.
template <typename T>
static inline void section_ends(const Positions<T>& positions, int64_t num_new, const Row<T>& row) {
  const T *u = row.u, *cdf = row.cdf;
  if (positions.spread == Spread::kRegular) {
    for (int64_t i = 0; i < row.size; ++i) {
      // u that was clipped lies below 1 too.
      const T place = cdf[i + 1] >= T(1) ? T(num_new) : cdf[i + 1] * T(num_new) - positions.shift;
      const int32_t below = int32_t(place);
      row.low[i] = below + (T(below) < place ? 1 : 0);
    }
  } else if (positions.spread == Spread::kEven) {  // all u before the place of cdf_{i+1} are below it, none after it
    for (int64_t i = 0; i < row.size; ++i) {
      const int32_t place = int32_t(cdf[i + 1] * T(num_new));
      row.low[i] = place + (u[place] < cdf[i + 1] ? 1 : 0);
    }
  } else {
    int32_t end = 0;
    for (int64_t i = 0; i < row.sections; ++i) {
      while (u[end] < cdf[i + 1]) ++end;
      row.low[i] = end;
    }
  }
  row.low[row.sections - 1] = int32_t(num_new);
}

template <typename T>
static inline void section_slopes(const Row<T>& row) {
  const T* __restrict t = row.t, * __restrict cdf = row.cdf;
  T* __restrict slope = row.slope;
  for (int64_t i = 0; i < row.size; ++i) {
    const T steep = (t[i + 1] - t[i]) / (cdf[i + 1] - cdf[i]);
    // Of an empty section it is infinite or NaN, and negative where rounding makes the distribution fall.
    slope[i] = steep >= T(0) && steep <= Limits<T>::largest ? steep : T(0);
  }
}

// Where u lies in a section, or the end that is nearer. (Up to rounding, u may belong to a neighbour.)
template <typename V>
static inline __attribute__((always_inline)) V interpolate(V u, V cdf, V slope, V start, V end) {
  const V offset = u - cdf;
  const V x = start + (offset > V{} ? offset : V{}) * slope;
  return x < end ? x : end;
}

template <typename T>
static inline void merge(int64_t num_new, const Row<T>& row) {
  constexpr int W = kWidth<T>;
  int64_t begin = 0;  // c_i
  for (int64_t i = 0; i < row.sections; ++i) {
    const int64_t end = row.low[i] > begin ? row.low[i] : begin;
    row.out[i + begin] = row.t[i];
    for (int64_t k = begin; k < end; k += W) {
      store(row.out + i + 1 + k, interpolate(load<W>(row.u + k), splat<W>(row.cdf[i]), splat<W>(row.slope[i]),
                                             splat<W>(row.t[i]), splat<W>(row.t[i + 1])));
    }
    begin = end;
  }
  row.out[row.sections + num_new] = row.t[row.sections];
}

// The same, a vector of the merged row at a time: what its lanes need of sections and of u is in two windows.
template <typename T>
static inline void merge_permuted(int64_t num_new, const Row<T>& row, int32_t* starts_at) {
  constexpr int W = kWidth<T>;
  using Index = Vec<int32_t, W>;
  const int64_t size = row.sections + 1 + num_new;
  for (int64_t p = 0; p < size + W; ++p) starts_at[p] = 0;
  starts_at[0] = 1;
  int32_t end = 0;
  for (int64_t i = 0; i < row.sections; ++i) {
    end = row.low[i] > end ? row.low[i] : end;
    starts_at[i + 1 + end] = 1;
  }
  int64_t started = 0;  // sections that start before p
  for (int64_t p = 0; p < size; p += W) {
    const Index starts = load<W>(starts_at + p), count = prefix_sum<int32_t, W>(starts);
    const Index section = count - broadcast<0, int32_t, W>(starts), sample = lane_numbers<int32_t, W>() - section;
    const int64_t i = started - 1 + starts_at[p], k = p - i - 1;  // of lane 0
    const Vec<T, W> start = permute(load<W>(row.t + i), section);
    const Vec<T, W> x =
        interpolate(permute(load<W>(row.u + k), sample), permute(load<W>(row.cdf + i), section),
                    permute(load<W>(row.slope + i), section), start, permute(load<W>(row.t + i + 1), section));
    store(row.out + p, starts != 0 ? start : x);
    started += count[W - 1];
  }
}

// The numbers themselves as a heap; NaN is the largest.
template <typename T>
struct NumberHeap {
  T* x;
  T get(int64_t i) const { return x[i]; }
  void set(int64_t i, T entry) const { x[i] = entry; }
  static bool less(T a, T b) { return a < b || (b != b && a == a); }
};

// The merged row of t and of the new samples, which stand in `row` behind the place of t.
template <typename T>
static __attribute__((noinline)) void merge_any(const T* t, int64_t num_samples, int64_t num_new, T* row, T* merged) {
  const T* added = row + num_samples;
  if (ascending(t, num_samples) && ascending(added, num_new)) {
    for (int64_t i = 0, k = 0; i + k < num_samples + num_new;) {
      const bool old = k == num_new || (i < num_samples && !(added[k] < t[i]));
      merged[i + k] = old ? t[i] : added[k];
      i += old;
      k += !old;
    }
    return;
  }
  for (int64_t i = 0; i < num_samples; ++i) row[i] = t[i];
  const NumberHeap<T> heap{row};  // a heap sort is in place, and fast for any order
  make_heap(heap, num_samples + num_new);
  sort_heap(heap, num_samples + num_new);
  for (int64_t i = 0; i < num_samples + num_new; ++i) merged[i] = row[i];
}

template <typename T>
static inline void prefetch(const T* row, int64_t n) {
  for (int64_t i = 0; i < n; i += 64 / int64_t(sizeof(T))) __builtin_prefetch(row + i);
}

template <typename T>
static void resample_exact(const SamplePdfArgs<T>& a, T* merged, T* scratch, int32_t* int_scratch, int64_t begin,
                           int64_t end) {
  const Row<T> row = make_row(a, scratch, int_scratch);
  // Whether a section starts at each place of the merged row; lies over what the search would need.
  int32_t* starts_at = row.low + row.size;
  const int64_t out_size = a.num_edges + a.num_new;
  Positions<T> positions{};
  for (int64_t ray = begin; ray < end; ++ray) {
    if (a.u_stride != 0 || ray == begin) positions = read_positions(a.u + ray * a.u_stride, a.num_new, row.u);
    if (ray + 1 < end) {
      prefetch(a.edges + (ray + 1) * a.num_edges, a.num_edges);
      prefetch(a.weights + (ray + 1) * a.weight_stride, a.weight_stride);
      prefetch(a.u + (ray + 1) * a.u_stride, a.u_stride);
    }
    read_ranges(a.edges + ray * a.num_edges, row);
    const bool has_cdf = distribution(a.weights + ray * a.weight_stride, row);
    const bool in_order = ascending(row.t, row.size + 1) && row.t[0] >= -Limits<T>::largest &&
                          row.t[row.size] <= Limits<T>::largest && positions.spread != Spread::kOther;
    T* __restrict out = merged + ray * out_size;
    if (has_cdf && in_order) {
      section_ends(positions, a.num_new, row);
      section_slopes(row);
      if constexpr (kPermute && sizeof(T) == 4) {
        merge_permuted(a.num_new, row, starts_at);
      } else {
        merge(a.num_new, row);
      }
      const T* __restrict from = row.out;
      for (int64_t i = 0; i < out_size; ++i) out[i] = from[i];
    } else {
      exact_samples(has_cdf, a.num_new, row, row.out + a.num_edges);
      merge_any(row.t, a.num_edges, a.num_new, row.out, out);
    }
  }
}

template <typename T>
static void resample_published(const SamplePdfArgs<T>& a, T* merged, T* scratch, int32_t* int_scratch, int64_t begin,
                               int64_t end) {
  const Row<T> row = make_row(a, scratch, int_scratch);
  for (int64_t ray = begin; ray < end; ++ray) {
    const T* u = a.u + ray * a.u_stride;
    for (int64_t k = 0; k < a.num_new; ++k) row.u[k] = u[k];
    read_ranges(a.edges + ray * a.num_edges, row);
    published_distribution(a.rule, a.weights + ray * a.weight_stride, row);
    published_samples(a.rule, a.num_new, row, row.out + a.num_edges);
    merge_any(row.t, a.num_edges, a.num_new, row.out, merged + ray * (a.num_edges + a.num_new));
  }
}

template <typename T>
static void resample(const SamplePdfArgs<T>& a, T* merged, T* scratch, int32_t* int_scratch, int64_t begin,
                     int64_t end) {
  const auto run = a.rule.mode == PdfMode::kExact ? resample_exact<T> : resample_published<T>;
  run(a, merged, scratch, int_scratch, begin, end);
}

}  // namespace

const SamplePdfKernels<float> resample_rays_f32 = {scratch_size<float>, int_scratch_size<float>, resample<float>};
const SamplePdfKernels<double> resample_rays_f64 = {scratch_size<double>, int_scratch_size<double>, resample<double>};

}  // namespace pred::PRED_ISA
