# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Procedural streets: geometry by hand, sensor layout, agreement of the sensors, determinism."""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pred.data.frame import Camera, Frame
from pred.data.labels import PseudoLabel
from pred.data.world import StreetConfig, StreetFrames, sensors
from pred.data.world.meshes import Material, Mesh, blobs, boxes, cylinders, loft, merge, quads
from pred.data.world.objects import CLASS_IDS, car, pedestrian
from pred.data.world.scene import SKY_CLASS, Scene

GREY = (0.5, 0.5, 0.5)
ROAD, CAR = CLASS_IDS["road"], CLASS_IDS["car"]
CONFIG = StreetConfig(frames=6, frames_per_street=3, image_width=160, image_height=90)


@pytest.fixture(scope="module")
def frames() -> StreetFrames:
    return StreetFrames(CONFIG)


@pytest.fixture(scope="module")
def loaded(frames: StreetFrames) -> list[Frame]:
    return [frames.load(index) for index in range(len(frames))]


def labels_of(camera: Camera) -> PseudoLabel:
    assert camera.labels is not None
    return camera.labels


def classes_of(frame: Frame) -> NDArray[Any]:
    assert frame.semantics is not None
    return frame.semantics


def digest(frame: Frame) -> str:
    """One hash over everything a frame holds, pictures and labels included."""
    arrays = [frame.points, frame.point_index, classes_of(frame), frame.T_world_from_lidar]
    for camera in frame.cameras:
        arrays += [camera.intrinsics, camera.T_camera_from_lidar]
        arrays += [camera.load_image(), labels_of(camera).class_map()]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


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


def test_points_lie_on_their_rays(loaded: list[Frame]) -> None:
    directions = sensors.lidar_directions()
    for frame in loaded:
        xyz = frame.points[:, :3].astype(np.float64)
        range_m = np.linalg.norm(xyz, axis=1)
        assert (np.diff(frame.point_index) > 0).all()
        np.testing.assert_allclose(xyz, directions[frame.point_index] * range_m[:, None], atol=1e-4)
        assert range_m.min() > 1.5 and range_m.max() < 105.2 and 3 < np.median(range_m) < 20
        assert 0.75 * 32 * 1085 < len(xyz) < 0.92 * 32 * 1085
        assert np.isfinite(frame.points).all()
        assert frame.is_keyframe.all() and not frame.points[:, 4].any()


def test_ground_is_1_84_m_below_with_2_cm_range_noise(loaded: list[Frame]) -> None:
    for frame in loaded:
        road = classes_of(frame) == ROAD
        xyz = frame.points[road, :3].astype(np.float64)
        assert road.sum() > 5000
        assert np.median(xyz[:, 2]) == pytest.approx(-1.84, abs=0.002)
        # On a plane the exact range follows from the beam's slope alone.
        slope = -sensors.lidar_directions()[frame.point_index[road], 2]
        error_m = np.linalg.norm(xyz, axis=1) - 1.84 / slope
        steep = slope > 0.2
        assert error_m[steep].std() == pytest.approx(0.02, abs=0.002)
        assert abs(error_m[steep].mean()) < 0.004


def test_intensity_is_an_integer_that_tells_materials_apart(loaded: list[Frame]) -> None:
    intensity = np.concatenate([frame.points[:, 3] for frame in loaded])
    semantics = np.concatenate([classes_of(frame) for frame in loaded])
    np.testing.assert_array_equal(intensity, np.rint(intensity))
    assert intensity.min() >= 0 and intensity.max() <= 255 and 8 < np.median(intensity) < 25
    assert np.median(intensity[semantics == CLASS_IDS["traffic sign"]]) > 3 * np.median(intensity)


def test_classes_present(loaded: list[Frame]) -> None:
    points = np.bincount(np.concatenate([classes_of(frame) for frame in loaded]), minlength=19)
    pixels = np.bincount(
        np.concatenate([labels_of(camera).class_map().ravel() for frame in loaded for camera in frame.cameras]),
        minlength=19,
    )
    for name in ("road", "sidewalk", "building", "pole", "vegetation", "terrain", "person", "car"):
        assert points[CLASS_IDS[name]] > 200, name
        assert pixels[CLASS_IDS[name]] > 500, name
    assert points[CLASS_IDS["sky"]] == 0 and pixels[CLASS_IDS["sky"]] > 10_000
    for name in ("traffic light", "traffic sign"):
        assert points[CLASS_IDS[name]] > 20 and pixels[CLASS_IDS[name]] > 50, name


# Cameras


def test_cameras_are_mounted_as_on_the_nuscenes_car(loaded: list[Frame]) -> None:
    cameras = {camera.name: camera for camera in loaded[0].cameras}
    yaw_deg = {"FRONT": 0, "FRONT_RIGHT": -55, "BACK_RIGHT": -110, "BACK": 180, "BACK_LEFT": 110, "FRONT_LEFT": 55}
    assert list(cameras) == [f"CAM_{name}" for name in yaw_deg]
    for name, degrees in yaw_deg.items():
        camera = cameras[f"CAM_{name}"]
        # In the LiDAR frame (x right, y ahead) a yaw from ahead is an azimuth of 90 degrees more.
        azimuth = np.deg2rad(90 + degrees)
        ahead = camera.T_lidar_from_camera[:3, 2]
        np.testing.assert_allclose(ahead, [np.cos(azimuth), np.sin(azimuth), 0], atol=1e-12)
        centre = camera.T_lidar_from_camera[:3, 3]
        assert centre[2] == pytest.approx(1.84 * -1 + 1.5, abs=0.06)
        assert np.linalg.norm(centre[:2]) < 1.0
        # A point 10 m ahead of the camera and 1 m above its axis.
        up = np.array([0, 0, 1.0])
        uv, z_depth_m = camera.project((centre + 10 * ahead + up)[None])
        focal_px = (809 if name == "BACK" else 1266) * 160 / 1600
        np.testing.assert_allclose(uv, [[80, 45 - focal_px / 10]], atol=1e-9)
        assert z_depth_m[0] == pytest.approx(10)


