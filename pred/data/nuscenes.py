# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for drive logs in the official nuScenes layout (JSON tables, samples/, sweeps/).

The tables of the full data set hold millions of rows. They are parsed once, rows that are not
needed are dropped while parsing, and the rest is kept in arrays, which forked loader workers share.
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import (
    Boxes,
    Camera,
    Frame,
    FrameError,
    check_image_header,
    invert_rigid,
)
from pred.data.labels import PseudoLabel, find_label_file
from pred.data.sweeps import place_sweep

LIDAR_CHANNEL = "LIDAR_TOP"
BYTES_PER_POINT = 20  # float32 x, y, z, intensity, ring
MICROSECONDS = 1e-6

Row = dict[str, Any]
T = TypeVar("T")


class _Calibration(NamedTuple):
    channel: str
    modality: str
    T_ego_from_sensor: NDArray[np.float64]
    intrinsics: list[list[float]]


@dataclass
class _SensorData:
    """The used rows of sample_data as columns: LiDAR sweeps and keyframe images, n in all."""

    filename: list[str]
    time_us: NDArray[np.int64]  # [n]
    calibration: NDArray[np.int64]  # [n]
    previous: NDArray[np.int64]  # [n] row of the sweep before, -1 at the start of a scene
    size: NDArray[np.int64]  # [n, 2] image width and height
    keyframe_of: NDArray[np.int64]  # [n] sample whose keyframe the row is, -1 for sweeps in between
    ego_pose: NDArray[np.float64]  # [n, 7] translation, quaternion w x y z, ego to world


@dataclass
class _Annotations:
    """Boxes of all samples in world coordinates; sample i owns rows offsets[i]:offsets[i + 1]."""

    offsets: NDArray[np.int64]
    pose: NDArray[np.float64]  # [m, 7] translation, quaternion
    size_wlh: NDArray[np.float64]  # [m, 3]
    name_id: NDArray[np.int64]  # [m]
    names: list[str]


