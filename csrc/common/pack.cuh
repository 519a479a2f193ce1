// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Neighbouring values that one access moves, 16 bytes at most.
#pragma once

#include <type_traits>

#include "common/launch.cuh"
#include "math/half.h"

namespace pred::PRED_ISA {
namespace {

template <typename S, int V>
struct alignas(V * sizeof(S)) Pack {
  S x[V];
};

// value[v] = from[v], or 0 where there is none.
template <int V, typename S>
PRED_DEVICE_ONLY void load_pack(const S* from, Compute<S> (&value)[V]) {
  Pack<S, V> pack;
  if (from) pack = *reinterpret_cast<const Pack<S, V>*>(from);
#pragma unroll
  for (int v = 0; v < V; ++v) value[v] = from ? widen(pack.x[v]) : Compute<S>(0);
}

// value[v] = from[v], of memory that the kernel does not write, so that loads may go ahead of stores.
template <int V, typename S>
PRED_DEVICE_ONLY void read_pack(const S* from, Compute<S> (&value)[V]) {
  Pack<S, V> pack;
#ifdef __CUDA_ARCH__
  using Small = std::conditional_t<sizeof(pack) == 2, unsigned short, unsigned>;
  using Word = std::conditional_t<sizeof(pack) <= 4, Small, std::conditional_t<sizeof(pack) == 8, uint2, uint4>>;
  static_assert(sizeof(Word) == sizeof(pack));
  const Word word = __ldg(reinterpret_cast<const Word*>(from));
  __builtin_memcpy(&pack, &word, sizeof word);
#else
  pack = *reinterpret_cast<const Pack<S, V>*>(from);
#endif
#pragma unroll
  for (int v = 0; v < V; ++v) value[v] = widen(pack.x[v]);
}

// The same, or 0 where there is none.
template <int V, typename S>
PRED_DEVICE_ONLY void load_constant_pack(const S* from, Compute<S> (&value)[V]) {
  if (from) {
    read_pack<V>(from, value);
  } else {
#pragma unroll
    for (int v = 0; v < V; ++v) value[v] = Compute<S>(0);
  }
}

// to[v] = value[v]
template <int V, typename S>
PRED_DEVICE_ONLY void store_pack(S* to, const Compute<S> (&value)[V]) {
  Pack<S, V> pack;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  if constexpr (sizeof(S) == 2 && V % 2 == 0) {
#pragma unroll
    for (int v = 0; v < V; v += 2) {
      const uint32_t both = narrow_pair(S{}, value[v], value[v + 1]);
      __builtin_memcpy(pack.x + v, &both, sizeof both);
    }
  } else
#endif
  {
#pragma unroll
    for (int v = 0; v < V; ++v) pack.x[v] = narrow<S>(value[v]);
  }
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(pack) >= 8) {  // an assignment may become a store of each value
    constexpr int kWords = sizeof(pack) / 4;
    uint32_t word[kWords];
    __builtin_memcpy(word, &pack, sizeof pack);
    const size_t address = __cvta_generic_to_global(to);
    if constexpr (kWords == 2) {
      asm volatile("st.global.v2.b32 [%0], {%1, %2};" ::"l"(address), "r"(word[0]), "r"(word[1]) : "memory");
    } else {
#pragma unroll
      for (int i = 0; i < kWords; i += 4) {
        asm volatile("st.global.v4.b32 [%0], {%1, %2, %3, %4};" ::"l"(address + 4 * i), "r"(word[i]), "r"(word[i + 1]),
                     "r"(word[i + 2]), "r"(word[i + 3])
                     : "memory");
      }
    }
    return;
  }
#endif
  *reinterpret_cast<Pack<S, V>*>(to) = pack;
}

}  // namespace
}  // namespace pred::PRED_ISA
