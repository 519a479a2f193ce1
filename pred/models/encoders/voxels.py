# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Voxel features and sparse 3D backbones of SECOND and CenterPoint.

Layer order, normalisation constants and parameter names are those of OpenPCDet's classes of the same names.

N points, M voxels, B frames, D raw point channels, C feature channels.
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from pred.models.encoders.norm import BatchNorm1d
from pred.nn import SparseConv3d, SparseModule, SparseSequential, SparseTensor, SubMConv3d
from pred.ops import segment_reduce, voxelize, voxelize_hard

OUT_CHANNELS = 128
"""Of the last sparse convolution."""


@dataclass
class VoxelConfig:
    """Sizes of the voxel encoder; the defaults are CenterPoint's on nuScenes, with voxels of 0.1 m."""

    backbone: Literal["plain", "residual"] = "residual"
    """plain: VoxelBackBone8x (SECOND, PV-RCNN on ONCE); residual: VoxelResBackBone8x (CenterPoint)."""
    voxel_size: tuple[float, float, float] = (0.1, 0.1, 0.2)
    """Edges of a voxel in x, y and z, metres."""
    conv_bias: bool = True
    """Residual blocks: convolutions have a bias, as OpenPCDet's have unless USE_BIAS is False (TransFusion)."""
    max_points: int | None = 10
    """Points of a voxel whose mean is taken, the first ones (hard voxels); None: all points of all voxels (dynamic)."""
    max_voxels: tuple[int, int] = (60000, 60000)
    """Voxels of a frame that count in training and in evaluation, the first ones; only with `max_points`."""

    def __post_init__(self) -> None:
        if len(self.voxel_size) != 3 or not all(0 < size < math.inf for size in self.voxel_size):
            raise ValueError(f"VoxelConfig: voxel_size must be 3 positive lengths, got {tuple(self.voxel_size)}")
        if self.max_points is not None and self.max_points < 1:
            raise ValueError(f"VoxelConfig: max_points must be at least 1 or None, got {self.max_points}")
        if len(self.max_voxels) != 2 or min(self.max_voxels) < 1:
            raise ValueError(f"VoxelConfig: max_voxels must be 2 numbers of at least 1, got {tuple(self.max_voxels)}")
        if self.backbone == "plain" and not self.conv_bias:
            raise ValueError(
                "VoxelConfig: conv_bias must be left out for the plain backbone, which has none, got False"
            )


class DynamicMeanVFE(nn.Module):
    """Mean of all points of every occupied voxel; no parameters.

    Args:
        voxel_size: edges (x, y, z), metres.
        point_range: range box, metres.
    """

    def __init__(self, voxel_size: tuple[float, float, float], point_range: tuple[float, ...]) -> None:
        super().__init__()
        self.voxel_size = voxel_size
        self.point_range = point_range

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> tuple[Tensor, Tensor]:
        """Returns means `[M, D]` and coordinates (b, z, y, x) `[M, 4]` int64."""
        voxels = voxelize(points, point_offsets, self.voxel_size, self.point_range)
        return segment_reduce(points, voxels.point_to_voxel, voxels.coords.shape[0], "mean"), voxels.coords


