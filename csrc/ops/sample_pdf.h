// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// sample_pdf: inverse-CDF samples of a ray's sections, by one of three rules. resample_rays: such samples, merged with
// the ray's own, which are the edges.
//
// Sample k lies in the section i with cdf_i <= u_k < cdf_{i+1}, at
//   e_i + (u_k - cdf_i) / (cdf_{i+1} - cdf_i) (e_{i+1} - e_i).
// The rules differ in what is done to the weights before they are summed, and in narrow sections.
#pragma once

#include "common/host_device.h"
#include "common/isa.h"

namespace pred {

enum class PdfMode {
  kExact,       // weights as they are, the last cdf is 1; useless weights give the uniform distribution
  kNeus,        // eps is added to each weight; sections narrower than eps in the cdf count as 1 wide
  kNerfstudio,  // histogram_padding is added to each weight, and what is missing of eps to their sum; the cdf is at
                // most 1; sections narrower than min_width count as 1 wide; samples stay in their section
};

template <typename T>
struct PdfRule {
  PdfMode mode;
  T histogram_padding, eps, min_width;
};

template <typename T>
struct SamplePdfArgs {
  const T* edges;    // [R, S]
  const T* weights;  // [R, weight_stride]
  const T* u;        // [R, u_stride], or [num_new] with u_stride 0
  int64_t num_edges, weight_stride, num_new, u_stride;
  PdfRule<T> rule;
};

// Ranges count rays.
template <typename T>
struct SamplePdfKernels {
  int64_t (*scratch_size)(const SamplePdfArgs<T>&);      // in elements, for one range
  int64_t (*int_scratch_size)(const SamplePdfArgs<T>&);  // likewise
  // out: [R, num_new], or merged [R, S + num_new]
  void (*sample)(const SamplePdfArgs<T>&, T* out, T* scratch, int32_t* int_scratch, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SamplePdfKernels<float>, sample_pdf_f32)
PRED_DECLARE_KERNELS(SamplePdfKernels<double>, sample_pdf_f64)
PRED_DECLARE_KERNELS(SamplePdfKernels<float>, resample_rays_f32)
PRED_DECLARE_KERNELS(SamplePdfKernels<double>, resample_rays_f64)
