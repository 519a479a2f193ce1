# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for the official ONCE layout (ImageSets/, data/<sequence>/).

LiDAR axes are x left, y back, z up, and stay so. Facts about the format: the ONCE documentation, the code of
once_devkit, and its issues 8 (axes), 21 and 22 (order of the pose, gaps between frames).
"""

from __future__ import annotations

import math
import re
from array import array
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import (
    Boxes,
    Camera,
    Frame,
    FrameError,
    invert_rigid,
    pose_matrix,
    read_rgb,
    rgb_image_size,
)
from pred.data.labels import PseudoLabel, find_label_file, label_folder
from pred.data.sweeps import place_sweep, require_finite_points
from pred.data.tables import read_json
from pred.data.undistort import COEFFICIENT_COUNTS, undistort_image, undistorted_intrinsics

CAMERAS = ("cam01", "cam03", "cam05", "cam06", "cam07", "cam08", "cam09")
"""Front, front (other lens), left back, left front, right front, right back, back."""
CLASSES = ("Car", "Truck", "Bus", "Pedestrian", "Cyclist")
LIDAR = "lidar_roof"
BYTES_PER_POINT = 16  # float32 x, y, z, intensity
EGO_BOX = (-1.0, -3.0, 1.0, 2.0)
"""(x_min, y_min, x_max, y_max), metres: nuScenes's box for the own car, in these axes."""
NO_POSE = [math.nan] * 7


@dataclass(frozen=True)
class _Calibration:
    """One camera of one sequence, hashable."""

    T_lidar_from_camera: tuple[float, ...]  # 16
    intrinsics: tuple[float, ...]  # 9, of the image on disk
    distortion: tuple[float, ...]


class _Annotation(NamedTuple):
    names: list[str]
    boxes: NDArray[np.float64]  # [M, 7] as in the file


@dataclass
class OnceSequence:
    """What is kept of the JSON file of a sequence with n frames."""

    folder: Path
    calibrations: dict[str, _Calibration]
    frame_ids: NDArray[np.str_]  # [n]
    poses: NDArray[np.float64]  # [n, 7] quaternion x y z w, translation; NaN where there is none
    annotations: dict[int, _Annotation]  # by row; frames that nobody annotated have none

    @property
    def path(self) -> Path:
        return self.folder / f"{self.folder.name}.json"


