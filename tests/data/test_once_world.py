# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A drive written in the ONCE layout comes back as it was, and everything that reads ONCE takes it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pred import cli
from pred.data.frame import invert_rigid, transform_points
from pred.data.index import FILE_NAME
from pred.data.once import CAMERAS, OnceFrames
from pred.data.once_writer import NUSCENES_CLASSES
from pred.data.world import Drive
from pred.data.world.annotation import annotated_keyframes, candidates
from pred.data.world.drive import NOISE
from pred.data.world.nuscenes_writer import WorldSettings
from pred.data.world.once_layout import ONCE_MOUNTS, once_splits
from pred.data.world.sensors import T_EGO_FROM_LIDAR, mounted_camera
from pred.world import make_world
from tests.data.test_nuscenes_writer import kill_at_random, tree

SEED, KEYFRAMES, WIDTH, HEIGHT = 3, 2, 96, 51
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
COMMAND = ["--layout", "once", "--scenes", "2", "--seed", "3", "--keyframes", "2", "--image-scale", "0.05"]
NOT_EGO = (0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("once") / "world"
    assert cli.main(["world", "make", str(folder), *COMMAND, "--exact-labels", "--workers", "1"]) == 0
    return folder


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive(SEED, 0, KEYFRAMES)


def test_points_poses_and_boxes_come_back(root: Path, drive: Drive) -> None:
    frames = OnceFrames(root, split="train", ego_box=NOT_EGO)
    assert len(frames) == KEYFRAMES
    T_world_from_once = [drive.T_world_from_ego(int(time_us)) @ T_EGO_FROM_LIDAR @ HALF_TURN
                         for time_us in drive.keyframe_us]  # fmt: skip
    assert np.linalg.norm(T_world_from_once[1][:2, 3] - T_world_from_once[0][:2, 3]) > 1.0
    sweeps = [drive.scan(int(time_us)) for time_us in drive.keyframe_us]
    T_lidar_from_world = [HALF_TURN @ invert_rigid(T_world) for T_world in T_world_from_once]
    found = [
        candidates(drive.actors, int(time_us), T_lidar, sweep.points)
        for time_us, T_lidar, sweep in zip(drive.keyframe_us, T_lidar_from_world, sweeps, strict=True)
    ]
    annotated = annotated_keyframes([{c.actor.instance: c.num_points for c in keyframe} for keyframe in found])
    for number in range(KEYFRAMES):
        frame = frames.load(number)
        assert frames.frame_id(number) == str(drive.keyframe_us[number] // 1000)
        expected = sweeps[number].points[sweeps[number].category != NOISE]
        np.testing.assert_allclose(frame.points[:, :3], expected[:, :3] * [-1, -1, 1], atol=1e-4)
        np.testing.assert_array_equal(frame.points[:, 3], expected[:, 3])
        T_first_from_lidar = invert_rigid(T_world_from_once[0]) @ T_world_from_once[number]
        np.testing.assert_allclose(frame.T_world_from_lidar, T_first_from_lidar, atol=1e-4)

        actors = [
            candidate.actor
            for candidate in found[number]
            if number in annotated.get(candidate.actor.instance, ()) and candidate.actor.category in NUSCENES_CLASSES
        ]
        assert frame.boxes is not None and len(frame.boxes) == len(actors) > 10
        assert frame.boxes.names == [NUSCENES_CLASSES[actor.category] for actor in actors]
        for row, actor in enumerate(actors):
            T = invert_rigid(T_world_from_once[number]) @ actor.pose(int(drive.keyframe_us[number]))
            np.testing.assert_allclose(frame.boxes.centre_m[row], T[:3, 3], atol=1e-4)
            np.testing.assert_allclose(frame.boxes.size_m[row], actor.size_lwh_m, atol=1e-4)
            yaw_rad = frame.boxes.yaw_rad[row]
            np.testing.assert_allclose([np.cos(yaw_rad), np.sin(yaw_rad)], T[:2, 0], atol=1e-4)


def test_still_objects_stand_still_in_the_world(root: Path) -> None:
    """What both frames call a parked car or a person at rest is at one place, by the poses in the files."""
    first, second = (OnceFrames(root, split="train").load(number) for number in range(KEYFRAMES))
    assert first.boxes is not None and second.boxes is not None
    before = transform_points(first.T_world_from_lidar, first.boxes.centre_m)
    after = transform_points(second.T_world_from_lidar, second.boxes.centre_m)
    nearest_m = np.linalg.norm(before[:, None] - after[None], axis=2).min(axis=1)
    assert (nearest_m < 1e-4).sum() > 5


def test_cameras_and_labels(root: Path, drive: Drive) -> None:
    frame = OnceFrames(root, split="train").load(1)
    time_us = int(drive.keyframe_us[1])
    assert [camera.name for camera in frame.cameras] == [mount.name for mount in ONCE_MOUNTS] == list(CAMERAS)
    for camera, mount in zip(frame.cameras, ONCE_MOUNTS, strict=True):
        expected = mounted_camera(mount, WIDTH, HEIGHT)
        np.testing.assert_allclose(camera.intrinsics, expected.intrinsics, atol=1e-9)
        np.testing.assert_allclose(camera.T_camera_from_lidar, expected.T_camera_from_lidar @ HALF_TURN, atol=1e-9)
        view = drive.view(mount, time_us, WIDTH, HEIGHT)
        assert np.abs(camera.load_image().astype(int) - view.image).mean() < 8  # JPEG
        assert camera.labels is not None
        np.testing.assert_array_equal(camera.labels.class_map(), view.class_id)
        with Image.open(root / f"depth/exact/000000/{mount.name}/{time_us // 1000}.png") as depth:
            np.testing.assert_allclose(
                np.asarray(depth) / 256.0, np.where(view.depth_m <= 255, view.depth_m, 0), atol=1 / 256
            )


def test_cameras_look_all_around() -> None:
    """ONCE's directions, and no gap between neighbours."""
    azimuths_deg = np.arange(360)
    seen = np.zeros(360, dtype=np.bool_)
    for mount in ONCE_MOUNTS:
        camera = mounted_camera(mount, WIDTH, HEIGHT)
        far = 1000.0 * np.stack(
            [np.sin(-np.deg2rad(azimuths_deg)), np.cos(np.deg2rad(azimuths_deg)), 0 * azimuths_deg], axis=1
        )
        seen |= camera.in_image(*camera.project(far))
    assert seen.all()


def test_tree(root: Path) -> None:
    assert {path.name for path in root.iterdir()} >= {"world.json", "data", "ImageSets", "pseudo", "depth"}
    lists = {path.stem: path.read_text().split() for path in (root / "ImageSets").iterdir()}
    assert lists == {
        "train": ["000000"], "val": ["000001"], "test": [],
        "raw_small": ["000000"], "raw_medium": ["000000"], "raw_large": ["000000"],
    }  # fmt: skip
    splits = once_splits(12)
    assert [len(splits[name]) for name in ("train", "test", "val")] == [8, 2, 2]
    assert once_splits(1)["train"] == ["000000"] and once_splits(1)["val"] == []


def test_data_check(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["data", "check", str(root)]) == 0
    assert "no problem" in capsys.readouterr().out


def test_evaluation_of_the_own_boxes(root: Path, tmp_path: Path) -> None:
    frames = OnceFrames(root, split="train")
    predictions: list[dict[str, Any]] = []
    for number in range(len(frames)):
        annotation = frames.annotation(number)
        assert annotation is not None
        names, boxes = annotation
        predictions.append(
            {
                "frame_id": frames.frame_id(number),
                "name": names,
                "score": [0.9] * len(names),
                "boxes_3d": boxes.tolist(),
            }
        )
    (tmp_path / "own.json").write_text(json.dumps(predictions))
    command = ["evaluate", "once", str(tmp_path / "own.json"), "--truth", str(root), "--split", "train"]
    assert cli.main(command) == 0
    result = json.loads((tmp_path / "own_ap.json").read_text())
    counts = result["true_boxes"]
    assert sum(count > 0 for count in counts.values()) >= 6
    for name, count in counts.items():
        assert result["ap"][f"AP_{name}"] == pytest.approx(100.0 if count else 0.0), name


def test_pretraining(root: Path, tmp_path: Path) -> None:
    sizes = [
        "--data.batch_size", "1", "--data.workers", "0", "--data.depth_rays", "48",
        "--data.semantic_rays_per_camera", "8",
        "--encoder.pillars.pillar_size", "[1.6, 1.6]", "--encoder.pillars.vfe_filters", "[8]", "--encoder.backbone_2d",
        "{layer_nums: [1], layer_strides: [1], num_filters: [8], upsample_strides: [1], num_upsample_filters: [8]}",
        "--field.hidden", "16", "--renderer.coarse_samples", "8",
        "--renderer.fine_samples", "8", "--train.epochs", "1.5", "--train.log_every", "1", "--train.accelerator", "cpu",
    ]  # fmt: skip
    run = tmp_path / "run"
    assert cli.main(["pretrain", "--config", "once_pillars", "--run", str(run), "--data.root", str(root), *sizes]) == 0
    assert (run / "encoder.pth").is_file() and len((run / "log.csv").read_text().splitlines()) == 4


def test_every_fifth_frame_is_not_annotated(tmp_path: Path) -> None:
    make_world(tmp_path, WorldSettings(scenes=1, keyframes=6, image_scale=0.02, layout="once"), workers=1)
    frames = OnceFrames(tmp_path)
    assert [frames.annotation(number) is None for number in range(6)] == [False] * 4 + [True, False]


def test_killed_and_continued_with_two_workers(root: Path, tmp_path: Path) -> None:
    """SIGKILL at random moments; the files are those of one process that ran to its end."""
    out = tmp_path / "world"
    command = [sys.executable, "-m", "pred", "world", "make", str(out), *COMMAND, "--exact-labels", "--workers", "2"]
    kill_at_random(command, out=out, times=3, seed=5)
    settings = WorldSettings(2, SEED, KEYFRAMES, 0.05, layout="once", exact_labels=True)
    make_world(out, settings, workers=2)
    assert made_files(out) == made_files(root)


def made_files(root: Path) -> dict[str, str]:
    """Digests, without the index that a reader keeps beside the data."""
    return {name: digest for name, digest in tree(root).items() if Path(name).name != FILE_NAME}


def test_settings() -> None:
    with pytest.raises(ValueError, match="layout once must have no version and no images of sweeps, got v1.0-mini"):
        WorldSettings(scenes=10, layout="once", version="v1.0-mini")
    with pytest.raises(ValueError, match="no images of sweeps, got images of sweeps"):
        WorldSettings(scenes=1, layout="once", sweep_images=True)
    with pytest.raises(ValueError, match="layout must be nuscenes or once, got 'kitti'"):
        WorldSettings(scenes=1, layout="kitti")
    assert WorldSettings(scenes=200, layout="once").image_size == (480, 255)
