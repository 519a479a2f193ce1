// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Stable sort of rows by an integer key, on torch's thread pool.
//
// An item is one unsigned integer: the row's key in the upper bits, its number in the lower ones. Sorting by
// the key bits alone with a stable sort therefore leaves equal keys in the order of their rows. Each pass of
// the least-significant-digit radix sort has a histogram per block of items; the blocks depend on the number of
// rows only, and one thread owns a block.
#pragma once

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "common/allocate.h"
#include "common/bits.h"
#include "common/check.h"
#include "common/parallel.h"

namespace pred {

template <typename Item>
struct SortedItems {
  std::unique_ptr<Item[]> items;
  int64_t count;

  // One of the blocks into which further passes over the items divide them.
  int64_t num_blocks;
  int64_t block_begin(int64_t block) const { return count * block / num_blocks; }
};

// pack(items, begin, end) -> count writes the items of the rows [begin, end) that take part, in order, from
// `items` on. They are sorted by their bits from row_bits to row_bits + key_bits.
template <typename Item, class Pack>
SortedItems<Item> sort_rows(int64_t num_rows, int row_bits, int key_bits, const Pack& pack) {
  constexpr int64_t kBlock = 32768, kMaxBlocks = 64;
  constexpr int kMaxDigitBits = 14;  // 27 key bits, 0.1 m voxels in the nuScenes range, take two passes
  PRED_CHECK(num_rows < (int64_t(1) << 31), "sort_rows: there must be fewer than 2^31 rows, got ", num_rows);
  int64_t num_blocks = (num_rows + kBlock - 1) / kBlock;
  num_blocks = num_blocks < 1 ? 1 : num_blocks > kMaxBlocks ? kMaxBlocks : num_blocks;

  std::unique_ptr<Item[]> from = allocate_array<Item>(num_rows), to = allocate_array<Item>(num_rows);
  std::vector<int64_t> begin(num_blocks + 1), end(num_blocks);
  for (int64_t block = 0; block <= num_blocks; ++block) begin[block] = num_rows * block / num_blocks;
  parallel(num_blocks, 1, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      end[block] = begin[block] + pack(from.get() + begin[block], begin[block], begin[block + 1]);
    }
  });
  int64_t count = 0;
  for (int64_t block = 0; block < num_blocks; ++block) count += end[block] - begin[block];

  const int num_passes = key_bits <= kMaxDigitBits ? 1 : (key_bits + kMaxDigitBits - 1) / kMaxDigitBits;
  const int digit_bits = (key_bits + num_passes - 1) / num_passes;
  const int64_t num_buckets = int64_t(1) << digit_bits;
  std::vector<uint32_t> slots(num_blocks * num_buckets), next(num_buckets);
  for (int pass = 0; pass < num_passes; ++pass) {
    const int shift = row_bits + pass * digit_bits;
    const auto bucket = [&](Item item) { return uint32_t(item >> shift) & uint32_t(num_buckets - 1); };
    parallel(num_blocks, 1, [&](int64_t first, int64_t last) {
      for (int64_t block = first; block < last; ++block) {
        uint32_t* histogram = slots.data() + block * num_buckets;
        for (int64_t k = 0; k < num_buckets; ++k) histogram[k] = 0;
        for (int64_t i = begin[block]; i < end[block]; ++i) ++histogram[bucket(from[i])];
      }
    });
    // The histograms become the place of each block's first item of each bucket: block by block, which is the
    // order of memory.
    std::fill(next.begin(), next.end(), 0);
    for (int64_t block = 0; block < num_blocks; ++block) {
      for (int64_t k = 0; k < num_buckets; ++k) next[k] += slots[block * num_buckets + k];
    }
    for (uint32_t k = 0, sum = 0; k < num_buckets; ++k) sum += std::exchange(next[k], sum);
    for (int64_t block = 0; block < num_blocks; ++block) {
      for (int64_t k = 0; k < num_buckets; ++k) {
        const uint32_t count_here = slots[block * num_buckets + k];
        slots[block * num_buckets + k] = next[k];
        next[k] += count_here;
      }
    }
    parallel(num_blocks, 1, [&](int64_t first, int64_t last) {
      for (int64_t block = first; block < last; ++block) {
        uint32_t* slot = slots.data() + block * num_buckets;
        for (int64_t i = begin[block]; i < end[block]; ++i) to[slot[bucket(from[i])]++] = from[i];
      }
    });
    std::swap(from, to);
    for (int64_t block = 0; block < num_blocks; ++block) {  // the first pass closed the gaps
      begin[block] = count * block / num_blocks;
      end[block] = count * (block + 1) / num_blocks;
    }
  }
  return {std::move(from), count, num_blocks};
}

}  // namespace pred
