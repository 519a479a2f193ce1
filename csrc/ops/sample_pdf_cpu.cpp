// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// One iteration owns one ray and writes that ray's row only.
#include "ops/inverse_cdf.h"

namespace pred::PRED_ISA {
namespace {

template <typename T>
static void sample(const SamplePdfArgs<T>& a, T* samples, T* scratch, int32_t* int_scratch, int64_t begin,
                   int64_t end) {
  const Row<T> row = make_row(a, scratch, int_scratch);
  const bool exact = a.rule.mode == PdfMode::kExact;
  for (int64_t ray = begin; ray < end; ++ray) {
    if (a.u_stride != 0 || ray == begin) {
      const T* u = a.u + ray * a.u_stride;
      for (int64_t k = 0; k < a.num_new; ++k) row.u[k] = exact ? clip_position(u[k]) : u[k];
    }
    read_ranges(a.edges + ray * a.num_edges, row);
    const T* weights = a.weights + ray * a.weight_stride;
    T* out = samples + ray * a.num_new;
    if (exact) {
      exact_samples(distribution(weights, row), a.num_new, row, out);
    } else {
      published_distribution(a.rule, weights, row);
      published_samples(a.rule, a.num_new, row, out);
    }
  }
}

}  // namespace

const SamplePdfKernels<float> sample_pdf_f32 = {scratch_size<float>, int_scratch_size<float>, sample<float>};
const SamplePdfKernels<double> sample_pdf_f64 = {scratch_size<double>, int_scratch_size<double>, sample<double>};

}  // namespace pred::PRED_ISA
