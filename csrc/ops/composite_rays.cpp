// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/composite_rays.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <optional>
#include <tuple>
#include <vector>

#include "common/check.h"
#include "common/parallel.h"

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(CompositeRaysKernels, composite_rays)

// From this size on, a gradient would push everything else out of the caches.
constexpr int64_t kStreamBytes = int64_t(16) << 20;

// Rays per task, such that a task takes some 100 microseconds.
template <typename T>
int64_t ray_grain(const CompositeRaysArgs<T>& a) {
  return 1 + 65536 / (a.num_samples * (8 + a.channels) + 1);
}

// Contiguous copies of the arguments and the pointers into them.
template <typename T>
struct Inputs {
  Tensor sdf, t, values;
  std::vector<Tensor> kept;
  CompositeRaysArgs<T> args;
  int64_t num_rays;

  Inputs(const char* op, const Tensor& sdf_in, const Tensor& inv_s, const Tensor& t_in,
         const std::optional<Tensor>& values_in, bool depth_mid, bool last_opaque) {
    const ScalarType dtype = sdf_in.scalar_type();
    check_cpu_tensor(op, "sdf", sdf_in, 2, dtype);
    num_rays = sdf_in.size(0);
    check_cpu_tensor(op, "t", t_in, 2, dtype);
    check_sizes(op, "t", t_in, {num_rays, sdf_in.size(1)});
    sdf = torch::stable::contiguous(sdf_in);
    t = torch::stable::contiguous(t_in);
    args = {sdf.const_data_ptr<T>(),
            t.const_data_ptr<T>(),
            nullptr,
            read_sharpness<T>(op, inv_s, dtype),
            sdf.size(1),
            0,
            depth_mid,
            last_opaque};
    if (!values_in) return;
    check_cpu_tensor(op, "values", *values_in, 3, dtype);
    check_sizes(op, "values", *values_in, {num_rays, args.num_samples, values_in->size(2)});
    values = torch::stable::contiguous(*values_in);
    args.values = values.const_data_ptr<T>();
    args.channels = values.size(2);
  }

  // Of a contiguous copy, if need be; null where there is no tensor.
  const T* pointer(const char* op, const char* name, const std::optional<Tensor>& tensor, std::vector<int64_t> shape) {
    if (!tensor) return nullptr;
    check_cpu_tensor(op, name, *tensor, int64_t(shape.size()), sdf.scalar_type());
    check_sizes(op, name, *tensor, shape);
    kept.push_back(torch::stable::contiguous(*tensor));
    return kept.back().const_data_ptr<T>();
  }

  template <class Body>
  void for_rays(const Body& body) const {
    const auto& k = kernels<T>();
    parallel(num_rays, ray_grain(args), [&](int64_t begin, int64_t end) {
      std::vector<T> scratch(k.scratch_size(args));
      body(k, scratch.data(), begin, end);
    });
  }
};

