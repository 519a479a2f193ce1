// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_grid_cuda.cuh"

namespace pred::PRED_ISA {

const SampleBevKernels<float> sample_bev_f32 = sample_grid_kernels<float, 2>();
const SampleBevKernels<double> sample_bev_f64 = sample_grid_kernels<double, 2>();
const SampleBevKernels<BFloat16> sample_bev_bf16 = sample_grid_kernels<BFloat16, 2>();
const SampleBevKernels<Float16> sample_bev_f16 = sample_grid_kernels<Float16, 2>();

}  // namespace pred::PRED_ISA
