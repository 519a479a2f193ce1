// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// build_rulebook: which active site feeds which through which tap of a sparse convolution's kernel.
//
// Per axis, tap k of output o reads input p = o stride - padding + k dilation, so that input p feeds
//   o = (p + padding - k dilation) / stride   where that is whole and inside.
// Taps count (z, y, x), x fastest. Sites are looked up in a hash table by their number in the grid.
#pragma once

#include "common/host_device.h"
#include "common/isa.h"

namespace pred {

struct RulebookArgs {
  const int64_t* indices;  // [M, 4], (b, z, y, x)
  int64_t num_sites, num_frames;
  int64_t in_shape[3], out_shape[3], kernel[3], stride[3], padding[3], dilation[3];  // z, y, x
};

PRED_HOST_DEVICE int64_t num_taps(const RulebookArgs& a) { return a.kernel[0] * a.kernel[1] * a.kernel[2]; }

// The number of a site in a grid of all frames.
PRED_HOST_DEVICE int64_t site_key(const int64_t* shape, int64_t frame, int64_t z, int64_t y, int64_t x) {
  return ((frame * shape[0] + z) * shape[1] + y) * shape[2] + x;
}

// The output that input p feeds through tap k along an axis, or -1.
PRED_HOST_DEVICE int64_t fed_output(const RulebookArgs& a, int axis, int64_t p, int64_t k) {
  const int64_t scaled = p + a.padding[axis] - k * a.dilation[axis];
  if (scaled < 0 || scaled % a.stride[axis] != 0) return -1;
  const int64_t o = scaled / a.stride[axis];
  return o < a.out_shape[axis] ? o : -1;
}

// Open addressing with linear probing; at most half of the slots, a power of two, are taken.
struct SiteTable {
  int64_t* keys;  // -1 where free
  int32_t* rows;
  int bits;  // of a slot's number
};

// Where a key is, or may be put. The product's highest bits depend on all bits of the key: those of a column of a grid
// are multiples of large powers of two (Knuth, The Art of Computer Programming 3, 6.4: Fibonacci hashing).
PRED_HOST_DEVICE uint64_t slot_of(const SiteTable& table, int64_t key) {
  const uint64_t mask = (uint64_t(1) << table.bits) - 1;
  uint64_t slot = uint64_t(key) * 0x9e3779b97f4a7c15ull >> (64 - table.bits);
  while (table.keys[slot] != key && table.keys[slot] != -1) slot = (slot + 1) & mask;
  return slot;
}

// The row of a key, or -1.
PRED_HOST_DEVICE int32_t find_site(const SiteTable& table, int64_t key) {
  const uint64_t slot = slot_of(table, key);
  return table.keys[slot] == key ? table.rows[slot] : -1;
}

// Ranges count sites of `indices`. Tables are [sites, taps] and hold -1 before.
struct RulebookKernels {
  // The first site that lies outside the grid, or -1.
  int64_t (*find_outside)(const RulebookArgs&, int64_t begin, int64_t end);
  void (*keys)(const RulebookArgs&, int64_t* keys, int64_t begin, int64_t end);
  // The keys of the outputs that each site feeds, [sites, most], filled up with -1.
  void (*outputs)(const RulebookArgs&, int64_t most, int64_t* keys, int64_t begin, int64_t end);
  // Outputs are the inputs; `table` holds them.
  void (*submanifold)(const RulebookArgs&, const SiteTable& table, int32_t* out_to_in, int32_t* in_to_out,
                      int64_t begin, int64_t end);
  // `table` holds the outputs.
  void (*strided)(const RulebookArgs&, const SiteTable& table, int32_t* out_to_in, int32_t* in_to_out, int64_t begin,
                  int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(RulebookKernels, build_rulebook_all)
