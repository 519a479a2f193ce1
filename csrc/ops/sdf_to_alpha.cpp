// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
#include "ops/sdf_to_alpha.h"

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

namespace pred {
namespace {

PRED_KERNELS_BY_TYPE(SdfToAlphaKernels, sdf_to_alpha)

constexpr int64_t kGrain = 16384;        // samples per task: some 50 microseconds
constexpr int64_t kGroup = kAlphaGroup;  // and of the rays that are worked on as one row

// Rays of one length (sdf [R, S]) or of any (sdf [P] and ray_offsets [R + 1]), and, for loops, their groups, each of
// whole rays.
template <typename T>
struct Rays {
  Tensor sdf, offsets;
  std::vector<int64_t> group_end;  // the ray behind each group
  int64_t largest_group = 0;       // in samples
  int64_t num_rays;
  PairAlphaArgs<T> args;

  Rays(const char* op, const Tensor& sdf_in, const Tensor& inv_s, bool last_opaque,
       const std::optional<Tensor>& ray_offsets) {
    check_tensor(op, "sdf", sdf_in, ray_offsets ? 1 : 2, sdf_in.scalar_type());
    sdf = torch::stable::contiguous(sdf_in);
    args = {
        {nullptr, 0, sdf.size(0)}, sdf.const_data_ptr<T>(), sharpness<T>(op, inv_s, sdf.scalar_type()), last_opaque};
    num_rays = sdf.size(0);
    if (ray_offsets) {
      offsets = read_offsets(op, "ray_offsets", *ray_offsets, 'P', sdf.size(0));
      args.rows.offsets = offsets.const_data_ptr<int64_t>();
      num_rays = offsets.size(0) - 1;
    } else {
      args.rows.num_samples = sdf.size(1);
    }
    if (sdf.numel() == 0) num_rays = 0;  // however many there are
    if (kLaunch) return;
    int64_t size = 0;
    for (int64_t ray = 0; ray < num_rays; ++ray) {
      size += ray_count(args.rows, ray);
      if (ray + 1 < num_rays && size + ray_count(args.rows, ray + 1) <= kGroup) continue;
      largest_group = std::max(largest_group, size);
      group_end.push_back(ray + 1);
      size = 0;
    }
  }

  // Sums that body makes: of groups, or, launched, of rays.
  int64_t num_parts() const { return kLaunch ? num_rays : int64_t(group_end.size()); }

  // body(scratch, part, first ray, the ray behind the last one), the former with `rows` times the samples of a group
  template <class Body>
  void run(int64_t rows, const Body& body) const {
    if (kLaunch) {
      if (num_rays > 0) body(static_cast<T*>(nullptr), 0, 0, num_rays);
      return;
    }
    parallel(num_parts(), kGrain / kGroup, [&](int64_t first, int64_t last) {
      std::vector<T> scratch(rows * largest_group);
      for (int64_t group = first; group < last; ++group) {
        body(scratch.data(), group, group == 0 ? 0 : group_end[group - 1], group_end[group]);
      }
    });
  }
};

Tensor sdf_to_alpha(const Tensor& sdf, const Tensor& inv_s, bool last_opaque, std::optional<Tensor> ray_offsets) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha", sdf.scalar_type(), [&] {
    const Rays<T> rays("sdf_to_alpha", sdf, inv_s, last_opaque, ray_offsets);
    Tensor alpha = torch::stable::empty_like(rays.sdf);
    T* out = alpha.mutable_data_ptr<T>();
    const auto& k = sdf_to_alpha_kernels<T>();
    rays.run(0, [&](T*, int64_t, int64_t begin, int64_t end) { k.pair(rays.args, out, begin, end); });
    return alpha;
  });
}

Tensor output(const Tensor& like, bool wanted) {
  return wanted ? torch::stable::empty_like(like) : torch::stable::new_empty(like, {0});
}

template <typename T>
T* data(Tensor& tensor, bool wanted) {
  return wanted ? tensor.mutable_data_ptr<T>() : nullptr;
}

Tensor parts_of_sum(const Tensor& like, int64_t count) {
  return torch::stable::new_empty(like, {count}, ScalarType::Double);
}

