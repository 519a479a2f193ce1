// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Sorting on the device, in the order of the current stream.
#pragma once

#include <stdint.h>

namespace pred {

// What sort_items needs in its workspace.
int64_t sort_bytes(int64_t count, int begin_bit, int end_bit);

// Stable, ascending by the bits [begin_bit, end_bit). `items` and `sorted` do not overlap.
void sort_items(void* workspace, int64_t bytes, const uint64_t* items, uint64_t* sorted, int64_t count, int begin_bit,
                int end_bit);

}  // namespace pred
