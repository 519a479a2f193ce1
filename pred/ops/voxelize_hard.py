# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Hard voxelization: a fixed number of points per voxel and of voxels per frame, as spconv's ``PointToVoxel``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count, check_tensors, widen
from pred.ops.voxelize import Voxels, check_voxelize_arguments, number_voxels


class HardVoxels(NamedTuple):
    """Voxels of a batch: frame after frame, within a frame in the order in which their first points appear."""

    voxels: Tensor  # [M, max_points, C], dtype of the points
    coords: Tensor  # [M, 4] int64, (b, z, y, x)
    counts: Tensor  # [M] int64, points kept per voxel


def voxelize_hard(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],  # (x, y, z)
    point_range: Sequence[float],  # (x_min, y_min, z_min, x_max, y_max, z_max)
    max_points: int,
    max_voxels: int,
) -> HardVoxels:
    """Gathers the points of each voxel into a table of ``max_points`` rows, zero padded.

    Per frame, voxels are numbered by their first point. The first ``max_voxels`` of them are kept, and of each the
    first ``max_points`` points; all other points are dropped. Which voxel a point belongs to is decided as in
    :func:`pred.ops.voxelize`.

    Equal to ``spconv.pytorch.utils.PointToVoxel`` of spconv 2.x on the CPU, called frame by frame, but for points
    within a rounding error of the upper bound: spconv decides by the index alone, so that it drops a point just below
    the bound whose quotient rounds up to the grid size, which here belongs to the last voxel (and it keeps a point on
    the bound whose quotient rounds down, which here is outside). spconv's coordinates are int32 (z, y, x).

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Frame b
            owns the rows from ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        voxel_size: edge lengths (x, y, z), in the unit of the points.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), same unit and frame as the points; each edge a whole
            multiple of the voxel size (within 1e-3 of a voxel).
        max_points: rows per voxel.
        max_voxels: voxels per frame.

    Returns:
        ``voxels [M, max_points, C]`` in the dtype of the points, ``coords [M, 4]`` (b, z, y, x) and ``counts [M]``, the
        number of points kept, both int64. M may be 0.

    Raises:
        ValueError: shape, device, sizes or range, offsets (values are checked for CPU tensors), ``max_points`` or
            ``max_voxels`` below 1, 2^31 or more points (compiled), or B nz ny nx (each edge rounded up to a power of
            two) above 2^62.
        TypeError: dtype.

    ``voxels`` is differentiable in ``points`` any number of times: a kept point takes the gradient of its row, a
    dropped one 0. Equal bits for any thread count and instruction set.
    """
    _native.refuse_transforms("voxelize_hard")
    points, cells = _arguments(points, batch_offsets, voxel_size, point_range, max_points, max_voxels)
    if _native.use_native("voxelize_hard", points):
        out = torch.ops.pred.voxelize_hard(points, batch_offsets, *cells, max_points, max_voxels)
        return HardVoxels(*out[:3])
    return _gather(points, number_voxels(points, batch_offsets, *cells), batch_offsets, max_points, max_voxels)


def voxelize_hard_reference(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    voxel_size: Sequence[float],
    point_range: Sequence[float],
    max_points: int,
    max_voxels: int,
) -> HardVoxels:
    """Plain PyTorch form of :func:`voxelize_hard`: two sorts on top of :func:`pred.ops.reference.voxelize`."""
    points, cells = _arguments(points, batch_offsets, voxel_size, point_range, max_points, max_voxels)
    return _gather(points, number_voxels(points, batch_offsets, *cells), batch_offsets, max_points, max_voxels)


def _arguments(
    points: Tensor,
    batch_offsets: Tensor,
    voxel_size: Sequence[float],
    point_range: Sequence[float],
    max_points: int,
    max_voxels: int,
) -> tuple[Tensor, tuple[list[float], list[float], list[int]]]:
    """Points, and voxel size, range and grid size (x, y, z), after all checks."""
    op = "voxelize_hard"
    check_tensors(op, points=points, batch_offsets=batch_offsets)
    points = widen(points)
    cells = check_voxelize_arguments(op, points, batch_offsets, voxel_size, point_range)
    check_count(op, "max_points", max_points, least=1)
    check_count(op, "max_voxels", max_voxels, least=1)
    return points, cells


