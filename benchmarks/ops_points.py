# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the ops on points: voxels, segments, samples, neighbours."""

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
                    "4 N C + 8 N + 40 M",
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
    frames = torch.arange(len(offsets) - 1, device=points.device)
    frame = torch.repeat_interleave(frames, offsets.diff(), output_size=len(points))
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


def _voxelize_hard_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)
    columns, size = points.shape[1], (sizes.voxel_m,) * 3
    limits = (sizes.voxel_points, sizes.max_voxels)
    inputs = (points, torch.tensor([0, sizes.points]))
    voxels = reference.voxelize_hard(*inputs, size, cases.POINT_RANGE_M, *limits).voxels
    slots = 8 * len(points)  # written for backward, and read there
    forward = points.nbytes + slots + voxels.nbytes + 40 * len(voxels)
    return [
        Case(
            op="voxelize_hard",
            name=f"voxelize_hard {sizes.points} points, {sizes.voxel_m} m, {sizes.voxel_points} per voxel",
            unit="points",
            items=sizes.points,
            inputs=inputs,
            ours=lambda points, offsets: ops.voxelize_hard(points, offsets, size, cases.POINT_RANGE_M, *limits),
            reference=lambda points, offsets: reference.voxelize_hard(
                points, offsets, size, cases.POINT_RANGE_M, *limits
            ),
            eager={"sort": Variant(lambda points, offsets: _eager_voxelize_hard(points, offsets, size, *limits))},
            compiled=("sort",),
            derivative_in=(0,),
            tolerance=0.0,
            phases=(
                Phase(FORWARD, "4 N C + 8 N + 4 M max_points C + 40 M", forward, (Target("peer", 2),)),
                Phase(
                    BACKWARD,
                    "8 N C + 16 N + 8 M max_points C + 40 M",
                    forward + voxels.nbytes + slots + points.nbytes,
                ),
            ),
            peers=peers.voxelize_hard(columns, size, cases.POINT_RANGE_M, *limits),
        )
    ]


def _eager_voxelize_hard(
    points: Tensor, offsets: Tensor, size: tuple[float, ...], max_points: int, max_voxels: int
) -> tuple[Tensor, ...]:
    coords, point_to_voxel, counts = _eager_voxelize(points.detach(), offsets, size, _sorted_unique)
    rows = (point_to_voxel >= 0).nonzero()[:, 0]
    voxel, order = point_to_voxel[rows].sort(stable=True)
    rows = rows[order]
    starts = counts.cumsum(0) - counts
    place = torch.arange(len(rows), device=rows.device) - starts[voxel]
    kept = rows[starts].argsort()[:max_voxels]  # the inputs are one frame
    number = torch.full_like(counts, -1)
    number[kept] = torch.arange(len(kept), device=kept.device)
    fits = (number[voxel] >= 0) & (place < max_points)
    slot = number[voxel[fits]] * max_points + place[fits]
    flat = points.new_zeros(len(kept) * max_points, points.shape[1]).index_copy(0, slot, points[rows[fits]])
    return flat.view(-1, max_points, points.shape[1]), coords[kept], counts[kept].clamp_max(max_points)


def _farthest_point_sample_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.search_points)[:, :3].contiguous()
    count = sizes.samples
    return [
        Case(
            op="farthest_point_sample",
            name=f"farthest_point_sample {count} of {sizes.search_points}",
            unit="points",
            items=sizes.search_points,
            inputs=(points, torch.tensor([0, sizes.search_points])),
            ours=lambda points, offsets: (ops.farthest_point_sample(points, offsets, count),),
            reference=lambda points, offsets: (reference.farthest_point_sample(points, offsets, count),),
            eager={"loop": Variant(lambda points, offsets: (_eager_farthest(points, count),))},
            compiled=(),
            tolerance=0.0,
            phases=(Phase(FORWARD, "12 N + 8 S", points.nbytes + 8 * count),),
        )
    ]


def _eager_farthest(points: Tensor, count: int) -> Tensor:  # [1, count]
    x, y, z = points.t().contiguous()
    distance = torch.full_like(x, torch.inf)
    chosen = torch.zeros(count, dtype=torch.int64, device=points.device)
    for i in range(1, count):
        last = chosen[i - 1]
        dx, dy, dz = x - x[last], y - y[last], z - z[last]
        torch.minimum(distance, dx.mul_(dx).add_(dy.mul_(dy)).add_(dz.mul_(dz)), out=distance)
        chosen[i] = distance.argmax()
    return chosen[None]


