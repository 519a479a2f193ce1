# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Layers of OpenPCDet, DSVT and mmdetection3d rebuilt from plain torch modules: same names, shapes and order.

Sparse convolutions are dense ones that keep track of the active sites: a submanifold convolution keeps them, any other
makes a site active where one of its inputs is. For OpenPCDet kernels are (out, z, y, x, in), for mmdetection3d
(z, y, x, in, out), as in the files.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.export_check import Spec, read_specs

MODELS = (
    "dsvt_nus", "dsvt_waymo", "pcdet_nus_cp_vox01", "pcdet_nus_dynpp", "pcdet_nus_pp", "pcdet_nus_second",
    "pcdet_nus_tf", "pcdet_once_cp", "pcdet_once_pp", "pcdet_once_pvrcnn", "pcdet_once_second", "pcdet_waymo_dsvt",
)  # fmt: skip
"""Detectors of OpenPCDet and DSVT whose state dicts are known."""

Sites = tuple[Tensor, Tensor]
"""Features [B, C, D, H, W], zero where inactive, and active sites [B, 1, D, H, W] of 0 and 1."""


def names_file(model: str) -> Path:
    """Names, shapes and types of a detector's state dict, as its framework has them."""
    folder = os.environ.get("PRED_TEST_FIXTURES")
    if not folder:
        pytest.skip("PRED_TEST_FIXTURES is not set: no names and shapes of the frameworks' models")
    return Path(folder) / "state_dicts" / f"{model}.txt"


def random_state(specs: dict[str, Spec], seed: int = 0) -> dict[str, Tensor]:
    """Weights of given names, shapes and types; variances are positive."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, spec in specs.items():
        if spec.dtype == "int64":
            state[name] = torch.randint(1, 1000, spec.shape, generator=generator)
        elif name.endswith("running_var"):
            state[name] = torch.rand(spec.shape, generator=generator) + 0.5
        else:
            fan_in = max(1, torch.Size(spec.shape).numel() // max(spec.shape[0], 1))
            state[name] = torch.randn(spec.shape, generator=generator) / fan_in**0.5
    return state


def encoder_specs(model: str) -> dict[str, Spec]:
    specs = read_specs(names_file(model))
    return {name: spec for name, spec in specs.items() if name.split(".")[0] in ("vfe", "backbone_3d", "backbone_2d")}


class SparseConvolution(nn.Module):
    """Dense stand-in for spconv's SubMConv3d and SparseConv3d."""

    def __init__(
        self,
        order: str,
        before: int,
        after: int,
        kernel: tuple[int, int, int] = (3, 3, 3),
        stride: tuple[int, int, int] = (1, 1, 1),
        padding: tuple[int, int, int] = (1, 1, 1),
        submanifold: bool = True,
        bias: bool = False,
    ) -> None:
        super().__init__()
        shape = (after, *kernel, before) if order == "krsc" else (*kernel, before, after)
        self.weight = nn.Parameter(torch.zeros(shape))
        self.bias = nn.Parameter(torch.zeros(after)) if bias else None
        self._axes = (0, 4, 1, 2, 3) if order == "krsc" else (4, 3, 0, 1, 2)
        self._kernel, self._stride, self._padding, self._submanifold = kernel, stride, padding, submanifold

    def forward(self, sites: Sites) -> Sites:
        features, active = sites
        features = F.conv3d(features, self.weight.permute(self._axes), self.bias, self._stride, self._padding)
        if not self._submanifold:
            active = F.max_pool3d(active, self._kernel, self._stride, self._padding)
        return features * active, active


class SparseSequential(nn.Sequential):
    def forward(self, sites: Sites) -> Sites:
        for layer in self:
            if isinstance(layer, nn.BatchNorm3d | nn.ReLU):
                sites = layer(sites[0]) * sites[1], sites[1]
            else:
                sites = layer(sites)
        return sites


