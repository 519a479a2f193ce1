// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// The last step of sums that are made in parts: always in the same order.
#pragma once

#include <stdint.h>

namespace pred {

#ifdef PRED_LAUNCH
void add_parts(const double* parts, int64_t count, float* sum);
void add_parts(const double* parts, int64_t count, double* sum);
#else
template <typename T>
void add_parts(const double* parts, int64_t count, T* sum) {
  double total = 0;
  for (int64_t i = 0; i < count; ++i) total += parts[i];
  *sum = T(total);
}
#endif

}  // namespace pred
