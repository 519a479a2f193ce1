// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <stdint.h>

namespace pred {

// Bits that hold the numbers 0 .. count - 1.
inline int bits_for(int64_t count) {
  int bits = 0;
  while (bits < 63 && (int64_t(1) << bits) < count) ++bits;
  return bits;
}

}  // namespace pred
