// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// What the bindings of composite_rays and composite_alpha share: checks, outputs, and the division of rays into tasks.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <optional>
#include <tuple>
#include <vector>

#include "common/check.h"
#include "common/clouds.h"
#include "common/parallel.h"
#include "common/parts.h"
#include "ops/composite.h"

namespace pred {
namespace {

constexpr ScalarType scalar_type(float) { return ScalarType::Float; }
constexpr ScalarType scalar_type(double) { return ScalarType::Double; }
constexpr ScalarType scalar_type(BFloat16) { return ScalarType::BFloat16; }
constexpr ScalarType scalar_type(Float16) { return ScalarType::Half; }

// Rays in order, in tasks of some 100 microseconds. Which ray is in which task depends on the rays' lengths only.
struct RayTasks {
  RayRows rows;
  int64_t num_rays, num_tasks;

  RayTasks(const RayRows& ray_rows, int64_t rays, int64_t channels) : rows(ray_rows), num_rays(rays) {
    num_tasks = std::min<int64_t>(rays, 1 + work_before(rays) * (8 + channels) / 65536);
  }

  // A ray costs some samples' time, even when it has none.
  int64_t work_before(int64_t ray) const { return ray_begin(rows, ray) + 8 * ray; }

  int64_t first_ray(int64_t task) const {
    const double share = double(task) / double(num_tasks);
    const int64_t work = task == num_tasks ? work_before(num_rays) : int64_t(double(work_before(num_rays)) * share);
    int64_t low = 0, high = num_rays;
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      if (work_before(middle) < work)
        low = middle + 1;
      else
        high = middle;
    }
    return low;
  }

  // Calls body(longest, begin, end) on ranges of rays, with the number of samples of the longest one.
  template <class Body>
  void run(const Body& body) const {
    parallel(num_tasks, 1, [&](int64_t first, int64_t last) {
      const int64_t begin = first_ray(first), end = first_ray(last);
      int64_t longest = rows.offsets ? 0 : rows.num_samples;
      for (int64_t ray = begin; rows.offsets && ray < end; ++ray) longest = std::max(longest, ray_count(rows, ray));
      body(longest, begin, end);
    });
  }
};

// Contiguous copies of the arguments and the pointers into them.
template <class Args>
struct CompositeInputs {
  using S = typename Args::Storage;
  using T = Compute<S>;

  const char* op;
  ScalarType dtype = scalar_type(T()), values_dtype = scalar_type(S());
  Args args{};
  int64_t num_rays;
  bool has_t, has_values;        // a tensor without elements has no pointer
  std::vector<int64_t> samples;  // shape of arrays over samples: [R, S], or [P] with offsets
  std::vector<Tensor> kept;

  CompositeInputs(const char* name, const char* source_name, const Tensor& source, const std::optional<Tensor>& t,
                  const std::optional<Tensor>& values, const std::optional<Tensor>& offsets, bool depth_mid)
      : op(name), has_t(t), has_values(values) {
    check_tensor(op, source_name, source, offsets ? 1 : 2, dtype);
    if (offsets) {
      const Tensor checked = read_offsets(op, "ray_offsets", *offsets, 'P', source.size(0));
      num_rays = checked.size(0) - 1;
      samples = {source.size(0)};
      args.rows = {keep<int64_t>(checked), 0, source.size(0)};
    } else {
      num_rays = source.size(0);
      samples = {num_rays, source.size(1)};
      args.rows = {nullptr, source.size(1), 0};
    }
    PRED_CHECK(num_rays < int64_t(1) << 40, op, ": ", source_name, " must have fewer than 2^40 rays, got ", num_rays);
    args.source = keep<T>(source);
    args.t = pointer<T>("t", t, samples);
    args.depth_mid = depth_mid;
    if (!values) return;
    check_tensor(op, "values", *values, int64_t(samples.size()) + 1, values_dtype);
    args.channels = values->size(values->dim() - 1);
    check_channels("values");
    args.values = pointer<S>("values", values, with(samples, args.channels));
  }

  // So that sizes of scratch rows need no further check.
  void check_channels(const char* name) const {
    PRED_CHECK(args.channels < int64_t(1) << 31, op, ": ", name, " must have fewer than 2^31 channels, got ",
               args.channels);
  }

  // Of a contiguous copy, if need be.
  template <typename Element>
  const Element* keep(const Tensor& tensor) {
    kept.push_back(torch::stable::contiguous(tensor));
    return storage<Element>(kept.back());
  }

  // The same, checked; null where there is no tensor.
  template <typename Element>
  const Element* pointer(const char* name, const std::optional<Tensor>& tensor, const std::vector<int64_t>& shape) {
    if (!tensor) return nullptr;
    check_tensor(op, name, *tensor, int64_t(shape.size()), scalar_type(Element()));
    check_sizes(op, name, *tensor, shape);
    return keep<Element>(*tensor);
  }

  static std::vector<int64_t> with(std::vector<int64_t> shape, int64_t size) {
    shape.push_back(size);
    return shape;
  }
  std::vector<int64_t> rendered_shape() const { return {num_rays, args.channels}; }
  std::vector<int64_t> values_shape() const { return with(samples, args.channels); }

