// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Tables of boxes on the device, for the kernels that are launched on them.
#pragma once

#include "math/rotated_box.h"

namespace pred {

#ifdef PRED_LAUNCH
// All rows of the table, those that fill up the last group too. rows: [count, 7], contiguous.
void put_boxes(const float* rows, const BoxTable& table);
void put_boxes(const double* rows, const BoxTable& table);
#endif

}  // namespace pred
