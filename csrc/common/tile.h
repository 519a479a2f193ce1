// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <stdint.h>

namespace pred {

// Rows that go through products together, so that they stay in cache: a multiple of every kTileRows (math/product.h).
constexpr int64_t kRowTile = 96;

}  // namespace pred
