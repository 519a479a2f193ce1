# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Placing LiDAR sweeps in the keyframe's frame: the inner loop of loader workers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import FrameError, outside_ego_box, transform_points, unreadable

try:
    from pred import _host

    HOST_ERROR: str | None = None  # why `_host` is not used: `pred doctor` prints it
except ImportError as error:  # built for another Python version, or not at all
    _host = None  # type: ignore[assignment]
    HOST_ERROR = str(error)


def place_sweep(
    points: NDArray[np.float32],
    T_keyframe_from_sweep: NDArray[np.float64],
    ego_box: tuple[float, float, float, float],
    lag_s: float,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Drops the own car's returns from a sweep and moves the rest to the keyframe's LiDAR frame.

    Args:
        points: [N, >= 4] float32 x, y, z, intensity in the sweep's own LiDAR frame, metres.
        T_keyframe_from_sweep: [4, 4] rigid transform.
        ego_box: (x_min, y_min, x_max, y_max) of the own car in the sweep's frame, metres.
        lag_s: age of the sweep, seconds behind the keyframe.

    Returns:
        [M, 5] float32 x, y, z, intensity, lag, and [M] int64 row in ``points``; order is kept. Compiled where
        ``pred._host`` is there; the NumPy form differs in the last bit of moved coordinates.
    """
    if _host is not None:
        placed, kept = _host.place_sweep(points, T_keyframe_from_sweep, np.asarray(ego_box), lag_s)
        return placed, kept
    return place_sweep_reference(points, T_keyframe_from_sweep, ego_box, lag_s)


def place_sweep_reference(
    points: NDArray[np.float32],
    T_keyframe_from_sweep: NDArray[np.float64],
    ego_box: tuple[float, float, float, float],
    lag_s: float,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """NumPy form of `place_sweep`."""
    kept = np.flatnonzero(outside_ego_box(points, ego_box))
    placed = np.empty((len(kept), 5), dtype=np.float32)
    placed[:, :3] = transform_points(T_keyframe_from_sweep, points[kept, :3])
    placed[:, 3] = points[kept, 3]
    placed[:, 4] = lag_s
    return placed, kept


def read_points(path: Path, columns: Sequence[str], what: str = "scan", hint: str = "") -> NDArray[np.float32]:
    """[N, columns] of a file of float32 numbers, point after point.

    Args:
        path: the file.
        columns: names of the values of a point.
        what: names the file in error texts.
        hint: what to do if it is missing.

    Raises:
        FrameError: the file is missing, unreadable, empty or truncated.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise unreadable(path, error, what, hint) from None
    _require_whole_points(path, len(content), columns, what)
    return np.frombuffer(content, dtype="<f4").reshape(-1, len(columns))


def check_points_size(path: Path, columns: Sequence[str], what: str = "scan", hint: str = "") -> None:
    """Check the size of a file of points without reading it; arguments and errors of `read_points`."""
    try:
        num_bytes = path.stat().st_size
    except OSError as error:
        raise unreadable(path, error, what, hint) from None
    _require_whole_points(path, num_bytes, columns, what)


def _require_whole_points(path: Path, num_bytes: int, columns: Sequence[str], what: str) -> None:
    point = 4 * len(columns)
    if num_bytes == 0 or num_bytes % point:
        names = ", ".join(columns)
        rule = f"{what} must hold whole points of {point} bytes (float32 {names})"
        raise FrameError(path, f"{rule}, got {num_bytes} bytes: truncated?")


def require_finite_points(path: Path, points: NDArray[np.float32]) -> None:
    """
    Raises:
        FrameError: a value of ``points`` [N, C] is NaN or infinite; names the file and the first such point.
    """
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise FrameError(
            path,
            f"points must be finite, got NaN or Inf in {np.count_nonzero(~finite)} of "
            f"{len(points)} points, first in point {np.argmin(finite)}",
        )


class Sweep(NamedTuple):
    """One sweep to be placed in a keyframe.

    Attributes:
        points: [N, >= 4] float32 x, y, z, intensity in the sweep's own LiDAR frame, metres.
        T_keyframe_from_sweep: [4, 4] rigid transform.
        lag_s: age of the sweep, seconds behind the keyframe.
        frame: token of the frame whose own sweep it is; None for sweeps in between.
    """

    points: NDArray[np.float32]
    T_keyframe_from_sweep: NDArray[np.float64]
    lag_s: float
    frame: str | None


class Accumulated(NamedTuple):
    """Fields of `pred.data.frame.Frame` that its sweeps make."""

    points: NDArray[np.float32]
    point_index: NDArray[np.int64]
    is_keyframe: NDArray[np.bool_]
    earlier_keyframes: dict[str, slice]


def accumulate(sweeps: Iterable[Sweep], ego_box: tuple[float, float, float, float]) -> Accumulated:
    """Joins the sweeps of one frame, of which the first is its own, each placed by `place_sweep`."""
    points, point_index, is_keyframe = [], [], []
    earlier_keyframes: dict[str, slice] = {}
    num_points = 0
    for number, sweep in enumerate(sweeps):
        placed, kept = place_sweep(sweep.points, sweep.T_keyframe_from_sweep, ego_box, sweep.lag_s)
        points.append(placed)
        point_index.append(kept)
        is_keyframe.append(np.full(len(kept), number == 0))
        if number > 0 and sweep.frame is not None:
            earlier_keyframes[sweep.frame] = slice(num_points, num_points + len(kept))
        num_points += len(kept)
    return Accumulated(
        np.concatenate(points), np.concatenate(point_index), np.concatenate(is_keyframe), earlier_keyframes
    )
