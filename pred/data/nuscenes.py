# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for drive logs in the official nuScenes layout (JSON tables, samples/, sweeps/).

The tables of the full data set hold millions of rows. `build_index` reads them once, into the file of
`pred.data.index`; `NuScenesFrames` reads that file, and loader processes share its pages.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import (
    EGO_BOX,
    Boxes,
    Camera,
    EgoBox,
    Frame,
    FrameError,
    check_image_header,
    invert_rigid,
    require_inside,
    require_intrinsics,
    transform_points,
)
from pred.data.image_depth import DepthMap, depth_folder
from pred.data.index import (
    Calibrations,
    FrameIndex,
    Images,
    IndexedBoxes,
    IndexedFrames,
    Readings,
    Sweeps,
    number_lists,
    offsets_of,
    open_index,
    rigid,
    strings,
)
from pred.data.info_files import load_info
from pred.data.labels import PseudoLabel, find_label_file, label_folder
from pred.data.lidarseg import NO_CLASS, class_files, class_ids_of_categories, read_point_classes
from pred.data.sweeps import Accumulated, Sweep, accumulate, check_points_size, read_points, require_finite_points
from pred.data.tables import Report, Row, raise_problem, read_json, read_table, reading_progress

LIDAR_CHANNEL = "LIDAR_TOP"
SWEEP_COLUMNS = ("x", "y", "z", "intensity", "ring")
MISSING_SWEEP_HINT = " (without sweeps/: data.sweeps 1)"
MICROSECONDS = 1e-6

TABLES = (
    "sensor", "calibrated_sensor", "scene", "sample", "sample_data", "ego_pose", "category", "instance",
    "sample_annotation",
)  # fmt: skip
"""What the index is made from."""

MAX_INFO_OFFSET_M = 0.05
"""Box centres of info files, some of them float32, differ by millimetres from those of the tables."""


