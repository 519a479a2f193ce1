# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the official ONCE layout from typed records, of a simulated world or of one's own recordings.

A sequence is written under a temporary name and renamed when it is complete, so that ``data/<sequence>`` is there as a
whole or not at all. Several processes may write, but each its own sequences; the lists of the splits come last.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pred.checkpoint import write_text
from pred.data.boxes import corners_3d
from pred.data.frame import (
    MIN_PROJECTION_DEPTH_M,
    Boxes,
    Camera,
    Frame,
    invert_rigid,
    quaternion_of,
    transform_points,
)
from pred.data.once import CAMERAS, CLASSES, LIDAR, PIXEL_CENTRE

JPEG_QUALITY = 95
CALIBRATION_TOLERANCE = 1e-6
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Turns x right, y forward (nuScenes) to x left, y back (ONCE), and back."""

NUSCENES_CAMERAS = {
    "CAM_FRONT": "cam01", "CAM_BACK_LEFT": "cam05", "CAM_FRONT_LEFT": "cam06", "CAM_FRONT_RIGHT": "cam07",
    "CAM_BACK_RIGHT": "cam08", "CAM_BACK": "cam09",
}  # fmt: skip
"""ONCE cameras that look where those of nuScenes do."""
NUSCENES_CLASSES = {
    "vehicle.car": "Car", "vehicle.emergency.police": "Car", "vehicle.truck": "Truck", "vehicle.bus.bendy": "Bus",
    "vehicle.bus.rigid": "Bus", "vehicle.bicycle": "Cyclist", "vehicle.motorcycle": "Cyclist",
    "human.pedestrian.adult": "Pedestrian", "human.pedestrian.child": "Pedestrian",
    "human.pedestrian.construction_worker": "Pedestrian", "human.pedestrian.police_officer": "Pedestrian",
}  # fmt: skip
"""ONCE classes of nuScenes categories; the others have none."""

_EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])


@dataclass
class OnceRecord:
    """One frame to be written. LiDAR axes are x left, y back, z up.

    Attributes:
        timestamp_ms: names the frame; no two of a tree should be equal.
        points: [N, 4] float32 x, y, z (metres, LiDAR frame), intensity.
        T_world_from_lidar: [4, 4] float64 in any world frame of the sequence, or None for a frame without pose.
        cameras: pinhole cameras named as in `pred.data.once.CAMERAS`, each with its image. ONCE keeps calibrations by
            sequence, so they must be the same in all of its frames.
        boxes: boxes in the LiDAR frame with names of `pred.data.once.CLASSES`; None: nobody annotated the frame.
    """

    timestamp_ms: int
    points: NDArray[np.float32]
    T_world_from_lidar: NDArray[np.float64] | None = None
    cameras: list[Camera] = field(default_factory=list)
    boxes: Boxes | None = None


def once_record(
    frame: Frame,
    timestamp_ms: int,
    camera_names: Mapping[str, str] = NUSCENES_CAMERAS,
    class_names: Mapping[str, str] = NUSCENES_CLASSES,
    T_once_from_lidar: NDArray[np.float64] = HALF_TURN,
) -> OnceRecord:
    """A record of any frame, in ONCE's axes: its keyframe returns, cameras and boxes. The defaults are for a frame of
    nuScenes's names and axes.

    Args:
        frame: cameras must have images.
        timestamp_ms: names the frame.
        camera_names: ONCE camera by the frame's camera name; others are left out.
        class_names: ONCE class by the frame's box name; boxes of others are left out.
        T_once_from_lidar: [4, 4] turn about z from the frame's LiDAR axes.
    """
    points = frame.points[frame.is_keyframe, :4].copy()
    points[:, :3] = transform_points(T_once_from_lidar, points[:, :3])
    T_lidar_from_once = invert_rigid(T_once_from_lidar)
    cameras = [
        Camera(
            name=camera_names[camera.name],
            intrinsics=camera.intrinsics,
            T_camera_from_lidar=camera.T_camera_from_lidar @ T_lidar_from_once,
            width=camera.width,
            height=camera.height,
            image=camera.image,
        )
        for camera in frame.cameras
        if camera.name in camera_names
    ]
    boxes = None
    if frame.boxes is not None:
        kept = [row for row, name in enumerate(frame.boxes.names) if name in class_names]
        yaw_rad = frame.boxes.yaw_rad[kept] + np.arctan2(T_once_from_lidar[1, 0], T_once_from_lidar[0, 0])
        boxes = Boxes(
            centre_m=transform_points(T_once_from_lidar, frame.boxes.centre_m[kept]),
            size_m=frame.boxes.size_m[kept],
            yaw_rad=np.arctan2(np.sin(yaw_rad), np.cos(yaw_rad)),
            names=[class_names[frame.boxes.names[row]] for row in kept],
        )
    return OnceRecord(timestamp_ms, points, frame.T_world_from_lidar @ T_lidar_from_once, cameras, boxes)


def write_once(
    root: str | Path, sequence: str, records: Iterable[OnceRecord], jpeg_quality: int = JPEG_QUALITY
) -> Path:
    """Write one sequence, ``root/data/<sequence>``; poses become relative to the first scan that has one.

    Records are taken one at a time, so that a generator keeps memory small. Equal records give equal bytes (with one
    version of Pillow).

    Args:
        root: root of the tree; made if it is not there.
        sequence: name of the sequence, such as 000076.
        records: frames in the order of time.
        jpeg_quality: of the images, 1 to 95.

    Returns:
        The folder.

    Raises:
        ValueError: the sequence exists, or a record breaks a rule; the text names sequence and frame. Nothing stays.
        FrameError: an image cannot be used.
    """
    if not re.fullmatch(r"\w[\w-]*", sequence):
        raise ValueError(f"write_once: sequence must be made of letters, digits, _ and -, got {sequence!r}")
    data = Path(root) / "data"
    folder = data / sequence
    if folder.exists():
        raise ValueError(f"write_once: sequence must be new, got {folder}, which exists")
    temporary = data / f".{sequence}.partial"
    shutil.rmtree(temporary, ignore_errors=True)  # what a killed process left
    try:
        for name in (LIDAR, *CAMERAS):
            (temporary / name).mkdir(parents=True)
        content = _write_frames(temporary, sequence, records, jpeg_quality)
        _write(temporary / f"{sequence}.json", json.dumps(content).encode())
        for name in CAMERAS:
            if name not in content["calib"]:
                (temporary / name).rmdir()
        os.replace(temporary, folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return folder


def write_once_splits(root: str | Path, splits: Mapping[str, Sequence[str]]) -> None:
    """Write ``root/ImageSets/<split>.txt``, the names of each split's sequences, replacing lists that are there.

    Raises:
        ValueError: a sequence has not been written.
    """
    root = Path(root)
    for split, sequences in splits.items():
        for sequence in sequences:
            if not (root / "data" / sequence / f"{sequence}.json").is_file():
                raise ValueError(f"write_once_splits: {split} must name sequences of {root}, got {sequence!r}")
    (root / "ImageSets").mkdir(parents=True, exist_ok=True)
    for split, sequences in splits.items():
        write_text(root / "ImageSets" / f"{split}.txt", "".join(f"{sequence}\n" for sequence in sequences))


def _write_frames(folder: Path, sequence: str, records: Iterable[OnceRecord], jpeg_quality: int) -> dict[str, Any]:
    """Write points and images; returns the content of the sequence's JSON file."""
    calibrations: dict[str, Camera] = {}
    frames: list[dict[str, Any]] = []
    T_first_from_world: NDArray[np.float64] | None = None
    for number, record in enumerate(records):
        where = f"write_once: sequence {sequence}, frame {record.timestamp_ms}"
        _check_record(record, where)
        if frames and int(frames[-1]["frame_id"]) >= record.timestamp_ms:
            raise ValueError(f"{where}: timestamp_ms must rise, got {frames[-1]['frame_id']} before it")
        if number == 0:
            calibrations = {camera.name: camera for camera in record.cameras}
        _check_calibrations(record, calibrations, where)
        if T_first_from_world is None and record.T_world_from_lidar is not None:
            T_first_from_world = invert_rigid(record.T_world_from_lidar)
        frame_id = str(record.timestamp_ms)
        frame: dict[str, Any] = {"sequence_id": sequence, "frame_id": frame_id, "pose": [0.0] * 7}
        if T_first_from_world is not None and record.T_world_from_lidar is not None:
            frame["pose"] = _pose(T_first_from_world @ record.T_world_from_lidar)
        if record.boxes is not None:
            frame["annos"] = _annotation(record.boxes, record.cameras)
        frames.append(frame)
        _write(folder / LIDAR / f"{frame_id}.bin", np.ascontiguousarray(record.points, dtype="<f4").tobytes())
        for camera in record.cameras:
            encoded = io.BytesIO()
            Image.fromarray(camera.load_image()).save(encoded, format="JPEG", quality=jpeg_quality)
            _write(folder / camera.name / f"{frame_id}.jpg", encoded.getvalue())
    if not frames:
        raise ValueError(f"write_once: sequence {sequence} must have at least one record, got none")
    calib = {
        name: {
            "cam_to_velo": invert_rigid(camera.T_camera_from_lidar).tolist(),
            "cam_intrinsic": (camera.intrinsics - PIXEL_CENTRE).tolist(),
            "distortion": [0.0] * 5,
        }
        for name, camera in sorted(calibrations.items())
    }
    return {"meta_info": {}, "calib": calib, "frames": frames}


