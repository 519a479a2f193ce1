# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""How incomplete and how occluded a made world is: `python -m benchmarks.world_figures ROOT`.

ROOT: a world in the nuScenes layout, made with ``--exact-labels``. Boxes are those of its table sample_annotation; a
return outside the own car is behind what its pixel shows by the rule of `pred evaluate rendering`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.measure import machine_record
from pred.data.nuscenes import NuScenesFrames
from pred.evaluate import shows_nearer_surface
from pred.run_folder import write_json


class Figures(NamedTuple):
    """Counts over all keyframes; a point that several images show counts once for each."""

    keyframes: int
    boxes: int
    boxes_under_five_points: int
    projected_points: int
    hidden_points: int

    def report(self) -> str:
        return (
            f"{self.boxes / self.keyframes:.1f} boxes a keyframe\n"
            f"{self.boxes_under_five_points / self.boxes:.1%} of them with fewer than five points\n"
            f"{self.hidden_points / self.projected_points:.1%} of the points behind what their pixel shows"
        )


def world_figures(root: Path) -> Figures:
    """Count in the tables and the depth maps of a world."""
    frames = NuScenesFrames(root, split="all", labels="none", image_depth="depth/exact")
    projected = hidden = 0
    for number in range(len(frames)):
        frame = frames.load(number)
        points = frame.points[frame.is_keyframe, :3]
        for camera in frame.cameras:
            uv, z_depth_m = camera.project(points)
            inside = camera.in_image(uv, z_depth_m)
            projected += int(inside.sum())
            hidden += int(shows_nearer_surface(z_depth_m[inside], camera.depth_at(uv[inside])).sum())
    (table,) = root.glob("v1.0-*/sample_annotation.json")
    num_points = np.array([row["num_lidar_pts"] for row in json.loads(table.read_text())])
    return Figures(len(frames), len(num_points), int((num_points < 5).sum()), projected, hidden)


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m benchmarks.world_figures", description=__doc__)
    parser.add_argument("root", type=Path, metavar="ROOT")
    parser.add_argument("--json", type=Path, help="file to write the counts to")
    options = parser.parse_args()
    figures = world_figures(options.root)
    print(figures.report())
    if options.json is not None:
        made_with = json.loads((options.root / "world.json").read_text())
        write_json(options.json, {**figures._asdict(), "world": made_with, "machine": machine_record()})
