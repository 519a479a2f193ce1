# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The k nearest points of each query."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count
from pred.ops._clouds import check_queries, frame_slices, squared_distances

_CHUNK = 2**22


class Neighbors(NamedTuple):
    """Nearest points of each query, nearest first."""

    indices: Tensor  # [M, k] int64, rows of the points, -1 where there are fewer
    squared_distance: Tensor  # [M, k], inf where there are fewer


def knn(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    queries: Tensor,  # [M, C]
    query_offsets: Tensor,  # [B + 1]
    k: int,
) -> Neighbors:
    """Finds the k points of a query's frame that are nearest to it, in ascending order of (distance, index).

    ``squared_distance = (x - x_q)^2 + (y - y_q)^2 + (z - z_q)^2``, a sum of squared differences in the dtype of the
    points (float32 for half precision). The search is exact.

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Frame b
            owns the rows from ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        queries: ``[M, C]``, C >= 3, columns as those of the points, same dtype; may be the points themselves, each of
            which then is its own first neighbour unless an equal point comes before it.
        query_offsets: ``[B + 1]`` int64, ascending from 0 to M.
        k: neighbours per query.

    Returns:
        ``indices [M, k]`` int64, rows of ``points``, and ``squared_distance [M, k]`` in the dtype of the computation;
        -1 and inf where the frame has fewer points. A point whose squared distance is not finite is no neighbour: one
        with a NaN or infinite coordinate, any point of a query with one, and two points so far apart that it overflows.

    Raises:
        ValueError: shape, device, offsets (values are checked for CPU tensors), negative ``k``, 2^31 or more points or
            queries (compiled). TypeError: dtype.

    Not differentiable, the distances neither: compute them again from the indices. Equal bits for any thread count and
    instruction set.
    """
    _native.refuse_transforms("knn")
    xyz, query_xyz = _arguments(points, batch_offsets, queries, query_offsets, k)
    if _native.use_native("knn", points):
        return Neighbors(*torch.ops.pred.knn(xyz, batch_offsets, query_xyz, query_offsets, k))
    return _search(xyz, batch_offsets, query_xyz, query_offsets, k)


def knn_reference(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    queries: Tensor,  # [M, C]
    query_offsets: Tensor,  # [B + 1]
    k: int,
) -> Neighbors:
    """Plain PyTorch form of :func:`knn`: all distances, sorted, some queries at a time."""
    xyz, query_xyz = _arguments(points, batch_offsets, queries, query_offsets, k)
    return _search(xyz, batch_offsets, query_xyz, query_offsets, k)


def _arguments(
    points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor, k: int
) -> tuple[Tensor, Tensor]:
    found = check_queries("knn", points, batch_offsets, queries, query_offsets)
    check_count("knn", "k", k)
    return found


def _search(xyz: Tensor, batch_offsets: Tensor, query_xyz: Tensor, query_offsets: Tensor, k: int) -> Neighbors:
    index = batch_offsets.new_full((query_xyz.shape[0], k), -1)
    squared_distance = xyz.new_full(index.shape, torch.inf)
    for rows, query_rows in zip(frame_slices(batch_offsets), frame_slices(query_offsets), strict=True):
        points, count = xyz[rows], min(k, rows.stop - rows.start)
        step = max(1, _CHUNK // max(1, points.shape[0]))
        for begin in range(query_rows.start, query_rows.stop, step):
            end = min(begin + step, query_rows.stop)
            distance = squared_distances(points, query_xyz[begin:end, None])
            distance = torch.where(distance.isfinite(), distance, torch.inf)
            nearest, order = (part[:, :count] for part in distance.sort(dim=1, stable=True))
            squared_distance[begin:end, :count] = nearest
            index[begin:end, :count] = torch.where(nearest.isfinite(), order + rows.start, -1)
    return Neighbors(index, squared_distance)


def _fake(
    points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor, k: int
) -> tuple[Tensor, Tensor]:
    num_queries = queries.shape[0]
    return batch_offsets.new_empty(num_queries, k), points.new_empty(num_queries, k)


_native.register("knn", fake=_fake, differentiable=False)
