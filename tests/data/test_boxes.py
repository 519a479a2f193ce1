# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Overlap of boxes: cases worked out by hand, and shapely as the oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pred.data.boxes import PAIRS_PER_BLOCK, corners_3d, corners_bev, intersection_bev, iou_3d

Array = NDArray[np.float64]


def box(x: float = 0, y: float = 0, z: float = 0, l: float = 4, w: float = 2, h: float = 1, yaw: float = 0) -> Array:  # noqa: E741
    return np.array([[x, y, z, l, w, h, yaw]], dtype=np.float64)


def random_boxes(rng: np.random.Generator, count: int) -> Array:
    columns = (
        rng.uniform(-3, 3, (count, 3)),
        rng.uniform(0.2, 6.0, (count, 3)),
        rng.uniform(-7, 7, (count, 1)),
    )
    return np.concatenate(columns, axis=1)


def test_corners() -> None:
    expected = [[3, 1], [-1, 1], [-1, -1], [3, -1]]
    np.testing.assert_allclose(corners_bev(box(x=1))[0], expected, atol=1e-15)
    # A quarter turn counter-clockwise: the length lies along y, the front left corner at negative x.
    np.testing.assert_allclose(corners_bev(box(yaw=math.pi / 2))[0, 0], [-1, 2], atol=1e-15)
    corners = corners_3d(box(z=2))[0]
    assert (corners[:4, 2] == 1.5).all() and (corners[4:, 2] == 2.5).all()
    np.testing.assert_array_equal(corners[:4, :2], corners[4:, :2])


@pytest.mark.parametrize(
    ("other", "area"),
    [
        (box(), 8.0),  # equal
        (box(l=1, w=1), 1.0),  # inside
        (box(l=9, w=9, yaw=0.3), 8.0),  # around
        (box(x=1), 6.0),
        (box(x=1, y=1), 3.0),
        (box(x=4), 0.0),  # share a side
        (box(x=4, y=2), 0.0),  # share a corner
        (box(x=2.5, w=0.5, l=1), 0.0),  # share a part of a side
        (box(x=9), 0.0),
        (box(yaw=math.pi), 8.0),
        (box(yaw=math.pi / 2), 4.0),
        (box(l=2 * math.sqrt(2), w=2 * math.sqrt(2), yaw=math.pi / 4), 6.0),  # a square on its corner: 8 less 2 tips
        (box(l=0), 0.0),
        (box(l=0, w=0), 0.0),
    ],
)
def test_intersection_by_hand(other: Array, area: float) -> None:
    for a, b in ((box(), other), (other, box())):
        np.testing.assert_allclose(intersection_bev(a, b), [area], atol=1e-14)
        for yaw, (x, y) in ((0.7, (0, 0)), (2.9, (75.0, -60.0))):
            moved_a, moved_b = moved(a, yaw, x, y), moved(b, yaw, x, y)
            np.testing.assert_allclose(intersection_bev(moved_a, moved_b), [area], atol=1e-12)


def moved(boxes: Array, yaw: float, x: float, y: float) -> Array:
    cos, sin = math.cos(yaw), math.sin(yaw)
    result = boxes.copy()
    result[:, 0] = cos * boxes[:, 0] - sin * boxes[:, 1] + x
    result[:, 1] = sin * boxes[:, 0] + cos * boxes[:, 1] + y
    result[:, 6] += yaw
    return result


@pytest.mark.parametrize(
    ("other", "iou"),
    [
        (box(), 1.0),
        (box(x=1), 6 / 10),
        (box(z=0.5), 1 / 3),
        (box(z=1), 0.0),  # on top
        (box(z=3), 0.0),
        (box(h=0.5), 0.5),
        (box(h=0), 0.0),
    ],
)
def test_iou_by_hand(other: Array, iou: float) -> None:
    np.testing.assert_allclose(iou_3d(box(), other), [iou], atol=1e-15)


def test_boxes_without_volume_have_no_iou() -> None:
    flat = box(l=0, w=0, h=0)
    assert iou_3d(flat, flat).tolist() == [0.0]


def test_no_pairs() -> None:
    none = np.zeros((0, 7))
    assert intersection_bev(none, none).shape == iou_3d(none, none).shape == (0,)
    assert corners_3d(none).shape == (0, 8, 3)


def test_shapely_agrees_on_random_boxes() -> None:
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(0)
    a, b = random_boxes(rng, 3000), random_boxes(rng, 3000)
    b[:300] = a[:300]
    b[300:600, :6] = a[300:600, :6]
    b[300:600, 6] = a[300:600, 6] + rng.choice([math.pi / 2, math.pi, 1e-9], 300)
    # Moved by their own length: they touch along a side, up to rounding.
    b[600:900] = a[600:900]
    b[600:900, :2] += a[600:900, 3:4] * np.stack([np.cos(a[600:900, 6]), np.sin(a[600:900, 6])], axis=1)
    expected = shapely.area(shapely.intersection(shapely.polygons(corners_bev(a)), shapely.polygons(corners_bev(b))))
    assert (expected > 0.1).mean() > 0.4
    np.testing.assert_allclose(intersection_bev(a, b), expected, atol=1e-9)
    np.testing.assert_allclose(intersection_bev(a, b)[900:], expected[900:], atol=1e-12)


def test_blocks_of_pairs_are_put_together() -> None:
    rng = np.random.default_rng(1)
    count = PAIRS_PER_BLOCK + 5
    a, b = random_boxes(rng, count), random_boxes(rng, count)
    rows = [0, PAIRS_PER_BLOCK - 1, PAIRS_PER_BLOCK, count - 1]
    np.testing.assert_array_equal(intersection_bev(a, b)[rows], intersection_bev(a[rows], b[rows]))
