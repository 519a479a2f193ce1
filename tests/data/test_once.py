# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The ONCE writer and reader: round trips with known answers, and broken trees."""

from __future__ import annotations

import io
import json
import math
import pickle
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from pred.data.batch import DataConfig, TrainingBatches, build_source
from pred.data.frame import Boxes, Camera, Frame, FrameError, invert_rigid, pose_matrix, quaternion_of, transform_points
from pred.data.index import FILE_NAME, FrameIndex
from pred.data.once import OnceFrames, build_index
from pred.data.once_writer import HALF_TURN, OnceRecord, boxes_in_image, once_record, write_once, write_once_splits
from pred.data.undistort import distort_rays
from pred.data_check import Report, check_data

WIDTH, HEIGHT = 64, 36
INTRINSICS = np.array([[50.0, 0.0, 31.5], [0.0, 50.0, 17.5], [0.0, 0.0, 1.0]])
FIRST_MS = 1616343527200
SEQUENCE = "000076"
DISTORTION = [-0.31, 0.11, -0.0004, 0.0011, -0.02]

# Camera axes (x right, y down, z ahead) as rows, in ONCE's LiDAR axes: x left, y back, z up.
FRONT = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
BACK = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def camera(name: str, rotation: NDArray[np.float64], seed: int) -> Camera:
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = rotation @ np.array([0.1, -0.2, 0.3])
    smooth = np.linspace(0, 255, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    image = np.roll(smooth, 7 * seed, axis=0).astype(np.uint8)
    return Camera(name, INTRINSICS, T, WIDTH, HEIGHT, image=image)


def world_pose(number: int) -> NDArray[np.float64]:
    """Driving ahead (-y) with a slow turn and some roll, far from the origin of the world."""
    turn = np.array([math.cos(0.1 * number), 0.02 * number, 0.01, math.sin(0.1 * number)])
    return pose_matrix(np.array([600.0, 1600.0 - 3.0 * number, 2.0 + 0.1 * number]), turn)


def records(count: int = 4, seed: int = 0) -> list[OnceRecord]:
    """Frame 0 has two boxes, 1 nobody annotated, 2 is annotated and empty, 3 has no pose and one box."""
    rng = np.random.default_rng(seed)
    boxes = [
        Boxes(np.array([[0.5, -9.0, -0.6], [3.0, 30.0, 0.1]]), np.array([[4.5, 1.9, 1.5], [0.7, 0.6, 1.7]]),
              np.array([-1.5, 3.1]), ["Car", "Pedestrian"]),
        None,
        Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), []),
        Boxes(np.array([[-4.0, -20.0, -0.2]]), np.array([[11.0, 2.9, 3.3]]), np.array([0.2]), ["Bus"]),
    ]  # fmt: skip
    return [
        OnceRecord(
            timestamp_ms=FIRST_MS + 500 * number,
            points=rng.uniform((-60, -60, -3, 0), (60, 60, 5, 255), (200 + number, 4)).astype(np.float32),
            T_world_from_lidar=world_pose(number) if number != 3 else None,
            cameras=[camera("cam01", FRONT, number), camera("cam09", BACK, number + 1)],
            boxes=boxes[number % 4],
        )
        for number in range(count)
    ]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_once(tmp_path, SEQUENCE, records())
    write_once_splits(tmp_path, {"train": [SEQUENCE], "val": []})
    return tmp_path


def json_file(root: Path) -> Path:
    return root / "data" / SEQUENCE / f"{SEQUENCE}.json"


def edit(root: Path, change: Callable[[Any], Any]) -> None:
    """Rewrite the sequence's JSON: ``change`` gets its content and may modify it."""
    content = json.loads(json_file(root).read_text())
    change(content)
    json_file(root).write_text(json.dumps(content))


# The written layout


