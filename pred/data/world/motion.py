# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Paths, motion along them, and the test whether two boxes overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Path:
    """A polyline [n, 3] that is travelled along; ``length_m`` is measured in the plane."""

    def __init__(self, points: ArrayLike) -> None:
        self.points = np.asarray(points, dtype=np.float64)
        steps_m = np.linalg.norm(np.diff(self.points[:, :2], axis=0), axis=1)
        self.distance_m = np.concatenate([[0.0], np.cumsum(steps_m)])

    @property
    def length_m(self) -> float:
        """From the first to the last point."""
        return float(self.distance_m[-1])

    def at(self, distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n, 3] points at ``distance_m`` [n] from the start; the ends stand for what lies beyond."""
        return np.stack([np.interp(distance_m, self.distance_m, self.points[:, axis]) for axis in range(3)], axis=1)


@dataclass(frozen=True)
class Profile:
    """Distance over time, with constant acceleration between knots.

    Attributes:
        start_us: time of the first knot, microseconds.
        knots_s: [n] seconds since the first knot, increasing.
        distance_m, speed_mps, acceleration_mps2: [n] at, and from, each knot.
    """

    start_us: int
    knots_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    acceleration_mps2: NDArray[np.float64]

    def at(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """[n] metres. Before the first knot nothing moves; the last knot's motion goes on."""
        seconds = np.maximum((times_us - self.start_us) / 1e6, 0.0)
        knot = np.searchsorted(self.knots_s, seconds, side="right") - 1
        rest_s = seconds - self.knots_s[knot]
        return np.asarray(
            self.distance_m[knot] + self.speed_mps[knot] * rest_s + 0.5 * self.acceleration_mps2[knot] * rest_s**2
        )


@dataclass(frozen=True)
class Travel:
    """Motion along a path of something that touches it at two points, as a car does with its axles.

    Attributes:
        path, profile: the profile's distance is that of the foremost point.
        front_m, rear_m: how far behind it the two points are.
    """

    path: Path
    profile: Profile
    front_m: float
    rear_m: float

    def pivots(self, times_us: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The two points at each time, [n, 3] each."""
        distance_m = self.profile.at(times_us)
        return self.path.at(distance_m - self.front_m), self.path.at(distance_m - self.rear_m)

    def placements(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """[n, 4] x, y, z of the middle between the two points, and the heading."""
        front, rear = self.pivots(times_us)
        yaw_rad = np.arctan2(front[:, 1] - rear[:, 1], front[:, 0] - rear[:, 0])
        return np.column_stack([0.5 * (front + rear), yaw_rad])


@dataclass(frozen=True)
class Stand:
    """No motion: x, y, z and heading."""

    placement: tuple[float, float, float, float]

    def placements(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """[n, 4] the same at each time."""
        return np.tile(np.array(self.placement), (len(times_us), 1))


Motion = Travel | Stand


def rigid(x: float, y: float, z: float, yaw_rad: float) -> NDArray[np.float64]:
    """[4, 4] turned about the z axis, then shifted."""
    pose = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = x, y, z
    return pose


def overlap(
    placements_a: NDArray[np.float64],  # [n, 4] x, y, z, yaw
    half_size_a: NDArray[np.float64],  # [n, 2] half length, half width
    placements_b: NDArray[np.float64],
    half_size_b: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """[n] whether two rectangles in the plane overlap: no axis of either separates them."""
    offset = placements_b[:, :2] - placements_a[:, :2]
    axes_a, axes_b = (
        np.stack([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]).transpose(2, 0, 1)  # [n, axis, 2]
        for yaw in (placements_a[:, 3], placements_b[:, 3])
    )
    touching = np.ones(len(offset), dtype=np.bool_)
    cosines = np.abs(np.einsum("nic,njc->nij", axes_a, axes_b))
    for axes, own, other, across in (
        (axes_a, half_size_a, half_size_b, cosines),
        (axes_b, half_size_b, half_size_a, cosines.transpose(0, 2, 1)),
    ):
        distance = np.abs(np.einsum("nic,nc->ni", axes, offset))
        touching &= (distance < own + np.einsum("nij,nj->ni", across, other)).all(axis=1)
    return touching
