// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's row only.
//
// The row is assembled in scratch as whole vectors: section by section, each overwriting the surplus of the one before,
// or vector by vector where lanes can be permuted. Rays whose t or u are out of order or not finite take the slow path:
// search, then sort.
#include "math/lanes.h"
#include "ops/resample_rays.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kPad = 16;  // at least a vector, on both sides of every row

static inline int64_t padded(int64_t n) { return (n + kPad - 1) / kPad * kPad; }

// `narrowest`: a section less probable counts as empty, so that slopes stay finite.
template <typename T>
struct Limits;
template <>
struct Limits<float> {
  static constexpr float smallest = __FLT_MIN__, largest = __FLT_MAX__, below_one = 1.0f - __FLT_EPSILON__ / 2;
  static constexpr float narrowest = 1e-30f;
};
template <>
struct Limits<double> {
  static constexpr double smallest = __DBL_MIN__, largest = __DBL_MAX__, below_one = 1.0 - __DBL_EPSILON__ / 2;
  static constexpr double narrowest = 1e-300;
};

// Scratch rows of one ray, with room for a vector on both sides. Sections are padded to whole vectors, by empty ones
// at the end.
template <typename T>
struct Row {
  int64_t sections, size;  // size: padded
  T *t, *mass, *cdf, *slope, *u, *merged;
  int32_t* end;     // [size] c_{i+1}
  int32_t* starts;  // [S + num_new + kPad] 1 where a section starts in the merged row, else 0
};

template <typename T>
static int64_t scratch_size(const ResampleRaysArgs<T>& a) {
  return 5 * (padded(a.num_samples) + 2 * kPad) + 2 * (a.num_new + 2 * kPad);
}

template <typename T>
static int64_t int_scratch_size(const ResampleRaysArgs<T>& a) {
  return padded(a.num_samples - 1) + a.num_samples + a.num_new + kPad;
}

template <typename T>
static Row<T> make_row(const ResampleRaysArgs<T>& a, T* scratch, int32_t* int_scratch) {
  const int64_t sections = a.num_samples - 1, size = padded(sections), stride = size + 2 * kPad;
  T* first = scratch + kPad;
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
          int_scratch + size};
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

// Clips u to [0, 1); keeps NaN.
template <typename T>
static inline Positions<T> read_positions(const T* __restrict from, int64_t n, T* __restrict to) {
  for (int64_t i = 0; i < n; ++i) {
    const T low = from[i] < T(0) ? T(0) : from[i];
    to[i] = low > Limits<T>::below_one ? Limits<T>::below_one : low;
  }
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

// row.end[i] = c_{i+1}, the number of samples with u < cdf_{i+1}; the last is num_new. Up to rounding: a sample that
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
      row.end[i] = below + (T(below) < place ? 1 : 0);
    }
  } else if (positions.spread == Spread::kEven) {  // all u before the place of cdf_{i+1} are below it, none after it
    for (int64_t i = 0; i < row.size; ++i) {
      const int32_t place = int32_t(cdf[i + 1] * T(num_new));
      row.end[i] = place + (u[place] < cdf[i + 1] ? 1 : 0);
    }
  } else {
    int32_t end = 0;
    for (int64_t i = 0; i < row.sections; ++i) {
      while (u[end] < cdf[i + 1]) ++end;
      row.end[i] = end;
    }
  }
  row.end[row.sections - 1] = int32_t(num_new);
}

template <typename T>
static inline void section_slopes(const Row<T>& row) {
  const T* __restrict t = row.t, * __restrict cdf = row.cdf;
  T* __restrict slope = row.slope;
  for (int64_t i = 0; i < row.size; ++i) {
    const T width = cdf[i + 1] - cdf[i];
    slope[i] = width >= Limits<T>::narrowest ? (t[i + 1] - t[i]) / width : T(0);
  }
}

// Where u lies in a section. u below it, which is that of the sample before, becomes the section's start.
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
    const int64_t end = row.end[i] > begin ? row.end[i] : begin;
    for (int64_t k = begin - 1; k < end; k += W) {
      store(row.merged + i + 1 + k, interpolate(load<W>(row.u + k), splat<W>(row.cdf[i]), splat<W>(row.slope[i]),
                                                splat<W>(row.t[i]), splat<W>(row.t[i + 1])));
    }
    begin = end;
  }
  row.merged[row.sections + num_new] = row.t[row.sections];
}

