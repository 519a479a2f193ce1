# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Lens distortion: from the image that a lens makes to the image of a pinhole camera.

The model is OpenCV's (its documentation of ``calib3d``): coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]], radial and
tangential; pixel centres have whole coordinates. It is written in NumPy because it runs only where pixels are looked at
(segmenting, drawing) and not in training, so OpenCV would be a dependency for a second or two per frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

COEFFICIENT_COUNTS = (4, 5, 8)
MAX_ITERATIONS = 200
CONVERGED_PX = 1e-6
POINTS_PER_SIDE = 9
"""Of the image border, as OpenCV samples it."""
RADII = 256
"""At which the distortion is looked at for a fold."""
ROWS_PER_BLOCK = 32
"""Rows of the new image that are worked on at once: their coordinates stay in the cache."""

Points = NDArray[np.float64]


def undistorted_intrinsics(
    intrinsics: NDArray[np.float64],  # [3, 3]
    distortion: Sequence[float],
    width: int,
    height: int,
) -> NDArray[np.float64]:
    """Intrinsics [3, 3] of a pinhole image of the same size.

    The upright rectangle inside the undistorted border, sampled at nine points per side, becomes the image, so that the
    lens image fills it: what OpenCV's ``getOptimalNewCameraMatrix`` gives for alpha = 0. Coefficients of wide lenses
    may hold for a part of the image only and fold it over before its border, which then has no rays; the given
    intrinsics are kept in that case.

    Raises:
        ValueError: the fold would show in the new image.
    """
    along_x = np.linspace(0.0, width - 1.0, POINTS_PER_SIDE)
    along_y = np.linspace(0.0, height - 1.0, POINTS_PER_SIDE)
    ones = np.ones(POINTS_PER_SIDE)
    top, bottom = np.stack([along_x, 0 * ones], axis=1), np.stack([along_x, (height - 1) * ones], axis=1)
    left, right = np.stack([0 * ones, along_y], axis=1), np.stack([(width - 1) * ones, along_y], axis=1)
    border = undistort_points(np.stack([top, bottom, left, right]), intrinsics, distortion)
    y_min, y_max = border[0, :, 1].max(), border[1, :, 1].min()
    x_min, x_max = border[2, :, 0].max(), border[3, :, 0].min()
    new = intrinsics.copy()
    if x_min < x_max and y_min < y_max:  # both false for NaN
        focal_x, focal_y = (width - 1) / (x_max - x_min), (height - 1) / (y_max - y_min)
        new = np.array([[focal_x, 0.0, -focal_x * x_min], [0.0, focal_y, -focal_y * y_min], [0.0, 0.0, 1.0]])
    corners = np.array([[0.0, 0.0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    radii = np.linspace(0.0, np.linalg.norm(_to_rays(corners, new), axis=1).max(), RADII)
    with np.errstate(invalid="ignore", divide="ignore"):
        radial, _ = _distortion_terms(radii, 0 * radii, _padded(distortion))
        bent = radii * radial
    if not (np.diff(bent) > 0).all():
        raise ValueError(
            f"distortion must be one-to-one inside the image, got {list(distortion)}, "
            f"which folds it over at {radii[np.argmin(np.diff(bent) > 0)]:.2f} of the focal length"
        )
    return new


def undistort_points(uv: Points, intrinsics: NDArray[np.float64], distortion: Sequence[float]) -> Points:
    """Rays (x / z, y / z) [..., 2] that the lens bends to pixels ``uv`` [..., 2]: fixed-point iteration; NaN for pixels
    where it does not converge, those behind a fold."""
    bent = _to_rays(uv, intrinsics)
    coefficients = _padded(distortion)
    tolerance = CONVERGED_PX / np.abs(intrinsics[:2, :2]).max()
    rays = bent
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(MAX_ITERATIONS):
            radial, tangential = _distortion_terms(rays[..., 0], rays[..., 1], coefficients)
            rays = (bent - tangential) / radial[..., None]
            error = np.abs(distort_rays(rays, distortion) - bent).max(axis=-1, keepdims=True)
            if (error < tolerance).all():
                break
    converged: Points = np.where(error < tolerance, rays, np.nan)
    return converged


def distort_rays(rays: Points, distortion: Sequence[float]) -> Points:
    """Where the lens puts rays (x / z, y / z) [..., 2], in the same units."""
    radial, tangential = _distortion_terms(rays[..., 0], rays[..., 1], _padded(distortion))
    return rays * radial[..., None] + tangential


def undistort_image(
    image: NDArray[np.uint8],  # [H, W, 3]
    intrinsics: NDArray[np.float64],  # [3, 3]
    distortion: Sequence[float],
    new_intrinsics: NDArray[np.float64],  # [3, 3]
) -> NDArray[np.uint8]:
    """The image [H, W, 3] of a pinhole camera with ``new_intrinsics``: bilinear, black beyond the lens image."""
    height, width = image.shape[:2]
    # A black rim, so that the neighbours of a pixel on the border need no special case.
    padded = np.zeros((height + 2, width + 2, 3), dtype=np.float32)
    padded[1:-1, 1:-1] = image
    pixels = padded.reshape(-1, 3)
    to_rays = np.linalg.inv(new_intrinsics[:2, :2])
    coefficients = _padded(distortion)
    undistorted = np.empty_like(image)
    for first in range(0, height, ROWS_PER_BLOCK):
        v, u = np.mgrid[first : min(first + ROWS_PER_BLOCK, height), :width]
        u, v = u - new_intrinsics[0, 2], v - new_intrinsics[1, 2]
        x, y = to_rays[0, 0] * u + to_rays[0, 1] * v, to_rays[1, 0] * u + to_rays[1, 1] * v
        radial, tangential = _distortion_terms(x, y, coefficients)
        x, y = x * radial + tangential[..., 0], y * radial + tangential[..., 1]
        u = intrinsics[0, 0] * x + intrinsics[0, 1] * y + intrinsics[0, 2]
        v = intrinsics[1, 0] * x + intrinsics[1, 1] * y + intrinsics[1, 2]
        # Anything outside lies on the rim; so does NaN, which fmin passes over.
        u, v = np.fmax(np.fmin(u, width), -1.0) + 1.0, np.fmax(np.fmin(v, height), -1.0) + 1.0
        column, row = np.minimum(u.astype(np.intp), width), np.minimum(v.astype(np.intp), height)
        right, down = (u - column).astype(np.float32)[..., None], (v - row).astype(np.float32)[..., None]
        corner = row * (width + 2) + column
        above = pixels[corner] * (1 - right) + pixels[corner + 1] * right
        below = pixels[corner + width + 2] * (1 - right) + pixels[corner + width + 3] * right
        undistorted[first : first + ROWS_PER_BLOCK] = np.rint(above * (1 - down) + below * down)
    return undistorted


def _distortion_terms(
    x: NDArray[np.float64], y: NDArray[np.float64], coefficients: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radial factor [...] and tangential shift [..., 2] of rays (x, y)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    shift_y = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return radial, np.stack([shift_x, shift_y], axis=-1)


def _to_rays(uv: Points, intrinsics: NDArray[np.float64]) -> Points:
    rays: Points = (uv - intrinsics[:2, 2]) @ np.linalg.inv(intrinsics[:2, :2]).T
    return rays


def _padded(distortion: Sequence[float]) -> list[float]:
    """Eight coefficients; absent ones are 0."""
    return [*distortion, *[0.0] * (8 - len(distortion))]
