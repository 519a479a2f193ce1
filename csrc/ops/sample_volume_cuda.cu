// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_grid_cuda.cuh"

namespace pred::PRED_ISA {

const SampleVolumeKernels<float> sample_volume_f32 = sample_grid_kernels<float, 3>();
const SampleVolumeKernels<double> sample_volume_f64 = sample_grid_kernels<double, 3>();
const SampleVolumeKernels<BFloat16> sample_volume_bf16 = sample_grid_kernels<BFloat16, 3>();
const SampleVolumeKernels<Float16> sample_volume_f16 = sample_grid_kernels<Float16, 3>();

}  // namespace pred::PRED_ISA
