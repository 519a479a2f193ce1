# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What stands still in a town and has no annotation: ground, paint, buildings, gardens, trees, street furniture."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pred.data.world import objects
from pred.data.world.meshes import Mesh, blobs, boxes, merge, prism, quads
from pred.data.world.population import CORNER_LOT_M, Plan
from pred.data.world.town import (
    EXTENT_M,
    FAR_M,
    KERB_Z_M,
    LANE_M,
    PARKING_M,
    SIDEWALK_M,
    TERRAIN_Z_M,
    CarPark,
    Layout,
    Node,
    Stretch,
    lane_range,
    stop_line,
    zebra,
)
from pred.random import numpy_generator

BUILT_M = 120.0
"""Blocks and furniture stand within that distance of the ego car's way; what is farther away cannot be seen."""
_PAINT_Z_M = 0.005
_CAR_PARK_Z_M = TERRAIN_Z_M + 0.015
_FACING_ROAD = np.pi / 2
"""Turn, from the heading of the traffic, of what stands on its right and faces the road."""


def build(plan: Plan, seed: int, index: int) -> Mesh:
    """The still town of scene ``index``. Each stretch has a generator of its own."""
    meshes = [*_ground(plan.layout), *_site_ground(plan, numpy_generator(seed, "drive", index, "site"))]
    for park in plan.car_parks:
        meshes += _car_park_ground(park)
    for stretch in plan.layout.stretches():
        meshes += _paint(plan.layout, stretch)
        if plan.has_frontage(stretch, BUILT_M):
            rng = numpy_generator(seed, "drive", index, "stretch", *stretch.a, *stretch.b)
            meshes += _lots(rng, plan, stretch)
            meshes += _furniture(rng, plan, stretch)
    rng = numpy_generator(seed, "drive", index, "green")
    meshes += _street_ends(rng, plan)
    meshes += _green(rng, plan)
    meshes.append(objects.woods(rng, 260.0, 330.0, 90).moved(EXTENT_M / 2, EXTENT_M / 2))
    return merge(meshes)


def _ground(layout: Layout) -> Iterator[Mesh]:
    """Road everywhere; on it the raised blocks, and on those the terrain. No two surfaces coincide."""
    far = FAR_M + 1
    yield boxes([-far, -far, -1.0], [EXTENT_M + far, EXTENT_M + far, 0.0], objects.ASPHALT)
    for block in layout.blocks():
        yield prism(block.outline, -0.5, KERB_Z_M, objects.PAVING)
        if (block.high - block.low).min() > 1.0:
            yield boxes([*block.low, -0.5], [*block.high, TERRAIN_Z_M], objects.GRASS)


def _paint(layout: Layout, stretch: Stretch) -> Iterator[Mesh]:
    """Centre and lane lines, stop lines, zebra stripes and the marks of parking places."""
    low, high = lane_range(stretch)
    edge = stretch.lanes * LANE_M
    if stretch.a < stretch.b:
        dashes = np.arange(low + 0.5, high - 3.5, 6.5)
        yield _marks(stretch, dashes, np.zeros_like(dashes), 3.2, 0.14)
    for lane in range(1, stretch.lanes):
        dashes = np.arange(low + 2.0, high - 2.0, 5.0)
        yield _marks(stretch, dashes, np.full_like(dashes, lane * LANE_M), 1.8, 0.12)
    bars = np.arange(low, high, 6.0)
    yield _marks(stretch, bars, np.full_like(bars, edge + 0.5 * PARKING_M), 0.12, PARKING_M - 0.3)
    if layout.is_junction(stretch.b):
        begin, end = stop_line(stretch)
        yield _marks(stretch, [0.5 * (begin + end)], [0.5 * edge], end - begin, edge - 0.2)
        begin, end = zebra(stretch)
        stripes = np.arange(-stretch.half_m + 0.5, stretch.half_m - 0.3, 1.0)
        yield _marks(stretch, np.full_like(stripes, 0.5 * (begin + end)), stripes, end - begin, 0.5)


def _marks(stretch: Stretch, along: ArrayLike, right: ArrayLike, length_m: float, width_m: float) -> Mesh:
    """Rectangles of road paint around the places given."""
    half_along, half_right = np.array([-1, 1, 1, -1]) * length_m / 2, np.array([1, 1, -1, -1]) * width_m / 2
    along, right = np.asarray(along, dtype=np.float64), np.asarray(right, dtype=np.float64)
    corners = stretch.place(along[:, None] + half_along, right[:, None] + half_right)
    return quads(np.concatenate([corners, np.full((*corners.shape[:2], 1), _PAINT_Z_M)], axis=2), objects.PAINT)


