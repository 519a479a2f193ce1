// Copyright 2026 The PRED authors
// SPDX-License-Identifier: Apache-2.0
//
// Every op schema. Sizes: B batch, C channels, D H W layers, rows and columns of a map, N points or samples.
// Implementations register in ops/<op>.cpp; fake kernels and derivatives in pred/ops/<op>.py.
#include <torch/csrc/stable/library.h>

#include <string>

#include "common/check.h"
#include "common/isa.h"
#include "common/parallel.h"

STABLE_TORCH_LIBRARY(pred, m) {
  // "key=value" lines: compiler, build type, sanitizers, levels compiled in, level in force.
  m.def("build_info() -> str");
  // Test hook of common/parallel.h: throws in a worker when fail_at >= 0.
  m.def("parallel_probe(Tensor out, int grain, int fail_at) -> ()");

  // deterministic: see SampleGridKernels; on the CPU the gradient of a map always has the same bits.
  // The second output of *_with_grad is the derivative in the grid, [B, N, 2 or 3, C].
  m.def("sample_bev(Tensor bev, Tensor grid, bool border, bool align_corners) -> Tensor");
  m.def(
      "sample_bev_backward(Tensor grad, Tensor bev, Tensor grid, bool border, bool align_corners, "
      "bool need_bev, bool need_grid, bool deterministic) -> (Tensor, Tensor)");
  m.def(
      "sample_bev_double_backward(Tensor? grad_grad_bev, Tensor? grad_grad_grid, Tensor grad, Tensor bev, "
      "Tensor grid, bool border, bool align_corners, bool need_grad, bool need_bev, bool need_grid, "
      "bool deterministic) -> (Tensor, Tensor, Tensor)");
  m.def("sample_bev_with_grad(Tensor bev, Tensor grid, bool border, bool align_corners) -> (Tensor, Tensor)");
  m.def(
      "sample_bev_with_grad_backward(Tensor? grad_values, Tensor? grad_grads, Tensor bev, Tensor grid, bool border, "
      "bool align_corners, bool need_bev, bool need_grid, bool deterministic) -> (Tensor, Tensor)");

  m.def("sample_volume(Tensor volume, Tensor grid, bool border, bool align_corners) -> Tensor");
  m.def(
      "sample_volume_backward(Tensor grad, Tensor volume, Tensor grid, bool border, bool align_corners, "
      "bool need_volume, bool need_grid, bool deterministic) -> (Tensor, Tensor)");
  m.def(
      "sample_volume_double_backward(Tensor? grad_grad_volume, Tensor? grad_grad_grid, Tensor grad, Tensor volume, "
      "Tensor grid, bool border, bool align_corners, bool need_grad, bool need_volume, bool need_grid, "
      "bool deterministic) -> (Tensor, Tensor, Tensor)");
  m.def("sample_volume_with_grad(Tensor volume, Tensor grid, bool border, bool align_corners) -> (Tensor, Tensor)");
  m.def(
      "sample_volume_with_grad_backward(Tensor? grad_values, Tensor? grad_grads, Tensor volume, Tensor grid, "
      "bool border, bool align_corners, bool need_volume, bool need_grid, bool deterministic) -> (Tensor, Tensor)");

  // tf32: see math/product_cuda.cuh; the CPU has float32 only.
  m.def("project_bev(Tensor bev, Tensor weight, bool tf32) -> Tensor");
  m.def(
      "project_bev_backward(Tensor grad, Tensor bev, Tensor weight, bool need_bev, bool need_weight, bool tf32) -> "
      "(Tensor, Tensor)");
  m.def(
      "decode_field(Tensor projected, Tensor points, Tensor parameters, SymInt[] widths, float[] point_range, "
      "SymInt octaves, float beta, float sdf_scale, bool with_gradient, bool keep, bool tf32) -> "
      "(Tensor sdf, Tensor semantics, Tensor gradient, Tensor activation, Tensor chain)");
  m.def(
      "decode_field_backward(Tensor? grad_sdf, Tensor? grad_semantics, Tensor? grad_gradient, Tensor projected, "
      "Tensor points, Tensor parameters, Tensor activation, Tensor chain, SymInt[] widths, "
      "float[] point_range, SymInt octaves, float beta, float sdf_scale, bool need_projected, bool need_points, "
      "bool need_parameters, bool deterministic, bool tf32) -> (Tensor, Tensor, Tensor)");

  m.def("segment_reduce(Tensor features, Tensor index, SymInt num_segments, str reduce) -> (Tensor, Tensor)");
  m.def("segment_reduce_backward(Tensor grad, Tensor index, Tensor saved, str reduce) -> Tensor");

  m.def(
      "voxelize(Tensor points, Tensor batch_offsets, float[] voxel_size, float[] point_range, int[] grid_size) -> "
      "(Tensor, Tensor, Tensor)");
  m.def(
      "voxelize_hard(Tensor points, Tensor batch_offsets, float[] voxel_size, float[] point_range, int[] grid_size, "
      "SymInt max_points, SymInt max_voxels) -> (Tensor voxels, Tensor coords, Tensor counts, Tensor point_to_slot)");
  m.def("voxelize_hard_backward(Tensor grad, Tensor point_to_slot) -> Tensor");

  m.def(
      "build_rulebook(Tensor indices, SymInt batch_size, SymInt[] spatial_shape, SymInt[] kernel_size, "
      "SymInt[] stride, SymInt[] padding, SymInt[] dilation, bool submanifold) -> "
      "(Tensor out_indices, Tensor out_to_in, Tensor in_to_out)");
  // weight: [O, K, C].
  m.def(
      "sparse_conv(Tensor features, Tensor weight, Tensor? bias, Tensor out_to_in, Tensor in_to_out, bool tf32) -> "
      "Tensor");
  m.def(
      "sparse_conv_backward(Tensor grad, Tensor features, Tensor weight, Tensor out_to_in, Tensor in_to_out, "
      "bool need_features, bool need_weight, bool tf32) -> (Tensor, Tensor)");
  m.def("sparse_max_pool(Tensor features, Tensor out_to_in, Tensor in_to_out) -> (Tensor out, Tensor winner)");
  m.def("sparse_max_pool_backward(Tensor grad, Tensor winner, Tensor in_to_out) -> Tensor");

  m.def("farthest_point_sample(Tensor points, Tensor batch_offsets, SymInt num_samples, SymInt start) -> Tensor");
  m.def(
      "knn(Tensor points, Tensor batch_offsets, Tensor queries, Tensor query_offsets, SymInt k) -> "
      "(Tensor indices, Tensor squared_distance)");
  m.def(
      "ball_query(Tensor points, Tensor batch_offsets, Tensor queries, Tensor query_offsets, float radius, "
      "SymInt max_points) -> (Tensor indices, Tensor counts)");

  m.def("box_iou_bev(Tensor boxes_a, Tensor boxes_b, bool aligned) -> Tensor");
  m.def("box_iou_3d(Tensor boxes_a, Tensor boxes_b, bool aligned) -> Tensor");
  m.def("nms_bev(Tensor boxes, Tensor scores, float iou_threshold, SymInt? pre_max, SymInt? post_max) -> Tensor");
  m.def("points_in_boxes(Tensor points, Tensor boxes, Tensor? batch_offsets, Tensor? box_offsets) -> Tensor");
  m.def("points_in_boxes_mask(Tensor points, Tensor boxes) -> Tensor");

  m.def("sdf_to_alpha(Tensor sdf, Tensor inv_s, bool last_opaque, Tensor? ray_offsets=None) -> Tensor");
  m.def(
      "sdf_to_alpha_backward(Tensor grad, Tensor sdf, Tensor inv_s, bool need_sdf, bool need_inv_s, "
      "Tensor? ray_offsets=None) -> (Tensor, Tensor)");
  m.def(
      "sdf_to_alpha_section(Tensor sdf, Tensor inv_s, Tensor cosine, Tensor section_length, Tensor cos_anneal, "
      "float eps) -> Tensor");
  m.def(
      "sdf_to_alpha_section_backward(Tensor grad, Tensor sdf, Tensor inv_s, Tensor cosine, Tensor section_length, "
      "Tensor cos_anneal, float eps, bool need_sdf, bool need_inv_s, bool need_cosine, bool need_section_length) -> "
      "(Tensor, Tensor, Tensor, Tensor)");
  m.def("sdf_to_alpha_density(Tensor density, Tensor section_length) -> Tensor");
  m.def(
      "sdf_to_alpha_density_backward(Tensor grad, Tensor density, Tensor section_length, bool need_density, "
      "bool need_section_length) -> (Tensor, Tensor)");

  m.def(
      "composite_rays(Tensor sdf, Tensor inv_s, Tensor t, Tensor? values, Tensor? ray_offsets, bool depth_mid, "
      "bool last_opaque) -> (Tensor weights, Tensor depth, Tensor opacity, Tensor values, Tensor remaining)");
  m.def(
      "composite_rays_backward(Tensor? grad_weights, Tensor? grad_depth, Tensor? grad_opacity, Tensor? grad_values, "
      "Tensor sdf, Tensor inv_s, Tensor t, Tensor? values, Tensor? ray_offsets, Tensor weights, Tensor remaining, "
      "bool depth_mid, bool last_opaque, bool need_sdf, bool need_inv_s, bool need_t, bool need_values) -> "
      "(Tensor, Tensor, Tensor, Tensor)");

  m.def(
      "composite_alpha(Tensor alpha, Tensor? t, Tensor? values, Tensor? ray_offsets, float eps, bool depth_mid) -> "
      "(Tensor weights, Tensor depth, Tensor opacity, Tensor values)");
  m.def(
      "composite_alpha_backward(Tensor? grad_weights, Tensor? grad_depth, Tensor? grad_opacity, Tensor? grad_values, "
      "Tensor alpha, Tensor? t, Tensor? values, Tensor? ray_offsets, float eps, bool depth_mid, bool need_alpha, "
      "bool need_t, bool need_values) -> (Tensor, Tensor, Tensor)");

  m.def(
      "sample_pdf(Tensor edges, Tensor weights, Tensor u, str mode, float histogram_padding, float eps, "
      "float min_width) -> Tensor");
  m.def(
      "resample_rays(Tensor t, Tensor weights, Tensor u, str mode, float histogram_padding, float eps, "
      "float min_width) -> Tensor");
}

