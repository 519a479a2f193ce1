# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The encoder that is pre-trained: points in, bird's-eye-view (BEV) feature map out.

Three families: pillars (PointPillars), voxels (SECOND, CenterPoint) and dsvt (DSVT-P). Sub-modules have the names of
OpenPCDet's and DSVT's detectors (``vfe``, ``backbone_3d``, ``backbone_2d``), and so has the state dict.

N points, B frames, D raw point channels, C map channels, H rows (y), W columns (x).
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from pred.models.encoders.bev import BaseBEVBackbone, BaseBEVResBackbone, BEVBackboneConfig
from pred.models.encoders.dsvt import DSVT, DSVTConfig
from pred.models.encoders.pillars import DynamicPillarVFE, PillarConfig, PillarVFE, PointPillarScatter
from pred.models.encoders.voxels import (
    OUT_CHANNELS,
    DynamicMeanVFE,
    HeightCompression,
    MeanVFE,
    VoxelBackBone8x,
    VoxelConfig,
    VoxelResBackBone8x,
)
from pred.ops._check import check_offsets


@dataclass
class EncoderConfig:
    """Family and sizes of the encoder; the defaults are CenterPoint's with dynamic pillars on nuScenes."""

    kind: Literal["pillars", "voxels", "dsvt"] = "pillars"
    """pillars: `pillars` alone; voxels: `voxels`; dsvt: `pillars`, then `dsvt`. Parts of other kinds are not used;
    `backbone_2d` has to be chosen with the kind."""
    bev: Literal["after_2d", "before_2d"] = "after_2d"
    """Where the field reads the map: after the 2D backbone, or before it; then there is no `backbone_2d`."""
    pillars: PillarConfig = field(default_factory=PillarConfig)
    """Pillar features."""
    voxels: VoxelConfig = field(default_factory=VoxelConfig)
    """Voxel features and sparse 3D backbone."""
    dsvt: DSVTConfig = field(default_factory=DSVTConfig)
    """Attention among the pillars."""
    backbone_2d: BEVBackboneConfig = field(default_factory=BEVBackboneConfig)
    """2D backbone."""

    def __post_init__(self) -> None:
        if self.kind == "dsvt" and self.pillars.max_points is not None:
            raise ValueError(
                f"EncoderConfig: pillars.max_points must be None for dsvt, whose pillars are dynamic, got "
                f"{self.pillars.max_points}"
            )
        if self.kind == "dsvt" and self.pillars.vfe_filters[-1] != self.dsvt.d_model:
            raise ValueError(
                f"EncoderConfig: pillars.vfe_filters must end with dsvt.d_model = {self.dsvt.d_model}, got "
                f"{self.pillars.vfe_filters}"
            )


