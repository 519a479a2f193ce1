# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The reader agrees with the official devkit: poses and boxes to 1e-6 m, pixels to 1e-2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pred.data.frame import Frame
from pred.data.nuscenes import NuScenesFrames
from tests.data.tiny_tree import VERSION, write_tree

nuscenes = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
data_classes = pytest.importorskip("nuscenes.utils.data_classes")
geometry = pytest.importorskip("nuscenes.utils.geometry_utils")
pyquaternion = pytest.importorskip("pyquaternion")


@pytest.fixture(params=["written", "real"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Root of a written tree with two keyframes, or of the real keyframe."""
    if request.param == "real":
        return Path(request.getfixturevalue("nuscenes_tiny"))
    write_tree(tmp_path)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "map.png").touch()
    return tmp_path


@pytest.fixture
def pairs(root: Path) -> tuple[Any, list[Frame]]:
    """The devkit's data set and the reader's frames."""
    frames = NuScenesFrames(root)
    devkit = nuscenes.NuScenes(frames.tables.name, str(root), verbose=False)
    assert len(devkit.sample) == len(frames)
    return devkit, [frames.load(index) for index in range(len(frames))]


def matrix(row: dict[str, Any]) -> np.ndarray:
    return np.asarray(geometry.transform_matrix(row["translation"], pyquaternion.Quaternion(row["rotation"])))


def test_poses(pairs: tuple[Any, list[Frame]]) -> None:
    devkit, frames = pairs
    for frame in frames:
        data = devkit.get("sample", frame.token)["data"]

        def world_from_sensor(token: str) -> np.ndarray:
            record = devkit.get("sample_data", token)
            sensor = devkit.get("calibrated_sensor", record["calibrated_sensor_token"])
            pose = matrix(devkit.get("ego_pose", record["ego_pose_token"])) @ matrix(sensor)
            return np.asarray(pose)

        T_world_from_lidar = world_from_sensor(data["LIDAR_TOP"])
        np.testing.assert_allclose(frame.T_world_from_lidar, T_world_from_lidar, rtol=0, atol=1e-6)
        for camera in frame.cameras:
            expected = np.linalg.inv(world_from_sensor(data[camera.name])) @ T_world_from_lidar
            np.testing.assert_allclose(camera.T_camera_from_lidar, expected, rtol=0, atol=1e-6)
            assert camera.intrinsics.tolist() == devkit.get_sample_data(data[camera.name])[2].tolist()


def test_boxes(pairs: tuple[Any, list[Frame]]) -> None:
    devkit, frames = pairs
    for frame in frames:
        token = devkit.get("sample", frame.token)["data"]["LIDAR_TOP"]
        _, expected, _ = devkit.get_sample_data(token)
        boxes = frame.boxes
        assert boxes is not None and len(boxes) == len(expected) > 0
        assert boxes.names == [box.name for box in expected]
        np.testing.assert_allclose(boxes.centre_m, [box.center for box in expected], rtol=0, atol=1e-6)
        np.testing.assert_allclose(boxes.size_m, [box.wlh[[1, 0, 2]] for box in expected], rtol=0, atol=1e-6)
        heading = np.stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)], axis=1)
        axes = np.stack([box.rotation_matrix[:2, 0] for box in expected])
        np.testing.assert_allclose(heading, axes / np.linalg.norm(axes, axis=1, keepdims=True), rtol=0, atol=1e-6)


def test_pixels(pairs: tuple[Any, list[Frame]], monkeypatch: pytest.MonkeyPatch) -> None:
    devkit, frames = pairs
    from_file = data_classes.LidarPointCloud.from_file

    def in_float64(path: str) -> Any:
        # In float32 the devkit's own detour over world coordinates of some 1000 m costs 1e-4 m.
        cloud = from_file(path)
        cloud.points = cloud.points.astype(np.float64)
        return cloud

    monkeypatch.setattr(data_classes.LidarPointCloud, "from_file", staticmethod(in_float64))
    for frame in frames:
        data = devkit.get("sample", frame.token)["data"]
        raw = np.fromfile(devkit.get_sample_data_path(data["LIDAR_TOP"]), dtype=np.float32).reshape(-1, 5)
        for camera in frame.cameras:
            expected, depth, _ = devkit.explorer.map_pointcloud_to_image(
                data["LIDAR_TOP"], data[camera.name], min_dist=1.0
            )
            uv, z_depth_m = camera.project(raw[:, :3])
            # The devkit's rule for "in the image".
            u, v = uv.T
            inside = (z_depth_m > 1.0) & (u > 1) & (u < camera.width - 1) & (v > 1) & (v < camera.height - 1)
            assert inside.sum() == expected.shape[1] > 0
            np.testing.assert_allclose(uv[inside], expected[:2].T, rtol=0, atol=1e-2)
            np.testing.assert_allclose(z_depth_m[inside], depth, rtol=0, atol=1e-5)


def test_sweeps(pairs: tuple[Any, list[Frame]]) -> None:
    devkit, frames = pairs
    for frame in frames:
        sample = devkit.get("sample", frame.token)
        cloud, age = data_classes.LidarPointCloud.from_file_multisweep(
            devkit, sample, "LIDAR_TOP", "LIDAR_TOP", nsweeps=10, min_distance=0.0
        )
        # The devkit keeps the own car in: look for the reader's points among its points.
        for seconds in np.unique(frame.points[:, 4]):
            mine = frame.points[:, 4] == seconds
            theirs = np.abs(age[0] - seconds) < 1e-6
            points = cloud.points[:3, theirs].T[frame.point_index[mine]]
            np.testing.assert_allclose(frame.points[mine, :3], points, rtol=0, atol=2e-4)


def test_official_split_names(tmp_path: Path) -> None:
    write_tree(tmp_path, scenes=("scene-a", "scene-0103"), keyframes=1)
    assert VERSION == "v1.0-test"
    frames = NuScenesFrames(tmp_path, split="mini_val")
    assert [frames.token(index) for index in range(len(frames))] == ["scene-0103-sample-0"]
    with pytest.raises(ValueError, match=r"data\.split must be one of first, second, .*mini_val.*, got 'nowhere'"):
        NuScenesFrames(tmp_path, split="nowhere")
