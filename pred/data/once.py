# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for the official ONCE layout (ImageSets/, data/<sequence>/).

LiDAR axes are x left, y back, z up, and stay so. The JSON files of the sequences are read once, into the file of
`pred.data.index`; `OnceFrames` reads that file, and loader processes share its pages.

Facts about the format: the ONCE documentation, the code of once_devkit, and its issues 8 (axes), 21 and 22 (order of
the pose, gaps between frames).
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pred.data.frame import (
    ONCE_EGO_BOX,
    Boxes,
    Camera,
    EgoBox,
    Frame,
    FrameError,
    invert_rigid,
    quaternion_of,
    read_rgb,
    require_intrinsics,
    rgb_image_size,
)
from pred.data.index import (
    Calibrations,
    FrameIndex,
    Images,
    IndexedBoxes,
    IndexedFrames,
    Sweeps,
    number_lists,
    offsets_of,
    open_index,
    rigid,
    strings,
)
from pred.data.labels import PseudoLabel, find_label_file, label_folder
from pred.data.sweeps import check_points_size, place_sweep, read_points, require_finite_points
from pred.data.tables import Report, raise_problem, read_json, reading_progress
from pred.data.undistort import COEFFICIENT_COUNTS, undistort_image, undistorted_intrinsics

CAMERAS = ("cam01", "cam03", "cam05", "cam06", "cam07", "cam08", "cam09")
"""Front, front (other lens), left back, left front, right front, right back, back."""
CLASSES = ("Car", "Truck", "Bus", "Pedestrian", "Cyclist")
LIDAR = "lidar_roof"
SCAN_COLUMNS = ("x", "y", "z", "intensity")
PIXEL_CENTRE = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Added to intrinsics of the data set, which are OpenCV's, with pixel centres at whole numbers; in
`pred.data.frame.Camera` they are at halves."""
NO_POSE = [math.nan] * 7


class _Calibration(NamedTuple):
    """One camera of one sequence."""

    T_lidar_from_camera: NDArray[np.float64]  # [4, 4]
    intrinsics: NDArray[np.float64]  # [3, 3] of the image on disk
    distortion: list[float]


class _Annotation(NamedTuple):
    names: list[str]
    boxes: NDArray[np.float64]  # [M, 7] as in the file


@dataclass
class OnceSequence:
    """What is kept of the JSON file of a sequence with n frames."""

    name: str
    calibrations: dict[str, _Calibration]
    frame_ids: list[str]  # n
    poses: NDArray[np.float64]  # [n, 7] quaternion x y z w, translation; NaN where there is none
    annotations: dict[int, _Annotation]  # by row; frames that nobody annotated have none


class OnceFrames(IndexedFrames):
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
        ego_box: EgoBox = ONCE_EGO_BOX,
        undistort: bool = True,
    ) -> None:
        self.root = Path(root)
        self.ego_box = ego_box
        self.undistort = undistort
        self.labels = label_folder(self.root, labels)
        self._index = self._open_index()
        self._rows = self._select(sequence_names(self.root) if split is None else split_names(self.root, split))
        if len(self) == 0:
            raise ValueError(f"data.split must select frames of {self.root}, got none: {split}")

    def frame_id(self, index: int) -> str:
        """The data set's own name of the frame: its time in milliseconds."""
        return _frame_id_of(self._index, self._row(index))

    def has_pose(self, index: int) -> bool:
        """Whether the data set knows where the frame was taken."""
        return bool(self._index.sweeps.pose[self._row(index)] >= 0)

    def annotation(self, index: int) -> tuple[list[str], NDArray[np.float64]] | None:
        """Names and boxes [M, 7] (centre, length, width, height in metres, yaw in radians) as they are in the file (the
        yaw up to rounding, and in [-2 pi, 2 pi]), or None if nobody annotated the frame."""
        row = self._row(index)
        boxes = self._index.boxes
        if not boxes.annotated[row]:
            return None
        rows = slice(*boxes.offsets[row : row + 2].tolist())
        pose = boxes.pose[rows]
        yaw_rad = 2.0 * np.arctan2(pose[:, 6], pose[:, 3])
        return boxes.name[rows].to_pylist(), np.column_stack([pose[:, :3], boxes.size_lwh[rows], yaw_rad])

    def load(self, index: int) -> Frame:
        """Read the scan of frame ``index`` and the headers of its images.

        Raises:
            FrameError: a file is missing, truncated, of the wrong type or size, or holds NaN or Inf.
        """
        row = self._row(index)
        scan = self._file(self._index.sweeps, row)
        points, point_index = place_sweep(read_scan(scan), np.eye(4), self.ego_box, lag_s=0.0)
        cameras = (self._camera(image, row) for image in range(*self._index.images.offsets[row : row + 2]))
        pose = int(self._index.sweeps.pose[row])
        return Frame(
            token=self.token(index),
            points=points,
            point_index=point_index,
            is_keyframe=np.ones(len(points), dtype=np.bool_),
            cameras=[camera for camera in cameras if camera is not None],
            T_world_from_lidar=rigid(self._index.poses[pose]) if pose >= 0 else np.eye(4),
            source=str(scan),
            boxes=_boxes(self.annotation(index)),
        )

    def _open_index(self) -> FrameIndex:
        files = [sequence_file(self.root, name) for name in sequence_names(self.root)]
        # What is wrong with a sequence is told where it is selected.
        return open_index(self.root, files, partial(build_index, self.root, report=lambda problem: None))

    def _select(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Rows of the frames of some sequences, in the order of the names."""
        place = pc.index_in(self._index.recording, value_set=strings(names)).fill_null(-1).to_numpy()
        for without_frames in {*range(len(names))} - {*np.unique(place).tolist()}:
            read_sequence(self.root, names[without_frames])
        order = np.argsort(place, kind="stable")
        return order[np.count_nonzero(place < 0) :]

    def _camera(self, image: int, row: int) -> Camera | None:
        images, calibrations = self._index.images, self._index.calibrations
        path = self._file(images, image)
        if self.labels is None and not path.is_file():
            return None
        width, height = rgb_image_size(path)
        calibration = int(images.calibration[image])
        name = str(calibrations.channel[calibration])
        intrinsics, distortion = calibrations.intrinsics[calibration], calibrations.distortion[calibration].as_py()
        camera = Camera(
            name=name,
            intrinsics=intrinsics + PIXEL_CENTRE,
            T_camera_from_lidar=invert_rigid(rigid(calibrations.pose[calibration])),
            width=width,
            height=height,
            image=path,
        )
        if self.undistort and any(distortion):
            straight = pinhole_intrinsics(self.root, self._index, calibration, width, height)
            camera.intrinsics = straight + PIXEL_CENTRE
            camera.image = partial(_read_undistorted, path, intrinsics, distortion, straight)
        if self.labels is not None:
            label_file = find_label_file(self.labels / str(self._index.recording[row]) / name, path.stem)
            camera.labels = PseudoLabel(label_file, width, height)
        return camera


def pinhole_intrinsics(root: Path, index: FrameIndex, calibration: int, width: int, height: int) -> NDArray[np.float64]:
    """[3, 3] intrinsics of the undistorted images of one camera of one sequence, with OpenCV's pixel centres.

    Raises:
        FrameError: the distortion cannot be undone.
    """
    camera = index.calibrations
    try:
        return _pinhole(
            tuple(camera.intrinsics[calibration].ravel().tolist()),
            tuple(camera.distortion[calibration].as_py()),
            width,
            height,
        )
    except ValueError as error:
        frame = frame_of(index.images, int(np.argmax(index.images.calibration == calibration)))
        path = sequence_file(root, str(index.recording[frame]))
        raise FrameError(
            path,
            f"calib {camera.channel[calibration]}: {error}; data.undistort false takes the images as they are",
        ) from None


@lru_cache(maxsize=1 << 13)  # the cameras of all sequences
def _pinhole(
    intrinsics: tuple[float, ...], distortion: tuple[float, ...], width: int, height: int
) -> NDArray[np.float64]:
    return undistorted_intrinsics(np.reshape(intrinsics, (3, 3)), distortion, width, height)


def _read_undistorted(
    path: Path, intrinsics: NDArray[np.float64], distortion: list[float], new_intrinsics: NDArray[np.float64]
) -> NDArray[np.uint8]:
    return undistort_image(read_rgb(path), intrinsics, distortion, new_intrinsics)


def _boxes(annotation: tuple[list[str], NDArray[np.float64]] | None) -> Boxes | None:
    if annotation is None:
        return None
    names, boxes = annotation
    yaw_rad = np.arctan2(np.sin(boxes[:, 6]), np.cos(boxes[:, 6]))
    return Boxes(centre_m=boxes[:, :3], size_m=boxes[:, 3:6], yaw_rad=yaw_rad, names=names)


# The index


def build_index(root: Path, report: Report = raise_problem) -> FrameIndex:
    """Read the JSON files of all sequences. Row f of the frames has row f of the sweeps.

    Args:
        root: folder of the data set.
        report: gets each problem as a `FrameError`; if it returns, that sequence is left out.
    """
    names = sequence_names(root)
    files = [sequence_file(root, name) for name in names]
    columns = _Columns()
    with reading_progress(f"indexing {root.name}", files) as advance:
        for name, file in zip(names, files, strict=True):
            try:
                columns.add(read_sequence(root, name))
            except FrameError as problem:
                report(problem)
            else:
                advance(file.stat().st_size)
    return columns.index()


class _Columns:
    """Columns of the index that grow by sequences."""

    def __init__(self) -> None:
        self.sequences: list[str] = []
        self.num_frames: list[int] = []
        self.frame_ids: list[str] = []
        self.poses: list[NDArray[np.float64]] = [np.zeros((0, 7))]
        self.sensors: list[tuple[str, _Calibration]] = []
        self.num_cameras: list[int] = []
        self.box_names: list[str] = []
        self.boxes: list[NDArray[np.float64]] = [np.zeros((0, 7))]
        self.annotated_frames: list[int] = []
        self.num_boxes: list[int] = []

    def add(self, sequence: OnceSequence) -> None:
        first = len(self.frame_ids)
        for row, annotation in sequence.annotations.items():
            self.annotated_frames.append(first + row)
            self.num_boxes.append(len(annotation.names))
            self.box_names += annotation.names
            self.boxes.append(annotation.boxes)
        self.sequences.append(sequence.name)
        self.num_frames.append(len(sequence.frame_ids))
        self.frame_ids += sequence.frame_ids
        self.poses.append(sequence.poses)
        cameras = [(name, sequence.calibrations[name]) for name in CAMERAS if name in sequence.calibrations]
        self.sensors += [(LIDAR, _Calibration(np.eye(4), np.zeros((3, 3)), [])), *cameras]
        self.num_cameras.append(len(cameras))

    def index(self) -> FrameIndex:
        num_frames = len(self.frame_ids)
        row = np.arange(num_frames, dtype=np.int32)
        frame_id = strings(self.frame_ids)
        time_us = np.array([_time_us(name) for name in self.frame_ids], dtype=np.int64)
        # A sequence has a row for its LiDAR in the calibrations, and then one for each of its cameras.
        num_cameras = np.array(self.num_cameras, dtype=np.int32)
        lidar = np.cumsum(num_cameras + 1, dtype=np.int32) - num_cameras - 1
        sequence = np.repeat(np.arange(len(lidar), dtype=np.int32), self.num_frames)  # [F]
        recording = strings(self.sequences).take(pa.array(sequence))
        channel = strings([name for name, _ in self.sensors])
        frame_pose = np.concatenate(self.poses)
        has_pose = ~np.isnan(frame_pose[:, 0])
        pose = np.where(has_pose, np.cumsum(has_pose) - 1, -1).astype(np.int32)
        # Images, frame after frame.
        owner = np.repeat(row, num_cameras[sequence])  # [images]
        offsets = offsets_of(owner, num_frames)
        camera = np.arange(len(owner), dtype=np.int32) - offsets[owner]
        calibration = (lidar[sequence[owner]] + 1 + camera).astype(np.int32)
        box_owner = np.repeat(np.array(self.annotated_frames, dtype=np.int64), self.num_boxes)
        box = np.concatenate(self.boxes)
        annotated = np.zeros(num_frames, dtype=np.bool_)
        annotated[self.annotated_frames] = True
        return FrameIndex(
            calibrations=Calibrations(
                channel=channel,
                pose=np.array(
                    [
                        (*camera.T_lidar_from_camera[:3, 3], *quaternion_of(camera.T_lidar_from_camera[:3, :3]))
                        for _, camera in self.sensors
                    ]
                ).reshape(-1, 7),
                intrinsics=np.array([camera.intrinsics for _, camera in self.sensors]).reshape(-1, 3, 3),
                distortion=number_lists([camera.distortion for _, camera in self.sensors]),
            ),
            poses=frame_pose[has_pose][:, [4, 5, 6, 3, 0, 1, 2]],
            sweeps=Sweeps(
                path=_paths(recording, strings([LIDAR]).take(pa.array(0 * row)), frame_id, "bin"),
                time_us=time_us,
                calibration=lidar[sequence],
                pose=pose,
                previous=np.where(np.diff(sequence, prepend=-1) > 0, -1, row - 1).astype(np.int32),
                frame=row,
            ),
            token=pc.binary_join_element_wise(recording, frame_id, "_"),
            recording=recording,
            sweep=row,
            images=Images(
                path=_paths(
                    recording.take(pa.array(owner)),
                    channel.take(pa.array(calibration)),
                    frame_id.take(pa.array(owner)),
                    "jpg",
                ),
                time_us=time_us[owner],
                calibration=calibration,
                pose=pose[owner],
                width=np.zeros(len(owner), dtype=np.int32),
                height=np.zeros(len(owner), dtype=np.int32),
                offsets=offsets,
            ),
            boxes=IndexedBoxes(
                name=strings(self.box_names),
                # A turn about z; the sign of the quaternion keeps yaws of up to two full turns apart.
                pose=np.column_stack(
                    [box[:, :3], np.cos(box[:, 6] / 2), np.zeros((len(box), 2)), np.sin(box[:, 6] / 2)]
                ),
                size_lwh=box[:, 3:6],
                offsets=offsets_of(box_owner, num_frames),
                annotated=annotated,
            ),
        )


def _paths(sequence: pa.StringArray, sensor: pa.StringArray, frame_id: pa.StringArray, suffix: str) -> pa.StringArray:
    file = pc.binary_join_element_wise(frame_id, suffix, ".")
    return pc.binary_join_element_wise("data", sequence, sensor, file, "/")


def _time_us(frame_id: str) -> int:
    """Frames are named by milliseconds; others have no time."""
    return 1000 * int(frame_id) if frame_id.isdecimal() and len(frame_id) < 16 else 0


def _frame_id_of(index: FrameIndex, row: int) -> str:
    return str(index.token[row])[len(str(index.recording[row])) + 1 :]


def frame_of(images: Images, row: int) -> int:
    """The frame that a row of the images belongs to."""
    return int(np.searchsorted(images.offsets, row, side="right")) - 1


# Files


def read_scan(path: Path) -> NDArray[np.float32]:
    """[N, 4] float32 x, y, z (metres), intensity.

    Raises:
        FrameError: the file is missing, unreadable, empty or truncated, or holds NaN or Inf.
    """
    points = read_points(path, SCAN_COLUMNS).astype(np.float32)
    require_finite_points(path, points)
    return points


def check_scan_size(path: Path) -> None:
    """Check the size of a scan without reading it; raises as `read_scan`."""
    check_points_size(path, SCAN_COLUMNS)


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


def sequence_file(root: Path, name: str) -> Path:
    """The JSON file of a sequence."""
    return root / "data" / name / f"{name}.json"


def read_sequence(root: Path, name: str) -> OnceSequence:
    """The JSON file of a sequence, checked.

    Raises:
        FrameError: it is missing or damaged, or breaks a rule of the format; the text says where.
    """
    path = sequence_file(root, name)
    content = read_json(path, "file of the sequence")
    try:
        calibrations = {camera: _calibration(camera, row) for camera, row in content["calib"].items()}
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
        name,
        calibrations,
        frame_ids,
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
    T, distortion = values["cam_to_velo"], values["distortion"].ravel()
    intrinsics = require_intrinsics(values["cam_intrinsic"], f"calib {name}: cam_intrinsic")
    if T.shape != (4, 4):
        raise ValueError(f"calib {name}: cam_to_velo must be 4 x 4 numbers, got {list(T.shape)}")
    rotation = T[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise ValueError(f"calib {name}: cam_to_velo must be a rigid transform, got {T.tolist()}")
    if len(distortion) not in COEFFICIENT_COUNTS:
        raise ValueError(f"calib {name}: distortion must be {COEFFICIENT_COUNTS} numbers, got {len(distortion)}")
    return _Calibration(T, intrinsics, distortion.tolist())


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
