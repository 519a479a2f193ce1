// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/composite_rays.h"

#include "ops/composite_binding.h"

namespace pred {
namespace {

PRED_KERNELS_BY_STORAGE(CompositeRaysKernels, composite_rays)

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> composite_rays(const Tensor& sdf, const Tensor& inv_s,
                                                                  const Tensor& t, std::optional<Tensor> values,
                                                                  std::optional<Tensor> ray_offsets, bool depth_mid,
                                                                  bool last_opaque) {
  const char* op = "composite_rays";
  return PRED_DISPATCH_STORAGE(op, storage_type(sdf, values), [&] {
    CompositeInputs<CompositeRaysArgs<S>> in(op, "sdf", sdf, t, values, ray_offsets, depth_mid);
    in.args.inv_s = sharpness<T>(op, inv_s, in.dtype);
    in.args.last_opaque = last_opaque;
    Tensor remaining = output_tensor(sdf, true, {in.num_rays}, in.dtype);
    auto out = composite(in, composite_rays_kernels<S>(), sdf, mutable_storage<T>(remaining));
    return std::tuple_cat(out, std::make_tuple(remaining));
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> composite_rays_backward(
    std::optional<Tensor> grad_weights, std::optional<Tensor> grad_depth, std::optional<Tensor> grad_opacity,
    std::optional<Tensor> grad_values, const Tensor& sdf, const Tensor& inv_s, const Tensor& t,
    std::optional<Tensor> values, std::optional<Tensor> ray_offsets, const Tensor& weights, const Tensor& remaining,
    bool depth_mid, bool last_opaque, bool need_sdf, bool need_inv_s, bool need_t, bool need_values) {
  const char* op = "composite_rays_backward";
  return PRED_DISPATCH_STORAGE(op, storage_type(sdf, values, grad_values), [&] {
    CompositeInputs<CompositeRaysArgs<S>> in(op, "sdf", sdf, t, values, ray_offsets, depth_mid);
    in.args.inv_s = sharpness<T>(op, inv_s, in.dtype);
    in.args.last_opaque = last_opaque;
    const CompositeSaved<T> saved{in.template pointer<T>("weights", weights, in.samples),
                                  in.template pointer<T>("remaining", remaining, {in.num_rays})};
    return composite_backward(in, composite_rays_kernels<S>(), sdf,
                              {grad_weights, grad_depth, grad_opacity, grad_values}, saved,
                              {need_sdf, need_inv_s, need_t, need_values});
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "composite_rays", &pred::composite_rays);
  PRED_IMPL(m, "composite_rays_backward", &pred::composite_rays_backward);
}
