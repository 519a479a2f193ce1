// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <new>
#include <type_traits>

namespace pred {

// Uninitialised scratch; std::bad_alloc (MemoryError in Python) where memory does not suffice. Not the plain new[],
// which under AddressSanitizer ends the process instead.
template <typename T>
std::unique_ptr<T[]> allocate_array(int64_t count) {
  static_assert(std::is_trivially_default_constructible_v<T> && std::is_trivially_destructible_v<T>);
  std::unique_ptr<T[]> memory(new (std::nothrow) T[count]);
  if (!memory) throw std::bad_alloc();
  return memory;
}

}  // namespace pred
