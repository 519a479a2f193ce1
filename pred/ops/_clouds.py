# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ragged batches of point clouds: frame b owns the rows from ``offsets[b]`` up to ``offsets[b + 1]``."""

from __future__ import annotations

import torch
from torch import Tensor

from pred.ops._check import FLOATING, check_dtype, check_like, check_shape

STORAGE = (torch.float32, torch.float64, torch.bfloat16, torch.float16)


def check_offsets(
    op: str, name: str, offsets: Tensor, letter: str, num_rows: int, rows_name: str, rows: Tensor
) -> None:
    """Shape, dtype and device, and in eager calls on the CPU the values: ascending from 0 to ``num_rows``."""
    check_shape(op, name, offsets, ("B + 1",))
    check_dtype(op, name, offsets, (torch.int64,))
    if offsets.device != rows.device:
        raise ValueError(f"{op}: {name} must be on the device of {rows_name} ({rows.device}), got {offsets.device}")
    if offsets.shape[0] == 0:
        raise ValueError(f"{op}: {name} must have shape [B + 1] with B >= 0, got [0]")
    if torch.compiler.is_compiling() or offsets.device.type != "cpu":
        return
    values = offsets.tolist()
    if values[0] != 0 or values[-1] != num_rows or any(a > b for a, b in zip(values, values[1:], strict=False)):
        shown = str(values) if len(values) <= 16 else f"{values[:8]} ... {values[-1]}"
        raise ValueError(f"{op}: {name} must ascend from 0 to {letter}={num_rows}, got {shown}")


def positions(op: str, name: str, points: Tensor) -> Tensor:  # [N, 3], float32 or float64
    """x, y, z of points, without their gradient; half precision becomes float32."""
    if points.dim() != 2 or points.shape[1] < 3:
        raise ValueError(f"{op}: {name} must have shape [N, D] with D >= 3, got {list(points.shape)}")
    check_dtype(op, name, points, STORAGE)
    xyz = points.detach()[:, :3]
    return xyz.float() if xyz.dtype not in FLOATING else xyz


def check_queries(
    op: str, points: Tensor, batch_offsets: Tensor, queries: Tensor, query_offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions of the points and of the queries after all checks of the four arguments."""
    xyz, query_xyz = positions(op, "points", points), positions(op, "queries", queries)
    check_like(op, "queries", query_xyz, "points", xyz)
    check_offsets(op, "batch_offsets", batch_offsets, "N", points.shape[0], "points", points)
    check_offsets(op, "query_offsets", query_offsets, "M", queries.shape[0], "points", points)
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
