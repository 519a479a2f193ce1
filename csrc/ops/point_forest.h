// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Builds the trees of ops/point_tree.h, one per frame, for the bindings.
//
// From the root down, the points of each group are sorted along a space-filling curve through the group's own extent
// and cut into 16 equal parts. Parts are equal in number, so depth and memory depend on the number of points alone, and
// each part has a scale of its own, so that a point far away costs the others nothing.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "common/allocate.h"
#include "common/check.h"
#include "common/clouds.h"
#include "common/parallel.h"
#include "common/radix_sort.h"
#include "ops/point_tree.h"

namespace pred {

template <typename T>
class PointForest {
 public:
  // xyz: [N, 3] contiguous; offset: [num_frames + 1]. Points with a coordinate that is not finite are left out.
  PointForest(const T* xyz, const int64_t* offset, int64_t num_frames) : trees_(num_frames) {
    int64_t deepest = 0;
    read_points(xyz, offset, num_frames);
    for (PointTree<T>& tree : trees_) {
      while (tree.num_points > 0 && (tree.num_levels == 0 || part_size(tree.num_levels) < tree.num_points)) {
        ++tree.num_levels;
      }
      deepest = std::max<int64_t>(deepest, tree.num_levels);
    }
    for (int64_t level = deepest - 1; level >= 0; --level) sort_groups(int(level));
    allocate();
    fill_leaves();
    fill_levels();
  }

  const PointTree<T>& operator[](int64_t frame) const { return trees_[frame]; }
  int64_t num_leaves(int64_t frame) const { return groups_of(trees_[frame].num_points, kLeafPoints); }
  int64_t num_groups(int64_t frame, int level) const {
    return groups_of(trees_[frame].num_points, part_size(level + 1));
  }

 private:
  struct Point {
    T position[3];
    int32_t row;
  };

  // Points that are sorted together, and how their positions become cells.
  struct Group {
    int64_t begin, end;
    T low[3], cells_per_unit;
  };

  static constexpr int kCellBits = 6;

  // Points of one child of a group of this level.
  static int64_t part_size(int level) {
    int64_t size = kLeafPoints;
    for (; level > 0; --level) size *= kTreeFan;
    return size;
  }

  static int64_t groups_of(int64_t count, int64_t size) { return (count + size - 1) / size; }

  void read_points(const T* xyz, const int64_t* offset, int64_t num_frames) {
    points_ = allocate_array<Point>(offset[num_frames]);
    spare_ = allocate_array<Point>(offset[num_frames]);
    begin_.assign(num_frames + 1, 0);
    int64_t count = 0;
    for (int64_t frame = 0; frame < num_frames; ++frame) {
      for (int64_t row = offset[frame]; row < offset[frame + 1]; ++row) {
        const T* p = xyz + 3 * row;
        points_[count] = {{p[0], p[1], p[2]}, int32_t(row)};
        count += is_finite(p);  // else the next point takes the place
      }
      begin_[frame + 1] = count;
      trees_[frame].num_points = count - begin_[frame];
    }
  }

  // The range of most of the points, from a few of them: without the two outermost on either side.
  void set_cells(Group& group) const {
    constexpr int64_t kSamples = 32;
    const int64_t size = group.end - group.begin, samples = std::min(size, kSamples);
    T extent = 0;
    for (int axis = 0; axis < 3; ++axis) {
      T low[2] = {T(INFINITY), T(INFINITY)}, high[2] = {T(-INFINITY), T(-INFINITY)};
      for (int64_t i = 0; i < samples; ++i) {
        const T value = points_[group.begin + size * i / samples].position[axis];
        low[1] = std::min(low[1], std::max(low[0], value));
        low[0] = std::min(low[0], value);
        high[1] = std::max(high[1], std::min(high[0], value));
        high[0] = std::max(high[0], value);
      }
      const T margin = T(0.25) * (high[1] - low[1]);
      group.low[axis] = low[1] - margin;
      extent = std::max(extent, high[1] - low[1] + 2 * margin);
    }
    group.cells_per_unit = T(1 << kCellBits) / extent;  // infinite where the samples agree: two cells per axis
  }

  static uint32_t cell(T position, T low, T cells_per_unit) {
    constexpr int32_t last = (1 << kCellBits) - 1;
    const T value = (position - low) * cells_per_unit;
    return uint32_t(value < T(last) ? int32_t(value > T(0) ? value : T(0)) : value >= T(last) ? last : 0);  // NaN: 0
  }

  // To every third bit.
  static uint32_t spread(uint32_t bits) {
    bits = (bits | bits << 8) & 0x300f;
    bits = (bits | bits << 4) & 0x30c3;
    return (bits | bits << 2) & 0x9249;
  }

