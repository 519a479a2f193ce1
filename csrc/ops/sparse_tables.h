// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The tables of a rulebook as arguments of an op.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <atomic>

#include "common/check.h"
#include "common/parallel.h"
#include "ops/sparse_conv.h"

namespace pred {

// A table [rows, taps] whose numbers are rows of another, or -1.
inline Tensor checked_table(const char* op, const char* name, const Tensor& table_in, int64_t rows, int64_t taps,
                            [[maybe_unused]] int64_t numbers) {
  check_tensor(op, name, table_in, 2, ScalarType::Int);
  check_sizes(op, name, table_in, {rows, taps});
  const Tensor table = torch::stable::contiguous(table_in);
#ifndef PRED_LAUNCH
  const int32_t* data = table.const_data_ptr<int32_t>();
  const auto& k = PRED_KERNELS(sparse_conv_f32);
  std::atomic<bool> valid{true};
  parallel(rows * taps, 65536, [&](int64_t begin, int64_t end) {
    if (!k.is_valid(data, numbers, begin, end)) valid = false;
  });
  for (int64_t i = 0; !valid; ++i) {
    PRED_CHECK(data[i] >= -1 && data[i] < numbers, op, ": ", name, " must lie in [-1, ", numbers, "), got ", data[i],
               " in row ", i / taps);
  }
#endif
  return table;
}

// Rows of a table, for any number of taps.
inline int64_t table_rows(const char* op, const char* name, const Tensor& table) {
  PRED_CHECK(table.dim() == 2, op, ": ", name, " must have 2 dimensions, got shape ", shape_text(table));
  PRED_CHECK(table.size(0) < int64_t(1) << 31, op, ": ", name, " must have fewer than 2^31 rows, got ", table.size(0));
  return table.size(0);
}

}  // namespace pred