class NuScenesFrames(IndexedFrames):
    """Keyframes of a nuScenes-like data set as a `FrameSource`.

    Args:
        root: folder with the table folder, samples/ and sweeps/.
        version: table folder; None takes the only one named like ``v1.0-*``.
        split: name in the version's ``splits.json``, or an official split name (these lists come
            from the devkit); None takes every sample.
        sweeps: at most so many LIDAR_TOP sweeps per frame, the keyframe's own included, each
            moved to the keyframe's LiDAR frame through the ego poses.
        labels: folder under `root` with ``<CAMERA>/<image stem>.png|.npy|.npz``; "auto" takes the
            only folder under ``pseudo/`` if there is one; "none" reads no labels. With labels,
            every listed image and its label must exist.
        ego_box: (x_min, y_min, x_max, y_max) in metres; returns in it are the own car and are
            removed from each sweep in the sweep's own frame.
        info: info file of OpenPCDet or mmdetection3d; its samples, in its order, are the frames.
        image_depth: folder under `root` with depth maps ``<CAMERA>/<image stem>.png`` (`pred.data.image_depth`), read
            when asked for; None or "none": no depth.
        point_classes: fill `Frame.semantics` of the keyframe's own returns, if the version has a lidarseg.json
            (`pred.data.lidarseg`). For evaluation; training reads none of it.

    Raises:
        FrameError: a table is missing or damaged, a folder cannot be found, or the info file does not fit the tables.
        ValueError: the split is unknown or empty.
    """

    def __init__(
        self,
        root: str | Path,
        version: str | None = None,
        split: str | None = None,
        sweeps: int = 10,
        labels: str | None = "auto",
        ego_box: EgoBox = EGO_BOX,
        info: str | Path | None = None,
        image_depth: str | None = None,
        point_classes: bool = False,
    ) -> None:
        if split is not None and info is not None:
            raise ValueError(f"data.split must not be given with data.info, which selects the frames, got {split!r}")
        self.root = Path(root)
        self.tables = self.root / version if version else only_table_folder(self.root)
        self.sweeps = sweeps
        self.ego_box = ego_box
        self.labels = label_folder(self.root, labels)
        self.depth = depth_folder(self.root, image_depth)
        self._class_files: dict[str, str] | None = None
        if point_classes and (self.tables / "lidarseg.json").exists():
            self._class_files, self._class_ids = class_files(self.tables), class_ids_of_categories(self.tables)
        self._index = self._open_index()
        self._rows = self._select(split) if info is None else self._select_infos(Path(info))

    def load(self, index: int) -> Frame:
        """Read the sweeps of keyframe ``index``. With labels, images are checked by their headers
        and labels to exist; without, images may be missing.

        Raises:
            FrameError: a file is missing, truncated, of the wrong type or size, or holds NaN or Inf.
        """
        row = self._row(index)
        token = str(self._index.token[row])
        keyframe = int(self._index.sweep[row])
        if keyframe < 0:
            raise no_keyframe(self.tables, token)
        T_world_from_lidar = self._sensor_pose(self._index.sweeps, keyframe)
        sweeps = accumulate(self._sweeps(keyframe, T_world_from_lidar), self.ego_box)
        images = range(*self._index.images.offsets[row : row + 2])
        return Frame(
            token=token,
            **sweeps._asdict(),
            cameras=[self._camera(image, T_world_from_lidar) for image in images],
            T_world_from_lidar=T_world_from_lidar,
            source=str(self._file(self._index.sweeps, keyframe)),
            semantics=None if self._class_files is None else self._point_classes(keyframe, sweeps, self._class_files),
            boxes=self._boxes(row, T_world_from_lidar),
        )

    def _open_index(self) -> FrameIndex:
        sources = [self.tables / f"{name}.json" for name in TABLES]
        return open_index(self.tables, sources, partial(build_index, self.tables))

    def _select(self, split: str | None) -> NDArray[np.int64]:
        """Rows of the split's frames in the index, in table order."""
        rows = np.arange(len(self._index)) if split is None else self._index.frames_of(_scene_names(self.tables, split))
        if not len(rows):
            raise ValueError(f"data.split must select samples of {self.tables}, got none: {split}")
        return rows

    def _select_infos(self, path: Path) -> NDArray[np.int64]:
        """Rows of the frames that an info file lists. Its boxes must be among those of the tables."""
        rows_by_token = {token: row for row, token in enumerate(self._index.token.to_pylist())}
        rows = []
        for info in load_info(path):
            row = rows_by_token.get(info.token)
            if row is None:
                raise FrameError(path, f"samples must be in {self.tables}, got {info.token}, which is not")
            if info.centres_m is not None and len(info.centres_m) and self._index.sweep[row] >= 0:
                self._check_info_boxes(path, row, info.centres_m)
            rows.append(row)
        return np.array(rows, dtype=np.int64)

    def _check_info_boxes(self, path: Path, row: int, centres_m: NDArray[np.float64]) -> None:
        boxes = self._index.boxes
        centres_world = boxes.pose[slice(*boxes.offsets[row : row + 2].tolist()), :3]
        T_lidar_from_world = invert_rigid(self._sensor_pose(self._index.sweeps, int(self._index.sweep[row])))
        offset_m = centres_m[:, None] - transform_points(T_lidar_from_world, centres_world)[None]
        distance_m = np.linalg.norm(offset_m, axis=2).min(axis=1, initial=np.inf)
        worst = int(np.argmax(distance_m))
        if not distance_m[worst] <= MAX_INFO_OFFSET_M:
            raise FrameError(
                path,
                f"boxes of sample {self._index.token[row]} must be those of {self.tables}, "
                f"got box {worst} {distance_m[worst]:.2f} m away from the nearest",
            )

    def _sensor_pose(self, readings: Readings, row: int) -> NDArray[np.float64]:
        """T_world_from_sensor at the time of the measurement."""
        T_world_from_ego = rigid(self._index.poses[readings.pose[row]])
        return T_world_from_ego @ rigid(self._index.calibrations.pose[readings.calibration[row]])

    def _sweeps(self, keyframe: int, T_world_from_lidar: NDArray[np.float64]) -> Iterator[Sweep]:
        """The keyframe's own sweep and those before it."""
        sweeps = self._index.sweeps
        row = keyframe
        for _ in range(self.sweeps):
            frame = int(sweeps.frame[row])
            yield Sweep(
                points=read_sweep(self._file(sweeps, row)),
                # A keyframe's points stay as measured, to the bit.
                T_keyframe_from_sweep=np.eye(4)
                if row == keyframe
                else invert_rigid(T_world_from_lidar) @ self._sensor_pose(sweeps, row),
                lag_s=float(sweeps.time_us[keyframe] - sweeps.time_us[row]) * MICROSECONDS,
                frame=str(self._index.token[frame]) if frame >= 0 else None,
            )
            row = int(sweeps.previous[row])
            if row < 0:
                return

    def _point_classes(self, keyframe: int, sweeps: Accumulated, files: dict[str, str]) -> NDArray[np.int64]:
        """[N] classes of the keyframe's own returns; no other has one."""
        sweep_file = str(self._index.sweeps.path[keyframe])
        if sweep_file not in files:
            raise FrameError(self.tables / "lidarseg.json", f"table must have a row for {sweep_file}, got none")
        num_points = self._file(self._index.sweeps, keyframe).stat().st_size // (4 * len(SWEEP_COLUMNS))
        classes = read_point_classes(self.root / files[sweep_file], num_points, self._class_ids)
        semantics = np.full(len(sweeps.points), NO_CLASS, dtype=np.int64)
        semantics[sweeps.is_keyframe] = classes[sweeps.point_index[sweeps.is_keyframe]]
        return semantics

    def _camera(self, row: int, T_world_from_lidar: NDArray[np.float64]) -> Camera:
        images = self._index.images
        calibration = int(images.calibration[row])
        channel = str(self._index.calibrations.channel[calibration])
        width, height = int(images.width[row]), int(images.height[row])
        image = self._file(images, row)
        labels = None
        if self.labels is not None:
            check_image_header(image, width, height)
            labels = PseudoLabel(find_label_file(self.labels / channel, image.stem), width, height)
        return Camera(
            name=channel,
            intrinsics=self._index.calibrations.intrinsics[calibration],
            # Through the world: the ego car moves between the LiDAR's and the camera's time.
            T_camera_from_lidar=invert_rigid(self._sensor_pose(images, row)) @ T_world_from_lidar,
            width=width,
            height=height,
            image=image if labels is not None or image.is_file() else None,
            labels=labels,
            depth=None if self.depth is None else DepthMap(self.depth / channel / f"{image.stem}.png", width, height),
        )

    def _boxes(self, row: int, T_world_from_lidar: NDArray[np.float64]) -> Boxes:
        boxes = self._index.boxes
        rows = slice(*boxes.offsets[row : row + 2].tolist())
        T_lidar_from_world = invert_rigid(T_world_from_lidar)
        poses = [T_lidar_from_world @ rigid(pose) for pose in boxes.pose[rows]]
        T_lidar_from_box = np.stack(poses) if poses else np.zeros((0, 4, 4))
        return Boxes(
            centre_m=T_lidar_from_box[:, :3, 3],
            size_m=boxes.size_lwh[rows],
            yaw_rad=np.arctan2(T_lidar_from_box[:, 1, 0], T_lidar_from_box[:, 0, 0]),
            names=boxes.name[rows].to_pylist(),
        )


