# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pred.data.batch import DataConfig, build_source
from pred.data.frame import CLASS_NAMES, FrameError
from pred.data.lidarseg import LIDARSEG_CLASSES, MERGED_CLASSES, MERGED_NAMES, merged_classes
from pred.data.nuscenes import NuScenesFrames
from pred.data.world.drive import CATEGORIES
from tests.data.tiny_tree import Tree, write_lidarseg, write_tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    tree = write_tree(tmp_path)
    write_lidarseg(tree)
    return tree


def test_every_official_name_has_a_class_or_none() -> None:
    assert tuple(LIDARSEG_CLASSES) == CATEGORIES
    named = {name for name in LIDARSEG_CLASSES.values() if name is not None}
    merged = merged_classes(np.array([CLASS_NAMES.index(name) for name in named]))
    # Each merged class can occur on the side of the points, and none of them twice.
    assert set(merged.tolist()) == set(range(len(MERGED_NAMES)))


def test_official_names_of_the_devkit() -> None:
    color_map = pytest.importorskip("nuscenes.utils.color_map")
    assert set(LIDARSEG_CLASSES) == set(color_map.get_colormap())


def test_merged_class_of_every_cityscapes_class() -> None:
    expected = {
        "road": "road", "sidewalk": "sidewalk", "building": "manmade", "wall": "manmade", "fence": "manmade",
        "pole": "manmade", "traffic light": "manmade", "traffic sign": "manmade", "vegetation": "vegetation",
        "terrain": "terrain", "sky": None, "person": "person", "rider": "cycle", "car": "car", "truck": "truck",
        "bus": "bus", "train": None, "motorcycle": "cycle", "bicycle": "cycle",
    }  # fmt: skip
    assert tuple(expected) == CLASS_NAMES
    for class_id, name in enumerate(CLASS_NAMES):
        merged = int(merged_classes(np.array([class_id]))[0])
        assert (None if merged < 0 else MERGED_NAMES[merged]) == expected[name]
    assert merged_classes(np.array([19, 255], dtype=np.uint8)).tolist() == [-1, -1]
    members = [name for names in MERGED_CLASSES.values() for name in names]
    assert len(members) == len(set(members)) == len(CLASS_NAMES) - 2


def test_points_get_the_class_of_their_byte(tree: Tree) -> None:
    frame = NuScenesFrames(tree.root, point_classes=True).load(1)
    assert frame.semantics is not None
    written = np.fromfile(tree.class_files[1], dtype=np.uint8)
    own = np.flatnonzero(frame.is_keyframe)
    # Returns of the own car were removed: the rows follow the points that are kept.
    assert 0 < len(own) < len(written)
    for row in own:
        name = LIDARSEG_CLASSES[CATEGORIES[written[frame.point_index[row]]]]
        assert frame.semantics[row] == (255 if name is None else CLASS_NAMES.index(name))
    assert (frame.semantics[~frame.is_keyframe] == 255).all()
    assert len(set(frame.semantics[own].tolist())) > 8


def test_training_reads_no_point_classes(tree: Tree) -> None:
    for path in tree.class_files:
        path.unlink()
    (tree.tables / "lidarseg.json").write_text("no JSON")
    config = DataConfig(dataset="nuscenes", root=str(tree.root))
    assert build_source(config).load(0).semantics is None
    with pytest.raises(FrameError, match=r"lidarseg\.json"):
        build_source(config, point_classes=True)


def test_without_the_table_there_are_no_classes(tmp_path: Path) -> None:
    tree = write_tree(tmp_path)
    assert NuScenesFrames(tree.root, point_classes=True).load(0).semantics is None


def test_damaged_classes_name_their_file(tree: Tree) -> None:
    source = NuScenesFrames(tree.root, point_classes=True)
    path = tree.class_files[0]
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(
        FrameError, match=rf"{path.name}: point classes must be one byte for each of {len(content)} poi"
    ):
        source.load(0)
    path.write_bytes(b"\xc8" + content[1:])
    with pytest.raises(FrameError, match=rf"{path.name}: point classes must be indices of category\.json, got 200"):
        source.load(0)
    path.unlink()
    with pytest.raises(FrameError, match=rf"{path.name}: point classes must exist, got no such file"):
        source.load(0)
    source.load(1)


def test_damaged_tables_name_the_row(tree: Tree) -> None:
    table = tree.tables / "lidarseg.json"
    rows = json.loads(table.read_text())

    def reading(changed: list[dict[str, str]]) -> NuScenesFrames:
        table.write_text(json.dumps(changed))
        return NuScenesFrames(tree.root, point_classes=True)

    with pytest.raises(FrameError, match=r"lidarseg\.json: sample_data_token must be in sample_data\.json, got nobody"):
        reading([*rows, {**rows[0], "sample_data_token": "nobody"}])
    with pytest.raises(FrameError, match=r"lidarseg\.json: row 1 must be well-formed, got '\.\./x'"):
        reading([{**rows[0], "filename": "../x"}])
    with pytest.raises(
        FrameError, match=r"lidarseg\.json: row 1 must have, and refer to, known keys, got no 'filename'"
    ):
        reading([{"sample_data_token": "x"}])
    with pytest.raises(FrameError, match=r"lidarseg\.json: table must have a row for samples/LIDAR_TOP"):
        reading(rows[:1]).load(1)
    table.write_text(json.dumps(rows))
    tree.edit("category", lambda categories: categories[3].update(name="vehicle.zeppelin"))
    with pytest.raises(FrameError, match=r"category\.json: names with an index must be .* got 'vehicle\.zeppelin'"):
        NuScenesFrames(tree.root, point_classes=True)
    tree.edit("category", lambda categories: categories[3].update(index=256))
    with pytest.raises(FrameError, match=r"category\.json: row 4 must be well-formed, got index 256"):
        NuScenesFrames(tree.root, point_classes=True)
