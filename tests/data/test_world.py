# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ray casting, meshes, and the layout of the sensors, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pred.data.world import sensors
from pred.data.world.meshes import Material, Mesh, blobs, boxes, cylinders, loft, merge, quads
from pred.data.world.objects import CLASS_IDS, car, pedestrian
from pred.data.world.scene import SKY_CLASS, Scene

GREY = (0.5, 0.5, 0.5)
ROAD, CAR = CLASS_IDS["road"], CLASS_IDS["car"]


# Ray casting


def test_cast_against_box_and_ground_by_hand() -> None:
    ground = quads([[[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]]], Material(ROAD, GREY, 0.1))
    box = boxes([5, -1, 0], [7, 1, 2], Material(CAR, GREY, 0.3))
    scene = Scene(merge([ground, box]))
    directions = np.array([[1, 0, 0], [0, 0, -1], [0.6, 0, -0.8], [-1, 0, 0], [0.8, 0.6, 0]], dtype=np.float32)
    hits = scene.cast(np.array([0, 0.25, 1], dtype=np.float32), directions)
    # The box's front at x = 5, straight down, down a 3-4-5 triangle, nothing, past the box.
    np.testing.assert_allclose(hits.t_m, [5, 1, 1.25, np.inf, np.inf], rtol=1e-6)
    assert hits.class_id.tolist() == [CAR, ROAD, ROAD, SKY_CLASS, SKY_CLASS]
    assert hits.t_m.dtype == np.float32
    np.testing.assert_array_equal(hits.normal, [[-1, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]])
    assert (hits.face[3:] == -1).all()
    # From below the ground's normal still faces the ray.
    below = scene.cast(np.array([20, 0, -3], dtype=np.float32), np.array([[0, 0, 1]], dtype=np.float32))
    assert below.t_m[0] == 3 and below.normal[0].tolist() == [0, 0, -1]
    up = np.array([[0, 0, 1], [0, 0, 1]], dtype=np.float32)
    assert scene.occluded(np.array([[6, 0, 1], [20, 0, 1]], dtype=np.float32), up).tolist() == [True, False]


def test_cast_on_no_rays() -> None:
    scene = Scene(boxes([0, 0, 0], [1, 1, 1], Material(CAR, GREY, 0.3)))
    hits = scene.cast(np.zeros(3, dtype=np.float32), np.zeros((0, 3), dtype=np.float32))
    assert hits.t_m.shape == (0,) and hits.normal.shape == (0, 3)


