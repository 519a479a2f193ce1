# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Projection, range tests, images and errors of frames."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pred.data.frame import (
    Camera,
    Frame,
    FrameError,
    inside_range,
    invert_rigid,
    outside_ego_box,
    transform_points,
)

# LiDAR x right, y ahead, z up; the camera sits 1 m ahead of the LiDAR and looks along +y.
T_CAMERA_FROM_LIDAR = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, -1.0], [0, 0, 0, 1.0]])
INTRINSICS = np.array([[100.0, 0, 50.0], [0, 100.0, 30.0], [0, 0, 1.0]])


def make_camera(**changes: object) -> Camera:
    arguments: dict[str, object] = {
        "name": "CAM",
        "intrinsics": INTRINSICS,
        "T_camera_from_lidar": T_CAMERA_FROM_LIDAR,
        "width": 100,
        "height": 60,
    }
    return Camera(**{**arguments, **changes})  # type: ignore[arg-type]


def test_project_hand_computed() -> None:
    points = np.array([[0.0, 11.0, 0.0], [2.0, 11.0, 1.0], [0.0, -5.0, 0.0]], dtype=np.float32)
    uv, z_depth_m = make_camera().project(points)
    np.testing.assert_allclose(z_depth_m, [10.0, 10.0, -6.0])
    # 2 m right at 10 m: 20 px right; 1 m up: 10 px up.
    np.testing.assert_allclose(uv[:2], [[50.0, 30.0], [70.0, 20.0]])
    assert uv.dtype == z_depth_m.dtype == np.float64
    assert make_camera().in_image(uv, z_depth_m).tolist() == [True, True, False]


def test_in_image_edges() -> None:
    uv = np.array([[0.0, 0.0], [99.999, 59.999], [100.0, 5.0], [5.0, 60.0], [-1e-9, 5.0], [5.0, 5.0], [5.0, 5.0]])
    z_depth_m = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.1, 0.0999])
    expected = [True, True, False, False, False, True, False]
    assert make_camera().in_image(uv, z_depth_m).tolist() == expected


def test_points_in_the_camera_plane_stay_finite() -> None:
    uv, z_depth_m = make_camera().project(np.array([[1.0, 1.0, 1.0]]))
    assert z_depth_m[0] == 0.0 and np.isfinite(uv).all()


def test_camera_centre_and_inverse() -> None:
    np.testing.assert_allclose(make_camera().T_lidar_from_camera[:3, 3], [0.0, 1.0, 0.0])
    identity = invert_rigid(T_CAMERA_FROM_LIDAR) @ T_CAMERA_FROM_LIDAR
    np.testing.assert_allclose(identity, np.eye(4), atol=1e-15)
    moved = transform_points(T_CAMERA_FROM_LIDAR, np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(moved, [[1.0, -3.0, 1.0]])


def test_camera_matrices_are_checked() -> None:
    with pytest.raises(ValueError, match=r"camera CAM: intrinsics must have shape \[3, 3\], got \[4, 4\]"):
        make_camera(intrinsics=np.eye(4))
    with pytest.raises(ValueError, match="camera CAM: T_camera_from_lidar must be finite"):
        make_camera(T_camera_from_lidar=np.full((4, 4), np.nan))


def test_frame_shapes_are_checked() -> None:
    index, flags = np.arange(3), np.ones(3, dtype=np.bool_)
    with pytest.raises(ValueError, match=r"f: points must be float32 of shape \[N, 5\], got float32 \[3, 4\]"):
        Frame("f", np.zeros((3, 4), np.float32), index, flags)
    with pytest.raises(ValueError, match=r"f: point_index must have shape \[4\], got \[3\]"):
        Frame("f", np.zeros((4, 5), np.float32), index, np.ones(4, dtype=np.bool_))


def test_range_box_excludes_upper_bound_and_nan() -> None:
    points = np.array([[0, 0, 0], [-1, -1, -1], [1, 0, 0], [0, np.nan, 0], [0, np.inf, 0]], dtype=np.float32)
    assert inside_range(points, (-1, -1, -1, 1, 1, 1)).tolist() == [True, True, False, False, False]


def test_ego_box_is_two_dimensional() -> None:
    points = np.array([[0, 0, 50], [0, 2.9, 0], [0, 3.1, 0], [-1.1, 0, 0]], dtype=np.float32)
    assert outside_ego_box(points, (-1, -2, 1, 3)).tolist() == [False, False, True, True]


def test_frame_error_survives_processes() -> None:
    error = pickle.loads(pickle.dumps(FrameError(Path("a/b.bin"), "points must be finite")))
    assert type(error) is FrameError and issubclass(FrameError, ValueError)
    assert (str(error), error.path) == ("a/b.bin: points must be finite", "a/b.bin")


def test_load_image(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (60, 100, 3), dtype=np.uint8)
    path = tmp_path / "image.png"
    Image.fromarray(pixels).save(path)
    for image in (path, pixels, lambda: pixels):
        assert np.array_equal(make_camera(image=image).load_image(), pixels)


def test_unusable_images_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    pixels = np.random.default_rng(0).integers(0, 256, (60, 100, 3), dtype=np.uint8)

    with pytest.raises(FrameError, match=r"image\.jpg: image file must exist"):
        make_camera(image=path).load_image()
    path.write_bytes(b"")
    with pytest.raises(FrameError, match=r"image\.jpg: image file must be readable, got UnidentifiedImageError"):
        make_camera(image=path).load_image()
    Image.fromarray(pixels).save(path)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FrameError, match=r"image\.jpg: image file must be readable, got OSError: .*truncated"):
        make_camera(image=path).load_image()
    Image.fromarray(pixels[:, :, 0]).save(path)
    with pytest.raises(FrameError, match=r"image\.jpg: image must have mode RGB, got L"):
        make_camera(image=path).load_image()
    Image.fromarray(pixels[:50]).save(path)
    with pytest.raises(FrameError, match=r"image\.jpg: image must be uint8 of shape \(60, 100, 3\), got .*\(50, 100"):
        make_camera(image=path).load_image()
    with pytest.raises(FrameError, match="camera CAM: image must be given, got None"):
        make_camera().load_image()
