# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""LiDAR encoders: points in, bird's-eye-view (BEV) feature map out."""

from pred.models.encoders.pillars import PillarEncoder, PillarEncoderConfig

__all__ = ["PillarEncoder", "PillarEncoderConfig"]
