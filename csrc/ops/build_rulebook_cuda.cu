// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one site; of outputs, one place in the sorted list of all keys that sites feed. Sites enter a hash
// table in no fixed order, which changes the slots that they get and nothing that is found.
#include "common/bits.h"
#include "common/launch.cuh"
#include "common/sort.h"
#include "common/workspace.h"
#include "ops/build_rulebook.h"

namespace pred::PRED_ISA {
namespace {

SiteTable table_in(char* memory, int64_t count, int64_t* bytes = nullptr) {
  Workspace space(memory);
  const int bits = table_bits(count);
  const SiteTable table{space.take<int64_t>(int64_t(1) << bits), space.take<int32_t>(int64_t(1) << bits), bits};
  if (bytes) *bytes = space.bytes();
  return table;
}

int64_t table_bytes(int64_t num_sites) {
  int64_t bytes = 0;
  table_in(nullptr, num_sites, &bytes);
  return bytes;
}

template <typename T>
__global__ void fill_kernel(T* to, int64_t count, T value) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) to[i] = value;
}

template <typename T>
void fill(T* to, int64_t count, T value) {
  launch_threads(fill_kernel<T>, count, to, count, value);
}

void clear(const SiteTable& table) { fill(table.keys, int64_t(1) << table.bits, int64_t(-1)); }

PRED_DEVICE_ONLY void insert(const SiteTable& table, int64_t key, int32_t row) {
  using Word = unsigned long long;
  const uint64_t mask = (uint64_t(1) << table.bits) - 1;
  for (uint64_t slot = first_slot(table, key);; slot = (slot + 1) & mask) {
    const Word before = atomicCAS(reinterpret_cast<Word*>(table.keys + slot), Word(-1), Word(key));
    if (before != Word(-1) && before != Word(key)) continue;
    table.rows[slot] = row;
    return;
  }
}

__global__ void insert_kernel(RulebookArgs a, SiteTable table) {
  for (int64_t i = first_thread(); i < a.num_sites; i += thread_stride()) {
    const int64_t* site = a.indices + 4 * i;
    if (is_inside(a, site)) insert(table, site_key(a.in_shape, site[0], site[1], site[2], site[3]), int32_t(i));
  }
}

// As on the CPU: through tap k a site is fed by the one that it feeds through the opposite tap.
__global__ void submanifold_kernel(RulebookArgs a, SiteTable table, int32_t* out_to_in, int32_t* in_to_out) {
  const int64_t taps = num_taps(a), centre = taps / 2;
  for (int64_t i = first_thread(); i < a.num_sites; i += thread_stride()) {
    const int64_t* site = a.indices + 4 * i;
    if (!is_inside(a, site)) continue;
    out_to_in[i * taps + centre] = in_to_out[i * taps + centre] = int32_t(i);
    for_each_output(a, site, [&](int64_t tap, int64_t key) {
      if (tap >= centre) return;
      const int64_t row = find_site(table, key);
      if (row < 0) return;
      in_to_out[i * taps + tap] = int32_t(row);
      out_to_in[row * taps + tap] = int32_t(i);
      in_to_out[row * taps + taps - 1 - tap] = int32_t(i);
      out_to_in[i * taps + taps - 1 - tap] = int32_t(row);
    });
  }
}

void submanifold(const RulebookArgs& a, int32_t* out_to_in, int32_t* in_to_out, char* memory) {
  const SiteTable table = table_in(memory, a.num_sites);
  const int64_t entries = a.num_sites * num_taps(a);
  fill(out_to_in, entries, int32_t(-1));
  fill(in_to_out, entries, int32_t(-1));
  clear(table);
  launch_threads(insert_kernel, a.num_sites, a, table);
  launch_threads(submanifold_kernel, a.num_sites, a, table, out_to_in, in_to_out);
}

// Keys that sites feed, num_keys where there is none.
struct OutputSpace {
  uint64_t *keys, *sorted;
  int32_t *starts, *numbers;  // whether a place is the first of its key; how many keys have started with it
  char* work;
  int64_t count, work_size, bytes;
  int key_bits;

