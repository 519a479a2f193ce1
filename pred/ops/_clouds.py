# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ragged batches of point clouds: frame b owns the rows from ``offsets[b]`` up to ``offsets[b + 1]``."""

from __future__ import annotations

from torch import Tensor

from pred.ops._check import FLOATING, HALF, as_geometry, check_dtype, check_like, check_offsets, check_tensors


def positions(op: str, name: str, points: Tensor) -> Tensor:  # [N, 3], float32 or float64
    """x, y, z of points, without their gradient; half precision becomes float32."""
    if points.dim() != 2 or points.shape[1] < 3:
        raise ValueError(f"{op}: {name} must have shape [N, C] with C >= 3, got {list(points.shape)}")
    check_dtype(op, name, points, FLOATING + HALF)
    return as_geometry(points.detach()[:, :3])


def check_queries(
    op: str, points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions of the points and of the queries after all checks of the four arguments."""
    check_tensors(op, points=points, batch_offsets=batch_offsets, queries=queries, query_offsets=query_offsets)
    xyz, query_xyz = positions(op, "points", points), positions(op, "queries", queries)
    check_like(op, "queries", query_xyz, "points", xyz)
    check_offsets(op, "batch_offsets", batch_offsets, "BN", "points", points)
    check_offsets(op, "query_offsets", query_offsets, "BM", "queries", queries)
    if query_offsets.shape != batch_offsets.shape:
        raise ValueError(
            f"{op}: query_offsets must have shape {list(batch_offsets.shape)} as batch_offsets, "
            f"got {list(query_offsets.shape)}"
        )
    return xyz, query_xyz


def frame_slices(offsets: Tensor) -> list[slice]:
    """The rows of each frame."""
    values = offsets.tolist()
    return [slice(begin, end) for begin, end in zip(values, values[1:], strict=False)]


def squared_distances(points: Tensor, query: Tensor) -> Tensor:
    """Sums of squared differences over the last dimension, x first; the other dimensions are broadcast."""
    dx, dy, dz = (points - query).unbind(-1)
    return dx * dx + dy * dy + dz * dz
