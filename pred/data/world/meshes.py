# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes with one material per face, and the few primitives that every street object is made of.

Objects are built around the origin, heading towards +x, standing on z = 0, in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """What a face is and looks like.

    Attributes:
        class_id: Cityscapes train id.
        colour: red, green, blue in [0, 1].
        reflectance: share of the LiDAR's light that returns at normal incidence, in [0, 1].
    """

    class_id: int
    colour: Colour
    reflectance: float


@dataclass(frozen=True)
class Mesh:
    """Triangles with per-face attributes.

    Attributes:
        vertices: [V, 3] float64, metres.
        faces: [F, 3] int32, indices into `vertices`.
        class_ids: [F] uint8, Cityscapes train ids.
        colours: [F, 3] float32 in [0, 1].
        reflectances: [F] float32 in [0, 1].
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    class_ids: NDArray[np.uint8]
    colours: NDArray[np.float32]
    reflectances: NDArray[np.float32]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw_rad: float = 0.0) -> Mesh:
        """Turned counter-clockwise about the z axis, then shifted."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        return self.turned([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], (x, y, z))

    def turned(self, rotation: ArrayLike, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
        """Multiplied by a [3, 3] rotation (and scale), then shifted."""
        vertices = self.vertices @ np.asarray(rotation, dtype=np.float64).T + np.asarray(shift)
        return Mesh(vertices, self.faces, self.class_ids, self.colours, self.reflectances)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner, [3] each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles in one mesh, in the order given."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, offsets, strict=True)]),
        class_ids=np.concatenate([mesh.class_ids for mesh in meshes]),
        colours=np.concatenate([mesh.colours for mesh in meshes]),
        reflectances=np.concatenate([mesh.reflectances for mesh in meshes]),
    )


def boxes(low: ArrayLike, high: ArrayLike, material: Material) -> Mesh:
    """Axis-aligned boxes between the corners ``low`` and ``high``, [N, 3] or [3] each."""
    low, high = (np.atleast_2d(np.asarray(corner, dtype=np.float64)) for corner in (low, high))
    corners = np.where(_CORNERS[None] == 0, low[:, None], high[:, None])
    return _instances(corners, _BOX_FACES, material)


def quads(corners: ArrayLike, material: Material) -> Mesh:
    """Flat quadrilaterals, [N, 4, 3] corners in turn, seen from both sides."""
    return _instances(np.asarray(corners, dtype=np.float64), _QUAD_FACES, material)


def loft(
    bottom: tuple[float, float, float, float],
    top: tuple[float, float, float, float],
    z_low: float,
    z_high: float,
    material: Material,
) -> Mesh:
    """Six-sided solid between two rectangles (x_min, x_max, y_min, y_max) at two heights.

    An edge of length zero is allowed: a gable roof is a loft whose upper rectangle is a line.
    """
    rectangle = np.array([bottom, top])[_CORNERS[:, 2]]
    corners = np.stack(
        [
            np.where(_CORNERS[:, 0] == 0, rectangle[:, 0], rectangle[:, 1]),
            np.where(_CORNERS[:, 1] == 0, rectangle[:, 2], rectangle[:, 3]),
            np.where(_CORNERS[:, 2] == 0, z_low, z_high),
        ],
        axis=1,
    )
    return _instances(corners[None], _BOX_FACES, material)


def prism(outline: ArrayLike, z_low: float, z_high: float, material: Material) -> Mesh:
    """Upright solid over a convex ``outline`` [n, 2], given counter-clockwise."""
    outline = np.asarray(outline, dtype=np.float64)
    count = len(outline)
    corners = np.concatenate([np.column_stack([outline, np.full(count, z)]) for z in (z_low, z_high)])
    near, fan = np.arange(count), np.arange(1, count - 1)
    after = (near + 1) % count
    sides = [(near, after, after + count), (near, after + count, near + count)]
    ends = [(fan * 0 + count, fan + count, fan + 1 + count), (fan * 0, fan + 1, fan)]
    faces = np.concatenate([np.stack(part, axis=1) for part in (*sides, *ends)]).astype(np.int32)
    return _instances(corners[None], faces, material)


def cylinders(
    start: ArrayLike,
    end: ArrayLike,
    radius_m: float,
    material: Material,
    end_radius_m: float | None = None,
    sides: int = 10,
) -> Mesh:
    """Closed cylinders (cones with ``end_radius_m``) from ``start`` to ``end``, [N, 3] or [3] each."""
    start, end = (np.atleast_2d(np.asarray(point, dtype=np.float64)) for point in (start, end))
    axis = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    # Any helper that is not parallel to the axis gives a perpendicular pair.
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = cross(helper, axis)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ring = cos * across[:, None] + sin * cross(axis, across)[:, None]
    far_radius_m = radius_m if end_radius_m is None else end_radius_m
    corners = np.concatenate(
        [
            start[:, None] + radius_m * ring,
            end[:, None] + far_radius_m * ring,
            start[:, None],
            end[:, None],
        ],
        axis=1,
    )
    return _instances(corners, _cylinder_faces(sides), material)


