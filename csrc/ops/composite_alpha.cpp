// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/composite_alpha.h"

#include "ops/composite_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(CompositeAlphaKernels, composite_alpha)

std::tuple<Tensor, Tensor, Tensor, Tensor> composite_alpha(const Tensor& alpha, std::optional<Tensor> t,
                                                           std::optional<Tensor> values,
                                                           std::optional<Tensor> ray_offsets, double eps,
                                                           bool depth_mid) {
  const char* op = "composite_alpha";
  return PRED_DISPATCH_STORAGE(op, storage_type(alpha, values), [&] {
    CompositeInputs<CompositeAlphaArgs<S>> in(op, "alpha", alpha, t, values, ray_offsets, depth_mid);
    in.args.eps = eps;
    return composite(in, composite_alpha_kernels<S>(), alpha, nullptr);
  });
}

std::tuple<Tensor, Tensor, Tensor> composite_alpha_backward(
    std::optional<Tensor> grad_weights, std::optional<Tensor> grad_depth, std::optional<Tensor> grad_opacity,
    std::optional<Tensor> grad_values, const Tensor& alpha, std::optional<Tensor> t, std::optional<Tensor> values,
    std::optional<Tensor> ray_offsets, double eps, bool depth_mid, bool need_alpha, bool need_t, bool need_values) {
  const char* op = "composite_alpha_backward";
  return PRED_DISPATCH_STORAGE(op, storage_type(alpha, values, grad_values), [&] {
    CompositeInputs<CompositeAlphaArgs<S>> in(op, "alpha", alpha, t, values, ray_offsets, depth_mid);
    in.args.eps = eps;
    auto [of_alpha, _, of_t, of_values] = composite_backward(
        in, composite_alpha_kernels<S>(), alpha, {grad_weights, grad_depth, grad_opacity, grad_values},
        {nullptr, nullptr}, {need_alpha, false, need_t, need_values});
    return std::make_tuple(of_alpha, of_t, of_values);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "composite_alpha", &pred::composite_alpha);
  PRED_IMPL(m, "composite_alpha_backward", &pred::composite_alpha_backward);
}
