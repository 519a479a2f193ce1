# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Undistortion: cases worked out by hand, and OpenCV as the oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pred.data.undistort import distort_rays, undistort_image, undistort_points, undistorted_intrinsics

WIDTH, HEIGHT = 320, 180
INTRINSICS = np.array([[230.0, 0.0, 157.0], [0.0, 228.0, 92.0], [0.0, 0.0, 1.0]])
DISTORTIONS = [
    (-0.3, 0.09, 0.0005, -0.0008),
    (-0.31, 0.11, -0.0004, 0.0011, -0.02),
    (0.12, -0.05, 0.001, 0.001, 0.01),
    (0.3, 0.05, 0.0002, -0.0003, 0.01, 0.65, 0.12, 0.02),
]


def test_distortion_by_hand() -> None:
    rays = np.array([[0.5, 0.0], [0.0, 1.0], [0.0, 0.0]])
    # r2 = 0.25: radial 1 + 0.1 * 0.25; tangential shift of x: p2 * 3 * 0.25, of y: p1 * 0.25.
    got = distort_rays(rays, (0.1, 0.0, 0.01, 0.02))
    np.testing.assert_allclose(got[0], [0.5 * 1.025 + 0.02 * 0.75, 0.01 * 0.25], atol=1e-15)
    np.testing.assert_allclose(got[1], [0.02, 1.1 + 0.03], atol=1e-15)
    np.testing.assert_array_equal(got[2], [0, 0])
    # k3 and the denominator 1 + k4 r2.
    np.testing.assert_allclose(distort_rays(rays[1], (0, 0, 0, 0, 0.5, 2.0, 0, 0)), [0, 1.5 / 3], atol=1e-15)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_undistorted_points_are_bent_back(distortion: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    uv = rng.uniform((0, 0), (WIDTH, HEIGHT), (200, 2))
    rays = undistort_points(uv, INTRINSICS, distortion)
    bent = distort_rays(rays, distortion) @ INTRINSICS[:2, :2].T + INTRINSICS[:2, 2]
    np.testing.assert_allclose(bent, uv, atol=1e-5)


def test_without_distortion_only_the_scale_of_the_border_remains() -> None:
    got = undistorted_intrinsics(INTRINSICS, (0, 0, 0, 0), WIDTH, HEIGHT)
    np.testing.assert_allclose(got, INTRINSICS, atol=1e-9)
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    np.testing.assert_array_equal(undistort_image(image, INTRINSICS, (0, 0, 0, 0), got), image)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_the_new_image_is_filled_to_its_border(distortion: tuple[float, ...]) -> None:
    new = undistorted_intrinsics(INTRINSICS, distortion, WIDTH, HEIGHT)
    white = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    undistorted = undistort_image(white, INTRINSICS, distortion, new)
    # Nine points per side do not bind what lies between them; a tenth of a pixel of the black beyond shows there.
    assert undistorted.min() > 200
    assert (undistorted[1:-1, 1:-1] == 255).all()
    corners = np.array([[0, 0], [WIDTH - 1, 0], [0, HEIGHT - 1], [WIDTH - 1, HEIGHT - 1]])
    outside = undistort_image(white, INTRINSICS, distortion, new * np.array([[0.8], [0.8], [1.0]]))
    assert any((outside[v, u] == 0).all() for u, v in corners)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_opencv_agrees(distortion: tuple[float, ...]) -> None:
    cv2: Any = pytest.importorskip("cv2")
    coefficients = np.array(distortion)
    expected, _ = cv2.getOptimalNewCameraMatrix(INTRINSICS, coefficients, (WIDTH, HEIGHT), 0.0, (WIDTH, HEIGHT))
    got = undistorted_intrinsics(INTRINSICS, distortion, WIDTH, HEIGHT)
    # OpenCV stops its fixed-point iteration early.
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=0.1)
    rng = np.random.default_rng(0)
    smooth = cv2.resize(
        rng.integers(0, 256, (12, 20, 3), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC
    )
    theirs = cv2.undistort(smooth, INTRINSICS, coefficients, newCameraMatrix=got)
    ours = undistort_image(smooth, INTRINSICS, distortion, got)
    # OpenCV rounds places to 1/32 pixel.
    difference = np.abs(ours.astype(int) - theirs.astype(int))[1:-1, 1:-1]
    assert difference.max() <= 2 and difference.mean() < 0.3


def test_fold_behind_the_new_image() -> None:
    """r (1 - 0.31 r2 + 0.11 r4 - 0.02 r6) rises to 0.95 at r = 1.55 and falls again. The corner of the lens image lies
    at 1.15 and has no ray; that of the new image lies at 1.15 too, before the fold."""
    width, height = 1920, 1080
    intrinsics = np.array([[960.0, 0.0, 959.5], [0.0, 960.0, 539.5], [0.0, 0.0, 1.0]])
    distortion = (-0.31, 0.11, 0.0, 0.0, -0.02)
    corner = undistort_points(np.array([[0.0, 0.0], [959.5, 0.0]]), intrinsics, distortion)
    assert np.isnan(corner[0]).all() and np.isfinite(corner[1]).all()
    np.testing.assert_array_equal(undistorted_intrinsics(intrinsics, distortion, width, height), intrinsics)


def test_distortion_that_folds_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be one-to-one .* got \[-3\.0, 0, 0, 0\], which folds it over"):
        undistorted_intrinsics(INTRINSICS, (-3.0, 0, 0, 0), WIDTH, HEIGHT)
