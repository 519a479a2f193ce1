# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Everything in a town that has an annotation: what it is, where it is, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pred.data.world.meshes import Mesh
from pred.data.world.motion import Motion, Stand, Travel, overlap, rigid

MARGIN_M = 0.04
"""Boxes are that much larger than their meshes on the sides and above: two standard deviations of the range."""
GROUND_GAP_M = 0.02
"""Boxes end that much above the ground, so that points on the road are not in them."""
MOVING_MPS = 0.2
"""From this speed on an actor counts as moving."""
_HALF_SPAN_US = 10_000

VEHICLE_STATES = ("vehicle.moving", "vehicle.stopped")
PARKED_STATES = ("vehicle.moving", "vehicle.parked")
PEDESTRIAN_STATES = ("pedestrian.moving", "pedestrian.standing")
RIDDEN_STATES = ("cycle.with_rider", "cycle.with_rider")
RIDERLESS_STATES = ("cycle.without_rider", "cycle.without_rider")
NO_STATES = ("", "")


@dataclass(frozen=True)
class Actor:
    """Something annotated, moving or not.

    Attributes:
        instance: identity within its drive, at least 1.
        category: official nuScenes category.
        size_lwh_m: of its box: length along the heading, width, height.
        mesh: in the frame of the box (origin in its centre, x along the heading, z up).
        motion: where it stands on the ground.
        lift_m: from the ground to the centre of the box.
        states: official nuScenes attribute while it moves, and while it stands; empty where there is none.
    """

    instance: int
    category: str
    size_lwh_m: tuple[float, float, float]
    mesh: Mesh
    motion: Motion
    lift_m: float
    states: tuple[str, str]

    @property
    def is_static(self) -> bool:
        """Whether it never moves."""
        return isinstance(self.motion, Stand)

    def pose(self, time_us: int) -> NDArray[np.float64]:
        """T_world_from_box [4, 4]: box centre, x along the heading, z up."""
        x, y, z, yaw_rad = self.motion.placements(np.array([time_us]))[0]
        return rigid(x, y, z + self.lift_m, yaw_rad)

    def velocity(self, time_us: int) -> NDArray[np.float64]:
        """[3] of the box centre in the world, metres per second."""
        if self.is_static:
            return np.zeros(3)
        before, after = self.motion.placements(np.array([time_us - _HALF_SPAN_US, time_us + _HALF_SPAN_US]))
        return np.asarray((after - before)[:3] / (2e-6 * _HALF_SPAN_US))

    def attribute(self, time_us: int) -> str:
        """Official nuScenes attribute, or an empty string."""
        moving = not self.is_static and float(np.linalg.norm(self.velocity(time_us))) > MOVING_MPS
        return self.states[0 if moving else 1]


def make_actor(category: str, mesh: Mesh, motion: Motion, states: tuple[str, str]) -> Actor:
    """An actor whose box fits its mesh; its number follows later."""
    low, high = mesh.bounds()
    low = low + [-MARGIN_M, -MARGIN_M, GROUND_GAP_M]
    high = high + MARGIN_M
    centre, size = 0.5 * (low + high), high - low
    boxed = mesh.moved(*(-centre))
    length, width, height = (float(extent) for extent in size)
    return Actor(0, category, (length, width, height), boxed, motion, float(centre[2]), states)


def without_overlaps(
    units: Sequence[Sequence[Actor]],
    ego: Travel,
    ego_size_m: tuple[float, float],
    times_us: NDArray[np.int64],
    margin_m: float = 0.15,
) -> tuple[Actor, ...]:
    """Actors that never overlap the ego car or each other, numbered from 1.

    A unit (a lorry and its trailer, which must not overlap either) stays or goes as a whole. Of two that meet the one
    that is named later goes.

    Args:
        units: actors; those that stand before those that move.
        ego: motion of the ego car.
        ego_size_m: its length and width.
        times_us: [T] when to look.
        margin_m: that much larger on all sides counts what moves, on top of the boxes' own margin.
    """
    tracks = [ego.placements(times_us)]
    halves = [0.5 * np.array(ego_size_m) + 0.5 * margin_m]
    kept: list[Actor] = []
    for unit in units:
        bare = [0.5 * np.array(actor.size_lwh_m[:2]) for actor in unit]
        grown = [half + (0.0 if actor.is_static else margin_m) for actor, half in zip(unit, bare, strict=True)]
        own = [actor.motion.placements(times_us[:1] if actor.is_static else times_us) for actor in unit]
        folds = any(_meet(own[i], bare[i], own[j], bare[j]) for i in range(len(unit)) for j in range(i))
        clear = all(
            not _meet(track, half, other, other_half)
            for track, half in zip(own, grown, strict=True)
            for other, other_half in zip(tracks, halves, strict=True)
        )
        if clear and not folds:
            tracks += own
            halves += grown
            kept += unit
    return tuple(replace(actor, instance=number) for number, actor in enumerate(kept, start=1))


def _meet(
    track: NDArray[np.float64], half: NDArray[np.float64], other: NDArray[np.float64], other_half: NDArray[np.float64]
) -> bool:
    """Whether two tracks, [T, 4] or [1, 4] each, overlap at any time."""
    reach_m = np.hypot(*half) + np.hypot(*other_half)
    near = np.flatnonzero(((track[:, :2] - other[:, :2]) ** 2).sum(axis=1) < reach_m**2)
    if len(near) == 0:
        return False
    count = max(len(track), len(other))
    track, other = (np.broadcast_to(rows, (count, 4))[near] for rows in (track, other))
    return bool(overlap(track, np.tile(half, (len(near), 1)), other, np.tile(other_half, (len(near), 1))).any())
