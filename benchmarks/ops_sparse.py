# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of sparse 3D convolution: the ops on layers of a detector's backbone, and a whole VoxelResBackBone8x.

Useful arithmetic: ``2 C O`` operations for each of the P pairs of sites that a tap joins, forward; twice that backward,
which gives the gradient in the voxels' features too. Dense convolution of these grids would need gigabytes: the plain
form is one gather, product and `index_add` per tap. For rulebooks and the backbone it is the reference, plain PyTorch.
"""

from __future__ import annotations

import os
import unittest.mock
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import pred.nn
from benchmarks import cases, peers
from benchmarks.case import BACKWARD, FORWARD, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.report import Target
from pred import ops
from pred.nn import SparseTensor
from pred.ops import reference
from pred.ops.build_rulebook import Rulebook

VOXEL_M = (0.1, 0.1, 0.2)  # x, y, z
SHAPE = (41, 1024, 1024)  # one cell more than the range along z, as in OpenPCDet
SUBMANIFOLD: dict[str, Any] = {"kernel_size": 3, "padding": 1, "submanifold": True}
STRIDED: dict[str, Any] = {"kernel_size": 3, "stride": 2, "padding": 1}


def _sites(sizes: Sizes) -> Tensor:  # [M, 4]
    """Voxels of a LiDAR frame, thinned out at random to as many as asked for."""
    points = cases.lidar_points(sizes.points)
    found = reference.voxelize(points, torch.tensor([0, len(points)]), VOXEL_M, cases.POINT_RANGE_M).coords
    kept = torch.randperm(len(found), generator=torch.Generator().manual_seed(0))[: sizes.sparse_sites]
    return found[kept.sort().values]


def _build_rulebook_cases(sizes: Sizes) -> list[Case]:
    sites = _sites(sizes)
    found = []
    for kind, kernel in (("submanifold", SUBMANIFOLD), ("stride 2", STRIDED)):
        outputs = len(reference.build_rulebook(sites, 1, SHAPE, **kernel).out_indices)
        traffic = sites.nbytes + 32 * outputs + 4 * 27 * (len(sites) + outputs)
        found.append(
            Case(
                op="build_rulebook",
                name=f"build_rulebook {len(sites)} to {outputs} sites, 3x3x3 {kind}",
                unit="sites",
                items=len(sites),
                inputs=(sites,),
                ours=lambda sites, kernel=kernel: tuple(ops.build_rulebook(sites, 1, SHAPE, **kernel)),
                reference=lambda sites, kernel=kernel: tuple(reference.build_rulebook(sites, 1, SHAPE, **kernel)),
                eager={
                    "sort": Variant(
                        lambda sites, kernel=kernel: tuple(reference.build_rulebook(sites, 1, SHAPE, **kernel))
                    )
                },
                compiled=(),
                tolerance=0.0,
                phases=(Phase(FORWARD, "32 M + 32 M' + 4 K (M + M')", traffic),),
            )
        )
    return found


def _sparse_conv_cases(sizes: Sizes) -> list[Case]:
    sites = _sites(sizes)
    width = sizes.sparse_channels
    submanifold = ops.build_rulebook(sites, 1, SHAPE, **SUBMANIFOLD)
    strided = ops.build_rulebook(sites, 1, SHAPE, **STRIDED)
    layers = [
        ("submanifold", submanifold, width, width, torch.float32),
        ("submanifold", submanifold, 4 * width, 4 * width, torch.float32),
        ("stride 2", strided, width, 2 * width, torch.float32),
        ("submanifold, bf16", submanifold, 4 * width, 4 * width, torch.bfloat16),
    ]
    return [_layer(*layer) for layer in layers] + [_backbone(sites, width)]


def _layer(kind: str, rulebook: Rulebook, channels: int, outputs: int, dtype: torch.dtype) -> Case:
    _, out_to_in, in_to_out = rulebook
    sites = len(in_to_out)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(sites, channels, generator=generator).to(dtype)
    weight = (torch.randn(outputs, 27, channels, generator=generator) / (27 * channels) ** 0.5).to(dtype)
    half = dtype == torch.bfloat16
    flop = 2 * int((out_to_in >= 0).sum()) * channels * outputs
    name = "bfloat16" if half else "float32"
    return Case(
        op="sparse_conv",
        name=f"sparse_conv {sites} sites, {channels} to {outputs}, 3x3x3 {kind}",
        unit="sites",
        items=sites,
        inputs=(features, weight, out_to_in, in_to_out),
        ours=lambda *inputs: (ops.sparse_conv(*inputs),),
        reference=lambda *inputs: (reference.sparse_conv(*inputs),),
        eager={"index_add": Variant(_per_tap, (features, weight, out_to_in, *_pairs(out_to_in)))},
        compiled=(),
        derivative_in=(0, 1),
        tolerance=5e-2 if half else 1e-4,  # eager adds up in bfloat16
        phases=(
            Phase(FORWARD, "", 0, work="2 P C O", flop=flop, flop_dtype=name),
            Phase(BACKWARD, "", 0, work="6 P C O", flop=3 * flop, flop_dtype=name),
        ),
    )


def _pairs(out_to_in: Tensor) -> list[Tensor]:
    """Each tap's outputs, then each tap's inputs, listed outside the time, as frameworks keep them."""
    rows = [(column >= 0).nonzero()[:, 0] for column in out_to_in.unbind(1)]
    return rows + [out_to_in[row, tap].long() for tap, row in enumerate(rows)]


def _per_tap(features: Tensor, weight: Tensor, out_to_in: Tensor, *pairs: Tensor) -> tuple[Tensor, ...]:
    taps = len(pairs) // 2
    out = features.new_zeros(len(out_to_in), len(weight))
    for tap, (rows, sources) in enumerate(zip(pairs[:taps], pairs[taps:], strict=True)):
        out = out.index_add(0, rows, features[sources] @ weight[:, tap].T)
    return (out,)


class _ResidualBlock(nn.Module):
    """Two submanifold convolutions and the way around them."""

    def __init__(self, sparse: Any, channels: int, key: str) -> None:
        super().__init__()
        self.conv1 = sparse.SubMConv3d(channels, channels, 3, padding=1, bias=False, indice_key=key)
        self.bn1 = _norm(channels)
        self.conv2 = sparse.SubMConv3d(channels, channels, 3, padding=1, bias=False, indice_key=key)
        self.bn2 = _norm(channels)

    def forward(self, x: Any) -> Any:
        out = self.conv1(x)
        out = self.conv2(out.replace_feature(F.silu(self.bn1(out.features))))
        return out.replace_feature(F.silu(self.bn2(out.features) + x.features))


class _Backbone(nn.Module):
    """VoxelResBackBone8x of OpenPCDet, of `pred.nn` or of spconv; without biases, whose gradients before a batch
    normalisation are rounding errors and cannot be compared, and with SiLU for ReLU: where contenders add up in other
    orders, some units would lie on the other side of its kink, and gradients differ by percents.
    """

    def __init__(self, sparse: Any, channels: int, width: int) -> None:
        super().__init__()

        def layer(inputs: int, outputs: int, size: Any, stride: Any, padding: Any, key: str) -> nn.Module:
            conv = (
                sparse.SubMConv3d(inputs, outputs, size, padding=padding, bias=False, indice_key=key)
                if stride == 1
                else sparse.SparseConv3d(inputs, outputs, size, stride, padding, bias=False, indice_key=key)
            )
            made: nn.Module = sparse.SparseSequential(conv, _norm(outputs), nn.SiLU())
            return made

        stages: list[nn.Module] = [layer(channels, width, 3, 1, 1, "subm1")]
        inputs = width
        for number, (outputs, padding) in enumerate(
            ((width, 0), (2 * width, 1), (4 * width, 1), (8 * width, (0, 1, 1))), start=1
        ):
            if number > 1:
                stages.append(layer(inputs, outputs, 3, 2, padding, f"spconv{number}"))
            stages += [_ResidualBlock(sparse, outputs, f"res{number}") for _ in range(2)]
            inputs = outputs
        stages.append(layer(inputs, inputs, (3, 1, 1), (2, 1, 1), 0, "spconv_down2"))
        self.stages = nn.ModuleList(stages)

    def forward(self, x: Any) -> Any:
        for stage in self.stages:
            x = stage(x)
        return x


def _norm(channels: int) -> nn.BatchNorm1d:
    return nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)


def _useful_flop(net: nn.Module, x: SparseTensor) -> int:
    """Of the forward pass, by the pairs of each layer's rulebook."""
    flop = 0

    def count(module: Any, arguments: tuple[SparseTensor], _: Any) -> None:
        nonlocal flop
        pairs = int((module.rulebook(arguments[0]).rulebook.out_to_in >= 0).sum())
        flop += 2 * pairs * module.in_channels * module.out_channels

    hooks = [
        module.register_forward_hook(count)
        for module in net.modules()
        if isinstance(module, pred.nn.SubMConv3d | pred.nn.SparseConv3d)
    ]
    with torch.no_grad():
        net(x)
    for hook in hooks:
        hook.remove()
    return flop


