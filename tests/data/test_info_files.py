# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Info files of other frameworks select frames; pickles that want more than plain values are refused."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pred.data.batch import DataConfig, build_source
from pred.data.frame import FrameError
from pred.data.info_files import _unpickle, load_info
from pred.data.nuscenes import NuScenesFrames
from tests.data.tiny_tree import Tree, write_tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return write_tree(tmp_path / "root", keyframes=3)


def save(path: Path, content: Any, protocol: int = pickle.DEFAULT_PROTOCOL) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def boxes_of(tree: Tree, frame: int) -> np.ndarray:
    boxes = NuScenesFrames(tree.root).load(frame).boxes
    assert boxes is not None
    return np.column_stack([boxes.centre_m, boxes.size_m, boxes.yaw_rad]).astype(np.float32)


def infos(tree: Tree, form: str, frames: list[int]) -> Any:
    """As the three frameworks' converters write them, less what is not looked at."""
    tokens = [tree.tokens[frame] for frame in frames]
    if form == "openpcdet":
        return [
            {
                "lidar_path": "samples/LIDAR_TOP/x.bin",
                "token": token,
                "sweeps": [{"time_lag": np.float64(0.05), "transform_matrix": np.eye(4)}],
                "gt_boxes": np.column_stack([boxes_of(tree, frame), np.full((1, 2), np.nan)]),
                "gt_names": np.array(["car"]),
                "num_lidar_pts": np.array([5]),
            }
            for frame, token in zip(frames, tokens, strict=True)
        ]
    if form == "mmdet3d":
        data = [
            {
                "sample_idx": number,
                "token": token,
                "timestamp": 1.5e9,
                "lidar_points": {"lidar_path": "x.bin", "lidar2ego": np.eye(4).tolist()},
                "instances": [{"bbox_3d": box.tolist(), "bbox_label_3d": 0} for box in boxes_of(tree, frame)],
            }
            for number, (frame, token) in enumerate(zip(frames, tokens, strict=True))
        ]
        return {"metainfo": {"dataset": "nuscenes", "info_version": "1.1"}, "data_list": data}
    data = [
        {
            "token": token,
            "gt_boxes": boxes_of(tree, frame)[:, [0, 1, 2, 4, 3, 5, 6]].astype(np.float64),
            "gt_names": np.array(["car"]),
            "valid_flag": np.array([True]),
        }
        for frame, token in zip(frames, tokens, strict=True)
    ]
    return {"metadata": {"version": "v1.0-test"}, "infos": data}


@pytest.mark.parametrize("form", ["openpcdet", "mmdet3d", "older"])
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_samples_and_their_order(tree: Tree, tmp_path: Path, form: str, protocol: int) -> None:
    path = save(tmp_path / "infos.pkl", infos(tree, form, [2, 0]), protocol)
    loaded = load_info(path)
    assert [info.token for info in loaded] == [tree.tokens[2], tree.tokens[0]]
    for info, frame in zip(loaded, (2, 0), strict=True):
        assert info.centres_m is not None
        np.testing.assert_allclose(info.centres_m, boxes_of(tree, frame)[:, :3], atol=1e-6)
    frames = build_source(DataConfig(root=str(tree.root), info=str(path)))
    assert [frames.token(index) for index in range(len(frames))] == [tree.tokens[2], tree.tokens[0]]
    # The sweeps before it still come from frames that are not listed.
    assert set(frames.load(0).earlier_keyframes) == set(tree.tokens[:2])


def test_written_with_numpy_1(tree: Tree, tmp_path: Path) -> None:
    path = save(tmp_path / "infos.pkl", infos(tree, "openpcdet", [0]), 2)
    content = path.read_bytes()
    assert b"cnumpy._core.multiarray\n" in content
    path.write_bytes(content.replace(b"cnumpy._core.", b"cnumpy.core."))
    (info,) = load_info(path)
    assert info.centres_m is not None and info.centres_m.shape == (1, 3)


def test_without_boxes(tree: Tree, tmp_path: Path) -> None:
    content = [{"token": tree.tokens[1]}, {"token": tree.tokens[0], "gt_boxes": np.zeros((0, 9))}]
    frames = NuScenesFrames(tree.root, info=save(tmp_path / "infos.pkl", content))
    assert [frames.token(index) for index in range(2)] == [tree.tokens[1], tree.tokens[0]]


def test_boxes_that_are_not_those_of_the_tables(tree: Tree, tmp_path: Path) -> None:
    content = infos(tree, "openpcdet", [0, 1])
    content[1]["gt_boxes"][0, 1] += 0.5
    with pytest.raises(
        FrameError, match=rf"infos\.pkl: boxes of sample {tree.tokens[1]} must be those of .*got box 0 0\.50 m"
    ):
        NuScenesFrames(tree.root, info=save(tmp_path / "infos.pkl", content))
    content[1]["gt_boxes"][0, 1] = np.nan
    with pytest.raises(FrameError, match="got box 0 nan m away"):
        NuScenesFrames(tree.root, info=save(tmp_path / "infos.pkl", content))