def _car_park_ground(park: CarPark) -> Iterator[Mesh]:
    near, far = park.right
    yield prism(park.stretch.rectangle(park.along, park.right), 0.0, _CAR_PARK_Z_M, objects.ASPHALT)
    driveway = park.stretch.rectangle(park.driveway_along, (park.stretch.half_m, near))
    yield prism(driveway, 0.0, KERB_Z_M + 0.01, objects.ASPHALT)
    bars = np.arange(park.along[0] + 0.25, park.along[1], 2.7)
    for right in (near + 3.0, far - 3.0):
        marks = _marks(park.stretch, bars, np.full_like(bars, right), 0.1, 4.8)
        yield marks.moved(z=_CAR_PARK_Z_M)


def _site_ground(plan: Plan, rng: np.random.Generator) -> Iterator[Mesh]:
    """Bare earth with heaps."""
    earth = objects.material("terrain", (0.48, 0.37, 0.26), 0.2)
    right = plan.first.half_m + SIDEWALK_M + 0.3
    yield prism(plan.first.rectangle(plan.site, (right, right + 13.0)), 0.0, TERRAIN_Z_M + 0.012, earth)
    for along in rng.uniform(plan.site[0] + 2.0, plan.site[1] - 2.0, 2):
        x, y = plan.first.place(along, right + 10.5)
        size = [*rng.uniform(1.6, 2.4, 2), rng.uniform(1.2, 2.0)]
        yield blobs([x, y, TERRAIN_Z_M], size, earth, rng, roughness=0.05)


def _put(mesh: Mesh, stretch: Stretch, along: float, right: float, z: float, turn_rad: float = 0.0) -> Mesh:
    x, y = stretch.place(along, right)
    return mesh.moved(float(x), float(y), z, stretch.yaw_rad + turn_rad)


def _lots(rng: np.random.Generator, plan: Plan, stretch: Stretch) -> Iterator[Mesh]:
    """Apartment blocks, houses with front gardens and small parks in a row on the right of a stretch."""
    low = stretch.kerb_a_m + SIDEWALK_M + _corner_m(plan.layout, stretch, stretch.a)
    high = stretch.kerb_b_m - SIDEWALK_M - _corner_m(plan.layout, stretch, stretch.b)
    taken = [park.along for park in plan.car_parks if _same(park.stretch, stretch)]
    if _same(plan.first, stretch):
        taken.append(plan.site)
    urban = rng.uniform(0.5, 0.9)
    along = low
    while True:
        draw = rng.random()
        width_m = rng.uniform(13.0, 19.0) if draw < urban else rng.uniform(10.0, 14.0)
        for begin, end in taken:
            if along + width_m > begin - 1.0 and along < end + 1.0:
                # What is left before a car park or a building site is fenced.
                if begin - 1.0 - along > 3.0:
                    boundary = objects.fence(rng, begin - 1.5 - along)
                    yield _put(
                        boundary, stretch, 0.5 * (along + begin - 1.0), _front_m(stretch), TERRAIN_Z_M, _FACING_ROAD
                    )
                along = end + 1.0
        if along + width_m > high:
            break
        yield from _lot(rng, stretch, along + width_m / 2, width_m, draw, urban)
        along += width_m + rng.uniform(0.5, 2.5)
    if high - along > 3.0:
        yield _put(
            objects.hedge(rng, high - along),
            stretch,
            0.5 * (along + high),
            _front_m(stretch),
            TERRAIN_Z_M,
            _FACING_ROAD,
        )
        yield _put(objects.broadleaf(rng), stretch, 0.5 * (along + high), _front_m(stretch) + 4.0, TERRAIN_Z_M)


def _corner_m(layout: Layout, stretch: Stretch, node: Node) -> float:
    """Room before a corner: lots along y leave it to those along x, if there are any."""
    right = (node[0] + round(stretch.ahead[1]), node[1] - round(stretch.ahead[0]))
    return CORNER_LOT_M if abs(stretch.ahead[1]) > 0.5 and layout.has_road(node, right) else 1.0


def _front_m(stretch: Stretch) -> float:
    """``right`` of fences and house fronts."""
    return stretch.half_m + SIDEWALK_M + 0.5


def _same(a: Stretch, b: Stretch) -> bool:
    return (a.a, a.b) == (b.a, b.b)