class NuScenesFrames:
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

    Raises:
        FrameError: a table is missing or damaged, or a folder cannot be found.
        ValueError: the split is unknown or empty.
    """

    def __init__(
        self,
        root: str | Path,
        version: str | None = None,
        split: str | None = None,
        sweeps: int = 10,
        labels: str | None = "auto",
        ego_box: tuple[float, float, float, float] = (-1.0, -2.0, 1.0, 3.0),
    ) -> None:
        self.root = Path(root)
        self.tables = self.root / version if version else _only_table_folder(self.root)
        self.sweeps = sweeps
        self.ego_box = ego_box
        self.labels = _label_folder(self.root, labels)
        self._tokens = self._read_samples(split)
        sample_rows = {token: row for row, token in enumerate(self._tokens)}
        self._calibrations, calibration_rows = self._read_calibrations()
        self._read_sample_data(sample_rows, calibration_rows)
        self._annotations = self._read_annotations(sample_rows)

    def __len__(self) -> int:
        return len(self._tokens)

    def token(self, index: int) -> str:
        """Sample token of frame ``index``."""
        return self._tokens[index]

    def load(self, index: int) -> Frame:
        """Read the sweeps of keyframe ``index``. With labels, images are checked by their headers
        and labels to exist; without, images may be missing.

        Raises:
            FrameError: a file is missing, truncated, of the wrong type or size, or holds NaN or Inf.
        """
        token = self._tokens[index]
        keyframe = int(self._lidar_rows[index])
        if keyframe < 0:
            raise FrameError(
                self.tables / "sample_data.json",
                f"sample {token} must have a {LIDAR_CHANNEL} keyframe, got none",
            )
        T_world_from_lidar = self._sensor_pose(keyframe)
        points, point_index, is_keyframe, earlier_keyframes = self._accumulate_sweeps(keyframe, T_world_from_lidar)
        camera_rows = [int(row) for row in self._camera_rows[index] if row >= 0]
        return Frame(
            token=token,
            points=points,
            point_index=point_index,
            is_keyframe=is_keyframe,
            cameras=[self._camera(row, T_world_from_lidar) for row in camera_rows],
            T_world_from_lidar=T_world_from_lidar,
            source=str(self.root / self._data.filename[keyframe]),
            boxes=self._boxes(index, T_world_from_lidar),
            earlier_keyframes=earlier_keyframes,
        )

    # Frames

    def _sensor_pose(self, row: int) -> NDArray[np.float64]:
        """T_world_from_sensor at the time of the measurement."""
        T_world_from_ego = _rigid(self._data.ego_pose[row])
        return T_world_from_ego @ self._calibrations[self._data.calibration[row]].T_ego_from_sensor

    def _accumulate_sweeps(
        self, keyframe: int, T_world_from_lidar: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.bool_], dict[str, slice]]:
        """`Frame.points`, `Frame.point_index`, `Frame.is_keyframe` and `Frame.earlier_keyframes`."""
        points, point_index, is_keyframe = [], [], []
        earlier_keyframes: dict[str, slice] = {}
        num_points = 0
        row = keyframe
        for _ in range(self.sweeps):
            sweep = _read_sweep(self.root / self._data.filename[row])
            # A keyframe's points stay as measured, to the bit.
            T = np.eye(4) if row == keyframe else invert_rigid(T_world_from_lidar) @ self._sensor_pose(row)
            lag_s = float(self._data.time_us[keyframe] - self._data.time_us[row]) * MICROSECONDS
            sweep, kept = place_sweep(sweep, T, self.ego_box, lag_s)
            points.append(sweep)
            point_index.append(kept)
            is_keyframe.append(np.full(len(kept), row == keyframe))
            sample = int(self._data.keyframe_of[row])
            if sample >= 0 and row != keyframe:
                earlier_keyframes[self._tokens[sample]] = slice(num_points, num_points + len(kept))
            num_points += len(kept)
            row = int(self._data.previous[row])
            if row < 0:
                break
        return np.concatenate(points), np.concatenate(point_index), np.concatenate(is_keyframe), earlier_keyframes

    def _camera(self, row: int, T_world_from_lidar: NDArray[np.float64]) -> Camera:
        calibration = self._calibrations[self._data.calibration[row]]
        width, height = (int(pixels) for pixels in self._data.size[row])
        image = self.root / self._data.filename[row]
        labels = None
        if self.labels is not None:
            check_image_header(image, width, height)
            label_file = find_label_file(self.labels / calibration.channel, image.stem)
            labels = PseudoLabel(label_file, width, height)
        return Camera(
            name=calibration.channel,
            intrinsics=np.asarray(calibration.intrinsics),
            # Through the world: the ego car moves between the LiDAR's and the camera's time.
            T_camera_from_lidar=invert_rigid(self._sensor_pose(row)) @ T_world_from_lidar,
            width=width,
            height=height,
            image=image if labels is not None or image.is_file() else None,
            labels=labels,
        )

    def _boxes(self, index: int, T_world_from_lidar: NDArray[np.float64]) -> Boxes:
        all_boxes = self._annotations
        rows = slice(int(all_boxes.offsets[index]), int(all_boxes.offsets[index + 1]))
        T_lidar_from_world = invert_rigid(T_world_from_lidar)
        poses = [T_lidar_from_world @ _rigid(pose) for pose in all_boxes.pose[rows]]
        T_lidar_from_box = np.stack(poses) if poses else np.zeros((0, 4, 4))
        return Boxes(
            centre_m=T_lidar_from_box[:, :3, 3],
            size_m=all_boxes.size_wlh[rows][:, [1, 0, 2]],
            yaw_rad=np.arctan2(T_lidar_from_box[:, 1, 0], T_lidar_from_box[:, 0, 0]),
            names=[all_boxes.names[name_id] for name_id in all_boxes.name_id[rows]],
        )

    # Tables

    def _table(self, name: str, read_row: Callable[[Row], T | None]) -> list[T]:
        return _read_table(self.tables / f"{name}.json", read_row)

    def _read_samples(self, split: str | None) -> list[str]:
        """Tokens of the split's samples, in table order."""
        wanted = None if split is None else _scene_names(self.tables, split)
        scene_names = dict(self._table("scene", lambda row: (row["token"], row["name"])))

        def read_row(row: Row) -> str | None:
            name = scene_names[row["scene_token"]]
            token: str = row["token"]
            return token if wanted is None or name in wanted else None

        tokens = self._table("sample", read_row)
        if not tokens:
            raise ValueError(f"data.split must select samples of {self.tables}, got none: {split}")
        return tokens

    def _read_calibrations(self) -> tuple[list[_Calibration], dict[str, int]]:
        sensors = {
            token: (channel, modality)
            for token, channel, modality in self._table(
                "sensor", lambda row: (row["token"], row["channel"], row["modality"])
            )
        }
        rows: dict[str, int] = {}

        def read_row(row: Row) -> _Calibration:
            rows[row["token"]] = len(rows)
            channel, modality = sensors[row["sensor_token"]]
            intrinsics = row["camera_intrinsic"]
            if modality == "camera" and not _is_finite_3x3(intrinsics):
                raise ValueError(f"camera_intrinsic must be 3 x 3 numbers, got {intrinsics}")
            return _Calibration(channel, modality, _rigid(np.array(_pose(row))), intrinsics)

        return self._table("calibrated_sensor", read_row), rows

    def _read_sample_data(self, sample_rows: dict[str, int], calibration_rows: dict[str, int]) -> None:
        data_rows: dict[str, int] = {}
        previous_tokens: list[str] = []
        pose_tokens: list[str] = []
        filenames: list[str] = []
        numbers = array("q")  # time, calibration, width, height, keyframe_of
        keyframes: list[tuple[int, str, int]] = []  # sample row, channel, data row

        def read_row(row: Row) -> None:
            sample = sample_rows.get(row["sample_token"])
            calibration = calibration_rows[row["calibrated_sensor_token"]]
            channel, modality = self._calibrations[calibration][:2]
            is_keyframe = row["is_key_frame"]
            is_image = modality == "camera" and is_keyframe
            if sample is None or not (channel == LIDAR_CHANNEL or is_image):
                return
            if is_keyframe:
                keyframes.append((sample, channel, len(filenames)))
            data_rows[row["token"]] = len(filenames)
            previous_tokens.append(row["prev"])
            pose_tokens.append(row["ego_pose_token"])
            filenames.append(row["filename"])
            width, height = (row["width"], row["height"]) if is_image else (0, 0)
            if is_image and not (width > 0 and height > 0):
                raise ValueError(f"width and height must be positive, got {width} x {height}")
            numbers.extend((row["timestamp"], calibration, width, height, sample if is_keyframe else -1))

        self._table("sample_data", read_row)
        columns = np.frombuffer(numbers, dtype=np.int64).reshape(-1, 5)
        self._data = _SensorData(
            filename=filenames,
            time_us=columns[:, 0],
            calibration=columns[:, 1],
            # A sweep that is not in the table (a subset of a scene) ends the walk like a start.
            previous=np.array([data_rows.get(token, -1) for token in previous_tokens], np.int64),
            size=columns[:, 2:4],
            keyframe_of=columns[:, 4],
            ego_pose=self._read_ego_poses(pose_tokens),
        )
        is_camera = [c.modality == "camera" for c in self._calibrations]
        channels = sorted({channel for _, channel, row in keyframes if is_camera[columns[row, 1]]})
        column_of = {channel: column for column, channel in enumerate(channels)}
        self._lidar_rows = np.full(len(sample_rows), -1, dtype=np.int64)
        self._camera_rows = np.full((len(sample_rows), len(channels)), -1, dtype=np.int64)
        for sample, channel, row in keyframes:
            if channel == LIDAR_CHANNEL:
                self._lidar_rows[sample] = row
            else:
                self._camera_rows[sample, column_of[channel]] = row

    def _read_ego_poses(self, tokens: list[str]) -> NDArray[np.float64]:
        needed = set(tokens)
        rows: dict[str, int] = {}
        numbers = array("d")

        def read_row(row: Row) -> None:
            token = row["token"]
            if token in needed and token not in rows:
                rows[token] = len(rows)
                numbers.extend(_pose(row))

        self._table("ego_pose", read_row)
        for token in tokens:
            if token not in rows:
                raise FrameError(
                    self.tables / "ego_pose.json",
                    f"table must have the row {token} that sample_data refers to, got no such row",
                )
        poses = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 7)
        return poses[[rows[token] for token in tokens]]

    def _read_annotations(self, sample_rows: dict[str, int]) -> _Annotations:
        categories = dict(self._table("category", lambda row: (row["token"], row["name"])))
        name_ids = {token: name_id for name_id, token in enumerate(categories)}
        instances = dict(self._table("instance", lambda row: (row["token"], name_ids[row["category_token"]])))
        owners, box_names = array("q"), array("q")
        poses, sizes = array("d"), array("d")

        def read_row(row: Row) -> None:
            sample = sample_rows.get(row["sample_token"])
            if sample is None:
                return
            size_wlh = row["size"]
            if len(size_wlh) != 3:
                raise ValueError(f"size must have 3 numbers, got {size_wlh}")
            owners.append(sample)
            box_names.append(instances[row["instance_token"]])
            poses.extend(_pose(row))
            sizes.extend(size_wlh)

        self._table("sample_annotation", read_row)
        owner = np.frombuffer(owners, dtype=np.int64)
        order = np.argsort(owner, kind="stable")
        counts = np.bincount(owner, minlength=len(sample_rows))
        return _Annotations(
            offsets=np.concatenate([[0], np.cumsum(counts)]),
            pose=np.frombuffer(poses, dtype=np.float64).reshape(-1, 7)[order],
            size_wlh=np.frombuffer(sizes, dtype=np.float64).reshape(-1, 3)[order],
            name_id=np.frombuffer(box_names, dtype=np.int64)[order],
            names=list(categories.values()),
        )


