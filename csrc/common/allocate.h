// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <new>
#include <type_traits>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace pred {

// Pages of 2 MiB for large memory that is about to be written from end to end: with pages of 4 KiB their first touch
// costs several times the writing. A hint, which the system need not take. Smaller blocks may lie on the heap, which
// would keep the hint when they are freed; glibc maps larger ones by themselves.
inline void prefer_large_pages([[maybe_unused]] void* memory, [[maybe_unused]] int64_t bytes) {
#ifdef MADV_HUGEPAGE
  constexpr int64_t kLarge = int64_t(32) << 20;
  constexpr uintptr_t kPage = uintptr_t(2) << 20;
  if (bytes < kLarge) return;
  const uintptr_t begin = (uintptr_t(memory) + kPage - 1) / kPage * kPage;
  const uintptr_t end = (uintptr_t(memory) + uintptr_t(bytes)) / kPage * kPage;
  madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

// Uninitialised scratch; std::bad_alloc (MemoryError in Python) where memory does not suffice. Not the plain new[],
// which under AddressSanitizer ends the process instead.
template <typename T>
std::unique_ptr<T[]> allocate_array(int64_t count) {
  static_assert(std::is_trivially_default_constructible_v<T> && std::is_trivially_destructible_v<T>);
  std::unique_ptr<T[]> memory(new (std::nothrow) T[count]);
  if (!memory) throw std::bad_alloc();
  prefer_large_pages(memory.get(), count * int64_t(sizeof(T)));
  return memory;
}

template <typename T>
std::unique_ptr<T[]> allocate_zeros(int64_t count) {
  std::unique_ptr<T[]> memory = allocate_array<T>(count);
  std::fill_n(memory.get(), count, T{});
  return memory;
}

// Gives out pieces of a block of memory, which has to have kAlignment bytes more for each and for itself; from null,
// only `at` is of use, their total size.
struct Arena {
  static constexpr int64_t kAlignment = 64;
  uintptr_t at;

  explicit Arena(char* memory) : at(uintptr_t(memory)) {}

  template <typename T>
  T* take(int64_t count) {
    const uintptr_t begin = (at + kAlignment - 1) / kAlignment * kAlignment;
    at = begin + uintptr_t(count) * sizeof(T);
    return (T*)begin;
  }
};

}  // namespace pred
