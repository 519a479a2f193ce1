// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Matrix products on tiles that stay in cache, with epilogues on the accumulators. CPU kernels only.
//
// Operands are stored as S and accumulated as T = Compute<S>. Bfloat16 operands are multiplied in pairs of consecutive
// k, by the dot-product instruction where there is one, and by two multiply-adds of the widened halves where there is
// not; the second factor is packed with the pairs side by side.
#pragma once

#include <type_traits>

#include "math/half_lanes.h"

namespace pred::PRED_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kTileRows = 12;  // 24 of 32 registers accumulate
#else
constexpr int kTileRows = 6;  // 12 of 16
#endif

template <typename S>
constexpr int kPair = std::is_same_v<S, BFloat16> ? 2 : 1;

// Columns of one panel of a packed matrix.
template <typename T>
constexpr int kPanel = 2 * kWidth<T>;

template <typename T>
static inline int64_t panel_columns(int64_t columns) {
  return (columns + kPanel<T> - 1) / kPanel<T> * kPanel<T>;
}

template <typename S>
static inline int64_t paired(int64_t k) {
  return (k + kPair<S> - 1) / kPair<S> * kPair<S>;
}

template <typename S>
static inline int64_t packed_size(int64_t k, int64_t columns) {
  return paired<S>(k) * panel_columns<Compute<S>>(columns);
}

// B[k, n] = from[k row_stride + n column_stride] as panels [n / kPanel][k / kPair][kPanel][kPair], padded by zeros.
template <typename S>
static void pack(const Compute<S>* from, int64_t row_stride, int64_t column_stride, int64_t rows, int64_t columns,
                 S* to) {
  using T = Compute<S>;
  constexpr int P = kPair<S>;
  for (int64_t first = 0; first < columns; first += kPanel<T>) {
    for (int64_t k = 0; k < rows; k += P) {
      for (int64_t n = first; n < first + kPanel<T>; ++n) {
        for (int64_t p = k; p < k + P; ++p) {
          const bool inside = n < columns && p < rows;
          narrow_to(*to++, inside ? from[p * row_stride + n * column_stride] : T(0));
        }
      }
    }
  }
}

// One number of A, or a pair, for every lane.
template <typename S>
static inline __attribute__((always_inline)) auto spread(const S* from) {
  if constexpr (std::is_same_v<S, BFloat16>) {
    int32_t pair;
    __builtin_memcpy(&pair, from, sizeof pair);
    return splat<kWidth<float>>(pair);
  } else {
    return splat<kWidth<S>>(*from);
  }
}

// sum += a b, where both hold one number per lane, or a pair.
template <typename V>
static inline __attribute__((always_inline)) V multiply_add(V sum, V a, V b) {
  return sum + a * b;
}

using Pairs = Vec<int32_t, kWidth<float>>;
using Floats = Vec<float, kWidth<float>>;
static inline __attribute__((always_inline)) Floats multiply_add(Floats sum, Pairs a, Pairs b) {
#if defined(__AVX512BF16__)
  return _mm512_dpbf16_ps(sum, (__m512bh)a, (__m512bh)b);
#else
  const Pairs high = splat<kWidth<float>>(int32_t(0xffff0000));
  sum += (Floats)(a & high) * (Floats)(b & high);
  return sum + (Floats)(a << 16) * (Floats)(b << 16);
#endif
}

// A vector of a packed matrix: kWidth columns, or pairs of them.
template <typename S>
static inline __attribute__((always_inline)) auto load_packed(const S* from) {
  using T = Compute<S>;
  using V = std::conditional_t<std::is_same_v<S, BFloat16>, Pairs, Vec<T, kWidth<T>>>;
  V v;
  __builtin_memcpy(&v, from, sizeof v);
  return v;
}

// As store_values, for rows that products read. Where there is a dot-product instruction, which takes subnormal
// bfloat16 for 0, they are stored as 0.
template <int N, typename S>
static inline __attribute__((always_inline)) void store_factors(S* to, Vec<Compute<S>, N> values) {
#if defined(__AVX512BF16__)
  if constexpr (std::is_same_v<S, BFloat16> && N == 16) {
    const __m256bh rounded = _mm512_cvtneps_pbh(values);
    __builtin_memcpy(to, &rounded, sizeof rounded);
    return;
  }
#endif
  store_values<N>(to, values);
}

template <int kRows, typename S, class Epilogue>
static inline void product_tile(const S* a, int64_t a_stride, int64_t k, const S* b, int64_t row, int64_t column,
                                const Epilogue& epilogue) {
  using T = Compute<S>;
  constexpr int W = kWidth<T>, P = kPair<S>;
  Vec<T, W> sum[kRows][2] = {};
  for (int64_t i = 0; i < k; i += P) {
    const auto left = load_packed(b), right = load_packed(b + W * P);
    b += 2 * W * P;
#pragma GCC unroll 16
    for (int r = 0; r < kRows; ++r) {
      const auto factor = spread(a + r * a_stride + i);
      sum[r][0] = multiply_add(sum[r][0], factor, left);
      sum[r][1] = multiply_add(sum[r][1], factor, right);
    }
  }
  for (int r = 0; r < kRows; ++r) {
    epilogue(row + r, column, sum[r][0]);
    epilogue(row + r, column + W, sum[r][1]);
  }
}

