# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Dynamic voxelization: every point keeps its voxel, voxels hold any number of points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import FLOATING, HALF, check_dtype, check_floats, check_offsets, check_tensors

_MAX_KEYS = 2**62
_MAX_CELLS = 2**30


class Voxels(NamedTuple):
    """Occupied voxels of a batch, in ascending (b, z, y, x) order, and the voxel of each point."""

    coords: Tensor  # [M, 4] int64, (b, z, y, x)
    point_to_voxel: Tensor  # [N] int64, row of `coords`, -1 for points outside
    counts: Tensor  # [M] int64, points per voxel


def voxelize(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],  # (x, y, z)
    point_range: Sequence[float],  # (x_min, y_min, z_min, x_max, y_max, z_max)
) -> Voxels:
    """Finds the occupied voxels of a ragged batch of point clouds.

    ``index = floor((p - min) / size)`` per axis, computed in the dtype of ``points``, or float32 for half-precision
    points (bounds and sizes are rounded to that dtype first). A point is inside when ``min <= p < max`` on all three
    axes; one just below ``max`` whose quotient rounds up to the grid size belongs to the last voxel. NaN and infinite
    coordinates are outside.

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Frame b
            owns the rows from ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        voxel_size: edge lengths (x, y, z), in the unit of the points.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), same unit and frame as the points; each edge a whole
            multiple of the voxel size (within 1e-3 of a voxel).

    Returns:
        ``coords [M, 4]`` (b, z, y, x) ascending, ``point_to_voxel [N]`` (-1 outside) and ``counts [M]``, all int64.
        M may be 0.

    Raises:
        ValueError: shape, device, sizes or range, offsets (values are checked for CPU tensors), 2^31 or more points
            (compiled), or B nz ny nx (each edge rounded up to a power of two) above 2^62. TypeError: dtype.

    Not differentiable: the outputs are integers. Equal bits for any thread count and instruction set.
    """
    _native.refuse_transforms("voxelize")
    size, bounds, grid = check_voxelize_arguments("voxelize", points, batch_offsets, voxel_size, point_range)
    if _native.use_native("voxelize", points):
        return Voxels(*torch.ops.pred.voxelize(points, batch_offsets, size, bounds, grid))
    return number_voxels(points, batch_offsets, size, bounds, grid)


def voxelize_reference(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],
    point_range: Sequence[float],
) -> Voxels:
    """Plain PyTorch form of :func:`voxelize`: ``torch.unique`` of linear voxel numbers."""
    checked = check_voxelize_arguments("voxelize", points, batch_offsets, voxel_size, point_range)
    return number_voxels(points, batch_offsets, *checked)


def number_voxels(
    points: Tensor, batch_offsets: Tensor, size: list[float], bounds: list[float], grid: list[int]
) -> Voxels:
    """The reference after all checks."""
    nx, ny, nz = grid
    xyz = points.detach()[:, :3]
    xyz = xyz if xyz.dtype == torch.float64 else xyz.float()
    low, high = xyz.new_tensor(bounds[:3]), xyz.new_tensor(bounds[3:])
    inside = ((xyz >= low) & (xyz < high)).all(dim=1)
    quotient = (xyz - low) / xyz.new_tensor(size)
    cells = torch.tensor([nx, ny, nz], device=points.device)
    below = quotient < cells.to(xyz.dtype)
    cell = torch.where(inside[:, None] & below, quotient, torch.zeros_like(quotient)).long()
    cell = torch.where(below, cell, cells - 1)
    row = torch.arange(points.shape[0], device=points.device)
    frame = torch.searchsorted(batch_offsets[1:].contiguous(), row, right=True)
    key = ((frame * nz + cell[:, 2]) * ny + cell[:, 1]) * nx + cell[:, 0]
    keys, voxel, counts = torch.unique(key[inside], return_inverse=True, return_counts=True)
    point_to_voxel = torch.full_like(row, -1)
    point_to_voxel[inside] = voxel
    coords = torch.stack([keys // (nx * ny * nz), keys // (nx * ny) % nz, keys // nx % ny, keys % nx], dim=1)
    return Voxels(coords, point_to_voxel, counts)


def check_voxelize_arguments(
    op: str,
    points: Tensor,
    batch_offsets: Tensor,
    voxel_size: Sequence[float],
    point_range: Sequence[float],
) -> tuple[list[float], list[float], list[int]]:
    """Voxel size, range and grid size (x, y, z) after all checks."""
    check_tensors(op, points=points, batch_offsets=batch_offsets)
    if points.dim() != 2 or points.shape[1] < 3:
        raise ValueError(f"{op}: points must have shape [N, C] with C >= 3, got {list(points.shape)}")
    check_dtype(op, "points", points, FLOATING + HALF)
    check_offsets(op, "batch_offsets", batch_offsets, "BN", "points", points)
    size, bounds = check_floats(op, "voxel_size", voxel_size, 3), check_floats(op, "point_range", point_range, 6)
    grid = _grid_size(op, size, bounds)
    frame_keys = math.prod([1 << (cells - 1).bit_length() for cells in grid])
    if batch_offsets.shape[0] - 1 > _MAX_KEYS // frame_keys:
        raise ValueError(
            f"{op}: point_range / voxel_size must give B nz ny nx <= 2^62 (edges rounded up to powers of two), "
            f"got a grid of {grid[0]} x {grid[1]} x {grid[2]} for {batch_offsets.shape[0] - 1} frames"
        )
    return size, bounds, grid


def _grid_size(op: str, voxel_size: Sequence[float], point_range: Sequence[float]) -> list[int]:
    """Voxels along x, y, z."""
    grid = []
    for axis, name in enumerate("xyz"):
        size, low, high = voxel_size[axis], point_range[axis], point_range[axis + 3]
        if not size > 0:
            raise ValueError(f"{op}: voxel_size must be positive, got {size} along {name}")
        if not low < high:
            raise ValueError(f"{op}: point_range must have min < max, got {low} and {high} along {name}")
        cells = (high - low) / size
        if cells > _MAX_CELLS:
            raise ValueError(f"{op}: voxel_size must give at most 2^30 voxels per axis, got {cells:.6g} along {name}")
        if round(cells) == 0 or abs(cells - round(cells)) > 1e-3:
            raise ValueError(
                f"{op}: point_range must be a whole multiple of voxel_size, got {cells:.6g} voxels "
                f"({low} to {high} in steps of {size}) along {name}"
            )
        grid.append(round(cells))
    return grid


def _fake(
    points: Tensor, batch_offsets: Tensor, voxel_size: list[float], point_range: list[float], grid: list[int]
) -> tuple[Tensor, Tensor, Tensor]:
    num_voxels = torch.library.get_ctx().new_dynamic_size()
    return (
        batch_offsets.new_empty(num_voxels, 4),
        batch_offsets.new_empty(points.shape[0]),
        batch_offsets.new_empty(num_voxels),
    )


_native.register("voxelize", fake=_fake, differentiable=False)