# The index


class _Reader(NamedTuple):
    """Reads the tables of one folder."""

    folder: Path
    report: Report
    advance: Callable[[int], None]

    def __call__(self, name: str, read_row: Callable[[Row], Any]) -> list[Any]:
        return read_table(self.folder / f"{name}.json", read_row, self.report, self.advance)


def build_index(tables: Path, report: Report = raise_problem) -> FrameIndex:
    """Read the tables of a version folder. Of sample_data, LIDAR_TOP and the cameras' keyframes are kept.

    Args:
        tables: folder with the JSON tables.
        report: gets each problem as a `FrameError`; if it returns, the rows concerned are left out.
    """
    with reading_progress(f"indexing {tables.name}", [tables / f"{name}.json" for name in TABLES]) as advance:
        return _build_index(_Reader(tables, report, advance))


def _build_index(read: _Reader) -> FrameIndex:
    frame_rows, scenes = _read_samples(read)
    calibrations, calibration_rows, is_camera = _read_calibrations(read)
    sweeps, images, poses = _read_sample_data(
        read, frame_rows, calibrations.channel.to_pylist(), calibration_rows, is_camera
    )
    own_sweep = np.full(len(frame_rows), -1, dtype=np.int32)
    keyframes = np.flatnonzero(sweeps.frame >= 0)
    own_sweep[sweeps.frame[keyframes]] = keyframes
    return FrameIndex(
        calibrations=calibrations,
        poses=poses,
        sweeps=sweeps,
        token=strings(list(frame_rows)),
        recording=strings(scenes),
        sweep=own_sweep,
        images=images,
        boxes=_read_boxes(read, frame_rows),
    )


