# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the ops on points: voxels, segments."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks import cases, peers
from benchmarks.case import BACKWARD, FORWARD, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.report import Target
from pred import ops
from pred.ops import reference


def _voxelize_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)
    offsets = torch.tensor([0, sizes.points])
    size = (sizes.voxel_m,) * 3
    voxels = reference.voxelize(points, offsets, size, cases.POINT_RANGE_M)
    return [
        Case(
            op="voxelize",
            name=f"voxelize {sizes.points} points, {sizes.voxel_m} m",
            unit="points",
            items=sizes.points,
            inputs=(points, offsets),
            ours=lambda points, offsets: ops.voxelize(points, offsets, size, cases.POINT_RANGE_M),
            reference=lambda points, offsets: reference.voxelize(points, offsets, size, cases.POINT_RANGE_M),
            eager={
                "unique": Variant(lambda points, offsets: _eager_voxelize(points, offsets, size, _unique)),
                "sort": Variant(lambda points, offsets: _eager_voxelize(points, offsets, size, _sorted_unique)),
            },
            compiled=("unique",),
            tolerance=0.0,
            phases=(
                Phase(
                    FORWARD,
                    "4 N D + 8 N + 40 M",
                    points.nbytes + 8 * sizes.points + 40 * len(voxels.counts),
                    (Target("eager", 5),),
                ),
            ),
        )
    ]


def _eager_voxelize(
    points: Tensor, offsets: Tensor, size: tuple[float, ...], unique: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
) -> tuple[Tensor, ...]:
    low, high = (points.new_tensor(bound) for bound in (cases.POINT_RANGE_M[:3], cases.POINT_RANGE_M[3:]))
    nx, ny, nz = (
        round((above - below) / edge)
        for below, above, edge in zip(cases.POINT_RANGE_M[:3], cases.POINT_RANGE_M[3:], size, strict=True)
    )
    xyz = points[:, :3]
    x, y, z = ((xyz - low) / points.new_tensor(size)).long().unbind(dim=1)
    frame = torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff(), output_size=len(points))
    key = ((frame * nz + z) * ny + y) * nx + x
    inside = ((xyz >= low) & (xyz < high)).all(dim=1)
    keys, voxel, counts = unique(key[inside])
    point_to_voxel = torch.full_like(key, -1)
    point_to_voxel[inside] = voxel
    coords = torch.stack([keys // (nx * ny * nz), keys // (nx * ny) % nz, keys // nx % ny, keys % nx], dim=1)
    return coords, point_to_voxel, counts


def _unique(key: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    keys, inverse, counts = torch.unique(key, return_inverse=True, return_counts=True)
    return keys, inverse, counts


def _sorted_unique(key: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    ordered, order = key.sort()
    keys, inverse, counts = torch.unique_consecutive(ordered, return_inverse=True, return_counts=True)
    return keys, torch.empty_like(inverse).scatter_(0, order, inverse), counts


def _segment_reduce_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)
    height_m = cases.POINT_RANGE_M[5] - cases.POINT_RANGE_M[2]
    pillars = reference.voxelize(
        points, torch.tensor([0, sizes.points]), (sizes.pillar_m, sizes.pillar_m, height_m), cases.POINT_RANGE_M
    )
    index, segments = pillars.point_to_voxel, len(pillars.counts)
    features = torch.randn(sizes.points, sizes.features, generator=torch.Generator().manual_seed(0))
    rows, out = features.nbytes, 4 * segments * sizes.features
    return [
        Case(
            op="segment_reduce",
            name=f"segment_reduce {reduce} {sizes.points}x{sizes.features} to {segments}",
            unit="points",
            items=sizes.points,
            inputs=(features, index),
            ours=lambda features, index, reduce=reduce: (ops.segment_reduce(features, index, segments, reduce),),
            reference=lambda features, index, reduce=reduce: (
                reference.segment_reduce(features, index, segments, reduce),
            ),
            eager={
                name: Variant(lambda *inputs, function=function, reduce=reduce: (function(*inputs, segments, reduce),))
                for name, function in _EAGER_SEGMENTS.items()
                if not (reduce == "max" and name == "index_add")
            },
            compiled=("scatter_reduce",),
            peers=peers.segment_reduce(segments, reduce),
            derivative_in=(0,),
            phases=(
                Phase(FORWARD, "4 NC + 8 N + 4 MC", rows + index.nbytes + out),
                Phase(BACKWARD, "8 NC + 16 N + 8 MC", 2 * (rows + index.nbytes + out)),
            ),
        )
        for reduce in ("mean", "max", "sum")
    ]


def _eager_index_add(features: Tensor, index: Tensor, segments: int, reduce: str) -> Tensor:
    total = features.new_zeros(segments, features.shape[1]).index_add(0, index, features)
    return total / torch.bincount(index, minlength=segments).clamp_min(1)[:, None] if reduce == "mean" else total


def _eager_scatter_reduce(features: Tensor, index: Tensor, segments: int, reduce: str) -> Tensor:
    empty = features.new_zeros(segments, features.shape[1])
    name = {"max": "amax"}.get(reduce, reduce)
    return empty.scatter_reduce(0, index[:, None].expand_as(features), features, name, include_self=False)


_EAGER_SEGMENTS = {"scatter_reduce": _eager_scatter_reduce, "index_add": _eager_index_add}


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "voxelize": _voxelize_cases,
    "segment_reduce": _segment_reduce_cases,
}
