// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "ops/sample_grid_binding.h"

namespace pred {
namespace {

struct Bev {
  static constexpr int kAxes = 2;
  static constexpr const char* kName = "sample_bev";
  static constexpr const char* kMap = "bev";
  template <typename S>
  static const SampleBevKernels<S>& table() {
    if constexpr (std::is_same_v<S, float>)
      return PRED_KERNELS(sample_bev_f32);
    else if constexpr (std::is_same_v<S, double>)
      return PRED_KERNELS(sample_bev_f64);
    else if constexpr (std::is_same_v<S, BFloat16>)
      return PRED_KERNELS(sample_bev_bf16);
    else
      return PRED_KERNELS(sample_bev_f16);
  }
};
using SampleBev = SampleGrid<Bev>;

}  // namespace
}  // namespace pred