template <typename T>
T* data(Tensor& tensor) {
  return tensor.mutable_data_ptr<T>();
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> composite_rays(const Tensor& sdf, const Tensor& inv_s,
                                                                  const Tensor& t, std::optional<Tensor> values,
                                                                  bool depth_mid, bool last_opaque) {
  return PRED_DISPATCH_FLOAT("composite_rays", sdf.scalar_type(), [&] {
    const Inputs<T> in("composite_rays", sdf, inv_s, t, values, depth_mid, last_opaque);
    const CompositeRaysArgs<T>& a = in.args;
    Tensor weights = torch::stable::new_empty(sdf, {in.num_rays, a.num_samples});
    Tensor depth = torch::stable::new_empty(sdf, {in.num_rays});
    Tensor opacity = torch::stable::new_empty(sdf, {in.num_rays});
    Tensor rendered =
        values ? torch::stable::new_empty(sdf, {in.num_rays, a.channels}) : torch::stable::new_empty(sdf, {0});
    Tensor remaining = torch::stable::new_empty(sdf, {in.num_rays});
    if (a.num_samples == 0) {
      for (Tensor* empty : {&depth, &opacity, &rendered}) torch::stable::zero_(*empty);
      torch::stable::fill_(remaining, 1.0);
      return std::make_tuple(weights, depth, opacity, rendered, remaining);
    }
    const CompositeRaysOutputs<T> out{data<T>(weights), data<T>(depth), data<T>(opacity), data<T>(rendered),
                                      data<T>(remaining)};
    in.for_rays([&](const auto& k, T* scratch, int64_t begin, int64_t end) { k.forward(a, out, scratch, begin, end); });
    return std::make_tuple(weights, depth, opacity, rendered, remaining);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> composite_rays_backward(
    std::optional<Tensor> grad_weights, std::optional<Tensor> grad_depth, std::optional<Tensor> grad_opacity,
    std::optional<Tensor> grad_values, const Tensor& sdf, const Tensor& inv_s, const Tensor& t,
    std::optional<Tensor> values, const Tensor& weights, const Tensor& remaining, bool depth_mid, bool last_opaque,
    bool need_sdf, bool need_inv_s, bool need_t, bool need_values) {
  return PRED_DISPATCH_FLOAT("composite_rays_backward", sdf.scalar_type(), [&] {
    const char* op = "composite_rays_backward";
    Inputs<T> in(op, sdf, inv_s, t, values, depth_mid, last_opaque);
    CompositeRaysArgs<T>& a = in.args;
    const int64_t rays = in.num_rays, samples = a.num_samples;
    if (grad_values && !values) {  // values are needed for dL/dsdf only
      check_cpu_tensor(op, "grad_values", *grad_values, 2, sdf.scalar_type());
      a.channels = grad_values->size(1);
    }
    PRED_CHECK(values || !grad_values || !(need_sdf || need_inv_s), op, ": values are missing");
    PRED_CHECK(!need_t || grad_depth, op, ": need_t asks for grad_depth");
    PRED_CHECK(!need_values || grad_values, op, ": need_values asks for grad_values");
    const CompositeRaysCotangents<T> grad{in.pointer(op, "grad_weights", grad_weights, {rays, samples}),
                                          in.pointer(op, "grad_depth", grad_depth, {rays}),
                                          in.pointer(op, "grad_opacity", grad_opacity, {rays}),
                                          in.pointer(op, "grad_values", grad_values, {rays, a.channels})};
    const CompositeRaysSaved<T> saved{in.pointer(op, "weights", weights, {rays, samples}),
                                      in.pointer(op, "remaining", remaining, {rays})};
    const auto output = [&](bool need, std::vector<int64_t> shape) {
      return torch::stable::new_empty(sdf, need ? shape : std::vector<int64_t>{0});
    };
    Tensor out_sdf = output(need_sdf, {rays, samples}), out_inv_s = output(need_inv_s, {});
    Tensor out_t = output(need_t, {rays, samples}), out_values = output(need_values, {rays, samples, a.channels});
    std::vector<double> per_ray(need_inv_s ? rays : 0);
    const CompositeRaysGradients<T> out{need_sdf ? data<T>(out_sdf) : nullptr, need_inv_s ? per_ray.data() : nullptr,
                                        need_t ? data<T>(out_t) : nullptr, need_values ? data<T>(out_values) : nullptr,
                                        rays * samples * a.channels * int64_t(sizeof(T)) >= kStreamBytes};
    if (samples > 0) {
      in.for_rays([&](const auto& k, T* scratch, int64_t begin, int64_t end) {
        k.backward(a, saved, grad, out, scratch, begin, end);
      });
    }
    if (need_inv_s) *data<T>(out_inv_s) = T(ordered_sum(per_ray));
    return std::make_tuple(out_sdf, out_inv_s, out_t, out_values);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) {
  m.impl("composite_rays", TORCH_BOX(&pred::composite_rays));
  m.impl("composite_rays_backward", TORCH_BOX(&pred::composite_rays_backward));
}
