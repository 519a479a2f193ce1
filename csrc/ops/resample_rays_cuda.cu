// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/inverse_cdf_cuda.cuh"

namespace pred::PRED_ISA {

const SamplePdfKernels<float> resample_rays_f32 = inverse_cdf_kernels<float, true>();
const SamplePdfKernels<double> resample_rays_f64 = inverse_cdf_kernels<double, true>();

}  // namespace pred::PRED_ISA
