# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Recognisable street objects, built from primitives and drawn from a generator.

Every function returns a mesh around the origin: heading (or facing) +x, standing on z = 0, metres.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import CLASS_NAMES
from pred.data.world.meshes import Colour, Material, Mesh, blobs, boxes, cylinders, loft, merge, quads

T = TypeVar("T")

CLASS_IDS = {name: class_id for class_id, name in enumerate(CLASS_NAMES)}
"""Cityscapes train id of each class name."""

_CAR_PAINTS: tuple[Colour, ...] = (
    (0.70, 0.10, 0.10), (0.12, 0.22, 0.55), (0.76, 0.76, 0.76), (0.10, 0.10, 0.12),
    (0.55, 0.57, 0.60), (0.15, 0.40, 0.25), (0.80, 0.55, 0.10),
)  # fmt: skip
_FACADES: tuple[Colour, ...] = (
    (0.72, 0.52, 0.40), (0.80, 0.74, 0.62), (0.62, 0.34, 0.28), (0.70, 0.70, 0.68),
    (0.82, 0.68, 0.45), (0.55, 0.60, 0.66),
)  # fmt: skip
_CLOTHES: tuple[Colour, ...] = (
    (0.75, 0.20, 0.20), (0.15, 0.35, 0.70), (0.90, 0.80, 0.30), (0.15, 0.15, 0.18),
    (0.85, 0.85, 0.85), (0.20, 0.50, 0.35), (0.55, 0.30, 0.55),
)  # fmt: skip
_SKINS: tuple[Colour, ...] = ((0.90, 0.72, 0.60), (0.72, 0.52, 0.40), (0.45, 0.30, 0.22))


def material(class_name: str, colour: Colour, reflectance: float) -> Material:
    """A material of a named Cityscapes class."""
    return Material(CLASS_IDS[class_name], colour, reflectance)


ASPHALT = material("road", (0.33, 0.33, 0.34), 0.1)
PAINT = material("road", (0.88, 0.88, 0.85), 0.45)
PAVING = material("sidewalk", (0.62, 0.60, 0.57), 0.2)
GRASS = material("terrain", (0.45, 0.58, 0.28), 0.25)
_STEEL = material("pole", (0.42, 0.44, 0.45), 0.25)


def car(rng: np.random.Generator) -> Mesh:
    """Saloon or estate, 3.9 to 4.8 m long: body, glazed cabin, roof, wheels with hubs, lights, plates."""
    length, width, height = rng.uniform(3.9, 4.8), rng.uniform(1.74, 1.9), rng.uniform(1.42, 1.62)
    estate = rng.random() < 0.4
    front, side, waist = length / 2, width / 2, 0.62 * height
    body = material("car", _pick(rng, _CAR_PAINTS), rng.uniform(0.12, 0.45))
    glass = material("car", (0.13, 0.17, 0.21), 0.05)
    trim = material("car", (0.07, 0.07, 0.08), 0.06)
    # Windscreen and rear window lean; an estate's rear is nearly upright.
    sill = (-front + (0.12 if estate else 0.55), front - 1.0)
    roof = (-front + (0.35 if estate else 1.15), front - 1.75)
    parts = [
        loft(
            (-front + 0.1, front - 0.1, -side + 0.06, side - 0.06),
            (-front, front, -side, side),
            0.2,
            0.5,
            body,
        ),
        loft(
            (-front, front, -side, side),
            (-front + 0.06, front - 0.14, -side + 0.05, side - 0.05),
            0.5,
            waist,
            body,
        ),
        loft(
            (*sill, -side + 0.07, side - 0.07),
            (*roof, -side + 0.24, side - 0.24),
            waist,
            height - 0.05,
            glass,
        ),
        loft(
            (roof[0] - 0.03, roof[1] + 0.03, -side + 0.22, side - 0.22),
            (roof[0] + 0.05, roof[1] - 0.05, -side + 0.28, side - 0.28),
            height - 0.05,
            height,
            body,
        ),
        # The pillars between the side windows stand out of the glass by 1 cm.
        *(
            loft(
                (x - 0.05, x + 0.05, -side + 0.06, side - 0.06),
                (x - 0.04, x + 0.04, -side + 0.23, side - 0.23),
                waist,
                height - 0.05,
                body,
            )
            for x in (0.5 * (roof[0] + roof[1]), roof[0] + 0.1)
        ),
        boxes([-front - 0.02, -side + 0.1, 0.3], [front + 0.02, side - 0.1, 0.42], trim),
    ]
    wheel_x = front - 0.82
    hubs = np.array([[x, y, 0.33] for x in (-wheel_x, wheel_x) for y in (-side, side)])
    outward = np.sign(hubs) * [0.0, 1.0, 0.0]
    parts += [
        cylinders(hubs - 0.2 * outward, hubs + 0.015 * outward, 0.33, trim),
        cylinders(hubs, hubs + 0.03 * outward, 0.19, material("car", (0.62, 0.63, 0.65), 0.4), sides=6),
    ]
    lamps = {
        front: material("car", (0.95, 0.95, 0.88), 0.5),
        -front: material("car", (0.75, 0.05, 0.05), 0.5),
    }
    for x, lamp in lamps.items():
        inner, outer = sorted((0.9 * x, x + np.sign(x) * 0.015))
        for y in (-side + 0.28, side - 0.28):
            parts.append(boxes([inner, y - 0.2, 0.52], [outer, y + 0.2, 0.66], lamp))
        plate = material("car", (0.92, 0.92, 0.85), 0.9)
        parts.append(boxes([x - 0.03, -0.26, 0.3], [x + 0.03, 0.26, 0.41], plate))
    return merge(parts)


