# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Layout of a street: where the objects stand and where the ego car drives.

World frame of a street, metres: x along the street in driving direction, y to the left, z up; the road's surface is
z = 0. A side street crosses. Traffic keeps to the right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred.data.world import objects
from pred.data.world.meshes import Mesh, boxes, merge, quads
from pred.data.world.scene import Scene

HALF_LENGTH_M = 115.0
LANE_M = 3.6
KERB_Y_M = LANE_M + 2.5
"""A lane and a parking strip on either side of the centre line."""
SIDEWALK_M = 3.2
SIDE_STREET_HALF_M = 4.5
DRIVE_M = 60.0
"""Stretch of the street along which the ego car is seen."""
CLEARANCE_M = 8.0
"""No car in the ego lane comes nearer to the ego car."""


@dataclass(frozen=True)
class Street:
    """A street that can be ray cast.

    Attributes:
        scene: everything but the ego car.
        T_world_from_ego: the ego car's poses [4, 4] float64: on the road below the car, x ahead, y left, z up.
        sun: [3] float32, unit vector towards the sun.
    """

    scene: Scene
    T_world_from_ego: list[NDArray[np.float64]]
    sun: NDArray[np.float32]


def build_street(rng: np.random.Generator, num_poses: int) -> Street:
    """A street drawn from ``rng``, with ``num_poses`` ego poses along it."""
    poses_x = np.linspace(-DRIVE_M / 2, DRIVE_M / 2, num_poses) if num_poses > 1 else np.zeros(1)
    poses_x = poses_x + rng.uniform(-4.0, 4.0, num_poses)
    poses = [_pose(x, -LANE_M / 2 + rng.normal(0, 0.15), np.deg2rad(rng.normal(0, 2.5))) for x in poses_x]
    crossing_x = rng.uniform(-25.0, 35.0)
    meshes = [*_ground(crossing_x)]
    for side in (-1, 1):
        meshes += _lots(rng, crossing_x, side)
        meshes += _sidewalk_furniture(rng, crossing_x, side)
        meshes += _pavement_life(rng, side)
        meshes += _parked_cars(rng, crossing_x, side)
    meshes += _crossing(rng, crossing_x, poses_x)
    meshes += _traffic(rng, crossing_x, poses_x)
    meshes.append(objects.woods(rng, 140.0, 170.0, 50))
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(35, 60))
    sun = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return Street(Scene(merge(meshes)), poses, np.array(sun, dtype=np.float32))


def _pose(x: float, y: float, yaw_rad: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:2, 3] = x, y
    return pose


def _ground(crossing_x: float) -> Iterator[Mesh]:
    """Road everywhere; on it four raised blocks of sidewalk, and on those the terrain. No two surfaces coincide."""
    far = 220.0
    yield boxes([-far, -far, -1.0], [far, far, 0.0], objects.ASPHALT)
    for along in (-1, 1):
        for side in (-1, 1):
            for inset, height, material in ((0.0, 0.13, objects.PAVING), (SIDEWALK_M, 0.16, objects.GRASS)):
                x_near = crossing_x + along * (SIDE_STREET_HALF_M + inset)
                y_near = side * (KERB_Y_M + inset)
                x, y = sorted((x_near, along * (far - 1))), sorted((y_near, side * (far - 1)))
                yield boxes([x[0], y[0], -0.5], [x[1], y[1], height], material)
    dashes = _clear_of_crossing(np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, 7.0), crossing_x, 11.0)
    yield _painted(dashes, np.zeros_like(dashes), 3.0, 0.14)
    edges = _clear_of_crossing(np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, 5.8), crossing_x, 12.0)
    for side in (-1, 1):
        # Bars between the parking places.
        yield _painted(edges + 2.9, np.full_like(edges, side * (LANE_M + 1.3)), 0.12, 2.4)
    stripes = np.arange(-KERB_Y_M + 0.5, KERB_Y_M - 0.4, 0.95)
    for along in (-1, 1):
        middle = crossing_x + along * (SIDE_STREET_HALF_M + 2.0)
        yield _painted(np.full_like(stripes, middle), stripes, 2.6, 0.5)


def _painted(x: NDArray[np.float64], y: NDArray[np.float64], length_m: float, width_m: float) -> Mesh:
    """Rectangles of road paint centred at (x, y), 5 mm above the asphalt."""
    half_x, half_y = np.array([-1, 1, 1, -1]) * length_m / 2, np.array([-1, -1, 1, 1]) * width_m / 2
    corner_x, corner_y = x[:, None] + half_x, y[:, None] + half_y
    return quads(np.stack([corner_x, corner_y, np.full_like(corner_x, 0.005)], axis=2), objects.PAINT)


def _clear_of_crossing(x: NDArray[np.float64], crossing_x: float, gap_m: float) -> NDArray[np.float64]:
    return x[np.abs(x - crossing_x) > gap_m]