// A scalar, or nothing.
template <typename T>
Tensor total(const Tensor& like, bool wanted, const Tensor& parts) {
  Tensor sum = torch::stable::new_empty(like, std::vector<int64_t>(wanted ? 0 : 1, 0));
  if (wanted) add_parts(parts.const_data_ptr<double>(), parts.numel(), sum.mutable_data_ptr<T>());
  return sum;
}

// Contiguous, with the dtype and shape of `like`.
Tensor contiguous_like(const char* op, const char* name, const Tensor& tensor, const Tensor& like) {
  check_tensor(op, name, tensor, like.dim(), like.scalar_type());
  check_sizes(op, name, tensor, sizes(like));
  return torch::stable::contiguous(tensor);
}

std::tuple<Tensor, Tensor> sdf_to_alpha_backward(const Tensor& grad_in, const Tensor& sdf, const Tensor& inv_s,
                                                 bool need_sdf, bool need_inv_s, std::optional<Tensor> ray_offsets) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_backward", sdf.scalar_type(), [&] {
    const char* op = "sdf_to_alpha_backward";
    const Rays<T> rays(op, sdf, inv_s, false, ray_offsets);
    const Tensor grad = contiguous_like(op, "grad", grad_in, rays.sdf);
    Tensor grad_sdf = output(rays.sdf, need_sdf);
    T* out = data<T>(grad_sdf, need_sdf);
    const Tensor parts = parts_of_sum(sdf, need_inv_s ? rays.num_parts() : 0);
    double* part = need_inv_s ? parts.mutable_data_ptr<double>() : nullptr;
    const auto& k = sdf_to_alpha_kernels<T>();
    rays.run(3, [&](T* scratch, int64_t group, int64_t begin, int64_t end) {
      k.pair_backward(rays.args, grad.const_data_ptr<T>(), out, part ? part + group : nullptr, scratch, begin, end);
    });
    return std::make_tuple(grad_sdf, total<T>(rays.sdf, need_inv_s, parts));
  });
}

// Contiguous copies of the arguments and the pointers into them.
template <typename T>
struct Sections {
  Tensor sdf, cosine, length;
  SectionAlphaArgs<T> args;

  Sections(const char* op, const Tensor& sdf_in, const Tensor& inv_s, const Tensor& cosine_in, const Tensor& length_in,
           const Tensor& cos_anneal, double eps) {
    check_tensor(op, "cos_anneal", cos_anneal, 0, sdf_in.scalar_type());
    sdf = contiguous_like(op, "sdf", sdf_in, sdf_in);
    cosine = contiguous_like(op, "cosine", cosine_in, sdf);
    length = contiguous_like(op, "section_length", length_in, sdf);
    args = {sdf.const_data_ptr<T>(),
            cosine.const_data_ptr<T>(),
            length.const_data_ptr<T>(),
            sharpness<T>("sdf_to_alpha", inv_s, sdf.scalar_type()),  // as the public op calls itself
            cos_anneal.const_data_ptr<T>(),
            T(eps)};
  }
};

Tensor sdf_to_alpha_section(const Tensor& sdf, const Tensor& inv_s, const Tensor& cosine, const Tensor& section_length,
                            const Tensor& cos_anneal, double eps) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_section", sdf.scalar_type(), [&] {
    const Sections<T> in("sdf_to_alpha_section", sdf, inv_s, cosine, section_length, cos_anneal, eps);
    Tensor alpha = torch::stable::empty_like(in.sdf);
    T* out = alpha.mutable_data_ptr<T>();
    const int64_t count = in.sdf.numel();
    const auto& k = sdf_to_alpha_kernels<T>();
    // Whole groups, so that a sample's place in its vector does not depend on the number of threads.
    parallel((count + kGroup - 1) / kGroup, kGrain / kGroup, [&](int64_t first, int64_t last) {
      k.section(in.args, out, first * kGroup, std::min(last * kGroup, count));
    });
    return alpha;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> sdf_to_alpha_section_backward(
    const Tensor& grad_in, const Tensor& sdf, const Tensor& inv_s, const Tensor& cosine, const Tensor& section_length,
    const Tensor& cos_anneal, double eps, bool need_sdf, bool need_inv_s, bool need_cosine, bool need_length) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_section_backward", sdf.scalar_type(), [&] {
    const char* op = "sdf_to_alpha_section_backward";
    const Sections<T> in(op, sdf, inv_s, cosine, section_length, cos_anneal, eps);
    const Tensor grad = contiguous_like(op, "grad", grad_in, in.sdf);
    Tensor grad_sdf = output(in.sdf, need_sdf), grad_cosine = output(in.sdf, need_cosine);
    Tensor grad_length = output(in.sdf, need_length);
    const SectionAlphaGradients<T> out{data<T>(grad_sdf, need_sdf), data<T>(grad_cosine, need_cosine),
                                       data<T>(grad_length, need_length)};
    const int64_t count = in.sdf.numel(), groups = (count + kGroup - 1) / kGroup;
    const Tensor parts = parts_of_sum(in.sdf, groups);
    double* part = parts.mutable_data_ptr<double>();
    const auto& k = sdf_to_alpha_kernels<T>();
    parallel(groups, kGrain / kGroup, [&](int64_t first, int64_t last) {
      if (kLaunch) return k.section_backward(in.args, grad.const_data_ptr<T>(), out, part, 0, count);
      for (int64_t group = first; group < last; ++group) {
        k.section_backward(in.args, grad.const_data_ptr<T>(), out, part + group, group * kGroup,
                           std::min((group + 1) * kGroup, count));
      }
    });
    return std::make_tuple(grad_sdf, total<T>(in.sdf, need_inv_s, parts), grad_cosine, grad_length);
  });
}

