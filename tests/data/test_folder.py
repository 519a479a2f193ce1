# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The reader of own drives, on a written tree with known answers and on broken ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pred.data.batch import DataConfig, TrainingBatches, build_source
from pred.data.folder import FolderFrames, check_scan_header, read_poses, read_scan
from pred.data.frame import Frame, FrameError
from tests.data.own_tree import (
    INTRINSICS,
    NUM_LANDMARKS,
    NUM_SCANS,
    PERIOD_S,
    T_CAMERA_FROM_LIDAR,
    OwnTree,
    write_own_tree,
    write_scan,
)

COLUMNS = ["x", "y", "z", "ring", "intensity"]


@pytest.fixture
def tree(tmp_path: Path) -> OwnTree:
    return write_own_tree(tmp_path)


def in_lidar(pose: np.ndarray, xyz_world: np.ndarray) -> np.ndarray:
    return (np.linalg.inv(pose) @ np.column_stack([xyz_world, np.ones(len(xyz_world))]).T).T[:, :3]


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd"])
def test_frames(tmp_path: Path, suffix: str) -> None:
    tree = write_own_tree(tmp_path, suffix)
    frames = FolderFrames(tree.root)
    assert len(frames) == 2 * NUM_SCANS
    names = [frames.token(index) for index in range(len(frames))]
    assert names == [f"drive-{drive}/{scan:06d}" for drive in "ab" for scan in range(NUM_SCANS)]
    for index in range(len(frames)):
        frame = frames.load(index)
        scan = index % NUM_SCANS
        assert frame.token == names[index] and frame.source.endswith(f"{names[index][:7]}/lidar/{scan:06d}{suffix}")
        assert np.array_equal(frame.T_world_from_lidar, tree.poses[scan])
        # The car does not see itself: landmarks are 5 m away or more.
        assert frame.points.shape == ((scan + 1) * NUM_LANDMARKS, 5)
        expected = in_lidar(tree.poses[scan], tree.landmarks_world)
        for sweep in range(scan + 1):
            rows = slice(sweep * NUM_LANDMARKS, (sweep + 1) * NUM_LANDMARKS)
            np.testing.assert_allclose(frame.points[rows, :3], expected, atol=1e-5)
            assert np.array_equal(frame.points[rows, 3], tree.intensity)
            np.testing.assert_allclose(frame.points[rows, 4], PERIOD_S * sweep, atol=1e-6)
            if sweep:
                assert frame.earlier_keyframes[f"{names[index][:7]}/{scan - sweep:06d}"] == rows
        assert frame.is_keyframe.tolist() == [True] * NUM_LANDMARKS + [False] * scan * NUM_LANDMARKS
        assert frame.point_index.tolist() == list(range(NUM_LANDMARKS)) * (scan + 1)
        (camera,) = frame.cameras
        assert camera.name == "front" and camera.intrinsics.tolist() == INTRINSICS
        assert camera.T_camera_from_lidar.tolist() == T_CAMERA_FROM_LIDAR
        assert camera.load_image().shape == (36, 64, 3)
        assert camera.labels is not None and camera.labels.class_map().shape == (36, 64)


def test_a_point_ahead_is_in_the_middle_of_the_picture(tree: OwnTree) -> None:
    camera = FolderFrames(tree.root).load(0).cameras[0]
    uv, depth_m = camera.project(np.array([[10.3, 0.1, -0.2]]))
    np.testing.assert_allclose(uv, [[32.0, 18.0]], atol=1e-12)
    np.testing.assert_allclose(depth_m, [10.0])


def test_own_car_is_removed(tree: OwnTree) -> None:
    path = tree.drives[0] / "lidar" / "000000.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 5)
    points[5, :2] = [1.5, 0.0]
    write_scan(path, points)
    frame = FolderFrames(tree.root, ego_box=(-1, -1, 2, 1)).load(0)
    assert frame.point_index.tolist() == [*range(5), *range(6, NUM_LANDMARKS)]


