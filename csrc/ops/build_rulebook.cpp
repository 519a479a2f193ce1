// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/build_rulebook.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <atomic>
#include <memory>
#include <numeric>
#include <tuple>
#include <vector>

#include "common/allocate.h"
#include "common/check.h"
#include "common/parallel.h"
#include "common/radix_sort.h"

namespace pred {
namespace {

constexpr int64_t kGrain = 1024, kMaxKeys = int64_t(1) << 62, kMaxRows = int64_t(1) << 31;

RulebookArgs arguments(const char* op, const Tensor& indices, int64_t num_frames, const std::vector<int64_t>& shape,
                       const std::vector<int64_t>& kernel, const std::vector<int64_t>& stride,
                       const std::vector<int64_t>& padding, const std::vector<int64_t>& dilation, bool submanifold) {
  RulebookArgs a{indices.const_data_ptr<int64_t>(), indices.size(0), num_frames, {}, {}, {}, {}, {}, {}};
  const auto take = [&](const char* name, const std::vector<int64_t>& from, int64_t least, int64_t* to) {
    PRED_CHECK(from.size() == 3, op, ": ", name, " must hold 3 numbers, got ", from.size());
    for (int axis = 0; axis < 3; ++axis) {
      PRED_CHECK(from[axis] >= least && from[axis] <= int64_t(1) << 30, op, ": ", name, " must lie in [", least,
                 ", 2^30], got ", from[axis]);
      to[axis] = from[axis];
    }
  };
  take("spatial_shape", shape, 1, a.in_shape);
  take("kernel_size", kernel, 1, a.kernel);
  take("stride", stride, 1, a.stride);
  take("padding", padding, 0, a.padding);
  take("dilation", dilation, 1, a.dilation);
  PRED_CHECK(num_frames >= 0, op, ": batch_size must not be negative, got ", num_frames);
  int64_t keys_in = std::max<int64_t>(1, num_frames), keys_out = keys_in, taps = 1;
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t reach = a.dilation[axis] * (a.kernel[axis] - 1);
    const bool kept = a.stride[axis] == 1 && a.kernel[axis] % 2 == 1 && 2 * a.padding[axis] == reach;
    PRED_CHECK(!submanifold || kept, op,
               ": padding must be dilation (kernel_size - 1) / 2 and stride 1 for a submanifold ", "kernel, got ",
               a.padding[axis], " and ", a.stride[axis], " for a kernel_size of ", a.kernel[axis]);
    const int64_t room = a.in_shape[axis] + 2 * a.padding[axis] - reach - 1;
    PRED_CHECK(room >= 0, op, ": spatial_shape must hold the kernel, got ", a.in_shape[axis], " for one of ",
               reach + 1 - 2 * a.padding[axis], " without the padding");
    a.out_shape[axis] = room / a.stride[axis] + 1;
    PRED_CHECK(keys_in <= kMaxKeys / a.in_shape[axis] && keys_out <= kMaxKeys / a.out_shape[axis], op,
               ": spatial_shape must give at most 2^62 sites in all frames, got ", shape_text(shape), " in ",
               num_frames);
    keys_in *= a.in_shape[axis];
    keys_out *= a.out_shape[axis];
    PRED_CHECK(taps <= 4096 / a.kernel[axis], op, ": kernel_size must give at most 4096 taps, got ",
               shape_text(kernel));
    taps *= a.kernel[axis];
  }
  PRED_CHECK(a.num_sites < kMaxRows / taps, op, ": indices must have fewer than 2^31 rows x taps, got ", a.num_sites,
             " x ", taps);
  return a;
}

// Outputs that one input can feed at most, and the number of keys of outputs.
struct OutputSizes {
  int64_t most = 1, num_keys;

  explicit OutputSizes(const RulebookArgs& a) : num_keys(std::max<int64_t>(1, a.num_frames)) {
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t period = a.stride[axis] / std::gcd(a.stride[axis], a.dilation[axis]);
      most *= (a.kernel[axis] + period - 1) / period;
      num_keys *= a.out_shape[axis];
    }
  }
};

void check_outputs(const char* op, int64_t num_out, int64_t taps) {
  PRED_CHECK(num_out < kMaxRows / taps, op, ": there must be fewer than 2^31 outputs x taps, got ", num_out, " x ",
             taps);
}

