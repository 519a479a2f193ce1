# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for people's own recordings, in a plain folder format::

    ROOT/splits.json                                        optional: {"train": ["drive-a", ...], ...}
    ROOT/<drive>/drive.yaml                                 how scans are stored; cameras
    ROOT/<drive>/poses.txt                                  a line per scan: stem, time, pose
    ROOT/<drive>/lidar/<stem>.bin | .npy | .pcd
    ROOT/<drive>/<camera>/<stem>.jpg | .jpeg | .png         optional
    ROOT/pseudo/<segmenter>/<drive>/<camera>/<stem>.png | .npy | .npz   optional
    ROOT/<folder>/<drive>/<camera>/<stem>.png               optional: depth maps of the images

Every scan that ``poses.txt`` names is a frame; the scans before it in the drive are its sweeps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pred.config import did_you_mean
from pred.data.frame import (
    EGO_BOX,
    Camera,
    EgoBox,
    Frame,
    FrameError,
    check_image_header,
    invert_rigid,
    require_inside,
    require_intrinsics,
    unreadable,
)
from pred.data.image_depth import DepthMap, depth_folder
from pred.data.labels import PseudoLabel, find_label_file, label_folder
from pred.data.pcd import read_pcd, read_pcd_header
from pred.data.sweeps import Sweep, accumulate, check_points_size, read_points, require_finite_points
from pred.data.tables import read_json

DESCRIPTION = "drive.yaml"
POSES = "poses.txt"
SCANS = "lidar"
SCAN_SUFFIXES = (".bin", ".npy", ".pcd")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
POINT_FIELDS = ("x", "y", "z", "intensity")
MAX_ROTATION_ERROR = 1e-3
"""Largest entry of R Rᵀ - 1: files hold rotations rounded to a few digits."""


@dataclass
class CameraDescription:
    """A camera of a drive, as in `pred.data.frame.Camera`."""

    name: str
    width: int
    height: int
    intrinsics: NDArray[np.float64]
    T_camera_from_lidar: NDArray[np.float64]


@dataclass
class Drive:
    """One recording.

    Attributes:
        folder: its folder.
        suffix: of the scan files.
        columns: names of the values of a point in .bin and .npy files.
        cameras: calibrated cameras.
        stems: [n] names of the scans in the order of their times.
        times_s: [n] float64 seconds, ascending.
        T_world_from_lidar: [n, 4, 4] float64.
    """

    folder: Path
    suffix: str
    columns: list[str]
    cameras: list[CameraDescription]
    stems: NDArray[np.str_]
    times_s: NDArray[np.float64]
    T_world_from_lidar: NDArray[np.float64]

    def scan_file(self, scan: int) -> Path:
        """File of a scan."""
        return self.folder / SCANS / f"{self.stems[scan]}{self.suffix}"

    def token(self, scan: int) -> str:
        """Identity of the frame of a scan."""
        return f"{self.folder.name}/{self.stems[scan]}"