def _read_sweep(path: Path) -> NDArray[np.float32]:
    """[N, 5] float32: x, y, z, intensity, ring."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise FrameError(path, "sweep file must exist, got no such file (without sweeps/: data.sweeps 1)") from None
    except OSError as error:
        raise FrameError(path, f"sweep file must be readable, got {error}") from None
    if not content or len(content) % BYTES_PER_POINT:
        raise FrameError(
            path,
            f"sweep must hold whole points of {BYTES_PER_POINT} bytes (float32 x, y, z, intensity, "
            f"ring), got {len(content)} bytes: truncated?",
        )
    points = np.frombuffer(content, dtype="<f4").astype(np.float32).reshape(-1, 5)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise FrameError(
            path,
            f"points must be finite, got NaN or Inf in {np.count_nonzero(~finite)} of "
            f"{len(points)} points, first in point {np.argmin(finite)}",
        )
    return points


def _read_json(path: Path) -> Any:
    return _parse_json(path, None)


def _read_table(path: Path, read_row: Callable[[Row], T | None]) -> list[T]:
    """Rows of a JSON table, each turned by ``read_row`` while parsing; None drops a row."""
    num_rows = 0

    def checked(row: Row) -> T | None:
        nonlocal num_rows
        num_rows += 1
        try:
            return read_row(row)
        except KeyError as error:
            what = f"row {num_rows} must have, and refer to, known keys, got no {error}"
        except (TypeError, ValueError, OverflowError) as error:
            what = f"row {num_rows} must be well-formed, got {error}"
        raise FrameError(path, what)

    rows = _parse_json(path, checked)
    if not isinstance(rows, list):
        raise FrameError(path, f"table must be a list of rows, got {type(rows).__name__}")
    return [row for row in rows if row is not None]


def _parse_json(path: Path, read_object: Callable[[Row], Any] | None) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"), object_hook=read_object)
    except FileNotFoundError:
        raise FrameError(path, "table must exist, got no such file") from None
    except OSError as error:
        raise FrameError(path, f"table must be readable, got {error}") from None
    except FrameError:
        raise
    except ValueError as error:
        raise FrameError(path, f"table must be valid JSON, got {error}") from None


def _is_finite_3x3(matrix: Any) -> bool:
    return np.shape(matrix) == (3, 3) and bool(np.isfinite(matrix).all())


def _pose(row: Row) -> list[float]:
    """Translation and unit quaternion (w, x, y, z) of a table row."""
    translation, rotation = row["translation"], row["rotation"]
    pose = [float(number) for number in (*translation, *rotation)]
    if len(translation) != 3 or len(rotation) != 4 or not math.isfinite(sum(pose)):
        raise ValueError(f"translation {translation} and rotation {rotation}")
    if abs(math.hypot(*pose[3:]) - 1.0) > 1e-2:
        raise ValueError(f"rotation {rotation}, which is not a unit quaternion")
    return pose


def _rigid(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] matrix of a translation and a quaternion (w, x, y, z)."""
    w, x, y, z = pose[3:] / np.linalg.norm(pose[3:])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = pose[:3]
    return matrix


def _only_table_folder(root: Path) -> Path:
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


def _label_folder(root: Path, labels: str | None) -> Path | None:
    if labels is None or labels == "none":
        return None
    if labels == "auto":
        folders = sorted(path for path in (root / "pseudo").glob("*") if path.is_dir())
        if len(folders) > 1:
            names = ", ".join(path.name for path in folders)
            raise FrameError(root / "pseudo", f"must hold one label folder, or data.labels name it, got {names}")
        return folders[0] if folders else None
    if not (root / labels).is_dir():
        raise FrameError(root / labels, "data.labels must be a folder, got no such folder")
    return root / labels


def _scene_names(tables: Path, split: str) -> set[str]:
    path = tables / "splits.json"
    own = _read_json(path) if path.is_file() else {}
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
