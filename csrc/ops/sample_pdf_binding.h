// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What the bindings of sample_pdf and resample_rays share: all but the width of the result.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <string>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"
#include "ops/sample_pdf.h"

namespace pred {
namespace {

struct PdfOptions {
  const std::string& mode;
  double histogram_padding, eps, min_width;
};

template <typename T>
PdfRule<T> read_rule(const char* op, const PdfOptions& options) {
  const std::string& mode = options.mode;
  PRED_CHECK(mode == "exact" || mode == "neus" || mode == "nerfstudio", op,
             ": mode must be exact, neus or nerfstudio, got ", mode);
  const PdfMode found = mode == "exact" ? PdfMode::kExact : mode == "neus" ? PdfMode::kNeus : PdfMode::kNerfstudio;
  return {found, T(options.histogram_padding), T(options.eps), T(options.min_width)};
}

// `name`: what the op calls its edges. `merged`: the result holds the edges too.
template <typename T>
Tensor sample_sections(const char* op, const char* name, bool merged, const SamplePdfKernels<T>& k,
                       const Tensor& edges_in, const Tensor& weights_in, const Tensor& u_in,
                       const PdfOptions& options) {
  constexpr int64_t kMost = int64_t(1) << 30;
  const ScalarType dtype = edges_in.scalar_type();
  check_tensor(op, name, edges_in, 2, dtype);
  check_tensor(op, "weights", weights_in, 2, dtype);
  check_tensor(op, "u", u_in, u_in.dim() == 1 ? 1 : 2, dtype);
  const int64_t rays = edges_in.size(0), num_edges = edges_in.size(1), num_new = u_in.size(u_in.dim() - 1);
  const int64_t num_weights = weights_in.size(1);
  PRED_CHECK(num_edges >= 2 && num_edges < kMost, op, ": ", name, " must have at least 2 and fewer than 2^30 samples ",
             "per ray, got ", num_edges);
  PRED_CHECK(weights_in.size(0) == rays && (num_weights == num_edges || num_weights == num_edges - 1), op,
             ": weights must have one row per ray of ", num_edges, " or ", num_edges - 1, " weights, got ",
             shape_text(weights_in));
  PRED_CHECK(u_in.dim() == 1 || u_in.size(0) == rays, op, ": u must have one row per ray, got ", shape_text(u_in));
  PRED_CHECK(num_new < kMost, op, ": u must have fewer than 2^30 samples per ray, got ", num_new);
  const Tensor edges = torch::stable::contiguous(edges_in), weights = torch::stable::contiguous(weights_in);
  const Tensor u = torch::stable::contiguous(u_in);
  const SamplePdfArgs<T> a{
      edges.const_data_ptr<T>(),  weights.const_data_ptr<T>(), u.const_data_ptr<T>(), num_edges, num_weights, num_new,
      u.dim() == 1 ? 0 : num_new, read_rule<T>(op, options)};
  Tensor samples = torch::stable::new_empty(edges, {rays, merged ? num_edges + num_new : num_new});
  if (samples.numel() == 0) return samples;
  T* out = samples.mutable_data_ptr<T>();
  if (kLaunch) {
    const Tensor scratch = torch::stable::new_empty(edges, {k.scratch_size(a)});
    k.sample(a, out, scratch.mutable_data_ptr<T>(), nullptr, 0, rays);
    return samples;
  }
  parallel(rays, 1 + 32768 / (num_edges + num_new), [&](int64_t begin, int64_t end) {
    std::vector<T> scratch(k.scratch_size(a));
    std::vector<int32_t> int_scratch(k.int_scratch_size(a));
    k.sample(a, out, scratch.data(), int_scratch.data(), begin, end);
  });
  return samples;
}

}  // namespace
}  // namespace pred