def _check_record(record: OnceRecord, where: str) -> None:
    points = record.points
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32 or len(points) == 0:
        raise ValueError(
            f"{where}: points must be float32 of shape [N > 0, 4], got {points.dtype} {list(points.shape)}"
        )
    if not np.isfinite(points).all():
        raise ValueError(f"{where}: points must be finite, got NaN or Inf")
    T = record.T_world_from_lidar
    if T is not None and (T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)):
        raise ValueError(f"{where}: T_world_from_lidar must be a rigid transform [4, 4], got {T.tolist()}")
    names = [camera.name for camera in record.cameras]
    if len({*names}) < len(names) or not {*names} <= {*CAMERAS}:
        raise ValueError(f"{where}: cameras must be among {', '.join(CAMERAS)}, each once, got {', '.join(names)}")
    unknown = sorted({*record.boxes.names} - {*CLASSES}) if record.boxes is not None else []
    if unknown:
        raise ValueError(f"{where}: names of boxes must be among {', '.join(CLASSES)}, got {', '.join(unknown)}")


def _check_calibrations(record: OnceRecord, calibrations: Mapping[str, Camera], where: str) -> None:
    if {camera.name for camera in record.cameras} != {*calibrations}:
        names = ", ".join(camera.name for camera in record.cameras)
        raise ValueError(f"{where}: cameras must be those of the first frame, {', '.join(calibrations)}, got {names}")
    for camera in record.cameras:
        first = calibrations[camera.name]
        same_size = (camera.width, camera.height) == (first.width, first.height)
        difference = max(
            np.abs(camera.intrinsics - first.intrinsics).max(),
            np.abs(camera.T_camera_from_lidar - first.T_camera_from_lidar).max(),
        )
        if not (same_size and difference <= CALIBRATION_TOLERANCE):
            raise ValueError(
                f"{where}: {camera.name} must have one size and calibration in the whole sequence, "
                f"got a difference of {difference:g}"
            )


