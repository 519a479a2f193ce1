// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// resample_rays: inverse-CDF samples of a ray's sections (sample_pdf.h), merged with the ray's own samples.
//
// Exact rule: sample k lies in the section i with cdf_i <= u_k < cdf_{i+1}, at t_i + (u_k - cdf_i) / (cdf_{i+1} -
// cdf_i) (t_{i+1} - t_i). So t_i comes after exactly the c_i samples with u_k < cdf_i, and the merge needs no
// comparison of ranges: it emits t_0, c_1 samples, t_1, c_2 - c_1 samples, and so on.
#pragma once

#include "ops/sample_pdf.h"

namespace pred {

template <typename T>
struct ResampleRaysArgs {
  const T* t;        // [R, S]
  const T* weights;  // [R, weight_stride]
  const T* u;        // [R, u_stride], or [num_new] with u_stride 0
  int64_t num_samples, weight_stride, num_new, u_stride;
  PdfRule<T> rule;
};

// Ranges count rays.
template <typename T>
struct ResampleRaysKernels {
  int64_t (*scratch_size)(const ResampleRaysArgs<T>&);      // in elements, for one range
  int64_t (*int_scratch_size)(const ResampleRaysArgs<T>&);  // likewise
  // merged [R, S + num_new]
  void (*resample)(const ResampleRaysArgs<T>&, T* merged, T* scratch, int32_t* int_scratch, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(ResampleRaysKernels<float>, resample_rays_f32)
PRED_DECLARE_KERNELS(ResampleRaysKernels<double>, resample_rays_f64)
