# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A town at one moment: a large acceleration structure for what stands still, a small one for what moves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.world.actors import Actor
from pred.data.world.meshes import Mesh, merge
from pred.data.world.motion import rigid
from pred.data.world.scene import Scene


class Surfaces(NamedTuple):
    """What N rays meet first.

    Attributes:
        t_m: [N] float32, distance; infinite where a ray meets nothing.
        class_id: [N] uint8, Cityscapes train id; sky where a ray meets nothing.
        normal: [N, 3] float32, unit, facing the ray.
        colour: [N, 3] float32 in [0, 1].
        reflectance: [N] float32 in [0, 1].
        instance: [N] int32, actor; 0 for none.
    """

    t_m: NDArray[np.float32]
    class_id: NDArray[np.uint8]
    normal: NDArray[np.float32]
    colour: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    instance: NDArray[np.int32]


class Layer:
    """A scene whose triangles know the actor that they belong to."""

    def __init__(self, ground: Mesh | None, actors: Sequence[tuple[Actor, NDArray[np.float64]]]) -> None:
        """``ground`` belongs to nobody; actors come with their T_world_from_box."""
        meshes = [] if ground is None else [ground]
        meshes += [actor.mesh.turned(pose[:3, :3], pose[:3, 3].tolist()) for actor, pose in actors]
        owners = [] if ground is None else [0]
        owners += [actor.instance for actor, _ in actors]
        self.scene = Scene(merge(meshes))
        faces = [len(mesh.faces) for mesh in meshes]
        self.instances = np.append(np.repeat(np.array(owners, dtype=np.int32), faces), np.int32(0))
        """[F + 1] int32 by `Hits.face`; the last entry stands for misses."""

    def cast(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Surfaces:
        """First hits in this layer alone."""
        hits = self.scene.cast(origins, directions)
        face = hits.face
        return Surfaces(
            hits.t_m,
            hits.class_id,
            hits.normal,
            self.scene.colours[face],
            self.scene.reflectances[face],
            self.instances[face],
        )


class Sector(NamedTuple):
    """Which directions in the plane count: ``heading_rad`` give or take ``half_rad``; ``margin_m`` on top."""

    heading_rad: float
    half_rad: float
    margin_m: float


def moving_layer(
    actors: Sequence[Actor],
    placements: NDArray[np.float64],  # [M, 4] of the actors on the ground: x, y, z, heading
    viewer: NDArray[np.float64],  # [2]
    within_m: float,
    sector: Sector,
) -> Layer | None:
    """The actors that somebody at ``viewer`` can meet within a distance, looking into a sector; None if there is none.

    Those that only touch the sector belong to it, as does what stands right beside the viewer.
    """
    offset = placements[:, :2] - viewer
    distance_m = np.hypot(*offset.T)
    reach_m = np.array([0.5 * np.hypot(*actor.size_lwh_m[:2]) for actor in actors]) + sector.margin_m
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - sector.heading_rad
    bearing = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    widened = sector.half_rad + np.arcsin(np.minimum(reach_m / np.maximum(distance_m, reach_m), 1.0))
    found = np.flatnonzero((distance_m < within_m) & (bearing < widened))
    if len(found) == 0:
        return None
    return Layer(
        None,
        [
            (actors[k], rigid(x, y, z + actors[k].lift_m, yaw_rad))
            for k, (x, y, z, yaw_rad) in zip(found.tolist(), placements[found], strict=True)
        ],
    )


def cover(
    below: Surfaces, layer: Layer, origins: NDArray[np.float32], directions: NDArray[np.float32], rays: slice
) -> None:
    """Replace hits ``below`` by those of ``layer`` that are nearer, for a slice of the rays."""
    directions = directions[rays]
    t_m, face = layer.scene.first(origins[rays] if origins.ndim == 2 else origins, directions)
    (nearer,) = np.nonzero(t_m < below.t_m[rays])
    face = face[nearer]
    hits = layer.scene.hits(t_m[nearer], face, directions[nearer])
    for target, values in (
        (below.t_m, hits.t_m),
        (below.class_id, hits.class_id),
        (below.normal, hits.normal),
        (below.colour, layer.scene.colours[face]),
        (below.reflectance, layer.scene.reflectances[face]),
        (below.instance, layer.instances[face]),
    ):
        target[rays][nearer] = values