def _pose(T_first_from_lidar: NDArray[np.float64]) -> list[float]:
    """Quaternion x, y, z, w, then translation."""
    w, x, y, z = quaternion_of(T_first_from_lidar[:3, :3]).tolist()
    return [x, y, z, w, *T_first_from_lidar[:3, 3].tolist()]


def _annotation(boxes: Boxes, cameras: Sequence[Camera]) -> dict[str, Any]:
    rows = np.concatenate([boxes.centre_m, boxes.size_m, boxes.yaw_rad[:, None]], axis=1)
    boxes_2d = {name: np.full((len(rows), 4), -1.0) for name in CAMERAS}
    for camera in cameras:
        boxes_2d[camera.name] = boxes_in_image(rows, replace(camera, intrinsics=camera.intrinsics - PIXEL_CENTRE))
    return {
        "names": list(boxes.names),
        "boxes_3d": rows.tolist(),
        "boxes_2d": {name: rectangles.tolist() for name, rectangles in boxes_2d.items()},
    }


def boxes_in_image(boxes: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """[M, 4] x_min, y_min, x_max, y_max in pixels of what an image shows of boxes [M, 7]; -1 for those outside.

    Occlusion plays no part.
    """
    corners = transform_points(camera.T_camera_from_lidar, corners_3d(boxes).reshape(-1, 3)).reshape(-1, 8, 3)
    starts, ends = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    # Edges are cut at the plane in front of which points have pixels.
    rise = ends[..., 2] - starts[..., 2]
    cut = np.divide(MIN_PROJECTION_DEPTH_M - starts[..., 2], rise, out=np.zeros_like(rise), where=rise != 0)
    crossing = starts + np.clip(cut, 0.0, 1.0)[..., None] * (ends - starts)
    outline = np.concatenate([corners, crossing], axis=1)  # [M, 20, 3]
    seen = outline[..., 2] >= MIN_PROJECTION_DEPTH_M * (1 - 1e-9)
    homogeneous = outline @ camera.intrinsics.T
    uv = homogeneous[..., :2] / np.where(seen, homogeneous[..., 2], 1.0)[..., None]
    lower = np.where(seen[..., None], uv, np.inf).min(axis=1)
    upper = np.where(seen[..., None], uv, -np.inf).max(axis=1)
    size = np.array([camera.width, camera.height])
    visible = (seen.any(axis=1) & (lower < size).all(axis=1) & (upper > 0).all(axis=1))[:, None]
    rectangles = np.concatenate([np.clip(lower, 0, size), np.clip(upper, 0, size)], axis=1)
    return np.where(visible, rectangles, -1.0)


def _write(path: Path, content: bytes) -> None:
    """Write and flush a file of a folder that is renamed as a whole."""
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
