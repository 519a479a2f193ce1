# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""2D backbones of bird's-eye-view (BEV) maps: blocks at falling resolution, brought to one resolution and joined.

Layer order, normalisation constants and parameter names are those of OpenPCDet's and DSVT's classes of the same names.

B frames, C channels, H rows (y), W columns (x).
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from pred.models.encoders.norm import BatchNorm2d


@dataclass
class BEVBackboneConfig:
    """Sizes of the 2D backbone; the defaults are those of PointPillars as trained on nuScenes."""

    kind: Literal["plain", "residual"] = "plain"
    """plain: OpenPCDet's BaseBEVBackbone; residual: DSVT's BaseBEVResBackbone."""
    layer_nums: list[int] = field(default_factory=lambda: [3, 5, 5])
    """3x3 convolutions (residual: pairs of them) per block, besides what opens it."""
    layer_strides: list[int] = field(default_factory=lambda: [2, 2, 2])
    """Stride of what opens each block."""
    num_filters: list[int] = field(default_factory=lambda: [64, 128, 256])
    """Channels of each block."""
    upsample_strides: list[float] = field(default_factory=lambda: [0.5, 1, 2])
    """Resolution change of each block's output; below 1 it is a strided convolution."""
    num_upsample_filters: list[int] = field(default_factory=lambda: [128, 128, 128])
    """Channels of each block's output in the concatenated map."""
    conv_for_no_stride: bool = False
    """Where the resolution stays, a convolution in place of a transposed one (USE_CONV_FOR_NO_STRIDE, TransFusion): the
    same function, with the kernel's axes swapped."""

    def __post_init__(self) -> None:
        blocks = len(self.layer_nums)
        if blocks == 0:
            raise ValueError("BEVBackboneConfig: layer_nums must name at least one block, got []")
        for name in ("layer_strides", "num_filters", "upsample_strides", "num_upsample_filters"):
            if len(getattr(self, name)) != blocks:
                raise ValueError(
                    f"BEVBackboneConfig: {name} must have one entry per block ({blocks}, as "
                    f"layer_nums), got {getattr(self, name)}"
                )
        for name in ("layer_nums", "layer_strides", "num_filters", "num_upsample_filters"):
            minimum = 0 if name == "layer_nums" else 1
            if min(getattr(self, name)) < minimum:
                raise ValueError(
                    f"BEVBackboneConfig: {name} must be at least {minimum} everywhere, got {getattr(self, name)}"
                )
        if not all(0 < stride < math.inf for stride in self.upsample_strides):
            raise ValueError(
                f"BEVBackboneConfig: upsample_strides must be positive and finite, got {self.upsample_strides}"
            )
        factors = [max(stride, 1 / stride) for stride in self.upsample_strides]
        if any(abs(factor - round(factor)) > 1e-6 for factor in factors):
            raise ValueError(
                "BEVBackboneConfig: upsample_strides must be whole numbers or 1 over whole numbers, got "
                f"{self.upsample_strides}"
            )