  // body(longest, scratch, begin, end), the rest of a kernel's arguments.
  template <class Body>
  void for_rays(const CompositeKernels<Args>& kernels, const Body& body) const {
    if (kLaunch) return body(static_cast<T*>(nullptr), int64_t(0), int64_t(0), num_rays);
    RayTasks(args.rows, num_rays, args.channels).run([&](int64_t longest, int64_t begin, int64_t end) {
      std::vector<T> scratch(kernels.scratch_size(args, longest));
      body(scratch.data(), longest, begin, end);
    });
  }
};

// An uninitialised tensor like `like`; without elements where it is not needed.
inline Tensor output_tensor(const Tensor& like, bool need, const std::vector<int64_t>& shape, ScalarType dtype) {
  return torch::stable::new_empty(like, need ? shape : std::vector<int64_t>{0}, dtype);
}

// Weights, depth, opacity, values.
template <class Args>
std::tuple<Tensor, Tensor, Tensor, Tensor> composite(const CompositeInputs<Args>& in,
                                                     const CompositeKernels<Args>& kernels, const Tensor& like,
                                                     typename CompositeInputs<Args>::T* remaining) {
  using S = typename Args::Storage;
  using T = Compute<S>;
  Tensor weights = output_tensor(like, true, in.samples, in.dtype);
  Tensor depth = output_tensor(like, in.has_t, {in.num_rays}, in.dtype);
  Tensor opacity = output_tensor(like, true, {in.num_rays}, in.dtype);
  Tensor values = output_tensor(like, in.has_values, in.rendered_shape(), in.values_dtype);
  const CompositeOutputs<S> out{mutable_storage<T>(weights), in.has_t ? mutable_storage<T>(depth) : nullptr,
                                mutable_storage<T>(opacity), in.has_values ? mutable_storage<S>(values) : nullptr,
                                remaining};
  in.for_rays(kernels, [&](T* scratch, int64_t longest, int64_t begin, int64_t end) {
    kernels.forward(in.args, out, scratch, longest, begin, end);
  });
  return {weights, depth, opacity, values};
}

// What the backward passes share: incoming gradients, and which gradients are wanted.
struct CompositeGrads {
  const std::optional<Tensor>&weights, &depth, &opacity, &values;
};
struct CompositeNeeds {
  bool source, inv_s, t, values;
};

// From this size on, a gradient would push everything else out of the caches.
constexpr int64_t kStreamBytes = int64_t(16) << 20;

// Gradients of the source, of inv_s, of t, of values.
template <class Args>
std::tuple<Tensor, Tensor, Tensor, Tensor> composite_backward(
    CompositeInputs<Args>& in, const CompositeKernels<Args>& kernels, const Tensor& like, const CompositeGrads& grads,
    const CompositeSaved<typename CompositeInputs<Args>::T>& saved, const CompositeNeeds& need) {
  using S = typename Args::Storage;
  using T = Compute<S>;
  if (grads.values && !in.has_values) {  // values are needed for the gradient of the source only
    check_tensor(in.op, "grad_values", *grads.values, 2, in.values_dtype);
    in.args.channels = grads.values->size(1);
    in.check_channels("grad_values");
  }
  PRED_CHECK(in.has_values || !grads.values || !(need.source || need.inv_s), in.op,
             ": values must be given with grad_values, got none");
  PRED_CHECK(in.has_t || !grads.depth, in.op, ": t must be given with grad_depth, got none");
  PRED_CHECK(!need.t || grads.depth, in.op, ": grad_depth must be given with need_t, got none");
  PRED_CHECK(!need.values || grads.values, in.op, ": grad_values must be given with need_values, got none");
  const CompositeCotangents<S> grad{in.template pointer<T>("grad_weights", grads.weights, in.samples),
                                    in.template pointer<T>("grad_depth", grads.depth, {in.num_rays}),
                                    in.template pointer<T>("grad_opacity", grads.opacity, {in.num_rays}),
                                    in.template pointer<S>("grad_values", grads.values, in.rendered_shape())};
  Tensor out_source = output_tensor(like, need.source, in.samples, in.dtype);
  Tensor out_inv_s = output_tensor(like, need.inv_s, {}, in.dtype);
  Tensor out_t = output_tensor(like, need.t, in.samples, in.dtype);
  Tensor out_values = output_tensor(like, need.values, in.values_shape(), in.values_dtype);
  const Tensor per_ray = output_tensor(like, need.inv_s, {in.num_rays}, ScalarType::Double);
  int64_t bytes = in.args.channels * int64_t(sizeof(S));
  for (const int64_t size : in.samples) bytes *= size;
  const CompositeGradients<S> out{need.source ? mutable_storage<T>(out_source) : nullptr,
                                  need.inv_s ? mutable_storage<double>(per_ray) : nullptr,
                                  need.t ? mutable_storage<T>(out_t) : nullptr,
                                  need.values ? mutable_storage<S>(out_values) : nullptr, bytes >= kStreamBytes};
  in.for_rays(kernels, [&](T* scratch, int64_t longest, int64_t begin, int64_t end) {
    kernels.backward(in.args, saved, grad, out, scratch, longest, begin, end);
  });
  if (need.inv_s) add_parts(storage<double>(per_ray), in.num_rays, mutable_storage<T>(out_inv_s));
  return {out_source, out_inv_s, out_t, out_values};
}

// The dtype that tells the storage type: that of values, of their gradient, or of the samples.
inline ScalarType storage_type(const Tensor& source, const std::optional<Tensor>& values,
                               const std::optional<Tensor>& grad_values = std::nullopt) {
  return (values ? *values : grad_values ? *grad_values : source).scalar_type();
}

}  // namespace
}  // namespace pred
