# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The plain PyTorch references of all ops, under the ops' own names."""

from pred.ops.composite_rays import composite_rays_reference as composite_rays
from pred.ops.resample_rays import resample_rays_reference as resample_rays
from pred.ops.sample_bev import sample_bev_reference as sample_bev
from pred.ops.sample_pdf import sample_pdf_reference as sample_pdf
from pred.ops.sdf_to_alpha import sdf_to_alpha_reference as sdf_to_alpha
from pred.ops.segment_reduce import segment_reduce_reference as segment_reduce
from pred.ops.voxelize import voxelize_reference as voxelize

__all__ = [
    "composite_rays",
    "resample_rays",
    "sample_bev",
    "sample_pdf",
    "sdf_to_alpha",
    "segment_reduce",
    "voxelize",
]