Tensor sdf_to_alpha_density(const Tensor& density_in, const Tensor& length_in) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_density", density_in.scalar_type(), [&] {
    const char* op = "sdf_to_alpha_density";
    const Tensor density = contiguous_like(op, "density", density_in, density_in);
    const Tensor length = contiguous_like(op, "section_length", length_in, density);
    const DensityAlphaArgs<T> a{density.const_data_ptr<T>(), length.const_data_ptr<T>()};
    Tensor alpha = torch::stable::empty_like(density);
    T* out = alpha.mutable_data_ptr<T>();
    const int64_t count = density.numel();
    const auto& k = sdf_to_alpha_kernels<T>();
    parallel((count + kGroup - 1) / kGroup, kGrain / kGroup,
             [&](int64_t first, int64_t last) { k.density(a, out, first * kGroup, std::min(last * kGroup, count)); });
    return alpha;
  });
}

std::tuple<Tensor, Tensor> sdf_to_alpha_density_backward(const Tensor& grad_in, const Tensor& density_in,
                                                         const Tensor& length_in, bool need_density, bool need_length) {
  return PRED_DISPATCH_FLOAT("sdf_to_alpha_density_backward", density_in.scalar_type(), [&] {
    const char* op = "sdf_to_alpha_density_backward";
    const Tensor density = contiguous_like(op, "density", density_in, density_in);
    const Tensor length = contiguous_like(op, "section_length", length_in, density);
    const Tensor grad = contiguous_like(op, "grad", grad_in, density);
    const DensityAlphaArgs<T> a{density.const_data_ptr<T>(), length.const_data_ptr<T>()};
    Tensor grad_density = output(density, need_density), grad_length = output(density, need_length);
    T *density_out = data<T>(grad_density, need_density), *length_out = data<T>(grad_length, need_length);
    const int64_t count = density.numel();
    const auto& k = sdf_to_alpha_kernels<T>();
    parallel((count + kGroup - 1) / kGroup, kGrain / kGroup, [&](int64_t first, int64_t last) {
      k.density_backward(a, grad.const_data_ptr<T>(), density_out, length_out, first * kGroup,
                         std::min(last * kGroup, count));
    });
    return std::make_tuple(grad_density, grad_length);
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, PRED_DEVICE, m) {
  PRED_IMPL(m, "sdf_to_alpha", &pred::sdf_to_alpha);
  PRED_IMPL(m, "sdf_to_alpha_backward", &pred::sdf_to_alpha_backward);
  PRED_IMPL(m, "sdf_to_alpha_section", &pred::sdf_to_alpha_section);
  PRED_IMPL(m, "sdf_to_alpha_section_backward", &pred::sdf_to_alpha_section_backward);
  PRED_IMPL(m, "sdf_to_alpha_density", &pred::sdf_to_alpha_density);
  PRED_IMPL(m, "sdf_to_alpha_density_backward", &pred::sdf_to_alpha_density_backward);
}