def _gather(points: Tensor, found: Voxels, batch_offsets: Tensor, max_points: int, max_voxels: int) -> HardVoxels:
    """The tables of voxels that are found."""
    rows = (found.point_to_voxel >= 0).nonzero()[:, 0]
    voxel = found.point_to_voxel[rows]
    # The n-th point of its voxel, n from 0: its place in a stable sort by voxel, less the voxel's first place.
    voxel, order = voxel.sort(stable=True)
    rows = rows[order]
    starts = found.counts.cumsum(0) - found.counts
    place = torch.arange(rows.shape[0], device=points.device) - starts[voxel]
    # New numbers by the voxels' first rows. Frames stay in order, since their rows do.
    by_appearance = rows[starts].argsort()
    frame = found.coords[by_appearance, 0]
    voxels_per_frame = torch.bincount(frame, minlength=batch_offsets.shape[0] - 1)
    frame_start = voxels_per_frame.cumsum(0) - voxels_per_frame
    kept = torch.arange(frame.shape[0], device=points.device) - frame_start[frame] < max_voxels
    by_appearance = by_appearance[kept]
    number = torch.full_like(found.counts, -1)
    number[by_appearance] = torch.arange(by_appearance.shape[0], device=points.device)
    fits = (number[voxel] >= 0) & (place < max_points)
    slot = number[voxel[fits]] * max_points + place[fits]
    flat = points.new_zeros(by_appearance.shape[0] * max_points, points.shape[1])
    voxels = flat.index_copy(0, slot, points[rows[fits]]).view(-1, max_points, points.shape[1])
    return HardVoxels(voxels, found.coords[by_appearance], found.counts[by_appearance].clamp_max(max_points))


def _fake(
    points: Tensor,
    batch_offsets: Tensor,
    voxel_size: list[float],
    point_range: list[float],
    grid: list[int],
    max_points: int,
    max_voxels: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    num_voxels = torch.library.get_ctx().new_dynamic_size()
    return (
        points.new_empty(num_voxels, max_points, points.shape[1]),
        batch_offsets.new_empty(num_voxels, 4),
        batch_offsets.new_empty(num_voxels),
        batch_offsets.new_empty(points.shape[0]),
    )


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(output[3])


def _backward(ctx: Any, grad: Tensor, *others: None) -> tuple[Tensor | None, ...]:
    (point_to_slot,) = ctx.saved_tensors
    return torch.ops.pred.voxelize_hard_backward(grad, point_to_slot), *(None,) * 6


def _fake_backward(grad: Tensor, point_to_slot: Tensor) -> Tensor:
    return grad.new_empty(point_to_slot.shape[0], grad.shape[2])


def _save_backward(ctx: Any, inputs: Any, output: Any) -> None:
    grad, point_to_slot = inputs
    ctx.shape = grad.shape
    ctx.save_for_backward(point_to_slot)


def _double_backward(ctx: Any, grad_grad: Tensor) -> tuple[Tensor | None, ...]:
    """The backward pass gathers rows; its transpose scatters them. One more row takes those of dropped points."""
    (point_to_slot,) = ctx.saved_tensors
    num_voxels, max_points, columns = ctx.shape
    slot = torch.where(point_to_slot < 0, num_voxels * max_points, point_to_slot)
    flat = grad_grad.new_zeros(num_voxels * max_points + 1, columns).index_copy(0, slot, grad_grad)
    return flat[:-1].view(num_voxels, max_points, columns), None


_native.register("voxelize_hard", fake=_fake, setup_context=_save, backward=_backward)
_native.register("voxelize_hard_backward", fake=_fake_backward, setup_context=_save_backward, backward=_double_backward)
