// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One thread owns one frame: every sample depends on the one before.
#include "ops/farthest_point_sample.h"

namespace pred::PRED_ISA {
namespace {

template <int64_t kCount, typename T>
static inline T maximum(const T* values) {
  T m[kCount / 2];
  for (int64_t i = 0; i < kCount / 2; ++i)
    m[i] = values[i] > values[i + kCount / 2] ? values[i] : values[i + kCount / 2];
  for (int64_t half = kCount / 4; half > 0; half /= 2) {
    for (int64_t i = 0; i < half; ++i) m[i] = m[i] > m[i + half] ? m[i] : m[i + half];
  }
  return m[0];
}

// Lowers the distances of a group's points; returns the largest of them.
template <typename T>
static T add_sample(const PointTree<T>& tree, const FarthestPointScratch<T>& s, int level, int64_t group,
                    const T sample[3]) {
  T box[kTreeFan];
  box_distances(tree, level, group, sample, box);
  T* largest = s.largest[level] + group * kTreeFan;
  uint32_t touched = 0;
  for (int64_t c = 0; c < kTreeFan; ++c) touched |= uint32_t(box[c] < largest[c]) << c;
  for (; touched != 0; touched &= touched - 1) {
    const int64_t c = __builtin_ctz(touched), child = group * kTreeFan + c;
    if (level > 0) {
      largest[c] = add_sample(tree, s, level - 1, child, sample);
      continue;
    }
    T* __restrict distance = s.distance + child * kLeafPoints;
    T to_sample[kLeafPoints];
    leaf_distances(tree, child, sample, to_sample);
    for (int64_t i = 0; i < kLeafPoints; ++i) distance[i] = to_sample[i] < distance[i] ? to_sample[i] : distance[i];
    largest[c] = maximum<kLeafPoints>(distance);
  }
  return maximum<kTreeFan>(largest);
}

// The smaller of `row` and the first row below a group whose distance is `value`.
template <typename T>
static int32_t first_row_at(const PointTree<T>& tree, const FarthestPointScratch<T>& s, int level, int64_t group,
                            T value, int32_t row) {
  for (int64_t child = group * kTreeFan; child < (group + 1) * kTreeFan; ++child) {
    if (s.largest[level][child] != value || tree.levels[level].first_rows[child] >= row) continue;
    if (level > 0) {
      row = first_row_at(tree, s, level - 1, child, value, row);
      continue;
    }
    for (int64_t i = child * kLeafPoints; i < (child + 1) * kLeafPoints; ++i) {
      row = (s.distance[i] == value) & (tree.rows[i] < row) ? tree.rows[i] : row;
    }
  }
  return row;
}

template <typename T>
static void sample(const PointTree<T>& tree, const FarthestPointScratch<T>& s, const T* xyz, int64_t num_leaves,
                   int64_t first, int64_t num_samples, int64_t* out) {
  const int root = tree.num_levels - 1;
  for (int64_t i = 0; i < num_leaves * kLeafPoints; ++i)
    s.distance[i] = tree.rows[i] == kNoRow ? T(-1) : T(__builtin_inf());
  int64_t num_children = num_leaves;
  for (int level = 0; level <= root; ++level) {
    const int64_t num_groups = (num_children + kTreeFan - 1) / kTreeFan;
    for (int64_t c = 0; c < num_groups * kTreeFan; ++c)
      s.largest[level][c] = T(c < num_children ? __builtin_inf() : -1);
    num_children = num_groups;
  }
  out[0] = first;
  for (int64_t n = 1; n < num_samples; ++n) {
    const T largest = add_sample(tree, s, root, 0, xyz + 3 * out[n - 1]);
    out[n] = first_row_at(tree, s, root, 0, largest, kNoRow);
    if (largest > T(0)) continue;
    // Every point coincides with a sample: it stays the lowest row.
    for (; n + 1 < num_samples; ++n) out[n + 1] = out[n];
  }
}

}  // namespace

const FarthestPointSampleKernels<float> farthest_point_sample_f32 = {sample<float>};
const FarthestPointSampleKernels<double> farthest_point_sample_f64 = {sample<double>};

}  // namespace pred::PRED_ISA
