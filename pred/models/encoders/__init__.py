# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""LiDAR encoders: points in, bird's-eye-view (BEV) feature map out."""

from pred.models.encoders.bev import BEVBackboneConfig
from pred.models.encoders.dsvt import DSVTConfig
from pred.models.encoders.encoder import Encoder, EncoderConfig
from pred.models.encoders.pillars import PillarConfig
from pred.models.encoders.voxels import VoxelConfig

__all__ = ["BEVBackboneConfig", "DSVTConfig", "Encoder", "EncoderConfig", "PillarConfig", "VoxelConfig"]