class ResidualBlock(nn.Module):
    """SparseBasicBlock: with biases in OpenPCDet, without in mmdetection3d."""

    def __init__(self, order: str, channels: int, bias: bool) -> None:
        super().__init__()
        self.conv1 = SparseConvolution(order, channels, channels, bias=bias)
        self.bn1 = nn.BatchNorm3d(channels, eps=1e-3)
        self.conv2 = SparseConvolution(order, channels, channels, bias=bias)
        self.bn2 = nn.BatchNorm3d(channels, eps=1e-3)

    def forward(self, sites: Sites) -> Sites:
        features, active = self.conv1(sites)
        features = F.relu(self.bn1(features)) * active
        features, _ = self.conv2((features, active))
        return F.relu(self.bn2(features) + sites[0]) * active, active


def sparse_layer(order: str, before: int, after: int, down: str = "") -> SparseSequential:
    """Convolution, batch normalisation, ReLU; ``down``: "" keeps the sites, "2" halves, "z" leaves z unpadded."""
    kernel, stride, padding = (3, 3, 3), (1, 1, 1), (1, 1, 1)
    if down in ("2", "z"):
        stride, padding = (2, 2, 2), (0, 1, 1) if down == "z" else (1, 1, 1)
    elif down == "out":
        kernel, stride, padding = (3, 1, 1), (2, 1, 1), (0, 0, 0)
    convolution = SparseConvolution(order, before, after, kernel, stride, padding, submanifold=not down)
    return SparseSequential(convolution, nn.BatchNorm3d(after, eps=1e-3), nn.ReLU())


def flatten_height(sites: Sites) -> Tensor:
    features, _ = sites
    return features.flatten(1, 2)


class OpenPCDetVoxelBackbone(nn.Module):
    """VoxelBackBone8x, or VoxelResBackBone8x with or without biases."""

    def __init__(self, point_channels: int, residual: bool, bias: bool = True) -> None:
        super().__init__()
        last = 128 if residual else 64
        self.conv_input = sparse_layer("krsc", point_channels, 16)
        widths = (16, 32, 64, last)
        for stage, width in enumerate(widths, start=1):
            layers: list[nn.Module] = []
            if stage > 1:
                layers.append(sparse_layer("krsc", widths[stage - 2], width, "z" if stage == 4 else "2"))
            if residual:
                layers += [ResidualBlock("krsc", width, bias) for _ in range(2)]
            else:
                layers += [sparse_layer("krsc", width, width) for _ in range(2 if stage > 1 else 1)]
            self.add_module(f"conv{stage}", SparseSequential(*layers))
        self.conv_out = sparse_layer("krsc", last, 128, "out")

    def forward(self, sites: Sites) -> Tensor:
        for name in ("conv_input", "conv1", "conv2", "conv3", "conv4", "conv_out"):
            sites = getattr(self, name)(sites)
        return flatten_height(sites)


class Mmdet3dSparseEncoder(nn.Module):
    """SparseEncoder with block_type "basicblock" (residual) or "conv_module"."""

    def __init__(self, point_channels: int, residual: bool) -> None:
        super().__init__()
        self.conv_input = sparse_layer("dhwio", point_channels, 16)
        self.encoder_layers = SparseSequential()
        channels: tuple[tuple[int, ...], ...]
        if residual:
            channels = ((16, 16, 32), (32, 32, 64), (64, 64, 128), (128, 128))
        else:
            channels = ((16,), (32, 32, 32), (64, 64, 64), (64, 64, 64))
        before = 16
        for stage, widths in enumerate(channels):
            layers: list[nn.Module] = []
            for place, width in enumerate(widths):
                if residual and (place < 2):
                    layers.append(ResidualBlock("dhwio", width, bias=False))
                elif residual:
                    layers.append(sparse_layer("dhwio", before, width, "z" if stage == 2 else "2"))
                else:
                    down = ("z" if stage == 3 else "2") if stage > 0 and place == 0 else ""
                    layers.append(sparse_layer("dhwio", before, width, down))
                before = width
            self.encoder_layers.add_module(f"encoder_layer{stage + 1}", SparseSequential(*layers))
        self.conv_out = sparse_layer("dhwio", before, 128, "out")

    def forward(self, sites: Sites) -> Tensor:
        return flatten_height(self.conv_out(self.encoder_layers(self.conv_input(sites))))


