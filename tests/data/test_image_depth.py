# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Depth maps of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pred.data.batch import DataConfig, build_source
from pred.data.folder import FolderFrames
from pred.data.frame import Camera, FrameError
from pred.data.image_depth import DepthMap
from pred.data.nuscenes import NuScenesFrames
from tests.data.own_tree import write_own_tree
from tests.data.tiny_tree import CAMERAS, HEIGHT, WIDTH, write_tree

VALUES = np.array([[256, 0, 65535], [128, 1, 2560]], dtype=np.uint16)


def camera(path: Path | None, width: int = 3, height: int = 2) -> Camera:
    depth = None if path is None else DepthMap(path, width, height)
    return Camera("CAM", np.eye(3), np.eye(4), width, height, depth=depth)


def write_depth(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
    return path


def test_depth_hand_computed(tmp_path: Path) -> None:
    asked = camera(write_depth(tmp_path / "a.png", VALUES))
    inside = np.array([[0.0, 0.0], [0.99, 0.99], [1.5, 0.5], [2.9, 0.1], [0.5, 1.0], [1.0, 1.0], [2.0, 1.9]])
    np.testing.assert_array_equal(asked.depth_at(inside), [1.0, 1.0, np.nan, 65535 / 256, 0.5, 1 / 256, 10.0])
    outside = np.array([[-0.1, 0.0], [0.0, -0.1], [3.0, 0.0], [0.0, 2.0], [np.nan, 0.0], [np.inf, -np.inf]])
    assert np.isnan(asked.depth_at(outside)).all()
    assert asked.depth_at(np.zeros((0, 2))).shape == (0,)


def test_damaged_depth_maps(tmp_path: Path) -> None:
    uv = np.zeros((1, 2))
    with pytest.raises(FrameError, match="camera CAM: depth map must be given, got None: see data.image_depth"):
        camera(None).depth_at(uv)
    with pytest.raises(FrameError, match=r"none.png: image file must exist, got no such file"):
        camera(tmp_path / "none.png").depth_at(uv)
    path = write_depth(tmp_path / "a.png", VALUES)
    with pytest.raises(FrameError, match=r"a.png: depth map must have its image's 6 x 4 pixels, got 3 x 2"):
        camera(path, 6, 4).depth_at(uv)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(FrameError, match=r"a.png: image file must be readable, got"):
        camera(path).depth_at(uv)
    with pytest.raises(FrameError, match=r"b.png: depth map must be a 16-bit grey PNG, got PNG of mode L"):
        camera(write_depth(tmp_path / "b.png", VALUES.astype(np.uint8))).depth_at(uv)


def test_nuscenes_layout(tmp_path: Path) -> None:
    tree = write_tree(tmp_path)
    for number, channel in enumerate(CAMERAS):
        file = tmp_path / "depth" / "exact" / channel / f"{tree.images[1][channel].stem}.png"
        write_depth(file, np.full((HEIGHT, WIDTH), 256 * (number + 1), dtype=np.uint16))
    source = build_source(DataConfig(root=str(tmp_path), image_depth="depth/exact"))
    cameras = {camera.name: camera for camera in source.load(1).cameras}
    for number, channel in enumerate(CAMERAS):
        assert cameras[channel].depth_at(np.array([[WIDTH - 0.5, HEIGHT - 0.5]])).tolist() == [number + 1.0]
    # Missing files matter to those who ask.
    missing = source.load(0).cameras[0]
    with pytest.raises(FrameError, match="image file must exist"):
        missing.depth_at(np.zeros((1, 2)))
    for nothing in (None, "none"):
        assert NuScenesFrames(tmp_path, image_depth=nothing).load(0).cameras[0].depth is None
    with pytest.raises(FrameError, match=r"nowhere: data.image_depth must be a folder, got no such folder"):
        NuScenesFrames(tmp_path, image_depth="nowhere")


def test_folder_layout(tmp_path: Path) -> None:
    write_own_tree(tmp_path)
    frames = FolderFrames(tmp_path)
    seen = frames.load(0).cameras[0]
    drive, stem = frames.token(0).split("/")
    write_depth(
        tmp_path / "depth" / drive / seen.name / f"{stem}.png",
        np.full((seen.height, seen.width), 512, dtype=np.uint16),
    )
    source = build_source(DataConfig(dataset="folder", root=str(tmp_path), image_depth="depth"))
    assert source.load(0).cameras[0].depth_at(np.zeros((1, 2))).tolist() == [2.0]


def test_once_has_none() -> None:
    with pytest.raises(ValueError, match=r"data\.image_depth must be none for data\.dataset once, got 'depth'"):
        DataConfig(dataset="once", root="x", image_depth="depth")
