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

PRED_HOST_DEVICE bool is_inside(const RulebookArgs& a, const int64_t* site) {
  bool inside = site[0] >= 0 && site[0] < a.num_frames;
  for (int axis = 0; axis < 3; ++axis) inside &= site[axis + 1] >= 0 && site[axis + 1] < a.in_shape[axis];
  return inside;
}

// body(tap, key of the output) for every output that a site feeds.
template <class Body>
PRED_HOST_DEVICE void for_each_output(const RulebookArgs& a, const int64_t* site, const Body& body) {
  int64_t tap = 0;
  for (int64_t kz = 0; kz < a.kernel[0]; ++kz) {
    const int64_t z = fed_output(a, 0, site[1], kz);
    for (int64_t ky = 0; ky < a.kernel[1]; ++ky) {
      const int64_t y = z < 0 ? -1 : fed_output(a, 1, site[2], ky);
      if (y < 0) {
        tap += a.kernel[2];
        continue;
      }
      for (int64_t kx = 0; kx < a.kernel[2]; ++kx, ++tap) {
        const int64_t x = fed_output(a, 2, site[3], kx);
        if (x >= 0) body(tap, site_key(a.out_shape, site[0], z, y, x));
      }
    }
  }
}

// Open addressing with linear probing; at most half of the slots, a power of two, are taken.
struct SiteTable {
  int64_t* keys;  // -1 where free
  int32_t* rows;
  int bits;  // of a slot's number
};

// Where a key is, or may be put. The product's highest bits depend on all bits of the key: those of a column of a grid
// are multiples of large powers of two (Knuth, The Art of Computer Programming 3, 6.4: Fibonacci hashing).
PRED_HOST_DEVICE uint64_t first_slot(const SiteTable& table, int64_t key) {
  return uint64_t(key) * 0x9e3779b97f4a7c15ull >> (64 - table.bits);
}
PRED_HOST_DEVICE uint64_t slot_of(const SiteTable& table, int64_t key) {
  const uint64_t mask = (uint64_t(1) << table.bits) - 1;
  uint64_t slot = first_slot(table, key);
  while (table.keys[slot] != key && table.keys[slot] != -1) slot = (slot + 1) & mask;
  return slot;
}

// The row of a key, or -1.
PRED_HOST_DEVICE int32_t find_site(const SiteTable& table, int64_t key) {
  const uint64_t slot = slot_of(table, key);
  return table.keys[slot] == key ? table.rows[slot] : -1;
}

// Bits of the number of slots of a table for so many keys.
inline int table_bits(int64_t count) {
  int bits = 4;
  while (int64_t(1) << bits < 2 * count) ++bits;
  return bits;
}

#ifdef PRED_LAUNCH
// Sites that lie outside the grid feed nothing; of equal ones any counts. Tables are [sites, taps].
struct RulebookKernels {
  int64_t (*table_bytes)(int64_t num_sites);
  int64_t (*outputs_bytes)(const RulebookArgs&, int64_t most, int64_t num_keys);
  // How many outputs there are: of the keys below num_keys, where a site feeds at most so many.
  int64_t (*outputs)(const RulebookArgs&, int64_t most, int64_t num_keys, char* workspace);
  // From the same workspace, and one for a table of the outputs.
  void (*strided)(const RulebookArgs&, int64_t most, int64_t num_keys, int64_t num_out, int64_t* out_indices,
                  int32_t* out_to_in, int32_t* in_to_out, char* workspace, char* table);
  // With a workspace for a table of the inputs, which are the outputs.
  void (*submanifold)(const RulebookArgs&, int32_t* out_to_in, int32_t* in_to_out, char* table);
};
#else
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
#endif

}  // namespace pred

PRED_DECLARE_KERNELS(RulebookKernels, build_rulebook_all)