def test_samples_of_another_data_set(tree: Tree, tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"infos\.pkl: samples must be in .*v1\.0-test, got elsewhere, which is not"):
        NuScenesFrames(tree.root, info=save(tmp_path / "infos.pkl", [{"token": "elsewhere"}]))
    with pytest.raises(ValueError, match=r"data\.split must not be given with data\.info.* got 'first'"):
        NuScenesFrames(tree.root, split="first", info="x")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("text", "must hold a list of samples, or one as data_list or infos, got str"),
        ([], "must hold a list of samples, or one as data_list or infos, got list"),
        ({"car": [], "truck": []}, "must hold a list of samples.*got a dictionary with car, truck"),
        ([{"frame_id": "1616"}], "sample 0 must have a nuScenes token and boxes of 7 numbers, got no 'token'"),
        ([{"token": 3}], "sample 0 must have a nuScenes token .*got token 3"),
        ([{"token": "a", "gt_boxes": np.zeros((2, 4))}], "sample 0 must have .* got boxes of 4 numbers"),
        ([{"token": "a", "gt_boxes": None}], "sample 0 must have"),
        ([3], "sample 0 must have"),
    ],
)
def test_other_contents(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(FrameError, match=rf"infos\.pkl: (info file )?{message}"):
        load_info(save(tmp_path / "infos.pkl", content))


class Hostile:
    """Pickles to a call of ``function``."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (os.system, ("touch {marker}",), r"(posix|os)\.system"),
        (eval, ("open('{marker}', 'w')",), r"builtins\.eval"),
        (exec, ("open('{marker}', 'w')",), r"builtins\.exec"),
        (getattr, ("text", "upper"), r"builtins\.getattr"),
        (open, ("{marker}", "w"), r"(io|_io)\.open"),
        (np.load, ("{marker}",), r"numpy\.load"),
        (np.fromfile, ("{marker}",), r"numpy\.fromfile"),
        (np.memmap, ("{marker}", "u1", "w+", 0, 10), r"numpy\.memmap"),
        (pickle.loads, (b"",), r"_pickle\.loads"),
    ],
)
def test_hostile_pickles(tmp_path: Path, function: Any, arguments: tuple[Any, ...], name: str) -> None:
    marker = tmp_path / "marker"
    filled = [a.format(marker=marker) if isinstance(a, str) else a for a in arguments]
    # Deep inside of an otherwise good file.
    path = save(tmp_path / "infos.pkl", [{"token": "a", "gt_boxes": np.zeros((0, 7)), "x": Hostile(function, *filled)}])
    with pytest.raises(
        FrameError, match=rf"infos\.pkl: info file must hold plain values and NumPy arrays only, got {name}"
    ):
        load_info(path)
    assert not marker.exists()


def test_objects_inside_of_arrays_are_refused_too(tmp_path: Path) -> None:
    content = [{"token": "a", "x": np.array([Hostile(eval, "1")], dtype=object)}]
    with pytest.raises(FrameError, match=r"got builtins\.eval"):
        load_info(save(tmp_path / "infos.pkl", content))


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_plain_values_come_through(tmp_path: Path, protocol: int) -> None:
    arrays = [
        np.arange(6).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(6, dtype=">f4"),
        np.zeros((0, 9), np.float32),
        np.array([True, False]),
        np.array(7, dtype=np.uint8),
    ]
    scalars = [np.float64(0.25), np.int32(-3), np.bool_(True), np.float32(1.5), 2**70, 0.1, b"\xff\x00", b"", None]
    containers = [{1, 2}, frozenset("a"), (1, (2,)), OrderedDict(a=1), bytearray(b"x"), 1 + 2j]
    values = {"arrays": arrays, "scalars": scalars, "containers": containers}
    found = _unpickle(save(tmp_path / "infos.pkl", values, protocol))
    for expected, stand_in in zip(arrays, found["arrays"], strict=True):
        array = stand_in.to_numpy()
        assert np.array_equal(array, expected) and array.dtype == expected.dtype and array.shape == expected.shape
    assert found["scalars"] == scalars and found["containers"] == containers
    assert [type(value) for value in found["scalars"]] == [type(value) for value in scalars]
    # Not numeric, and not needed: texts, objects, structures.
    others = [np.array(["a", "bc"]), np.array([None, "text"], dtype=object), np.zeros(2, [("x", "f4")]), np.str_("a")]
    found = _unpickle(save(tmp_path / "infos.pkl", others, protocol))
    assert found[3] is None
    for stand_in in found[:3]:
        with pytest.raises(ValueError, match="array of"):
            stand_in.to_numpy()


def test_an_array_of_another_size_than_its_bytes(tmp_path: Path) -> None:
    content = pickle.dumps([{"token": "a", "gt_boxes": np.zeros((3, 7))}], 4)
    assert content.count(b"K\x03K\x07") == 1
    path = tmp_path / "infos.pkl"
    path.write_bytes(content.replace(b"K\x03K\x07", b"K\x04K\x07"))
    with pytest.raises(FrameError, match=r"infos\.pkl: sample 0 must have a nuScenes token and boxes .*cannot reshape"):
        load_info(path)


def test_damaged_and_missing_files(tmp_path: Path) -> None:
    path = tmp_path / "infos.pkl"
    with pytest.raises(FrameError, match=r"infos\.pkl: info file must exist, got no such file"):
        load_info(path)
    whole = pickle.dumps([{"token": "a", "gt_boxes": np.zeros((3, 7))}])
    for content in (b"", b"junk", whole[:-10], whole[:40]):
        path.write_bytes(content)
        with pytest.raises(FrameError, match=r"infos\.pkl: info file must be a readable pickle, got \w+"):
            load_info(path)
