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
#include "ops/box_table.h"

namespace pred {

// A table of its own memory, on the device of a tensor.
class BoxColumns {
 public:
#ifdef PRED_LAUNCH
  BoxColumns(const Tensor& like, int64_t count)
      : memory_(torch::stable::new_empty(like, {kBoxColumns * BoxTable::stride_of(count)}, ScalarType::Double)),
        table_{memory_.mutable_data_ptr<double>(), BoxTable::stride_of(count), count} {}
#else
  // All rows are no boxes at first.
  BoxColumns(const Tensor&, int64_t count)
      : memory_(allocate_array<double>(kBoxColumns * BoxTable::stride_of(count))),
        table_{memory_.get(), BoxTable::stride_of(count), count} {
    for (int64_t row = 0; row < table_.stride; ++row) put_box(table_, row, no_box());
  }
#endif

  const BoxTable& table() const { return table_; }

 private:
#ifdef PRED_LAUNCH
  Tensor memory_;
#else
  std::unique_ptr<double[]> memory_;
#endif
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
  BoxColumns columns(rows, rows.size(0));
  const T* data = rows.const_data_ptr<T>();
#ifdef PRED_LAUNCH
  put_boxes(data, columns.table());
#else
  parallel(rows.size(0), 512, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) put_box(columns.table(), row, read_box(data + 7 * row));
  });
#endif
  return columns;
}

}  // namespace pred
