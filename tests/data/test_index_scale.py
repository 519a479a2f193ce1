# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Indexes of the size of nuScenes and ONCE; a small one always, the large ones where PRED_TEST_SCALE names a folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.index_scale import write_once_files, write_tables
from pred.data.nuscenes import NuScenesFrames, build_index
from pred.data.once import CAMERAS, OnceFrames


def test_small(tmp_path: Path) -> None:
    tables = tmp_path / "v1.0-trainval"
    assert write_tables(tables, 80) == 80 * 76
    index = build_index(tables)
    assert len(index.sweeps.path) == 800 and len(index.images.path) == 480 and len(index.boxes.name) == 80 * 34
    # Two scenes of forty samples: each walk goes back to the start of its scene.
    assert index.recording.to_pylist() == ["scene-0000"] * 40 + ["scene-0001"] * 40
    assert [int(row) for row in index.sweeps.previous[:12]] == [-1, *range(11)] and index.sweeps.previous[400] == -1
    assert len(NuScenesFrames(tmp_path)) == 80


def test_small_once(tmp_path: Path) -> None:
    assert write_once_files(tmp_path, 4000) == 28000
    frames = OnceFrames(tmp_path)
    index = frames._index
    assert len(frames) == 4000 and len(index.images.path) == 28000
    assert index.images.path[7 * 1800 + 1].as_py() == "data/000001/cam03/1616100900000.jpg"
    assert index.sweeps.path[1799].as_py() == "data/000000/lidar_roof/1616100899500.bin"
    assert index.sweeps.time_us[1799] == 1_616_100_899_500_000
    assert index.frames_of({"000002"}).tolist() == list(range(3600, 4000))
    assert index.sweeps.previous[[0, 1, 1799, 1800]].tolist() == [-1, 0, 1798, -1]
    assert [frames.has_pose(row) for row in (0, 1, 49, 50)] == [False, True, True, False] and len(index.poses) == 3920
    assert index.boxes.offsets[[1, 60, 61]].tolist() == [25, 25, 50]
    assert [frames.annotation(row) is not None for row in (0, 1, 59, 60)] == [True, False, False, True]
    assert index.calibrations.channel.to_pylist() == ["lidar_roof", *CAMERAS] * 3
    assert index.images.calibration[[0, 6, 7 * 1800]].tolist() == [1, 7, 9]


@pytest.mark.skipif("PRED_TEST_SCALE" not in os.environ, reason="PRED_TEST_SCALE names no folder for 5 GB")
def test_full_size(tmp_path: Path) -> None:
    record = tmp_path / "record.json"
    command = [sys.executable, "-m", "benchmarks.index_scale", os.environ["PRED_TEST_SCALE"], "--json", str(record)]
    subprocess.run(command, check=True)
    figures = json.loads(record.read_text())["figures"]
    for name in ("nuscenes", "once"):
        assert figures[f"{name} build"]["peak_rss_mb"] < 4000
        assert figures[f"{name} open"]["seconds"] < 2
        for start in ("walk", "spawn"):
            worker = figures[f"{name} {start}"]
            assert worker["private_dirty_mb"] + worker["private_clean_mb"] < 100
