// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_pdf_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(SamplePdfKernels, resample_rays)

Tensor resample_rays(const Tensor& t, const Tensor& weights, const Tensor& u, const std::string& mode,
                     double histogram_padding, double eps, double min_width) {
  return PRED_DISPATCH_FLOAT("resample_rays", t.scalar_type(), [&] {
    return sample_sections<T>("resample_rays", "t", true, resample_rays_kernels<T>(), t, weights, u,
                              {mode, histogram_padding, eps, min_width});
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "resample_rays", &pred::resample_rays); }