namespace pred {
namespace {

std::string build_info() {
  return concat("compiler=", PRED_COMPILER, "\nbuild_type=", PRED_BUILD_TYPE, "\nsanitizers=", PRED_SANITIZERS,
                "\nlevels=", PRED_LEVELS, "\nlevel=", isa_name(active_isa()));
}

void parallel_probe(const Tensor& out, int64_t grain, int64_t fail_at) {
  check_tensor("parallel_probe", "out", out, 1, ScalarType::Long);
  PRED_CHECK(out.is_contiguous(), "parallel_probe: out must be contiguous");
  static std::atomic<int64_t> next_id{0};
  int64_t* data = out.mutable_data_ptr<int64_t>();
  parallel(out.size(0), grain, [&](int64_t begin, int64_t end) {
    thread_local const int64_t id = next_id++;
    for (int64_t i = begin; i < end; ++i) {
      PRED_CHECK(i != fail_at, "parallel_probe: index ", i, " was asked to fail");
      data[i] = id;
    }
  });
}

}  // namespace
}  // namespace pred

STABLE_TORCH_LIBRARY_IMPL(pred, CompositeExplicitAutograd, m) { m.impl("build_info", TORCH_BOX(&pred::build_info)); }
STABLE_TORCH_LIBRARY_IMPL(pred, CPU, m) { m.impl("parallel_probe", TORCH_BOX(&pred::parallel_probe)); }