class FolderFrames:
    """Frames of a folder of drives as a `pred.data.frame.FrameSource`; the format is in the module's text.

    Args:
        root: folder of the drives.
        split: name in ``splits.json``; None takes every drive, in the order of their names.
        sweeps: at most so many scans per frame, its own included, each moved to the frame's LiDAR coordinates.
        labels: folder under ``root`` with ``<drive>/<camera>/<stem>.png|.npy|.npz``; "auto" takes the only folder under
            ``pseudo/`` if there is one; "none" reads no labels. With labels, every image and its label must exist.
        ego_box: (x_min, y_min, x_max, y_max) in metres; returns in it are the own car and are removed from each scan.
        image_depth: folder under ``root`` with depth maps (`pred.data.image_depth`), read when asked for; None or
            "none": no depth.

    Raises:
        FrameError: a description or a pose file is missing or wrong, or a folder cannot be found.
        ValueError: the split is unknown.
    """

    def __init__(
        self,
        root: str | Path,
        split: str | None = None,
        sweeps: int = 10,
        labels: str | None = "auto",
        ego_box: EgoBox = EGO_BOX,
        image_depth: str | None = None,
    ) -> None:
        self.root = Path(root)
        self.sweeps = sweeps
        self.ego_box = ego_box
        self.labels = label_folder(self.root, labels)
        self.depth = depth_folder(self.root, image_depth)
        self.drives = [read_drive(folder) for folder in drive_folders(self.root, split)]
        self._first = np.cumsum([0, *(len(drive.stems) for drive in self.drives)])

    def __len__(self) -> int:
        return int(self._first[-1])

    def token(self, index: int) -> str:
        """``<drive>/<stem>`` of frame ``index``."""
        drive, scan = self._place(index)
        return drive.token(scan)

    def load(self, index: int) -> Frame:
        """Read the scans of frame ``index``. With labels, images are checked by their headers and labels to exist;
        without, images may be missing.

        Raises:
            FrameError: a file is missing, truncated, of the wrong type or size, or holds NaN or Inf.
        """
        drive, scan = self._place(index)
        return Frame(
            token=drive.token(scan),
            **accumulate(self._sweeps(drive, scan), self.ego_box)._asdict(),
            cameras=[self._camera(drive, camera, str(drive.stems[scan])) for camera in drive.cameras],
            T_world_from_lidar=drive.T_world_from_lidar[scan],
            source=str(drive.scan_file(scan)),
        )

    def _place(self, index: int) -> tuple[Drive, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"index must be in [0, {len(self)}), got {index}")
        number = int(np.searchsorted(self._first, index, side="right")) - 1
        return self.drives[number], index - int(self._first[number])

    def _sweeps(self, drive: Drive, scan: int) -> Iterator[Sweep]:
        T_lidar_from_world = invert_rigid(drive.T_world_from_lidar[scan])
        for earlier in range(scan, max(-1, scan - self.sweeps), -1):
            yield Sweep(
                points=read_scan(drive.scan_file(earlier), drive.columns),
                # A frame's own points stay as measured, to the bit.
                T_keyframe_from_sweep=np.eye(4)
                if earlier == scan
                else T_lidar_from_world @ drive.T_world_from_lidar[earlier],
                lag_s=float(drive.times_s[scan] - drive.times_s[earlier]),
                frame=drive.token(earlier),
            )

    def _camera(self, drive: Drive, camera: CameraDescription, stem: str) -> Camera:
        image = find_image_file(drive.folder / camera.name, stem)
        labels = None
        if self.labels is not None:
            check_image_header(image, camera.width, camera.height)
            label_file = find_label_file(self.labels / drive.folder.name / camera.name, stem)
            labels = PseudoLabel(label_file, camera.width, camera.height)
        return Camera(
            name=camera.name,
            intrinsics=camera.intrinsics,
            T_camera_from_lidar=camera.T_camera_from_lidar,
            width=camera.width,
            height=camera.height,
            image=image if labels is not None or image.is_file() else None,
            labels=labels,
            depth=None
            if self.depth is None
            else DepthMap(self.depth / drive.folder.name / camera.name / f"{stem}.png", camera.width, camera.height),
        )


def drive_folders(root: Path, split: str | None = None) -> list[Path]:
    """Folders of the drives, in the order of their names, or of the split's list.

    Raises:
        FrameError: there is no drive, or one that the split names is missing.
        ValueError: the split is unknown.
    """
    if not root.is_dir():
        raise FrameError(root, "data.root must be a folder, got no such folder")
    if split is None:
        folders = sorted(path.parent for path in root.glob(f"*/{DESCRIPTION}"))
        if not folders:
            raise FrameError(root, f"data.root must hold drives, folders with a {DESCRIPTION}, got none")
        return folders
    path = root / "splits.json"
    splits = read_json(path)
    if not isinstance(splits, dict) or not all(isinstance(names, list) for names in splits.values()):
        raise FrameError(path, "must map split names to lists of drives, got something else")
    if split not in splits:
        raise ValueError(f"data.split must be one of {', '.join(splits) or 'none'} in {path}, got {split!r}")
    if not splits[split]:
        raise ValueError(f"data.split must select drives of {root}, got none: {split}")
    try:
        return [root / require_inside(str(name)) for name in splits[split]]
    except ValueError as error:
        raise FrameError(path, f"drives must be folders of {root}, got {error}") from None


def read_drive(folder: Path) -> Drive:
    """Description and poses of one drive.

    Raises:
        FrameError: a file is missing or wrong.
    """
    path = folder / DESCRIPTION
    content = _read_description(path)
    try:
        suffix, columns = _scans(_mapping(content, "", ("scans",), ("cameras",))["scans"])
        cameras = [_camera(str(name), value) for name, value in (content.get("cameras") or {}).items()]
    except (ValueError, TypeError, AttributeError) as error:
        raise FrameError(path, str(error)) from None
    return Drive(folder, suffix, columns, cameras, *read_poses(folder / POSES))