def _backbone(sites: Tensor, width: int) -> Case:
    channels = 5
    torch.manual_seed(0)
    net = _Backbone(pred.nn, channels, width)
    names = [name for name, _ in net.named_parameters()]
    features = torch.randn(len(sites), channels, generator=torch.Generator().manual_seed(2))
    flop = _useful_flop(net, SparseTensor(features, sites, SHAPE, 1))

    def ours(features: Tensor, sites: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
        x = SparseTensor(features, sites, SHAPE, 1)
        out = torch.func.functional_call(net, dict(zip(names, parameters, strict=True)), (x,))
        return (out.features,)

    def plain(*inputs: Tensor) -> tuple[Tensor, ...]:
        with unittest.mock.patch.dict(os.environ, PRED_BACKEND="reference"):
            return ours(*inputs)

    return Case(
        op="sparse_conv",
        name=f"VoxelResBackBone8x {len(sites)} sites, rulebooks included",
        unit="sites",
        items=len(sites),
        inputs=(features, sites, *(parameter.detach() for parameter in net.parameters())),
        modules=(net,),
        ours=ours,
        reference=plain,
        eager={"product per tap": Variant(plain)},
        compiled=(),
        derivative_in=(0, *range(2, 2 + len(names))),
        tolerance=1e-3,  # of 21 layers
        phases=(
            Phase(FORWARD, "", 0, work="2 P C O of all layers", flop=flop),
            Phase(BACKWARD, "", 0, (Target("peer", 4),), work="6 P C O of all layers", flop=3 * flop),
        ),
        peers=peers.sparse_backbone(lambda sparse: _Backbone(sparse, channels, width), names, SHAPE),
    )


def _sparse_max_pool_cases(sizes: Sizes) -> list[Case]:
    sites = _sites(sizes)
    _, out_to_in, in_to_out = ops.build_rulebook(sites, 1, SHAPE, **STRIDED)
    features = torch.randn(len(sites), sizes.sparse_channels, generator=torch.Generator().manual_seed(1))
    rows, taps = (out_to_in >= 0).nonzero().unbind(1)
    sources = out_to_in[rows, taps].long()
    read, out = features.nbytes, 4 * len(out_to_in) * sizes.sparse_channels
    return [
        Case(
            op="sparse_max_pool",
            name=f"sparse_max_pool {len(sites)} to {len(out_to_in)} sites, {sizes.sparse_channels}, 3x3x3 stride 2",
            unit="sites",
            items=len(sites),
            inputs=(features, out_to_in, in_to_out),
            ours=lambda *inputs: (ops.sparse_max_pool(*inputs),),
            reference=lambda *inputs: (reference.sparse_max_pool(*inputs),),
            eager={"scatter_reduce": Variant(_pool_by_scatter, (features, out_to_in, rows, sources))},
            compiled=(),
            derivative_in=(0,),
            phases=(
                Phase(FORWARD, "4 M C + 4 K M' + 4 M' C", read + out_to_in.nbytes + out),
                Phase(
                    BACKWARD,
                    "8 M C + 8 K M' + 4 K M + 8 M' C",
                    2 * (read + out_to_in.nbytes + out) + in_to_out.nbytes,
                ),
            ),
        )
    ]


def _pool_by_scatter(features: Tensor, out_to_in: Tensor, rows: Tensor, sources: Tensor) -> tuple[Tensor, ...]:
    empty = features.new_zeros(len(out_to_in), features.shape[1])
    index = rows[:, None].expand(-1, features.shape[1])
    return (empty.scatter_reduce(0, index, features[sources], "amax", include_self=False),)


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "build_rulebook": _build_rulebook_cases,
    "sparse_conv": _sparse_conv_cases,
    "sparse_max_pool": _sparse_max_pool_cases,
}
