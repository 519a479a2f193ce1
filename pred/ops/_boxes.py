# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Upright boxes ``[x, y, z, length, width, height, yaw]``: checks, and the plain PyTorch forms of their geometry.

All of it is float64, whatever the boxes are stored in, and relative to one box's centre.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pred.ops._check import FLOATING, HALF, as_geometry, check_dtype, check_shape

_CHUNK = 2**14
"""Pairs whose intersection is worked out at once, some 10 kB each."""
_CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
"""Counter-clockwise, in halves of length and width."""


def check_boxes(op: str, name: str, boxes: Tensor) -> Tensor:  # [N, 7], float32 or float64
    """The boxes without their gradient; half precision becomes float32."""
    check_shape(op, name, boxes, ("N", 7))
    check_dtype(op, name, boxes, FLOATING + HALF)
    return as_geometry(boxes.detach())


def are_boxes(boxes: Tensor) -> Tensor:  # [N] bool
    """Whether each row is finite and has no negative size."""
    return boxes.isfinite().all(dim=1) & (boxes[:, 3:6] >= 0).all(dim=1)


def contained(points: Tensor, boxes: Tensor) -> Tensor:  # [M, N] bool
    """Whether each point ``[N, 3]`` lies in each box ``[M, 7]``: no farther from its centre than half its size, along
    each of its axes."""
    boxes = _exact(boxes)[:, None]
    dx, dy, dz = (points.double() - boxes[..., :3]).unbind(-1)
    cos, sin = boxes[..., 6].cos(), boxes[..., 6].sin()
    offset = torch.stack([dx * cos + dy * sin, dy * cos - dx * sin, dz], dim=-1)
    return (offset.abs() <= boxes[..., 3:6] / 2).all(dim=-1)


def pair_ious(a: Tensor, b: Tensor, with_height: bool) -> Tensor:  # [P] float64
    """Intersection over union of the boxes ``a`` and ``b``, both ``[P, 7]``, pair by pair."""
    a, b = _exact(a), _exact(b)
    shared = a.new_zeros(a.shape[0])
    for rows in _overlap(a, b).nonzero()[:, 0].split(_CHUNK):
        shared[rows] = _intersection(a[rows], b[rows])
    sizes = 2
    if with_height:
        offset, half_a, half_b = b[:, 2] - a[:, 2], a[:, 5] / 2, b[:, 5] / 2
        height = torch.minimum(half_a, offset + half_b) - torch.maximum(-half_a, offset - half_b)
        shared = shared * height.clamp_min(0)
        sizes = 3
    size_a, size_b = a[:, 3 : 3 + sizes].prod(dim=1), b[:, 3 : 3 + sizes].prod(dim=1)
    shared = torch.minimum(shared, torch.minimum(size_a, size_b))
    union = size_a + size_b - shared
    return torch.where((shared > 0) & union.isfinite(), shared / union, 0.0)


def _exact(boxes: Tensor) -> Tensor:
    """In float64, and NaN throughout where a row is no box: every comparison with one is false."""
    return torch.where(are_boxes(boxes)[:, None], boxes.double(), torch.nan)


def _turn(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of b's yaw less a's."""
    cos_a, sin_a, cos_b, sin_b = a[:, 6].cos(), a[:, 6].sin(), b[:, 6].cos(), b[:, 6].sin()
    return cos_a * cos_b + sin_a * sin_b, sin_b * cos_a - cos_b * sin_a


def _offset(a: Tensor, b: Tensor) -> Tensor:  # [P, 2]
    """The centre of b in the frame of a, seen from above."""
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    cos, sin = a[:, 6].cos(), a[:, 6].sin()
    return torch.stack([dx * cos + dy * sin, dy * cos - dx * sin], dim=1)


def _overlap(a: Tensor, b: Tensor) -> Tensor:  # [P] bool
    """Separating axes: the shadows of the rectangles on the directions of all sides overlap. Touching is none."""
    cos, sin = (value.abs() for value in _turn(a, b))
    meet = torch.ones_like(cos, dtype=torch.bool)
    for one, other in ((a, b), (b, a)):
        length, width = (other[:, 3:5] / 2).unbind(1)
        reach = one[:, 3:5] / 2 + torch.stack([cos * length + sin * width, sin * length + cos * width], dim=1)
        meet &= (_offset(one, other).abs() < reach).all(dim=1)
    return meet


def _intersection(a: Tensor, b: Tensor) -> Tensor:  # [P]
    """Area of the rectangles' intersection: Sutherland and Hodgman's clipping of one by the four sides of the other,
    then the shoelace formula. The smaller one is clipped, around its own centre, in the frame of the larger."""
    swap = (b[:, 3:5].square().sum(dim=1) < a[:, 3:5].square().sum(dim=1))[:, None]
    a, b = torch.where(swap, b, a), torch.where(swap, a, b)
    cos, sin = _turn(b, a)
    corners = a[:, None, 3:5] / 2 * a.new_tensor(_CORNERS)
    x, y = corners.unbind(-1)
    cos, sin = cos[:, None], sin[:, None]
    polygon = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)  # [P, 4, 2]
    centre, half = _offset(b, a), b[:, 3:5] / 2
    for axis in (0, 1):
        for sign in (1, -1):
            bound = half[:, axis] - sign * centre[:, axis]
            polygon = _clipped(polygon, bound[:, None] - sign * polygon[..., axis])
    x, y = (polygon - polygon[:, :1]).unbind(-1)
    return ((x * y.roll(-1, 1) - x.roll(-1, 1) * y).sum(dim=1) / 2).clamp_min(0)


def _clipped(polygon: Tensor, depth: Tensor) -> Tensor:  # [P, 2 V, 2]
    """The part of polygons ``[P, V, 2]`` where their vertices' depths ``[P, V]`` behind a line are not negative.

    Every vertex is followed by the crossing of its edge with the line. Those that are not there are replaced by the one
    before: an edge of no length.
    """
    inside = depth >= 0
    crosses = inside != inside.roll(-1, 1)
    place = depth / (depth - depth.roll(-1, 1))
    crossing = polygon + place[..., None] * (polygon.roll(-1, 1) - polygon)
    vertices = torch.stack([polygon, crossing], dim=2).flatten(1, 2)
    there = torch.stack([inside, crosses], dim=2).flatten(1)
    last = torch.where(there, torch.arange(there.shape[1], device=there.device), -1).cummax(dim=1).values
    last = torch.where(last < 0, last[:, -1:], last).clamp_min(0)
    return vertices.gather(1, last[..., None].expand(-1, -1, 2))
