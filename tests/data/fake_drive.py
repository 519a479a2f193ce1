# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A drive without a ray tracer: boxes on a plane around a slow car, with known points, pixels and velocities."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import invert_rigid, transform_points
from pred.data.world.nuscenes_writer import CATEGORIES
from pred.data.world.sensors import T_EGO_FROM_LIDAR, mounted_camera
from pred.random import numpy_generator

START_US = 1_600_000_000_000_000
KEYFRAME_PERIOD_US, SWEEP_PERIOD_US = 500_000, 50_000
EGO_SPEED, EGO_YAW = 3.0, 0.3
POINTS_PER_ACTOR = 30
NUM_GROUND, NUM_NO_RETURN = 500, 40
CLASS_IDS = {"vehicle": 13, "human": 11, "movable_object": 255}
HIDDEN, LATE_AND_GAPPED, BEHIND_TRUCK = 11, 12, 13

# Category, length, width, height, speed along the heading, attribute. All ten detection classes.
ACTORS = (
    ("vehicle.car", 4.5, 1.9, 1.6, 5.0, "vehicle.moving"),
    ("vehicle.truck", 8.0, 2.5, 3.2, 0.0, "vehicle.parked"),
    ("vehicle.bus.rigid", 11.0, 2.9, 3.4, 0.0, "vehicle.stopped"),
    ("vehicle.trailer", 10.0, 2.7, 3.6, 0.0, "vehicle.parked"),
    ("vehicle.construction", 6.0, 2.7, 3.0, 0.0, "vehicle.parked"),
    ("human.pedestrian.adult", 0.7, 0.7, 1.75, 1.2, "pedestrian.moving"),
    ("vehicle.motorcycle", 2.1, 0.8, 1.4, 4.0, "cycle.with_rider"),
    ("vehicle.bicycle", 1.7, 0.6, 1.3, 0.0, "cycle.without_rider"),
    ("movable_object.trafficcone", 0.4, 0.4, 0.8, 0.0, ""),
    ("movable_object.barrier", 0.5, 2.4, 1.0, 0.0, ""),
)


@dataclass(frozen=True)
class FakeActor:
    instance: int
    category: str
    size_lwh_m: tuple[float, float, float]
    place_m: tuple[float, float]
    yaw_rad: float
    speed: float
    name: str
    start_us: int

    def pose(self, time_us: int) -> NDArray[np.float64]:
        pose = _yaw_pose(self.yaw_rad, *self.place_m)
        pose[:3, 3] += self.velocity(time_us) * (time_us - self.start_us) * 1e-6
        pose[2, 3] = self.size_lwh_m[2] / 2
        return pose

    def velocity(self, time_us: int) -> NDArray[np.float64]:
        return self.speed * np.array([np.cos(self.yaw_rad), np.sin(self.yaw_rad), 0.0])

    def attribute(self, time_us: int) -> str:
        return self.name


class FakeSweep(NamedTuple):
    points: NDArray[np.float32]
    class_id: NDArray[np.uint8]
    category: NDArray[np.uint8]
    instance: NDArray[np.int32]


class FakeView(NamedTuple):
    image: NDArray[np.uint8]
    class_id: NDArray[np.uint8]
    instance: NDArray[np.int32]
    depth_m: NDArray[np.float32]