def volume(mesh: Mesh) -> float:
    """Volume of a closed mesh with faces turned outwards (divergence theorem)."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6)


def test_primitives_are_closed_and_of_the_right_size() -> None:
    grey = Material(CAR, GREY, 0.3)
    assert volume(boxes([[0, 0, 0], [5, 5, 5]], [[1, 2, 3], [6, 6, 6]], grey)) == pytest.approx(7)
    # A frustum: h/3 (A + B + sqrt(AB)); a gable roof: half of its box.
    assert volume(loft((0, 4, 0, 4), (1, 3, 1, 3), 0, 3, grey)) == pytest.approx(28)
    assert volume(loft((0, 4, 0, 2), (0, 4, 1, 1), 1, 3, grey)) == pytest.approx(8)
    prism = 0.5 * 6 * np.sin(2 * np.pi / 6) * 2**2
    assert volume(cylinders([1, 1, 1], [1, 4, 1], 2.0, grey, sides=6)) == pytest.approx(3 * prism)
    sphere = blobs([0, 0, 1], [2, 3, 4], grey, smoothness=3)
    assert volume(sphere) == pytest.approx(4 / 3 * np.pi * 24, rel=0.02)
    assert len(sphere.faces) == 20 * 4**3
    moved = boxes([0, 0, 0], [1, 2, 3], grey).moved(10, 0, 0, np.pi / 2)
    np.testing.assert_allclose(moved.vertices.min(axis=0), [8, 0, 0], atol=1e-12)


def test_objects_stand_on_the_ground_and_have_the_size_of_their_kind() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        for mesh, name, size in ((car(rng), "car", [4.4, 1.85, 1.5]), (pedestrian(rng), "person", [0.7, 0.65, 1.75])):
            low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            assert abs(low[2]) < 0.05
            extent = high - low
            assert extent[1:] == pytest.approx(size[1:], rel=0.12)
            assert 0.4 * size[0] < extent[0] < 1.5 * size[0]
            assert set(mesh.class_ids) == {CLASS_IDS[name]}


# LiDAR


def test_lidar_rays_follow_the_nuscenes_layout() -> None:
    directions = sensors.lidar_directions()
    assert directions.shape == (32 * 1085, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    grid = directions.reshape(1085, 32, 3)  # column by column
    elevation_deg = np.rad2deg(np.arcsin(grid[..., 2]))
    np.testing.assert_allclose(elevation_deg[:, 0], -30.67, atol=1e-9)
    np.testing.assert_allclose(elevation_deg[:, 31], 10.67, atol=1e-9)
    np.testing.assert_allclose(np.diff(elevation_deg, axis=1), 1.3335, atol=1e-3)
    azimuth_deg = np.rad2deg(np.unwrap(np.arctan2(grid[:, 5, 1], grid[:, 5, 0])))
    assert abs(azimuth_deg[0]) == pytest.approx(180)  # left: x points to the right
    np.testing.assert_allclose(np.diff(azimuth_deg), -360 / 1085, atol=1e-9)  # clockwise
    assert grid[271, 5, 1] > 0.8  # a quarter turn later: ahead


# Cameras


def test_cameras_are_mounted_as_on_the_nuscenes_car() -> None:
    yaw_deg = {"FRONT": 0, "FRONT_RIGHT": -55, "BACK_RIGHT": -110, "BACK": 180, "BACK_LEFT": 110, "FRONT_LEFT": 55}
    assert [mount.name for mount in sensors.CALIBRATED_MOUNTS] == [f"CAM_{name}" for name in yaw_deg]
    for mount, nominal_deg in zip(sensors.CALIBRATED_MOUNTS, yaw_deg.values(), strict=True):
        assert mount.yaw_deg == pytest.approx(nominal_deg, abs=1.5)
        camera = sensors.mounted_camera(mount, 160, 90)
        # In the LiDAR frame (x right, y ahead) a yaw from ahead is an azimuth of 90 degrees more.
        azimuth, pitch = np.deg2rad(90 + mount.yaw_deg), np.deg2rad(mount.pitch_deg)
        ahead = np.array([np.cos(pitch) * np.cos(azimuth), np.cos(pitch) * np.sin(azimuth), np.sin(pitch)])
        up = np.array([-np.sin(pitch) * np.cos(azimuth), -np.sin(pitch) * np.sin(azimuth), np.cos(pitch)])
        np.testing.assert_allclose(camera.T_lidar_from_camera[:3, 2], ahead, atol=1e-12)
        centre = camera.T_lidar_from_camera[:3, 3]
        assert centre[2] == pytest.approx(1.84 * -1 + 1.5, abs=0.1)
        assert np.linalg.norm(centre[:2]) < 1.05
        # A point 10 m ahead of the camera and 1 m above its axis.
        uv, z_depth_m = camera.project((centre + 10 * ahead + up)[None])
        assert mount.centre_px is not None
        centre_u, centre_v = mount.centre_px[0] / 10, mount.centre_px[1] / 10
        np.testing.assert_allclose(uv, [[centre_u, centre_v - mount.focal_px / 100]], atol=1e-9)
        assert z_depth_m[0] == pytest.approx(10)


def test_a_mount_without_calibration_looks_level_through_the_middle() -> None:
    camera = sensors.mounted_camera(sensors.Mount("left", 1.0, 0.5, 1.5, 90.0, 800.0), 160, 90)
    np.testing.assert_allclose(camera.T_lidar_from_camera[:3, 2], [-1, 0, 0], atol=1e-12)
    uv, _ = camera.project(camera.T_lidar_from_camera[None, :3, 3] + [[-10.0, 0.0, 1.0]])
    np.testing.assert_allclose(uv, [[80, 45 - 8]], atol=1e-9)
