// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/resample_rays.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <string>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"
#include "ops/read_pdf_rule.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(ResampleRaysKernels, resample_rays)

Tensor resample_rays(const Tensor& t_in, const Tensor& weights_in, const Tensor& u_in, const std::string& mode,
                     double histogram_padding, double eps, double min_width) {
  return PRED_DISPATCH_FLOAT("resample_rays", t_in.scalar_type(), [&] {
    const char* op = "resample_rays";
    const ScalarType dtype = t_in.scalar_type();
    check_cpu_tensor(op, "t", t_in, 2, dtype);
    check_cpu_tensor(op, "weights", weights_in, 2, dtype);
    check_cpu_tensor(op, "u", u_in, u_in.dim() == 1 ? 1 : 2, dtype);
    const int64_t rays = t_in.size(0), samples = t_in.size(1), new_samples = u_in.size(u_in.dim() - 1);
    const int64_t num_weights = weights_in.size(1);
    PRED_CHECK(samples >= 2, op, ": t must have at least 2 samples per ray, got ", samples);
    PRED_CHECK(weights_in.size(0) == rays && (num_weights == samples || num_weights == samples - 1), op,
               ": weights must have one row per ray of ", samples, " or ", samples - 1, " weights, got ",
               shape_text(weights_in));
    PRED_CHECK(u_in.dim() == 1 || u_in.size(0) == rays, op, ": u must have one row per ray, got ", shape_text(u_in));
    PRED_CHECK(new_samples < (int64_t(1) << 30), op, ": u must have fewer than 2^30 samples per ray, got ",
               new_samples);
    const Tensor t = torch::stable::contiguous(t_in), weights = torch::stable::contiguous(weights_in);
    const Tensor u = torch::stable::contiguous(u_in);
    const ResampleRaysArgs<T> a{t.const_data_ptr<T>(),
                                weights.const_data_ptr<T>(),
                                u.const_data_ptr<T>(),
                                samples,
                                num_weights,
                                new_samples,
                                u.dim() == 1 ? 0 : new_samples,
                                read_pdf_rule<T>(op, mode, histogram_padding, eps, min_width)};
    Tensor merged = torch::stable::new_empty(t, {rays, samples + new_samples});
    T* out = merged.mutable_data_ptr<T>();
    const auto& k = kernels<T>();
    parallel(rays, 1 + 32768 / (samples + new_samples), [&](int64_t begin, int64_t end) {
      std::vector<T> scratch(k.scratch_size(a));
      std::vector<int32_t> int_scratch(k.int_scratch_size(a));
      k.resample(a, out, scratch.data(), int_scratch.data(), begin, end);
    });
    return merged;
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) { m.impl("resample_rays", TORCH_BOX(&pred::resample_rays)); }
