# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A mesh that can be ray cast: the only place that knows the ray tracer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.world.meshes import Mesh, cross
from pred.data.world.objects import CLASS_IDS

SKY_CLASS = CLASS_IDS["sky"]


class Hits(NamedTuple):
    """First hits of N rays.

    Attributes:
        t_m: [N] float32, distance along the unit direction; infinite where a ray meets nothing.
        face: [N] int64, index of the triangle; -1 where a ray meets nothing.
        class_id: [N] uint8, Cityscapes train id; sky where a ray meets nothing.
        normal: [N, 3] float32, unit, facing the ray; zero where a ray meets nothing.
    """

    t_m: NDArray[np.float32]
    face: NDArray[np.int64]
    class_id: NDArray[np.uint8]
    normal: NDArray[np.float32]


class Scene:
    """Static geometry with an acceleration structure.

    Equal meshes and rays give equal hits, bit for bit, in every process on one machine.
    """

    def __init__(self, mesh: Mesh) -> None:
        # Imported here so that jobs on recorded data neither load nor need the ray tracer.
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        vertices = mesh.vertices.astype(np.float32)
        self._tracer = EmbreeScene()
        self._triangles = TriangleMesh(self._tracer, vertices, mesh.faces)
        corners = vertices[mesh.faces]
        normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Degenerate triangles (the ridge of a roof) have no normal and are never hit.
        lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        # One row more than there are faces: index -1, a miss, reads the sky.
        self._normals = np.concatenate([normals / lengths, np.zeros((1, 3), np.float32)])
        self._class_ids = np.append(mesh.class_ids, np.uint8(SKY_CLASS))
        self.colours = np.concatenate([mesh.colours, np.zeros((1, 3), np.float32)])
        """[F + 1, 3] float32: colour by `Hits.face`; the last row stands for misses."""
        self.reflectances = np.append(mesh.reflectances, np.float32(0))
        """[F + 1] float32: LiDAR reflectance by `Hits.face`; the last row stands for misses."""

    def cast(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """First hits of rays from ``origins`` [N, 3] (or one [3]) along unit ``directions`` [N, 3]."""
        t_m, face = self.first(origins, directions)
        return self.hits(t_m, face, directions)

    def first(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Distance and triangle of first hits alone, as in `Hits`."""
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        origins = np.broadcast_to(np.asarray(origins, dtype=np.float32), directions.shape)
        found = self._tracer.run(np.ascontiguousarray(origins), directions, output=1)
        face = found["primID"].astype(np.int64)
        return np.where(face >= 0, found["tfar"], np.float32(np.inf)), face

    def hits(self, t_m: NDArray[np.float32], face: NDArray[np.int64], directions: NDArray[np.float32]) -> Hits:
        """What there is to know of first hits of rays along ``directions``."""
        normal = self._normals[face]
        away = np.einsum("nc,nc->n", normal, directions.astype(np.float32, copy=False)) > 0
        normal[away] *= -1
        return Hits(t_m, face, self._class_ids[face], normal)

    def occluded(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[N] whether rays from ``origins`` [N, 3] along ``directions`` [N, 3] meet anything."""
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        hit = self._tracer.run(np.ascontiguousarray(origins), directions, query="OCCLUDED")
        return np.asarray(hit >= 0)
