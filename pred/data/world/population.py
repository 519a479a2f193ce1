# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Who is in a town: parked vehicles, a building site, people, traffic, and the ego car among them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pred.data.world import actors, objects, vehicles
from pred.data.world.actors import Actor, make_actor
from pred.data.world.lanes import Route, draw_route, lane_section
from pred.data.world.meshes import Mesh
from pred.data.world.motion import Path, Profile, Stand, Travel
from pred.data.world.town import (
    KERB_Z_M,
    LANE_M,
    PARKING_M,
    SIDEWALK_M,
    TERRAIN_Z_M,
    CarPark,
    Layout,
    Stretch,
    lane_range,
    zebra,
)
from pred.data.world.traffic import Crossings, Driver, simulate

EGO_SIZE_M = (4.1, 1.75)
EGO_AXLES_M = (0.85, 3.25)
"""Behind the front bumper. The ego frame has its origin below the rear axle."""
PEOPLED_M = 100.0
"""Actors live within that distance of the ego car's way."""
SITE_M = 15.0
CORNER_LOT_M = 16.0
"""Depth of the lots; those of the crossing road take that much at either end of a stretch."""
DRAWBAR_GAP_M = 0.9

Builder = Callable[[np.random.Generator], Mesh]
_BUILDERS: dict[str, tuple[str, Builder]] = {
    "car": ("vehicle.car", objects.car),
    "truck": ("vehicle.truck", vehicles.truck),
    "bus": ("vehicle.bus.rigid", vehicles.bus),
    "trailer": ("vehicle.trailer", vehicles.trailer),
    "motorcycle": ("vehicle.motorcycle", lambda rng: vehicles.motorcycle(rng, ridden=False)),
    "bicycle": ("vehicle.bicycle", lambda rng: vehicles.bicycle(rng, ridden=False)),
    "motorcyclist": ("vehicle.motorcycle", lambda rng: vehicles.motorcycle(rng, ridden=True)),
    "cyclist": ("vehicle.bicycle", lambda rng: vehicles.bicycle(rng, ridden=True)),
    "adult": ("human.pedestrian.adult", objects.pedestrian),
    "child": ("human.pedestrian.child", vehicles.child),
    "worker": ("human.pedestrian.construction_worker", vehicles.construction_worker),
    "excavator": ("vehicle.construction", vehicles.excavator),
    "wheel_loader": ("vehicle.construction", vehicles.wheel_loader),
    "cone": ("movable_object.trafficcone", vehicles.traffic_cone),
    "barrier": ("movable_object.barrier", vehicles.barrier),
}
_TRAFFIC = (
    ("car", 0.68),
    ("truck", 0.08),
    ("road train", 0.04),
    ("bus", 0.05),
    ("motorcyclist", 0.07),
    ("cyclist", 0.08),
)
_PARKED = (("car", 0.84), ("truck", 0.05), ("trailer", 0.02), ("motorcycle", 0.05), ("bicycle", 0.04))

Unit = list[Actor]


@dataclass(frozen=True)
class Plan:
    """What is decided before anything is built.

    Attributes:
        layout: where the roads run.
        route: the ego car's.
        front_m: of the ego car on the route at the start.
        first: the stretch on which the ego car starts.
        site: ``along`` of the building site on the right of ``first``.
        car_parks: on other stretches near the route.
        near: whether points [n, 2] are within a distance of what the ego car drives along.
    """

    layout: Layout
    route: Route
    front_m: float
    first: Stretch
    site: tuple[float, float]
    car_parks: tuple[CarPark, ...]
    near: Callable[[NDArray[np.float64], float], NDArray[np.bool_]]

    def has_frontage(self, stretch: Stretch, distance_m: float) -> bool:
        """Whether any part of a stretch is within ``distance_m`` of the way."""
        along = np.linspace(stretch.kerb_a_m, stretch.kerb_b_m, 9)
        return bool(self.near(stretch.place(along, np.zeros(9)), distance_m).any())


