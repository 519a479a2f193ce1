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
    if (!is_inside(a, a.indices + 4 * i)) return i;
  }
  return -1;
}

static void keys(const RulebookArgs& a, int64_t* keys, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    const int64_t* site = a.indices + 4 * i;
    keys[i] = site_key(a.in_shape, site[0], site[1], site[2], site[3]);
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
