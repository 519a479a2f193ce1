# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The nuScenes reader on a written tree with known answers, and on broken trees."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pred.data.frame import FrameError
from pred.data.nuscenes import NuScenesFrames
from tests.data.tiny_tree import BOX_SIZE_WLH, NUM_EGO_POINTS, NUM_LANDMARKS, VERSION, Tree, write_tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return write_tree(tmp_path)


def in_frame(T_frame_from_world: np.ndarray, xyz_world: np.ndarray) -> np.ndarray:
    homogeneous = np.column_stack([xyz_world, np.ones(len(xyz_world))])
    return (T_frame_from_world @ homogeneous.T).T[:, :3]


def test_sweeps_accumulate_in_the_keyframe(tree: Tree) -> None:
    frames = NuScenesFrames(tree.root)
    assert len(frames) == 2
    for index, num_sweeps in enumerate([2, 4]):
        frame = frames.load(index)
        assert frame.token == frames.token(index) == tree.tokens[index]
        assert frame.points.shape == (num_sweeps * NUM_LANDMARKS, 5)
        expected = in_frame(np.linalg.inv(tree.T_world_from_lidar[index]), tree.landmarks_world)
        for sweep in range(num_sweeps):
            points = frame.points[sweep * NUM_LANDMARKS : (sweep + 1) * NUM_LANDMARKS]
            np.testing.assert_allclose(points[:, :3], expected, atol=1e-5)
            # The newest sweep comes first.
            np.testing.assert_allclose(points[:, 4], 0.05 * sweep, atol=1e-7)
        assert (frame.points[:NUM_LANDMARKS, 4] == 0).all()
        assert frame.is_keyframe[:NUM_LANDMARKS].all() and not frame.is_keyframe[NUM_LANDMARKS:].any()
        np.testing.assert_allclose(frame.T_world_from_lidar, tree.T_world_from_lidar[index], atol=1e-9)
        assert frame.source == str(tree.keyframe_files[index])
        # Frame 1: own, in between, keyframe of frame 0, in between.
        earlier = {tree.tokens[0]: slice(2 * NUM_LANDMARKS, 3 * NUM_LANDMARKS)} if index == 1 else {}
        assert frame.earlier_keyframes == earlier


def test_own_car_is_removed_and_point_index_kept(tree: Tree) -> None:
    frame = NuScenesFrames(tree.root, sweeps=2).load(1)
    assert frame.points.shape == (2 * NUM_LANDMARKS, 5)
    expected = np.arange(NUM_EGO_POINTS, NUM_EGO_POINTS + NUM_LANDMARKS)
    assert np.array_equal(frame.point_index, np.tile(expected, 2))
    raw = np.fromfile(tree.keyframe_files[1], dtype=np.float32).reshape(-1, 5)
    assert np.array_equal(frame.points[:NUM_LANDMARKS, :4], raw[frame.point_index[:NUM_LANDMARKS], :4])
    kept = NuScenesFrames(tree.root, sweeps=1, ego_box=(0, 0, 0, 0)).load(1)
    assert len(kept.points) == NUM_LANDMARKS + NUM_EGO_POINTS


def test_projection_compensates_ego_motion(tree: Tree) -> None:
    for index, frame in enumerate(map(NuScenesFrames(tree.root).load, range(2))):
        assert [camera.name for camera in frame.cameras] == ["CAM_BACK", "CAM_FRONT"]
        for camera in frame.cameras:
            # Landmarks stand still in the world, so the LiDAR plays no part in the expected pixels.
            T_world_from_camera = tree.T_world_from_camera[index][camera.name]
            expected_xyz = in_frame(np.linalg.inv(T_world_from_camera), tree.landmarks_world)
            uv, z_depth_m = camera.project(frame.points[:NUM_LANDMARKS, :3])
            np.testing.assert_allclose(z_depth_m, expected_xyz[:, 2], atol=1e-4)
            inside = camera.in_image(uv, z_depth_m)
            assert 20 < inside.sum() < NUM_LANDMARKS
            expected_uv = (tree.intrinsics[camera.name] @ expected_xyz[inside].T).T
            expected_uv = expected_uv[:, :2] / expected_uv[:, 2:]
            np.testing.assert_allclose(uv[inside], expected_uv, atol=1e-3)
            expected_T = np.linalg.inv(T_world_from_camera) @ tree.T_world_from_lidar[index]
            np.testing.assert_allclose(camera.T_camera_from_lidar, expected_T, atol=1e-9)
            assert camera.load_image().shape == (36, 64, 3)