class BevResidualBlock(nn.Module):
    """Block of BaseBEVResBackbone (OpenPCDet, DSVT) and of ResSECOND (mmdetection3d)."""

    def __init__(self, before: int, after: int, stride: int, projects: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(after, eps=1e-3)
        self.conv2 = nn.Conv2d(after, after, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(after, eps=1e-3)
        if projects:
            self.downsample_layer = nn.Sequential(
                nn.Conv2d(before, after, 1, stride, bias=False), nn.BatchNorm2d(after, eps=1e-3)
            )

    def forward(self, x: Tensor) -> Tensor:
        kept = self.downsample_layer(x) if hasattr(self, "downsample_layer") else x
        return F.relu(self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x))))) + kept)


def bev_blocks(
    before: int, widths: list[int], strides: list[int], layers: list[int], residual: bool, padding_layer: bool
) -> nn.ModuleList:
    blocks = nn.ModuleList()
    for width, stride, count in zip(widths, strides, layers, strict=True):
        parts: list[nn.Module] = []
        if residual:
            parts = [BevResidualBlock(before, width, stride, projects=True)]
            parts += [BevResidualBlock(width, width, 1, projects=False) for _ in range(count)]
        else:
            parts = [nn.ZeroPad2d(1)] if padding_layer else []
            padding = 0 if padding_layer else 1
            parts += [
                nn.Conv2d(before, width, 3, stride, padding, bias=False),
                nn.BatchNorm2d(width, eps=1e-3),
                nn.ReLU(),
            ]
            for _ in range(count):
                parts += [nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width, eps=1e-3), nn.ReLU()]
        blocks.append(nn.Sequential(*parts))
        before = width
    return blocks


def bev_deblocks(widths: list[int], ups: list[float], outs: list[int], stride1_conv: bool) -> nn.ModuleList:
    deblocks = nn.ModuleList()
    for width, up, out in zip(widths, ups, outs, strict=True):
        resize: nn.Module
        if up > 1 or (up == 1 and not stride1_conv):
            resize = nn.ConvTranspose2d(width, out, int(up), int(up), bias=False)
        else:
            resize = nn.Conv2d(width, out, round(1 / up), round(1 / up), bias=False)
        deblocks.append(nn.Sequential(resize, nn.BatchNorm2d(out, eps=1e-3), nn.ReLU()))
    return deblocks


class OpenPCDetBevBackbone(nn.Module):
    """BaseBEVBackbone or BaseBEVResBackbone."""

    def __init__(
        self, before: int, widths: list[int], strides: list[int], layers: list[int], ups: list[float], outs: list[int],
        residual: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        self.blocks = bev_blocks(before, widths, strides, layers, residual, padding_layer=True)
        self.deblocks = bev_deblocks(widths, ups, outs, stride1_conv=False)

    def forward(self, x: Tensor) -> Tensor:
        outputs = []
        for block, deblock in zip(self.blocks, self.deblocks, strict=True):
            x = block(x)
            outputs.append(deblock(x))
        return torch.cat(outputs, dim=1)


class Mmdet3dBevBackbone(nn.Module):
    """SECOND or ResSECOND, and SECONDFPN, under a detector's names."""

    def __init__(
        self, prefix: str, before: int, widths: list[int], strides: list[int], layers: list[int], ups: list[float],
        outs: list[int], residual: bool = False, stride1_conv: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        backbone, neck = nn.Module(), nn.Module()
        backbone.blocks = bev_blocks(before, widths, strides, layers, residual, padding_layer=False)
        neck.deblocks = bev_deblocks(widths, ups, outs, stride1_conv)
        self.add_module(f"{prefix}backbone", backbone)
        self.add_module(f"{prefix}neck", neck)
        self._blocks, self._deblocks = [backbone.blocks], [neck.deblocks]

    def forward(self, x: Tensor) -> Tensor:
        outputs = []
        for block, deblock in zip(self._blocks[0], self._deblocks[0], strict=True):
            x = block(x)
            outputs.append(deblock(x))
        return torch.cat(outputs, dim=1)
