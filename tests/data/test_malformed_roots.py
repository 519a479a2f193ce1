# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Each kind of damage in each layout: loading and ``pred data check`` both name the file, and nothing partial stays."""

from __future__ import annotations

import io
import json
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from pred.data.folder import FolderFrames
from pred.data.frame import FrameError, FrameSource
from pred.data.nuscenes import NuScenesFrames
from pred.data.once import OnceFrames
from pred.data.once_writer import write_once, write_once_splits
from pred.data_check import check_data
from tests.data.own_tree import write_own_tree
from tests.data.test_once import SEQUENCE, records, write_labels
from tests.data.tiny_tree import write_tree


@dataclass
class Root:
    """A small intact root, and what to damage in it.

    Attributes:
        root: its folder.
        open: reads it.
        table: a file that every frame needs.
        scan, image, label: files of the first frame.
        refer_to_nothing: puts a reference to something that is not there into a file; gives that file, and the one
            that the loader looks for.
    """

    root: Path
    open: Callable[[], FrameSource]
    table: Path
    scan: Path
    image: Path
    label: Path
    refer_to_nothing: Callable[[], tuple[Path, Path]]


def nuscenes_root(folder: Path) -> Root:
    tree = write_tree(folder)

    def refer() -> tuple[Path, Path]:
        tree.edit("sample_data", lambda rows: [row.update(ego_pose_token="gone") for row in rows])
        return (tree.tables / "ego_pose.json",) * 2

    return Root(
        folder,
        lambda: NuScenesFrames(folder),
        tree.tables / "sample_annotation.json",
        tree.keyframe_files[0],
        tree.images[0]["CAM_FRONT"],
        tree.labels[0]["CAM_FRONT"],
        refer,
    )


def once_root(folder: Path) -> Root:
    write_once(folder, SEQUENCE, records())
    write_once_splits(folder, {"train": [SEQUENCE]})
    write_labels(folder)
    first = str(records(1)[0].timestamp_ms)
    data = folder / "data" / SEQUENCE

    def refer() -> tuple[Path, Path]:
        split = folder / "ImageSets" / "train.txt"
        split.write_text("000999\n")
        return split, folder / "data" / "000999" / "000999.json"

    return Root(
        folder,
        lambda: OnceFrames(folder, split="train"),
        data / f"{SEQUENCE}.json",
        data / "lidar_roof" / f"{first}.bin",
        data / "cam01" / f"{first}.jpg",
        folder / "pseudo" / "made-up" / SEQUENCE / "cam01" / f"{first}.png",
        refer,
    )


def folder_root(folder: Path) -> Root:
    tree = write_own_tree(folder, drives=("drive-a",))
    picture = tree.drives[0] / "front" / "000000.png"
    image = picture.with_suffix(".jpg")
    Image.open(picture).save(image)
    picture.unlink()
    (folder / "splits.json").write_text('{"train": ["drive-a"]}')

    def refer() -> tuple[Path, Path]:
        (folder / "splits.json").write_text(json.dumps({"train": ["drive-z"]}))
        return folder / "splits.json", folder / "drive-z" / "drive.yaml"

    return Root(
        folder,
        lambda: FolderFrames(folder, split="train"),
        tree.drives[0] / "poses.txt",
        tree.drives[0] / "lidar" / "000000.bin",
        image,
        folder / "pseudo" / "made-up" / "drive-a" / "front" / "000000.png",
        refer,
    )


LAYOUTS = {"nuscenes": nuscenes_root, "once": once_root, "folder": folder_root}


@pytest.fixture(params=LAYOUTS)
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Root:
    return LAYOUTS[request.param](tmp_path / "root")


def load_everything(root: Root) -> None:
    frames = root.open()
    for index in range(len(frames)):
        for camera in frames.load(index).cameras:
            assert camera.labels is not None
            camera.load_image()
            camera.labels.class_map()


def assert_both_name(root: Root, checked: Path, loaded: Path | None = None) -> None:
    """Loading names one file, the check the other, and no unfinished file is left."""
    with pytest.raises(FrameError) as caught:
        load_everything(root)
    assert caught.value.path == str(loaded or checked)
    text = io.StringIO()
    report = check_data(root.root, console=Console(file=text, width=1000))
    assert report.num_problems >= 1 and f"    {checked}: " in text.getvalue()
    assert [path for path in root.root.rglob("*") if path.suffix == ".partial"] == []


def test_intact(made: Root) -> None:
    load_everything(made)
    assert check_data(made.root, console=Console(file=io.StringIO())).num_problems == 0


def test_missing_table(made: Root) -> None:
    made.table.unlink()
    assert_both_name(made, made.table)


def test_truncated_table(made: Root) -> None:
    made.table.write_bytes(made.table.read_bytes()[:-20])
    assert_both_name(made, made.table)


def test_dangling_reference(made: Root) -> None:
    assert_both_name(made, *made.refer_to_nothing())


@pytest.mark.parametrize("kept", [0, -5])
def test_truncated_scan(made: Root, kept: int) -> None:
    made.scan.write_bytes(made.scan.read_bytes()[:kept])
    assert_both_name(made, made.scan)


@pytest.mark.parametrize("part", ["header", "body"])
def test_corrupt_image(made: Root, part: str) -> None:
    content = made.image.read_bytes()
    made.image.write_bytes(b"junk" + content[4:] if part == "header" else content[: len(content) // 2])
    assert_both_name(made, made.image)


def test_unreadable_label(made: Root) -> None:
    made.label.write_bytes(b"no label at all")
    assert_both_name(made, made.label)


class _Hostile:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> Any:
        return os.system, (self.command,)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_hostile_pickle_as_a_label(made: Root, tmp_path: Path, suffix: str) -> None:
    made.label.unlink()
    label = made.label.with_suffix(suffix)
    array = np.array([_Hostile(f"touch {tmp_path / 'marker'}")], dtype=object)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if suffix == ".npy":
            np.save(label, array, allow_pickle=True)
        else:
            np.savez(label, probabilities=array)
    assert_both_name(made, label)
    assert not (tmp_path / "marker").exists()
