# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The official devkit on a written procedural drive; `test_nuscenes_writer` has the cases with known answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pred import cli
from tests.data.test_nuscenes_writer import evaluate, kill_at_random, table, tree

COMMAND = ["--scenes", "2", "--seed", "11", "--keyframes", "2", "--image-scale", "0.05", "--exact-labels"]

nuscenes = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world") / "world"
    assert cli.main(["world", "make", str(folder), *COMMAND, "--workers", "1"]) == 0
    return folder


@pytest.fixture(scope="module")
def devkit(root: Path) -> Any:
    return nuscenes.NuScenes("v1.0-world", str(root), verbose=False)


def known_velocity(box: dict[str, Any]) -> None:
    """A box without neighbour in time has no velocity. Its error does not count, but the devkit's running mean takes 0
    until the first one that does: such boxes come last."""
    if np.isnan(box["velocity"]).any():
        box["velocity"] = [0.0, 0.0]
        box["detection_score"] -= 0.5


def test_perfect_predictions(devkit: Any, tmp_path: Path) -> None:
    found = evaluate(devkit, "all", tmp_path, known_velocity)
    assert found["mean_ap"] == pytest.approx(1.0, abs=1e-6)
    assert found["nd_score"] == pytest.approx(1.0, abs=1e-6)
    assert all(error == pytest.approx(0.0, abs=1e-6) for error in found["tp_errors"].values())


def test_perturbed_predictions(devkit: Any, tmp_path: Path) -> None:
    """Small enough that no box comes nearer to another one's truth."""
    quaternion = pytest.importorskip("pyquaternion").Quaternion

    def change(box: dict[str, Any]) -> None:
        known_velocity(box)
        box["translation"][0] += 0.05
        box["size"] = [1.1 * side for side in box["size"]]
        box["rotation"] = (quaternion(axis=[0, 0, 1], radians=0.1) * quaternion(box["rotation"])).elements.tolist()
        box["velocity"][1] += 0.4

    found = evaluate(devkit, "all", tmp_path, change)
    assert found["mean_ap"] == pytest.approx(1.0, abs=1e-6)
    assert found["tp_errors"] == pytest.approx(
        {"trans_err": 0.05, "scale_err": 1 - 1.1**-3, "orient_err": 0.1, "vel_err": 0.4, "attr_err": 0.0}, abs=1e-6
    )


def test_counts_are_the_points_in_the_boxes(devkit: Any) -> None:
    """Counted by the devkit from the files; of those, most bear the label of the box's category."""
    geometry = pytest.importorskip("nuscenes.utils.geometry_utils")
    names = [row["name"] for row in sorted(devkit.category, key=lambda row: row["index"])]
    boxes_ = points_ = own = 0
    for sample in devkit.sample:
        path, boxes, _ = devkit.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = np.fromfile(path, np.float32).reshape(-1, 5)
        label_file = devkit.get("lidarseg", sample["data"]["LIDAR_TOP"])["filename"]
        labels = np.fromfile(Path(devkit.dataroot) / label_file, np.uint8)
        assert len(labels) == len(points)
        for box in boxes:
            inside = geometry.points_in_box(box, points[:, :3].T)
            assert devkit.get("sample_annotation", box.token)["num_lidar_pts"] == inside.sum()
            boxes_, points_ = boxes_ + 1, points_ + int(inside.sum())
            own += int((labels[inside] == names.index(box.name)).sum())
    assert boxes_ > 100 and own / points_ > 0.95


def test_maps(root: Path, devkit: Any) -> None:
    """The car stands on the drivable area, and a patch around it shows every layer of the town."""
    map_api = pytest.importorskip("nuscenes.map_expansion.map_api")
    for scene in devkit.scene:
        location = devkit.get("log", scene["log_token"])["location"]
        town = map_api.NuScenesMap(str(root), location)
        sample = devkit.get("sample", scene["first_sample_token"])
        pose = devkit.get("ego_pose", devkit.get("sample_data", sample["data"]["LIDAR_TOP"])["ego_pose_token"])
        x, y = pose["translation"][:2]
        assert town.layers_on_point(x, y)["drivable_area"] != ""
        layers = ["drivable_area", "road_segment", "lane", "ped_crossing", "walkway", "stop_line", "road_divider"]
        masks = town.get_map_mask((x, y, 400, 400), 0, layers, (400, 400))
        assert (masks.sum(axis=(1, 2)) > 0).all()
        assert sum(row["is_intersection"] for row in town.road_segment) == 16
    assert {row["is_intersection"] for row in town.road_segment} == {True, False}


def test_many_categories_are_annotated(root: Path) -> None:
    names = {row["token"]: row["name"] for row in table(root, "category")}
    found = {names[row["category_token"]] for row in table(root, "instance")}
    assert len(found) >= 12


@pytest.mark.parametrize("seed", [0, 1])
def test_killed_and_continued_with_two_workers(root: Path, tmp_path: Path, seed: int) -> None:
    """SIGKILL at random moments; the files are those of one process that ran to its end."""
    out = tmp_path / "world"
    command = [sys.executable, "-m", "pred", "world", "make", str(out), *COMMAND, "--workers", "2"]
    kill_at_random(command, begun=out / "sweeps", times=2, seed=seed)
    assert subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert tree(out) == tree(root)
