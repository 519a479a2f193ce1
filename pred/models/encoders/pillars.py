# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""PointPillars encoder: dynamic pillar features, then the 2D backbone.

Layer order, normalisation constants and parameter names are those of OpenPCDet's
`DynamicPillarVFE`, `PointPillarScatter` and `BaseBEVBackbone`, so the state dict loads there as it
is (`vfe.…`, `backbone_2d.…`).

N points, M pillars, B frames, D raw point channels, C feature channels.
"""

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.ops import segment_reduce, voxelize

BATCH_NORM_EPS = 1e-3
BATCH_NORM_MOMENTUM = 0.01


@dataclass
class PillarEncoderConfig:
    """Sizes of the pillar encoder; the defaults are PointPillars as trained on nuScenes."""

    pillar_size: tuple[float, float] = (0.2, 0.2)
    """Extent of a pillar in x and y, metres."""
    vfe_filters: list[int] = field(default_factory=lambda: [64, 64])
    """Output channels of each point-wise layer (all but the last: half of them per-point)."""
    layer_nums: list[int] = field(default_factory=lambda: [3, 5, 5])
    """3x3 convolutions per block, besides the strided one that opens it."""
    layer_strides: list[int] = field(default_factory=lambda: [2, 2, 2])
    """Stride of the convolution that opens each block."""
    num_filters: list[int] = field(default_factory=lambda: [64, 128, 256])
    """Channels of each block."""
    upsample_strides: list[float] = field(default_factory=lambda: [0.5, 1, 2])
    """Resolution change of each block's output; below 1 it is a strided convolution."""
    num_upsample_filters: list[int] = field(default_factory=lambda: [128, 128, 128])
    """Channels of each block's output in the concatenated map."""

    def __post_init__(self) -> None:
        if not all(size > 0 for size in self.pillar_size):
            raise ValueError(f"PillarEncoderConfig: pillar_size must be positive, got {tuple(self.pillar_size)}")
        if not self.vfe_filters:
            raise ValueError("PillarEncoderConfig: vfe_filters must name at least one layer, got []")
        if any(width % 2 for width in self.vfe_filters[:-1]):
            raise ValueError(
                f"PillarEncoderConfig: vfe_filters must be even for all but the last layer, got {self.vfe_filters}"
            )
        blocks = len(self.layer_nums)
        if blocks == 0:
            raise ValueError("PillarEncoderConfig: layer_nums must name at least one block, got []")
        for name in ("layer_strides", "num_filters", "upsample_strides", "num_upsample_filters"):
            if len(getattr(self, name)) != blocks:
                raise ValueError(
                    f"PillarEncoderConfig: {name} must have one entry per block ({blocks}, as "
                    f"layer_nums), got {getattr(self, name)}"
                )
        for name in ("vfe_filters", "layer_nums", "layer_strides", "num_filters", "num_upsample_filters"):
            minimum = 0 if name == "layer_nums" else 1
            if min(getattr(self, name)) < minimum:
                raise ValueError(
                    f"PillarEncoderConfig: {name} must be at least {minimum} everywhere, got {getattr(self, name)}"
                )
        if not all(0 < stride < math.inf for stride in self.upsample_strides):
            raise ValueError(
                f"PillarEncoderConfig: upsample_strides must be positive and finite, got {self.upsample_strides}"
            )


