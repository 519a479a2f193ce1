# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Non-maximum suppression of rotated boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._boxes import are_boxes, check_boxes, pair_ious
from pred.ops._check import as_geometry, check_count, check_like, check_number, check_shape, check_tensors


def nms_bev(
    boxes: Tensor,  # [N, 7]
    scores: Tensor,  # [N]
    iou_threshold: float,
    pre_max: int | None = None,
    post_max: int | None = None,
) -> Tensor:  # [K]
    """Greedy non-maximum suppression by the IoU seen from above.

    Boxes are taken by falling score, of equal scores the lowest row first. A box is kept unless its
    :func:`~pred.ops.box_iou_bev` with one that was kept before is larger than ``iou_threshold``.

    Args:
        boxes: ``[N, 7]`` float32, float64, bfloat16 or float16: x, y, z of the centre, length, width, height, yaw in
            radians, counter-clockwise. Any strides.
        scores: ``[N]``, same dtype; infinite ones are fine.
        iou_threshold: in [0, 1].
        pre_max: only so many boxes of the highest scores take part; None: all.
        post_max: at most so many are kept; None: all.

    Returns:
        ``[K]`` int64, rows of the boxes kept, by falling score. A row that is no box (one with a NaN, an infinity or a
        negative size) or whose score is NaN takes no part, and does not count for ``pre_max``. A box without area
        overlaps none.

    Raises:
        ValueError: shape, device, ``iou_threshold``, negative ``pre_max`` or ``post_max``. TypeError: dtype.

    IoUs are computed in float64 and compared without rounding. Memory grows with N, not with pairs. Not differentiable:
    the output is integer. Equal bits for any thread count and instruction set.
    """
    _native.refuse_transforms("nms_bev")
    rows, row_scores = _arguments(boxes, scores, iou_threshold, pre_max, post_max)
    pre_max, post_max = (None if limit is None else min(limit, rows.shape[0]) for limit in (pre_max, post_max))
    if _native.use_native("nms_bev", rows):
        out: Tensor = torch.ops.pred.nms_bev(rows, row_scores, float(iou_threshold), pre_max, post_max)
        return out
    return _suppress(rows, row_scores, float(iou_threshold), pre_max, post_max)


def nms_bev_reference(
    boxes: Tensor,  # [N, 7]
    scores: Tensor,  # [N]
    iou_threshold: float,
    pre_max: int | None = None,
    post_max: int | None = None,
) -> Tensor:  # [K]
    """Plain PyTorch form of :func:`nms_bev`: the best box that is left removes others, again and again."""
    rows, row_scores = _arguments(boxes, scores, iou_threshold, pre_max, post_max)
    return _suppress(rows, row_scores, float(iou_threshold), pre_max, post_max)


def _arguments(
    boxes: Tensor, scores: Tensor, iou_threshold: float, pre_max: int | None, post_max: int | None
) -> tuple[Tensor, Tensor]:
    op = "nms_bev"
    check_tensors(op, boxes=boxes, scores=scores)
    rows = check_boxes(op, "boxes", boxes)
    row_scores = as_geometry(scores.detach())
    check_shape(op, "scores", scores, (boxes.shape[0],), " as boxes")
    check_like(op, "scores", row_scores, "boxes", rows)
    check_number(op, "iou_threshold", iou_threshold)
    if not 0 <= iou_threshold <= 1:
        raise ValueError(f"{op}: iou_threshold must be in [0, 1], got {iou_threshold}")
    for name, limit in (("pre_max", pre_max), ("post_max", post_max)):
        if limit is not None:
            check_count(op, name, limit)
    return rows, row_scores


def _suppress(boxes: Tensor, scores: Tensor, iou_threshold: float, pre_max: int | None, post_max: int | None) -> Tensor:
    rows = (are_boxes(boxes) & ~scores.isnan()).nonzero()[:, 0]
    rows = rows[scores[rows].argsort(descending=True, stable=True)][:pre_max]
    most = rows.shape[0] if post_max is None else post_max
    kept: list[Tensor] = []
    while rows.shape[0] > 0 and len(kept) < most:
        kept.append(rows[:1])
        first, rows = boxes[rows[:1]], rows[1:]
        iou = pair_ious(first.expand(rows.shape[0], 7), boxes[rows], with_height=False)
        rows = rows[iou <= iou_threshold]
    return torch.cat(kept) if kept else rows[:0]


def _fake(boxes: Tensor, scores: Tensor, iou_threshold: float, pre_max: int | None, post_max: int | None) -> Tensor:
    return boxes.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.int64)


_native.register("nms_bev", fake=_fake, differentiable=False)