def test_splits(tree: OwnTree) -> None:
    frames = FolderFrames(tree.root, split="train")
    assert len(frames) == NUM_SCANS and frames.token(0) == "drive-b/000000"
    with pytest.raises(ValueError, match=r"data\.split must be one of train, none in .*splits\.json, got 'val'"):
        FolderFrames(tree.root, split="val")
    with pytest.raises(ValueError, match=r"data\.split must select drives of .*, got none: none"):
        FolderFrames(tree.root, split="none")
    (tree.root / "splits.json").write_text('{"train": ["drive-z"], "odd": 3}')
    with pytest.raises(FrameError, match=r"splits\.json: must map split names to lists"):
        FolderFrames(tree.root, split="train")
    (tree.root / "splits.json").write_text('{"train": ["../elsewhere"]}')
    with pytest.raises(FrameError, match=r"splits\.json: drives must be folders of .*, got '\.\./elsewhere'"):
        FolderFrames(tree.root, split="train")
    (tree.root / "splits.json").write_text('{"train": ["drive-z"]}')
    with pytest.raises(FrameError, match=r"drive-z/drive\.yaml: description must exist"):
        FolderFrames(tree.root, split="train")


def test_roots(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"data\.root must hold drives, folders with a drive\.yaml, got none"):
        FolderFrames(tmp_path)
    with pytest.raises(FrameError, match=r"gone: data\.root must be a folder"):
        FolderFrames(tmp_path / "gone")


def test_index_outside(tree: OwnTree) -> None:
    frames = FolderFrames(tree.root)
    for index in (-1, 2 * NUM_SCANS):
        with pytest.raises(IndexError, match=r"index must be in \[0, 6\)"):
            frames.load(index)


def test_images_and_labels(tree: OwnTree) -> None:
    image = tree.drives[0] / "front" / "000000.png"
    Image.open(image).save(image.with_suffix(".jpg"))
    image.unlink()
    assert FolderFrames(tree.root).load(0).cameras[0].image == image.with_suffix(".jpg")
    image.with_suffix(".jpg").unlink()
    with pytest.raises(FrameError, match=r"front/000000\.jpg: image file must exist"):
        FolderFrames(tree.root).load(0)
    assert FolderFrames(tree.root, labels="none").load(0).cameras[0].image is None
    Image.new("RGB", (32, 18)).save(image)
    with pytest.raises(FrameError, match=r"000000\.png: image must be RGB of 64 x 36 pixels, got RGB of 32 x 18"):
        FolderFrames(tree.root).load(0)
    (tree.root / "pseudo" / "made-up" / "drive-a" / "front" / "000001.png").unlink()
    with pytest.raises(FrameError, match=r"drive-a/front/000001\.png: label file must exist"):
        FolderFrames(tree.root).load(1)


def test_without_cameras(tree: OwnTree) -> None:
    tree.describe(0, cameras=None)
    assert FolderFrames(tree.root, labels="none").load(0).cameras == []


def test_data_configuration(tree: OwnTree) -> None:
    config = DataConfig(dataset="folder", root=str(tree.root), batch_size=2, workers=0, depth_rays=8, sweeps=2)
    source = build_source(config)
    assert isinstance(source, FolderFrames) and source.sweeps == 2
    batch = TrainingBatches(config, (-40, -40, -5, 40, 40, 5), seed=0, total_steps=2)[1]
    assert batch.semantic is not None and batch.depth.valid.any()
    with pytest.raises(ValueError, match=r"data\.info must be left out for data\.dataset folder, got 'x'"):
        DataConfig(dataset="folder", root="r", info="x")
    with pytest.raises(ValueError, match=r"data\.root must name a folder, got an empty string"):
        DataConfig(dataset="folder", root="")


# Broken files


def broken_text(tree: OwnTree, index: int = 0) -> str:
    with pytest.raises(FrameError) as caught:
        FolderFrames(tree.root).load(index)
    return str(caught.value)