def _read_samples(read: _Reader) -> tuple[dict[str, int], list[str]]:
    """Row of each frame by sample token, and the scene names of the frames."""
    scenes = dict(read("scene", lambda row: (_text(row["token"]), _text(row["name"]))))
    rows: dict[str, int] = {}

    def read_row(row: Row) -> str:
        token, scene = _text(row["token"]), scenes[row["scene_token"]]
        _add_row(rows, token)
        return scene

    return rows, read("sample", read_row)


def _read_calibrations(read: _Reader) -> tuple[Calibrations, dict[str, int], list[bool]]:
    """The sensors, their row by token, and which of them are cameras."""
    sensors = dict(
        read("sensor", lambda row: (_text(row["token"]), (_text(row["channel"]), row["modality"] == "camera")))
    )
    rows: dict[str, int] = {}

    def read_row(row: Row) -> tuple[str, bool, list[float], list[float]]:
        channel, is_camera = sensors[row["sensor_token"]]
        intrinsics = row["camera_intrinsic"]
        if is_camera:
            require_intrinsics(intrinsics, "camera_intrinsic")
        pose = _pose(row)
        _add_row(rows, row["token"])
        return channel, is_camera, pose, np.ravel(intrinsics).tolist() if is_camera else [0.0] * 9

    read_rows = read("calibrated_sensor", read_row)
    calibrations = Calibrations(
        channel=strings([channel for channel, _, _, _ in read_rows]),
        pose=np.array([pose for _, _, pose, _ in read_rows], dtype=np.float64).reshape(-1, 7),
        intrinsics=np.array([intrinsics for _, _, _, intrinsics in read_rows], dtype=np.float64).reshape(-1, 3, 3),
        distortion=number_lists([[]] * len(read_rows)),
    )
    return calibrations, rows, [is_camera for _, is_camera, _, _ in read_rows]


