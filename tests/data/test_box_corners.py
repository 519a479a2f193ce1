# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Corners of boxes, worked out by hand."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pred.data.boxes import corners_3d, corners_bev

Array = NDArray[np.float64]


def box(x: float = 0, y: float = 0, z: float = 0, l: float = 4, w: float = 2, h: float = 1, yaw: float = 0) -> Array:  # noqa: E741
    return np.array([[x, y, z, l, w, h, yaw]], dtype=np.float64)


def test_corners() -> None:
    expected = [[3, 1], [-1, 1], [-1, -1], [3, -1]]
    np.testing.assert_allclose(corners_bev(box(x=1))[0], expected, atol=1e-15)
    # A quarter turn counter-clockwise: the length lies along y, the front left corner at negative x.
    np.testing.assert_allclose(corners_bev(box(yaw=math.pi / 2))[0, 0], [-1, 2], atol=1e-15)
    corners = corners_3d(box(z=2))[0]
    assert (corners[:4, 2] == 1.5).all() and (corners[4:, 2] == 2.5).all()
    np.testing.assert_array_equal(corners[:4, :2], corners[4:, :2])


def test_no_boxes() -> None:
    assert corners_3d(np.zeros((0, 7))).shape == (0, 8, 3)
