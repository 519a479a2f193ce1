# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""pred data check: an intact root passes; each kind of damage is counted and names its file; nothing stops it."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from pred import cli
from pred.data.frame import FrameError
from pred.data_check import Report, check_data, find_layout
from tests.data.own_tree import OwnTree, write_own_tree
from tests.data.tiny_tree import Tree, write_tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return write_tree(tmp_path)


def check(root: Path, fast: bool = False, labels: str | None = "auto") -> tuple[Report, str]:
    """The report and the text that was printed."""
    text = io.StringIO()
    return check_data(root, labels=labels, fast=fast, console=Console(file=text, width=1000)), text.getvalue()


def counts(report: Report) -> dict[str, int]:
    return {rule: problems.count for rule, problems in report.problems.items()}


@pytest.mark.parametrize("fast", [False, True])
def test_intact_nuscenes(tree: Tree, fast: bool) -> None:
    before = sorted(path for path in tree.root.rglob("*"))
    report, text = check(tree.root, fast)
    assert report.num_problems == 0 and not report.problems
    assert report.counts == {"scenes": 1, "frames": 2, "sweeps": 4, "images": 4, "boxes": 2}
    assert "no problem in 12 files" in text and "checking files 12/12" in text
    assert "1 scenes, 2 frames, 4 sweeps, 4 images, 2 boxes" in text
    assert sorted(path for path in tree.root.rglob("*")) == before


def damage_everything(tree: Tree) -> dict[Path, str]:
    """Each file that is broken, and a part of the rule that it breaks."""
    nan = np.fromfile(tree.keyframe_files[0], np.float32)
    nan[40] = np.nan
    nan.tofile(tree.keyframe_files[0])
    tree.sweep_files[0].write_bytes(tree.sweep_files[0].read_bytes()[:-3])
    tree.sweep_files[1].unlink()
    image = tree.images[0]["CAM_FRONT"]
    image.write_bytes(image.read_bytes()[:-60])
    tree.images[1]["CAM_BACK"].write_bytes(b"junk")
    tree.labels[0]["CAM_BACK"].write_bytes(tree.labels[0]["CAM_BACK"].read_bytes()[:-5])
    tree.labels[1]["CAM_FRONT"].unlink()
    (tree.tables / "splits.json").write_text('{"first": ["scene-x"]}')
    return {
        tree.keyframe_files[0]: "points must be finite",
        tree.sweep_files[0]: "sweep file must hold whole points",
        tree.sweep_files[1]: "sweep file must exist",
        image: "image file must be readable",
        tree.images[1]["CAM_BACK"]: "image file must be readable",
        tree.labels[0]["CAM_BACK"]: "label must be a readable .npy file",
        tree.labels[1]["CAM_FRONT"]: "label file must exist",
        tree.tables / "splits.json": "must name recordings that are there",
    }


def test_every_broken_file_is_named(tree: Tree) -> None:
    broken = damage_everything(tree)
    report, text = check(tree.root)
    assert report.num_problems == len(broken)
    for path, rule in broken.items():
        assert f"    {path}: {rule}" in text
    assert "8 problems in 12 files" in text


def test_fast_reads_headers_and_sizes_only(tree: Tree) -> None:
    broken = damage_everything(tree)
    tree.labels[0]["CAM_FRONT"].write_bytes(b"")
    report, text = check(tree.root, fast=True)
    # Damage behind a header and values stay unseen.
    hidden = {tree.keyframe_files[0], tree.images[0]["CAM_FRONT"], tree.labels[0]["CAM_BACK"]}
    for path, rule in broken.items():
        assert (f"    {path}: {rule}" in text) == (path not in hidden)
    assert f"{tree.labels[0]['CAM_FRONT']}: label must be a readable file, got an empty one" in text
    assert report.num_problems == len(broken) - len(hidden) + 1
    assert "(headers and sizes only)" in text


@pytest.mark.parametrize(
    ("table", "change", "rule", "number"),
    [
        ("sample_data", lambda rows: rows[1].update(sample_token="other"), "known keys", 1),
        ("ego_pose", lambda rows: rows[1].update(token="other"), "that sample_data refers to", 1),
        ("sample_data", lambda rows: [row.update(timestamp=7) for row in rows], "later than the one before it", 3),
        ("sample_annotation", lambda rows: [row.update(instance_token="x") for row in rows], "known keys", 2),
        ("sample_annotation", lambda rows: rows[0].update(sample_token="x"), "known keys", 1),
        ("sample_annotation", lambda rows: rows[0].update(size=[1, 2, -3]), "well-formed", 1),
        ("calibrated_sensor", lambda rows: rows[0].pop("rotation"), "known keys", 1 + 4),
        ("sample", lambda rows: rows.append(dict(rows[0])), "well-formed", 1),
        ("ego_pose", lambda rows: rows[0].update(rotation=[0, 0, 0, 0]), "well-formed", 1),
    ],
)
def test_broken_tables(tree: Tree, table: str, change: Callable[..., None], rule: str, number: int) -> None:
    tree.edit(table, change)
    report, text = check(tree.root)
    found = sum(count for name, count in counts(report).items() if rule in name)
    assert found == number and f"{table}.json: " in text


@pytest.mark.parametrize(
    ("change", "rule", "number"),
    [
        (lambda rows: rows[0].update(next="gone"), "must name a next that is in the table", 1),
        (lambda rows: [row.update(prev="gone") for row in rows[:3]], "must name a prev that is in the table", 3),
        (lambda rows: rows.append(dict(rows[0])), "must have a token of its own", 1),
        (
            lambda rows: rows.append({**next(row for row in rows if row["is_key_frame"]), "token": "another"}),
            "must be the only keyframe of its sample and channel",
            1,
        ),
    ],
)
def test_readings_among_each_other(
    tree: Tree, change: Callable[[list[dict[str, Any]]], Any], rule: str, number: int
) -> None:
    tree.edit("sample_data", change)
    report, text = check(tree.root, fast=True)
    found = {known: count for known, count in counts(report).items() if rule in known}
    assert list(found.values()) == [number], text
    assert f"{tree.tables / 'sample_data.json'}: row " in text


