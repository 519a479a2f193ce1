// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "ops/sample_grid_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(SampleBevKernels, sample_bev)

struct Bev {
  static constexpr int kAxes = 2;
  static constexpr const char* kName = "sample_bev";
  static constexpr const char* kMap = "bev";
  template <typename S>
  static const SampleBevKernels<S>& table() {
    return sample_bev_kernels<S>();
  }
};
using SampleBev = SampleGrid<Bev>;

}  // namespace
}  // namespace pred
