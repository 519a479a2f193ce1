# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the ops on rotated boxes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks import cases, peers
from benchmarks.case import FORWARD, Case, Phase, Variant
from benchmarks.cases import Sizes
from pred import ops
from pred.ops import reference


def _box_iou_cases(sizes: Sizes, op: str) -> list[Case]:
    count, with_height = sizes.boxes, op == "box_iou_3d"
    boxes_a, boxes_b = cases.road_users(count), cases.road_users(count, seed=1)
    return [
        Case(
            op=op,
            name=f"{op} {count} x {count}",
            unit="pairs",
            items=count * count,
            inputs=(boxes_a, boxes_b),
            ours=lambda a, b: (getattr(ops, op)(a, b),),
            reference=lambda a, b: (getattr(reference, op)(a, b),),
            eager={"24 vertices": Variant(lambda a, b: (_eager_iou(a, b, with_height),))},
            compiled=("24 vertices",),
            # Corners that are float32, as those of spconv and of the plain form, are 4e-6 m wrong 50 m away.
            tolerance=1e-4,
            phases=(Phase(FORWARD, "28 N + 28 M + 4 N M", 28 * 2 * count + 4 * count * count),),
            peers=peers.box_iou(boxes_a, boxes_b, with_height),
        )
    ]


def _eager_iou(a: Tensor, b: Tensor, with_height: bool) -> Tensor:  # [N, M]
    """Of all pairs, some at a time: the polygon of all sides' crossings and of the corners inside, in the order of
    their angle."""
    corners_a, corners_b = _corners(a), _corners(b)
    shared = torch.cat([_shared_area(rows[:, None], corners_b[None]) for rows in corners_a.split(64)])
    size_a, size_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    if with_height:
        top = torch.minimum((a[:, 2] + a[:, 5] / 2)[:, None], b[:, 2] + b[:, 5] / 2)
        bottom = torch.maximum((a[:, 2] - a[:, 5] / 2)[:, None], b[:, 2] - b[:, 5] / 2)
        shared, size_a, size_b = shared * (top - bottom).clamp_min(0), size_a * a[:, 5], size_b * b[:, 5]
    return shared / (size_a[:, None] + size_b - shared)


def _corners(boxes: Tensor) -> Tensor:  # [N, 4, 2], counter-clockwise
    x, y = (boxes[:, None, 3:5] / 2 * boxes.new_tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]])).unbind(-1)
    cos, sin = boxes[:, None, 6].cos(), boxes[:, None, 6].sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1) + boxes[:, None, :2]


