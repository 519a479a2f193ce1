// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Rows of boxes, checked and made columns, for the bindings of the ops on boxes.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <memory>

#include "common/allocate.h"
#include "common/check.h"
#include "common/parallel.h"
#include "math/rotated_box.h"

namespace pred {

// A table of its own memory; all rows are no boxes at first.
class BoxColumns {
 public:
  explicit BoxColumns(int64_t count)
      : memory_(allocate_array<double>(kBoxColumns * BoxTable::stride_of(count))),
        table_{memory_.get(), BoxTable::stride_of(count), count} {
    for (int64_t row = 0; row < table_.stride; ++row) put_box(table_, row, no_box());
  }

  const BoxTable& table() const { return table_; }

 private:
  std::unique_ptr<double[]> memory_;
  BoxTable table_;
};

inline Tensor read_box_rows(const char* op, const char* name, const Tensor& boxes, ScalarType dtype) {
  check_tensor(op, name, boxes, 2, dtype);
  PRED_CHECK(boxes.size(1) == 7, op, ": ", name, " must have shape [N, 7], got ", shape_text(boxes));
  return torch::stable::contiguous(boxes);
}

// rows: [N, 7], contiguous.
template <typename T>
BoxColumns box_columns(const Tensor& rows) {
  BoxColumns columns(rows.size(0));
  const T* data = rows.const_data_ptr<T>();
  parallel(rows.size(0), 512, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) put_box(columns.table(), row, read_box(data + 7 * row));
  });
  return columns;
}

}  // namespace pred
