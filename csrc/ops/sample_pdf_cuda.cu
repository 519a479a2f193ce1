// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/inverse_cdf_cuda.cuh"

namespace pred::PRED_ISA {

const SamplePdfKernels<float> sample_pdf_f32 = inverse_cdf_kernels<float, false>();
const SamplePdfKernels<double> sample_pdf_f64 = inverse_cdf_kernels<double, false>();

}  // namespace pred::PRED_ISA