def _cross(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _shared_area(a: Tensor, b: Tensor) -> Tensor:
    a, b = torch.broadcast_tensors(a, b)  # [n, M, 4, 2]
    sides_a, sides_b = a.roll(-1, -2) - a, b.roll(-1, -2) - b
    offset = b[..., None, :, :] - a[..., :, None, :]  # [n, M, 4, 4, 2]
    along_a, along_b = sides_a[..., :, None, :], sides_b[..., None, :, :]
    turn = _cross(along_a, along_b)
    at_a, at_b = _cross(offset, along_b) / turn, _cross(offset, along_a) / turn
    crosses = (at_a >= 0) & (at_a <= 1) & (at_b >= 0) & (at_b <= 1)
    crossings = a[..., :, None, :] + at_a[..., None] * along_a
    a_inside = (_cross(along_b, -offset) >= 0).all(dim=-1)
    b_inside = (_cross(along_a, offset) >= 0).all(dim=-2)
    vertices = torch.cat([crossings.flatten(-3, -2), a, b], dim=-2)  # [n, M, 24, 2]
    valid = torch.cat([crosses.flatten(-2), a_inside, b_inside], dim=-1)
    vertices = vertices.masked_fill(~valid[..., None], 0)
    centre = vertices.sum(dim=-2, keepdim=True) / valid.sum(dim=-1)[..., None, None].clamp_min(1)
    vertices = (vertices - centre).masked_fill(~valid[..., None], 0)
    angle = torch.atan2(vertices[..., 1], vertices[..., 0]).masked_fill(~valid, 9)
    order = angle.argsort(dim=-1)
    vertices = vertices.gather(-2, order[..., None].expand_as(vertices))
    valid = valid.gather(-1, order)
    vertices = torch.where(valid[..., None], vertices, vertices[..., :1, :])
    return _cross(vertices, vertices.roll(-1, -2)).sum(dim=-1).clamp_min(0) / 2


def _nms_bev_cases(sizes: Sizes) -> list[Case]:
    boxes, scores = cases.detections(sizes.candidates)
    threshold = 0.2
    kept = len(ops.nms_bev(boxes, scores, threshold))
    return [
        Case(
            op="nms_bev",
            name=f"nms_bev {sizes.candidates} boxes, {kept} kept",
            unit="boxes",
            items=sizes.candidates,
            inputs=(boxes, scores),
            ours=lambda boxes, scores: (ops.nms_bev(boxes, scores, threshold),),
            reference=lambda boxes, scores: (reference.nms_bev(boxes, scores, threshold),),
            # Every pair in plain PyTorch would take minutes; this looks at the boxes that are left.
            eager={"best of the rest": Variant(lambda boxes, scores: (reference.nms_bev(boxes, scores, threshold),))},
            compiled=(),
            tolerance=0.0,
            phases=(Phase(FORWARD, "32 N + 8 K", 32 * sizes.candidates + 8 * kept),),
            peers=peers.nms_bev(boxes, scores, threshold),
        )
    ]


def _points_in_boxes_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)[:, :3].contiguous()
    boxes = cases.road_users(sizes.frame_boxes)
    size = f"{sizes.points} points, {sizes.frame_boxes} boxes"
    read = points.nbytes + boxes.nbytes
    return [
        Case(
            op="points_in_boxes",
            name=f"points_in_boxes {size}",
            unit="points",
            items=sizes.points,
            inputs=(points, boxes),
            ours=lambda points, boxes: (ops.points_in_boxes(points, boxes),),
            reference=lambda points, boxes: (reference.points_in_boxes(points, boxes),),
            eager={"all pairs": Variant(_eager_first)},
            compiled=("all pairs",),
            tolerance=0.0,
            outliers=1e-5,  # points on a face, up to rounding in float32
            phases=(Phase(FORWARD, "12 N + 28 M + 8 N", read + 8 * sizes.points),),
            peers=peers.points_in_boxes(boxes, first=True),
        )
    ]


def _points_in_boxes_mask_cases(sizes: Sizes) -> list[Case]:
    (case,) = _points_in_boxes_cases(sizes)
    points, boxes = case.inputs
    return [
        Case(
            op="points_in_boxes_mask",
            name=case.name.replace("points_in_boxes", "points_in_boxes_mask"),
            unit="points",
            items=sizes.points,
            inputs=(points, boxes),
            ours=lambda points, boxes: (ops.points_in_boxes_mask(points, boxes).view(torch.uint8),),
            reference=lambda points, boxes: (reference.points_in_boxes_mask(points, boxes).view(torch.uint8),),
            eager={"all pairs": Variant(lambda points, boxes: (_eager_mask(points, boxes).view(torch.uint8),))},
            compiled=("all pairs",),
            tolerance=0.0,
            outliers=1e-5,
            phases=(Phase(FORWARD, "12 N + 28 M + N M", points.nbytes + boxes.nbytes + len(points) * len(boxes)),),
            peers=peers.points_in_boxes(boxes, first=False),
        )
    ]


def _eager_mask(points: Tensor, boxes: Tensor) -> Tensor:  # [M, N]
    dx, dy, dz = (points.t()[:, None] - boxes[:, :3].t()[..., None]).unbind(0)
    cos, sin = boxes[:, 6:].cos(), boxes[:, 6:].sin()
    half = boxes[:, 3:6, None] / 2
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    return (along.abs() <= half[:, 0]) & (across.abs() <= half[:, 1]) & (dz.abs() <= half[:, 2])


def _eager_first(points: Tensor, boxes: Tensor) -> tuple[Tensor]:
    inside = _eager_mask(points, boxes)
    return (torch.where(inside.any(dim=0), inside.byte().argmax(dim=0), -1),)


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "box_iou_bev": lambda sizes: _box_iou_cases(sizes, "box_iou_bev"),
    "box_iou_3d": lambda sizes: _box_iou_cases(sizes, "box_iou_3d"),
    "nms_bev": _nms_bev_cases,
    "points_in_boxes": _points_in_boxes_cases,
    "points_in_boxes_mask": _points_in_boxes_mask_cases,
}