def _lot(
    rng: np.random.Generator, stretch: Stretch, along: float, width_m: float, draw: float, urban: float
) -> Iterator[Mesh]:
    front_m = _front_m(stretch)
    if draw < urban:
        block = objects.apartment_block(rng, width_m - 0.5, rng.uniform(10.0, 13.0), (4, 9))
        yield _put(block, stretch, along, front_m + rng.uniform(0.0, 1.2), TERRAIN_Z_M, _FACING_ROAD)
        return
    boundary = (objects.hedge, objects.fence, objects.wall)[int(rng.integers(3))]
    yield _put(boundary(rng, width_m - 0.6), stretch, along, front_m, TERRAIN_Z_M, _FACING_ROAD)
    tree = objects.broadleaf if rng.random() < 0.6 else objects.conifer
    yield _put(tree(rng), stretch, along + rng.uniform(-0.3, 0.3) * width_m, front_m + 2.6, TERRAIN_Z_M)
    if draw < urban + 0.12:
        for offset, depth in ((-0.2, 5.0), (0.25, 8.0), (-0.1, 11.0)):
            kind = objects.broadleaf if rng.random() < 0.6 else objects.conifer
            yield _put(kind(rng), stretch, along + offset * width_m, front_m + depth, TERRAIN_Z_M)
    else:
        home = objects.house(rng, width_m - 2.0, rng.uniform(7.0, 9.0))
        yield _put(home, stretch, along, front_m + rng.uniform(4.0, 5.5), TERRAIN_Z_M, _FACING_ROAD)


def _furniture(rng: np.random.Generator, plan: Plan, stretch: Stretch) -> Iterator[Mesh]:
    """Lamps, trees, signs and traffic lights along the kerb on the right."""
    low, high = lane_range(stretch)
    kerb_m = stretch.half_m + 0.6
    clear = [park.driveway_along for park in plan.car_parks if _same(park.stretch, stretch)]

    def free(places: NDArray[np.float64]) -> NDArray[np.float64]:
        for begin, end in clear:
            places = places[(places < begin - 1.0) | (places > end + 1.0)]
        return places

    lamp = objects.street_lamp()
    for along in free(np.arange(low + rng.uniform(0.0, 8.0), high, 26.0)):
        yield _put(lamp, stretch, along, kerb_m, KERB_Z_M, _FACING_ROAD)
    if rng.random() < 0.7:
        spacing_m = rng.uniform(9.0, 15.0)
        for along in free(np.arange(low + rng.uniform(3.0, spacing_m), high - 3.0, spacing_m)):
            tree = objects.broadleaf(rng).turned(np.eye(3) * rng.uniform(1.0, 1.5))
            yield _put(tree, stretch, along, kerb_m + 0.2, KERB_Z_M, rng.uniform(0, 6))
    for along in free(rng.uniform(low, high, 3)):
        yield _put(objects.traffic_sign(rng), stretch, along, kerb_m, KERB_Z_M, np.pi)
    if plan.layout.is_junction(stretch.b):
        yield _put(objects.traffic_light(rng), stretch, sum(stop_line(stretch)) / 2, kerb_m, KERB_Z_M, np.pi)
    else:
        yield _put(objects.traffic_sign(rng), stretch, high, kerb_m, KERB_Z_M, np.pi)


def _street_ends(rng: np.random.Generator, plan: Plan) -> Iterator[Mesh]:
    """Houses that look down the road at T-junctions and bends, where a fourth road is missing."""
    for i, j in plan.layout.nodes:
        for step_x, step_y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            if plan.layout.has_road((i, j), (i + step_x, j + step_y)):
                continue
            column, row = plan.layout.columns[i], plan.layout.rows[j]
            kerb_m, half_m = (column.half_m, row.half_m) if step_x else (row.half_m, column.half_m)
            away = np.array([step_x, step_y])
            x, y = plan.layout.centre((i, j)) + away * (kerb_m + SIDEWALK_M + rng.uniform(1.5, 4.0))
            block = objects.apartment_block(rng, 2 * half_m - 1.0, rng.uniform(9.0, 12.0), (3, 7))
            if plan.near(np.array([[x, y]]), BUILT_M)[0]:
                yield block.moved(x, y, TERRAIN_Z_M, float(np.arctan2(-step_y, -step_x)))


def _green(rng: np.random.Generator, plan: Plan) -> Iterator[Mesh]:
    """Trees in the yards and in the place of missing roads."""
    for block in plan.layout.blocks():
        margin_m = 18.0 if block.inner else 2.5
        low, high = np.maximum(block.low, -10.0) + margin_m, np.minimum(block.high, EXTENT_M + 10.0) - margin_m
        if (high - low).min() < 1.0 or not plan.near(0.5 * (low + high)[None], BUILT_M)[0]:
            continue
        count = min(int((high - low).prod() / 40.0) + 1, 24)
        depth = high - low
        if not block.inner and depth.min() > 25.0:
            continue  # gardens of the lots along the rim
        for x, y in low + rng.uniform(0, 1, (count, 2)) * depth:
            tree = (objects.broadleaf if rng.random() < 0.7 else objects.conifer)(rng)
            yield tree.turned(np.eye(3) * rng.uniform(1.0, 1.8)).moved(x, y, TERRAIN_Z_M)