def test_boxes(tree: Tree) -> None:
    for index, frame in enumerate(map(NuScenesFrames(tree.root).load, range(2))):
        assert frame.boxes is not None
        assert len(frame.boxes) == 1 and frame.boxes.names == ["vehicle.car"]
        T_lidar_from_box = np.linalg.inv(tree.T_world_from_lidar[index]) @ tree.T_world_from_box[index]
        np.testing.assert_allclose(frame.boxes.centre_m[0], T_lidar_from_box[:3, 3], atol=1e-9)
        heading = T_lidar_from_box[:2, 0]
        expected_yaw = np.arctan2(heading[1], heading[0])
        np.testing.assert_allclose(frame.boxes.yaw_rad, [expected_yaw], atol=1e-9)
        width, length, height = BOX_SIZE_WLH
        assert frame.boxes.size_m.tolist() == [[length, width, height]]


def test_labels_are_found(tree: Tree) -> None:
    for labels in ("auto", "pseudo/made-up"):
        for camera in NuScenesFrames(tree.root, labels=labels).load(1).cameras:
            assert camera.labels is not None
            assert camera.labels.source == tree.labels[1][camera.name]
            assert camera.labels.class_map().shape == (18, 32)


@pytest.mark.parametrize("labels", [None, "none"])
def test_without_labels_images_may_be_missing(tree: Tree, labels: str | None) -> None:
    tree.images[0]["CAM_FRONT"].unlink()
    frame = NuScenesFrames(tree.root, labels=labels).load(0)
    assert [camera.labels for camera in frame.cameras] == [None, None]
    assert [camera.image for camera in frame.cameras] == [tree.images[0]["CAM_BACK"], None]


def test_no_label_folder_means_no_labels(tree: Tree) -> None:
    (tree.root / "pseudo").rename(tree.root / "elsewhere")
    assert NuScenesFrames(tree.root).labels is None
    with pytest.raises(FrameError, match=r"pseudo/made-up: data\.labels must be a folder"):
        NuScenesFrames(tree.root, labels="pseudo/made-up")
    (tree.root / "pseudo" / "one").mkdir(parents=True)
    (tree.root / "pseudo" / "two").mkdir()
    with pytest.raises(FrameError, match=r"must hold one label folder, or data\.labels name it, got one, two"):
        NuScenesFrames(tree.root)


def test_version_folder(tree: Tree) -> None:
    assert NuScenesFrames(tree.root).tables.name == VERSION
    (tree.root / "v1.0-mini").mkdir()
    with pytest.raises(FrameError, match=r"must hold one table folder.*got v1\.0-mini, v1\.0-test"):
        NuScenesFrames(tree.root)
    assert len(NuScenesFrames(tree.root, version=VERSION)) == 2
    with pytest.raises(FrameError, match=r"v1\.0-mini/scene\.json: table must exist"):
        NuScenesFrames(tree.root, version="v1.0-mini")
    with pytest.raises(FrameError, match="must hold one table folder .* got none"):
        NuScenesFrames(tree.root / "samples")
    with pytest.raises(FrameError, match="nowhere: data.root must be a folder, got no such folder"):
        NuScenesFrames(tree.root / "nowhere")


def test_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = write_tree(tmp_path, scenes=("scene-a", "scene-b", "scene-0103"), keyframes=1)
    assert len(NuScenesFrames(tmp_path)) == 3
    assert [NuScenesFrames(tmp_path, split="first").token(0)] == ["scene-a-sample-0"]
    second = NuScenesFrames(tmp_path, split="second")
    assert [second.token(index) for index in range(len(second))] == tree.tokens[1:]
    frame = second.load(0)
    expected = in_frame(np.linalg.inv(tree.T_world_from_lidar[1]), tree.landmarks_world)
    np.testing.assert_allclose(frame.points[:NUM_LANDMARKS, :3], expected, atol=1e-5)
    assert frame.boxes is not None and len(frame.boxes) == 1

    monkeypatch.setitem(sys.modules, "nuscenes.utils.splits", None)
    with pytest.raises(ValueError, match=r"pip install 'pred-lidar\[nuscenes\]'"):
        NuScenesFrames(tmp_path, split="mini_val")