def pedestrian(rng: np.random.Generator) -> Mesh:
    """A walking person, 1.55 to 1.9 m tall."""
    height = rng.uniform(1.55, 1.9)
    scale = height / 1.75
    stride, swing = rng.uniform(0.05, 0.32), rng.uniform(0.05, 0.25)
    trousers = material("person", _pick(rng, _CLOTHES[1:4]), 0.15)
    coat = material("person", _pick(rng, _CLOTHES), 0.25)
    skin = material("person", _pick(rng, _SKINS), 0.3)
    hair = material("person", (0.16, 0.11, 0.07), 0.1)
    legs = (
        np.array([[stride, 0.1, 0.0], [-stride, -0.1, 0.0]]),
        np.array([[0.0, 0.09, 0.9], [0.0, -0.09, 0.9]]),
    )
    arms = (
        np.array([[0.0, 0.24, 1.4], [0.0, -0.24, 1.4]]),
        np.array([[-swing, 0.29, 0.85], [swing, -0.29, 0.85]]),
    )
    shoes = np.array([[stride + 0.04, 0.1, 0.04], [-stride + 0.04, -0.1, 0.04]])
    parts = [
        cylinders(*legs, 0.06, trousers, end_radius_m=0.1, sides=6),
        blobs(shoes, np.tile([0.14, 0.06, 0.06], (2, 1)), hair, smoothness=0),
        loft((-0.11, 0.11, -0.16, 0.16), (-0.12, 0.12, -0.23, 0.23), 0.82, 1.42, coat),
        cylinders(*arms, 0.065, coat, end_radius_m=0.05, sides=6),
        cylinders([0, 0, 1.4], [0, 0, 1.55], 0.06, skin, sides=6),
        blobs([0.01, 0, 1.63], [0.1, 0.085, 0.125], skin),
        blobs([-0.02, 0, 1.66], [0.105, 0.095, 0.12], hair),
    ]
    mesh = merge(parts)
    return mesh.turned(np.eye(3) * scale)


def broadleaf(rng: np.random.Generator) -> Mesh:
    """Tree with a trunk and a crown of overlapping blobs, 5 to 9 m tall."""
    trunk_m, crown_m = rng.uniform(2.2, 3.2), rng.uniform(1.5, 2.4)
    bark = material("vegetation", (0.36, 0.26, 0.18), 0.2)
    green = material("vegetation", _vary(rng, (0.25, 0.47, 0.16)), 0.25)
    num_blobs = 5
    turn = 2 * np.pi * np.arange(num_blobs) / num_blobs + rng.uniform(0, 6)
    reach = crown_m * rng.uniform(0.35, 0.7, num_blobs)
    reach[0] = 0.0
    centres = np.stack(
        [
            reach * np.cos(turn),
            reach * np.sin(turn),
            trunk_m + crown_m * rng.uniform(0.5, 1.1, num_blobs),
        ],
        axis=1,
    )
    centres[0, 2] = trunk_m + 1.3 * crown_m
    radii = crown_m * rng.uniform(0.5, 0.75, (num_blobs, 1)) * [[1.0, 1.0, 0.85]]
    return merge(
        [
            cylinders([0, 0, -0.1], [0, 0, trunk_m + crown_m], 0.16, bark, end_radius_m=0.08, sides=6),
            blobs(centres, radii, green, rng, roughness=0.1),
        ]
    )


