// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Sorting and counting on the device, in the order of the current stream.
#pragma once

#include <stdint.h>

namespace pred {

// What sort_items needs in its workspace.
int64_t sort_bytes(int64_t count, int begin_bit, int end_bit);

// Stable, ascending by the bits [begin_bit, end_bit). `items` and `sorted` do not overlap.
void sort_items(void* workspace, int64_t bytes, const uint64_t* items, uint64_t* sorted, int64_t count, int begin_bit,
                int end_bit);

// The same for keys with a row each, which keeps its key; all of the keys' bits below key_bits count.
int64_t sort_rows_bytes(int64_t count, int key_bits);
void sort_rows(void* workspace, int64_t bytes, const uint64_t* keys, uint64_t* sorted_keys, const int32_t* rows,
               int32_t* sorted_rows, int64_t count, int key_bits);

// start[key], for keys from 0 to num_keys, = the first sorted item whose bits from number_bits on are this key or a
// higher one.
void find_runs(const uint64_t* sorted, int64_t count, int number_bits, int64_t num_keys, int64_t* start);

// What add_up needs in its workspace.
int64_t scan_bytes(int64_t count);

// sums[i] = values[0] + ... + values[i]
void add_up(void* workspace, int64_t bytes, const int32_t* values, int32_t* sums, int64_t count);

// A number on the device, once it is there: the host waits for the stream. For sizes of results only.
int32_t read_back(const int32_t* number);

}  // namespace pred