def draw_plan(rng: np.random.Generator, layout: Layout, duration_s: float) -> Plan:
    """Route of the ego car, building site and car parks."""
    starts = [stretch for stretch in layout.stretches() if layout.is_junction(stretch.b)]
    first = starts[int(rng.integers(len(starts)))]
    lane = int(rng.integers(first.lanes))
    # The route reaches beyond what the ego car can see along its way; most of it is never driven.
    route = draw_route(layout, rng, (first.a, first.b, lane), 12.0 * duration_s + 60.0, turn_within=1)
    lane_m = float(route.starts_m[1])
    front_m = max(lane_m - rng.uniform(36.0, 44.0), EGO_SIZE_M[0] + 1.0)
    driven = route.path.at(np.arange(0.0, front_m + 8.0 * duration_s + 10.0, 4.0))[:, :2]

    def near(points: NDArray[np.float64], distance_m: float) -> NDArray[np.bool_]:
        gaps = np.linalg.norm(points[:, None] - driven[None], axis=2)
        return np.asarray(gaps.min(axis=1) < distance_m)

    middle = 0.5 * (first.kerb_a_m + first.kerb_b_m)
    plan = Plan(layout, route, front_m, first, (middle - SITE_M / 2, middle + SITE_M / 2), (), near)
    others = [stretch for stretch in layout.stretches() if stretch.a != first.a or stretch.b != first.b]
    others = [stretch for stretch in others if plan.has_frontage(stretch, 40.0)]
    chosen = rng.permutation(len(others))[:2]
    return Plan(layout, route, front_m, first, plan.site, tuple(_car_park(others[int(k)]) for k in chosen), near)


def _car_park(stretch: Stretch) -> CarPark:
    low = stretch.kerb_a_m + SIDEWALK_M + CORNER_LOT_M + 1.0
    high = stretch.kerb_b_m - SIDEWALK_M - CORNER_LOT_M - 1.0
    middle = 0.5 * (low + high)
    half = min(0.5 * (high - low), 18.0)
    near_m = stretch.half_m + SIDEWALK_M
    return CarPark(stretch, (middle - half, middle + half), (near_m, near_m + 18.5), (middle - 3.0, middle + 3.0))


def populate(
    rng: np.random.Generator, plan: Plan, start_us: int, duration_s: float
) -> tuple[tuple[Actor, ...], Travel]:
    """All actors, and the ego car's motion, from ``start_us`` on."""
    stretches = [stretch for stretch in plan.layout.stretches() if plan.has_frontage(stretch, PEOPLED_M)]
    units = [*_site(rng, plan)]
    for stretch in stretches:
        units += _parked(rng, plan, stretch)
    for park in plan.car_parks:
        units += _in_car_park(rng, park)
    walkers: list[Unit] = []
    crossings: Crossings = {}
    for stretch in stretches:
        standing, walking = _pavement_life(rng, stretch, start_us, duration_s)
        units += standing
        walkers += walking
        if plan.layout.is_junction(stretch.b):
            walkers += _crossing_people(rng, plan, stretch, start_us, duration_s, crossings)
    drivers, trains = _draw_traffic(rng, plan, stretches, duration_s)
    ego_driver = Driver(plan.route, EGO_SIZE_M[0], plan.front_m, rng.uniform(9.0, 11.5), rng.uniform(0.5, 1.5), True)
    profiles = simulate([ego_driver, *drivers], plan.layout, crossings, start_us, duration_s)
    ego = Travel(plan.route.path, profiles[0], *EGO_AXLES_M)
    for driver, train, profile in zip(drivers, trains, profiles[1:], strict=True):
        units.append([*_train(driver, train, profile)])
    units += walkers
    times_us = start_us + np.arange(0, int(1e6 * duration_s) + 1, 100_000)
    return actors.without_overlaps(units, ego, EGO_SIZE_M, times_us), ego


