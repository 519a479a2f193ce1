# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Drives of the procedural world as a data set in the official ONCE layout.

ONCE keeps one calibration per sequence, so all cameras take their pictures at the stamp of the LiDAR, and there are
keyframes only. A scene is a sequence; its number in six digits is the name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pred.checkpoint import atomic_write
from pred.data.frame import Boxes, Camera, Frame, invert_rigid
from pred.data.once import CAMERAS
from pred.data.once_writer import OnceRecord, once_record, write_once, write_once_splits
from pred.data.world.annotation import Candidate, annotated_keyframes, candidates
from pred.data.world.drive import NOISE, Drive, Sweep, View
from pred.data.world.nuscenes_writer import JPEG_QUALITY, WorldSettings, encode_depth
from pred.data.world.sensors import T_EGO_FROM_LIDAR, Mount, mounted_camera

ONCE_MOUNTS = (
    Mount("cam01", 1.55, 0.15, 1.72, 0.0, 1386.0),
    Mount("cam03", 1.55, -0.15, 1.72, 0.0, 462.0),
    Mount("cam05", 0.75, 0.50, 1.72, 125.0, 671.0),
    Mount("cam06", 1.25, 0.50, 1.72, 55.0, 671.0),
    Mount("cam07", 1.25, -0.50, 1.72, -55.0, 671.0),
    Mount("cam08", 0.75, -0.50, 1.72, -125.0, 671.0),
    Mount("cam09", 0.15, 0.0, 1.72, 180.0, 1386.0),
)
"""Seven cameras that look where those of ONCE do; places and fields of view (60, 120, four times 100, and 60 degrees)
are chosen here."""

UNANNOTATED_EVERY = 5
"""Nobody annotates the fifth frame of a sequence, the tenth, and so on: the real sequences have such frames, too."""

TakeView = Callable[[str, str, View], None]
"""Gets frame id, camera and what the camera shows."""


def sequence_name(scene: int) -> str:
    return f"{scene:06d}"


def once_splits(scenes: int) -> dict[str, list[str]]:
    """Sequences by split: the last fifth, but at least one of several, is `val`; from five scenes on the fifth before
    it is `test`. The raw splits name the sequences of `train`: pre-training asks for no annotation."""
    names = [sequence_name(scene) for scene in range(scenes)]
    num_val, num_test = max(scenes // 5, min(1, scenes - 1)), scenes // 5
    num_train = scenes - num_val - num_test
    train, test, val = names[:num_train], names[num_train : num_train + num_test], names[num_train + num_test :]
    return {"train": train, "val": val, "test": test, "raw_small": train, "raw_medium": train, "raw_large": train}


def once_records(drive: Drive, width: int, height: int, take_view: TakeView | None = None) -> Iterator[OnceRecord]:
    """Records of all keyframes of a drive, pictures made when they are asked for.

    Beams without a return are left out. Boxes follow `pred.data.world.annotation`, in the classes of ONCE.

    Args:
        drive: the drive.
        width, height: size of the images.
        take_view: is called with each picture's exact labels.
    """
    times_us = drive.keyframe_us.tolist()
    scans = [drive.scan(time_us) for time_us in times_us]  # 0.9 MB each
    found = [_candidates(drive, time_us, scan) for time_us, scan in zip(times_us, scans, strict=True)]
    annotated = annotated_keyframes([{seen.actor.instance: seen.num_points for seen in keyframe} for keyframe in found])
    for number, (time_us, scan) in enumerate(zip(times_us, scans, strict=True)):
        points = scan.points[scan.category != NOISE]
        points[:, 4] = 0.0  # the ring gives way to the age
        boxed = [seen for seen in found[number] if number in annotated.get(seen.actor.instance, ())]
        frame = Frame(
            token=str(time_us // 1000),
            points=points,
            point_index=np.arange(len(points)),
            is_keyframe=np.ones(len(points), dtype=np.bool_),
            cameras=_cameras(drive, time_us, width, height, take_view),
            T_world_from_lidar=drive.T_world_from_ego(time_us) @ T_EGO_FROM_LIDAR,
            boxes=None if number % UNANNOTATED_EVERY == UNANNOTATED_EVERY - 1 else _boxes(boxed),
        )
        yield once_record(frame, time_us // 1000, {name: name for name in CAMERAS})


def write_sequence(root: Path, settings: WorldSettings, drive: Drive, scene: int) -> None:
    """Write one sequence and, if the settings say so, its exact labels.

    The sequence appears last and as a whole: where it is, its labels are.
    """
    name = sequence_name(scene)

    def write_labels(frame_id: str, camera: str, view: View) -> None:
        place = Path("exact") / name / camera / f"{frame_id}.png"
        _write_png(root / "pseudo" / place, view.class_id)
        _write_png(root / "depth" / place, encode_depth(view.depth_m))

    records = once_records(drive, *settings.image_size, write_labels if settings.exact_labels else None)
    write_once(root, name, records, JPEG_QUALITY)


def write_splits(root: Path, settings: WorldSettings) -> int:
    """Write the lists of the splits, which complete the data set; returns the bytes of all files of the sequences."""
    write_once_splits(root, once_splits(settings.scenes))
    folders = [root / "data", root / "pseudo", root / "depth"]
    return sum(path.stat().st_size for folder in folders for path in folder.rglob("*") if path.is_file())


def _candidates(drive: Drive, time_us: int, sweep: Sweep) -> list[Candidate]:
    T_lidar_from_world = invert_rigid(drive.T_world_from_ego(time_us) @ T_EGO_FROM_LIDAR)
    return candidates(drive.actors, time_us, T_lidar_from_world, sweep.points[sweep.category != NOISE])


def _cameras(drive: Drive, time_us: int, width: int, height: int, take_view: TakeView | None) -> list[Camera]:
    cameras = []
    for mount in ONCE_MOUNTS:
        view = drive.view(mount, time_us, width, height)
        if take_view is not None:
            take_view(str(time_us // 1000), mount.name, view)
        camera = mounted_camera(mount, width, height)
        camera.image = view.image
        cameras.append(camera)
    return cameras


def _boxes(found: list[Candidate]) -> Boxes:
    T_lidar_from_box = np.array([candidate.T_lidar_from_box for candidate in found]).reshape(-1, 4, 4)
    return Boxes(
        centre_m=T_lidar_from_box[:, :3, 3],
        size_m=np.array([candidate.actor.size_lwh_m for candidate in found], dtype=np.float64).reshape(-1, 3),
        yaw_rad=np.arctan2(T_lidar_from_box[:, 1, 0], T_lidar_from_box[:, 0, 0]),
        names=[candidate.actor.category for candidate in found],
    )


def _write_png(path: Path, values: NDArray[np.uint8 | np.uint16]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        Image.fromarray(values).save(file, format="PNG")
