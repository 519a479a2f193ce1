# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Corners of upright boxes [x, y, z, length, width, height, yaw] in NumPy, float64.

M boxes; metres; yaw in radians, counter-clockwise from +x to the length axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def _rotated(
    points: Array,  # [M, n, 2]
    yaw_rad: Array,  # [M]
) -> Array:
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