def _standing(
    rng: np.random.Generator, kind: str, stretch: Stretch, along: float, right: float, turn_rad: float, z: float = 0.0
) -> Unit:
    """One actor beside a stretch; ``turn_rad`` counts from the heading of its traffic."""
    category, build = _BUILDERS[kind]
    x, y = stretch.place(along, right)
    motion = Stand((float(x), float(y), z, stretch.yaw_rad + turn_rad))
    return [make_actor(category, build(rng), motion, _still_states(kind))]


def _still_states(kind: str) -> tuple[str, str]:
    if kind in ("cone", "barrier"):
        return actors.NO_STATES
    if kind in ("adult", "child", "worker"):
        return actors.PEDESTRIAN_STATES
    return actors.RIDERLESS_STATES if kind in ("motorcycle", "bicycle") else actors.PARKED_STATES


def _site(rng: np.random.Generator, plan: Plan) -> Iterator[Unit]:
    """Building site: barriers and cones in the parking strip, machines and workers behind the walkway."""
    stretch, (low, high) = plan.first, plan.site
    edge = stretch.lanes * LANE_M
    for along in np.arange(low + 1.6, high - 1.0, 2.2):
        yield _standing(rng, "barrier", stretch, along, edge + 0.5, np.pi / 2 + rng.normal(0, 0.03))
    for step in range(4):
        for along in (low - 0.2 - 1.1 * step, high + 0.2 + 1.1 * step):
            yield _standing(rng, "cone", stretch, along, edge + 0.5 + 0.55 * step, rng.uniform(0, 6))
    ground = stretch.half_m + SIDEWALK_M
    machines = ("excavator", "wheel_loader") if rng.random() < 0.5 else ("wheel_loader", "excavator")
    for machine, along in zip(machines, (low + 3.5, high - 3.5), strict=True):
        heading = rng.uniform(0, 2 * np.pi) if machine == "excavator" else rng.normal(0, 0.3)
        yield _standing(rng, machine, stretch, along, ground + rng.uniform(3.8, 5.0), heading, TERRAIN_Z_M)
    for along in rng.uniform(low + 1.0, high - 1.0, 3):
        right = edge + 1.8 if rng.random() < 0.6 else ground + 0.8
        yield _standing(rng, "worker", stretch, along, right, rng.uniform(0, 6), 0.0 if right < ground else TERRAIN_Z_M)


def _parked(rng: np.random.Generator, plan: Plan, stretch: Stretch) -> Iterator[Unit]:
    """Vehicles along the kerb; on the stretch where the drive starts one of each kind."""
    low, high = lane_range(stretch)
    spans = [(low + 1.0, high - 1.0)]
    wanted: list[str] = []
    ends = (plan.first.a, plan.first.b)
    if (stretch.a, stretch.b) == ends:
        spans = [(low + 1.0, plan.site[0] - 4.5), (plan.site[1] + 4.5, high - 1.0)]
        wanted = ["bus"]
    elif (stretch.b, stretch.a) == ends:
        wanted = ["truck", "trailer", "motorcycle", "bicycle", "car"]
    busy = rng.uniform(0.35, 0.75)
    for start, end in spans:
        cursor = start + rng.uniform(0.0, 0.8)
        queue = [wanted[int(k)] for k in rng.permutation(len(wanted))]
        needed = {"bus": 12.5, "truck": 9.5, "trailer": 9.0, "car": 5.8}
        while end - cursor > 2.5:
            spare = end - cursor - sum(needed.get(kind, 3.2) for kind in queue)
            if spare > 6.5 and rng.random() > busy:
                cursor += rng.uniform(2.0, 5.8)
                continue
            kind = queue.pop() if queue and (spare < 10.0 or rng.random() < 0.4) else _draw(rng, _PARKED)
            right = stretch.lanes * LANE_M + PARKING_M / 2 + rng.normal(0, 0.06)
            (actor,) = _standing(rng, kind, stretch, 0.0, 0.0, rng.normal(0, 0.02))
            length_m = actor.size_lwh_m[0]
            if cursor + length_m > end:
                break
            x, y = stretch.place(cursor + length_m / 2, right)
            motion = Stand((float(x), float(y), 0.0, stretch.yaw_rad + rng.normal(0, 0.02)))
            yield [make_actor(actor.category, actor.mesh.moved(z=actor.lift_m), motion, actor.states)]
            if kind in wanted:
                wanted.remove(kind)
            cursor += length_m + rng.uniform(0.7, 1.5)