def blobs(
    centres: ArrayLike,
    radii: ArrayLike,
    material: Material,
    rng: np.random.Generator | None = None,
    roughness: float = 0.0,
    smoothness: int = 1,
) -> Mesh:
    """Ellipsoids at ``centres`` [N, 3] with semi-axes ``radii`` [N, 3]; with ``rng`` they become foliage.

    ``roughness`` is the standard deviation of the vertices' relative radius and of the faces' brightness.
    ``smoothness`` subdivides the icosahedron that often (20, 80, 320 faces).
    """
    centres, radii = (np.atleast_2d(np.asarray(value, dtype=np.float64)) for value in (centres, radii))
    vertices, faces = _icosphere(smoothness)
    corners = np.broadcast_to(vertices, (len(centres), *vertices.shape))
    if rng is not None:
        corners = corners * rng.normal(1.0, roughness, (*corners.shape[:2], 1)).clip(0.5, 1.5)
    mesh = _instances(centres[:, None] + corners * radii[:, None], faces, material)
    if rng is not None:
        brightness = rng.normal(1.0, roughness, (len(mesh.faces), 1)).astype(np.float32)
        np.multiply(mesh.colours, brightness.clip(0.5, 1.5), out=mesh.colours)
    return mesh


def cross(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Cross products of [N, 3] rows; `numpy.cross` takes several times as long."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _instances(corners: NDArray[np.float64], faces: NDArray[np.int32], material: Material) -> Mesh:
    """N copies of one topology: ``corners`` [N, V, 3], ``faces`` [F, 3]."""
    count, num_vertices = corners.shape[:2]
    num_faces = count * len(faces)
    offsets = np.arange(count, dtype=np.int32)[:, None, None] * np.int32(num_vertices)
    colours = np.empty((num_faces, 3), dtype=np.float32)
    colours[:] = material.colour
    return Mesh(
        vertices=corners.reshape(-1, 3),
        faces=(faces[None] + offsets).reshape(-1, 3),
        class_ids=np.full(num_faces, material.class_id, dtype=np.uint8),
        colours=colours,
        reflectances=np.full(num_faces, material.reflectance, dtype=np.float32),
    )


# Corner i of a box has x, y, z at the upper bound where bit 0, 1, 2 of i is set.
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
_QUAD_FACES = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32)
_BOX_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
_BOX_FACES = np.array([face for a, b, c, d in _BOX_QUADS for face in ((a, b, c), (a, c, d))], dtype=np.int32)


@lru_cache
def _cylinder_faces(sides: int) -> NDArray[np.int32]:
    """Vertices: the start ring, the end ring, the start centre, the end centre."""
    near = np.arange(sides)
    after = (near + 1) % sides
    quads = [(near, after, after + sides), (near, after + sides, near + sides)]
    caps = [(after, near, near * 0 + 2 * sides), (near + sides, after + sides, near * 0 + 2 * sides + 1)]
    return np.concatenate([np.stack(part, axis=1) for part in (*quads, *caps)]).astype(np.int32)


@lru_cache
def _icosphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    golden = (1 + 5**0.5) / 2
    plane = [(-1.0, golden), (1.0, golden), (-1.0, -golden), (1.0, -golden)]
    points = [(a, b, 0.0) for a, b in plane]
    points += [(0.0, a, b) for a, b in plane] + [(b, 0.0, a) for a, b in plane]
    vertices = [np.array(point) / np.linalg.norm(point) for point in points]
    # A face joins three mutually nearest vertices (edge length 2 / |(1, golden)| before scaling).
    near = np.linalg.norm(np.array(vertices)[:, None] - np.array(vertices)[None], axis=2) < 1.1
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    outward = [np.dot(vertices[i], np.cross(vertices[j], vertices[k])) > 0 for i, j, k in faces]
    faces = [(i, j, k) if out else (i, k, j) for (i, j, k), out in zip(faces, outward, strict=True)]
    for _ in range(subdivisions):
        middle: dict[tuple[int, int], int] = {}
        finer = []
        for face in faces:
            halves = []
            for a, b in ((0, 1), (1, 2), (2, 0)):
                edge = (min(face[a], face[b]), max(face[a], face[b]))
                if edge not in middle:
                    middle[edge] = len(vertices)
                    point = vertices[edge[0]] + vertices[edge[1]]
                    vertices.append(point / np.linalg.norm(point))
                halves.append(middle[edge])
            ab, bc, ca = halves
            finer += [(face[0], ab, ca), (face[1], bc, ab), (face[2], ca, bc), (ab, bc, ca)]
        faces = finer
    return np.array(vertices), np.array(faces, dtype=np.int32)
