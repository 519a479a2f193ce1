// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sample_pdf.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <string>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"
#include "ops/read_pdf_rule.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(SamplePdfKernels, sample_pdf)

Tensor sample_pdf(const Tensor& edges_in, const Tensor& weights_in, const Tensor& u_in, const std::string& mode,
                  double histogram_padding, double eps, double min_width) {
  return PRED_DISPATCH_FLOAT("sample_pdf", edges_in.scalar_type(), [&] {
    const char* op = "sample_pdf";
    const ScalarType dtype = edges_in.scalar_type();
    check_cpu_tensor(op, "edges", edges_in, 2, dtype);
    check_cpu_tensor(op, "weights", weights_in, 2, dtype);
    check_cpu_tensor(op, "u", u_in, u_in.dim() == 1 ? 1 : 2, dtype);
    const int64_t rays = edges_in.size(0), num_edges = edges_in.size(1), num_new = u_in.size(u_in.dim() - 1);
    const int64_t num_weights = weights_in.size(1);
    PRED_CHECK(num_edges >= 2 && num_edges < (int64_t(1) << 30), op, ": edges must have 2 to 2^30 edges per ray, got ",
               num_edges);
    PRED_CHECK(weights_in.size(0) == rays && (num_weights == num_edges || num_weights == num_edges - 1), op,
               ": weights must have one row per ray of ", num_edges, " or ", num_edges - 1, " weights, got ",
               shape_text(weights_in));
    PRED_CHECK(u_in.dim() == 1 || u_in.size(0) == rays, op, ": u must have one row per ray, got ", shape_text(u_in));
    const Tensor edges = torch::stable::contiguous(edges_in), weights = torch::stable::contiguous(weights_in);
    const Tensor u = torch::stable::contiguous(u_in);
    const SamplePdfArgs<T> a{edges.const_data_ptr<T>(),
                             weights.const_data_ptr<T>(),
                             u.const_data_ptr<T>(),
                             num_edges,
                             num_weights,
                             num_new,
                             u.dim() == 1 ? 0 : num_new,
                             read_pdf_rule<T>(op, mode, histogram_padding, eps, min_width)};
    Tensor samples = torch::stable::new_empty(edges, {rays, num_new});
    T* out = samples.mutable_data_ptr<T>();
    if (num_new == 0) return samples;
    const auto& k = kernels<T>();
    parallel(rays, 1 + 32768 / (num_edges + num_new), [&](int64_t begin, int64_t end) {
      std::vector<T> scratch(k.scratch_size(a));
      std::vector<int32_t> int_scratch(k.int_scratch_size(a));
      k.sample(a, out, scratch.data(), int_scratch.data(), begin, end);
    });
    return samples;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) { m.impl("sample_pdf", TORCH_BOX(&pred::sample_pdf)); }