def _in_car_park(rng: np.random.Generator, park: CarPark) -> Iterator[Unit]:
    """Cars in two rows, nose to the aisle or to the end."""
    places = np.arange(park.along[0] + 1.6, park.along[1] - 1.5, 2.7)
    for right, is_near in ((park.right[0] + 3.0, True), (park.right[1] - 3.0, False)):
        for along in places:
            in_driveway = is_near and park.driveway_along[0] - 1.4 < along < park.driveway_along[1] + 1.4
            if not in_driveway and rng.random() < 0.45:
                turn = np.pi / 2 * (1 if rng.random() < 0.5 else -1) + rng.normal(0, 0.03)
                yield _standing(rng, "car", park.stretch, along, right, turn, TERRAIN_Z_M + 0.015)


def _pavement_life(
    rng: np.random.Generator, stretch: Stretch, start_us: int, duration_s: float
) -> tuple[list[Unit], list[Unit]]:
    """People who stand, and people who walk, on the right of a stretch."""
    low, high = stretch.kerb_a_m + 5.0, stretch.kerb_b_m - 5.0
    standing = []
    for along in rng.uniform(low, high, int(rng.integers(0, 3))):
        for step in range(int(rng.integers(1, 3))):
            turn = rng.uniform(0, 2 * np.pi)
            right = stretch.half_m + 2.75
            standing.append(_standing(rng, "adult", stretch, along + 0.8 * step, right, turn, KERB_Z_M))
    walking = []
    for along in rng.uniform(low, high, int(rng.integers(2, 6))):
        onward = bool(rng.random() < 0.5)
        right = stretch.half_m + (1.45 if onward else 2.15) + rng.uniform(-0.1, 0.1)
        ends = [along, high + 3.0] if onward else [along, low - 3.0]
        flat = stretch.place(ends, [right, right])
        path = Path(np.column_stack([flat, [KERB_Z_M] * 2]))
        kind = "child" if rng.random() < 0.15 else "adult"
        walking.append([_walker(rng, kind, path, start_us, 0.0, rng.uniform(0.9, 1.6))])
    return standing, walking


def _walker(rng: np.random.Generator, kind: str, path: Path, start_us: int, begin_s: float, speed_mps: float) -> Actor:
    """Somebody who sets out at ``begin_s`` and stops at the end of the path."""
    category, build = _BUILDERS[kind]
    step_m = 0.4
    end_s = begin_s + max(path.length_m - step_m, 0.01) / speed_mps
    profile = Profile(
        start_us,
        np.array([0.0, max(begin_s, 1e-3), end_s + 2e-3]),
        np.array([step_m, step_m, path.length_m]),
        np.array([0.0, speed_mps, 0.0]),
        np.zeros(3),
    )
    return make_actor(category, build(rng), Travel(path, profile, 0.0, step_m), actors.PEDESTRIAN_STATES)


