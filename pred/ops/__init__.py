# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Fused ops for rendering-based LiDAR pre-training.

Dimensions: ``B`` batch, ``N`` points or samples, ``M`` voxels, ``R`` rays, ``S`` samples per ray, ``P`` samples of all
packed rays, ``C`` channels, ``H`` and ``W`` rows and columns of a BEV map, ``D`` layers of a volume. Each op has a
plain PyTorch reference of the same meaning in its own module, which is its fallback and its oracle;
:mod:`pred.ops.reference` gathers them.
"""

from pred.ops._composite import Composite
from pred.ops._sampling import SampledWithGrad
from pred.ops.ball_query import Ball, ball_query
from pred.ops.composite_alpha import composite_alpha
from pred.ops.composite_rays import composite_rays
from pred.ops.farthest_point_sample import farthest_point_sample
from pred.ops.knn import Neighbors, knn
from pred.ops.resample_rays import resample_rays
from pred.ops.sample_bev import sample_bev, sample_bev_with_grad
from pred.ops.sample_pdf import sample_pdf
from pred.ops.sample_volume import sample_volume, sample_volume_with_grad
from pred.ops.sdf_to_alpha import sdf_to_alpha
from pred.ops.segment_reduce import segment_reduce
from pred.ops.voxelize import Voxels, voxelize
from pred.ops.voxelize_hard import HardVoxels, voxelize_hard

__all__ = [
    "Ball",
    "Composite",
    "HardVoxels",
    "Neighbors",
    "Voxels",
    "ball_query",
    "SampledWithGrad",
    "composite_alpha",
    "composite_rays",
    "farthest_point_sample",
    "knn",
    "resample_rays",
    "sample_bev",
    "sample_bev_with_grad",
    "sample_pdf",
    "sample_volume",
    "sample_volume_with_grad",
    "sdf_to_alpha",
    "segment_reduce",
    "voxelize",
    "voxelize_hard",
]