class PillarEncoder(nn.Module):
    """Points to a BEV map `[B, C, H, W]` (row = y, column = x), C = sum of the upsample filters.

    Args:
        config: sizes.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame; a
            whole number of pillars in x and y.
        point_channels: D, raw channels per point; the first three are x, y, z in metres.

    Raises:
        ValueError: the range box is not a whole number of pillars, or the blocks' outputs would
            differ in size.
    """

    def __init__(
        self,
        config: PillarEncoderConfig,
        point_range: tuple[float, float, float, float, float, float],
        point_channels: int = 5,
    ) -> None:
        super().__init__()
        x_min, y_min, z_min, x_max, y_max, z_max = point_range
        self.point_range = tuple(float(value) for value in point_range)
        self.voxel_size = (*(float(size) for size in config.pillar_size), float(z_max - z_min))
        self.num_columns = _whole_cells("x", x_min, x_max, self.voxel_size[0])  # nx
        self.num_rows = _whole_cells("y", y_min, y_max, self.voxel_size[1])  # ny
        self.vfe = PillarFeatures(point_channels, config.vfe_filters, self.voxel_size, self.point_range)
        self.backbone_2d = BEVBackbone(config, (self.num_rows, self.num_columns))
        self.out_channels: int = sum(config.num_upsample_filters)

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> Tensor:  # [B, C, H, W]
        """Encodes the points `point_offsets[b]:point_offsets[b + 1]` of each frame b.

        Points outside the range box are ignored; a frame without points gives a finite map.
        The point-wise part runs in the parameters' precision even under autocast (bf16 cannot hold
        coordinates), the 2D backbone obeys autocast.
        """
        num_frames = point_offsets.shape[0] - 1
        with torch.autocast(points.device.type, enabled=False):
            features, coords = self.vfe(points, point_offsets)
            # Pillars are unique, so a copy is enough. The canvas is stored channels-last, which is
            # also what the convolutions like best.
            canvas = features.new_zeros(num_frames * self.num_rows * self.num_columns, features.shape[1])
            frame, row, column = coords[:, 0], coords[:, 2], coords[:, 3]
            cell = (frame * self.num_rows + row) * self.num_columns + column
            canvas.index_copy_(0, cell, features)
            canvas = canvas.view(num_frames, self.num_rows, self.num_columns, -1)
        return self.backbone_2d(canvas.permute(0, 3, 1, 2))


class PillarFeatures(nn.Module):
    """Dynamic pillar features: every point counts, no cap on points or pillars."""

    def __init__(
        self,
        point_channels: int,
        filters: list[int],
        voxel_size: tuple[float, ...],
        point_range: tuple[float, ...],
    ) -> None:
        super().__init__()
        self.voxel_size = voxel_size
        self.point_range = point_range
        widths = [point_channels + 6, *filters]
        self.pfn_layers = nn.ModuleList(
            PointLayer(before, after, last=layer == len(filters))
            for layer, (before, after) in enumerate(zip(widths, filters, strict=False), start=1)
        )

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1]
    ) -> tuple[Tensor, Tensor]:
        """Returns pillar features `[M, C]` and their coordinates (b, z, y, x) `[M, 4]` int64."""
        pillars = voxelize(points, point_offsets, self.voxel_size, self.point_range)
        inside = pillars.point_to_voxel >= 0
        points = points[inside].to(next(self.parameters()).dtype)
        pillar = pillars.point_to_voxel[inside]
        num_pillars = pillars.coords.shape[0]

        xyz = points[:, :3]
        mean = segment_reduce(xyz, pillar, num_pillars, "mean")
        x_min, y_min, z_min = self.point_range[:3]
        size = xyz.new_tensor(self.voxel_size)
        low = xyz.new_tensor((x_min, y_min, z_min))
        centre = (pillars.coords[:, [3, 2, 1]].to(xyz.dtype) + 0.5) * size + low
        features = torch.cat([points, xyz - mean[pillar], xyz - centre[pillar]], dim=1)
        for layer in self.pfn_layers:
            features = layer(features, pillar, num_pillars)
        return features, pillars.coords


