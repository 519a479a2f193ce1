# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Pillar features: points to one feature vector per occupied pillar, and their place in a map.

Layer order, normalisation constants and parameter names are those of OpenPCDet's classes of the same names. Dynamic
pillars take every point; hard pillars take the first points of the first pillars, as PointPillars was published. They
share their parameters, but normalise differently: hard ones count the empty slots of their tables.

N points, M pillars, P slots per pillar, B frames, D raw point channels, C feature channels.
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.models.encoders.norm import BatchNorm1d
from pred.ops import segment_reduce, voxelize, voxelize_hard


@dataclass
class PillarConfig:
    """Sizes of the pillar features; the defaults are CenterPoint's with dynamic pillars on nuScenes."""

    pillar_size: tuple[float, float] = (0.2, 0.2)
    """Extent of a pillar in x and y, metres."""
    vfe_filters: list[int] = field(default_factory=lambda: [64, 64])
    """Output channels of each point-wise layer (all but the last: half of them per-point)."""
    max_points: int | None = None
    """Points of a pillar that count, the first ones (hard pillars); None: all points of all pillars (dynamic)."""
    max_pillars: tuple[int, int] = (30000, 30000)
    """Pillars of a frame that count in training and in evaluation, the first ones; only with `max_points`."""

    def __post_init__(self) -> None:
        if len(self.pillar_size) != 2 or not all(0 < size < math.inf for size in self.pillar_size):
            raise ValueError(f"PillarConfig: pillar_size must be 2 positive lengths, got {tuple(self.pillar_size)}")
        if not self.vfe_filters:
            raise ValueError("PillarConfig: vfe_filters must name at least one layer, got []")
        if min(self.vfe_filters) < 1:
            raise ValueError(f"PillarConfig: vfe_filters must be at least 1 everywhere, got {self.vfe_filters}")
        if any(width % 2 for width in self.vfe_filters[:-1]):
            raise ValueError(
                f"PillarConfig: vfe_filters must be even for all but the last layer, got {self.vfe_filters}"
            )
        if self.max_points is not None and self.max_points < 1:
            raise ValueError(f"PillarConfig: max_points must be at least 1 or None, got {self.max_points}")
        if len(self.max_pillars) != 2 or min(self.max_pillars) < 1:
            raise ValueError(
                f"PillarConfig: max_pillars must be 2 numbers of at least 1, got {tuple(self.max_pillars)}"
            )


class DynamicPillarVFE(nn.Module):
    """Features of every occupied pillar from all of its points.

    Args:
        config: sizes.
        point_channels: D; the first three are x, y, z in metres.
        voxel_size: edges (x, y, z) of a pillar, metres.
        point_range: range box, metres.
    """

    def __init__(
        self,
        config: PillarConfig,
        point_channels: int,
        voxel_size: tuple[float, float, float],
        point_range: tuple[float, ...],
    ) -> None:
        super().__init__()
        self.voxel_size = voxel_size
        self.point_range = point_range
        self.pfn_layers = _pfn_layers(point_channels, config.vfe_filters)

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> tuple[Tensor, Tensor]:
        """Returns pillar features `[M, C]` and their coordinates (b, z, y, x) `[M, 4]` int64."""
        pillars = voxelize(points, point_offsets, self.voxel_size, self.point_range)
        inside = pillars.point_to_voxel >= 0
        points = points[inside].to(next(self.parameters()).dtype)
        pillar = pillars.point_to_voxel[inside]
        num_pillars = pillars.coords.shape[0]

        xyz = points[:, :3]
        mean = segment_reduce(xyz, pillar, num_pillars, "mean")
        centre = cell_centres(pillars.coords, self.voxel_size, self.point_range, xyz)
        features = torch.cat([points, xyz - mean[pillar], xyz - centre[pillar]], dim=1)
        maximum = features
        for index, layer in enumerate(self.pfn_layers):
            if index > 0:
                features = torch.cat([features, maximum.index_select(0, pillar)], dim=1)
            features = layer(features)
            maximum = segment_reduce(features, pillar, num_pillars, "max")
        return maximum, pillars.coords


