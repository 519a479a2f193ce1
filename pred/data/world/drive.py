# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Drives through towns, measured by a LiDAR and six cameras modelled on nuScenes.

Frames: world (metres, z up, roads at z = 0), ego (below the rear axle, x ahead, y left), LiDAR (x right, y ahead) and
camera (x right, y down, z ahead). Times are integer microseconds.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import Camera, invert_rigid
from pred.data.world import blocks, sensors
from pred.data.world.meshes import Material, boxes, loft, merge
from pred.data.world.moment import Layer, Sector, Surfaces, cover, moving_layer
from pred.data.world.motion import rigid
from pred.data.world.objects import CLASS_IDS
from pred.data.world.population import draw_plan, populate
from pred.data.world.scene import Scene
from pred.data.world.sensors import MAX_RANGE_M, MIN_RANGE_M, NUM_COLUMNS, NUM_RINGS, Mount
from pred.data.world.town import Layout, town_map
from pred.data.world.vehicles import NO_CLASS
from pred.random import numpy_generator

KEYFRAME_US, SWEEP_US = 500_000, 50_000
"""Periods of keyframes (2 Hz) and of LiDAR revolutions (20 Hz)."""
CAMERA_OFFSETS_US = {
    "CAM_FRONT_LEFT": -43_000,
    "CAM_FRONT": -35_000,
    "CAM_FRONT_RIGHT": -28_000,
    "CAM_BACK_RIGHT": -20_000,
    "CAM_BACK": -10_000,
    "CAM_BACK_LEFT": -1_000,
}
"""When a camera takes its picture, relative to the stamp of the LiDAR: as the beam passes through its view."""
CATEGORIES = (
    "noise", "animal", "human.pedestrian.adult", "human.pedestrian.child", "human.pedestrian.construction_worker",
    "human.pedestrian.personal_mobility", "human.pedestrian.police_officer", "human.pedestrian.stroller",
    "human.pedestrian.wheelchair", "movable_object.barrier", "movable_object.debris",
    "movable_object.pushable_pullable", "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle",
    "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction", "vehicle.emergency.ambulance",
    "vehicle.emergency.police", "vehicle.motorcycle", "vehicle.trailer", "vehicle.truck", "flat.driveable_surface",
    "flat.other", "flat.sidewalk", "flat.terrain", "static.manmade", "static.other", "static.vegetation", "vehicle.ego",
)  # fmt: skip
"""Official names of the nuScenes-lidarseg categories, by index."""
NOISE, EGO = CATEGORIES.index("noise"), CATEGORIES.index("vehicle.ego")
SEEN_M = 150.0
"""Moving actors that are farther away are not drawn."""

_EPOCH_US = 1_600_000_000_000_000
_SCENE_STRIDE_US = 600_000_000
_LEAD_US, _TAIL_US = 2_000_000, 200_000
"""The simulation starts so long before the first keyframe and ends so long after the last."""
_SHADOW_M = 6.0
"""Moving actors that far outside a picture are drawn, too: their shadows may be in it."""
_SLICES = 8
"""Moving actors are placed anew that often during a revolution."""
_BACKGROUND = {
    "road": "flat.driveable_surface", "sidewalk": "flat.sidewalk", "terrain": "flat.terrain",
    "vegetation": "static.vegetation",
}  # fmt: skip
_BASE_LOSS, _FAR_LOSS = 0.01, 0.02
"""Lost returns: of all, and of a surface that returns one tenth of the light from `MAX_RANGE_M`."""
_FULL_INTENSITY = 200.0
"""Of a surface that returns all light."""


class Sweep(NamedTuple):
    """One LiDAR revolution that ends at its stamp; every beam has an entry, column by column.

    Attributes:
        points: [N, 5] float32, N = 32 * 1085: x, y, z (metres, LiDAR frame at the stamp, ego motion compensated),
            intensity (integers 0 to 255), ring (0 is the lowest). Beams without a return are stored where the sensor
            was when they were sent out.
        class_id: [N] uint8, Cityscapes train id; 255 where there is none (no return, ego car, cones).
        category: [N] uint8, index into `CATEGORIES`.
        instance: [N] int32, actor that was hit; 0 for none.
    """

    points: NDArray[np.float32]
    class_id: NDArray[np.uint8]
    category: NDArray[np.uint8]
    instance: NDArray[np.int32]


