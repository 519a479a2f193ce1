# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The official devkit on a written procedural drive; `test_nuscenes_writer` has the cases with known answers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pred import cli
from tests.data.official_evaluation import check_perturbed, evaluate, evaluate_true_lidarseg
from tests.data.test_nuscenes_writer import kill_at_random, table, tree

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
    check_perturbed(devkit, tmp_path, shift_m=0.05, before=known_velocity)


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


def test_lidarseg_statistics(devkit: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """The devkit counts, over all keyframes and for one, what the label files hold; their points are all labelled."""
    names = [row["name"] for row in sorted(devkit.category, key=lambda row: row["index"])]
    counts = {}
    for record in devkit.lidarseg:
        labels = np.fromfile(Path(devkit.dataroot) / record["filename"], np.uint8)
        points = devkit.get("sample_data", record["sample_data_token"])["filename"]
        assert len(labels) * 20 == (Path(devkit.dataroot) / points).stat().st_size
        counts[record["sample_data_token"]] = np.bincount(labels, minlength=len(names))
    assert len(counts) == len(devkit.sample)
    total = np.sum(list(counts.values()), axis=0)
    assert np.count_nonzero(total) > 12

    def printed() -> dict[str, int]:
        rows = re.findall(r"^ *(\d+) +(\S+) +n\S*= *([\d,]+)$", capsys.readouterr().out, re.MULTILINE)
        assert all(names[int(index)] == name for index, name, _ in rows)
        return {name: int(count.replace(",", "")) for _, name, count in rows}

    devkit.list_lidarseg_categories(sort_by="index")
    assert printed() == dict(zip(names, total, strict=True))
    sample = devkit.sample[0]
    devkit.get_sample_lidarseg_stats(sample["token"])
    own = counts[sample["data"]["LIDAR_TOP"]]
    assert printed() == {name: count for name, count in zip(names, own, strict=True) if count}


@pytest.mark.parametrize("split", ["all", "world_val"])
def test_lidarseg_evaluation(devkit: Any, split: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This evaluation knows the official splits only: it is told those of the world. (A world --as v1.0-mini needs
    no help: `test_nuscenes_writer`.)"""
    utils = pytest.importorskip("nuscenes.eval.lidarseg.utils")
    splits = json.loads((Path(devkit.table_root) / "splits.json").read_text())
    monkeypatch.setattr(utils, "create_splits_scenes", lambda verbose: splits)
    found = evaluate_true_lidarseg(devkit, split, tmp_path)
    assert found["miou"] == found["freq_weighted_iou"] == 1.0
    present = [name for name, iou in found["iou_per_class"].items() if not np.isnan(iou)]
    assert {"car", "pedestrian", "driveable_surface", "sidewalk", "manmade", "vegetation"} <= set(present)


def test_maps(root: Path, devkit: Any) -> None:
    """The car is on the drivable area in every keyframe, and a patch around it shows every layer of the town."""
    map_api = pytest.importorskip("nuscenes.map_expansion.map_api")
    num_keyframes = 0
    for scene in devkit.scene:
        log = devkit.get("log", scene["log_token"])
        town = map_api.NuScenesMap(str(root), log["location"])
        polygons = [town.extract_polygon(token) for row in town.drivable_area for token in row["polygon_tokens"]]
        assert polygons and all(polygon.is_valid and polygon.area > 0 for polygon in polygons)
        mask = devkit.get("map", log["map_token"])["mask"]
        for sample in devkit.sample:
            if sample["scene_token"] == scene["token"]:
                pose = devkit.get("ego_pose", devkit.get("sample_data", sample["data"]["LIDAR_TOP"])["ego_pose_token"])
                x, y = pose["translation"][:2]
                assert town.layers_on_point(x, y)["drivable_area"] != ""
                assert mask.is_on_mask(x, y).all()
                num_keyframes += 1
        layers = ["drivable_area", "road_segment", "lane", "ped_crossing", "walkway", "stop_line", "road_divider"]
        masks = town.get_map_mask((x, y, 400, 400), 0, layers, (400, 400))
        assert (masks.sum(axis=(1, 2)) > 0).all()
        assert sum(row["is_intersection"] for row in town.road_segment) == 16
    assert num_keyframes == len(devkit.sample) == 4
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
    kill_at_random(command, out=out, times=2, seed=seed)
    assert subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert tree(out) == tree(root)