  // Sorts the points of each group of a level along a curve, so that cutting it into parts gives its children.
  void sort_groups(int level) {
    const int64_t size = part_size(level + 1);
    std::vector<Group> groups;
    std::vector<int64_t> group_offset{0};
    for (size_t frame = 0; frame < trees_.size(); ++frame) {
      // A frame that is not so deep is a group that stays as it is.
      const int64_t step = level < trees_[frame].num_levels ? size : std::max<int64_t>(trees_[frame].num_points, 1);
      for (int64_t begin = begin_[frame]; begin < begin_[frame + 1]; begin += step) {
        groups.push_back({begin, std::min(begin + step, begin_[frame + 1]), {}, 0});
        if (level < trees_[frame].num_levels) set_cells(groups.back());
        group_offset.push_back(groups.back().end);
      }
    }
    const int64_t count = begin_.back(), num_groups = int64_t(groups.size());
    const int row_bits = bits_for(count), group_bits = bits_for(num_groups);
    // So many points in so many groups leave fewer bits for cells: then these are larger.
    const int curve_bits = std::min(3 * kCellBits, (64 - row_bits - group_bits) / 3 * 3);
    const auto sorted =
        sort_rows<uint64_t>(count, row_bits, group_bits + curve_bits, [&](uint64_t* items, int64_t begin, int64_t end) {
          for_each_frame(group_offset.data(), num_groups, begin, end, [&](int64_t g, int64_t first, int64_t last) {
            const Group& group = groups[g];
            for (int64_t i = first; i < last; ++i) {
              uint32_t curve = 0;
              for (int axis = 0; axis < 3 && group.cells_per_unit > 0; ++axis) {
                curve |= spread(cell(points_[i].position[axis], group.low[axis], group.cells_per_unit)) << axis;
              }
              *items++ = (uint64_t(g) << curve_bits | curve >> (3 * kCellBits - curve_bits)) << row_bits | uint64_t(i);
            }
          });
          return end - begin;
        });
    const uint64_t row_mask = (uint64_t(1) << row_bits) - 1;
    parallel(count, 16384, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) spare_[i] = points_[sorted.items[i] & row_mask];
    });
    points_.swap(spare_);
  }

  void allocate() {
    int64_t num_leaves = 0, num_groups = 0;
    for (int64_t frame = 0; frame < int64_t(trees_.size()); ++frame) {
      num_leaves += this->num_leaves(frame);
      for (int level = 0; level < trees_[frame].num_levels; ++level) num_groups += this->num_groups(frame, level);
    }
    leaf_points_ = allocate_array<T>(num_leaves * 3 * kLeafPoints);
    leaf_rows_ = allocate_array<int32_t>(num_leaves * kLeafPoints);
    boxes_ = allocate_array<T>(num_groups * 6 * kTreeFan);
    first_rows_ = allocate_array<int32_t>(num_groups * kTreeFan);
    num_leaves = num_groups = 0;
    for (int64_t frame = 0; frame < int64_t(trees_.size()); ++frame) {
      PointTree<T>& tree = trees_[frame];
      tree.points = leaf_points_.get() + num_leaves * 3 * kLeafPoints;
      tree.rows = leaf_rows_.get() + num_leaves * kLeafPoints;
      num_leaves += this->num_leaves(frame);
      for (int level = 0; level < tree.num_levels; ++level) {
        tree.levels[level] = {boxes_.get() + num_groups * 6 * kTreeFan, first_rows_.get() + num_groups * kTreeFan};
        num_groups += this->num_groups(frame, level);
      }
    }
  }

  void fill_leaves() {
    for (int64_t frame = 0; frame < int64_t(trees_.size()); ++frame) {
      const PointTree<T>& tree = trees_[frame];
      T* xyz = const_cast<T*>(tree.points);
      int32_t* rows = const_cast<int32_t*>(tree.rows);
      parallel(num_leaves(frame) * kLeafPoints, 16384, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
          const bool exists = i < tree.num_points;
          const Point& point = points_[begin_[frame] + (exists ? i : 0)];
          T* to = xyz + i / kLeafPoints * 3 * kLeafPoints + i % kLeafPoints;
          for (int axis = 0; axis < 3; ++axis) to[axis * kLeafPoints] = exists ? point.position[axis] : T(NAN);
          rows[i] = exists ? point.row : kNoRow;
        }
      });
    }
  }

  // From the leaves up.
  void fill_levels() {
    for (int64_t frame = 0; frame < int64_t(trees_.size()); ++frame) {
      const PointTree<T>& tree = trees_[frame];
      for (int level = 0; level < tree.num_levels; ++level) {
        const int64_t num_children = level == 0 ? num_leaves(frame) : num_groups(frame, level - 1);
        parallel(num_groups(frame, level), 64, [&](int64_t begin, int64_t end) {
          for (int64_t child = begin * kTreeFan; child < end * kTreeFan; ++child) {
            fill_child(tree, level, child, child < num_children);
          }
        });
      }
    }
  }

  static void fill_child(const PointTree<T>& tree, int level, int64_t child, bool exists) {
    const int64_t group = child / kTreeFan, place = child % kTreeFan;
    T* box = const_cast<T*>(tree.levels[level].boxes) + group * 6 * kTreeFan + place;
    int32_t first_row = kNoRow;
    for (int axis = 0; axis < 3; ++axis) {
      T low = T(INFINITY), high = T(-INFINITY);
      if (exists && level == 0) {
        const T* values = tree.points + (child * 3 + axis) * kLeafPoints;
        for (int64_t i = 0; i < kLeafPoints; ++i) {
          low = values[i] < low ? values[i] : low;  // NaN fails
          high = values[i] > high ? values[i] : high;
        }
      } else if (exists) {
        const T* boxes = tree.levels[level - 1].boxes + (child * 6 + axis) * kTreeFan;
        low = *std::min_element(boxes, boxes + kTreeFan);
        high = *std::max_element(boxes + 3 * kTreeFan, boxes + 4 * kTreeFan);
      }
      box[axis * kTreeFan] = low;
      box[(axis + 3) * kTreeFan] = high;
    }
    if (exists) {
      const int32_t* rows =
          level == 0 ? tree.rows + child * kLeafPoints : tree.levels[level - 1].first_rows + child * kTreeFan;
      first_row = *std::min_element(rows, rows + (level == 0 ? kLeafPoints : kTreeFan));
    }
    const_cast<int32_t*>(tree.levels[level].first_rows)[child] = first_row;
  }

  std::vector<PointTree<T>> trees_;
  std::vector<int64_t> begin_;  // of each frame in points_
  std::unique_ptr<Point[]> points_, spare_;
  std::unique_ptr<T[]> leaf_points_, boxes_;
  std::unique_ptr<int32_t[]> leaf_rows_, first_rows_;
};

}  // namespace pred