POSE = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "pose file must hold a line per scan, got none"),
        ("# nothing\n\n", "pose file must hold a line per scan, got none"),
        (f"a 0 {POSE}\nb 1 2 3", r"line 2 must hold a stem and 13 numbers \(time, 3 x 4 matrix\), got 4 words"),
        (f"a 0 {POSE[:-1]}x", "line 1 must hold a stem and 13 numbers, got could not convert string to float: 'x'"),
        (f"a nan {POSE}", "line 1 must hold finite numbers, got NaN or Inf"),
        (f"a/b 0 {POSE}", "line 1 must start with the stem of a file name, got a/b"),
        (f"a 0 {POSE}\na 1 {POSE}", "line 2 must name another scan than the lines before, got a again"),
        (f"a 1 {POSE}\n#\nb 1 {POSE}", r"line 3 must have a later time than 1\.0, got 1\.0"),
        (f"a 0 2{POSE[1:]}", "line 1 must hold a rotation in its first three columns, got R Rᵀ off the identity by 3"),
        (f"a 0 -{POSE}", "line 1 must hold a rotation in its first three columns, got a mirror image"),
    ],
)
def test_poses(tree: OwnTree, text: str, message: str) -> None:
    (tree.drives[0] / "poses.txt").write_text(text)
    with pytest.raises(FrameError, match=rf"drive-a/poses\.txt: {message}"):
        FolderFrames(tree.root)


def test_pose_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"poses\.txt: pose file must exist, got no such file"):
        read_poses(tmp_path / "poses.txt")
    (tmp_path / "poses.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(FrameError, match=r"poses\.txt: pose file must be readable, got 'utf-8' codec"):
        read_poses(tmp_path / "poses.txt")


CAMERA = {"width": 64, "height": 36, "intrinsics": INTRINSICS, "T_camera_from_lidar": T_CAMERA_FROM_LIDAR}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scans": None}, "must have scans, got cameras"),
        ({"camera": {}}, "unknown key camera; did you mean cameras?"),
        ({"scans": [1]}, "scans: must be a mapping, got list"),
        ({"scans": {"columns": []}}, "scans: must have suffix, got columns"),
        ({"scans": {"suffix": ".las"}}, r"scans: suffix must be one of .bin, .npy, .pcd, got .las"),
        ({"scans": {"suffix": ".bin"}}, r"scans: columns must hold x, y, z and perhaps intensity, each once, got \[\]"),
        ({"scans": {"suffix": ".bin", "columns": ["x", "y", "z", "x"]}}, "scans: columns must hold x, y, z"),
        ({"scans": {"suffix": ".pcd", "columns": ["x"]}}, "scans: columns must not be given for .pcd files"),
        ({"cameras": {"front": CAMERA | {"width": 0}}}, "cameras: front: width must be a positive whole number, got 0"),
        ({"cameras": {"front": CAMERA | {"fov": 0}}}, "cameras: front: unknown key fov"),
        ({"cameras": {"..": CAMERA}}, r"cameras: \.\.: name must be that of a folder in the drive"),
        ({"cameras": {"front": CAMERA | {"intrinsics": [[0] * 3] * 3}}}, "intrinsics must have positive focal lengths"),
        ({"cameras": {"../x": CAMERA}}, r"cameras: \.\./x: name must be that of a folder in the drive"),
        ({"cameras": {"front": CAMERA | {"intrinsics": [[1]]}}}, "cameras: front: intrinsics must be 3 x 3 finite"),
        (
            {"cameras": {"front": CAMERA | {"T_camera_from_lidar": [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}}},
            "cameras: front: T_camera_from_lidar must hold a rotation .* off the identity by 3",
        ),
        ({"cameras": [1]}, "object has no attribute 'items'"),
    ],
)
def test_descriptions(tree: OwnTree, changes: dict[str, Any], message: str) -> None:
    tree.describe(0, **changes)
    with pytest.raises(FrameError, match=rf"drive-a/drive\.yaml: .*{message}"):
        FolderFrames(tree.root)


