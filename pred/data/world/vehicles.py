# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Lorries, buses, trailers, machines, cycles and their riders, workers, cones and barriers.

As in `objects`, every function returns a mesh around the origin: heading +x, standing on z = 0, metres. Classes are
those of Cityscapes: trailers and construction machines count as trucks, a temporary barrier as a fence; a cone is none
of the nineteen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pred.data.world.meshes import Colour, Material, Mesh, blobs, boxes, cylinders, loft, merge
from pred.data.world.objects import material, pedestrian

NO_CLASS = 255
"""Train id of what is none of the nineteen Cityscapes classes."""

_LORRY_PAINTS: tuple[Colour, ...] = (
    (0.85, 0.85, 0.83), (0.16, 0.30, 0.58), (0.72, 0.16, 0.12), (0.20, 0.42, 0.30), (0.90, 0.66, 0.12),
)  # fmt: skip
_BUS_PAINTS: tuple[Colour, ...] = ((0.74, 0.12, 0.12), (0.10, 0.42, 0.62), (0.20, 0.50, 0.26), (0.88, 0.72, 0.20))
_GLASS: Colour = (0.12, 0.16, 0.20)
_RUBBER: Colour = (0.06, 0.06, 0.07)
_CHROME: Colour = (0.60, 0.61, 0.63)
_YELLOW: Colour = (0.92, 0.66, 0.08)


def truck(rng: np.random.Generator) -> Mesh:
    """Rigid lorry with a box or an open tipper body, 6 to 8.5 m long."""
    length, width, height = rng.uniform(6.0, 8.5), rng.uniform(2.25, 2.45), rng.uniform(2.8, 3.4)
    front, side = length / 2, width / 2
    frame = material("truck", (0.16, 0.16, 0.17), 0.1)
    body = material("truck", _pick(rng, _LORRY_PAINTS), rng.uniform(0.2, 0.45))
    parts = [*_cab(front, side, material("truck", _pick(rng, _LORRY_PAINTS), rng.uniform(0.15, 0.4)))]
    parts.append(boxes([-front + 0.1, -0.45, 0.55], [front - 0.4, 0.45, 0.85], frame))
    load_front = front - 2.15
    if rng.random() < 0.65:
        ribs = np.linspace(-front + 0.5, load_front - 0.5, 5)
        parts.append(boxes([-front + 0.02, -side, 0.9], [load_front, side, height], body))
        for y in (-side, side):
            low, high = sorted((y, y + np.sign(y) * 0.02))
            parts.append(boxes([[x, low, 1.0] for x in ribs], [[x + 0.06, high, height - 0.1] for x in ribs], frame))
        parts.append(boxes([-front, -0.02, 1.0], [-front + 0.02, 0.02, height - 0.1], frame))
    else:
        parts.append(
            loft(
                (-front + 0.35, load_front, -side + 0.15, side - 0.15),
                (-front, load_front, -side, side),
                0.9,
                2.2,
                body,
            )
        )
        heap = material("truck", (0.42, 0.34, 0.26), 0.2)
        middle, half = (load_front - front) / 2, (load_front + front) / 2
        parts.append(blobs([middle, 0, 2.1], [0.85 * half, 0.8 * side, 0.55], heap, rng, roughness=0.06))
    parts += _wheels("truck", (front - 1.0, -front + 1.2, -front + 2.2), side, 0.48)
    parts += _tail_lamps("truck", -front, side, 0.75)
    return merge(parts)


def _cab(front: float, side: float, paint: Material) -> list[Mesh]:
    """Forward-control cab, 2 m long, with windscreen, side windows, grille and lamps."""
    glass = material("truck", _GLASS, 0.05)
    rear = front - 2.0
    return [
        loft((rear, front, -side, side), (rear, front - 0.02, -side + 0.02, side - 0.02), 0.45, 1.45, paint),
        loft(
            (rear + 0.35, front - 0.02, -side + 0.03, side - 0.03),
            (rear + 0.35, front - 0.3, -side + 0.12, side - 0.12),
            1.45,
            2.25,
            glass,
        ),
        loft(
            (rear, rear + 0.36, -side + 0.02, side - 0.02),
            (rear, rear + 0.36, -side + 0.1, side - 0.1),
            1.45,
            2.25,
            paint,
        ),
        loft(
            (rear, front - 0.28, -side + 0.1, side - 0.1),
            (rear + 0.1, front - 0.5, -side + 0.2, side - 0.2),
            2.25,
            2.5,
            paint,
        ),
        boxes([front - 0.02, -0.6 * side, 0.75], [front + 0.02, 0.6 * side, 1.2], material("truck", _RUBBER, 0.1)),
        boxes(
            [[front - 0.02, y - 0.18, 0.55] for y in (-0.75 * side, 0.75 * side)],
            [[front + 0.03, y + 0.18, 0.72] for y in (-0.75 * side, 0.75 * side)],
            material("truck", (0.95, 0.95, 0.88), 0.5),
        ),
    ]