class OnceFrames:
    """Frames of the ONCE data set as a `FrameSource`, annotated or not, one scan each.

    Frames lie 0.5 s apart, and up to 7 s where some were dropped; there are no sweeps in between to add. The world
    frame of a sequence is the LiDAR frame of its first scan. Frames without a usable pose have the identity as theirs
    (`has_pose`). ``Frame.boxes`` is None for frames that nobody annotated, and holds no box for annotated empty ones.

    Args:
        root: folder with ImageSets/ and data/.
        split: name of a list in ImageSets/, such as train or raw_small; None takes every sequence under data/.
        labels: folder under `root` with ``<sequence>/<camera>/<frame id>.png|.npy|.npz``; "auto" takes the only folder
            under ``pseudo/`` if there is one; "none" reads no labels. With labels, every camera of the calibration must
            have its image and label; without, cameras without an image are left out.
        ego_box: (x_min, y_min, x_max, y_max) in metres; returns in it are the own car and are removed.
        undistort: images and intrinsics are those of pinhole cameras, made with the lens distortion of the calibration;
            labels must be labels of such images. False takes the images on disk for pinhole images.

    Raises:
        FrameError: a list or a sequence's JSON file is missing or damaged.
        ValueError: there is no frame.
    """

    def __init__(
        self,
        root: str | Path,
        split: str | None = None,
        labels: str | None = "auto",
        ego_box: tuple[float, float, float, float] = EGO_BOX,
        undistort: bool = True,
    ) -> None:
        self.root = Path(root)
        self.ego_box = ego_box
        self.undistort = undistort
        self.labels = label_folder(self.root, labels)
        names = sequence_names(self.root) if split is None else split_names(self.root, split)
        self._sequences = [read_sequence(self.root / "data" / name) for name in names]
        lengths = [len(sequence.frame_ids) for sequence in self._sequences]
        self._starts = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        if len(self) == 0:
            raise ValueError(f"data.split must select frames of {self.root}, got none: {split}")

    def __len__(self) -> int:
        return int(self._starts[-1])

    def token(self, index: int) -> str:
        """``<sequence>_<frame id>``."""
        sequence, row = self._place(index)
        return f"{sequence.folder.name}_{sequence.frame_ids[row]}"

    def frame_id(self, index: int) -> str:
        """The data set's own name of the frame: its time in milliseconds."""
        sequence, row = self._place(index)
        return str(sequence.frame_ids[row])

    def has_pose(self, index: int) -> bool:
        """Whether the data set knows where the frame was taken."""
        sequence, row = self._place(index)
        return bool(np.isfinite(sequence.poses[row, 0]))

    def annotation(self, index: int) -> tuple[list[str], NDArray[np.float64]] | None:
        """Names and boxes [M, 7] (centre, length, width, height in metres, yaw in radians) as they are in the file,
        or None if nobody annotated the frame."""
        sequence, row = self._place(index)
        return sequence.annotations.get(row)

    def load(self, index: int) -> Frame:
        """Read the scan of frame ``index`` and the headers of its images.

        Raises:
            FrameError: a file is missing, truncated, of the wrong type or size, or holds NaN or Inf.
        """
        sequence, row = self._place(index)
        frame_id = str(sequence.frame_ids[row])
        scan = sequence.folder / LIDAR / f"{frame_id}.bin"
        points, point_index = place_sweep(read_scan(scan), np.eye(4), self.ego_box, lag_s=0.0)
        cameras = (self._camera(sequence, name, frame_id) for name in CAMERAS if name in sequence.calibrations)
        annotation = sequence.annotations.get(row)
        pose = sequence.poses[row]
        return Frame(
            token=self.token(index),
            points=points,
            point_index=point_index,
            is_keyframe=np.ones(len(points), dtype=np.bool_),
            cameras=[camera for camera in cameras if camera is not None],
            T_world_from_lidar=pose_matrix(pose[4:], pose[[3, 0, 1, 2]]) if self.has_pose(index) else np.eye(4),
            source=str(scan),
            boxes=None if annotation is None else _boxes(annotation),
        )

    def _place(self, index: int) -> tuple[OnceSequence, int]:
        """Sequence and row of a frame."""
        if not 0 <= index < len(self):
            raise IndexError(f"index must be in [0, {len(self)}), got {index}")
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._sequences[number], index - int(self._starts[number])

    def _camera(self, sequence: OnceSequence, name: str, frame_id: str) -> Camera | None:
        path = sequence.folder / name / f"{frame_id}.jpg"
        if self.labels is None and not path.is_file():
            return None
        width, height = rgb_image_size(path)
        calibration = sequence.calibrations[name]
        intrinsics = np.reshape(calibration.intrinsics, (3, 3))
        camera = Camera(
            name=name,
            intrinsics=intrinsics,
            T_camera_from_lidar=invert_rigid(np.reshape(calibration.T_lidar_from_camera, (4, 4))),
            width=width,
            height=height,
            image=path,
        )
        if self.undistort and any(calibration.distortion):
            try:
                camera.intrinsics = _pinhole(calibration, width, height).copy()  # of a cached array
            except ValueError as error:
                raise FrameError(
                    sequence.path, f"calib {name}: {error}; data.undistort false takes the images as they are"
                ) from None
            camera.image = partial(_read_undistorted, path, intrinsics, calibration.distortion, camera.intrinsics)
        if self.labels is not None:
            label_file = find_label_file(self.labels / sequence.folder.name / name, frame_id)
            camera.labels = PseudoLabel(label_file, width, height)
        return camera


@lru_cache(maxsize=256)
def _pinhole(calibration: _Calibration, width: int, height: int) -> NDArray[np.float64]:
    intrinsics = np.reshape(calibration.intrinsics, (3, 3))
    return undistorted_intrinsics(intrinsics, calibration.distortion, width, height)