def conifer(rng: np.random.Generator) -> Mesh:
    """Tree of stacked cones, 5 to 8 m tall."""
    height, radius_m = rng.uniform(5.0, 8.0), rng.uniform(1.2, 1.7)
    bark = material("vegetation", (0.32, 0.23, 0.16), 0.2)
    green = material("vegetation", _vary(rng, (0.13, 0.34, 0.17)), 0.2)
    parts = [cylinders([0, 0, -0.1], [0, 0, 0.3 * height], 0.14, bark, sides=8)]
    for tier in range(4):
        base = [0.0, 0.0, height * (0.16 + 0.2 * tier)]
        tip = [0.0, 0.0, height * (0.5 + 0.1667 * tier)]
        parts.append(cylinders(base, tip, radius_m * (1 - 0.2 * tier), green, end_radius_m=0.02, sides=12))
    return merge(parts)


def hedge(rng: np.random.Generator, length_m: float) -> Mesh:
    """Clipped row of bushes along y, about 1.1 m tall."""
    green = material("vegetation", _vary(rng, (0.20, 0.38, 0.14)), 0.25)
    count = max(int(length_m / 0.75), 1)
    along = (np.arange(count) + 0.5) / count * length_m - length_m / 2
    centres = np.stack([np.zeros(count), along, np.full(count, 0.45)], axis=1)
    radii = np.tile([0.45, 0.62, 0.65], (count, 1)) * rng.uniform(0.9, 1.1, (count, 1))
    return blobs(centres, radii, green, rng, roughness=0.09)


def fence(rng: np.random.Generator, length_m: float) -> Mesh:
    """Picket fence along y, 1.1 m tall."""
    paint = material("fence", _pick(rng, ((0.86, 0.84, 0.78), (0.45, 0.32, 0.22))), 0.35)
    along = np.arange(-length_m / 2, length_m / 2, 0.2)
    zeros = np.zeros_like(along)
    low = np.stack([zeros - 0.02, along, zeros], axis=1)
    high = np.stack([zeros + 0.02, along + 0.11, zeros + 1.1], axis=1)
    rails_low = [[-0.04, -length_m / 2, 0.25], [-0.04, -length_m / 2, 0.8]]
    rails_high = [[-0.021, length_m / 2, 0.33], [-0.021, length_m / 2, 0.88]]
    return merge([boxes(low, high, paint), boxes(rails_low, rails_high, paint)])


def wall(rng: np.random.Generator, length_m: float) -> Mesh:
    """Garden wall with a cap along y, about 1.3 m tall."""
    height = rng.uniform(1.1, 1.6)
    brick = material("wall", _vary(rng, (0.58, 0.42, 0.34)), 0.2)
    cap = material("wall", (0.68, 0.66, 0.62), 0.25)
    half = length_m / 2
    return merge(
        [
            boxes([-0.12, -half, -0.1], [0.12, half, height], brick),
            boxes([-0.17, -half - 0.05, height], [0.17, half + 0.05, height + 0.08], cap),
        ]
    )


def street_lamp() -> Mesh:
    """Lamp post, 7 m, its arm reaching over +x."""
    lamp = material("pole", (0.88, 0.88, 0.82), 0.4)
    return merge(
        [
            cylinders([0, 0, -0.1], [0, 0, 7.0], 0.11, _STEEL, end_radius_m=0.06),
            cylinders([0, 0, 6.9], [1.8, 0, 7.2], 0.05, _STEEL, sides=8),
            boxes([1.5, -0.12, 7.12], [2.2, 0.12, 7.26], lamp),
        ]
    )


