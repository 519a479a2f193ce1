# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Geometry of upright boxes [x, y, z, length, width, height, yaw] in NumPy, float64.

P pairs, M boxes; metres; yaw in radians, counter-clockwise from +x to the length axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PAIRS_PER_BLOCK = 16384
"""Pairs whose intersection is worked out at once, some 1 kB each."""

Array = NDArray[np.float64]

# Counter-clockwise, in halves of length and width.
_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def corners_bev(boxes: Array) -> Array:
    """[M, 4, 2] corners seen from above, counter-clockwise."""
    return _rotated(_CORNERS * boxes[:, None, 3:5] / 2, boxes[:, 6]) + boxes[:, None, :2]


def corners_3d(boxes: Array) -> Array:
    """[M, 8, 3] corners: the four of the lower face, then those of the upper."""
    around = corners_bev(boxes)
    faces = []
    for side in (-0.5, 0.5):
        z = np.broadcast_to((boxes[:, 2] + side * boxes[:, 5])[:, None, None], (len(boxes), 4, 1))
        faces.append(np.concatenate([around, z], axis=2))
    return np.concatenate(faces, axis=1)


def intersection_bev(a: Array, b: Array) -> Array:
    """[P] area, seen from above, that boxes ``a`` [P, 7] and ``b`` [P, 7] share, pair by pair.

    The map that moves every point to the nearest one of b's rectangle keeps the area inside of it and leaves none
    outside. So the area sought is the one that a's outline encloses after that map, by the shoelace formula, once the
    outline has been cut where it crosses the lines of b's sides. There is no case of touching, nested or equal boxes to
    tell apart, and the result is as exact as its roundings.
    """
    areas = np.empty(len(a))
    for first in range(0, len(a), PAIRS_PER_BLOCK):
        block = slice(first, first + PAIRS_PER_BLOCK)
        areas[block] = _clamped_area(a[block], b[block])
    return areas


def iou_3d(a: Array, b: Array) -> Array:
    """[P] intersection over union of the volumes of boxes ``a`` [P, 7] and ``b`` [P, 7], pair by pair; 0 for boxes
    without volume."""
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    shared = intersection_bev(a, b) * np.maximum(top - bottom, 0.0)
    union = a[:, 3:6].prod(axis=1) + b[:, 3:6].prod(axis=1) - shared
    return np.divide(shared, union, out=np.zeros(len(a)), where=union > 0)


def _clamped_area(a: Array, b: Array) -> Array:
    half = b[:, None, 3:5] / 2  # [P, 1, 2]
    # a's corners in the frame of b, where b's sides are parallel to the axes.
    corners = _rotated(_CORNERS * a[:, None, 3:5] / 2, a[:, 6] - b[:, 6])
    corners += _rotated((a[:, :2] - b[:, :2])[:, None], -b[:, 6])
    edges = np.roll(corners, -1, axis=1) - corners
    # Places along each edge, 0 to 1, where it crosses one of the four lines; elsewhere any place does.
    lines = np.stack([-half - corners, half - corners], axis=-1)  # [P, 4, 2, 2]
    with np.errstate(over="ignore"):
        places = np.divide(lines, edges[..., None], out=np.zeros_like(lines), where=edges[..., None] != 0)
    places = np.sort(np.clip(places.reshape(len(a), 4, 4), 0.0, 1.0), axis=2)
    places = np.concatenate([np.zeros((len(a), 4, 1)), places], axis=2)
    outline = (corners[:, :, None] + places[..., None] * edges[:, :, None]).reshape(len(a), 20, 2)
    outline = np.clip(outline, -half, half)
    x, y = outline[..., 0], outline[..., 1]
    twice = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
    return np.maximum(twice / 2, 0.0)


def _rotated(
    points: Array,  # [M, n, 2]
    yaw_rad: Array,  # [M]
) -> Array:
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