def test_empty_split(tree: Tree) -> None:
    with pytest.raises(ValueError, match=r"data\.split must select samples .* got none: second"):
        NuScenesFrames(tree.root, split="second")


def test_chain_of_sweeps_may_start_outside_the_table(tree: Tree) -> None:
    def cut(rows: list[dict[str, Any]]) -> None:
        next(row for row in rows if row["token"] == "scene-a-sweep-0")["prev"] = "not-here"

    tree.edit("sample_data", cut)
    assert len(NuScenesFrames(tree.root).load(1).points) == 4 * NUM_LANDMARKS


# Broken files


def broken_text(tree: Tree, index: int = 1) -> str:
    with pytest.raises(FrameError) as caught:
        NuScenesFrames(tree.root).load(index)
    return str(caught.value)


def test_truncated_sweep(tree: Tree) -> None:
    path = tree.sweep_files[1]
    path.write_bytes(path.read_bytes()[:-7])
    size = path.stat().st_size
    text = broken_text(tree)
    assert text.startswith(f"{path}: sweep file must hold whole points of 20 bytes")
    assert text.endswith(f"got {size} bytes: truncated?")
    # The other keyframe does not use it.
    NuScenesFrames(tree.root).load(0)
    path.write_bytes(b"")
    assert f"{path}: sweep file must hold whole points" in broken_text(tree)


def test_missing_sweep(tree: Tree) -> None:
    tree.sweep_files[0].unlink()
    assert broken_text(tree).startswith(f"{tree.sweep_files[0]}: sweep file must exist")
    NuScenesFrames(tree.root, sweeps=2).load(1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("column", [0, 3])
def test_points_that_are_not_finite(tree: Tree, value: float, column: int) -> None:
    path = tree.keyframe_files[1]
    points = np.fromfile(path, dtype=np.float32).reshape(-1, 5)
    points[[30, 99], column] = value
    points.tofile(path)
    count = f"2 of {len(points)} points, first in point 30"
    assert broken_text(tree) == f"{path}: points must be finite, got NaN or Inf in {count}"


def test_missing_image_and_label(tree: Tree) -> None:
    label = tree.labels[1]["CAM_FRONT"]
    label.rename(label.with_suffix(".bak"))
    assert broken_text(tree).startswith(f"{label}: label file must exist")
    tree.images[1]["CAM_FRONT"].unlink()
    assert broken_text(tree) == f"{tree.images[1]['CAM_FRONT']}: image file must exist, got no such file"


def test_damaged_image_and_image_of_another_size_or_mode(tree: Tree) -> None:
    path = tree.images[1]["CAM_FRONT"]
    whole = path.read_bytes()
    path.write_bytes(b"junk" * 100)
    assert broken_text(tree).startswith(f"{path}: image file must be readable, got UnidentifiedImageError")
    rule = "image must be RGB of 64 x 36 pixels, got"
    for mode, size in (("RGB", (36, 64)), ("L", (64, 36))):
        Image.new(mode, size).save(path)
        assert broken_text(tree) == f"{path}: {rule} {mode} of {size[0]} x {size[1]} pixels"
    # Only the header is read.
    path.write_bytes(whole[:-100])
    camera = NuScenesFrames(tree.root).load(1).cameras[1]
    with pytest.raises(FrameError, match=rf"{path}: image file must be readable, got OSError"):
        camera.load_image()


@pytest.mark.parametrize("table", ["scene", "sample", "sample_data", "ego_pose", "sample_annotation", "category"])
def test_missing_and_damaged_tables(tree: Tree, table: str) -> None:
    path = tree.tables / f"{table}.json"
    whole = path.read_text()
    path.unlink()
    with pytest.raises(FrameError, match=rf"{table}\.json: table must exist, got no such file"):
        NuScenesFrames(tree.root)
    path.write_text(whole[:-20])
    with pytest.raises(FrameError, match=rf"{table}\.json: table must be valid JSON"):
        NuScenesFrames(tree.root)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FrameError, match=rf"{table}\.json: table must be valid JSON"):
        NuScenesFrames(tree.root)
    path.write_text('"text"')
    with pytest.raises(FrameError, match=rf"{table}\.json: table must be a list of rows, got str"):
        NuScenesFrames(tree.root)