def _read_undistorted(
    path: Path, intrinsics: NDArray[np.float64], distortion: tuple[float, ...], new_intrinsics: NDArray[np.float64]
) -> NDArray[np.uint8]:
    return undistort_image(read_rgb(path), intrinsics, distortion, new_intrinsics)


def _boxes(annotation: _Annotation) -> Boxes:
    boxes = annotation.boxes
    return Boxes(
        centre_m=boxes[:, :3],
        size_m=boxes[:, 3:6],
        yaw_rad=np.arctan2(np.sin(boxes[:, 6]), np.cos(boxes[:, 6])),
        names=annotation.names,
    )


# Files


def read_scan(path: Path) -> NDArray[np.float32]:
    """[N, 4] float32 x, y, z (metres), intensity.

    Raises:
        FrameError: the file is missing, unreadable, empty or truncated, or holds NaN or Inf.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise FrameError(path, "scan must exist, got no such file") from None
    except OSError as error:
        raise FrameError(path, f"scan must be readable, got {error}") from None
    _require_whole_points(path, len(content))
    points = np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(-1, 4)
    require_finite_points(path, points)
    return points


def check_scan_size(path: Path) -> None:
    """Check the size of a scan without reading it; raises as `read_scan`."""
    try:
        _require_whole_points(path, path.stat().st_size)
    except FileNotFoundError:
        raise FrameError(path, "scan must exist, got no such file") from None


def _require_whole_points(path: Path, num_bytes: int) -> None:
    if num_bytes == 0 or num_bytes % BYTES_PER_POINT:
        raise FrameError(
            path,
            f"scan must hold whole points of {BYTES_PER_POINT} bytes (float32 x, y, z, intensity), "
            f"got {num_bytes} bytes: truncated?",
        )


def sequence_names(root: Path) -> list[str]:
    """Every folder under data/. One whose name starts with a dot is being written.

    Raises:
        FrameError: there is no data/.
    """
    folder = root / "data"
    if not folder.is_dir():
        raise FrameError(folder, "must be a folder with one folder per sequence, got no such folder")
    return sorted(path.name for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def split_names(root: Path, split: str) -> list[str]:
    """Sequences that ImageSets/ lists for a split.

    Raises:
        FrameError: the list is missing or holds something else.
    """
    path = root / "ImageSets" / f"{split}.txt"
    try:
        lines = path.read_text(encoding="utf-8").split()
    except FileNotFoundError:
        present = ", ".join(sorted(file.stem for file in path.parent.glob("*.txt"))) or "none"
        raise FrameError(path, f"list of the split must exist, got no such file; there are: {present}") from None
    except (OSError, ValueError) as error:
        raise FrameError(path, f"list of the split must be a readable text, got {error}") from None
    for name in lines:
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise FrameError(path, f"list must hold names of sequences, got {name!r}")
    return list(dict.fromkeys(lines))


def read_sequence(folder: Path) -> OnceSequence:
    """The JSON file of a sequence, checked.

    Raises:
        FrameError: it is missing or damaged, or breaks a rule of the format; the text says where.
    """
    path = folder / f"{folder.name}.json"
    content = read_json(path, "file of the sequence")
    try:
        calibrations = {name: _calibration(name, row) for name, row in content["calib"].items()}
        frames = content["frames"]
        if not isinstance(frames, list):
            raise TypeError
    except KeyError as error:
        raise FrameError(path, f"must have the keys calib and frames, got no {error}") from None
    except (AttributeError, TypeError):
        raise FrameError(path, "must be {calib: {camera: ...}, frames: [...]}, got another structure") from None
    except ValueError as error:
        raise FrameError(path, str(error)) from None
    frame_ids: list[str] = []
    poses = array("d")
    annotations: dict[int, _Annotation] = {}
    for row, frame in enumerate(frames):
        try:
            frame_ids.append(_frame_id(frame["frame_id"]))
            poses.extend(_pose(frame.get("pose")))
            annotation = _annotation(frame.get("annos"))
            if annotation is not None:
                annotations[row] = annotation
        except KeyError as error:
            raise FrameError(path, f"frame {row} must have the key {error}, got none") from None
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise FrameError(path, f"frame {row} must be well-formed, got {error}") from None
    if len(set(frame_ids)) < len(frame_ids):
        twice = next(frame_id for frame_id in frame_ids if frame_ids.count(frame_id) > 1)
        raise FrameError(path, f"frame_id must be unique, got {twice} twice")
    return OnceSequence(
        folder,
        calibrations,
        np.array(frame_ids, dtype=np.str_),
        np.frombuffer(poses, dtype=np.float64).reshape(-1, 7),
        annotations,
    )


def _calibration(name: str, row: dict[str, Any]) -> _Calibration:
    if name not in CAMERAS:
        raise ValueError(f"calib must be of the cameras {', '.join(CAMERAS)}, got {name!r}")
    values: dict[str, NDArray[np.float64]] = {}
    for key in ("cam_to_velo", "cam_intrinsic", "distortion"):
        if key not in row:
            raise ValueError(f"calib {name} must have the key {key!r}, got none")
        values[key] = _numbers(row[key], f"calib {name}: {key}")
    T, intrinsics, distortion = values["cam_to_velo"], values["cam_intrinsic"], values["distortion"].ravel()
    for key, size in (("cam_to_velo", 4), ("cam_intrinsic", 3)):
        if values[key].shape != (size, size):
            raise ValueError(f"calib {name}: {key} must be {size} x {size} numbers, got {list(values[key].shape)}")
    rotation = T[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise ValueError(f"calib {name}: cam_to_velo must be a rigid transform, got {T.tolist()}")
    if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
        raise ValueError(f"calib {name}: cam_intrinsic must have positive focal lengths, got {intrinsics.tolist()}")
    if len(distortion) not in COEFFICIENT_COUNTS:
        raise ValueError(f"calib {name}: distortion must be {COEFFICIENT_COUNTS} numbers, got {len(distortion)}")
    return _Calibration(tuple(T.ravel().tolist()), tuple(intrinsics.ravel().tolist()), tuple(distortion.tolist()))


def _frame_id(value: Any) -> str:
    if not isinstance(value, str | int) or not re.fullmatch(r"\w[\w-]*", str(value)):
        raise ValueError(f"frame_id {value!r}")
    return str(value)


def _pose(value: Any) -> list[float]:
    """Quaternion x y z w, translation; NaN where the data set has none: no entry, or a quaternion of zeros."""
    if value is None:
        return NO_POSE
    pose = [float(number) for number in value]
    if len(pose) != 7 or not math.isfinite(sum(pose)):
        raise ValueError(f"pose {value}, which is not a quaternion x, y, z, w and a translation")
    norm = math.hypot(*pose[:4])
    if norm == 0:
        return NO_POSE
    if abs(norm - 1.0) > 1e-2:
        raise ValueError(f"pose {value}, whose first four numbers are not a unit quaternion")
    return pose


def _annotation(value: Any) -> _Annotation | None:
    """None where nobody annotated the frame: no entry, or one without names."""
    if value is None or "names" not in value:
        return None
    names = [str(name) for name in value["names"]]
    boxes = _numbers(value["boxes_3d"], "boxes_3d")
    if boxes.shape != (len(names), 7) and (len(names) or boxes.size):
        raise ValueError(f"boxes_3d of shape {list(boxes.shape)} for {len(names)} names")
    boxes = boxes.reshape(len(names), 7)
    unknown = sorted({*names} - {*CLASSES})
    if unknown:
        raise ValueError(f"names {', '.join(unknown)}; known are {', '.join(CLASSES)}")
    if not (boxes[:, 3:6] >= 0).all():
        raise ValueError("boxes_3d with a negative size")
    return _Annotation(names, boxes)


def _numbers(value: Any, what: str) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be numbers in rows of one length, got {value}") from None
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} must be finite, got {value}")
    return numbers