def traffic_light(rng: np.random.Generator) -> Mesh:
    """Signal of three lamps on a pole, facing +x."""
    housing = material("traffic light", (0.08, 0.09, 0.09), 0.15)
    lit = int(rng.integers(3))
    parts = [
        cylinders([0, 0, -0.1], [0, 0, 3.1], 0.08, _STEEL),
        boxes([-0.06, -0.2, 2.9], [0.22, 0.2, 3.9], housing),
        boxes([-0.1, -0.3, 2.8], [-0.061, 0.3, 4.0], housing),
    ]
    for lamp, colour in enumerate(((0.95, 0.1, 0.08), (0.95, 0.7, 0.1), (0.15, 0.85, 0.35))):
        shade = 1.0 if lamp == lit else 0.3
        glow = material("traffic light", (shade * colour[0], shade * colour[1], shade * colour[2]), 0.3)
        z = 3.7 - 0.3 * lamp
        parts.append(cylinders([0.1, 0, z], [0.25, 0, z], 0.12, glow, sides=12))
    return merge(parts)


def traffic_sign(rng: np.random.Generator) -> Mesh:
    """Round, triangular or square plate with a coloured rim on a pole, facing +x."""
    sides, tilt, rim_colour, face_colour = _pick(
        rng,
        (
            (20, 0.0, (0.80, 0.06, 0.08), (0.96, 0.96, 0.94)),
            (3, 0.0, (0.80, 0.06, 0.08), (0.96, 0.96, 0.94)),
            (4, np.pi / 4, (0.95, 0.95, 0.95), (0.08, 0.25, 0.70)),
            (4, 0.0, (0.95, 0.95, 0.95), (0.95, 0.75, 0.08)),
        ),
    )
    rim = material("traffic sign", rim_colour, 0.9)
    face = material("traffic sign", face_colour, 0.9)
    back = material("traffic sign", (0.5, 0.5, 0.52), 0.3)
    plate = merge(
        [
            cylinders([0.05, 0, 0], [0.07, 0, 0], 0.42, back, sides=sides),
            cylinders([0.06, 0, 0], [0.08, 0, 0], 0.42, rim, sides=sides),
            cylinders([0.06, 0, 0], [0.09, 0, 0], 0.32, face, sides=sides),
        ]
    )
    # `cylinders` starts its ring half a side off the y axis; with tilt 0 a corner shall point up.
    angle = np.pi / 2 - np.pi / sides + tilt
    c, s = np.cos(angle), np.sin(angle)
    plate = plate.turned([[1, 0, 0], [0, c, -s], [0, s, c]], (0.0, 0.0, 2.6))
    return merge([cylinders([0, 0, -0.1], [0, 0, 2.9], 0.05, _STEEL, sides=8), plate])


def apartment_block(
    rng: np.random.Generator, width_m: float, depth_m: float, storeys_range: tuple[int, int] = (3, 7)
) -> Mesh:
    """Flat-roofed building, by default of 3 to 6 storeys; its front is at x = 0, facing +x, and its body behind."""
    storeys, storey_m = int(rng.integers(*storeys_range)), rng.uniform(2.9, 3.3)
    height = storeys * storey_m + 0.8
    paint = _vary(rng, _pick(rng, _FACADES))
    facade = material("building", paint, rng.uniform(0.15, 0.35))
    plinth = material("building", (0.7 * paint[0], 0.7 * paint[1], 0.7 * paint[2]), 0.2)
    half = width_m / 2
    parts = [
        boxes([-depth_m, -half, -0.1], [0.0, half, height], facade),
        boxes([-depth_m - 0.06, -half - 0.06, -0.1], [0.06, half + 0.06, 0.7], plinth),
        boxes([-depth_m - 0.15, -half - 0.15, height], [0.2, half + 0.15, height + 0.35], plinth),
        # A balcony slab, or cornice, at each floor breaks up the front.
        boxes(
            [[0.0, -half, storey_m * k - 0.1] for k in range(1, storeys)],
            [[0.12, half, storey_m * k + 0.12] for k in range(1, storeys)],
            plinth,
        ),
    ]
    sills = 0.95 + storey_m * np.arange(storeys, dtype=np.float64)
    parts += _windows(width_m, depth_m, sills)
    door_y = rng.uniform(-half + 2.0, half - 2.0)
    door = material("building", (0.30, 0.20, 0.13), 0.2)
    parts.append(boxes([0.0, door_y - 0.6, 0.0], [0.14, door_y + 0.6, 2.3], door))
    return merge(parts)