def read_poses(path: Path) -> tuple[NDArray[np.str_], NDArray[np.float64], NDArray[np.float64]]:
    """Stems, times [n] in seconds and T_world_from_lidar [n, 4, 4] of a pose file.

    A line has 14 words: the stem of the scan's file name, its time in seconds, and the rows of the 3 x 4 matrix that
    maps LiDAR to world coordinates. Empty lines and lines that start with # are passed over.

    Raises:
        FrameError: names the first line that is wrong.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise FrameError(path, "pose file must exist, got no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FrameError(path, f"pose file must be readable, got {error}") from None
    stems: dict[str, None] = {}
    numbers: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            values = [float(word) for word in words[1:]]
        except ValueError as error:
            raise FrameError(path, f"line {number} must hold a stem and 13 numbers, got {error}") from None
        _check_pose_line(path, number, words[0], values)
        if words[0] in stems:
            raise FrameError(path, f"line {number} must name another scan than the lines before, got {words[0]} again")
        if numbers and not values[0] > numbers[-1][0]:
            raise FrameError(path, f"line {number} must have a later time than {numbers[-1][0]}, got {values[0]}")
        stems[words[0]] = None
        numbers.append(values)
    if not numbers:
        raise FrameError(path, "pose file must hold a line per scan, got none")
    table = np.array(numbers)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table[:, 1:].reshape(-1, 3, 4)
    return np.array(list(stems)), table[:, 0].copy(), poses


def read_scan(path: Path, columns: list[str]) -> NDArray[np.float32]:
    """[N, 4] float32: x, y, z, intensity (0 where the file has none).

    In .pcd files NaN in x, y or z means "no return"; such points are left out.

    Args:
        path: .bin, .npy or .pcd file.
        columns: names of the values of a point in .bin and .npy files.

    Raises:
        FrameError: the file is missing, truncated or damaged, or holds NaN or Inf.
    """
    if path.suffix == ".pcd":
        points = _from_fields(path, read_pcd(path))
        points = points[~np.isnan(points[:, :3]).any(axis=1)]
    elif path.suffix == ".npy":
        points = _from_columns(np.asarray(_map_npy(path, columns)), columns)
    else:
        points = _from_columns(read_points(path, columns), columns)
    if not len(points):
        raise FrameError(path, "scan must hold points, got none")
    require_finite_points(path, points)
    return points


def check_scan_header(path: Path, columns: list[str]) -> None:
    """Check type and size of a scan file without reading its points.

    Raises:
        FrameError: as `read_scan`.
    """
    if path.suffix == ".pcd":
        _require_fields(path, read_pcd_header(path).dtype)
    elif path.suffix == ".npy":
        _map_npy(path, columns)
    else:
        check_points_size(path, columns)


def find_image_file(folder: Path, stem: str) -> Path:
    """The image file ``<folder>/<stem>`` with one of the known suffixes; with the first of them if there is none."""
    candidates = [folder / f"{stem}{suffix}" for suffix in IMAGE_SUFFIXES]
    return next((path for path in candidates if path.is_file()), candidates[0])


def _map_npy(path: Path, columns: list[str]) -> NDArray[Any]:
    try:
        points = npy_format.open_memmap(path, mode="r")
    except OSError as error:
        raise unreadable(path, error, "scan") from None
    # A damaged header surfaces as ValueError, SyntaxError, EOFError, OverflowError, ...
    except Exception as error:
        raise FrameError(path, f"scan must be a readable .npy file, got {type(error).__name__}: {error}") from None
    if points.ndim != 2 or points.shape[1] != len(columns) or points.dtype.kind != "f":
        rule = f"scan must hold floats of shape [N, {len(columns)}] ({', '.join(columns)})"
        raise FrameError(path, f"{rule}, got {points.dtype} {list(points.shape)}")
    return points


def _from_columns(values: NDArray[Any], columns: list[str]) -> NDArray[np.float32]:
    points = np.zeros((len(values), 4), dtype=np.float32)
    for column, name in enumerate(POINT_FIELDS):
        if name in columns:
            points[:, column] = values[:, columns.index(name)]
    return points


def _from_fields(path: Path, values: NDArray[Any]) -> NDArray[np.float32]:
    _require_fields(path, values.dtype)
    points = np.zeros((len(values), 4), dtype=np.float32)
    for column, name in enumerate(POINT_FIELDS):
        if name in (values.dtype.names or ()):
            points[:, column] = values[name]
    return points


def _require_fields(path: Path, dtype: np.dtype[Any]) -> None:
    names = dtype.names or ()
    missing = [name for name in POINT_FIELDS[:3] if name not in names]
    if missing or any(dtype[name].shape for name in POINT_FIELDS if name in names):
        raise FrameError(path, f".pcd file must have the single fields x, y, z, got {', '.join(names)}")


def _check_pose_line(path: Path, number: int, stem: str, values: list[float]) -> None:
    if len(values) != 13:
        what = f"line {number} must hold a stem and 13 numbers (time, 3 x 4 matrix), got {1 + len(values)} words"
        raise FrameError(path, what)
    if not math.isfinite(sum(values)):
        raise FrameError(path, f"line {number} must hold finite numbers, got NaN or Inf")
    if Path(stem).name != stem:
        raise FrameError(path, f"line {number} must start with the stem of a file name, got {stem}")
    rotation = np.array(values[1:]).reshape(3, 4)[:, :3]
    _require_rotation(rotation, lambda what: FrameError(path, f"line {number} must hold {what}"))


def _require_rotation(rotation: NDArray[np.float64], error: Any) -> None:
    worst = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if worst > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        reason = f"R Rᵀ off the identity by {worst:.2g}" if worst > MAX_ROTATION_ERROR else "a mirror image"
        raise error(f"a rotation in its first three columns, got {reason}")


# drive.yaml


def _read_description(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FrameError(path, "description must exist, got no such file") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise FrameError(path, f"description must be readable YAML, got {error}") from None
    if not isinstance(content, dict):
        raise FrameError(path, f"description must be a mapping, got {type(content).__name__}")
    return content


def _mapping(value: Any, name: str, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """``value`` as a mapping with these keys and no others."""
    where = f"{name}: " if name else ""
    if not isinstance(value, dict):
        raise ValueError(f"{where}must be a mapping, got {type(value).__name__}")
    for key in value:
        if key not in (*required, *optional):
            raise ValueError(f"{where}unknown key {key}{did_you_mean(str(key), (*required, *optional))}")
    for key in required:
        if key not in value:
            raise ValueError(f"{where}must have {key}, got {', '.join(map(str, value)) or 'nothing'}")
    return value


def _scans(value: Any) -> tuple[str, list[str]]:
    scans = _mapping(value, "scans", ("suffix",), ("columns",))
    suffix = scans["suffix"]
    if suffix not in SCAN_SUFFIXES:
        raise ValueError(f"scans: suffix must be one of {', '.join(SCAN_SUFFIXES)}, got {suffix}")
    columns = [str(name) for name in scans.get("columns") or ()]
    if suffix == ".pcd":
        if columns:
            raise ValueError("scans: columns must not be given for .pcd files, which name their fields")
        return suffix, []
    used = [name for name in columns if name in POINT_FIELDS]
    if not {"x", "y", "z"} <= set(columns) or len(used) != len(set(used)):
        raise ValueError(f"scans: columns must hold x, y, z and perhaps intensity, each once, got {columns}")
    return suffix, columns


def _camera(name: str, value: Any) -> CameraDescription:
    where = f"cameras: {name}"
    if Path(name).name != name or name in ("", ".."):
        raise ValueError(f"{where}: name must be that of a folder in the drive")
    camera = _mapping(value, where, ("width", "height", "intrinsics", "T_camera_from_lidar"))
    for key in ("width", "height"):
        if not isinstance(camera[key], int) or camera[key] < 1:
            raise ValueError(f"{where}: {key} must be a positive whole number, got {camera[key]}")
    intrinsics = require_intrinsics(camera["intrinsics"], f"{where}: intrinsics")
    given = _array(camera["T_camera_from_lidar"], ((3, 4), (4, 4)), f"{where}: T_camera_from_lidar")
    transform = np.eye(4)
    transform[:3] = given[:3]
    _require_rotation(transform[:3, :3], lambda what: ValueError(f"{where}: T_camera_from_lidar must hold {what}"))
    return CameraDescription(name, camera["width"], camera["height"], intrinsics, transform)


def _array(value: Any, shapes: tuple[tuple[int, int], ...], what: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.zeros(0)
    if array.shape not in shapes or not np.isfinite(array).all():
        rule = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise ValueError(f"{what} must be {rule} finite numbers, got {value}")
    return array
