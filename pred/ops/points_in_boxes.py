# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Which points lie in which rotated boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._boxes import check_boxes, contained
from pred.ops._check import check_like, check_offsets, check_tensors
from pred.ops._clouds import frame_slices, positions

_CHUNK = 2**20
"""Pairs of a point and a box compared at once by the reference."""


def points_in_boxes(
    points: Tensor,  # [N, C]
    boxes: Tensor,  # [M, 7]
    batch_offsets: Tensor | None = None,  # [B + 1]
    box_offsets: Tensor | None = None,  # [B + 1]
) -> Tensor:  # [N]
    """The first box that holds each point, or -1.

    A point is in a box if it is no farther from the centre than half the length, width and height along the box's own
    axes; faces belong to the box, as in the nuScenes devkit.

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Any
            strides.
        boxes: ``[M, 7]``, same dtype: x, y, z of the centre, length, width, height, yaw in radians, counter-clockwise.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N: frame b owns the points from ``batch_offsets[b]`` up to
            ``batch_offsets[b + 1]``. None: one frame.
        box_offsets: ``[B + 1]`` int64, ascending from 0 to M, the same for boxes; with ``batch_offsets`` only.

    Returns:
        ``[N]`` int64: the lowest row of ``boxes`` (not number within the frame) whose box holds the point, -1 where
        there is none. A point with a NaN or infinite coordinate is in no box; a row that is no box (one with a NaN, an
        infinity or a negative size) holds none.

    Raises:
        ValueError: shape, device, offsets (values are checked for CPU tensors). TypeError: dtype.

    Computed in float64, relative to the centre of the box. Not differentiable: the output is integer. Equal bits for
    any thread count and instruction set.
    """
    _native.refuse_transforms("points_in_boxes")
    xyz, rows = _arguments("points_in_boxes", points, boxes)
    _check_frames(points, boxes, batch_offsets, box_offsets)
    if _native.use_native("points_in_boxes", xyz):
        out: Tensor = torch.ops.pred.points_in_boxes(xyz, rows, batch_offsets, box_offsets)
        return out
    return _first(xyz, rows, batch_offsets, box_offsets)


def points_in_boxes_mask(
    points: Tensor,  # [N, C]
    boxes: Tensor,  # [M, 7]
) -> Tensor:  # [M, N]
    """Whether each box holds each point, by the rule of :func:`points_in_boxes`.

    Args:
        points: ``[N, C]``, boxes ``[M, 7]``: as there, of one frame.

    Returns:
        ``[M, N]`` bool; False for points and boxes that are not finite.

    Raises:
        ValueError: shape, device. TypeError: dtype.

    Not differentiable. Equal bits for any thread count and instruction set.
    """
    _native.refuse_transforms("points_in_boxes_mask")
    xyz, rows = _arguments("points_in_boxes_mask", points, boxes)
    if _native.use_native("points_in_boxes_mask", xyz):
        out: Tensor = torch.ops.pred.points_in_boxes_mask(xyz, rows)
        return out
    return _mask(xyz, rows)


def points_in_boxes_reference(
    points: Tensor,  # [N, C]
    boxes: Tensor,  # [M, 7]
    batch_offsets: Tensor | None = None,  # [B + 1]
    box_offsets: Tensor | None = None,  # [B + 1]
) -> Tensor:  # [N]
    """Plain PyTorch form of :func:`points_in_boxes`: all points of a frame against all of its boxes."""
    xyz, rows = _arguments("points_in_boxes", points, boxes)
    _check_frames(points, boxes, batch_offsets, box_offsets)
    return _first(xyz, rows, batch_offsets, box_offsets)


def points_in_boxes_mask_reference(
    points: Tensor,  # [N, C]
    boxes: Tensor,  # [M, 7]
) -> Tensor:  # [M, N]
    """Plain PyTorch form of :func:`points_in_boxes_mask`."""
    return _mask(*_arguments("points_in_boxes_mask", points, boxes))


def _arguments(op: str, points: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    check_tensors(op, points=points, boxes=boxes)
    xyz, rows = positions(op, "points", points), check_boxes(op, "boxes", boxes)
    check_like(op, "boxes", rows, "points", xyz)
    return xyz, rows


def _check_frames(points: Tensor, boxes: Tensor, batch_offsets: Tensor | None, box_offsets: Tensor | None) -> None:
    op = "points_in_boxes"
    if batch_offsets is None and box_offsets is None:
        return
    if batch_offsets is None or box_offsets is None:
        name, other = ("batch_offsets", "box_offsets") if batch_offsets is None else ("box_offsets", "batch_offsets")
        raise ValueError(f"{op}: {name} must be given with {other}, got None")
    check_tensors(op, batch_offsets=batch_offsets, box_offsets=box_offsets)
    check_offsets(op, "batch_offsets", batch_offsets, "BN", "points", points)
    check_offsets(op, "box_offsets", box_offsets, "BM", "boxes", boxes)
    if box_offsets.shape != batch_offsets.shape:
        raise ValueError(
            f"{op}: box_offsets must have shape {list(batch_offsets.shape)} as batch_offsets, "
            f"got {list(box_offsets.shape)}"
        )


def _mask(xyz: Tensor, boxes: Tensor) -> Tensor:
    mask = xyz.new_empty(boxes.shape[0], xyz.shape[0], dtype=torch.bool)
    step = max(1, _CHUNK // max(1, boxes.shape[0]))
    for begin in range(0, xyz.shape[0], step):
        mask[:, begin : begin + step] = contained(xyz[begin : begin + step], boxes)
    return mask


def _first(xyz: Tensor, boxes: Tensor, batch_offsets: Tensor | None, box_offsets: Tensor | None) -> Tensor:
    first = xyz.new_full((xyz.shape[0],), -1, dtype=torch.int64)
    if batch_offsets is None or box_offsets is None:
        frames = [(slice(0, xyz.shape[0]), slice(0, boxes.shape[0]))]
    else:
        frames = list(zip(frame_slices(batch_offsets), frame_slices(box_offsets), strict=True))
    for rows, box_rows in frames:
        if box_rows.stop == box_rows.start:
            continue
        step = max(1, _CHUNK // (box_rows.stop - box_rows.start))
        for begin in range(rows.start, rows.stop, step):
            end = min(begin + step, rows.stop)
            inside = contained(xyz[begin:end], boxes[box_rows])
            found = inside.byte().argmax(dim=0) + box_rows.start  # the first of the largest
            first[begin:end] = torch.where(inside.any(dim=0), found, -1)
    return first


def _fake(points: Tensor, boxes: Tensor, batch_offsets: Tensor | None, box_offsets: Tensor | None) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int64)


def _fake_mask(points: Tensor, boxes: Tensor) -> Tensor:
    return points.new_empty(boxes.shape[0], points.shape[0], dtype=torch.bool)


_native.register("points_in_boxes", fake=_fake, differentiable=False)
_native.register("points_in_boxes_mask", fake=_fake_mask, differentiable=False)