// epilogue(row, column, vector of (A B)[row, column ...]) for all rows of A and all columns of the packed B, those that
// pad its last panel included. Rows of A have paired<S>(k) elements.
template <typename S, class Epilogue>
static inline void product(const S* a, int64_t a_stride, int64_t rows, int64_t k, const S* b, int64_t columns,
                           const Epilogue& epilogue) {
  using T = Compute<S>;
  for (int64_t column = 0; column < columns; column += kPanel<T>) {
    const S* panel = b + column * paired<S>(k);
    int64_t row = 0;
    for (; row + kTileRows <= rows; row += kTileRows) {
      product_tile<kTileRows>(a + row * a_stride, a_stride, k, panel, row, column, epilogue);
    }
    constexpr int kFew = 4;
    for (; row + kFew <= rows; row += kFew) {
      product_tile<kFew>(a + row * a_stride, a_stride, k, panel, row, column, epilogue);
    }
    for (; row < rows; ++row) product_tile<1>(a + row * a_stride, a_stride, k, panel, row, column, epilogue);
  }
}

// Rows of whole panels as outer_product wants them: bfloat16 as [(count + 1) / 2][stride][2], with zeros where a row is
// missing.
template <typename S>
static const S* interleave(const S* rows, int64_t stride, int64_t count, S* buffer) {
  if constexpr (kPair<S> == 1) {
    return rows;
  } else {
    constexpr int W = kWidth<float>;
    for (int64_t r = 0; r < count; r += 2) {
      const S* first = rows + r * stride;
      for (int64_t c = 0; c < stride; c += W) {
        Vec<uint16_t, W> low, high{};
        __builtin_memcpy(&low, first + c, sizeof low);
        if (r + 1 < count) __builtin_memcpy(&high, first + stride + c, sizeof high);
        using Both = Vec<uint32_t, W>;
        const Both both = __builtin_convertvector(low, Both) | __builtin_convertvector(high, Both) << 16;
        __builtin_memcpy(buffer + r * stride + 2 * c, &both, sizeof both);
      }
    }
    return buffer;
  }
}

template <int kRows, typename S>
static inline void outer_tile(const S* a, int64_t a_stride, const S* b, int64_t b_stride, int64_t samples,
                              Compute<S>* sum, int64_t sum_stride) {
  using T = Compute<S>;
  constexpr int W = kWidth<T>, P = kPair<S>;
  Vec<T, W> tile[kRows][2] = {};
  for (int64_t i = 0; i < samples; i += P) {
    const auto left = load_packed(b), right = load_packed(b + W * P);
#pragma GCC unroll 16
    for (int r = 0; r < kRows; ++r) {
      const auto factor = spread(a + r * P);
      tile[r][0] = multiply_add(tile[r][0], factor, left);
      tile[r][1] = multiply_add(tile[r][1], factor, right);
    }
    a += a_stride * P;
    b += b_stride * P;
  }
  // Added at the end, so that sums of many tiles lose no more digits than those of as many numbers.
  for (int r = 0; r < kRows; ++r) {
    T* to = sum + r * sum_stride;
    store(to, load<W>(to) + tile[r][0]);
    store(to + W, load<W>(to + W) + tile[r][1]);
  }
}

// sum[m, n] += sum_i a[i, m] b[i, n]: m < rows; n < columns, a multiple of kPanel. Both are interleaved.
template <typename S>
static inline void outer_product(const S* a, int64_t a_stride, int64_t rows, const S* b, int64_t b_stride,
                                 int64_t columns, int64_t samples, Compute<S>* sum, int64_t sum_stride) {
  using T = Compute<S>;
  constexpr int P = kPair<S>;
  for (int64_t column = 0; column < columns; column += kPanel<T>) {
    const S* panel = b + column * P;
    T* to = sum + column;
    int64_t row = 0;
    for (; row + kTileRows <= rows; row += kTileRows) {
      outer_tile<kTileRows>(a + row * P, a_stride, panel, b_stride, samples, to + row * sum_stride, sum_stride);
    }
    constexpr int kFew = 4;
    for (; row + kFew <= rows; row += kFew) {
      outer_tile<kFew>(a + row * P, a_stride, panel, b_stride, samples, to + row * sum_stride, sum_stride);
    }
    for (; row < rows; ++row) {
      outer_tile<1>(a + row * P, a_stride, panel, b_stride, samples, to + row * sum_stride, sum_stride);
    }
  }
}

}  // namespace
}  // namespace pred::PRED_ISA
