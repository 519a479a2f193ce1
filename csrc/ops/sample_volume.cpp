// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_grid_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(SampleVolumeKernels, sample_volume)

struct Volume {
  static constexpr int kAxes = 3;
  static constexpr const char* kName = "sample_volume";
  static constexpr const char* kMap = "volume";
  template <typename S>
  static const SampleVolumeKernels<S>& table() {
    return sample_volume_kernels<S>();
  }
};
using SampleVolume = SampleGrid<Volume>;

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "sample_volume", &pred::SampleVolume::forward);
  PRED_IMPL(m, "sample_volume_backward", &pred::SampleVolume::backward);
  PRED_IMPL(m, "sample_volume_double_backward", &pred::SampleVolume::double_backward);
  PRED_IMPL(m, "sample_volume_with_grad", &pred::SampleVolume::with_grad);
  PRED_IMPL(m, "sample_volume_with_grad_backward", &pred::SampleVolume::with_grad_backward);
}