using Outputs = std::tuple<Tensor, Tensor, Tensor>;

#ifdef PRED_LAUNCH
Outputs rulebook(const char* op, const RulebookArgs& a, const Tensor& indices, bool submanifold) {
  const RulebookKernels& k = PRED_KERNELS(build_rulebook_all);
  const int64_t taps = num_taps(a);
  const auto new_table = [&](int64_t rows) { return torch::stable::new_empty(indices, {rows, taps}, ScalarType::Int); };
  const auto bytes = [&](int64_t count) { return torch::stable::new_empty(indices, {count}, ScalarType::Byte); };
  Tensor in_to_out = new_table(a.num_sites);
  int32_t* in_data = in_to_out.mutable_data_ptr<int32_t>();
  if (submanifold) {
    Tensor out_to_in = new_table(a.num_sites);
    const Tensor table = bytes(k.table_bytes(a.num_sites));
    k.submanifold(a, out_to_in.mutable_data_ptr<int32_t>(), in_data, mutable_storage<char>(table));
    return {torch::stable::clone(indices), out_to_in, in_to_out};
  }
  const OutputSizes sizes(a);
  const Tensor workspace = bytes(k.outputs_bytes(a, sizes.most, sizes.num_keys));
  const int64_t num_out = k.outputs(a, sizes.most, sizes.num_keys, mutable_storage<char>(workspace));
  check_outputs(op, num_out, taps);
  Tensor out_indices = torch::stable::new_empty(indices, {num_out, 4}), out_to_in = new_table(num_out);
  const Tensor table = bytes(k.table_bytes(num_out));
  k.strided(a, sizes.most, sizes.num_keys, num_out, out_indices.mutable_data_ptr<int64_t>(),
            out_to_in.mutable_data_ptr<int32_t>(), in_data, mutable_storage<char>(workspace),
            mutable_storage<char>(table));
  return {out_indices, out_to_in, in_to_out};
}
#else
// A hash table with the memory of its own.
struct OwnedTable {
  std::unique_ptr<int64_t[]> keys;
  std::unique_ptr<int32_t[]> rows;
  SiteTable table;

  explicit OwnedTable(int64_t count) {
    const int bits = table_bits(count);
    const int64_t slots = int64_t(1) << bits;
    keys = allocate_array<int64_t>(slots);
    rows = allocate_array<int32_t>(slots);
    std::fill_n(keys.get(), slots, int64_t(-1));
    table = {keys.get(), rows.get(), bits};
  }

  // The row that had the key before, or -1.
  int32_t insert(int64_t key, int32_t row) {
    const uint64_t slot = slot_of(table, key);
    if (table.keys[slot] == key) return table.rows[slot];
    table.keys[slot] = key;
    table.rows[slot] = row;
    return -1;
  }
};

void check_sites(const char* op, const RulebookArgs& a) {
  const RulebookKernels& k = PRED_KERNELS(build_rulebook_all);
  std::atomic<int64_t> first{a.num_sites};
  parallel(a.num_sites, 32768, [&](int64_t begin, int64_t end) {
    const int64_t found = k.find_outside(a, begin, end);
    int64_t known = first;
    while (found >= 0 && found < known && !first.compare_exchange_weak(known, found)) {
    }
  });
  if (first == a.num_sites) return;
  const int64_t* site = a.indices + 4 * first;
  PRED_CHECK(false, op, ": indices must lie inside batch_size ", a.num_frames, " and spatial_shape ",
             shape_text({a.in_shape[0], a.in_shape[1], a.in_shape[2]}), ", got ",
             shape_text({site[0], site[1], site[2], site[3]}), " in row ", int64_t(first));
}

void check_distinct(const char* op, const RulebookArgs& a, OwnedTable& table) {
  const RulebookKernels& k = PRED_KERNELS(build_rulebook_all);
  auto keys = allocate_array<int64_t>(a.num_sites);
  parallel(a.num_sites, 32768, [&](int64_t begin, int64_t end) { k.keys(a, keys.get(), begin, end); });
  for (int64_t i = 0; i < a.num_sites; ++i) {
    const int32_t before = table.insert(keys[i], int32_t(i));
    PRED_CHECK(before < 0, op, ": indices must be distinct, got one site in rows ", before, " and ", i);
  }
}

