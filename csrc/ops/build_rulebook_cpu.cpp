// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one input site. A tap of an output is fed by one input at most: no two iterations write one
// address.
#include "ops/build_rulebook.h"

namespace pred::PRED_ISA {
namespace {

static int64_t find_outside(const RulebookArgs& a, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    const int64_t* site = a.indices + 4 * i;
    bool inside = site[0] >= 0 && site[0] < a.num_frames;
    for (int axis = 0; axis < 3; ++axis) inside &= site[axis + 1] >= 0 && site[axis + 1] < a.in_shape[axis];
    if (!inside) return i;
  }
  return -1;
}

static void keys(const RulebookArgs& a, int64_t* keys, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    const int64_t* site = a.indices + 4 * i;
    keys[i] = site_key(a.in_shape, site[0], site[1], site[2], site[3]);
  }
}

// body(tap, key of the output) for every output that a site feeds.
template <class Body>
static inline void for_each_output(const RulebookArgs& a, const int64_t* site, const Body& body) {
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

static void outputs(const RulebookArgs& a, int64_t most, int64_t* keys, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    int64_t *next = keys + i * most, *last = next + most;
    for_each_output(a, a.indices + 4 * i, [&](int64_t, int64_t key) { *next++ = key; });
    while (next < last) *next++ = -1;
  }
}

// Through tap k a site is fed by the one that it feeds through the opposite tap: half of them are looked up.
static void submanifold(const RulebookArgs& a, const SiteTable& table, int32_t* out_to_in, int32_t* in_to_out,
                        int64_t begin, int64_t end) {
  const int64_t taps = num_taps(a), centre = taps / 2;
  for (int64_t i = begin; i < end; ++i) {
    out_to_in[i * taps + centre] = in_to_out[i * taps + centre] = int32_t(i);
    for_each_output(a, a.indices + 4 * i, [&](int64_t tap, int64_t key) {
      if (tap >= centre) return;
      const int32_t row = find_site(table, key);
      if (row < 0) return;
      in_to_out[i * taps + tap] = row;
      out_to_in[row * taps + tap] = int32_t(i);
      in_to_out[row * taps + taps - 1 - tap] = int32_t(i);
      out_to_in[i * taps + taps - 1 - tap] = row;
    });
  }
}

static void strided(const RulebookArgs& a, const SiteTable& table, int32_t* out_to_in, int32_t* in_to_out,
                    int64_t begin, int64_t end) {
  const int64_t taps = num_taps(a);
  for (int64_t i = begin; i < end; ++i) {
    for_each_output(a, a.indices + 4 * i, [&](int64_t tap, int64_t key) {
      const int32_t row = find_site(table, key);
      in_to_out[i * taps + tap] = row;
      out_to_in[row * taps + tap] = int32_t(i);
    });
  }
}

}  // namespace

const RulebookKernels build_rulebook_all = {find_outside, keys, outputs, submanifold, strided};

}  // namespace pred::PRED_ISA