class MeanVFE(nn.Module):
    """Mean of the first `max_points` points of the first `max_voxels` occupied voxels of each frame; no parameters.

    Args:
        config: caps; its `max_points` is not None.
        point_range: range box, metres.
    """

    def __init__(self, config: VoxelConfig, point_range: tuple[float, ...]) -> None:
        super().__init__()
        assert config.max_points is not None
        self.max_points = config.max_points
        self.max_voxels = config.max_voxels
        self.voxel_size = config.voxel_size
        self.point_range = point_range

    def forward(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> tuple[Tensor, Tensor]:
        """Returns means `[M, D]` and coordinates (b, z, y, x) `[M, 4]` int64."""
        in_training, in_evaluation = self.max_voxels
        voxels = voxelize_hard(
            points,
            point_offsets,
            self.voxel_size,
            self.point_range,
            self.max_points,
            in_training if self.training else in_evaluation,
        )
        return voxels.voxels.sum(dim=1) / voxels.counts[:, None], voxels.coords


class _BackBone8x(nn.Module):
    """Stages at full, half, quarter and eighth resolution, and a convolution that halves the height once more.

    Args:
        in_channels: C of the voxel features.
        grid_size: voxels (nz, ny, nx); the grid of the convolutions has one layer more in z.
        widths: channels of the four stages.
        blocks: of the first stage; the others have two, after the strided convolution.
        block: makes one of a width; those of a key are on the same sites.

    Raises:
        ValueError: the grid is too low to be halved so often.
    """

    def __init__(
        self,
        in_channels: int,
        grid_size: tuple[int, int, int],
        widths: tuple[int, int, int, int],
        blocks: int,
        block: Callable[[int, str], SparseModule],
    ) -> None:
        super().__init__()
        depth = grid_size[0] + 1
        self.spatial_shape = (depth, *grid_size[1:])
        depth = (((depth + 1) // 2 + 1) // 2 - 1) // 2  # after conv4, which does not pad in z
        self.out_depth = (depth - 1) // 2
        if self.out_depth < 1:
            raise ValueError(
                f"{type(self).__name__}: voxel_size must divide the range box into at least 24 layers in z, "
                f"got {grid_size[0]}"
            )
        self.conv_input = _layer(SubMConv3d(in_channels, widths[0], 3, padding=1, bias=False, indice_key="subm1"))
        self.conv1 = SparseSequential(*(block(widths[0], "subm1") for _ in range(blocks)))
        self.conv2 = self._stage(widths[0], widths[1], 1, block, 2)
        self.conv3 = self._stage(widths[1], widths[2], 1, block, 3)
        self.conv4 = self._stage(widths[2], widths[3], (0, 1, 1), block, 4)
        self.conv_out = _layer(SparseConv3d(widths[3], OUT_CHANNELS, (3, 1, 1), stride=(2, 1, 1), bias=False))

    @staticmethod
    def _stage(
        before: int,
        after: int,
        padding: int | tuple[int, int, int],
        block: Callable[[int, str], SparseModule],
        stage: int,
    ) -> SparseSequential:
        strided = SparseConv3d(before, after, 3, stride=2, padding=padding, bias=False, indice_key=f"spconv{stage}")
        return SparseSequential(_layer(strided), *(block(after, f"subm{stage}") for _ in range(2)))

    def forward(
        self,
        features: Tensor,  # [M, C]
        coords: Tensor,  # [M, 4] int64
        num_frames: int,
    ) -> SparseTensor:
        """Sparse tensor of 128 channels at an eighth of the resolution in y and x. Obeys autocast.

        Args:
            features: of each voxel.
            coords: (b, z, y, x) of each voxel, no two alike.
            num_frames: B.
        """
        x = self.conv_input(SparseTensor(features, coords, self.spatial_shape, num_frames))
        for stage in (self.conv1, self.conv2, self.conv3, self.conv4):
            x = stage(x)
        encoded: SparseTensor = self.conv_out(x)
        return encoded


class VoxelBackBone8x(_BackBone8x):
    """Sparse convolutions without shortcuts (Yan et al., "SECOND", 2018).

    Args:
        in_channels: C of the voxel features.
        grid_size: voxels (nz, ny, nx).
    """

    def __init__(self, in_channels: int, grid_size: tuple[int, int, int]) -> None:
        def block(width: int, key: str) -> SparseModule:
            return _layer(SubMConv3d(width, width, 3, padding=1, bias=False, indice_key=key))

        super().__init__(in_channels, grid_size, (16, 32, 64, 64), 1, block)


class VoxelResBackBone8x(_BackBone8x):
    """Sparse convolutions in residual blocks.

    Args:
        in_channels: C of the voxel features.
        grid_size: voxels (nz, ny, nx).
        conv_bias: whether the convolutions of the blocks have a bias.
    """

    def __init__(self, in_channels: int, grid_size: tuple[int, int, int], conv_bias: bool = True) -> None:
        def block(width: int, key: str) -> SparseModule:
            return SparseBasicBlock(width, conv_bias, key)

        super().__init__(in_channels, grid_size, (16, 32, 64, 128), 2, block)


class SparseBasicBlock(SparseModule):
    """Two submanifold convolutions around which the input passes."""

    def __init__(self, channels: int, bias: bool, indice_key: str) -> None:
        super().__init__()
        self.conv1 = SubMConv3d(channels, channels, 3, padding=1, bias=bias, indice_key=indice_key)
        self.bn1 = BatchNorm1d(channels)
        self.conv2 = SubMConv3d(channels, channels, 3, padding=1, bias=bias, indice_key=indice_key)
        self.bn2 = BatchNorm1d(channels)

    def forward(self, x: SparseTensor) -> SparseTensor:
        out = self.conv1(x)
        out = self.conv2(out.replace_feature(torch.relu_(self.bn1(out.features))))
        features = torch.relu_(self.bn2(out.features) + x.features)
        return x.replace_feature(features)


class HeightCompression(nn.Module):
    """Sparse tensor `[B, C, D, H, W]` to a map `[B, C D, H, W]`, channels first, height after; no parameters."""

    def forward(self, x: SparseTensor) -> Tensor:
        # Stored channels-last, as the convolutions like best.
        grid = x.dense(channels_first=False)  # [B, D, H, W, C]
        return grid.permute(0, 2, 3, 4, 1).flatten(3).permute(0, 3, 1, 2)


def _layer(convolution: SubMConv3d | SparseConv3d) -> SparseSequential:
    return SparseSequential(convolution, BatchNorm1d(convolution.out_channels), nn.ReLU(inplace=True))