_CHUNK = 256  # queries whose distances to all points are held at once


def _search_inputs(sizes: Sizes) -> tuple[Tensor, ...]:
    """One frame, and queries as a set-abstraction layer has them: some of the points."""
    points = cases.lidar_points(sizes.search_points)[:, :3].contiguous()
    frame = torch.tensor([0, len(points)])
    queries = points[ops.farthest_point_sample(points, frame, sizes.samples)[0]]
    return points, frame, queries, torch.tensor([0, len(queries)])


def _knn_cases(sizes: Sizes) -> list[Case]:
    inputs, k = _search_inputs(sizes), sizes.neighbors
    return [
        Case(
            op="knn",
            name=f"knn {k} of {sizes.search_points} points, {sizes.samples} queries",
            unit="queries",
            items=sizes.samples,
            inputs=inputs,
            # Only distances are compared: of points equally far others may be chosen.
            ours=lambda points, frame, queries, query_frame: (
                ops.knn(points, frame, queries, query_frame, k).squared_distance,
            ),
            reference=lambda points, frame, queries, query_frame: (
                reference.knn(points, frame, queries, query_frame, k).squared_distance,
            ),
            eager={
                name: Variant(lambda points, _, queries, __, mode=mode: (_eager_knn(points, queries, k, mode),))
                for name, mode in _CDIST.items()
            },
            compiled=(),
            phases=(
                Phase(FORWARD, "12 N + 12 M + 12 M k", inputs[0].nbytes + inputs[2].nbytes + 12 * sizes.samples * k),
            ),
        )
    ]


_CDIST = {
    "cdist, topk": "donot_use_mm_for_euclid_dist",
    "cdist by products, topk": "use_mm_for_euclid_dist",
}


def _eager_knn(points: Tensor, queries: Tensor, k: int, mode: str) -> Tensor:  # [M, k]
    index = torch.cat(
        [
            torch.cdist(chunk, points, compute_mode=mode).topk(k, largest=False).indices
            for chunk in queries.split(_CHUNK)
        ]
    )
    return (points[index] - queries[:, None]).square().sum(dim=-1)


def _ball_query_cases(sizes: Sizes) -> list[Case]:
    inputs, count, radius_m = _search_inputs(sizes), sizes.neighbors, 0.8
    return [
        Case(
            op="ball_query",
            name=f"ball_query {count} in {radius_m} m of {sizes.search_points} points, {sizes.samples} queries",
            unit="queries",
            items=sizes.samples,
            inputs=inputs,
            ours=lambda points, frame, queries, query_frame: ops.ball_query(
                points, frame, queries, query_frame, radius_m, count
            ),
            reference=lambda points, frame, queries, query_frame: reference.ball_query(
                points, frame, queries, query_frame, radius_m, count
            ),
            eager={
                "cdist, topk": Variant(lambda points, _, queries, __: _eager_ball(points, queries, radius_m, count))
            },
            compiled=(),
            tolerance=0.0,
            outliers=2e-3,  # roots are rounded: a point on the sphere may change sides and move its list
            phases=(
                Phase(
                    FORWARD,
                    "12 N + 20 M + 8 M k",
                    inputs[0].nbytes + inputs[2].nbytes + 8 * sizes.samples * (1 + count),
                ),
            ),
        )
    ]


def _eager_ball(points: Tensor, queries: Tensor, radius_m: float, count: int) -> tuple[Tensor, Tensor]:
    none = len(points)
    row = torch.arange(none, device=points.device)
    lists = []
    for chunk in queries.split(_CHUNK):
        inside = torch.cdist(chunk, points, compute_mode="donot_use_mm_for_euclid_dist") < radius_m
        lists.append(torch.where(inside, row, none).topk(count, largest=False).values)
    index = torch.cat(lists)
    return index.masked_fill(index == none, -1), (index < none).sum(dim=1)


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
    "voxelize_hard": _voxelize_hard_cases,
    "segment_reduce": _segment_reduce_cases,
    "farthest_point_sample": _farthest_point_sample_cases,
    "knn": _knn_cases,
    "ball_query": _ball_query_cases,
}
