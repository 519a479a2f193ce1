// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Explicit vectors for what the compiler does not vectorise by itself: scans, sums in a fixed order and
// small matrix products. CPU kernels only; the width is that of the level being compiled.
#pragma once

#include <stdint.h>

#include <utility>

#include "common/intrinsics.h"

namespace pred::PRED_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <typename T>
constexpr int kWidth = kVectorBytes / int(sizeof(T));

template <typename T, int N>
struct VecOf {
  typedef T type __attribute__((vector_size(N * sizeof(T))));
};
template <typename T>
struct VecOf<T, 1> {
  typedef T type;
};
template <typename T, int N>
using Vec = typename VecOf<T, N>::type;

template <int Bytes>
struct IntOf {
  using type = int32_t;
};
template <>
struct IntOf<8> {
  using type = int64_t;
};
template <typename T, int N>
using Mask = Vec<typename IntOf<sizeof(T)>::type, N>;

template <int N, typename T>
inline __attribute__((always_inline)) Vec<T, N> load(const T* from) {
  Vec<T, N> v;
  __builtin_memcpy(&v, from, sizeof v);
  return v;
}

template <typename T, typename V>
inline __attribute__((always_inline)) void store(T* to, V v) {
  __builtin_memcpy(to, &v, sizeof v);
}

template <typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> lane_numbers(std::integer_sequence<int, I...>) {
  return Vec<T, N>{I...};
}

// 0, 1, 2, ...
template <typename T, int N>
inline __attribute__((always_inline)) Vec<T, N> lane_numbers() {
  return lane_numbers<T, N>(std::make_integer_sequence<int, N>());
}

template <int N, typename T>
inline __attribute__((always_inline)) Vec<T, N> splat(T x) {
  return x - Vec<T, N>{};
}

template <typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> shuffle(Vec<T, N> a, Vec<T, N> b) {
#ifdef __clang__
  return __builtin_shufflevector(a, b, I...);
#else
  return __builtin_shuffle(a, b, Mask<T, N>{I...});
#endif
}

template <int K, typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> shift_up(Vec<T, N> v, Vec<T, N> fill,
                                                         std::integer_sequence<int, I...>) {
  return shuffle<T, N, (I < K ? N + I : I - K)...>(v, fill);
}

// Lane i gets lane i - K of v; the first K lanes are fill's, all of whose lanes are equal.
template <int K, typename T, int N>
inline __attribute__((always_inline)) Vec<T, N> shift_up(Vec<T, N> v, Vec<T, N> fill) {
#if defined(__AVX512F__)  // one instruction, which the compiler does not find
  if constexpr (N == 16 && sizeof(T) == 4) return (Vec<T, N>)_mm512_alignr_epi32((__m512i)v, (__m512i)fill, N - K);
  if constexpr (N == 8 && sizeof(T) == 8) return (Vec<T, N>)_mm512_alignr_epi64((__m512i)v, (__m512i)fill, N - K);
#endif
  return shift_up<K, T, N>(v, fill, std::make_integer_sequence<int, N>());
}

template <int K, typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> shift_down(Vec<T, N> v, Vec<T, N> fill,
                                                           std::integer_sequence<int, I...>) {
  return shuffle<T, N, (I + K < N ? I + K : N + I)...>(v, fill);
}

// Lane i gets lane i + K of v; the last K lanes are fill's, all of whose lanes are equal.
template <int K, typename T, int N>
inline __attribute__((always_inline)) Vec<T, N> shift_down(Vec<T, N> v, Vec<T, N> fill) {
#if defined(__AVX512F__)
  if constexpr (N == 16 && sizeof(T) == 4) return (Vec<T, N>)_mm512_alignr_epi32((__m512i)fill, (__m512i)v, K);
  if constexpr (N == 8 && sizeof(T) == 8) return (Vec<T, N>)_mm512_alignr_epi64((__m512i)fill, (__m512i)v, K);
#endif
  return shift_down<K, T, N>(v, fill, std::make_integer_sequence<int, N>());
}

template <int Lane, typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> broadcast(Vec<T, N> v, std::integer_sequence<int, I...>) {
  return shuffle<T, N, (I * 0 + Lane)...>(v, v);
}

// Every lane gets lane `Lane` of v.
template <int Lane, typename T, int N>
inline __attribute__((always_inline)) Vec<T, N> broadcast(Vec<T, N> v) {
  return broadcast<Lane, T, N>(v, std::make_integer_sequence<int, N>());
}

// Lane i gets lane index[i] of v. Where this is one instruction; kPermute says so.
#if defined(__AVX512F__)
constexpr bool kPermute = true;
inline __attribute__((always_inline)) Vec<float, 16> permute(Vec<float, 16> v, Vec<int32_t, 16> index) {
  return _mm512_permutexvar_ps((__m512i)index, v);
}
#elif defined(__AVX2__)
constexpr bool kPermute = true;
inline __attribute__((always_inline)) Vec<float, 8> permute(Vec<float, 8> v, Vec<int32_t, 8> index) {
  return _mm256_permutevar8x32_ps(v, (__m256i)index);
}
#else
constexpr bool kPermute = false;
#endif