def trailer(rng: np.random.Generator) -> Mesh:
    """Drawbar trailer with a box body, 5.5 to 8 m long; its bar points ahead."""
    length, width, height = rng.uniform(5.5, 8.0), rng.uniform(2.2, 2.45), rng.uniform(2.7, 3.3)
    front, side = length / 2, width / 2
    body = material("truck", _pick(rng, _LORRY_PAINTS), rng.uniform(0.2, 0.45))
    frame = material("truck", (0.16, 0.16, 0.17), 0.1)
    stripe = material("truck", _pick(rng, _LORRY_PAINTS), 0.3)
    return merge(
        [
            boxes([-front, -side, 0.85], [front - 1.0, side, height], body),
            boxes([-front - 0.01, -side - 0.01, 1.3], [front - 0.99, side + 0.01, 1.6], stripe),
            boxes([-front + 0.1, -0.4, 0.55], [front - 1.0, 0.4, 0.85], frame),
            cylinders([[front - 1.0, y, 0.65] for y in (-0.5, 0.5)], [[front, 0, 0.6]] * 2, 0.06, frame, sides=6),
            *_wheels("truck", (-0.5, -1.6), side, 0.45),
            *_tail_lamps("truck", -front, side, 0.75),
        ]
    )


def bus(rng: np.random.Generator) -> Mesh:
    """City bus, 9.5 to 11.5 m long, with window bands, doors on the right and a route display."""
    length, side, height = rng.uniform(9.5, 11.5), 1.25, rng.uniform(2.95, 3.2)
    front = length / 2
    paint = material("bus", _pick(rng, _BUS_PAINTS), rng.uniform(0.2, 0.4))
    light = material("bus", (0.88, 0.88, 0.86), 0.35)
    glass = material("bus", _GLASS, 0.05)
    dark = material("bus", _RUBBER, 0.1)
    panes = np.linspace(-front + 0.7, front - 1.6, 7)
    pane_m = 0.88 * (panes[1] - panes[0])
    doors = np.array([front - 1.35, 0.2])
    return merge(
        [
            boxes([-front, -side, 0.35], [front, side, 1.15], paint),
            loft(
                (-front, front, -side, side),
                (-front, front - 0.12, -side + 0.04, side - 0.04),
                1.15,
                height - 0.2,
                light,
            ),
            loft(
                (-front, front - 0.12, -side + 0.04, side - 0.04),
                (-front + 0.15, front - 0.3, -side + 0.2, side - 0.2),
                height - 0.2,
                height,
                paint,
            ),
            boxes([[x, -side - 0.012, 1.3] for x in panes], [[x + pane_m, side + 0.012, 2.3] for x in panes], glass),
            boxes([[x, -side - 0.02, 0.42] for x in doors], [[x + 1.1, -side + 0.1, 2.35] for x in doors], glass),
            boxes([[x + 0.52, -side - 0.03, 0.42] for x in doors], [[x + 0.58, -side, 2.35] for x in doors], light),
            loft(
                (front - 0.1, front + 0.02, -side + 0.12, side - 0.12),
                (front - 0.2, front - 0.08, -side + 0.14, side - 0.14),
                1.0,
                2.35,
                glass,
            ),
            boxes([front - 0.3, -0.7, 2.5], [front - 0.06, 0.7, 2.75], material("bus", (0.95, 0.70, 0.15), 0.3)),
            boxes([-front - 0.02, -side + 0.2, 1.5], [-front + 0.1, side - 0.2, 2.3], glass),
            boxes([-front - 0.02, -side + 0.05, 0.35], [front + 0.03, side - 0.05, 0.5], dark),
            *_wheels("bus", (front - 2.3, -front + 2.6), side, 0.48),
            *_tail_lamps("bus", -front - 0.02, side, 0.8),
        ]
    )


