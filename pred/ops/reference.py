# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The plain PyTorch references of all ops, under the ops' own names."""

from pred.ops.ball_query import ball_query_reference as ball_query
from pred.ops.box_iou import box_iou_3d_reference as box_iou_3d
from pred.ops.box_iou import box_iou_bev_reference as box_iou_bev
from pred.ops.build_rulebook import build_rulebook_reference as build_rulebook
from pred.ops.composite_alpha import composite_alpha_reference as composite_alpha
from pred.ops.composite_rays import composite_rays_reference as composite_rays
from pred.ops.decode_field import decode_field_reference as decode_field
from pred.ops.farthest_point_sample import farthest_point_sample_reference as farthest_point_sample
from pred.ops.knn import knn_reference as knn
from pred.ops.nms_bev import nms_bev_reference as nms_bev
from pred.ops.points_in_boxes import points_in_boxes_mask_reference as points_in_boxes_mask
from pred.ops.points_in_boxes import points_in_boxes_reference as points_in_boxes
from pred.ops.resample_rays import resample_rays_reference as resample_rays
from pred.ops.sample_bev import sample_bev_reference as sample_bev
from pred.ops.sample_bev import sample_bev_with_grad_reference as sample_bev_with_grad
from pred.ops.sample_pdf import sample_pdf_reference as sample_pdf
from pred.ops.sample_volume import sample_volume_reference as sample_volume
from pred.ops.sample_volume import sample_volume_with_grad_reference as sample_volume_with_grad
from pred.ops.sdf_to_alpha import sdf_to_alpha_reference as sdf_to_alpha
from pred.ops.segment_reduce import segment_reduce_reference as segment_reduce
from pred.ops.sparse_conv import sparse_conv_reference as sparse_conv
from pred.ops.sparse_max_pool import sparse_max_pool_reference as sparse_max_pool
from pred.ops.voxelize import voxelize_reference as voxelize
from pred.ops.voxelize_hard import voxelize_hard_reference as voxelize_hard

__all__ = [  # in the order of docs/ops
    "sample_bev",
    "sample_bev_with_grad",
    "sample_volume",
    "sample_volume_with_grad",
    "decode_field",
    "sdf_to_alpha",
    "composite_rays",
    "composite_alpha",
    "sample_pdf",
    "resample_rays",
    "voxelize",
    "voxelize_hard",
    "segment_reduce",
    "build_rulebook",
    "sparse_conv",
    "sparse_max_pool",
    "farthest_point_sample",
    "knn",
    "ball_query",
    "box_iou_bev",
    "box_iou_3d",
    "nms_bev",
    "points_in_boxes",
    "points_in_boxes_mask",
]
