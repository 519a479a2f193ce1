# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Fused ops for rendering-based LiDAR pre-training.

Dimensions: ``B`` batch (maps, volumes, frames of points), ``N`` points, rows, or samples of a map, ``M`` voxels,
queries or boxes, ``R`` rays, ``S`` samples per ray, ``P`` samples of all packed rays, ``C`` channels of a map or
columns of a row, ``D``, ``H`` and ``W`` layers, rows and columns of a map or volume. Other sizes have the name of the
argument that sets them. Each op has a plain PyTorch reference of the same meaning in its own module, which is its
fallback and its oracle; :mod:`pred.ops.reference` gathers them.
"""

from pred.ops._composite import Composite
from pred.ops._sampling import SampledWithGrad
from pred.ops.ball_query import Ball, ball_query
from pred.ops.box_iou import box_iou_3d, box_iou_bev
from pred.ops.build_rulebook import Rulebook, build_rulebook
from pred.ops.composite_alpha import composite_alpha
from pred.ops.composite_rays import composite_rays
from pred.ops.decode_field import DecodedField, decode_field
from pred.ops.farthest_point_sample import farthest_point_sample
from pred.ops.knn import Neighbors, knn
from pred.ops.nms_bev import nms_bev
from pred.ops.points_in_boxes import points_in_boxes, points_in_boxes_mask
from pred.ops.resample_rays import resample_rays
from pred.ops.sample_bev import sample_bev, sample_bev_with_grad
from pred.ops.sample_pdf import sample_pdf
from pred.ops.sample_volume import sample_volume, sample_volume_with_grad
from pred.ops.sdf_to_alpha import sdf_to_alpha
from pred.ops.segment_reduce import segment_reduce
from pred.ops.sparse_conv import sparse_conv
from pred.ops.sparse_max_pool import sparse_max_pool
from pred.ops.voxelize import Voxels, voxelize
from pred.ops.voxelize_hard import HardVoxels, voxelize_hard

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
    "SampledWithGrad",
    "DecodedField",
    "Composite",
    "Voxels",
    "HardVoxels",
    "Rulebook",
    "Neighbors",
    "Ball",
]
