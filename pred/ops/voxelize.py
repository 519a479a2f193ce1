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
from pred.ops._check import FLOATING, check_dtype, check_shape, check_tensors

_MAX_KEYS = 2**62
_MAX_CELLS = 2**30


class Voxels(NamedTuple):
    """Occupied voxels of a batch, in ascending (b, z, y, x) order, and the voxel of each point."""

    coords: Tensor  # [M, 4] int64, (b, z, y, x)
    point_to_voxel: Tensor  # [N] int64, row of `coords`, -1 for points outside
    counts: Tensor  # [M] int64, points per voxel


def voxelize(
    points: Tensor,  # [N, D]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],  # (x, y, z)
    point_range: Sequence[float],  # (x_min, y_min, z_min, x_max, y_max, z_max)
) -> Voxels:
    """Finds the occupied voxels of a ragged batch of point clouds.

    ``index = floor((p - min) / size)`` per axis, computed in the dtype of ``points`` (bounds and sizes are rounded to
    it first). A point is inside when ``min <= p < max`` on all three axes; one just below ``max`` whose quotient
    rounds up to the grid size belongs to the last voxel. NaN and infinite coordinates are outside.

    Args:
        points: ``[N, D]`` float32 or float64, D >= 3; the first three columns are x, y, z. Frame b owns the rows from
            ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        voxel_size: edge lengths (x, y, z), in the unit of the points.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), same unit and frame as the points; each edge a whole
            multiple of the voxel size (within 1e-3 of a voxel).

    Returns:
        ``coords [M, 4]`` (b, z, y, x) ascending, ``point_to_voxel [N]`` (-1 outside) and ``counts [M]``, all int64.
        M may be 0.

    Raises:
        ValueError: shape, device, sizes or range, offsets (values are checked for CPU tensors), or B nz ny nx (each
            edge rounded up to a power of two) above 2^62. TypeError: dtype.

    Not differentiable: the outputs are integers. Equal bits for any thread count and instruction set.
    """
    check_tensors("voxelize", points=points, batch_offsets=batch_offsets)
    if points.dim() != 2 or points.shape[1] < 3:
        raise ValueError(f"voxelize: points must have shape [N, D] with D >= 3, got {list(points.shape)}")
    check_dtype("voxelize", "points", points, FLOATING)
    check_shape("voxelize", "batch_offsets", batch_offsets, ("B + 1",))
    check_dtype("voxelize", "batch_offsets", batch_offsets, (torch.int64,))
    if batch_offsets.device != points.device:
        raise ValueError(
            f"voxelize: batch_offsets must be on the device of points ({points.device}), got {batch_offsets.device}"
        )
    if batch_offsets.shape[0] == 0:
        raise ValueError("voxelize: batch_offsets must have shape [B + 1] with B >= 0, got [0]")
    size, bounds = _floats("voxel_size", voxel_size, 3), _floats("point_range", point_range, 6)
    grid = _grid_size(size, bounds)
    frame_keys = math.prod([1 << (cells - 1).bit_length() for cells in grid])
    if batch_offsets.shape[0] - 1 > _MAX_KEYS // frame_keys:
        raise ValueError(
            f"voxelize: point_range / voxel_size must give B nz ny nx <= 2^62 (edges rounded up to powers of two), "
            f"got a grid of {grid[0]} x {grid[1]} x {grid[2]} for {batch_offsets.shape[0] - 1} frames"
        )
    if not torch.compiler.is_compiling() and batch_offsets.device.type == "cpu":
        _check_offsets(batch_offsets, points.shape[0])
    if _native.use_native("voxelize", points):
        return Voxels(*torch.ops.pred.voxelize(points, batch_offsets, size, bounds, grid))
    return voxelize_reference(points, batch_offsets, size, bounds)


def voxelize_reference(
    points: Tensor,  # [N, D]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],
    point_range: Sequence[float],
) -> Voxels:
    """Plain PyTorch form of :func:`voxelize`: ``torch.unique`` of linear voxel numbers."""
    nx, ny, nz = _grid_size(voxel_size, point_range)
    xyz = points.detach()[:, :3]
    low, high = points.new_tensor(point_range[:3]), points.new_tensor(point_range[3:])
    inside = ((xyz >= low) & (xyz < high)).all(dim=1)
    quotient = (xyz - low) / points.new_tensor(voxel_size)
    cells = torch.tensor([nx, ny, nz], device=points.device)
    below = quotient < cells.to(points.dtype)
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


def _floats(name: str, values: Sequence[float], count: int) -> list[float]:
    floats = [float(value) for value in values]
    if len(floats) != count or not all(math.isfinite(value) for value in floats):
        raise ValueError(f"voxelize: {name} must hold {count} finite numbers, got {floats}")
    return floats


def _grid_size(voxel_size: Sequence[float], point_range: Sequence[float]) -> list[int]:
    """Voxels along x, y, z."""
    grid = []
    for axis, name in enumerate("xyz"):
        size, low, high = voxel_size[axis], point_range[axis], point_range[axis + 3]
        if not size > 0:
            raise ValueError(f"voxelize: voxel_size must be positive, got {size} along {name}")
        if not low < high:
            raise ValueError(f"voxelize: point_range must have min < max, got {low} and {high} along {name}")
        cells = (high - low) / size
        if cells > _MAX_CELLS:
            raise ValueError(
                f"voxelize: voxel_size must give at most 2^30 voxels per axis, got {cells:.6g} along {name}"
            )
        if round(cells) == 0 or abs(cells - round(cells)) > 1e-3:
            raise ValueError(
                f"voxelize: point_range must be a whole multiple of voxel_size, got {cells:.6g} voxels "
                f"({low} to {high} in steps of {size}) along {name}"
            )
        grid.append(round(cells))
    return grid


def _check_offsets(batch_offsets: Tensor, num_points: int) -> None:
    offsets = batch_offsets.tolist()
    if offsets[0] != 0 or offsets[-1] != num_points or any(a > b for a, b in zip(offsets, offsets[1:], strict=False)):
        shown = str(offsets) if len(offsets) <= 16 else f"{offsets[:8]} ... {offsets[-1]}"
        raise ValueError(f"voxelize: batch_offsets must ascend from 0 to N={num_points}, got {shown}")


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