class _BEVBackbone(nn.Module):
    """What the two backbones share: blocks, and the way of their outputs to one resolution.

    Args:
        config: sizes.
        in_channels: C of the input.
        grid_size: rows and columns (H, W) of the input.

    Raises:
        ValueError: the blocks' outputs would differ in size, or one would have a single cell.
    """

    def __init__(self, config: BEVBackboneConfig, in_channels: int, grid_size: tuple[int, int]) -> None:
        super().__init__()
        self.out_channels = sum(config.num_upsample_filters)
        self.blocks = nn.ModuleList()
        self.deblocks = nn.ModuleList()
        channels, size = in_channels, grid_size
        block_sizes, output_sizes = [], []
        for block, width in enumerate(config.num_filters):
            stride = config.layer_strides[block]
            self.blocks.append(nn.Sequential(*self._block(channels, width, stride, config.layer_nums[block])))
            channels = width
            size = ((size[0] - 1) // stride + 1, (size[1] - 1) // stride + 1)
            block_sizes.append(size)

            up, up_width = config.upsample_strides[block], config.num_upsample_filters[block]
            if up > 1 or (up == 1 and not config.conv_for_no_stride):
                factor = round(up)
                resize: nn.Module = nn.ConvTranspose2d(width, up_width, factor, stride=factor, bias=False)
                output_sizes.append((size[0] * factor, size[1] * factor))
            else:
                factor = round(1 / up)
                resize = nn.Conv2d(width, up_width, factor, stride=factor, bias=False)
                output_sizes.append((size[0] // factor, size[1] // factor))
            self.deblocks.append(nn.Sequential(resize, BatchNorm2d(up_width), nn.ReLU(inplace=True)))
        name = type(self).__name__
        if len(set(output_sizes)) > 1 or min(output_sizes[0]) < 1:
            raise ValueError(
                f"{name}: layer_strides and upsample_strides must bring every block of a "
                f"{grid_size[0]} x {grid_size[1]} grid to one size, got {output_sizes}"
            )
        if (1, 1) in [*block_sizes, *output_sizes]:  # batch normalisation of one frame needs two values
            raise ValueError(
                f"{name}: layer_strides and upsample_strides must leave every block of a {grid_size[0]} x "
                f"{grid_size[1]} grid more than one cell, got {block_sizes} brought to {output_sizes}"
            )

    def _block(self, before: int, after: int, stride: int, repeats: int) -> list[nn.Module]:
        raise NotImplementedError

    def forward(self, bev: Tensor) -> Tensor:  # [B, C, H, W] to [B, C', H', W']
        """Concatenated outputs of the blocks."""
        outputs = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            bev = block(bev)
            outputs.append(deblock(bev))
        return torch.cat(outputs, dim=1) if len(outputs) > 1 else outputs[0]


class BaseBEVBackbone(_BEVBackbone):
    """Blocks of 3x3 convolutions, the first of each strided (PointPillars, SECOND)."""

    def _block(self, before: int, after: int, stride: int, repeats: int) -> list[nn.Module]:
        # OpenPCDet pads in a layer of its own at index 0; the convolution pads as well and
        # saves a copy of the map. The index stays, for the names' sake.
        layers: list[nn.Module] = [nn.Identity()]
        for index in range(1 + repeats):
            strided = index == 0
            layers += [
                nn.Conv2d(
                    before if strided else after, after, 3, stride=stride if strided else 1, padding=1, bias=False
                ),
                BatchNorm2d(after),
                nn.ReLU(inplace=True),
            ]
        return layers


class BaseBEVResBackbone(_BEVBackbone):
    """Blocks of residual pairs of 3x3 convolutions, the first of each strided and with a projection (DSVT)."""

    def _block(self, before: int, after: int, stride: int, repeats: int) -> list[nn.Module]:
        return [BasicBlock(before, after, stride, project=True), *(BasicBlock(after, after) for _ in range(repeats))]


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around which the input passes, by a 1x1 convolution where `project`."""

    def __init__(self, before: int, after: int, stride: int = 1, project: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
        self.bn1 = BatchNorm2d(after)
        self.conv2 = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.bn2 = BatchNorm2d(after)
        self.stride = stride
        self.downsample_layer: nn.Module | None = None
        if project:
            self.downsample_layer = nn.Sequential(nn.Conv2d(before, after, 1, bias=False), BatchNorm2d(after))

    def forward(self, x: Tensor) -> Tensor:
        identity = x
        if self.downsample_layer is not None:
            # The stride by slicing: in bfloat16, channels-last and with 8 channels, the backward pass of torch 2.13's
            # strided 1x1 convolution on CPUs writes out of bounds.
            identity = self.downsample_layer(x[:, :, :: self.stride, :: self.stride])
        out = torch.relu_(self.bn1(self.conv1(x)))
        return torch.relu_(self.bn2(self.conv2(out)) + identity)