class _Rows:
    """Rows of sample_data of one kind, as columns that grow."""

    def __init__(self) -> None:
        self.paths: list[str] = []
        self.pose_tokens: list[str] = []
        self.numbers = array("q")  # five for each row

    def add(self, row: Row, calibration: int, frame: int, width: int = 0, height: int = 0) -> None:
        numbers = array("q", (row["timestamp"], calibration, frame, width, height))
        path, pose_token = require_inside(_text(row["filename"])), _text(row["ego_pose_token"])
        # Nothing is kept of a row with a wrong value.
        self.paths.append(path)
        self.pose_tokens.append(pose_token)
        self.numbers.extend(numbers)

    def columns(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Times, and [4, n] calibration, frame, width, height."""
        numbers = np.frombuffer(self.numbers, dtype=np.int64).reshape(-1, 5).T
        return numbers[0].copy(), numbers[1:].astype(np.int32)


def _read_sample_data(
    read: _Reader,
    frame_rows: dict[str, int],
    channels: list[str],
    calibration_rows: dict[str, int],
    is_camera: list[bool],
) -> tuple[Sweeps, Images, NDArray[np.float64]]:
    """LiDAR sweeps, keyframe images, and the poses that both refer to."""
    sweep_rows, image_rows = _Rows(), _Rows()
    row_of_sweep: dict[str, int] = {}
    previous_tokens: list[str] = []

    def read_row(row: Row) -> None:
        calibration = calibration_rows[row["calibrated_sensor_token"]]
        is_keyframe = row["is_key_frame"]
        if is_camera[calibration] and is_keyframe:
            width, height = row["width"], row["height"]
            if not (width > 0 and height > 0):
                raise ValueError(f"width and height must be positive, got {width} x {height}")
            image_rows.add(row, calibration, frame_rows[row["sample_token"]], width, height)
        elif channels[calibration] == LIDAR_CHANNEL:
            frame = frame_rows[row["sample_token"]]
            token, previous = _text(row["token"]), _text(row["prev"])
            sweep_rows.add(row, calibration, frame if is_keyframe else -1)
            row_of_sweep[token] = len(previous_tokens)
            previous_tokens.append(previous)

    read("sample_data", read_row)
    pose_rows, poses = _read_ego_poses(read, {*sweep_rows.pose_tokens, *image_rows.pose_tokens})

    def rows_of_poses(rows: _Rows) -> NDArray[np.int32]:
        return np.array([pose_rows.get(token, -1) for token in rows.pose_tokens], dtype=np.int32)

    time_us, (calibration, frame, _, _) = sweep_rows.columns()
    sweeps = Sweeps(
        path=strings(sweep_rows.paths),
        time_us=time_us,
        calibration=calibration,
        pose=rows_of_poses(sweep_rows),
        # A sweep that is not in the table (a subset of a scene) ends the walk like a start.
        previous=np.array([row_of_sweep.get(token, -1) for token in previous_tokens], dtype=np.int32),
        frame=frame,
    )
    time_us, (calibration, frame, width, height) = image_rows.columns()
    order = _image_order(frame, [channels[row] for row in calibration])
    images = Images(
        path=strings(image_rows.paths).take(order),
        time_us=time_us[order],
        calibration=calibration[order],
        pose=rows_of_poses(image_rows)[order],
        width=width[order],
        height=height[order],
        offsets=offsets_of(frame[order], len(frame_rows)),
    )
    return sweeps, images, poses


def _image_order(frame: NDArray[np.int32], channel: list[str]) -> NDArray[np.int64]:
    """Rows of images by frame and then channel; of several images of one camera the last."""
    rows = {(owner, name): row for row, (owner, name) in enumerate(zip(frame.tolist(), channel, strict=True))}
    return np.array([rows[key] for key in sorted(rows)], dtype=np.int64)


def _read_ego_poses(read: _Reader, needed: set[str]) -> tuple[dict[str, int], NDArray[np.float64]]:
    """The poses with the needed tokens, and their row by token."""
    rows: dict[str, int] = {}
    numbers = array("d")

    def read_row(row: Row) -> None:
        token = row["token"]
        if token in needed and token not in rows:
            numbers.extend(_pose(row))
            rows[token] = len(rows)

    read("ego_pose", read_row)
    for token in sorted(needed - rows.keys()):
        what = f"table must have the row {token} that sample_data refers to, got no such row"
        read.report(FrameError(read.folder / "ego_pose.json", what))
    return rows, np.frombuffer(numbers, dtype=np.float64).reshape(-1, 7)


def _read_boxes(read: _Reader, frame_rows: dict[str, int]) -> IndexedBoxes:
    categories = dict(read("category", lambda row: (_text(row["token"]), _text(row["name"]))))
    category_of = dict(read("instance", lambda row: (_text(row["token"]), categories[row["category_token"]])))
    names: list[str] = []
    frames = array("q")
    numbers = array("d")  # ten for each box: pose, length, width, height

    def read_row(row: Row) -> None:
        if len(row["size"]) != 3:
            raise ValueError(f"size must have 3 numbers, got {row['size']}")
        width, length, height = (float(number) for number in row["size"])
        if not (width >= 0 and length >= 0 and height >= 0 and math.isfinite(width + length + height)):
            raise ValueError(f"size must be finite and not negative, got {row['size']}")
        name, frame, pose = category_of[row["instance_token"]], frame_rows[row["sample_token"]], _pose(row)
        names.append(name)
        frames.append(frame)
        numbers.extend((*pose, length, width, height))

    read("sample_annotation", read_row)
    frame = np.frombuffer(frames, dtype=np.int64)
    order = np.argsort(frame, kind="stable")
    columns = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 10)[order]
    return IndexedBoxes(
        name=strings(names).take(order),
        pose=columns[:, :7],
        size_lwh=columns[:, 7:],
        offsets=offsets_of(frame, len(frame_rows)),
        annotated=np.ones(len(frame_rows), dtype=np.bool_),
    )


def no_keyframe(tables: Path, token: str) -> FrameError:
    """The error of a sample without a LiDAR sweep."""
    return FrameError(tables / "sample_data.json", f"sample {token} must have a {LIDAR_CHANNEL} keyframe, got none")


# Files


def read_sweep(path: Path) -> NDArray[np.float32]:
    """[N, 5] float32: x, y, z, intensity, ring."""
    points = read_points(path, SWEEP_COLUMNS, "sweep file", MISSING_SWEEP_HINT).astype(np.float32)
    require_finite_points(path, points)
    return points


def check_sweep_size(path: Path) -> None:
    """Check the size of a sweep file without reading it; raises as `read_sweep`."""
    check_points_size(path, SWEEP_COLUMNS, "sweep file", MISSING_SWEEP_HINT)


def _add_row(rows: dict[str, int], token: Any) -> None:
    """Number a kept row by its token."""
    if _text(token) in rows:
        raise ValueError(f"token {token}, which another row has")
    rows[token] = len(rows)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r}, which is not text")
    return value


def _pose(row: Row) -> list[float]:
    """Translation and unit quaternion (w, x, y, z) of a table row."""
    translation, rotation = row["translation"], row["rotation"]
    pose = [float(number) for number in (*translation, *rotation)]
    if len(translation) != 3 or len(rotation) != 4 or not math.isfinite(sum(pose)):
        raise ValueError(f"translation {translation} and rotation {rotation}")
    if abs(math.hypot(*pose[3:]) - 1.0) > 1e-2:
        raise ValueError(f"rotation {rotation}, which is not a unit quaternion")
    return pose


def only_table_folder(root: Path) -> Path:
    if not root.is_dir():
        raise FrameError(root, "data.root must be a folder, got no such folder")
    folders = sorted(path for path in root.glob("v1.0-*") if path.is_dir())
    if len(folders) != 1:
        names = ", ".join(path.name for path in folders) or "none"
        raise FrameError(
            root,
            f"data.root must hold one table folder such as v1.0-trainval, or data.version must name it, got {names}",
        )
    return folders[0]


def _scene_names(tables: Path, split: str) -> set[str]:
    path = tables / "splits.json"
    own = read_json(path) if path.is_file() else {}
    if not isinstance(own, dict):
        raise FrameError(path, f"must map split names to scene names, got {type(own).__name__}")
    if split in own:
        return set(own[split])
    try:
        from nuscenes.utils.splits import create_splits_scenes
    except ImportError as error:
        raise ValueError(
            f"data.split must be in {path} or be an official split, got {split!r}; the official "
            f"lists need: pip install 'pred-lidar[nuscenes]' ({error})"
        ) from error
    official = create_splits_scenes()
    if split not in official:
        known = ", ".join([*own, *official])
        raise ValueError(f"data.split must be one of {known}, got {split!r}")
    return set(official[split])
