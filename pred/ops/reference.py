# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The plain PyTorch references of all ops, under the ops' own names."""

from pred.ops.ball_query import ball_query_reference as ball_query
from pred.ops.composite_rays import composite_rays_reference as composite_rays
from pred.ops.farthest_point_sample import farthest_point_sample_reference as farthest_point_sample
from pred.ops.knn import knn_reference as knn
from pred.ops.resample_rays import resample_rays_reference as resample_rays
from pred.ops.sample_bev import sample_bev_reference as sample_bev
from pred.ops.sdf_to_alpha import sdf_to_alpha_reference as sdf_to_alpha
from pred.ops.segment_reduce import segment_reduce_reference as segment_reduce
from pred.ops.voxelize import voxelize_reference as voxelize
from pred.ops.voxelize_hard import voxelize_hard_reference as voxelize_hard

__all__ = [
    "ball_query",
    "composite_rays",
    "farthest_point_sample",
    "knn",
    "resample_rays",
    "sample_bev",
    "sdf_to_alpha",
    "segment_reduce",
    "voxelize",
    "voxelize_hard",
]