def excavator(rng: np.random.Generator) -> Mesh:
    """Tracked excavator: crawler, house with cab, boom, stick and bucket; about 6 m long."""
    paint = material("truck", _YELLOW, rng.uniform(0.25, 0.4))
    dark = material("truck", (0.13, 0.13, 0.14), 0.1)
    glass = material("truck", _GLASS, 0.05)
    knee, tip = np.array([2.0, -0.1, 3.3]), np.array([3.3, -0.1, 1.6])
    return merge(
        [
            boxes([[-1.5, y - 0.25, 0.0] for y in (-0.95, 0.95)], [[1.5, y + 0.25, 0.75] for y in (-0.95, 0.95)], dark),
            boxes([-1.0, -0.7, 0.4], [1.0, 0.7, 0.9], dark),
            loft((-2.1, 1.2, -1.15, 1.15), (-2.0, 1.2, -1.1, 1.1), 0.9, 1.75, paint),
            boxes([-2.15, -1.0, 1.0], [-1.3, 1.0, 2.0], paint),
            loft((-0.2, 1.3, 0.2, 1.12), (0.0, 1.1, 0.25, 1.05), 1.75, 2.65, glass),
            boxes([-0.1, 0.2, 2.65], [1.2, 1.1, 2.75], paint),
            cylinders([0.6, -0.1, 1.4], knee, 0.24, paint, end_radius_m=0.17, sides=4),
            cylinders(knee + [-0.2, 0, 0.1], tip, 0.18, paint, end_radius_m=0.12, sides=4),
            cylinders([1.0, -0.1, 1.4], knee + [-0.5, 0, -0.4], 0.06, material("truck", _CHROME, 0.4), sides=6),
            loft((2.9, 3.4, -0.55, 0.35), (2.7, 3.7, -0.6, 0.4), 0.85, 1.65, dark),
        ]
    )


def wheel_loader(rng: np.random.Generator) -> Mesh:
    """Wheel loader with a raised bucket; about 6 m long."""
    paint = material("truck", _YELLOW, rng.uniform(0.25, 0.4))
    dark = material("truck", (0.13, 0.13, 0.14), 0.1)
    arms = np.array([[0.9, y, 1.5] for y in (-0.5, 0.5)])
    return merge(
        [
            loft((-2.7, -0.3, -1.0, 1.0), (-2.5, -0.3, -0.9, 0.9), 0.8, 1.9, paint),
            boxes([-0.4, -0.6, 0.7], [1.6, 0.6, 1.4], paint),
            loft((-0.6, 0.9, -0.75, 0.75), (-0.4, 0.7, -0.65, 0.65), 1.7, 2.95, material("truck", _GLASS, 0.05)),
            boxes([-0.55, -0.75, 2.95], [0.85, 0.75, 3.08], paint),
            cylinders(arms, arms + [1.6, 0, -0.7], 0.14, paint, sides=4),
            loft((2.3, 2.9, -1.25, 1.25), (2.2, 3.3, -1.25, 1.25), 0.3, 1.15, dark),
            *_wheels("truck", (1.25, -1.6), 1.15, 0.7),
        ]
    )


def motorcycle(rng: np.random.Generator, ridden: bool) -> Mesh:
    """Motorcycle, 2.1 m long, with its rider if ``ridden``."""
    paint = material("motorcycle", _pick(rng, _LORRY_PAINTS[1:]), 0.3)
    dark = material("motorcycle", _RUBBER, 0.08)
    chrome = material("motorcycle", _CHROME, 0.45)
    hubs = np.array([[-0.72, 0.0, 0.32], [0.74, 0.0, 0.32]])
    across = np.array([0.0, 0.07, 0.0])
    parts = [
        cylinders(hubs - across, hubs + across, 0.32, dark, sides=12),
        cylinders(hubs - 1.15 * across, hubs + 1.15 * across, 0.18, chrome, sides=8),
        boxes([-0.3, -0.16, 0.28], [0.35, 0.16, 0.62], chrome),
        loft((-0.1, 0.5, -0.16, 0.16), (0.0, 0.45, -0.1, 0.1), 0.62, 0.98, paint),
        loft((-1.0, 0.0, -0.12, 0.12), (-1.02, 0.0, -0.15, 0.15), 0.68, 0.84, dark),
        cylinders(
            [[0.74, y, 0.32] for y in (-0.1, 0.1)], [[0.46, y, 1.0] for y in (-0.1, 0.1)], 0.035, chrome, sides=6
        ),
        cylinders([0.42, -0.38, 1.06], [0.42, 0.38, 1.06], 0.025, dark, sides=6),
        blobs([0.58, 0, 0.92], [0.12, 0.12, 0.12], material("motorcycle", (0.95, 0.95, 0.88), 0.5)),
        boxes([-1.06, -0.08, 0.6], [-1.0, 0.08, 0.7], material("motorcycle", (0.75, 0.05, 0.05), 0.6)),
    ]
    if ridden:
        parts.append(_rider(rng, hip=(-0.25, 0.9), hand=(0.38, 1.08), foot_z=0.4, helmet=True))
    return merge(parts)


