// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Vectors of stored values: load_values widens S to Compute<S>, store_values rounds back. CPU kernels only.
#pragma once

#include <type_traits>

#include "math/half.h"
#include "math/lanes.h"

namespace pred::PRED_ISA {
namespace {

template <int N, typename S>
inline __attribute__((always_inline)) Vec<Compute<S>, N> load_values(const S* from) {
  if constexpr (std::is_same_v<S, Compute<S>>) {
    return load<N>(from);
  } else if constexpr (N == 1) {
    return widen(*from);
  } else {
#if defined(__F16C__)
    if constexpr (std::is_same_v<S, Float16> && N == 4) return _mm_cvtph_ps(_mm_loadl_epi64((const __m128i*)from));
    if constexpr (std::is_same_v<S, Float16> && N == 8) return _mm256_cvtph_ps(_mm_loadu_si128((const __m128i*)from));
#endif
#if defined(__AVX512F__)
    if constexpr (std::is_same_v<S, Float16> && N == 16) {
      return _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i*)from));
    }
#endif
    using F = Vec<float, N>;
    using U = Vec<uint32_t, N>;
    Vec<uint16_t, N> bits;
    __builtin_memcpy(&bits, from, sizeof bits);
    if constexpr (std::is_same_v<S, BFloat16>) return widen_bfloat16<F>(__builtin_convertvector(bits, U));
    return widen_float16<F>(__builtin_convertvector(bits, U));
  }
}

template <int N, typename S>
inline __attribute__((always_inline)) void store_values(S* to, Vec<Compute<S>, N> values) {
  if constexpr (std::is_same_v<S, Compute<S>>) {
    store(to, values);
  } else if constexpr (N == 1) {
    *to = narrow<S>(values);
  } else {
    Vec<uint16_t, N> bits;
#if defined(__F16C__)
    constexpr int kNearestEven = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;
    if constexpr (std::is_same_v<S, Float16> && N == 4) {
      _mm_storel_epi64((__m128i*)to, _mm_cvtps_ph(values, kNearestEven));
      return;
    }
    if constexpr (std::is_same_v<S, Float16> && N == 8) {
      _mm_storeu_si128((__m128i*)to, _mm256_cvtps_ph(values, kNearestEven));
      return;
    }
#endif
#if defined(__AVX512F__)
    if constexpr (std::is_same_v<S, Float16> && N == 16) {
      _mm256_storeu_si256((__m256i*)to, _mm512_cvtps_ph(values, kNearestEven));
      return;
    }
#endif
    using U = Vec<uint32_t, N>;
    if constexpr (std::is_same_v<S, BFloat16>) {
      bits = __builtin_convertvector(narrow_bfloat16<U>(values), Vec<uint16_t, N>);
    } else {
      bits = __builtin_convertvector(narrow_float16<U>(values), Vec<uint16_t, N>);
    }
    __builtin_memcpy(to, &bits, sizeof bits);
  }
}

}  // namespace
}  // namespace pred::PRED_ISA
