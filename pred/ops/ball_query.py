# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The points within a radius of each query."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count, check_number
from pred.ops._clouds import check_queries, frame_slices, squared_distances

_CHUNK = 2**22


class Ball(NamedTuple):
    """Points around each query, in ascending order of their index."""

    indices: Tensor  # [M, max_points] int64, rows of the points, -1 where there are fewer
    counts: Tensor  # [M] int64, how many are listed


def ball_query(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    queries: Tensor,  # [M, C]
    query_offsets: Tensor,  # [B + 1]
    radius: float,
    max_points: int,
) -> Ball:
    """Lists the points p of a query's frame with ``|p - q|^2 < radius^2``: the first ``max_points`` by index.

    The squared distance is a sum of three squared differences, and ``radius^2`` the square of the rounded radius, both
    in the dtype of the points (float32 for half precision). The search is exact.

    pointnet2 and OpenPCDet choose the same points, but fill a list with repetitions of its first index, and an empty
    one with 0. For one frame theirs is
    ``torch.where(indices < 0, indices[:, :1], indices).clamp_min(0)``.

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Frame b
            owns the rows from ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        queries: ``[M, C]``, C >= 3, columns as those of the points, same dtype.
        query_offsets: ``[B + 1]`` int64, ascending from 0 to M.
        radius: in the unit of the points, positive.
        max_points: length of each list.

    Returns:
        ``indices [M, max_points]``, rows of ``points``, -1 behind the last, and ``counts [M]``, the number of points
        listed (at most ``max_points``), both int64. A point with a NaN or infinite coordinate is in no list, and the
        list of such a query is empty.

    Raises:
        ValueError: shape, device, offsets (values are checked for CPU tensors), ``radius`` not positive, negative
            ``max_points``, 2^31 or more points or queries (compiled). TypeError: dtype.

    Not differentiable: the outputs are integers. Equal bits for any thread count and instruction set.
    """
    _native.refuse_transforms("ball_query")
    xyz, query_xyz = _arguments(points, batch_offsets, queries, query_offsets, radius, max_points)
    if _native.use_native("ball_query", points):
        return Ball(*torch.ops.pred.ball_query(xyz, batch_offsets, query_xyz, query_offsets, float(radius), max_points))
    return _search(xyz, batch_offsets, query_xyz, query_offsets, radius, max_points)


def ball_query_reference(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    queries: Tensor,  # [M, C]
    query_offsets: Tensor,  # [B + 1]
    radius: float,
    max_points: int,
) -> Ball:
    """Plain PyTorch form of :func:`ball_query`: all distances, some queries at a time."""
    xyz, query_xyz = _arguments(points, batch_offsets, queries, query_offsets, radius, max_points)
    return _search(xyz, batch_offsets, query_xyz, query_offsets, radius, max_points)


def _arguments(
    points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor, radius: float, max_points: int
) -> tuple[Tensor, Tensor]:
    found = check_queries("ball_query", points, batch_offsets, queries, query_offsets)
    check_number("ball_query", "radius", radius)
    if not radius > 0:
        raise ValueError(f"ball_query: radius must be positive, got {radius}")
    check_count("ball_query", "max_points", max_points)
    return found


def _search(
    xyz: Tensor, batch_offsets: Tensor, query_xyz: Tensor, query_offsets: Tensor, radius: float, max_points: int
) -> Ball:
    num_queries = query_xyz.shape[0]
    index = batch_offsets.new_full((num_queries, max_points), -1)
    counts = batch_offsets.new_zeros(num_queries)
    squared_radius = xyz.new_tensor(radius).square()
    for rows, query_rows in zip(frame_slices(batch_offsets), frame_slices(query_offsets), strict=True):
        points, count = xyz[rows], min(max_points, rows.stop - rows.start)
        step = max(1, _CHUNK // max(1, points.shape[0]))
        for begin in range(query_rows.start, query_rows.stop, step):
            end = min(begin + step, query_rows.stop)
            inside = squared_distances(points, query_xyz[begin:end, None]) < squared_radius
            found = inside.sum(dim=1).clamp_max(max_points)
            # Sorting puts the points inside first and keeps their order.
            order = inside.logical_not().byte().sort(dim=1, stable=True).indices[:, :count] + rows.start
            listed = torch.arange(count, device=xyz.device) < found[:, None]
            index[begin:end, :count] = torch.where(listed, order, -1)
            counts[begin:end] = found
    return Ball(index, counts)


def _fake(
    points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor, radius: float, max_points: int
) -> tuple[Tensor, Tensor]:
    num_queries = queries.shape[0]
    return batch_offsets.new_empty(num_queries, max_points), batch_offsets.new_empty(num_queries)


_native.register("ball_query", fake=_fake, differentiable=False)