def bicycle(rng: np.random.Generator, ridden: bool) -> Mesh:
    """Bicycle, 1.75 m long, with its rider if ``ridden``."""
    paint = material("bicycle", _pick(rng, _LORRY_PAINTS), 0.3)
    dark = material("bicycle", _RUBBER, 0.08)
    turn = 2 * np.pi * np.arange(12) / 12
    ring = 0.33 * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    rims = np.concatenate([ring + [x, 0, 0.345] for x in (-0.54, 0.54)])
    ends = np.concatenate([np.roll(ring, -1, axis=0) + [x, 0, 0.345] for x in (-0.54, 0.54)])
    rear, crank, seat, head, front = (
        np.array([x, 0.0, z]) for x, z in ((-0.54, 0.345), (-0.08, 0.3), (-0.24, 0.82), (0.34, 0.82), (0.54, 0.345))
    )
    starts = np.array([rear, rear, crank, crank, seat, head])
    stops = np.array([crank, seat, seat, head, head, front])
    parts = [
        cylinders(rims, ends, 0.022, dark, sides=5),
        cylinders(starts, stops, 0.022, paint, sides=5),
        cylinders(head, head + [-0.04, 0, 0.2], 0.018, dark, sides=5),
        cylinders(head + [-0.04, -0.28, 0.2], head + [-0.04, 0.28, 0.2], 0.018, dark, sides=5),
        boxes([-0.38, -0.08, 0.86], [-0.12, 0.08, 0.92], dark),
    ]
    if ridden:
        parts.append(_rider(rng, hip=(-0.24, 0.97), hand=(0.3, 1.03), foot_z=0.2, helmet=bool(rng.random() < 0.5)))
    return merge(parts)


def _rider(
    rng: np.random.Generator, hip: tuple[float, float], hand: tuple[float, float], foot_z: float, helmet: bool
) -> Mesh:
    """Somebody who sits at ``hip`` and holds on at ``hand``, (x, z) each."""
    coat = material("rider", _pick(rng, _LORRY_PAINTS), 0.25)
    trousers = material("rider", (0.16, 0.18, 0.28), 0.15)
    skin = material("rider", (0.78, 0.58, 0.46), 0.3)
    cap = material("rider", _pick(rng, _LORRY_PAINTS) if helmet else (0.16, 0.11, 0.07), 0.3)
    hips, knees, feet, shoulders, hands = (
        np.array([[x, -y, z], [x, y, z]])
        for x, y, z in (
            (hip[0], 0.1, hip[1]),
            (hip[0] + 0.38, 0.17, 0.5 * (hip[1] + foot_z) + 0.12),
            (hip[0] + 0.2, 0.15, foot_z),
            (hip[0] + 0.2, 0.2, hip[1] + 0.5),
            (hand[0], 0.28, hand[1]),
        )
    )
    neck = np.array([hip[0] + 0.24, 0.0, hip[1] + 0.55])
    return merge(
        [
            cylinders(hips, knees, 0.09, trousers, end_radius_m=0.07, sides=6),
            cylinders(knees, feet, 0.07, trousers, end_radius_m=0.05, sides=6),
            blobs(feet + [0.05, 0, 0], np.tile([0.13, 0.05, 0.05], (2, 1)), trousers, smoothness=0),
            cylinders([hip[0], 0, hip[1] - 0.05], neck, 0.17, coat, end_radius_m=0.19, sides=8),
            cylinders(shoulders, hands, 0.065, coat, end_radius_m=0.045, sides=6),
            blobs(neck + [0.05, 0, 0.14], [0.1, 0.085, 0.125], skin),
            blobs(neck + [0.02, 0, 0.18], [0.13, 0.115, 0.125], cap),
        ]
    )


