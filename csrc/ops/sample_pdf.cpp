// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_pdf_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(SamplePdfKernels, sample_pdf)

Tensor sample_pdf(const Tensor& edges, const Tensor& weights, const Tensor& u, const std::string& mode,
                  double histogram_padding, double eps, double min_width) {
  return PRED_DISPATCH_FLOAT("sample_pdf", edges.scalar_type(), [&] {
    return sample_sections<T>("sample_pdf", "edges", false, sample_pdf_kernels<T>(), edges, weights, u,
                              {mode, histogram_padding, eps, min_width});
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) { PRED_IMPL(m, "sample_pdf", &pred::sample_pdf); }
