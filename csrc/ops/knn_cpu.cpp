// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one query and its row of the outputs.
#include "math/heap.h"
#include "ops/knn.h"

namespace pred::PRED_ISA {
namespace {

constexpr int64_t kNoPoint = 0x7fffffffffffffff;

template <typename T>
constexpr T kLargest = T(sizeof(T) == 4 ? double(__FLT_MAX__) : __DBL_MAX__);

template <typename T>
struct Neighbor {
  T distance;
  int64_t row;
};

template <typename T>
static inline bool closer(Neighbor<T> a, Neighbor<T> b) {
  return (a.distance < b.distance) | ((a.distance == b.distance) & (a.row < b.row));
}

// The k best so far, for any k: a heap in the output rows; (infinity, kNoPoint) where there are fewer.
template <typename T>
struct NeighborHeap {
  T* distance;
  int64_t* row;
  int64_t k;

  Neighbor<T> get(int64_t i) const { return {distance[i], row[i]}; }
  void set(int64_t i, Neighbor<T> entry) const {
    distance[i] = entry.distance;
    row[i] = entry.row;
  }
  static bool less(Neighbor<T> a, Neighbor<T> b) { return closer(a, b); }

  void clear() const {
    for (int64_t i = 0; i < k; ++i) set(i, {T(__builtin_inf()), kNoPoint});
  }
  Neighbor<T> worst() const { return get(0); }
  void add(Neighbor<T> entry) const { replace_root(*this, k, entry); }
  void finish() const { sort_heap(*this, k); }
};

// The same for k <= K: a sorted list. Adding an entry moves all others in one vector loop without branches, from one
// buffer to the other.
template <typename T, int K>
struct NeighborList {
  using Row = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  struct Buffer {
    T distance[K + 1];  // [0]: less than all others
    Row row[K + 1];
  };
  Buffer buffers[2];
  int current;
  T* distance_out;
  int64_t* row_out;
  int64_t k;

  NeighborList(T* distance, int64_t* row, int64_t k) : distance_out(distance), row_out(row), k(k) {}

  void clear() {
    current = 0;
    for (int i = 0; i <= K; ++i) {
      buffers[0].distance[i] = buffers[1].distance[i] = T(i > 0 ? __builtin_inf() : -__builtin_inf());
      buffers[0].row[i] = buffers[1].row[i] = Row(kNoRow);
    }
  }
  Neighbor<T> worst() const { return {buffers[current].distance[k], buffers[current].row[k]}; }
  void add(Neighbor<T> entry) {
    const Buffer& from = buffers[current];
    current = 1 - current;
    Buffer& to = buffers[current];
    const T distance = entry.distance;
    const Row row = Row(entry.row);
    const T* __restrict from_distance = from.distance;
    const Row* __restrict from_row = from.row;
    T* __restrict to_distance = to.distance;
    Row* __restrict to_row = to.row;
    for (int i = 1; i <= K; ++i) {
      const T before = from_distance[i - 1], here = from_distance[i];
      const Row row_before = from_row[i - 1], row_here = from_row[i];
      const bool moves = (distance < before) | ((distance == before) & (row < row_before));
      const bool stays = (distance > here) | ((distance == here) & (row > row_here));
      to_distance[i] = moves ? before : stays ? here : distance;
      to_row[i] = moves ? row_before : stays ? row_here : row;
    }
  }
  void finish() {
    for (int64_t i = 0; i < k; ++i) {
      distance_out[i] = buffers[current].distance[i + 1];
      const Row row = buffers[current].row[i + 1];
      row_out[i] = row == Row(kNoRow) ? kNoPoint : int64_t(row);
    }
  }
};

// Adds the points of a leaf. Returns the largest distance that may still matter: an infinite one never does.
template <typename T, typename Best>
static inline T visit_leaf(const PointTree<T>& tree, int64_t leaf, const T query[3], Best& best, T bound) {
  T distance[kLeafPoints];
  leaf_distances(tree, leaf, query, distance);
  uint32_t close = 0;
  for (int64_t i = 0; i < kLeafPoints; ++i) close |= uint32_t(distance[i] <= bound) << i;
  for (; close != 0; close &= close - 1) {
    const int64_t i = __builtin_ctz(close);
    const Neighbor<T> entry{distance[i], tree.rows[leaf * kLeafPoints + i]};
    if (closer(entry, best.worst())) best.add(entry);
  }
  const T worst = best.worst().distance;
  return worst < bound ? worst : bound;
}

template <typename T, typename Best>
static void search_query(const PointTree<T>& tree, const T query[3], Best& best) {
  struct {
    int64_t group;
    T distance[kTreeFan];  // infinite once visited
  } path[kTreeLevels];
  const int root = tree.num_levels - 1;
  int level = root;
  T bound = kLargest<T>;
  path[root].group = 0;
  box_distances(tree, root, 0, query, path[root].distance);
  while (true) {
    T* distance = path[level].distance;
    int64_t nearest = 0;
    for (int64_t c = 1; c < kTreeFan; ++c) nearest = distance[c] < distance[nearest] ? c : nearest;
    if (!(distance[nearest] <= bound)) {
      if (level == root) return;
      ++level;
      continue;
    }
    distance[nearest] = T(__builtin_inf());
    const int64_t child = path[level].group * kTreeFan + nearest;
    if (level == 0) {
      bound = visit_leaf(tree, child, query, best, bound);
    } else {
      --level;
      path[level].group = child;
      box_distances(tree, level, child, query, path[level].distance);
    }
  }
}

template <typename T, typename Best>
static void search_queries(const PointTree<T>& tree, const T* queries, int64_t k, int64_t* index, T* distance,
                           int64_t begin, int64_t end) {
  for (int64_t q = begin; q < end; ++q) {
    Best best{distance + q * k, index + q * k, k};
    best.clear();
    if (k > 0 && tree.num_levels > 0 && is_finite(queries + 3 * q)) search_query(tree, queries + 3 * q, best);
    best.finish();
    for (int64_t i = q * k; i < (q + 1) * k; ++i) index[i] = index[i] == kNoPoint ? -1 : index[i];
  }
}

template <typename T>
static void search(const PointTree<T>& tree, const T* queries, int64_t k, int64_t* index, T* distance, int64_t begin,
                   int64_t end) {
  const auto call = k <= 8    ? search_queries<T, NeighborList<T, 8>>
                    : k <= 16 ? search_queries<T, NeighborList<T, 16>>
                    : k <= 32 ? search_queries<T, NeighborList<T, 32>>
                    : k <= 64 ? search_queries<T, NeighborList<T, 64>>
                              : search_queries<T, NeighborHeap<T>>;
  call(tree, queries, k, index, distance, begin, end);
}

}  // namespace

const KnnKernels<float> knn_f32 = {search<float>};
const KnnKernels<double> knn_f64 = {search<double>};

}  // namespace pred::PRED_ISA