def _lots(rng: np.random.Generator, crossing_x: float, side: int) -> Iterator[Mesh]:
    """Apartment blocks, houses with front gardens, and small parks, in a row."""
    facing = -side * np.pi / 2
    fence_y = side * (KERB_Y_M + SIDEWALK_M + 0.4)
    urban = rng.uniform(0.15, 0.6)
    for along in (-1, 1):
        x = crossing_x + along * (SIDE_STREET_HALF_M + SIDEWALK_M + 1.0)
        while abs(x) < HALF_LENGTH_M:
            draw = rng.random()
            width_m = rng.uniform(13.0, 19.0) if draw < urban else rng.uniform(10.0, 14.0)
            middle = x + along * width_m / 2
            x += along * (width_m + rng.uniform(0.5, 3.0))
            if draw < urban:
                block = objects.apartment_block(rng, width_m - 0.5, rng.uniform(10.0, 13.0))
                yield block.moved(middle, fence_y + side * rng.uniform(0.2, 1.5), 0.16, facing)
                continue
            boundary = (objects.hedge, objects.fence, objects.wall)[rng.integers(3)]
            yield boundary(rng, width_m - 0.6).moved(middle, fence_y, 0.16, facing)
            garden_y = fence_y + side * 3.0
            tree = objects.broadleaf if rng.random() < 0.6 else objects.conifer
            yield tree(rng).moved(middle + rng.uniform(-0.35, 0.35) * width_m, garden_y, 0.16)
            if draw < urban + 0.3:
                yield objects.broadleaf(rng).moved(middle, garden_y + side * 6.0, 0.16)
                yield objects.conifer(rng).moved(middle + 4.0, garden_y + side * 9.0, 0.16)
            else:
                home = objects.house(rng, width_m - 2.0, rng.uniform(7.0, 9.0))
                yield home.moved(middle, garden_y + side * rng.uniform(2.5, 4.5), 0.16, facing)


def _sidewalk_furniture(rng: np.random.Generator, crossing_x: float, side: int) -> Iterator[Mesh]:
    """Lamps, trees and signs along the kerb."""
    kerb_y = side * (KERB_Y_M + 0.6)
    lamps = np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, 28.0) + rng.uniform(0, 28.0)
    lamp = objects.street_lamp()
    for x in _clear_of_crossing(lamps, crossing_x, 9.0):
        yield lamp.moved(x, kerb_y, 0.13, -side * np.pi / 2)
    if rng.random() < 0.6:
        spacing_m = rng.uniform(13.0, 20.0)
        trees = np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, spacing_m) + rng.uniform(0, spacing_m)
        for x in _clear_of_crossing(trees, crossing_x, 12.0):
            yield objects.broadleaf(rng).moved(x, kerb_y + side * 0.3, 0.13, rng.uniform(0, 6))
    for x in _clear_of_crossing(rng.uniform(-70.0, 80.0, 7), crossing_x, 9.0):
        # Signs face the drivers on their side of the road.
        yield objects.traffic_sign(rng).moved(x, kerb_y, 0.13, 0.0 if side > 0 else np.pi)


def _pavement_life(rng: np.random.Generator, side: int) -> Iterator[Mesh]:
    """Pedestrians on the sidewalk, some in pairs."""
    for x in rng.uniform(-70.0, 80.0, 10):
        y = side * (KERB_Y_M + rng.uniform(1.4, SIDEWALK_M - 0.4))
        heading = np.pi * rng.integers(2) + rng.normal(0, 0.2)
        yield objects.pedestrian(rng).moved(x, y, 0.13, heading)
        if rng.random() < 0.3:
            yield objects.pedestrian(rng).moved(x + 0.1, y - side * 0.7, 0.13, heading)


def _parked_cars(rng: np.random.Generator, crossing_x: float, side: int) -> Iterator[Mesh]:
    occupancy = rng.uniform(0.25, 0.6)
    places = np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, 5.8)
    for x in _clear_of_crossing(places, crossing_x, 14.0):
        if rng.random() < occupancy:
            y = side * (LANE_M + 1.4) + rng.normal(0, 0.08)
            heading = (0.0 if side < 0 else np.pi) + rng.normal(0, 0.03)
            yield objects.car(rng).moved(x + rng.normal(0, 0.2), y, 0.0, heading)


def _crossing(rng: np.random.Generator, crossing_x: float, poses_x: NDArray[np.float64]) -> Iterator[Mesh]:
    """Traffic lights, people on the zebra crossings and a car waiting in the side street."""
    near, kerb = SIDE_STREET_HALF_M + 0.6, KERB_Y_M + 0.6
    for x, y, facing in ((-near, -kerb, 2), (near, kerb, 0), (near, -kerb, 3), (-near, kerb, 1)):
        yield objects.traffic_light(rng).moved(crossing_x + x, y, 0.13, facing * np.pi / 2)
    for along in (-1, 1):
        x = crossing_x + along * (SIDE_STREET_HALF_M + 2.0) + rng.uniform(-0.8, 0.8)
        for y in rng.uniform(-KERB_Y_M, KERB_Y_M, 2):
            if np.abs(poses_x - x).min() > CLEARANCE_M or y > 0.5:
                heading = np.pi * (rng.integers(2) + 0.5)
                yield objects.pedestrian(rng).moved(x, y, 0.0, heading)
    for side in (-1, 1):
        y = side * (KERB_Y_M + rng.uniform(5.0, 7.0))
        yield objects.car(rng).moved(crossing_x - side * 2.2, y, 0.0, -side * np.pi / 2)


def _traffic(rng: np.random.Generator, crossing_x: float, poses_x: NDArray[np.float64]) -> Iterator[Mesh]:
    """Cars standing in both lanes."""
    for lane, heading in ((-1, 0.0), (1, np.pi)):
        places = np.arange(-90.0, 110.0, 11.0) + rng.uniform(-2.0, 2.0, 19)
        for x in _clear_of_crossing(places, crossing_x, 10.0):
            free = lane > 0 or np.abs(poses_x - x).min() > CLEARANCE_M
            if free and rng.random() < 0.3:
                y = lane * LANE_M / 2 + rng.normal(0, 0.12)
                yield objects.car(rng).moved(x, y, 0.0, heading + rng.normal(0, 0.02))
