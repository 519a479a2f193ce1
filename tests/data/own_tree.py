# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Writes drives in the folder format: a moving car sees landmarks that stand still, so that the answers are known."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

NUM_LANDMARKS = 60
WIDTH, HEIGHT = 64, 36
NUM_SCANS = 3
PERIOD_S = 0.1
T_CAMERA_FROM_LIDAR = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 0.0, 1.0]]
"""LiDAR axes x forward, y left, z up; camera axes x right, y down, z forward."""
INTRINSICS = [[50.0, 0.0, 32.0], [0.0, 50.0, 18.0], [0.0, 0.0, 1.0]]


@dataclass
class OwnTree:
    """What was written."""

    root: Path
    landmarks_world: NDArray[np.float64]  # [NUM_LANDMARKS, 3]
    intensity: NDArray[np.float32]  # [NUM_LANDMARKS]
    poses: list[NDArray[np.float64]] = field(default_factory=list)  # T_world_from_lidar, the same in each drive
    drives: list[Path] = field(default_factory=list)

    def describe(self, drive: int, **changes: Any) -> None:
        """Rewrite drive.yaml; a change to None removes the key."""
        path = self.drives[drive] / "drive.yaml"
        content = yaml.safe_load(path.read_text()) | changes
        path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))


def write_own_tree(root: Path, suffix: str = ".bin", drives: tuple[str, ...] = ("drive-a", "drive-b")) -> OwnTree:
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(-math.pi, math.pi, NUM_LANDMARKS), rng.uniform(5.0, 30.0, NUM_LANDMARKS)
    landmarks = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-1, 3, NUM_LANDMARKS)], axis=1)
    tree = OwnTree(root, landmarks, rng.integers(0, 256, NUM_LANDMARKS).astype(np.float32))
    for scan in range(NUM_SCANS):
        yaw = 0.2 * scan
        pose = np.eye(4)
        pose[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        pose[:3, 3] = [0.8 * scan, 0.1 * scan, 1.7]
        tree.poses.append(pose)
    for name in drives:
        drive = root / name
        tree.drives.append(drive)
        (drive / "lidar").mkdir(parents=True)
        (drive / "front").mkdir()
        labels = root / "pseudo" / "made-up" / name / "front"
        labels.mkdir(parents=True)
        scans: dict[str, Any] = {"suffix": suffix}
        if suffix != ".pcd":
            scans["columns"] = ["x", "y", "z", "ring", "intensity"]
        camera = {
            "width": WIDTH,
            "height": HEIGHT,
            "intrinsics": INTRINSICS,
            "T_camera_from_lidar": T_CAMERA_FROM_LIDAR,
        }
        (drive / "drive.yaml").write_text(yaml.safe_dump({"scans": scans, "cameras": {"front": camera}}))
        lines = ["# stem time_s T_world_from_lidar"]
        for scan, pose in enumerate(tree.poses):
            stem = f"{scan:06d}"
            xyz = (np.linalg.inv(pose) @ np.column_stack([landmarks, np.ones(NUM_LANDMARKS)]).T).T[:, :3]
            points = np.column_stack([xyz, np.full(NUM_LANDMARKS, 7.0), tree.intensity]).astype(np.float32)
            write_scan(drive / "lidar" / f"{stem}{suffix}", points)
            Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(
                drive / "front" / f"{stem}.png"
            )
            ids = rng.choice([0, 2, 13, 19], (HEIGHT, WIDTH)).astype(np.uint8)
            Image.fromarray(ids).save(labels / f"{stem}.png")
            numbers = " ".join(repr(float(number)) for number in pose[:3].ravel())
            lines.append(f"{stem} {10 + PERIOD_S * scan!r} {numbers}")
        (drive / "poses.txt").write_text("\n".join(lines) + "\n\n")
    (root / "splits.json").write_text(json.dumps({"train": [drives[-1]], "none": []}))
    return tree


def write_scan(path: Path, points: NDArray[np.float32]) -> None:
    """[N, 5] x, y, z, ring, intensity."""
    if path.suffix == ".bin":
        points.tofile(path)
    elif path.suffix == ".npy":
        np.save(path, points)
    else:
        header = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z ring intensity\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 1\n"
            f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
        )
        path.write_bytes(header.encode() + points.tobytes())