class View(NamedTuple):
    """One camera picture with what it shows.

    Attributes:
        image: [h, w, 3] uint8.
        class_id: [h, w] uint8, Cityscapes train id, 10 for sky, 255 for what has none.
        instance: [h, w] int32, actor; 0 for none.
        depth_m: [h, w] float32 along the optical axis; infinite in the sky.
    """

    image: NDArray[np.uint8]
    class_id: NDArray[np.uint8]
    instance: NDArray[np.int32]
    depth_m: NDArray[np.float32]


class Drive:
    """A drive of the ego car through a town of its own: a function of the arguments alone, in any process.

    Args:
        seed: of the world.
        index: number of the scene.
        keyframes: length of the drive, two keyframes a second.

    Raises:
        ValueError: an argument or, in the methods, a time is out of range.

    Attributes:
        keyframe_us: [K] int64, LiDAR stamps of the keyframes.
        actors: everything that annotations are about, also what is far away or hidden; ``actors[i].instance == i + 1``.
        town: the map.
        sun: [3] float32, unit vector towards the sun.
        camera_offsets_us: by camera, relative to the keyframe's stamp.
        start_us, end_us: times for which poses, sweeps and pictures can be asked; sweeps begin 50 ms earlier than
            their stamps.
    """

    def __init__(self, seed: int, index: int, keyframes: int = 40) -> None:
        if index < 0:
            raise ValueError(f"drive: index must be at least 0, got {index}")
        if not 1 <= keyframes <= 1000:
            raise ValueError(f"drive: keyframes must be in [1, 1000], got {keyframes}")
        self.seed, self.index = seed, index
        first_us = _EPOCH_US + index * _SCENE_STRIDE_US
        self.keyframe_us: NDArray[np.int64] = first_us + KEYFRAME_US * np.arange(keyframes, dtype=np.int64)
        self.start_us = first_us - _LEAD_US
        self.end_us = int(self.keyframe_us[-1]) + _TAIL_US
        duration_s = (self.end_us - self.start_us) / 1e6
        self._plan = draw_plan(self._generator("plan"), Layout(self._generator("layout")), duration_s)
        self.actors, self._ego = populate(self._generator("population"), self._plan, self.start_us, duration_s)
        self.town = town_map(self._plan.layout, self._plan.car_parks)
        rng = self._generator("sun")
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(35, 60))
        flat = np.cos(elevation)
        self.sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], dtype=np.float32)
        self.camera_offsets_us = dict(CAMERA_OFFSETS_US)
        self._movers = [actor for actor in self.actors if not actor.is_static]
        self._category_of_instance = np.array(
            [NOISE] + [CATEGORIES.index(actor.category) for actor in self.actors], dtype=np.uint8
        )

    def sweep_us(self, keyframe: int) -> NDArray[np.int64]:
        """Stamps of the sweeps after the keyframe before, up to keyframe ``keyframe``'s own; [10] int64.

        Those of keyframe 0 are eleven, so that it, too, has ten sweeps before its own.
        """
        if not 0 <= keyframe < len(self.keyframe_us):
            raise ValueError(f"drive: keyframe must be in [0, {len(self.keyframe_us)}), got {keyframe}")
        count = KEYFRAME_US // SWEEP_US + (keyframe == 0)
        return np.asarray(self.keyframe_us[keyframe] + SWEEP_US * np.arange(1 - count, 1, dtype=np.int64))

    def T_world_from_ego(self, time_us: int) -> NDArray[np.float64]:  # noqa: N802
        """[4, 4] float64: pose of the ego car, on the ground below its rear axle."""
        x, y, yaw_rad = self._ego_track(np.array([time_us]))[0]
        return rigid(x, y, 0.0, yaw_rad)

    def scan(self, time_us: int) -> Sweep:
        """The LiDAR revolution that ends at ``time_us``."""
        rng = self._generator("scan", time_us)
        beams = sensors.lidar_directions()
        # A column is fired while the car is where it was then; the last one at the stamp.
        times_us = time_us - SWEEP_US * np.arange(NUM_COLUMNS - 1, -1, -1) // NUM_COLUMNS
        origins, directions = self._beams_in_world(times_us)
        origins32, directions32 = origins.astype(np.float32), directions.astype(np.float32)
        hits = self._still.cast(origins32, directions32)
        slices = np.array_split(np.arange(NUM_COLUMNS), _SLICES)
        middles = [int(columns[len(columns) // 2]) for columns in slices]
        placements = self._mover_placements(times_us[middles])
        for columns, middle, at_middle in zip(slices, middles, placements, strict=True):
            rays = slice(int(columns[0]) * NUM_RINGS, (int(columns[-1]) + 1) * NUM_RINGS)
            ahead = directions[middle * NUM_RINGS]
            sector = Sector(float(np.arctan2(ahead[1], ahead[0])), 1.1 * np.pi / _SLICES, 0.5)
            layer = moving_layer(self._movers, at_middle, origins[middle * NUM_RINGS, :2], MAX_RANGE_M, sector)
            if layer is not None:
                cover(hits, layer, origins32, directions32, rays)
        # Drawn for all beams, so that a beam's noise does not depend on what the others meet.
        noise_m, chance, speckle, glint = (
            rng.normal(0.0, sensors.RANGE_NOISE_M, len(beams)),
            rng.random(len(beams)),
            rng.normal(1.0, 0.1, len(beams)),
            rng.random(len(beams)),
        )
        cosine = -np.einsum("nc,nc->n", hits.normal, directions32)
        returned = sensors.returned_light(hits.reflectance, cosine, speckle)
        category = self._categories(hits)
        on_car_m = ego_range_m()
        on_car = on_car_m < hits.t_m
        range_m = np.where(on_car, on_car_m, hits.t_m).astype(np.float64)
        lost = _BASE_LOSS + _FAR_LOSS * (range_m / MAX_RANGE_M) ** 2 / np.maximum(returned, 1e-3) * 10
        no_return = ~on_car & ((chance < lost) | (range_m >= MAX_RANGE_M) | (range_m <= MIN_RANGE_M))
        intensity = np.where(on_car, 60 * glint**3, _FULL_INTENSITY * returned)
        world = origins + directions * np.where(no_return, 0.0, range_m + noise_m)[:, None]
        T_lidar_from_world = invert_rigid(self.T_world_from_ego(time_us) @ sensors.T_EGO_FROM_LIDAR)
        points = np.empty((len(beams), 5), dtype=np.float32)
        points[:, :3] = world @ T_lidar_from_world[:3, :3].T + T_lidar_from_world[:3, 3]
        points[:, 3] = np.rint(np.where(no_return, 8 * glint, intensity)).clip(0, 255)
        points[:, 4] = np.tile(np.arange(NUM_RINGS), NUM_COLUMNS)
        unclassed = on_car | no_return
        class_id = np.where(unclassed, np.uint8(NO_CLASS), hits.class_id)
        category[on_car], category[no_return] = EGO, NOISE
        return Sweep(points, class_id, category, np.where(unclassed, np.int32(0), hits.instance))

    def view(self, camera: Mount | Camera, time_us: int, width: int = 400, height: int = 225) -> View:
        """What a camera shows at ``time_us`` (its own time, not that of the LiDAR).

        Args:
            camera: a mount of `pred.data.world.sensors`, or a camera with the static extrinsics of one.
            time_us: when.
            width, height: size of the picture; the intrinsics of a mount follow it, those of a camera must be for it.
        """
        if isinstance(camera, Mount):
            camera = sensors.mounted_camera(camera, width, height)
        if (camera.width, camera.height) != (width, height):
            given = f"{camera.width} x {camera.height}"
            raise ValueError(f"drive: camera must have the size of the picture, {width} x {height}, got {given}")
        T_world_from_lidar = self.T_world_from_ego(time_us) @ sensors.T_EGO_FROM_LIDAR
        origin, directions = sensors.camera_rays(camera, T_world_from_lidar)
        hits = self._still.cast(origin, directions)
        optical_axis = (T_world_from_lidar @ camera.T_lidar_from_camera)[:3, 2].astype(np.float32)
        half_rad = float(np.arccos((directions @ optical_axis).min()))
        sector = Sector(float(np.arctan2(optical_axis[1], optical_axis[0])), half_rad, _SHADOW_M)
        (placements,) = self._mover_placements(np.array([time_us]))
        moving = moving_layer(self._movers, placements, origin[:2].astype(np.float64), SEEN_M, sector)
        if moving is not None:
            cover(hits, moving, origin, directions, slice(None))

        def occluded(places: NDArray[np.float32], towards: NDArray[np.float32]) -> NDArray[np.bool_]:
            dark = self._still.scene.occluded(places, towards)
            if moving is not None:
                light = np.flatnonzero(~dark)
                dark[light] = moving.scene.occluded(places[light], towards[light])
            return dark

        (solid,) = np.nonzero(np.isfinite(hits.t_m))
        pixels = sensors.shade(
            origin, directions, solid, hits.t_m[solid], hits.normal[solid], hits.colour[solid], self.sun, occluded
        )
        return View(
            pixels.reshape(height, width, 3),
            hits.class_id.reshape(height, width),
            hits.instance.reshape(height, width),
            (hits.t_m * (directions @ optical_axis)).reshape(height, width),
        )

    def _generator(self, *key: int | str) -> np.random.Generator:
        return numpy_generator(self.seed, "drive", self.index, *key)

    def _ego_track(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """[n, 3] x, y and heading of the ego frame."""
        if times_us.min() < self.start_us or times_us.max() > self.end_us:
            outside = times_us.min() if times_us.min() < self.start_us else times_us.max()
            raise ValueError(f"drive: time_us must be in [{self.start_us}, {self.end_us}], got {outside}")
        front, rear = self._ego.pivots(times_us)
        ahead = front - rear
        return np.column_stack([rear[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])])

    def _beams_in_world(self, times_us: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origins and directions [N, 3] of the beams of all columns, each fired at its time."""
        x, y, yaw_rad = self._ego_track(times_us).T
        # The LiDAR's axes are the car's, turned by -90 degrees.
        c, s = np.cos(yaw_rad - np.pi / 2), np.sin(yaw_rad - np.pi / 2)
        beams = sensors.lidar_directions().reshape(NUM_COLUMNS, NUM_RINGS, 3)
        directions = np.stack(
            [
                c[:, None] * beams[..., 0] - s[:, None] * beams[..., 1],
                s[:, None] * beams[..., 0] + c[:, None] * beams[..., 1],
                beams[..., 2],
            ],
            axis=2,
        )
        ahead_m, height_m = sensors.T_EGO_FROM_LIDAR[[0, 2], 3]
        centres = np.stack([x + ahead_m * np.cos(yaw_rad), y + ahead_m * np.sin(yaw_rad), 0 * x + height_m], axis=1)
        return np.repeat(centres, NUM_RINGS, axis=0), directions.reshape(-1, 3)

    def _mover_placements(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """[n, M, 4] of all that moves."""
        tracks = [actor.motion.placements(times_us) for actor in self._movers]
        return np.array(tracks).reshape(-1, len(times_us), 4).transpose(1, 0, 2)

    @cached_property
    def _still(self) -> Layer:
        """Everything that does not move, parked cars included."""
        time_us = self.start_us
        parked = [(actor, actor.pose(time_us)) for actor in self.actors if actor.is_static]
        return Layer(blocks.build(self._plan, self.seed, self.index), parked)

    def _categories(self, hits: Surfaces) -> NDArray[np.uint8]:
        """[N] index into `CATEGORIES`."""
        return np.where(
            hits.instance > 0, self._category_of_instance[hits.instance], _BACKGROUND_CATEGORY[hits.class_id]
        )


def _background_categories() -> NDArray[np.uint8]:
    table = np.full(256, CATEGORIES.index("static.manmade"), dtype=np.uint8)
    for name, category in _BACKGROUND.items():
        table[CLASS_IDS[name]] = CATEGORIES.index(category)
    table[CLASS_IDS["sky"]] = NOISE
    return table


_BACKGROUND_CATEGORY = _background_categories()


@lru_cache(maxsize=1)
def ego_range_m() -> NDArray[np.float32]:
    """[32 * 1085] distance at which each beam meets the ego car; infinite where it does not.

    The car is what nuScenes sweeps show of it: a rack behind and below the sensor, and the bonnet.
    """
    grey = Material(NO_CLASS, (0.5, 0.5, 0.5), 0.3)
    car = merge(
        [
            boxes([-0.55, -0.72, -0.45], [0.55, 0.26, -0.31], grey),
            boxes([-0.12, -1.1, -0.40], [0.12, -0.75, -0.31], grey),
            loft((-0.62, 0.62, 1.0, 2.0), (-0.60, 0.60, 1.1, 1.85), -1.1, -0.93, grey),
        ]
    )
    range_m = Scene(car).cast(np.zeros(3, dtype=np.float32), sensors.lidar_directions().astype(np.float32)).t_m
    range_m.flags.writeable = False
    return range_m