def house(rng: np.random.Generator, width_m: float, depth_m: float) -> Mesh:
    """Two storeys under a gable roof; its front is at x = 0, facing +x, and its body behind."""
    eaves = rng.uniform(5.0, 5.8)
    facade = material("building", _vary(rng, _pick(rng, _FACADES)), rng.uniform(0.2, 0.4))
    tiles = material("building", _vary(rng, (0.50, 0.22, 0.16)), 0.15)
    door = material("building", _vary(rng, (0.35, 0.20, 0.15)), 0.2)
    half, rise = width_m / 2, 0.35 * depth_m
    parts = [
        boxes([-depth_m, -half, -0.1], [0.0, half, eaves], facade),
        loft(
            (-depth_m - 0.4, 0.4, -half - 0.3, half + 0.3),
            (-depth_m / 2, -depth_m / 2, -half - 0.3, half + 0.3),
            eaves,
            eaves + rise,
            tiles,
        ),
        boxes([-depth_m / 2 - 1.2, half - 1.6, eaves], [-depth_m / 2 - 0.6, half - 1.0, eaves + rise + 0.9], tiles),
        boxes([0.0, -0.5, 0.0], [0.09, 0.5, 2.1], door),
    ]
    parts += _windows(width_m, depth_m, np.array([0.9, 3.4]))
    return merge(parts)


def woods(rng: np.random.Generator, nearest_m: float, farthest_m: float, count: int) -> Mesh:
    """Ring of tree tops around the origin, so that the horizon is not bare."""
    leaves = material("vegetation", (0.22, 0.36, 0.20), 0.2)
    turn = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1, count)) / count
    distance_m = rng.uniform(nearest_m, farthest_m, count)
    height_m = rng.uniform(5.0, 11.0, count)
    centres = np.stack([distance_m * np.cos(turn), distance_m * np.sin(turn), 0.6 * height_m], axis=1)
    radii = np.stack([np.full(count, 10.0), np.full(count, 10.0), height_m], axis=1)
    return blobs(centres, radii, leaves, rng, roughness=0.07)


def _windows(width_m: float, depth_m: float, sills_m: NDArray[np.float64]) -> list[Mesh]:
    """Frames and panes in rows on the front and on both sides, 4 and 6 cm proud of the wall."""
    glass = material("building", (0.22, 0.30, 0.38), 0.05)
    frame = material("building", (0.90, 0.88, 0.84), 0.3)

    def grid(extent_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        count = max(int(extent_m / 2.4), 1)
        places = (np.arange(count) + 0.5) * extent_m / count - extent_m / 2
        along, sill = np.meshgrid(places, sills_m)
        return along.ravel(), sill.ravel()

    meshes = []
    for half_m, height_m, proud_m, paint in ((0.62, 1.5, 0.04, frame), (0.52, 1.3, 0.06, glass)):
        margin_m = (1.5 - height_m) / 2
        along, sill = grid(width_m)
        y = np.stack([along - half_m, along + half_m, along + half_m, along - half_m], axis=1)
        z = sill[:, None] + margin_m + np.array([0.0, 0.0, height_m, height_m])
        meshes.append(quads(np.stack([np.full_like(y, proud_m), y, z], axis=2), paint))
        along, sill = grid(depth_m)
        along -= depth_m / 2
        x = np.stack([along - half_m, along + half_m, along + half_m, along - half_m], axis=1)
        z = sill[:, None] + margin_m + np.array([0.0, 0.0, height_m, height_m])
        for reach_m in (-width_m / 2 - proud_m, width_m / 2 + proud_m):
            meshes.append(quads(np.stack([x, np.full_like(x, reach_m), z], axis=2), paint))
    return meshes


def _pick(rng: np.random.Generator, choices: tuple[T, ...]) -> T:
    return choices[int(rng.integers(len(choices)))]


def _vary(rng: np.random.Generator, colour: Colour) -> Colour:
    """A slightly lighter or darker shade."""
    red, green, blue = (np.array(colour) * rng.uniform(0.85, 1.15)).clip(0, 1)
    return float(red), float(green), float(blue)
