# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The real keyframe (PRED_TEST_DATA): counts that geometry mistakes would change."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pred.data.batch import DataConfig, TrainingBatches, evaluation_batch
from pred.data.frame import CLASS_NAMES, inside_range
from pred.data.masking import is_held_out
from pred.data.nuscenes import NuScenesFrames

POINT_RANGE = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)


def test_frame(nuscenes_tiny: Path) -> None:
    for split in (None, "tiny_all"):
        assert len(NuScenesFrames(nuscenes_tiny, split=split)) == 1
    frame = NuScenesFrames(nuscenes_tiny).load(0)
    assert len(frame.cameras) == 6
    assert frame.boxes is not None and len(frame.boxes) == 68
    assert 20_000 < len(frame.points) < 34_688 and frame.point_index.max() < 34_688
    for camera in frame.cameras:
        uv, z_depth_m = camera.project(frame.points[:, :3])
        assert 2_900 < camera.in_image(uv, z_depth_m).sum() < 5_000
        assert camera.load_image().shape == (900, 1600, 3)


def test_labels_agree_with_geometry(nuscenes_tiny: Path) -> None:
    frame = NuScenesFrames(nuscenes_tiny).load(0)
    # The ground lies 1.8 m below the sensor and slopes a little.
    heights: dict[str, list[np.ndarray]] = {name: [] for name in CLASS_NAMES}
    for camera in frame.cameras:
        uv, z_depth_m = camera.project(frame.points[:, :3])
        seen = camera.in_image(uv, z_depth_m)
        assert camera.labels is not None
        class_id = camera.labels.lookup(uv[seen]).class_id
        for index, name in enumerate(CLASS_NAMES):
            heights[name].append(frame.points[seen, 2][class_id == index])
    road, building = np.concatenate(heights["road"]), np.concatenate(heights["building"])
    assert abs(np.median(road) + 1.83) < 0.1 and (np.abs(road + 1.83) < 0.6).mean() > 0.9
    assert (building > -1.0).mean() > 0.9
    # Points in car boxes are mostly labelled car.
    assert frame.boxes is not None
    in_cars, labelled_car = 0, 0
    for centre, size, yaw, name in zip(
        frame.boxes.centre_m, frame.boxes.size_m, frame.boxes.yaw_rad, frame.boxes.names, strict=True
    ):
        if name != "vehicle.car":
            continue
        offset = frame.points[:, :3] - centre
        along = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw)
        across = -offset[:, 0] * np.sin(yaw) + offset[:, 1] * np.cos(yaw)
        inside = np.abs(np.stack([along, across, offset[:, 2]], axis=1)) < size / 2
        in_box = inside.all(axis=1)
        for camera in frame.cameras:
            uv, z_depth_m = camera.project(frame.points[in_box, :3])
            assert camera.labels is not None
            labels = camera.labels.lookup(uv[camera.in_image(uv, z_depth_m)])
            in_cars += len(labels.class_id)
            labelled_car += int((labels.class_id == CLASS_NAMES.index("car")).sum())
    assert in_cars > 50
    assert labelled_car / in_cars > 0.7


def test_batches_and_held_out_share(nuscenes_tiny: Path) -> None:
    config = DataConfig(root=str(nuscenes_tiny), batch_size=1, workers=0)
    batches = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=2)
    batch = batches[0]
    assert batch.semantic is not None
    assert batch.depth.valid.shape == batch.semantic.valid.shape == (1, 3072)
    assert batch.depth.valid.all() and batch.semantic.valid.all()
    # Balanced: a class with thousands of returns is drawn about as often as one with hundreds.
    drawn = batch.semantic.target[0].sum(dim=0)
    assert drawn[CLASS_NAMES.index("road")] < 4 * drawn[CLASS_NAMES.index("car")]
    frame = batches.source.load(0)
    inside = inside_range(frame.points, POINT_RANGE)
    held = is_held_out(frame.point_index, frame.token, config.holdout_fraction)
    assert abs(held[inside].mean() - 0.1) < 0.005
    evaluation = evaluation_batch(frame, config, POINT_RANGE, seed=0)
    assert evaluation.depth.valid.shape == (1, (held & inside).sum())
