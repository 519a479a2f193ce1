// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// A binary heap with its largest entry at the root, in the caller's memory. For some type Entry a Heap has
// Entry get(int64_t) const, void set(int64_t, Entry) const and bool less(Entry, Entry) const.
#pragma once

#include "common/host_device.h"

namespace pred {

// Puts `entry` in place of the root, or of another entry that is the root of a heap.
template <typename Heap, typename Entry>
PRED_HOST_DEVICE void replace_root(const Heap& heap, int64_t size, Entry entry, int64_t root = 0) {
  int64_t hole = root;
  for (int64_t child = 2 * hole + 1; child < size; child = 2 * hole + 1) {
    if (child + 1 < size && heap.less(heap.get(child), heap.get(child + 1))) ++child;
    if (!heap.less(entry, heap.get(child))) break;
    heap.set(hole, heap.get(child));
    hole = child;
  }
  heap.set(hole, entry);
}

// Turns a list into a heap.
template <typename Heap>
PRED_HOST_DEVICE void make_heap(const Heap& heap, int64_t size) {
  for (int64_t root = size / 2 - 1; root >= 0; --root) replace_root(heap, size, heap.get(root), root);
}

// Turns the heap into an ascending list.
template <typename Heap>
PRED_HOST_DEVICE void sort_heap(const Heap& heap, int64_t size) {
  for (int64_t last = size - 1; last > 0; --last) {
    const auto entry = heap.get(last);
    heap.set(last, heap.get(0));
    replace_root(heap, last, entry);
  }
}

}  // namespace pred