// The same, a vector of the merged row at a time: what its lanes need of sections and of u is in two windows.
template <typename T>
static inline void merge_permuted(int64_t num_new, const Row<T>& row) {
  constexpr int W = kWidth<T>;
  using Index = Vec<int32_t, W>;
  const int64_t size = row.sections + 1 + num_new;
  for (int64_t p = 0; p < size + W; ++p) row.starts[p] = 0;
  row.starts[0] = 1;
  int32_t end = 0;
  for (int64_t i = 0; i < row.sections; ++i) {
    end = row.end[i] > end ? row.end[i] : end;
    row.starts[i + 1 + end] = 1;
  }
  int64_t started = 0;  // sections that start before p
  for (int64_t p = 0; p < size; p += W) {
    const Index starts = load<W>(row.starts + p), count = prefix_sum<int32_t, W>(starts);
    const Index section = count - broadcast<0, int32_t, W>(starts), sample = lane_numbers<int32_t, W>() - section;
    const int64_t i = started - 1 + row.starts[p], k = p - i - 1;  // of lane 0
    store(row.merged + p, interpolate(permute(load<W>(row.u + k), sample), permute(load<W>(row.cdf + i), section),
                                      permute(load<W>(row.slope + i), section), permute(load<W>(row.t + i), section),
                                      permute(load<W>(row.t + i + 1), section)));
    started += count[W - 1];
  }
}

template <typename T>
static inline bool sorts_after(T a, T b) {
  return a > b || (a != a && b == b);  // NaN last
}

// Heap sort: in place, and fast for any order.
template <typename T>
static void sort(T* x, int64_t n) {
  for (int64_t top = n / 2 - 1, last = n; last > 1;) {
    if (top < 0) {  // the heap stands: move its largest to the end
      --last;
      const T largest = x[0];
      x[0] = x[last];
      x[last] = largest;
    }
    int64_t at = top < 0 ? 0 : top;
    for (int64_t child; (child = 2 * at + 1) < last; at = child) {
      if (child + 1 < last && sorts_after(x[child + 1], x[child])) ++child;
      if (!sorts_after(x[child], x[at])) break;
      const T swap = x[at];
      x[at] = x[child];
      x[child] = swap;
    }
    if (top >= 0) --top;
  }
}

template <typename T>
static void merge_any(int64_t num_new, bool has_cdf, const Row<T>& row) {
  const T *t = row.t, *cdf = row.cdf;
  const int64_t num_samples = row.sections + 1;
  for (int64_t i = 0; i < num_samples; ++i) row.merged[i] = t[i];
  for (int64_t k = 0; k < num_new; ++k) {
    const T u = row.u[k];
    int64_t low = 0, high = row.sections;  // the section is in [low, high)
    while (high - low > 1) {
      const int64_t middle = low + (high - low) / 2;
      (cdf[middle] <= u ? low : high) = middle;
    }
    const T width = cdf[low + 1] - cdf[low];
    const T fraction = (u - cdf[low]) / (width > T(0) ? width : T(1));
    row.merged[num_samples + k] = has_cdf ? t[low] + fraction * (t[low + 1] - t[low]) : T(__builtin_nan(""));
  }
  sort(row.merged, num_samples + num_new);
}

template <typename T>
static inline void prefetch(const T* row, int64_t n) {
  for (int64_t i = 0; i < n; i += 64 / int64_t(sizeof(T))) __builtin_prefetch(row + i);
}

template <typename T>
static void resample(const ResampleRaysArgs<T>& a, T* merged, T* scratch, int32_t* int_scratch, int64_t begin,
                     int64_t end) {
  const Row<T> row = make_row(a, scratch, int_scratch);
  const int64_t out_size = a.num_samples + a.num_new;
  Positions<T> positions{};
  for (int64_t ray = begin; ray < end; ++ray) {
    if (a.u_stride != 0 || ray == begin) positions = read_positions(a.u + ray * a.u_stride, a.num_new, row.u);
    if (ray + 1 < end) {
      prefetch(a.t + (ray + 1) * a.num_samples, a.num_samples);
      prefetch(a.weights + (ray + 1) * a.weight_stride, a.weight_stride);
      prefetch(a.u + (ray + 1) * a.u_stride, a.u_stride);
    }
    read_ranges(a.t + ray * a.num_samples, row);
    const bool has_cdf = distribution(a.weights + ray * a.weight_stride, row);
    const bool in_order = ascending(row.t, row.size + 1) && row.t[0] >= -Limits<T>::largest &&
                          row.t[row.size] <= Limits<T>::largest && positions.spread != Spread::kOther;
    if (has_cdf && in_order) {
      section_ends(positions, a.num_new, row);
      section_slopes(row);
      if constexpr (kPermute && sizeof(T) == 4) {
        merge_permuted(a.num_new, row);
      } else {
        merge(a.num_new, row);
      }
    } else {
      merge_any(a.num_new, has_cdf, row);
    }
    T* __restrict out = merged + ray * out_size;
    const T* __restrict from = row.merged;
    for (int64_t i = 0; i < out_size; ++i) out[i] = from[i];
  }
}

}  // namespace

const ResampleRaysKernels<float> resample_rays_f32 = {scratch_size<float>, int_scratch_size<float>, resample<float>};
const ResampleRaysKernels<double> resample_rays_f64 = {scratch_size<double>, int_scratch_size<double>,
                                                       resample<double>};

}  // namespace pred::PRED_ISA