def _crossing_people(
    rng: np.random.Generator,
    plan: Plan,
    stretch: Stretch,
    start_us: int,
    duration_s: float,
    crossings: Crossings,
) -> Iterator[Unit]:
    """People on the zebra crossing before node b; notes in ``crossings`` when they are on the road."""
    ego_waits = (stretch.a, stretch.b) == (plan.first.a, plan.first.b)
    # Nobody crosses where the ego car leaves a junction, or it might wait there for most of the drive.
    leaving = {(lane.key[2], lane.key[1]) for lane in plan.route.sections[2:6:2]}
    if ego_waits and stretch.lanes > 1:
        return
    if not ego_waits and ((stretch.a, stretch.b) in leaving or rng.random() > 0.4):
        return
    begin_s = rng.uniform(0.0, 1.5) if ego_waits else rng.uniform(0.0, max(duration_s - 8.0, 1.0))
    along_low, along_high = zebra(stretch)
    for along in np.linspace(along_low + 0.6, along_high - 0.6, int(rng.integers(1, 4))):
        side = 1 if rng.random() < 0.5 else -1
        kerb, outside = stretch.half_m, stretch.half_m + 0.85
        across = side * np.array([outside, kerb + 0.1, kerb - 0.1, -kerb + 0.1, -kerb - 0.1, -outside])
        heights = [KERB_Z_M, KERB_Z_M, 0.0, 0.0, KERB_Z_M, KERB_Z_M]
        path = Path(np.column_stack([stretch.place(np.full(6, along), across), heights]))
        speed_mps, set_out_s = rng.uniform(1.3, 1.9), begin_s + rng.uniform(0.0, 1.0)
        yield [_walker(rng, "adult", path, start_us, set_out_s, speed_mps)]
        middle_s, end_s = (set_out_s + share * path.length_m / speed_mps for share in (0.5, 1.0))
        for is_right, span_s in ((side > 0, (set_out_s, middle_s + 0.5)), (side < 0, (middle_s - 0.5, end_s))):
            crossings.setdefault((stretch.a, stretch.b, is_right), []).append(span_s)


def _draw_traffic(
    rng: np.random.Generator, plan: Plan, stretches: Sequence[Stretch], duration_s: float
) -> tuple[list[Driver], list[list[tuple[str, Mesh, tuple[str, str]]]]]:
    """Drivers, and the parts of the vehicle of each: category, mesh, attributes."""
    drivers, trains = [], []
    ego_key = plan.route.sections[0].key
    for stretch in stretches:
        low, high = lane_range(stretch)
        for lane in range(stretch.lanes):
            front_m = high - low - rng.uniform(0.0, 14.0)
            while front_m > 14.0:
                kind = _draw(rng, _TRAFFIC)
                names = ("truck", "trailer") if kind == "road train" else (kind,)
                train = []
                for name in names:
                    category, build = _BUILDERS[name]
                    ridden = name in ("motorcyclist", "cyclist")
                    train.append((category, build(rng), actors.RIDDEN_STATES if ridden else actors.VEHICLE_STATES))
                length_m = sum(_length_m(mesh) for _, mesh, _ in train) + DRAWBAR_GAP_M * (len(train) - 1)
                desired = rng.uniform(4.0, 5.5) if kind == "cyclist" else rng.uniform(7.5, 12.0)
                is_ego_lane = lane_section(stretch, lane).key == ego_key
                free = not is_ego_lane or front_m < plan.front_m - 14.0
                start = (stretch.a, stretch.b, lane)
                route = draw_route(plan.layout, rng, start, front_m + 12.0 * duration_s + 30.0)
                if free and rng.random() < 0.42 and front_m > length_m:
                    drivers.append(Driver(route, length_m, front_m, desired))
                    trains.append(train)
                front_m -= length_m + rng.uniform(7.0, 16.0)
    return drivers, trains


def _train(driver: Driver, train: Sequence[tuple[str, Mesh, tuple[str, str]]], profile: Profile) -> Iterator[Actor]:
    behind_m = 0.0
    for category, mesh, states in train:
        length_m = _length_m(mesh)
        pivots = (behind_m + 0.2 * length_m, behind_m + 0.8 * length_m)
        yield make_actor(category, mesh, Travel(driver.route.path, profile, *pivots), states)
        behind_m += length_m + DRAWBAR_GAP_M


def _length_m(mesh: Mesh) -> float:
    low, high = mesh.bounds()
    return float(high[0] - low[0])


def _draw(rng: np.random.Generator, shares: Sequence[tuple[str, float]]) -> str:
    """One of the names, each with its share."""
    names, weights = zip(*shares, strict=True)
    return str(names[int(np.searchsorted(np.cumsum(weights) / sum(weights), rng.random(), side="right"))])