// The distinct keys of the outputs, ascending.
std::vector<int64_t> output_keys(const RulebookArgs& a, const RulebookKernels& k) {
  const OutputSizes sizes(a);
  const int64_t most = sizes.most, num_keys = sizes.num_keys;
  const auto fed = allocate_array<int64_t>(a.num_sites * most);
  parallel(a.num_sites, kGrain, [&](int64_t begin, int64_t end) { k.outputs(a, most, fed.get(), begin, end); });
  const auto sorted =
      sort_rows<uint64_t>(a.num_sites * most, 0, bits_for(num_keys), [&](uint64_t* items, int64_t begin, int64_t end) {
        int64_t count = 0;
        for (int64_t i = begin; i < end; ++i) {
          if (fed[i] >= 0) items[count++] = uint64_t(fed[i]);
        }
        return count;
      });
  std::vector<int64_t> keys;
  for (int64_t i = 0; i < sorted.count; ++i) {
    if (i == 0 || sorted.items[i] != sorted.items[i - 1]) keys.push_back(int64_t(sorted.items[i]));
  }
  return keys;
}

Outputs rulebook(const char* op, const RulebookArgs& a, const Tensor& indices, bool submanifold) {
  check_sites(op, a);
  const RulebookKernels& k = PRED_KERNELS(build_rulebook_all);
  OwnedTable inputs(a.num_sites);
  check_distinct(op, a, inputs);

  const int64_t taps = num_taps(a);
  const auto new_table = [&](int64_t rows) {
    Tensor table = torch::stable::new_empty(indices, {rows, taps}, ScalarType::Int);
    std::fill_n(table.mutable_data_ptr<int32_t>(), rows * taps, -1);
    return table;
  };
  Tensor in_to_out = new_table(a.num_sites);
  int32_t* in_data = in_to_out.mutable_data_ptr<int32_t>();
  if (submanifold) {
    Tensor out_to_in = new_table(a.num_sites);
    int32_t* out_data = out_to_in.mutable_data_ptr<int32_t>();
    parallel(a.num_sites, kGrain,
             [&](int64_t begin, int64_t end) { k.submanifold(a, inputs.table, out_data, in_data, begin, end); });
    return {torch::stable::clone(indices), out_to_in, in_to_out};
  }

  const std::vector<int64_t> keys = output_keys(a, k);
  const int64_t num_out = int64_t(keys.size());
  check_outputs(op, num_out, taps);
  OwnedTable outputs(num_out);
  Tensor out_indices = torch::stable::new_empty(indices, {num_out, 4});
  int64_t* site = out_indices.mutable_data_ptr<int64_t>();
  for (int64_t row = 0; row < num_out; ++row, site += 4) {
    int64_t key = keys[row];
    outputs.insert(key, int32_t(row));
    for (int axis = 2; axis >= 0; --axis) {
      site[axis + 1] = key % a.out_shape[axis];
      key /= a.out_shape[axis];
    }
    site[0] = key;
  }
  Tensor out_to_in = new_table(num_out);
  int32_t* out_data = out_to_in.mutable_data_ptr<int32_t>();
  parallel(a.num_sites, kGrain,
           [&](int64_t begin, int64_t end) { k.strided(a, outputs.table, out_data, in_data, begin, end); });
  return {out_indices, out_to_in, in_to_out};
}
#endif

Outputs build_rulebook(const Tensor& indices_in, int64_t batch_size, std::vector<int64_t> spatial_shape,
                       std::vector<int64_t> kernel_size, std::vector<int64_t> stride, std::vector<int64_t> padding,
                       std::vector<int64_t> dilation, bool submanifold) {
  const char* op = "build_rulebook";
  check_tensor(op, "indices", indices_in, 2, ScalarType::Long);
  PRED_CHECK(indices_in.size(1) == 4, op, ": indices must have shape [M, 4], got ", shape_text(indices_in));
  const Tensor indices = torch::stable::contiguous(indices_in);
  const RulebookArgs a =
      arguments(op, indices, batch_size, spatial_shape, kernel_size, stride, padding, dilation, submanifold);
  return rulebook(op, a, indices, submanifold);
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "build_rulebook", &pred::build_rulebook); }
