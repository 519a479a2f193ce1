# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Intersection over union of rotated boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._boxes import check_boxes, pair_ious
from pred.ops._check import check_flags, check_like, check_tensors

_CHUNK = 2**18
"""Pairs compared at once by the reference."""


def box_iou_bev(
    boxes_a: Tensor,  # [N, 7]
    boxes_b: Tensor,  # [M, 7]
    aligned: bool = False,
) -> Tensor:  # [N, M], or [N]
    """Intersection over union of boxes seen from above: of all pairs, or row by row.

    ``|A n B| / (|A| + |B| - |A n B|)``, with the exact area of the rectangles' intersection.

    Args:
        boxes_a: ``[N, 7]`` float32, float64, bfloat16 or float16: x, y, z of the centre, length, width, height, and yaw
            in radians, counter-clockwise from +x to the length. Any unit of length. Any strides.
        boxes_b: ``[M, 7]``, same dtype.
        aligned: compare row i with row i only; M = N then.

    Returns:
        ``[N, M]``, or ``[N]`` for aligned boxes, in the dtype of the boxes (float32 for half precision), at most 1.
        Exactly 0 for boxes that are apart, for a box without area, and for a row that is no box: one with a NaN, an
        infinity or a negative size. Also where an area is beyond float64 or underflows in it. Boxes that touch have 0
        along the axes, and up to the rounding of their coordinates otherwise.

    Raises:
        ValueError: shape, device. TypeError: dtype, ``aligned`` is no bool.

    Computed in float64, relative to one box's centre, and rounded once. Not differentiable: the result is a constant.
    Equal bits for any thread count and instruction set.
    """
    return _box_iou("box_iou_bev", boxes_a, boxes_b, aligned, native=True)


def box_iou_3d(
    boxes_a: Tensor,  # [N, 7]
    boxes_b: Tensor,  # [M, 7]
    aligned: bool = False,
) -> Tensor:  # [N, M], or [N]
    """Intersection over union of the boxes' volumes: :func:`box_iou_bev` with the height that both share.

    Args, Returns, Raises: as there. A box without volume has IoU 0 with all.
    """
    return _box_iou("box_iou_3d", boxes_a, boxes_b, aligned, native=True)


def box_iou_bev_reference(boxes_a: Tensor, boxes_b: Tensor, aligned: bool = False) -> Tensor:
    """Plain PyTorch form of :func:`box_iou_bev`: Sutherland and Hodgman's clipping of polygons."""
    return _box_iou("box_iou_bev", boxes_a, boxes_b, aligned, native=False)


def box_iou_3d_reference(boxes_a: Tensor, boxes_b: Tensor, aligned: bool = False) -> Tensor:
    """Plain PyTorch form of :func:`box_iou_3d`."""
    return _box_iou("box_iou_3d", boxes_a, boxes_b, aligned, native=False)


def _box_iou(op: str, boxes_a: Tensor, boxes_b: Tensor, aligned: bool, native: bool) -> Tensor:
    if native:
        _native.refuse_transforms(op)
    check_tensors(op, boxes_a=boxes_a, boxes_b=boxes_b)
    check_flags(op, aligned=aligned)
    a, b = check_boxes(op, "boxes_a", boxes_a), check_boxes(op, "boxes_b", boxes_b)
    check_like(op, "boxes_b", b, "boxes_a", a)
    if aligned and a.shape != b.shape:
        raise ValueError(f"{op}: boxes_b must have shape {list(a.shape)} as boxes_a if aligned, got {list(b.shape)}")
    if native and _native.use_native(op, a):
        out: Tensor = getattr(torch.ops.pred, op)(a, b, aligned)
        return out
    with_height = op == "box_iou_3d"
    if aligned:
        return pair_ious(a, b, with_height).to(a.dtype)
    out = a.new_empty(a.shape[0], b.shape[0])
    step = max(1, _CHUNK // max(1, b.shape[0]))
    for begin in range(0, a.shape[0], step):
        rows = a[begin : begin + step]
        pairs = rows.repeat_interleave(b.shape[0], dim=0), b.repeat(rows.shape[0], 1)
        out[begin : begin + step] = pair_ious(*pairs, with_height).view(rows.shape[0], b.shape[0])
    return out


def _fake(boxes_a: Tensor, boxes_b: Tensor, aligned: bool) -> Tensor:
    shape = boxes_a.shape[:1] if aligned else (boxes_a.shape[0], boxes_b.shape[0])
    return boxes_a.new_empty(shape)


for _op in ("box_iou_bev", "box_iou_3d"):
    _native.register(_op, fake=_fake, differentiable=False)