@pytest.mark.parametrize(
    ("text", "message"), [("a: [", "readable YAML"), ("- 1", "mapping, got list"), ("", "NoneType")]
)
def test_descriptions_that_are_none(tree: OwnTree, text: str, message: str) -> None:
    (tree.drives[0] / "drive.yaml").write_text(text)
    with pytest.raises(FrameError, match=rf"drive-a/drive\.yaml: description must be .*{message}"):
        FolderFrames(tree.root)


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd"])
def test_truncated_and_missing_scans(tmp_path: Path, suffix: str) -> None:
    tree = write_own_tree(tmp_path, suffix)
    path = tree.drives[0] / "lidar" / f"000000{suffix}"
    columns = [] if suffix == ".pcd" else COLUMNS
    check_scan_header(path, columns)
    path.write_bytes(path.read_bytes()[:-7])
    expected = {
        ".bin": "scan must hold whole points of 20 bytes (float32 x, y, z, ring, intensity), got 1193 bytes",
        ".npy": "scan must be a readable .npy file, got ValueError",
        ".pcd": ".pcd file must hold 1200 bytes of points, got 1193: truncated?",
    }[suffix]
    assert broken_text(tree).startswith(f"{path}: {expected}")
    with pytest.raises(FrameError) as caught:
        check_scan_header(path, columns)
    assert str(caught.value).startswith(f"{path}: {expected}")
    path.unlink()
    assert broken_text(tree) == f"{path}: scan must exist, got no such file"
    with pytest.raises(FrameError, match="scan must exist, got no such file"):
        check_scan_header(path, columns)


def test_values_of_scans(tree: OwnTree) -> None:
    path = tree.drives[0] / "lidar" / "000000.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 5)
    points[[3, 8], 0] = np.nan
    write_scan(path, points)
    assert broken_text(tree) == f"{path}: points must be finite, got NaN or Inf in 2 of 60 points, first in point 3"
    # Of .pcd files it means "no return", except where the intensity alone is NaN.
    pcd = path.with_suffix(".pcd")
    write_scan(pcd, points)
    assert len(read_scan(pcd, [])) == NUM_LANDMARKS - 2
    points[4, 4] = np.nan
    write_scan(pcd, points)
    with pytest.raises(FrameError, match="got NaN or Inf in 1 of 58 points, first in point 3"):
        read_scan(pcd, [])
    write_scan(pcd, np.full((2, 5), np.nan, np.float32))
    with pytest.raises(FrameError, match="scan must hold points, got none"):
        read_scan(pcd, [])


def test_npy_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "scan.npy"
    for values in (np.zeros((3, 4), np.float32), np.zeros((3, 5), np.int32), np.zeros(5), np.array([{}], dtype=object)):
        np.save(path, values, allow_pickle=True)
        with pytest.raises(FrameError, match=r"scan\.npy: scan must (hold floats of shape \[N, 5\]|be a readable)"):
            read_scan(path, COLUMNS)
    np.save(path, np.ones((3, 5), np.float64))
    assert read_scan(path, COLUMNS).dtype == np.float32


def test_without_intensity(tmp_path: Path) -> None:
    path = tmp_path / "scan.bin"
    np.arange(6, dtype=np.float32).tofile(path)
    assert read_scan(path, ["z", "y", "x"]).tolist() == [[2, 1, 0, 0], [5, 4, 3, 0]]


def test_loading_twice_gives_the_same(tree: OwnTree) -> None:
    def content(frame: Frame) -> list[Any]:
        return [frame.token, frame.points.tobytes(), frame.point_index.tobytes(), frame.earlier_keyframes]

    assert content(FolderFrames(tree.root).load(2)) == content(FolderFrames(tree.root).load(2))