@pytest.mark.parametrize(
    ("table", "row", "key"),
    [
        ("sample_data", 2, "ego_pose_token"),
        ("sample_data", 3, "width"),
        ("ego_pose", 2, "rotation"),
        ("sample", 2, "scene_token"),
        ("calibrated_sensor", 2, "camera_intrinsic"),
        ("sample_annotation", 2, "size"),
    ],
)
def test_missing_table_keys(tree: Tree, table: str, row: int, key: str) -> None:
    tree.edit(table, lambda rows: rows[row - 1].pop(key))
    with pytest.raises(FrameError, match=rf"{table}\.json: row {row} must have, .* got no '{key}'"):
        NuScenesFrames(tree.root)


@pytest.mark.parametrize(
    ("table", "key", "value", "text"),
    [
        ("ego_pose", "rotation", [0.0, 0.0, 0.0, 0.0], "not a unit quaternion"),
        ("ego_pose", "rotation", [1.0, 0.0, 0.0], "row 2 must be well-formed"),
        ("ego_pose", "translation", [float("nan"), 0.0, 0.0], "row 2 must be well-formed"),
        ("ego_pose", "translation", "here", "row 2 must be well-formed"),
        ("ego_pose", "token", "other", r"must have the row scene-a-\S+ that sample_data refers to"),
        ("calibrated_sensor", "camera_intrinsic", [[1.0]], "camera_intrinsic must be 3 x 3"),
        ("calibrated_sensor", "sensor_token", "other", "got no 'other'"),
        ("sample_data", "calibrated_sensor_token", "other", "got no 'other'"),
        ("sample_data", "timestamp", "noon", "row 2 must be well-formed"),
        ("sample_annotation", "size", [1.0, 2.0], "size must have 3 numbers"),
        ("sample_annotation", "size", [1.0, 2.0, -1.0], "size must be finite and not negative"),
        ("sample_annotation", "sample_token", "other", "got no 'other'"),
        ("sample_data", "sample_token", "other", "got no 'other'"),
        ("sample_data", "filename", None, "row 2 must be well-formed, got None, which is not text"),
        ("sample_data", "filename", "/etc/hostname", "is no path below the root"),
        ("sample_data", "filename", "samples/../../other", "is no path below the root"),
        ("sample_data", "token", ["x"], "which is not text"),
        ("sample_data", "prev", ["x"], "which is not text"),
        ("calibrated_sensor", "camera_intrinsic", [[0.0] * 3] * 3, "camera_intrinsic must have positive focal lengths"),
        ("sample", "token", "scene-a-sample-0", "token scene-a-sample-0, which another row has"),
        ("calibrated_sensor", "token", "calibrated-LIDAR_TOP", "token calibrated-LIDAR_TOP, which another row has"),
        ("category", "token", [], r"got \[\], which is not text"),
    ],
)
def test_wrong_table_values(tree: Tree, table: str, key: str, value: Any, text: str) -> None:
    tree.edit(table, lambda rows: rows[1].update({key: value}))
    with pytest.raises(FrameError, match=rf"{table}\.json: .*{text}"):
        NuScenesFrames(tree.root)


def test_sample_without_lidar(tree: Tree) -> None:
    def remove(rows: list[dict[str, Any]]) -> None:
        rows[:] = [row for row in rows if row["token"] != "scene-a-sweep-3"]

    tree.edit("sample_data", remove)
    assert f"sample {tree.tokens[1]} must have a LIDAR_TOP keyframe" in broken_text(tree)
    NuScenesFrames(tree.root).load(0)