class Encoder(nn.Module):
    """Points to a BEV map `[B, C, H, W]` (row = y, column = x).

    Args:
        config: family and sizes.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame; a
            whole number of pillars in x and y, or of voxels in x, y and z.
        point_channels: D, raw channels per point that are used; the first three are x, y, z in metres.

    Attributes:
        out_channels: C.
        voxel_size: edges (x, y, z) of a pillar or voxel, metres.
        point_range: the range box.
        point_channels: D.

    Raises:
        ValueError: the range box is not a whole number of cells, is too low for the sparse convolutions, or the 2D
            backbone's blocks would differ in size.
    """

    def __init__(
        self,
        config: EncoderConfig,
        point_range: tuple[float, float, float, float, float, float],
        point_channels: int = 5,
    ) -> None:
        super().__init__()
        if point_channels < 3:
            raise ValueError(f"Encoder: point_channels must be at least 3 (x, y, z), got {point_channels}")
        self.point_range = tuple(float(value) for value in point_range)
        self.point_channels = point_channels
        z_min, z_max = self.point_range[2], self.point_range[5]
        if config.kind == "voxels":
            size_x, size_y, size_z = (float(size) for size in config.voxels.voxel_size)
        else:
            size_x, size_y = (float(size) for size in config.pillars.pillar_size)
            size_z = z_max - z_min
        self.voxel_size = (size_x, size_y, size_z)
        num_x, num_y, num_z = (_whole_cells(axis, self.point_range, self.voxel_size) for axis in range(3))

        map_size = (num_y, num_x)
        self.vfe: nn.Module
        self.backbone_3d: nn.Module | None = None
        self.to_map: PointPillarScatter | HeightCompression
        if config.kind == "voxels":
            voxels = config.voxels
            if voxels.max_points is None:
                self.vfe = DynamicMeanVFE(self.voxel_size, self.point_range)
            else:
                self.vfe = MeanVFE(voxels, self.point_range)
            grid_size = (num_z, num_y, num_x)
            backbone: VoxelBackBone8x | VoxelResBackBone8x
            if voxels.backbone == "plain":
                backbone = VoxelBackBone8x(point_channels, grid_size)
            else:
                backbone = VoxelResBackBone8x(point_channels, grid_size, voxels.conv_bias)
            self.backbone_3d = backbone
            self.to_map = HeightCompression()
            self.out_channels = OUT_CHANNELS * backbone.out_depth
            map_size = ((num_y - 1) // 8 + 1, (num_x - 1) // 8 + 1)  # three times halved
        else:
            pillar_vfe = DynamicPillarVFE if config.pillars.max_points is None else PillarVFE
            self.vfe = pillar_vfe(config.pillars, point_channels, self.voxel_size, self.point_range)
            if config.kind == "dsvt":
                self.backbone_3d = DSVT(config.dsvt, map_size)
            self.to_map = PointPillarScatter(map_size)
            self.out_channels = config.pillars.vfe_filters[-1]
        self.backbone_2d: BaseBEVBackbone | BaseBEVResBackbone | None = None
        if config.bev == "after_2d":
            backbone_2d = BaseBEVBackbone if config.backbone_2d.kind == "plain" else BaseBEVResBackbone
            self.backbone_2d = backbone_2d(config.backbone_2d, self.out_channels, map_size)
            self.out_channels = self.backbone_2d.out_channels

    def forward(
        self,
        points: Tensor,  # [N, D or more]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> Tensor:  # [B, C, H, W]
        """Encodes the points `point_offsets[b]:point_offsets[b + 1]` of each frame b.

        Points outside the range box are ignored, and so are channels beyond D; a frame without points gives a finite
        map. Voxelization and point features keep the parameters' precision even under autocast (bf16 cannot hold
        coordinates); the 3D and the 2D backbone obey it.

        Args:
            points: coordinates may be NaN or infinite (such points are ignored), other channels are finite.
            point_offsets: ascending from 0 to N.

        Raises:
            ValueError: points have fewer than D channels; shape or values of the offsets.
            TypeError: the offsets are not int64.
        """
        if points.dim() != 2 or points.shape[1] < self.point_channels:
            raise ValueError(
                f"Encoder: points must have shape [N, D] with D of at least {self.point_channels}, got "
                f"{list(points.shape)}"
            )
        check_offsets("Encoder", "point_offsets", point_offsets, "BN", "points", points)
        num_frames = point_offsets.shape[0] - 1
        with torch.autocast(points.device.type, enabled=False):
            features, coords = self.vfe(points[:, : self.point_channels], point_offsets)
            features = features.to(next(self.parameters()).dtype)
        if isinstance(self.to_map, HeightCompression):
            assert self.backbone_3d is not None
            bev = self.to_map(self.backbone_3d(features, coords, num_frames))
        else:
            if self.backbone_3d is not None:
                features = self.backbone_3d(features, coords, num_frames)
            bev = self.to_map(features, coords, num_frames)
        encoded: Tensor = bev if self.backbone_2d is None else self.backbone_2d(bev)
        return encoded


def _whole_cells(axis: int, point_range: tuple[float, ...], voxel_size: tuple[float, ...]) -> int:
    low, high, size = point_range[axis], point_range[3 + axis], voxel_size[axis]
    cells = (high - low) / size
    if round(cells) < 1 or abs(cells - round(cells)) > 1e-3:
        raise ValueError(
            f"Encoder: point_range must span a whole number of cells in {'xyz'[axis]}, got "
            f"{low} to {high} at {size} m per cell = {cells:.3f}"
        )
    return round(cells)