// Inclusive scans within a vector.
template <typename T, int N, int K = 1>
inline __attribute__((always_inline)) Vec<T, N> prefix_product(Vec<T, N> v) {
  if constexpr (K < N)
    return prefix_product<T, N, 2 * K>(v * shift_up<K, T, N>(v, splat<N>(T(1))));
  else
    return v;
}

template <typename T, int N, int K = 1>
inline __attribute__((always_inline)) Vec<T, N> prefix_sum(Vec<T, N> v) {
  if constexpr (K < N)
    return prefix_sum<T, N, 2 * K>(v + shift_up<K, T, N>(v, Vec<T, N>{}));
  else
    return v;
}

template <typename T, int N, int K = 1>
inline __attribute__((always_inline)) Vec<T, N> suffix_sum(Vec<T, N> v) {
  if constexpr (K < N)
    return suffix_sum<T, N, 2 * K>(v + shift_down<K, T, N>(v, Vec<T, N>{}));
  else
    return v;
}

// Copies past the caches, for results too large to stay there: saves reading the destination. Whole lines only; the
// ends of the row are stored as usual. fence_stream() must follow before another thread may read.
template <typename T>
inline void stream_row(const T* __restrict from, T* __restrict to, int64_t n) {
  int64_t i = 0;
#if defined(__SSE2__)
  constexpr int64_t line = 64 / int64_t(sizeof(T));
  for (; i < n && (uintptr_t)(to + i) % 64 != 0; ++i) to[i] = from[i];
  for (; i + line <= n; i += line) {
    for (int64_t k = 0; k < line; k += kWidth<T>) {
      const auto v = load<kWidth<T>>(from + i + k);
#if defined(__AVX512F__)
      _mm512_stream_si512((__m512i*)(to + i + k), (__m512i)v);
#elif defined(__AVX2__)
      _mm256_stream_si256((__m256i*)(to + i + k), (__m256i)v);
#else
      _mm_stream_si128((__m128i*)(to + i + k), (__m128i)v);
#endif
    }
  }
#endif
  for (; i < n; ++i) to[i] = from[i];
}

static inline void fence_stream() {
#if defined(__SSE2__)
  _mm_sfence();
#endif
}

// As many elements as a vector has doubles, to and from double.
inline __attribute__((always_inline)) Vec<double, kWidth<double>> load_wide(const double* from) {
  return load<kWidth<double>>(from);
}
inline __attribute__((always_inline)) void store_narrow(double* to, Vec<double, kWidth<double>> v) { store(to, v); }

inline __attribute__((always_inline)) Vec<double, kWidth<double>> load_wide(const float* from) {
#if defined(__AVX512F__)
  return _mm512_cvtps_pd(_mm256_loadu_ps(from));
#elif defined(__AVX2__)
  return _mm256_cvtps_pd(_mm_loadu_ps(from));
#else
  return Vec<double, 2>{from[0], from[1]};
#endif
}
inline __attribute__((always_inline)) void store_narrow(float* to, Vec<double, kWidth<double>> v) {
#if defined(__AVX512F__)
  _mm256_storeu_ps(to, _mm512_cvtpd_ps(v));
#elif defined(__AVX2__)
  _mm_storeu_ps(to, _mm256_cvtpd_ps(v));
#else
  to[0] = float(v[0]);
  to[1] = float(v[1]);
#endif
}

// Pairwise sum of all lanes.
template <typename T, int N, int K = N / 2>
inline __attribute__((always_inline)) T sum(Vec<T, N> v) {
  if constexpr (K > 0)
    return sum<T, N, K / 2>(v + shift_down<K, T, N>(v, v));
  else
    return v[0];
}

template <int H, typename T, int N, int... I>
inline __attribute__((always_inline)) Vec<T, N> fold(Vec<T, N> a, Vec<T, N> b, std::integer_sequence<int, I...>) {
  return shuffle<T, N, ((I & H) ? N + I - H : I)...>(a, b) + shuffle<T, N, ((I & H) ? N + I : I + H)...>(a, b);
}

// rows[0..N) -> the vector of their N sums, by log2(N) rounds of pairwise folding. Overwrites rows.
template <typename T, int N, int H = 1>
inline __attribute__((always_inline)) Vec<T, N> row_sums(Vec<T, N>* rows) {
  if constexpr (H < N) {
    for (int i = 0; i < N / (2 * H); ++i) {
      rows[i] = fold<H, T, N>(rows[2 * i], rows[2 * i + 1], std::make_integer_sequence<int, N>());
    }
    return row_sums<T, N, 2 * H>(rows);
  } else {
    return rows[0];
  }
}

}  // namespace
}  // namespace pred::PRED_ISA