def construction_worker(rng: np.random.Generator) -> Mesh:
    """Pedestrian with a high-visibility waistcoat and a helmet."""
    person = pedestrian(rng)
    scale = float(person.bounds()[1][2]) / 1.78
    vest = material("person", (0.95, 0.42, 0.05), 0.8)
    band = material("person", (0.90, 0.90, 0.85), 0.95)
    parts = [
        loft((-0.125, 0.125, -0.19, 0.19), (-0.135, 0.135, -0.245, 0.245), 0.85, 1.4, vest),
        boxes([-0.14, -0.235, 1.05], [0.14, 0.235, 1.12], band),
        blobs([0.0, 0, 1.7], [0.14, 0.125, 0.11], material("person", (0.95, 0.85, 0.15), 0.4)),
    ]
    return merge([person, merge(parts).turned(np.eye(3) * scale)])


def child(rng: np.random.Generator) -> Mesh:
    """Small pedestrian, 1.1 to 1.35 m tall."""
    return pedestrian(rng).turned(np.eye(3) * 0.71)


def traffic_cone(rng: np.random.Generator) -> Mesh:
    """Orange cone with two white bands, 0.65 to 0.85 m tall."""
    height = rng.uniform(0.65, 0.85)
    orange = Material(NO_CLASS, (0.95, 0.35, 0.06), 0.4)
    white = Material(NO_CLASS, (0.95, 0.95, 0.92), 0.95)

    def radius_m(z: float) -> float:
        return 0.15 - 0.12 * z / height

    parts = [
        boxes([-0.2, -0.2, 0.0], [0.2, 0.2, 0.04], Material(NO_CLASS, (0.12, 0.12, 0.12), 0.1)),
        cylinders([0, 0, 0.04], [0, 0, height], radius_m(0), orange, end_radius_m=radius_m(height)),
    ]
    for low, high in ((0.4, 0.55), (0.7, 0.82)):
        z_low, z_high = low * height, high * height
        far_m = radius_m(z_high) + 0.008
        parts.append(cylinders([0, 0, z_low], [0, 0, z_high], radius_m(z_low) + 0.008, white, end_radius_m=far_m))
    return merge(parts)


def barrier(rng: np.random.Generator) -> Mesh:
    """Water-filled plastic barrier, 2 m along y, 1 m tall, alternately red or white."""
    colour = ((0.86, 0.30, 0.10), (0.90, 0.90, 0.88))[int(rng.integers(2))]
    plastic = material("fence", colour, 0.45)
    dark = material("fence", (0.25, 0.25, 0.26), 0.2)
    return merge(
        [
            loft((-0.3, 0.3, -0.98, 0.98), (-0.12, 0.12, -0.98, 0.98), 0.0, 0.45, plastic),
            loft((-0.12, 0.12, -0.98, 0.98), (-0.09, 0.09, -0.95, 0.95), 0.45, 1.0, plastic),
            boxes([-0.125, -0.8, 0.62], [0.125, 0.8, 0.72], material("fence", (0.95, 0.95, 0.92), 0.9)),
            boxes([-0.02, 0.98, 0.2], [0.02, 1.0, 0.9], dark),
        ]
    )


def _wheels(class_name: str, axles_x: ArrayLike, side: float, radius_m: float) -> list[Mesh]:
    """A pair of wheels with hubs on each axle."""
    hubs: NDArray[np.float64] = np.array([[x, y, radius_m] for x in np.atleast_1d(axles_x) for y in (-side, side)])
    outward = np.sign(hubs) * [0.0, 1.0, 0.0]
    return [
        cylinders(hubs - 0.3 * outward, hubs + 0.015 * outward, radius_m, material(class_name, _RUBBER, 0.06)),
        cylinders(hubs, hubs + 0.03 * outward, 0.5 * radius_m, material(class_name, _CHROME, 0.4), sides=6),
    ]


def _tail_lamps(class_name: str, rear: float, side: float, z: float) -> list[Mesh]:
    lamp, plate = material(class_name, (0.75, 0.05, 0.05), 0.6), material(class_name, (0.92, 0.92, 0.85), 0.9)
    places = (-0.8 * side, 0.8 * side)
    return [
        boxes([[rear - 0.02, y - 0.12, z] for y in places], [[rear + 0.1, y + 0.12, z + 0.16] for y in places], lamp),
        boxes([rear - 0.03, -0.26, z], [rear + 0.1, 0.26, z + 0.12], plate),
    ]


def _pick(rng: np.random.Generator, choices: tuple[Colour, ...]) -> Colour:
    return choices[int(rng.integers(len(choices)))]
