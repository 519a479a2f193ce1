# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Which objects of a drive have a box in which keyframe: one rule for all layouts.

An object has a box in every keyframe from the first to the last in which a LiDAR point lies in it, as long as the
LiDAR can reach its centre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import invert_rigid, transform_points
from pred.data.world.actors import Actor
from pred.data.world.sensors import MAX_RANGE_M


class Candidate(NamedTuple):
    """An object whose centre is in the LiDAR's range.

    Attributes:
        actor: the object.
        T_lidar_from_box: [4, 4] float64.
        num_points: points of the sweep inside the box, faces included: the official meaning of num_lidar_pts.
    """

    actor: Actor
    T_lidar_from_box: NDArray[np.float64]
    num_points: int


def candidates(
    actors: Sequence[Actor],
    time_us: int,
    T_lidar_from_world: NDArray[np.float64],  # [4, 4]
    points: NDArray[np.float32],  # [N, 3 or more] x, y, z in the LiDAR frame
) -> list[Candidate]:
    """Objects in range at a time, with their points of the sweep of that time."""
    points = points[:, :3].astype(np.float64)
    x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
    found = []
    for actor in actors:
        T_lidar_from_box = T_lidar_from_world @ actor.pose(time_us)
        if np.linalg.norm(T_lidar_from_box[:3, 3]) > MAX_RANGE_M:
            continue
        half = np.asarray(actor.size_lwh_m) / 2
        centre_x, centre_y = T_lidar_from_box[:2, 3]
        near = points[(x - centre_x) ** 2 + (y - centre_y) ** 2 <= half @ half]
        inside = np.abs(transform_points(invert_rigid(T_lidar_from_box), near)) <= half
        found.append(Candidate(actor, T_lidar_from_box, int(inside.all(axis=1).sum())))
    return found


def annotated_keyframes(num_points: Sequence[Mapping[int, int]]) -> dict[int, list[int]]:
    """Numbers of the keyframes in which each object has a box, by instance, in rising order.

    Args:
        num_points: for each keyframe of the drive, points by instance of the objects in range.
    """
    tracks: dict[int, list[int]] = {}
    for number, counts in enumerate(num_points):
        for instance in counts:
            tracks.setdefault(instance, []).append(number)
    annotated = {}
    for instance, track in sorted(tracks.items()):
        seen = [number for number in track if num_points[number][instance]]
        if seen:
            annotated[instance] = [number for number in track if seen[0] <= number <= seen[-1]]
    return annotated
