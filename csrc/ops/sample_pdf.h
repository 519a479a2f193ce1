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
struct Limits;
template <>
struct Limits<float> {
  static constexpr float smallest = __FLT_MIN__, largest = __FLT_MAX__, below_one = 1.0f - __FLT_EPSILON__ / 2;
};
template <>
struct Limits<double> {
  static constexpr double smallest = __DBL_MIN__, largest = __DBL_MAX__, below_one = 1.0 - __DBL_EPSILON__ / 2;
};

// To [0, 1); keeps NaN.
template <typename T>
PRED_HOST_DEVICE T clip_position(T u) {
  const T low = u < T(0) ? T(0) : u;
  return low > Limits<T>::below_one ? Limits<T>::below_one : low;
}

// The sample of u in the section [start, end) of the cumulative distribution [cdf, next_cdf).
template <typename T>
PRED_HOST_DEVICE T exact_sample(T u, T cdf, T next_cdf, T start, T end) {
  const T width = next_cdf - cdf, fraction = (u - cdf) / (width > T(0) ? width : T(1));
  return start + fraction * (end - start);
}

template <typename T>
PRED_HOST_DEVICE T published_sample(const PdfRule<T>& rule, T u, T cdf, T next_cdf, T start, T end) {
  const bool neus = rule.mode == PdfMode::kNeus;
  const T narrow = neus ? rule.eps : rule.min_width, width = next_cdf - cdf;
  const T fraction = (u - cdf) / (narrow > T(0) && width < narrow ? T(1) : width);
  const T positive = fraction >= T(0) ? fraction : T(0), clipped = positive > T(1) ? T(1) : positive;
  // With a least width nothing is divided by 0, and NaN is that of the input.
  const T kept = neus || (narrow > T(0) && fraction != fraction) ? fraction : clipped;
  return start + kept * (end - start);
}

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
  int64_t (*scratch_size)(const SamplePdfArgs<T>&);      // in elements, for one range; launched, for all rays
  int64_t (*int_scratch_size)(const SamplePdfArgs<T>&);  // likewise; launched, there is none
  // out: [R, num_new], or merged [R, S + num_new]
  void (*sample)(const SamplePdfArgs<T>&, T* out, T* scratch, int32_t* int_scratch, int64_t begin, int64_t end);
};

}  // namespace pred

PRED_DECLARE_KERNELS(SamplePdfKernels<float>, sample_pdf_f32)
PRED_DECLARE_KERNELS(SamplePdfKernels<double>, sample_pdf_f64)
PRED_DECLARE_KERNELS(SamplePdfKernels<float>, resample_rays_f32)
PRED_DECLARE_KERNELS(SamplePdfKernels<double>, resample_rays_f64)
