// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one query and its row of the outputs.
#include "math/heap.h"
#include "ops/ball_query.h"

namespace pred::PRED_ISA {
namespace {

// The lowest rows so far; kNoRow where there are fewer.
struct LowestRows {
  int64_t* row;
  int64_t get(int64_t i) const { return row[i]; }
  void set(int64_t i, int64_t entry) const { row[i] = entry; }
  static bool less(int64_t a, int64_t b) { return a < b; }
};

template <typename T>
static inline void visit_leaf(const PointTree<T>& tree, int64_t leaf, const T query[3], T squared_radius,
                              const LowestRows& lowest, int64_t max_points) {
  T distance[kLeafPoints];
  leaf_distances(tree, leaf, query, distance);
  const int32_t* rows = tree.rows + leaf * kLeafPoints;
  const int32_t bound = int32_t(lowest.row[0]);
  uint32_t inside = 0;
  for (int64_t i = 0; i < kLeafPoints; ++i) inside |= uint32_t((distance[i] < squared_radius) & (rows[i] < bound)) << i;
  for (; inside != 0; inside &= inside - 1) {
    const int64_t row = rows[__builtin_ctz(inside)];
    if (row < lowest.row[0]) replace_root(lowest, max_points, row);
  }
}

// The first rows of a group's children that the ball touches, else kNoRow.
template <typename T>
static inline void touched_rows(const PointTree<T>& tree, int level, int64_t group, const T query[3], T squared_radius,
                                int32_t* __restrict out) {
  T distance[kTreeFan];
  box_distances(tree, level, group, query, distance);
  const int32_t* first_rows = tree.levels[level].first_rows + group * kTreeFan;
  for (int64_t c = 0; c < kTreeFan; ++c) out[c] = distance[c] < squared_radius ? first_rows[c] : kNoRow;
}

// Visits boxes in the order of their first rows, so that a list that is full soon ends the search.
template <typename T>
static void search_query(const PointTree<T>& tree, const T query[3], T squared_radius, const LowestRows& lowest,
                         int64_t max_points) {
  struct {
    int64_t group;
    int32_t row[kTreeFan];  // kNoRow once visited
  } path[kTreeLevels];
  const int root = tree.num_levels - 1;
  int level = root;
  path[root].group = 0;
  touched_rows(tree, root, 0, query, squared_radius, path[root].row);
  while (true) {
    int32_t* row = path[level].row;
    int64_t first = 0;
    for (int64_t c = 1; c < kTreeFan; ++c) first = row[c] < row[first] ? c : first;
    if (row[first] >= lowest.row[0]) {
      if (level == root) return;
      ++level;
      continue;
    }
    row[first] = kNoRow;
    const int64_t child = path[level].group * kTreeFan + first;
    if (level == 0) {
      visit_leaf(tree, child, query, squared_radius, lowest, max_points);
    } else {
      --level;
      path[level].group = child;
      touched_rows(tree, level, child, query, squared_radius, path[level].row);
    }
  }
}

template <typename T>
static void search(const PointTree<T>& tree, const T* queries, T squared_radius, int64_t max_points, int64_t* index,
                   int64_t* counts, int64_t begin, int64_t end) {
  for (int64_t q = begin; q < end; ++q) {
    const LowestRows lowest{index + q * max_points};
    for (int64_t i = 0; i < max_points; ++i) lowest.row[i] = kNoRow;
    if (max_points > 0 && tree.num_levels > 0 && is_finite(queries + 3 * q)) {
      search_query(tree, queries + 3 * q, squared_radius, lowest, max_points);
      sort_heap(lowest, max_points);
    }
    counts[q] = 0;
    for (int64_t i = 0; i < max_points; ++i) {
      counts[q] += lowest.row[i] != kNoRow;
      lowest.row[i] = lowest.row[i] == kNoRow ? -1 : lowest.row[i];
    }
  }
}

}  // namespace

const BallQueryKernels<float> ball_query_f32 = {search<float>};
const BallQueryKernels<double> ball_query_f64 = {search<double>};

}  // namespace pred::PRED_ISA