def test_lidar_and_cameras_agree(frames: StreetFrames, loaded: list[Frame]) -> None:
    """Labels at the pixels of LiDAR points equal the points' classes, but for parallax and pixel size.

    Of all points in the images about 95 % agree; of those that the camera sees, 99 % (at 400 x 225).
    """
    total = agreeing = visible = agreeing_visible = 0
    for index, frame in enumerate(loaded):
        scene, T_world_from_lidar = frames._place(index)[0].scene, frame.T_world_from_lidar
        for camera in frame.cameras:
            uv, z_depth_m = camera.project(frame.points[:, :3])
            inside = camera.in_image(uv, z_depth_m)
            agree = labels_of(camera).lookup(uv[inside]).class_id == classes_of(frame)[inside]
            centre = camera.T_lidar_from_camera[:3, 3]
            sight = frame.points[inside, :3] - centre
            distance_m = np.linalg.norm(sight, axis=1)
            hits = scene.cast(
                (T_world_from_lidar[:3, :3] @ centre + T_world_from_lidar[:3, 3]).astype(np.float32),
                (sight / distance_m[:, None] @ T_world_from_lidar[:3, :3].T).astype(np.float32),
            )
            seen = hits.t_m > distance_m - 0.3
            total, agreeing = total + len(agree), agreeing + agree.sum()
            visible, agreeing_visible = visible + seen.sum(), agreeing_visible + (agree & seen).sum()
    assert total > 15_000 * len(loaded)
    assert agreeing / total > 0.92
    assert agreeing_visible / visible > 0.975
    assert 0.005 < 1 - visible / total < 0.1  # occlusion by parallax is there


def test_images_are_pictures_of_the_labels(loaded: list[Frame]) -> None:
    for camera in loaded[1].cameras:
        image, labels = camera.load_image(), labels_of(camera).class_map()
        assert image.shape == (90, 160, 3) and image.dtype == np.uint8
        assert labels.shape == (90, 160)
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
        sky = image[labels == SKY_CLASS].astype(int)
        if len(sky):
            assert (sky[:, 2] > 180).all() and (sky[:, 2] >= sky[:, 0]).all()


# Frames


def test_frames_differ_and_move_along_the_street(loaded: list[Frame]) -> None:
    assert len({frame.token for frame in loaded}) == len(loaded)
    assert len({frame.points.tobytes() for frame in loaded}) == len(loaded)
    x_m, z_m = ([frame.T_world_from_lidar[axis, 3] for frame in loaded] for axis in (0, 2))
    assert x_m[1] - x_m[0] > 15 and x_m[2] - x_m[1] > 15 and x_m[3] < x_m[2]
    assert z_m == [1.84] * len(loaded)
    for frame in loaded:
        rotation = frame.T_world_from_lidar[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert rotation[0, 1] > 0.98  # the LiDAR's y axis points along the street


def test_frames_depend_on_seed_and_index_alone(loaded: list[Frame]) -> None:
    expected = digest(loaded[4])
    alone = StreetFrames(CONFIG)
    assert digest(alone.load(4)) == expected
    assert digest(pickle.loads(pickle.dumps(alone)).load(4)) == expected
    more = StreetFrames(StreetConfig(frames=50, frames_per_street=3, image_width=160, image_height=90))
    assert digest(more.load(4)) == expected
    other = StreetFrames(CONFIG, seed=1)
    assert other.token(4) != alone.token(4) and digest(other.load(4)) != expected


def test_without_labels_all_else_is_the_same(loaded: list[Frame]) -> None:
    frames = StreetFrames(CONFIG, labels=False)
    for frame in (frames.load(4), pickle.loads(pickle.dumps(frames)).load(4)):
        assert [camera.labels for camera in frame.cameras] == [None] * 6
        np.testing.assert_array_equal(frame.points, loaded[4].points)
        np.testing.assert_array_equal(frame.cameras[0].load_image(), loaded[4].cameras[0].load_image())


def test_another_process_makes_the_same_bits(loaded: list[Frame]) -> None:
    program = "\n".join(
        [
            "import hashlib",
            "from pred.data.world import StreetConfig, StreetFrames",
            f"frame = StreetFrames({CONFIG!r}).load(5)",
            "data = frame.points.tobytes() + frame.cameras[3].load_image().tobytes()",
            "print(hashlib.sha256(data).hexdigest())",
        ]
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    data = loaded[5].points.tobytes() + loaded[5].cameras[3].load_image().tobytes()
    assert output.strip() == hashlib.sha256(data).hexdigest()


def test_returned_arrays_are_not_shared() -> None:
    frames = StreetFrames(CONFIG)
    first = frames.load(0)
    labels, points = labels_of(first.cameras[0]).class_map(), first.points.copy()
    kept = labels.copy()
    labels[:] = 0
    first.points[:] = 0
    again = frames.load(0)
    np.testing.assert_array_equal(again.points, points)
    np.testing.assert_array_equal(labels_of(again.cameras[0]).class_map(), kept)


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="street: image_width must be at least 1, got 0"):
        StreetConfig(image_width=0)
    with pytest.raises(IndexError, match=r"street: index must be in \[0, 6\), got 6"):
        StreetFrames(CONFIG).load(6)