def test_a_sweep_whose_prev_is_of_another_scene(tmp_path: Path) -> None:
    tree = write_tree(tmp_path, scenes=("scene-a", "scene-b"))

    def change(rows: list[dict[str, Any]]) -> None:
        sweeps = [row for row in rows if row["calibrated_sensor_token"] == "calibrated-LIDAR_TOP"]
        assert len(sweeps) == 8 and sweeps[4]["prev"] == ""
        sweeps[4]["prev"] = sweeps[3]["token"]

    tree.edit("sample_data", change)
    report, _ = check(tree.root, fast=True)
    assert counts(report) == {"row … must have its prev in its own scene and channel": 1}


@pytest.mark.parametrize("table", ["sensor", "sample", "sample_data", "ego_pose", "category", "sample_annotation"])
def test_missing_tables(tree: Tree, table: str) -> None:
    path = tree.tables / f"{table}.json"
    whole = path.read_text()
    path.unlink()
    report, text = check(tree.root)
    assert counts(report)["table must exist"] == 1 and f"    {path}: table must exist, got no such file" in text
    path.write_text(whole[: len(whole) // 2])
    report, text = check(tree.root)
    assert any("valid JSON" in rule for rule in report.problems) and f"    {path}: table must be valid JSON" in text


def test_tables_that_only_the_devkit_needs(tree: Tree) -> None:
    (tree.tables / "log.json").unlink()
    report, text = check(tree.root)
    assert report.num_problems == 0 and "log.json is missing: only the official devkit needs it" in text


def test_without_labels_missing_images_are_a_note(tree: Tree) -> None:
    for images in tree.images:
        images["CAM_FRONT"].unlink()
    report, text = check(tree.root, labels="none")
    assert report.num_problems == 0
    assert "note: 2 x image is missing" in text and "note: no pseudo labels" in text
    report, text = check(tree.root, labels="elsewhere")
    assert "elsewhere: data.labels must be a folder" in text and report.num_problems == 1


def test_many_problems_are_counted_and_a_few_shown(tmp_path: Path) -> None:
    tree = write_tree(tmp_path, scenes=("scene-a", "scene-b", "scene-c"))
    for path in tree.sweep_files:
        path.unlink()
    report, text = check(tree.root)
    assert counts(report) == {"sweep file must exist": 6}
    assert "6 x sweep file must exist" in text and "    ... and 3 more" in text
    assert text.count("got no such file") == 3


@pytest.fixture
def own(tmp_path: Path) -> OwnTree:
    return write_own_tree(tmp_path)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd"])
def test_intact_folder(tmp_path: Path, suffix: str, fast: bool) -> None:
    tree = write_own_tree(tmp_path, suffix)
    report, text = check(tree.root, fast)
    assert report.num_problems == 0 and report.counts == {"drives": 2, "frames": 6, "images": 6}
    assert "no problem in 18 files" in text


def test_broken_folder(own: OwnTree) -> None:
    scans = own.drives[1] / "lidar"
    (scans / "000000.bin").unlink()
    (scans / "000001.bin").write_bytes(b"123")
    points = np.fromfile(scans / "000002.bin", np.float32)
    points[1] = np.inf
    points.tofile(scans / "000002.bin")
    points.tofile(scans / "000009.bin")
    (own.drives[1] / "front" / "000001.png").write_bytes(b"no image")
    poses = own.drives[0] / "poses.txt"
    poses.write_text(poses.read_text().replace("10.1", "9.0"))
    report, text = check(own.root)
    assert f"{poses}: line 3 must have a later time than 10.0, got 9.0" in text
    for name, rule in {
        "lidar/000000.bin": "scan must exist",
        "lidar/000001.bin": "scan must hold whole points of 20 bytes",
        "lidar/000002.bin": "points must be finite",
        "front/000001.png": "image file must be readable",
    }.items():
        assert f"{own.drives[1] / name}: {rule}" in text
    assert report.num_problems == 5
    assert f"note: 1 scans of {own.drives[1]} are not used: poses.txt has no line for them" in text


def test_layouts(tree: Tree, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert find_layout(tree.root) == "nuscenes"
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(FrameError, match=r"must hold nuScenes tables .* drives .* or ONCE's sequences .*, got none"):
        find_layout(empty)
    with pytest.raises(FrameError, match="gone: must be a folder"):
        find_layout(empty / "gone")
    (empty / "drive").mkdir()
    (empty / "drive" / "drive.yaml").touch()
    assert find_layout(empty) == "folder"


def test_command(tree: Tree, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["data", "check", str(tree.root), "--fast"]) == 0
    assert "no problem in 12 files" in capfd.readouterr().out
    assert cli.main(["data", "check", str(tree.root), "--version", "v1.0-other"]) == 1
    captured = capfd.readouterr()
    assert "v1.0-other/scene.json: table must exist" in captured.out
    tree.sweep_files[0].unlink()
    assert cli.main(["data", "check", str(tree.root)]) == 1
    captured = capfd.readouterr()
    assert f"{tree.sweep_files[0]}: sweep file must exist" in captured.out
    assert f"pred data: error: {tree.root} must be intact, got 1 problem" in captured.err
    assert cli.main(["data", "check", str(tree.root / "samples")]) == 1
    assert "must hold nuScenes tables" in capfd.readouterr().err
