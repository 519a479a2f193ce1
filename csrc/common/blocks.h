// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Rows in blocks whose bounds depend on the number of rows alone, so that sums made block by block have the same bits
// for any number of threads.
#pragma once

#include <algorithm>
#include <cstdint>

#include "common/parallel.h"
#include "common/tile.h"

namespace pred {

struct Blocks {
  int64_t rows, size;

  int64_t count() const { return (rows + size - 1) / size; }
  int64_t begin(int64_t block) const { return block * size; }
  int64_t end(int64_t block) const { return std::min(rows, (block + 1) * size); }
};

// Whole tiles, which are cut alike whoever cuts them. Tasks write their own rows only; blocks have sums of their own,
// all of which are held, in kHeldBytes or in eight blocks.
inline Blocks product_tasks(int64_t rows) { return {rows, 10 * kRowTile}; }
inline Blocks product_sums(int64_t rows, int64_t bytes_per_block) {
  constexpr int64_t kLeast = 20 * kRowTile, kHeldBytes = int64_t(256) << 20;
  const int64_t blocks = std::clamp<int64_t>(kHeldBytes / std::max<int64_t>(1, bytes_per_block), 8, 64);
  return {rows, std::max<int64_t>(1, (rows + kLeast * blocks - 1) / (kLeast * blocks)) * kLeast};
}

// out[row, column] = the sum over blocks, in order, of sums[block * block_stride + row * row_stride + column].
template <typename T>
void add_blocks(const T* sums, int64_t num_blocks, int64_t block_stride, int64_t rows, int64_t row_stride,
                int64_t columns, T* out) {
  parallel(rows, 16, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      T* __restrict sum = out + row * columns;
      std::fill(sum, sum + columns, T(0));
      for (int64_t block = 0; block < num_blocks; ++block) {
        const T* __restrict part = sums + block * block_stride + row * row_stride;
        for (int64_t column = 0; column < columns; ++column) sum[column] += part[column];
      }
    }
  });
}

}  // namespace pred