class PillarVFE(nn.Module):
    """Features of the first `max_pillars` occupied pillars of each frame from their first `max_points` points.

    Slots without a point are zero at first, and then go through all layers, batch normalisation and the maximum
    like points, as published.

    Args:
        config: sizes; its `max_points` is not None.
        point_channels: D; the first three are x, y, z in metres.
        voxel_size: edges (x, y, z) of a pillar, metres.
        point_range: range box, metres.
    """

    def __init__(
        self,
        config: PillarConfig,
        point_channels: int,
        voxel_size: tuple[float, float, float],
        point_range: tuple[float, ...],
    ) -> None:
        super().__init__()
        assert config.max_points is not None
        self.max_points = config.max_points
        self.max_pillars = config.max_pillars
        self.voxel_size = voxel_size
        self.point_range = point_range
        self.pfn_layers = _pfn_layers(point_channels, config.vfe_filters)

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> tuple[Tensor, Tensor]:
        """Returns pillar features `[M, C]` and their coordinates (b, z, y, x) `[M, 4]` int64."""
        in_training, in_evaluation = self.max_pillars
        max_pillars = in_training if self.training else in_evaluation
        pillars = voxelize_hard(points, point_offsets, self.voxel_size, self.point_range, self.max_points, max_pillars)
        slots = pillars.voxels.to(next(self.parameters()).dtype)  # [M, P, D]
        counts = pillars.counts[:, None, None]
        xyz = slots[:, :, :3]
        mean = xyz.sum(dim=1, keepdim=True) / counts
        centre = cell_centres(pillars.coords, self.voxel_size, self.point_range, xyz)[:, None]
        features = torch.cat([slots, xyz - mean, xyz - centre], dim=2)
        features = features * (torch.arange(self.max_points, device=counts.device)[:, None] < counts)
        maximum = features
        for index, layer in enumerate(self.pfn_layers):
            if index > 0:
                features = torch.cat([features, maximum.expand_as(features)], dim=2)
            features = layer(features)
            maximum = features.amax(dim=1, keepdim=True)
        return maximum[:, 0], pillars.coords


class PFNLayer(nn.Module):
    """Linear, batch norm, ReLU of each point or slot."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels, out_channels, bias=False)
        self.norm = BatchNorm1d(out_channels)

    def forward(self, features: Tensor) -> Tensor:  # [..., in] to [..., out]
        values = self.linear(features)
        return F.relu(self.norm(values.flatten(0, -2))).view_as(values)


class PointPillarScatter(nn.Module):
    """Pillar features to a map with zeros where no pillar is occupied; no parameters.

    Args:
        grid_size: rows and columns (ny, nx).
    """

    def __init__(self, grid_size: tuple[int, int]) -> None:
        super().__init__()
        self.grid_size = grid_size

    def forward(
        self,
        features: Tensor,  # [M, C]
        coords: Tensor,  # [M, 4] int64
        num_frames: int,
    ) -> Tensor:  # [B, C, ny, nx]
        # Pillars are unique, so a copy is enough. The map is stored channels-last, which is also
        # what the convolutions like best.
        num_rows, num_columns = self.grid_size
        channels = features.shape[1]
        canvas = features.new_zeros(num_frames * num_rows * num_columns, channels)
        frame, row, column = coords[:, 0], coords[:, 2], coords[:, 3]
        canvas = canvas.index_copy(0, (frame * num_rows + row) * num_columns + column, features)
        return canvas.view(num_frames, num_rows, num_columns, channels).permute(0, 3, 1, 2)


def cell_centres(
    coords: Tensor,  # [M, 4] int64
    voxel_size: tuple[float, float, float],
    point_range: tuple[float, ...],
    like: Tensor,
) -> Tensor:  # [M, 3]
    """Centres (x, y, z) of cells (b, z, y, x), metres, of `like`'s dtype."""
    cell = coords[:, [3, 2, 1]].to(like.dtype) + 0.5
    return cell * like.new_tensor(voxel_size) + like.new_tensor(point_range[:3])


def _pfn_layers(point_channels: int, filters: list[int]) -> nn.ModuleList:
    # A layer before the last computes half of its channels; the other half is their maximum over the pillar.
    before = [point_channels + 6, *filters[:-1]]
    widths = [*(width // 2 for width in filters[:-1]), filters[-1]]
    return nn.ModuleList(PFNLayer(*channels) for channels in zip(before, widths, strict=True))