  OutputSpace(const RulebookArgs& a, int64_t most, int64_t num_keys, char* memory) {
    count = a.num_sites * most;
    key_bits = bits_for(num_keys + 1);
    const int64_t sort = sort_bytes(count, 0, key_bits), scan = scan_bytes(count);
    work_size = sort > scan ? sort : scan;
    Workspace space(memory);
    keys = space.take<uint64_t>(count);
    sorted = space.take<uint64_t>(count);
    starts = space.take<int32_t>(count);
    numbers = space.take<int32_t>(count);
    work = space.take<char>(work_size);
    bytes = space.bytes();
  }
};

int64_t outputs_bytes(const RulebookArgs& a, int64_t most, int64_t num_keys) {
  return OutputSpace(a, most, num_keys, nullptr).bytes;
}

__global__ void keys_kernel(RulebookArgs a, int64_t most, int64_t num_keys, uint64_t* keys) {
  for (int64_t i = first_thread(); i < a.num_sites; i += thread_stride()) {
    const int64_t* site = a.indices + 4 * i;
    uint64_t *next = keys + i * most, *last = next + most;
    if (is_inside(a, site)) for_each_output(a, site, [&](int64_t, int64_t key) { *next++ = uint64_t(key); });
    while (next < last) *next++ = uint64_t(num_keys);
  }
}

__global__ void starts_kernel(const uint64_t* sorted, int64_t count, int64_t num_keys, int32_t* starts) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    starts[i] = int64_t(sorted[i]) < num_keys && (i == 0 || sorted[i] != sorted[i - 1]);
  }
}

int64_t outputs(const RulebookArgs& a, int64_t most, int64_t num_keys, char* workspace) {
  const OutputSpace space(a, most, num_keys, workspace);
  if (space.count == 0) return 0;
  launch_threads(keys_kernel, a.num_sites, a, most, num_keys, space.keys);
  sort_items(space.work, space.work_size, space.keys, space.sorted, space.count, 0, space.key_bits);
  launch_threads(starts_kernel, space.count, static_cast<const uint64_t*>(space.sorted), space.count, num_keys,
                 space.starts);
  add_up(space.work, space.work_size, space.starts, space.numbers, space.count);
  return read_back(space.numbers + space.count - 1);
}

__global__ void outputs_kernel(RulebookArgs a, const uint64_t* sorted, const int32_t* starts, const int32_t* numbers,
                               int64_t count, SiteTable table, int64_t* out_indices) {
  for (int64_t i = first_thread(); i < count; i += thread_stride()) {
    if (!starts[i]) continue;
    const int32_t row = numbers[i] - 1;
    int64_t key = int64_t(sorted[i]);
    insert(table, key, row);
    int64_t* site = out_indices + 4 * int64_t(row);
    for (int axis = 2; axis >= 0; --axis) {
      site[axis + 1] = key % a.out_shape[axis];
      key /= a.out_shape[axis];
    }
    site[0] = key;
  }
}

__global__ void strided_kernel(RulebookArgs a, SiteTable table, int32_t* out_to_in, int32_t* in_to_out) {
  const int64_t taps = num_taps(a);
  for (int64_t i = first_thread(); i < a.num_sites; i += thread_stride()) {
    const int64_t* site = a.indices + 4 * i;
    if (!is_inside(a, site)) continue;
    for_each_output(a, site, [&](int64_t tap, int64_t key) {
      const int64_t row = find_site(table, key);
      in_to_out[i * taps + tap] = int32_t(row);
      out_to_in[row * taps + tap] = int32_t(i);
    });
  }
}

void strided(const RulebookArgs& a, int64_t most, int64_t num_keys, int64_t num_out, int64_t* out_indices,
             int32_t* out_to_in, int32_t* in_to_out, char* workspace, char* memory) {
  const OutputSpace space(a, most, num_keys, workspace);
  const SiteTable table = table_in(memory, num_out);
  fill(out_to_in, num_out * num_taps(a), int32_t(-1));
  fill(in_to_out, a.num_sites * num_taps(a), int32_t(-1));
  clear(table);
  launch_threads(outputs_kernel, space.count, a, static_cast<const uint64_t*>(space.sorted),
                 static_cast<const int32_t*>(space.starts), static_cast<const int32_t*>(space.numbers), space.count,
                 table, out_indices);
  launch_threads(strided_kernel, a.num_sites, a, table, out_to_in, in_to_out);
}

}  // namespace

const RulebookKernels build_rulebook_all = {table_bytes, outputs_bytes, outputs, strided, submanifold};

}  // namespace pred::PRED_ISA