class PointLayer(nn.Module):
    """Linear, batch norm, ReLU, maximum per pillar.

    The last layer returns the maxima `[M, out]`; any other emits half the width per point and
    appends its pillar's maximum: `[N, out]`.
    """

    def __init__(self, in_channels: int, out_channels: int, last: bool) -> None:
        super().__init__()
        self.last = last
        width = out_channels if last else out_channels // 2
        self.linear = nn.Linear(in_channels, width, bias=False)
        self.norm = nn.BatchNorm1d(width, eps=BATCH_NORM_EPS, momentum=BATCH_NORM_MOMENTUM)

    def forward(self, features: Tensor, pillar: Tensor, num_pillars: int) -> Tensor:
        features = F.relu(self._normalise(self.linear(features)))
        maximum = segment_reduce(features, pillar, num_pillars, "max")
        if self.last:
            return maximum
        return torch.cat([features, maximum.index_select(0, pillar)], dim=1)

    def _normalise(self, features: Tensor) -> Tensor:
        # One point has no variance (torch raises) and no point would write NaN statistics: such a
        # batch is normalised by the running statistics and leaves them as they are.
        norm = self.norm
        if self.training and features.shape[0] < 2:
            return F.batch_norm(features, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)
        return norm(features)


class BEVBackbone(nn.Module):
    """Blocks of 3x3 convolutions at falling resolution, brought to one resolution and joined."""

    def __init__(self, config: PillarEncoderConfig, grid_size: tuple[int, int]) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        self.deblocks = nn.ModuleList()
        channels = config.vfe_filters[-1]
        size = grid_size
        block_sizes, output_sizes = [], []
        for block, width in enumerate(config.num_filters):
            stride = config.layer_strides[block]
            # OpenPCDet pads in a layer of its own at index 0; the convolution pads as well and
            # saves a copy of the map. The index stays, for the names' sake.
            layers: list[nn.Module] = [nn.Identity(), *_convolution(channels, width, stride)]
            for _ in range(config.layer_nums[block]):
                layers += _convolution(width, width, 1)
            self.blocks.append(nn.Sequential(*layers))
            channels = width
            size = ((size[0] - 1) // stride + 1, (size[1] - 1) // stride + 1)
            block_sizes.append(size)

            up = config.upsample_strides[block]
            if up >= 1:
                factor = round(up)
                resize: nn.Module = nn.ConvTranspose2d(
                    width, config.num_upsample_filters[block], factor, stride=factor, bias=False
                )
                output_sizes.append((size[0] * factor, size[1] * factor))
            else:
                factor = round(1 / up)
                resize = nn.Conv2d(width, config.num_upsample_filters[block], factor, stride=factor, bias=False)
                output_sizes.append((size[0] // factor, size[1] // factor))
            self.deblocks.append(
                nn.Sequential(resize, _batch_norm(config.num_upsample_filters[block]), nn.ReLU(inplace=True))
            )
        if len(set(output_sizes)) > 1 or min(output_sizes[0]) < 1:
            raise ValueError(
                "PillarEncoder: layer_strides and upsample_strides must bring every block of a "
                f"{grid_size[0]} x {grid_size[1]} grid to one size, got {output_sizes}"
            )
        if (1, 1) in [*block_sizes, *output_sizes]:  # batch normalisation of one frame needs two values
            raise ValueError(
                f"PillarEncoder: layer_strides and upsample_strides must leave every block of a {grid_size[0]} x "
                f"{grid_size[1]} grid more than one cell, got {block_sizes} brought to {output_sizes}"
            )

    def forward(self, canvas: Tensor) -> Tensor:
        outputs = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            canvas = block(canvas)
            outputs.append(deblock(canvas))
        return torch.cat(outputs, dim=1) if len(outputs) > 1 else outputs[0]


def _convolution(before: int, after: int, stride: int) -> list[nn.Module]:
    return [
        nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False),
        _batch_norm(after),
        nn.ReLU(inplace=True),
    ]


def _batch_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=BATCH_NORM_EPS, momentum=BATCH_NORM_MOMENTUM)


def _whole_cells(axis: str, low: float, high: float, size: float) -> int:
    cells = (high - low) / size
    if round(cells) < 1 or abs(cells - round(cells)) > 1e-3:
        raise ValueError(
            f"PillarEncoder: point_range must span a whole number of pillars in {axis}, got "
            f"{low} to {high} at {size} m per pillar = {cells:.3f}"
        )
    return round(cells)