def _town() -> dict[str, list[NDArray[np.float64]]]:
    def rectangle(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    return {
        "drivable_area": [rectangle(-60, -60, 60, 60), rectangle(60, -10, 120, 10)],
        "road_segment": [rectangle(-10, -10, 10, 10), rectangle(60, -10, 120, 10)],
        "road_block": [rectangle(60, -10, 120, 0)],
        "lane": [rectangle(60, -10, 120, -5), rectangle(60, -5, 120, 0)],
        "ped_crossing": [rectangle(60, -10, 64, 10)],
        "walkway": [rectangle(60, 10, 120, 14)],
        "stop_line": [rectangle(65, -10, 66, 0)],
        "carpark_area": [rectangle(-60, -60, -40, -40)],
    }


@dataclass
class FakeTown:
    polygons: dict[str, list[NDArray[np.float64]]] = field(default_factory=_town)
    lines: dict[str, list[NDArray[np.float64]]] = field(
        default_factory=lambda: {
            "road_divider": [np.array([[60.0, 0.0], [120.0, 0.0]])],
            "lane_divider": [np.array([[60.0, -5.0], [90.0, -5.0], [120.0, -5.0]])],
        }
    )
    intersections: list[NDArray[np.float64]] = field(default_factory=lambda: _town()["road_segment"][:1])


class FakeDrive:
    """The API of `pred.data.world.drive.Drive`."""

    def __init__(self, seed: int, index: int, keyframes: int = 40) -> None:
        self.seed, self.index = seed, index
        self.start_us = START_US + index * 100_000_000
        self.keyframe_us = self.start_us + KEYFRAME_PERIOD_US * np.arange(keyframes, dtype=np.int64)
        self.town = FakeTown()
        self.camera_offsets_us = {
            "CAM_FRONT_LEFT": -43_000,
            "CAM_FRONT": -35_000,
            "CAM_FRONT_RIGHT": -28_000,
            "CAM_BACK_RIGHT": -20_000,
            "CAM_BACK": -10_000,
            "CAM_BACK_LEFT": -1_000,
        }
        rng = numpy_generator(seed, "fake", index)
        actors = []
        for number, (category, length, width, height, speed, name) in enumerate(ACTORS):
            angle, radius = 2 * np.pi * number / len(ACTORS), float(rng.uniform(15, 18))
            place = (radius * float(np.cos(angle)), radius * float(np.sin(angle)))
            # Moving ones drive outwards, so that nothing meets.
            actors.append(self._actor(number + 1, category, (length, width, height), place, angle, speed, name))
        actors.append(self._actor(HIDDEN, "vehicle.car", (4.0, 1.8, 1.5), (-40.0, 0.0), 0.0, 0.0, "vehicle.parked"))
        actors.append(self._actor(LATE_AND_GAPPED, "animal", (0.8, 0.4, 0.5), (0.0, 8.0), 1.0, 0.0, ""))
        truck = actors[1].place_m
        actors.append(
            self._actor(
                BEHIND_TRUCK, "vehicle.car", (4.0, 1.8, 1.5), (truck[0] * 2, truck[1] * 2), 0.0, 0.0, "vehicle.parked"
            )
        )
        self.actors = tuple(actors)

    def _actor(
        self,
        instance: int,
        category: str,
        size_lwh_m: tuple[float, float, float],
        place_m: tuple[float, float],
        yaw_rad: float,
        speed: float,
        name: str,
    ) -> FakeActor:
        return FakeActor(instance, category, size_lwh_m, place_m, yaw_rad, speed, name, self.start_us)

    def sweep_us(self, k: int) -> NDArray[np.int64]:
        first = -10 if k == 0 else -9
        return np.asarray(self.keyframe_us[k] + SWEEP_PERIOD_US * np.arange(first, 1))

    def T_world_from_ego(self, time_us: int) -> NDArray[np.float64]:  # noqa: N802
        travelled_m = EGO_SPEED * (time_us - self.start_us) * 1e-6
        return _yaw_pose(EGO_YAW, travelled_m * np.cos(EGO_YAW), travelled_m * np.sin(EGO_YAW))

    def num_points(self, actor: FakeActor, time_us: int) -> int:
        """Returns of an actor in the sweep that ends at a time."""
        seconds = (time_us - self.start_us) / 1e6
        if actor.instance == HIDDEN or (actor.instance == LATE_AND_GAPPED and seconds not in (0.5, 1.5)):
            return 0
        return POINTS_PER_ACTOR

    def scan(self, time_us: int) -> FakeSweep:
        rng = numpy_generator(self.seed, "scan", self.index, time_us)
        T_lidar_from_world = invert_rigid(self.T_world_from_ego(time_us) @ T_EGO_FROM_LIDAR)
        xyz, category, class_id, instance = [], [], [], []

        def add(points: NDArray[np.float64], index: int | NDArray[Any], train_id: int, number: int) -> None:
            xyz.append(points)
            category.append(np.broadcast_to(index, len(points)))
            class_id.append(np.full(len(points), train_id))
            instance.append(np.full(len(points), number))

        ground = rng.uniform(-30, 30, (NUM_GROUND, 3))
        ground[:, 2] = -T_EGO_FROM_LIDAR[2, 3] - 0.2
        ground[:, :2] += 2 * np.sign(ground[:, :2])
        add(ground, rng.integers(24, 31, NUM_GROUND), 0, 0)
        add(rng.normal(0, 0.01, (NUM_NO_RETURN, 3)), 0, 255, 0)
        for actor in self.actors:
            num_points = self.num_points(actor, time_us)
            points = rng.uniform(-0.45, 0.45, (num_points, 3)) * actor.size_lwh_m
            points = transform_points(T_lidar_from_world @ actor.pose(time_us), points)
            train_id = CLASS_IDS.get(actor.category.split(".")[0], 255)
            add(points, CATEGORIES.index(actor.category), train_id, actor.instance)
        points = np.concatenate(xyz)
        returns = np.zeros((len(points), 5), dtype=np.float32)
        returns[:, :3] = points
        returns[:, 3] = rng.integers(0, 256, len(points))
        returns[:, 4] = np.arange(len(points)) % 32
        return FakeSweep(
            returns,
            np.concatenate(class_id).astype(np.uint8),
            np.concatenate(category).astype(np.uint8),
            np.concatenate(instance).astype(np.int32),
        )

    def view(self, mount: Any, time_us: int, width: int, height: int) -> FakeView:
        camera = mounted_camera(mount, width, height)
        T_world_from_lidar = self.T_world_from_ego(time_us) @ T_EGO_FROM_LIDAR
        T_camera_from_world = camera.T_camera_from_lidar @ invert_rigid(T_world_from_lidar)
        image = np.zeros((height, width, 3), dtype=np.uint8)
        image[:, :, 2] = 200
        class_id = np.full((height, width), 10, dtype=np.uint8)
        instance = np.zeros((height, width), dtype=np.int32)
        depth_m = np.full((height, width), np.inf, dtype=np.float32)
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        for actor in self.actors:
            in_camera = transform_points(T_camera_from_world @ actor.pose(time_us), corners * actor.size_lwh_m)
            if in_camera[:, 2].min() < 0.5:
                continue
            uv = in_camera @ camera.intrinsics.T
            uv = uv[:, :2] / uv[:, 2:]
            (left, top), (right, bottom) = (
                np.rint(uv.min(axis=0)).astype(int).clip(0),
                np.rint(uv.max(axis=0)).astype(int).clip(0),
            )
            window = np.s_[top:bottom, left:right]
            depth = np.float32(in_camera[:, 2].mean())
            nearest = depth_m[window] > depth
            depth_m[window][nearest] = depth
            instance[window][nearest] = actor.instance
            class_id[window][nearest] = CLASS_IDS.get(actor.category.split(".")[0], 255)
            image[window][nearest] = (10 * actor.instance, 100, 0)
        return FakeView(image, class_id, instance, depth_m)


class SlowDrive(FakeDrive):
    """Takes as long as a kill needs to come at any moment."""

    def scan(self, time_us: int) -> FakeSweep:
        import time

        time.sleep(0.003)
        return super().scan(time_us)


class LargeTownDrive(FakeDrive):
    def __init__(self, seed: int, index: int, keyframes: int = 40) -> None:
        super().__init__(seed, index, keyframes)
        self.town.lines["road_divider"] = [np.array([[-60.0, 0.0], [500.0, 0.0]])]


class MisnamedDrive(FakeDrive):
    def __init__(self, seed: int, index: int, keyframes: int = 40) -> None:
        super().__init__(seed, index, keyframes)
        self.actors = (self._actor(1, "vehicle.car", (4.0, 2.0, 1.5), (9.0, 0.0), 0.0, 0.0, "vehicle.flying"),)


def _yaw_pose(yaw: float, x: float, y: float) -> NDArray[np.float64]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])