def test_files_are_the_official_ones(root: Path) -> None:
    names = sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())
    frames = [str(FIRST_MS + 500 * number) for number in range(4)]
    folders = [
        (f"data/{SEQUENCE}/cam01", "jpg"),
        (f"data/{SEQUENCE}/cam09", "jpg"),
        (f"data/{SEQUENCE}/lidar_roof", "bin"),
    ]
    expected = [f"{folder}/{frame}.{suffix}" for folder, suffix in folders for frame in frames]
    assert names == sorted([*expected, f"data/{SEQUENCE}/{SEQUENCE}.json", "ImageSets/train.txt", "ImageSets/val.txt"])
    assert (root / "ImageSets" / "train.txt").read_text() == f"{SEQUENCE}\n"
    points = np.fromfile(root / "data" / SEQUENCE / "lidar_roof" / f"{FIRST_MS}.bin", dtype=np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(points, records()[0].points)


def test_json_is_the_official_one(root: Path) -> None:
    content = json.loads(json_file(root).read_text())
    assert sorted(content) == ["calib", "frames", "meta_info"]
    assert sorted(content["calib"]) == ["cam01", "cam09"]
    front = content["calib"]["cam01"]
    # cam_to_velo: the optical axis is -y, and the centre lies where the camera is.
    np.testing.assert_allclose(np.array(front["cam_to_velo"])[:3, 2], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(np.array(front["cam_to_velo"])[:3, 3], [-0.1, 0.2, -0.3], atol=1e-12)
    # OpenCV's pixel centres are whole numbers.
    assert front["cam_intrinsic"] == [[50, 0, 31], [0, 50, 17], [0, 0, 1]] and front["distortion"] == [0.0] * 5
    first, second, third, fourth = content["frames"]
    assert first["frame_id"] == str(FIRST_MS) and first["sequence_id"] == SEQUENCE
    # Relative to the first frame, quaternion x, y, z, w first.
    np.testing.assert_allclose(first["pose"], [0, 0, 0, 1, 0, 0, 0], atol=1e-9)
    assert fourth["pose"] == [0.0] * 7
    relative = np.linalg.inv(world_pose(0)) @ world_pose(1)
    np.testing.assert_allclose(second["pose"][4:], relative[:3, 3], atol=1e-9)
    assert second["pose"][3] > 0.99 and second["pose"][2] == pytest.approx(math.sin(0.1), abs=1e-3)
    assert "annos" not in second and third["annos"]["boxes_3d"] == []
    annos = first["annos"]
    assert annos["names"] == ["Car", "Pedestrian"]
    np.testing.assert_allclose(annos["boxes_3d"][0], [0.5, -9.0, -0.6, 4.5, 1.9, 1.5, -1.5])
    # The car is ahead and the pedestrian behind; cameras that are not there see nothing.
    assert sorted(annos["boxes_2d"]) == ["cam01", "cam03", "cam05", "cam06", "cam07", "cam08", "cam09"]
    assert annos["boxes_2d"]["cam01"][1] == annos["boxes_2d"]["cam09"][0] == annos["boxes_2d"]["cam03"][0] == [-1] * 4
    x_min, y_min, x_max, y_max = annos["boxes_2d"]["cam01"][0]
    assert 0 < x_min < 31.5 < x_max < WIDTH and 0 < y_min < y_max < HEIGHT


def test_boxes_in_image_by_hand() -> None:
    front = Camera("cam01", INTRINSICS, np.diag([1.0, 1, 1, 1]), WIDTH, HEIGHT)
    front.T_camera_from_lidar[:3, :3] = FRONT
    # A cube of 2 m whose near face is 9 m ahead, 1 m to the left: half-size 50 / 9 pixels.
    cube = np.array([[1.0, -10.0, 0.0, 2.0, 2.0, 2.0, 0.0]])
    np.testing.assert_allclose(
        boxes_in_image(cube, front), [[31.5 - 100 / 9, 17.5 - 50 / 9, 31.5, 17.5 + 50 / 9]], atol=1e-9
    )
    # One that reaches behind the camera beside it: it fills the left of the image down to the vanishing lines.
    wall = np.array([[2.0, 0.0, 0.0, 1.0, 30.0, 1.0, 0.0]])
    (x_min, y_min, x_max, y_max) = boxes_in_image(wall, front)[0]
    assert (x_min, y_min, y_max) == (0, 0, HEIGHT) and x_max == pytest.approx(31.5 - 50 * 1.5 / 15)
    behind = np.array([[0.0, 10.0, 0.0, 2.0, 2.0, 2.0, 0.0]])
    aside = np.array([[30.0, -10.0, 0.0, 2.0, 2.0, 2.0, 0.0]])
    assert (boxes_in_image(np.concatenate([behind, aside]), front) == -1).all()
    assert boxes_in_image(np.zeros((0, 7)), front).shape == (0, 4)


# Round trip


def test_round_trip(root: Path) -> None:
    frames = OnceFrames(root, split="train", ego_box=(0, 0, 0, 0))
    assert len(frames) == 4
    for index, record in enumerate(records()):
        frame = frames.load(index)
        assert frame.token == frames.token(index) == f"{SEQUENCE}_{record.timestamp_ms}"
        assert frames.frame_id(index) == str(record.timestamp_ms)
        assert frame.source == str(root / "data" / SEQUENCE / "lidar_roof" / f"{record.timestamp_ms}.bin")
        np.testing.assert_array_equal(frame.points[:, :4], record.points)
        assert (frame.points[:, 4] == 0).all() and frame.is_keyframe.all()
        np.testing.assert_array_equal(frame.point_index, np.arange(len(record.points)))
        assert frames.has_pose(index) == (record.T_world_from_lidar is not None)
        expected = np.eye(4)
        if record.T_world_from_lidar is not None:
            expected = np.linalg.inv(world_pose(0)) @ record.T_world_from_lidar
        np.testing.assert_allclose(frame.T_world_from_lidar, expected, atol=1e-9)
        if record.boxes is None:
            assert frame.boxes is None
        else:
            assert frame.boxes is not None and frame.boxes.names == record.boxes.names
            for attribute in ("centre_m", "size_m", "yaw_rad"):
                got, wanted = getattr(frame.boxes, attribute), getattr(record.boxes, attribute)
                assert got.shape == wanted.shape
                np.testing.assert_allclose(got, wanted, atol=1e-12)
        assert [got.name for got in frame.cameras] == ["cam01", "cam09"]
        for got, wanted in zip(frame.cameras, record.cameras, strict=True):
            np.testing.assert_allclose(got.T_camera_from_lidar, wanted.T_camera_from_lidar, atol=1e-12)
            np.testing.assert_array_equal(got.intrinsics, INTRINSICS)
            assert (got.width, got.height) == (WIDTH, HEIGHT)
            difference = got.load_image().astype(int) - wanted.load_image()
            assert np.abs(difference).max() < 25  # JPEG
    assert OnceFrames(root, split="train").annotation(1) is None


def test_points_stand_still_in_the_world(tmp_path: Path) -> None:
    landmarks = np.random.default_rng(3).uniform((560, 1560, -2), (640, 1640, 5), (300, 3))

    def seen() -> Iterator[OnceRecord]:
        for number in range(3):
            xyz = transform_points(invert_rigid(world_pose(number)), landmarks)
            points = np.column_stack([xyz, np.full(len(xyz), 9.0)]).astype(np.float32)
            yield OnceRecord(FIRST_MS + 500 * number, points, world_pose(number))

    write_once(tmp_path, SEQUENCE, seen())
    frames = OnceFrames(tmp_path, ego_box=(0, 0, 0, 0))
    placed = [transform_points(frame.T_world_from_lidar, frame.points[:, :3]) for frame in map(frames.load, range(3))]
    for later in placed[1:]:
        np.testing.assert_allclose(later, placed[0], atol=1e-4)


def test_record_of_a_frame_in_other_axes(tmp_path: Path) -> None:
    """A frame with x right, y forward. What is ahead stays ahead: in the camera, in the world and for the boxes."""
    original = records(1)[0]
    assert original.boxes is not None and original.T_world_from_lidar is not None
    points = np.zeros((3, 5), dtype=np.float32)
    points[:, :4] = [[0, 10, 0, 5], [2, 0, 1, 6], [7, 7, 7, 7]]
    frame = Frame(
        token="x",
        points=points,
        point_index=np.arange(3),
        is_keyframe=np.array([True, True, False]),
        cameras=[replace(camera("CAM_FRONT", FRONT @ HALF_TURN[:3, :3], 0)), camera("CAM_OTHER", FRONT, 0)],
        T_world_from_lidar=world_pose(2),
        boxes=Boxes(
            np.array([[1.0, 10.0, 0.0], [0.0, 5.0, 0.0]]),
            np.array([[4.0, 2.0, 1.5], [1.0, 1.0, 1.0]]),
            np.array([math.pi / 2, 0.0]),
            ["vehicle.car", "movable_object.barrier"],
        ),
    )
    record = once_record(frame, FIRST_MS)
    np.testing.assert_array_equal(record.points, np.array([[0, -10, 0, 5], [-2, 0, 1, 6]], dtype=np.float32))
    assert record.boxes is not None and record.boxes.names == ["Car"]
    np.testing.assert_allclose(record.boxes.centre_m, [[-1, -10, 0]])
    np.testing.assert_allclose(record.boxes.yaw_rad, [-math.pi / 2])
    assert record.T_world_from_lidar is not None
    np.testing.assert_allclose(
        transform_points(record.T_world_from_lidar, record.points[:, :3]),
        transform_points(frame.T_world_from_lidar, points[:2, :3]),
        atol=1e-9,
    )
    (turned,) = record.cameras
    before, after = frame.cameras[0].project(points[:1, :3]), turned.project(record.points[:1, :3])
    np.testing.assert_allclose(after[0], before[0])
    assert turned.name == "cam01" and after[1] == pytest.approx(before[1]) and after[1] > 9
    write_once(tmp_path, SEQUENCE, [record])
    assert OnceFrames(tmp_path).load(0).boxes is not None
    assert once_record(replace(frame, boxes=None), FIRST_MS, {}, {}).boxes is None


def test_equal_records_give_equal_bytes(root: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    write_once(other, SEQUENCE, records())
    for path in (root / "data").rglob("*.*"):
        assert path.read_bytes() == (other / path.relative_to(root)).read_bytes(), path


@pytest.mark.parametrize("seed", range(20))
def test_quaternions_of_rotations(seed: int) -> None:
    quaternion = np.random.default_rng(seed).normal(size=4)
    if seed < 6:  # half turns, where the real part is 0 or nearly so
        quaternion = np.array([1e-9 * (seed % 2), *np.eye(3)[seed // 2]])
    quaternion *= np.sign(quaternion[0] or 1) / np.linalg.norm(quaternion)
    got = quaternion_of(pose_matrix(np.zeros(3), quaternion)[:3, :3])
    np.testing.assert_allclose(np.abs(got @ quaternion), 1, atol=1e-12)
    assert got[0] >= 0


# Reading


def test_own_car_is_removed_and_point_index_kept(tmp_path: Path) -> None:
    points = np.array([[0, -2.5, 0, 1], [0, 5, 0, 2], [0, 2.5, 0, 3], [0.9, 0, 0, 4]], dtype=np.float32)
    write_once(tmp_path, SEQUENCE, [OnceRecord(FIRST_MS, points)])
    frame = OnceFrames(tmp_path).load(0)
    # Three metres ahead (-y) and two behind.
    assert frame.point_index.tolist() == [1, 2]
    np.testing.assert_array_equal(frame.points[:, 3], [2, 3])
    assert len(OnceFrames(tmp_path, ego_box=(0, 0, 0, 0)).load(0).points) == 4


def test_splits_and_sequences(tmp_path: Path) -> None:
    for number, name in enumerate(("000104", "000027", "000080")):
        write_once(tmp_path, name, records(2, seed=number))
    (tmp_path / "data" / ".000001.partial").mkdir()
    everything = OnceFrames(tmp_path)
    assert [everything.token(index)[:6] for index in range(6)] == ["000027"] * 2 + ["000080"] * 2 + ["000104"] * 2
    write_once_splits(tmp_path, {"raw_small": ["000104", "000027"], "val": []})
    chosen = OnceFrames(tmp_path, split="raw_small")
    assert [chosen.token(index)[:6] for index in range(4)] == ["000104"] * 2 + ["000027"] * 2
    with pytest.raises(IndexError, match=r"index must be in \[0, 4\), got 4"):
        chosen.token(4)
    with pytest.raises(
        FrameError, match=r"ImageSets/test\.txt: list of the split must exist.* there are: raw_small, val"
    ):
        OnceFrames(tmp_path, split="test")
    with pytest.raises(ValueError, match=r"data\.split must select frames of .* got none: val"):
        OnceFrames(tmp_path, split="val")
    (tmp_path / "ImageSets" / "val.txt").write_text("../000027\n")
    with pytest.raises(FrameError, match=r"val\.txt: list must hold names of sequences, got '\.\./000027'"):
        OnceFrames(tmp_path, split="val")
    (tmp_path / "ImageSets" / "val.txt").write_text("000999\n")
    with pytest.raises(FrameError, match=r"data/000999/000999\.json: file of the sequence must exist"):
        OnceFrames(tmp_path, split="val")
    with pytest.raises(FrameError, match=r"nowhere/data: must be a folder with one folder per sequence"):
        OnceFrames(tmp_path / "nowhere")


def write_labels(root: Path) -> None:
    label = np.full((HEIGHT // 2, WIDTH // 2), 13, dtype=np.uint8)
    for number in range(4):
        for name in ("cam01", "cam09"):
            folder = root / "pseudo" / "made-up" / SEQUENCE / name
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray(label).save(folder / f"{FIRST_MS + 500 * number}.png")


def test_labels(root: Path) -> None:
    write_labels(root)
    for labels in ("auto", "pseudo/made-up"):
        frame = OnceFrames(root, labels=labels).load(1)
        assert all(camera.labels is not None and (camera.labels.class_map() == 13).all() for camera in frame.cameras)
    (root / "pseudo" / "made-up" / SEQUENCE / "cam09" / f"{FIRST_MS}.png").unlink()
    with pytest.raises(FrameError, match=rf"{SEQUENCE}/cam09/{FIRST_MS}\.png: label file must exist"):
        OnceFrames(root).load(0)
    image = root / "data" / SEQUENCE / "cam01" / f"{FIRST_MS + 500}.jpg"
    image.unlink()
    with pytest.raises(FrameError, match=rf"{image}: image file must exist"):
        OnceFrames(root).load(1)
    # Without labels, cameras without an image are left out.
    assert [camera.name for camera in OnceFrames(root, labels="none").load(1).cameras] == ["cam09"]


def test_frames_of_the_configuration(root: Path) -> None:
    config = DataConfig(
        dataset="once", root=str(root), split="train", labels="none", batch_size=2, depth_rays=20, workers=0
    )
    source = build_source(config)
    assert isinstance(source, OnceFrames) and len(source) == 4
    batch = TrainingBatches(config, (-51.2, -51.2, -5.0, 51.2, 51.2, 6.0), seed=0, total_steps=1)[0]
    assert batch.depth.valid.all() and batch.semantic is None and len(batch.points) > 0
    with pytest.raises(ValueError, match=r"data\.root must name the folder of the data set, got None"):
        build_source(replace(config, root=None))
    with pytest.raises(ValueError, match=r"data\.root must name a folder, got an empty string"):
        replace(config, root="")


# The index


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Roots, once for each time that the JSON files of one are read."""
    roots: list[Path] = []

    def counted(root: Path, report: Any) -> FrameIndex:
        roots.append(root)
        return build_index(root, report)

    monkeypatch.setattr("pred.data.once.build_index", counted)
    return roots


def test_json_files_are_read_once(root: Path, builds: list[Path]) -> None:
    frames = OnceFrames(root)
    assert (root / FILE_NAME).is_file()
    again = OnceFrames(root, split="train", undistort=False)
    sent = pickle.dumps(frames)
    received = pickle.loads(sent)
    assert builds == [root] and len(sent) < 2000
    for one, other in zip(map(frames.load, range(4)), map(received.load, range(4)), strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.T_world_from_lidar, other.T_world_from_lidar)
    assert [again.token(index) for index in range(4)] == [frames.token(index) for index in range(4)]


def test_a_changed_or_added_file_makes_it_stale(root: Path, builds: list[Path]) -> None:
    assert OnceFrames(root).load(0).boxes is not None
    edit(root, lambda content: content["frames"][0].pop("annos"))
    assert OnceFrames(root).load(0).boxes is None
    write_once(root, "000027", records(2, seed=1))
    assert [len(OnceFrames(root)), len(OnceFrames(root, split="train")), len(builds)] == [6, 4, 3]
    shutil.rmtree(root / "data" / "000027")
    assert [len(OnceFrames(root)), len(builds)] == [4, 4]


def test_a_damaged_index_is_made_anew(root: Path, builds: list[Path]) -> None:
    pose = OnceFrames(root).load(1).T_world_from_lidar
    content = bytearray((root / FILE_NAME).read_bytes())
    content[content.index(pose[0, 3].tobytes()) + 6] ^= 1
    (root / FILE_NAME).write_bytes(content)
    with pytest.warns(UserWarning, match=f"{FILE_NAME}: index must be intact, got a wrong checksum; it is made anew"):
        frames = OnceFrames(root)
    np.testing.assert_array_equal(frames.load(1).T_world_from_lidar, pose)
    assert len(builds) == 2


def test_broken_sequences_of_other_splits_do_not_matter(root: Path, builds: list[Path]) -> None:
    write_once(root, "000027", records(2))
    write_once(root, "000104", records(2))
    broken = root / "data" / "000027" / "000027.json"
    whole = broken.read_text()
    broken.write_text("{")
    (root / "data" / "000080").mkdir()  # pictures alone
    write_once_splits(root, {"train": [SEQUENCE, "000104"], "val": ["000104", "000027"]})
    for _ in range(2):
        assert len(OnceFrames(root, split="train")) == 6
        with pytest.raises(FrameError, match=rf"{broken}: file of the sequence must be valid JSON"):
            OnceFrames(root, split="val")
    assert len(builds) == 1
    broken.write_text(whole)
    frames = OnceFrames(root, split="val")
    assert [frames.token(index)[:6] for index in range(4)] == ["000104"] * 2 + ["000027"] * 2


def test_calibrations_by_sequence(root: Path) -> None:
    """Each sequence has its own cameras, with numbers of their own."""
    other = records(2)
    moved = np.eye(4)
    moved[:3, 3] = [0.0, 0.0, 0.7]
    for record in other:
        front = replace(record.cameras[0], name="cam05", intrinsics=INTRINSICS + np.diag([3.0, 3.0, 0.0]))
        record.cameras = [replace(front, T_camera_from_lidar=moved @ front.T_camera_from_lidar)]
    write_once(root, "000027", other)
    write_once(root, "000028", [OnceRecord(FIRST_MS, records(1)[0].points)])  # none
    frames = OnceFrames(root)
    cameras = [[camera.name for camera in frames.load(index).cameras] for index in range(7)]
    assert cameras == [["cam05"]] * 2 + [[]] + [["cam01", "cam09"]] * 4
    (camera_05,) = frames.load(1).cameras
    np.testing.assert_array_equal(camera_05.intrinsics, INTRINSICS + np.diag([3.0, 3.0, 0.0]))
    np.testing.assert_allclose(camera_05.T_camera_from_lidar, other[1].cameras[0].T_camera_from_lidar, atol=1e-12)


def test_annotations_are_as_they_are_in_the_file(root: Path) -> None:
    boxes = [[1.5, -2.0, 0.25, 4.0, 2.0, 1.5, yaw] for yaw in (-6.0, -3.5, 0.0, 3.0, 4.0, 6.2)]
    edit(root, lambda content: content["frames"][1].update(annos={"names": ["Car"] * 6, "boxes_3d": boxes}))
    frames = OnceFrames(root)
    annotation = frames.annotation(1)
    assert annotation is not None and annotation[0] == ["Car"] * 6
    np.testing.assert_allclose(annotation[1], boxes, rtol=0, atol=1e-14)
    loaded = frames.load(1).boxes
    assert loaded is not None and (np.abs(loaded.yaw_rad) <= math.pi).all()


def test_a_tree_without_frames(root: Path) -> None:
    edit(root, lambda content: content["frames"].clear())
    with pytest.raises(ValueError, match=r"data\.split must select frames of .* got none: None"):
        OnceFrames(root)
    shutil.rmtree(root / "data" / SEQUENCE)
    with pytest.raises(ValueError, match=r"data\.split must select frames of .* got none: None"):
        OnceFrames(root)


# Undistortion


def test_undistorted_images_agree_with_their_intrinsics(root: Path) -> None:
    """A mark painted where the lens shows a point is found where the pinhole camera has it."""
    edit(root, lambda content: content["calib"]["cam01"].update(distortion=DISTORTION))
    frame = OnceFrames(root).load(0)
    front = frame.cameras[0]
    assert front.intrinsics[0, 0] != INTRINSICS[0, 0]
    back = frame.cameras[1]
    assert isinstance(back.image, Path) and back.intrinsics[0, 0] == INTRINSICS[0, 0]
    for xyz in ([[1.8, -8.0, 1.0]], [[-2.0, -9.0, -1.0]]):
        point = np.array(xyz)
        on_camera = transform_points(front.T_camera_from_lidar, point)
        bent = distort_rays(on_camera[:, :2] / on_camera[:, 2:], DISTORTION)
        u, v = (bent @ INTRINSICS[:2, :2].T)[0] + INTRINSICS[:2, 2]
        grid_v, grid_u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        blob = 255 * np.exp(-((grid_u - u) ** 2 + (grid_v - v) ** 2) / (2 * 2.0**2))
        image = np.repeat(blob[..., None], 3, axis=2).astype(np.uint8)
        Image.fromarray(image).save(root / "data" / SEQUENCE / "cam01" / f"{FIRST_MS}.jpg", quality=95)
        seen = front.load_image()[..., 0].astype(float)
        seen[seen < 30] = 0
        centroid = [(seen * grid_u).sum() / seen.sum(), (seen * grid_v).sum() / seen.sum()]
        projected, _ = front.project(point)
        np.testing.assert_allclose(centroid, projected[0], atol=0.3)
        assert np.abs(projected[0] - (u, v)).max() > 0.5
    raw = OnceFrames(root, undistort=False).load(0).cameras[0]
    assert isinstance(raw.image, Path)
    np.testing.assert_array_equal(raw.intrinsics, INTRINSICS)


def test_pixels_are_those_of_opencv_and_a_half(root: Path) -> None:
    """OpenCV's pixel (0, 0) has its centre there; ours covers [0, 1)."""
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(2).uniform((-4, -20, -2), (4, -6, 2), (50, 3))
    for distortion in ([0.0] * 5, DISTORTION):
        edit(root, lambda content, d=distortion: content["calib"]["cam01"].update(distortion=d))  # type: ignore[misc]
        calibration = json.loads(json_file(root).read_text())["calib"]["cam01"]
        K, d = np.array(calibration["cam_intrinsic"]), np.array(calibration["distortion"])
        T_camera_from_lidar = np.linalg.inv(calibration["cam_to_velo"])
        rotation, _ = cv2.Rodrigues(T_camera_from_lidar[:3, :3])
        straight, _ = cv2.getOptimalNewCameraMatrix(K, d, (WIDTH, HEIGHT), 0)
        for undistort, matrix in ((True, straight if any(distortion) else K), (False, K)):
            uv, _ = cv2.projectPoints(points, rotation, T_camera_from_lidar[:3, 3], matrix, None)
            camera = OnceFrames(root, undistort=undistort).load(0).cameras[0]
            # OpenCV's new matrix comes from five iterations, ours from as many as are needed.
            atol = 5e-3 if matrix is straight else 1e-9
            np.testing.assert_allclose(camera.project(points)[0], uv[:, 0] + 0.5, rtol=0, atol=atol)


def test_distortion_that_cannot_be_undone_names_the_file(root: Path) -> None:
    edit(root, lambda content: content["calib"]["cam09"].update(distortion=[[-30.0, 0, 0, 0, 0]]))
    rule = r"calib cam09: distortion must be one-to-one inside the image.*; data\.undistort false takes"
    with pytest.raises(FrameError, match=rf"{json_file(root)}: {rule}"):
        OnceFrames(root).load(0)
    OnceFrames(root, undistort=False).load(0)


# Broken trees


def broken_text(root: Path, index: int = 0) -> str:
    with pytest.raises(FrameError) as caught:
        OnceFrames(root).load(index)
    return str(caught.value)


def test_missing_and_damaged_json(root: Path) -> None:
    path = json_file(root)
    whole = path.read_bytes()
    for content, text in (
        (whole[:-20], "file of the sequence must be valid JSON"),
        (b"\xff\xfe\x00", "file of the sequence must be valid JSON"),
        (b"[" * 100_000, "file of the sequence must be valid JSON"),
        (b"[]", "must be {calib: {camera: ...}, frames: [...]}, got another structure"),
        (b'{"calib": {}}', "must have the keys calib and frames, got no 'frames'"),
        (b'{"calib": [], "frames": []}', "must be {calib"),
        (b'{"calib": {}, "frames": {}}', "must be {calib"),
        (b'{"calib": {"cam01": 3}, "frames": []}', "must be {calib"),
        (b'{"calib": {}, "frames": [3]}', "frame 0 must be well-formed"),
    ):
        path.write_bytes(content)
        assert broken_text(root).startswith(f"{path}: {text}")
    path.unlink()
    assert broken_text(root) == f"{path}: file of the sequence must exist, got no such file"


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ({"frame_id": None}, "frame 1 must be well-formed, got frame_id None"),
        ({"frame_id": "../x"}, "frame 1 must be well-formed, got frame_id '../x'"),
        ({"frame_id": str(FIRST_MS)}, f"frame_id must be unique, got {FIRST_MS} twice"),
        ({"pose": [0, 0, 0, 1, 0, 0]}, "frame 1 must be well-formed, got pose [0, 0, 0, 1, 0, 0], which is not"),
        ({"pose": [1, 1, 0, 1, 0, 0, 0]}, "whose first four numbers are not a unit quaternion"),
        ({"pose": [0, 0, 0, float("nan"), 0, 0, 0]}, "which is not a quaternion x, y, z, w and a translation"),
        ({"pose": "here"}, "frame 1 must be well-formed, got could not convert string"),
        ({"pose": [10**400] * 7}, "frame 1 must be well-formed"),
        ({"annos": {"names": ["Car"]}}, "frame 1 must have the key 'boxes_3d', got none"),
        ({"annos": {"names": ["Car"], "boxes_3d": []}}, "boxes_3d of shape [0] for 1 names"),
        ({"annos": {"names": ["Car"], "boxes_3d": [[1, 2, 3]]}}, "boxes_3d of shape [1, 3] for 1 names"),
        ({"annos": {"names": ["Car"], "boxes_3d": [[1, 2], [3]]}}, "boxes_3d must be numbers in rows of one length"),
        ({"annos": {"names": ["Car"], "boxes_3d": [[0, 0, 0, 1, -1, 1, 0]]}}, "boxes_3d with a negative size"),
        ({"annos": {"names": ["Tram"], "boxes_3d": [[0, 0, 0, 1, 1, 1, 0]]}}, "names Tram; known are Car, Truck"),
    ],
)
def test_wrong_frames(root: Path, frame: dict[str, Any], text: str) -> None:
    edit(root, lambda content: content["frames"][1].update(frame))
    got = broken_text(root)
    assert got.startswith(f"{json_file(root)}: ") and text in got


@pytest.mark.parametrize(
    ("calibration", "text"),
    [
        ({"cam_to_velo": np.eye(3).tolist()}, "calib cam01: cam_to_velo must be 4 x 4 numbers, got [3, 3]"),
        ({"cam_to_velo": np.diag([1.0, 2, 1, 1]).tolist()}, "calib cam01: cam_to_velo must be a rigid transform"),
        ({"cam_to_velo": np.diag([1.0, 1, -1, 1]).tolist()}, "calib cam01: cam_to_velo must be a rigid transform"),
        ({"cam_intrinsic": [[1.0]]}, "calib cam01: cam_intrinsic must be 3 x 3 finite numbers, got [[1.]]"),
        ({"cam_intrinsic": np.zeros((3, 3)).tolist()}, "calib cam01: cam_intrinsic must have positive focal lengths"),
        ({"cam_intrinsic": np.diag([9.0, 9, 0]).tolist()}, "calib cam01: cam_intrinsic must have positive focal"),
        ({"cam_intrinsic": [[float("inf")] * 3] * 3}, "calib cam01: cam_intrinsic must be finite"),
        ({"distortion": [0.1] * 7}, "calib cam01: distortion must be (4, 5, 8) numbers, got 7"),
        ({"distortion": "none"}, "calib cam01: distortion must be numbers"),
    ],
)
def test_wrong_calibrations(root: Path, calibration: dict[str, Any], text: str) -> None:
    edit(root, lambda content: content["calib"]["cam01"].update(calibration))
    assert broken_text(root).startswith(f"{json_file(root)}: {text}")


def test_unknown_camera_and_missing_key(root: Path) -> None:
    edit(root, lambda content: content["calib"]["cam01"].pop("distortion"))
    assert broken_text(root) == f"{json_file(root)}: calib cam01 must have the key 'distortion', got none"
    edit(root, lambda content: content["calib"].update(cam02=content["calib"].pop("cam01")))
    assert broken_text(root).startswith(f"{json_file(root)}: calib must be of the cameras cam01, cam03")
    assert broken_text(root).endswith("got 'cam02'")


def test_absent_poses_and_annotations(root: Path) -> None:
    def change(content: Any) -> None:
        content["frames"][0]["pose"] = None
        del content["frames"][1]["pose"]
        content["frames"][2]["annos"] = {}

    edit(root, change)
    frames = OnceFrames(root)
    assert [frames.has_pose(index) for index in range(4)] == [False, False, True, False]
    assert frames.load(2).boxes is None
    np.testing.assert_array_equal(frames.load(1).T_world_from_lidar, np.eye(4))


def test_broken_scans_and_images(root: Path) -> None:
    scan = root / "data" / SEQUENCE / "lidar_roof" / f"{FIRST_MS}.bin"
    whole = scan.read_bytes()
    rule = "scan must hold whole points of 16 bytes (float32 x, y, z, intensity)"
    for content in (whole[:-7], b""):
        scan.write_bytes(content)
        assert broken_text(root) == f"{scan}: {rule}, got {len(content)} bytes: truncated?"
    points = np.frombuffer(whole, dtype=np.float32).reshape(-1, 4).copy()
    points[[30, 99], 0] = np.nan
    points.tofile(scan)
    count = f"2 of {len(points)} points, first in point 30"
    assert broken_text(root) == f"{scan}: points must be finite, got NaN or Inf in {count}"
    scan.unlink()
    assert broken_text(root) == f"{scan}: scan must exist, got no such file"
    scan.write_bytes(whole)

    image = root / "data" / SEQUENCE / "cam01" / f"{FIRST_MS}.jpg"
    whole = image.read_bytes()
    image.write_bytes(b"junk" * 100)
    assert broken_text(root).startswith(f"{image}: image file must be readable, got UnidentifiedImageError")
    Image.new("L", (WIDTH, HEIGHT)).save(image)
    assert broken_text(root) == f"{image}: image must have mode RGB, got L"
    # Only the header is read until pixels are asked for, undistorted or not.
    image.write_bytes(whole[:-200])
    for distortion in ([0.0] * 5, DISTORTION):
        edit(root, lambda content, d=distortion: content["calib"]["cam01"].update(distortion=d))  # type: ignore[misc]
        front = OnceFrames(root).load(0).cameras[0]
        with pytest.raises(FrameError, match=rf"{image}: image file must be readable, got OSError"):
            front.load_image()


# Broken records


def moved_camera(record: OnceRecord) -> OnceRecord:
    T = record.cameras[0].T_camera_from_lidar.copy()
    T[0, 3] += 0.1
    return replace(record, cameras=[replace(record.cameras[0], T_camera_from_lidar=T), record.cameras[1]])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda r: replace(r, points=r.points[:, :3]), r"points must be float32 of shape \[N > 0, 4\], got float32"),
        (lambda r: replace(r, points=r.points.astype(float)), r"points must be float32 .* got float64 \[201, 4\]"),
        (lambda r: replace(r, points=r.points[:0]), r"points must be float32 .* got float32 \[0, 4\]"),
        (lambda r: replace(r, points=r.points * np.float32(np.nan)), "points must be finite, got NaN or Inf"),
        (lambda r: replace(r, T_world_from_lidar=np.eye(4) * 2), "T_world_from_lidar must be a rigid transform"),
        (lambda r: replace(r, timestamp_ms=FIRST_MS), f"timestamp_ms must rise, got {FIRST_MS} before it"),
        (
            lambda r: replace(r, cameras=r.cameras[:1]),
            "cameras must be those of the first frame, .* got cam01",
        ),
        (
            lambda r: replace(r, cameras=[camera("CAM_FRONT", FRONT, 0)]),
            "cameras must be among .* got CAM_FRONT",
        ),
        (moved_camera, "cam01 must have one size and calibration in the whole sequence, got a difference of 0.1"),
        (
            lambda r: replace(r, boxes=Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1), ["Tram"])),
            "names of boxes must be among Car, .* got Tram",
        ),
        (
            lambda r: replace(r, cameras=[replace(c, image=None) for c in r.cameras]),
            "camera cam01: image must be given, got None",
        ),
    ],
)
def test_nothing_stays_of_a_sequence_with_a_broken_record(
    tmp_path: Path, change: Callable[[OnceRecord], OnceRecord], text: str
) -> None:
    first, second = records(2)
    with pytest.raises(ValueError, match=text) as caught:
        write_once(tmp_path, SEQUENCE, [first, change(second)])
    if not isinstance(caught.value, FrameError):
        assert str(caught.value).startswith(f"write_once: sequence {SEQUENCE}, frame ")
    assert list((tmp_path / "data").iterdir()) == []


def test_what_a_killed_writer_left_goes_away(tmp_path: Path) -> None:
    left = tmp_path / "data" / f".{SEQUENCE}.partial" / "lidar_roof"
    left.mkdir(parents=True)
    (left / "1.bin").write_bytes(b"half")
    write_once(tmp_path, SEQUENCE, records(1))
    assert [path.name for path in (tmp_path / "data").iterdir()] == [SEQUENCE]
    assert [path.name for path in (tmp_path / "data" / SEQUENCE / "lidar_roof").iterdir()] == [f"{FIRST_MS}.bin"]


def test_writer_arguments(root: Path) -> None:
    with pytest.raises(ValueError, match=rf"sequence must be new, got .*{SEQUENCE}, which exists"):
        write_once(root, SEQUENCE, records())
    with pytest.raises(ValueError, match="sequence must be made of letters, digits, _ and -, got '../x'"):
        write_once(root, "../x", records())
    with pytest.raises(ValueError, match="sequence other must have at least one record, got none"):
        write_once(root, "other", [])
    with pytest.raises(ValueError, match="train must name sequences of .*, got '000077'"):
        write_once_splits(root, {"val": [SEQUENCE], "train": ["000077"]})
    assert (root / "ImageSets" / "val.txt").read_text() == ""
    assert [path.name for path in (root / "data").iterdir()] == [SEQUENCE]


# pred data check


def check(root: Path, fast: bool = False) -> tuple[Report, str]:
    text = io.StringIO()
    return check_data(root, fast=fast, console=Console(file=text, width=1000)), text.getvalue()


@pytest.mark.parametrize("fast", [False, True])
def test_data_check_of_an_intact_tree(root: Path, fast: bool) -> None:
    report, text = check(root, fast)
    assert report.num_problems == 0
    assert "1 sequences, 4 frames, 3 annotated frames, 8 images, 3 boxes" in text
    assert "no problem in 12 files" in text and "note: 1 frames have no pose; they are placed at the origin" in text


@pytest.mark.parametrize("fast", [False, True])
def test_data_check_finds_all_damage(root: Path, fast: bool) -> None:
    write_labels(root)
    write_once(root, "000027", records(1))
    (root / "data" / "000027" / "000027.json").write_text("{")
    (root / "ImageSets" / "val.txt").write_text("000999\n")
    folder = root / "data" / SEQUENCE
    scans = [folder / "lidar_roof" / f"{FIRST_MS + 500 * number}.bin" for number in range(3)]
    scans[0].write_bytes(scans[0].read_bytes()[:-3])
    scans[1].unlink()
    points = np.fromfile(scans[2], dtype=np.float32)
    points[5] = np.inf
    points.tofile(scans[2])
    images = [folder / "cam01" / f"{FIRST_MS + 500 * number}.jpg" for number in range(3)]
    images[0].unlink()
    images[1].write_bytes(images[1].read_bytes()[:-200])
    label = root / "pseudo" / "made-up" / SEQUENCE / "cam09" / f"{FIRST_MS}.png"
    label.unlink()
    report, text = check(root, fast)
    behind_headers = [scans[2], images[1]]
    broken = [root / "data" / "000027" / "000027.json", root / "ImageSets" / "val.txt", *scans[:2], images[0], label]
    for path in [*broken, *([] if fast else behind_headers)]:
        assert f"{path}: " in text, path
    assert report.num_problems == (6 if fast else 8)


def test_data_check_finds_lenses_that_fold(root: Path) -> None:
    write_once(root, "000027", records(1))
    for name, camera_name in ((SEQUENCE, "cam09"), ("000027", "cam01")):
        path = root / "data" / name / f"{name}.json"
        content = json.loads(path.read_text())
        content["calib"]["cam01"]["distortion"] = DISTORTION
        content["calib"][camera_name]["distortion"] = [-30.0, 0, 0, 0, 0]
        path.write_text(json.dumps(content))
    # The size is that of the first image that can be read.
    (root / "data" / SEQUENCE / "cam09" / f"{FIRST_MS}.jpg").unlink()
    report, text = check(root, fast=True)
    assert report.num_problems == 2
    for name, camera_name in ((SEQUENCE, "cam09"), ("000027", "cam01")):
        assert f"{name}.json: calib {camera_name}: distortion must be one-to-one inside the image" in text
