// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sdf_to_alpha.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <tuple>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(SdfToAlphaKernels, sdf_to_alpha)

// Rays per task, such that a task takes some 50 microseconds.
int64_t ray_grain(int64_t num_samples) { return 1 + 16384 / (num_samples + 1); }

template <typename T>
SdfToAlphaArgs<T> arguments(const char* op, const Tensor& sdf, const Tensor& inv_s, bool last_opaque) {
  return {sdf.const_data_ptr<T>(), read_sharpness<T>(op, inv_s, sdf.scalar_type()), sdf.size(1), last_opaque};
}

Tensor sdf_to_alpha(const Tensor& sdf_in, const Tensor& inv_s, bool last_opaque) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha", sdf_in.scalar_type(), [&] {
    check_cpu_tensor("sdf_to_alpha", "sdf", sdf_in, 2, sdf_in.scalar_type());
    const Tensor sdf = torch::stable::contiguous(sdf_in);
    const auto a = arguments<T>("sdf_to_alpha", sdf, inv_s, last_opaque);
    Tensor alpha = torch::stable::new_empty(sdf, {sdf.size(0), a.num_samples});
    T* out = alpha.mutable_data_ptr<T>();
    if (a.num_samples == 0) return alpha;
    const auto& k = kernels<T>();
    parallel(sdf.size(0), ray_grain(a.num_samples), [&](int64_t begin, int64_t end) { k.forward(a, out, begin, end); });
    return alpha;
  });
}

std::tuple<Tensor, Tensor> sdf_to_alpha_backward(const Tensor& grad_in, const Tensor& sdf_in, const Tensor& inv_s,
                                                 bool need_sdf, bool need_inv_s) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_backward", sdf_in.scalar_type(), [&] {
    const char* op = "sdf_to_alpha_backward";
    check_cpu_tensor(op, "sdf", sdf_in, 2, sdf_in.scalar_type());
    check_cpu_tensor(op, "grad", grad_in, 2, sdf_in.scalar_type());
    check_sizes(op, "grad", grad_in, {sdf_in.size(0), sdf_in.size(1)});
    const Tensor sdf = torch::stable::contiguous(sdf_in), grad = torch::stable::contiguous(grad_in);
    const auto a = arguments<T>(op, sdf, inv_s, false);
    const int64_t rays = sdf.size(0), samples = a.num_samples;
    Tensor grad_sdf = need_sdf ? torch::stable::new_empty(sdf, {rays, samples}) : torch::stable::new_empty(sdf, {0});
    Tensor grad_inv_s = torch::stable::new_empty(sdf, std::vector<int64_t>(need_inv_s ? 0 : 1, 0));
    T* out = need_sdf ? grad_sdf.mutable_data_ptr<T>() : nullptr;
    std::vector<double> per_ray(need_inv_s ? rays : 0);
    const auto& k = kernels<T>();
    if (samples > 0) {
      parallel(rays, ray_grain(samples), [&](int64_t begin, int64_t end) {
        std::vector<T> scratch(3 * samples);
        k.backward(a, grad.const_data_ptr<T>(), out, need_inv_s ? per_ray.data() : nullptr, scratch.data(), begin, end);
      });
    }
    if (need_inv_s) *grad_inv_s.mutable_data_ptr<T>() = T(ordered_sum(per_ray));
    return std::make_tuple(grad_sdf, grad_inv_s);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) {
  m.impl("sdf_to_alpha", TORCH_BOX(&pred::sdf_to_alpha));
  m.impl("sdf_to_alpha_backward", TORCH_BOX(&pred::sdf_to_alpha_backward));
}
