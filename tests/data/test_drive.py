# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Drives through towns: motion and map by hand, agreement of sensors, boxes and map, determinism."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from pred.data.frame import invert_rigid, transform_points
from pred.data.world import CATEGORIES, Actor, Drive, Sweep, sensors, vehicles
from pred.data.world.actors import MARGIN_M, make_actor, without_overlaps
from pred.data.world.annotation import annotated_keyframes, candidates
from pred.data.world.drive import EGO, NOISE, ego_range_m
from pred.data.world.meshes import Material, Mesh, boxes, prism
from pred.data.world.motion import Path, Profile, Stand, Travel, overlap
from pred.data.world.objects import CLASS_IDS
from pred.data.world.population import EGO_SIZE_M
from pred.data.world.scene import SKY_CLASS
from pred.data.world.town import EXTENT_M, Layout, clip, rounded_rectangle, signed_area, town_map
from pred.data.world.vehicles import NO_CLASS

NUM_BEAMS = 32 * 1085
RANGES_M = {
    "vehicle.car": 50, "vehicle.truck": 50, "vehicle.bus.rigid": 50, "vehicle.trailer": 50, "vehicle.construction": 50,
    "human.pedestrian.adult": 40, "vehicle.motorcycle": 40, "vehicle.bicycle": 40, "movable_object.trafficcone": 30,
    "movable_object.barrier": 30,
}  # fmt: skip
"""The ten detection classes and the distances to which nuScenes evaluates them."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive(seed=2, index=1, keyframes=40)


@pytest.fixture(scope="module")
def moving_us(drive: Drive) -> int:
    """A keyframe while the ego car is fast."""
    speeds = [ego_speed(drive, int(time_us)) for time_us in drive.keyframe_us]
    return int(drive.keyframe_us[int(np.argmax(speeds))])


@pytest.fixture(scope="module")
def sweep(drive: Drive, moving_us: int) -> Sweep:
    return drive.scan(moving_us)


def ego_speed(drive: Drive, time_us: int) -> float:
    before, after = (drive.T_world_from_ego(time_us + step)[:2, 3] for step in (-5000, 5000))
    return float(np.linalg.norm(after - before) / 0.01)


def in_box(actor: Actor, time_us: int, points_world: NDArray[np.float64], margin_m: float = 0.0) -> NDArray[np.bool_]:
    local = transform_points(invert_rigid(actor.pose(time_us)), points_world)
    return np.asarray((np.abs(local) <= np.array(actor.size_lwh_m) / 2 + margin_m).all(axis=1))


def in_world(drive: Drive, time_us: int, points_lidar: NDArray[np.float32]) -> NDArray[np.float64]:
    return transform_points(drive.T_world_from_ego(time_us) @ sensors.T_EGO_FROM_LIDAR, points_lidar[:, :3])


# Geometry and motion by hand


def test_prism_clip_and_rounded_rectangle() -> None:
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], dtype=np.float64)
    mesh = prism(square, 1.0, 4.0, Material(0, (0.5, 0.5, 0.5), 0.1))
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert np.einsum("fc,fc->", a, np.cross(b, c)) / 6 == pytest.approx(12)
    assert signed_area(clip(square, (1, 0), 0.5)) == pytest.approx(1)
    assert len(clip(square, (1, 0), -1.0)) == 0
    rounded = rounded_rectangle((0, 0), (10, 10), [0, 0, 2, 0])
    # The corner at (10, 10) is a polygon inside the circle of radius 2.
    assert signed_area(rounded) == pytest.approx(100 - (4 - np.pi), abs=0.05)
    assert rounded.max() == 10 and rounded.min() == 0


def test_motion_along_a_path() -> None:
    path = Path([[0, 0, 0], [10, 0, 0], [10, 10, 2]])
    assert path.length_m == 20
    np.testing.assert_allclose(path.at(np.array([5.0, 15.0, 99.0])), [[5, 0, 0], [10, 5, 1], [10, 10, 2]])
    # At rest for one second, then 2 m/s^2 for two seconds, then 4 m/s.
    profile = Profile(
        1_000_000, np.array([0.0, 1.0, 3.0]), np.array([3.0, 3.0, 7.0]), np.array([0, 0, 4.0]), np.array([0, 2.0, 0])
    )
    times_us = np.array([0, 1_500_000, 3_000_000, 4_000_000, 5_000_000])
    np.testing.assert_allclose(profile.at(times_us), [3, 3, 4, 7, 11])
    travel = Travel(path, profile, 1.0, 3.0)
    np.testing.assert_allclose(travel.placements(times_us[:1]), [[1, 0, 0, 0]])
    np.testing.assert_allclose(travel.placements(times_us[-1:]), [[9, 0, 0, 0]])


def test_overlap_of_rectangles() -> None:
    car = np.array([[0, 0, 0, 0.0]])
    half = np.array([[2.0, 1.0]])
    for placement, expected in (
        ([3.9, 0, 0, 0], True),
        ([4.1, 0, 0, 0], False),
        ([3.1, 0, 0, np.pi / 2], False),
        ([2.9, 0, 0, np.pi / 2], True),
        # Corner to corner at 45 degrees: the axis-aligned hulls overlap, the rectangles do not.
        ([3.9, 2.9, 0, np.pi / 4], False),
    ):
        assert bool(overlap(car, half, np.array([placement]), half)[0]) is expected, placement


def test_the_box_of_an_actor_fits_its_mesh_and_stands_on_the_ground() -> None:
    mesh = boxes([-1, -0.5, 0], [3, 0.5, 2], Material(CLASS_IDS["car"], (0.5, 0.5, 0.5), 0.3))
    actor = make_actor("vehicle.car", mesh, Stand((10.0, 20.0, 0.13, np.pi / 2)), ("moving", "parked"))
    np.testing.assert_allclose(actor.size_lwh_m, [4 + 2 * MARGIN_M, 1 + 2 * MARGIN_M, 2 + MARGIN_M - 0.02])
    pose = actor.pose(0)
    np.testing.assert_allclose(pose[:3, 3], [10, 20, 0.13 + (0.02 + 2 + MARGIN_M) / 2])
    np.testing.assert_allclose(pose[:3, 0], [0, 1, 0], atol=1e-12)
    low, high = actor.mesh.bounds()
    np.testing.assert_allclose((low + high)[:2], 0, atol=1e-12)
    assert actor.attribute(0) == "parked" and not actor.velocity(0).any() and actor.is_static


def test_what_overlaps_goes_with_its_unit() -> None:
    mesh = boxes([-1, -0.5, 0], [1, 0.5, 1], Material(CLASS_IDS["car"], (0.5, 0.5, 0.5), 0.3))

    def at(x: float, y: float) -> Actor:
        return make_actor("vehicle.car", mesh, Stand((x, y, 0.0, 0.0)), ("", ""))

    still = Profile(0, np.zeros(1), np.array([10.0]), np.zeros(1), np.zeros(1))
    ego = Travel(Path([[0, 0, 0], [50, 0, 0]]), still, 0.0, 4.0)  # its middle at x = 8
    kept = without_overlaps([[at(8, 0)], [at(20, 0)], [at(21, 0), at(40, 0)], [at(30, 0)]], ego, (4, 2), np.array([0]))
    assert [(actor.instance, actor.pose(0)[0, 3]) for actor in kept] == [(1, 20), (2, 30)]


BUILDERS: list[tuple[Callable[[np.random.Generator], Mesh], list[float], set[str]]] = [
    (vehicles.truck, [7.3, 2.4, 3.0], {"truck"}),
    (vehicles.trailer, [6.8, 2.4, 3.0], {"truck"}),
    (vehicles.bus, [10.5, 2.55, 3.1], {"bus"}),
    (vehicles.excavator, [5.8, 2.4, 3.4], {"truck"}),
    (vehicles.wheel_loader, [6.0, 2.5, 3.1], {"truck"}),
    (lambda rng: vehicles.motorcycle(rng, ridden=False), [2.1, 0.76, 1.09], {"motorcycle"}),
    (lambda rng: vehicles.motorcycle(rng, ridden=True), [2.1, 0.76, 1.75], {"motorcycle", "rider"}),
    (lambda rng: vehicles.bicycle(rng, ridden=False), [1.76, 0.58, 1.04], {"bicycle"}),
    (lambda rng: vehicles.bicycle(rng, ridden=True), [1.76, 0.62, 1.83], {"bicycle", "rider"}),
    (vehicles.construction_worker, [0.65, 0.67, 1.8], {"person"}),
    (vehicles.child, [0.45, 0.48, 1.23], {"person"}),
    (vehicles.barrier, [0.6, 1.98, 1.0], {"fence"}),
]


@pytest.mark.parametrize(("build", "size", "classes"), BUILDERS)
def test_objects_have_the_size_of_their_kind(
    build: Callable[[np.random.Generator], Mesh], size: list[float], classes: set[str]
) -> None:
    for seed in range(4):
        mesh = build(np.random.default_rng(seed))
        low, high = mesh.bounds()
        assert abs(low[2]) < 0.04
        np.testing.assert_allclose(high - low, size, rtol=0.4 if classes == {"person"} else 0.26)
        assert set(mesh.class_ids) == {CLASS_IDS[name] for name in classes}
        assert mesh.faces.max() < len(mesh.vertices) and ((mesh.colours >= 0) & (mesh.colours <= 1.5)).all()
    cone = vehicles.traffic_cone(np.random.default_rng(0))
    assert set(cone.class_ids) == {NO_CLASS}


# Map


def within(polygon: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[n] whether points [n, 2] lie inside, by counting the edges that a ray to the right crosses."""
    inside = np.zeros(len(points), dtype=np.bool_)
    for (x_0, y_0), (x_1, y_1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        straddles = (y_0 > points[:, 1]) != (y_1 > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= straddles & (points[:, 0] < x_0 + (points[:, 1] - y_0) * (x_1 - x_0) / (y_1 - y_0))
    return inside


def within_any(polygons: list[NDArray[np.float64]], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.any([within(polygon, points) for polygon in polygons], axis=0)


def is_simple(polygon: NDArray[np.float64]) -> bool:
    """No two edges cross."""
    after = np.roll(polygon, -1, axis=0)

    def side(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    return not any(
        side(polygon[i], after[i], polygon[j]) * side(polygon[i], after[i], after[j]) < -1e-9
        and side(polygon[j], after[j], polygon[i]) * side(polygon[j], after[j], after[i]) < -1e-9
        for i in range(len(polygon))
        for j in range(i)
    )


def test_map_layers_are_valid_and_inside_the_town() -> None:
    for seed in range(3):
        layout = Layout(np.random.default_rng(seed))
        town = town_map(layout, ())
        assert set(town.polygons) == {
            "drivable_area", "road_segment", "road_block", "lane", "ped_crossing", "walkway", "stop_line",
            "carpark_area",
        }  # fmt: skip
        assert set(town.lines) == {"road_divider", "lane_divider"}
        for name, polygons in town.polygons.items():
            assert len(polygons) > 10 or name == "carpark_area", name
            for polygon in polygons:
                assert polygon.shape[1] == 2 and signed_area(polygon) > 0.1 and is_simple(polygon), name
                assert ((polygon >= 0) & (polygon <= EXTENT_M)).all(), name
        drivable = town.polygons["drivable_area"]
        rng = np.random.default_rng(seed)
        for name in ("road_segment", "road_block", "lane", "ped_crossing", "stop_line"):
            corners = np.concatenate(
                [polygon + 1e-6 * (polygon.mean(axis=0) - polygon) for polygon in town.polygons[name]]
            )
            assert within_any(drivable, corners).all(), name
        places = rng.uniform(0, EXTENT_M, (3000, 2))
        in_lanes = np.sum([within(lane, places) for lane in town.polygons["lane"]], axis=0)
        assert in_lanes.max() == 1
        assert not (within_any(town.polygons["walkway"], places) & within_any(drivable, places)).any()
        for lines in town.lines.values():
            for line in lines:
                assert line.shape == (2, 2) and within_any(drivable, line.mean(axis=0)[None]).all()
        assert len(town.intersections) == 16


def test_map_shows_where_the_road_is(drive: Drive) -> None:
    """What a ray straight down meets is what the map says."""
    rng = np.random.default_rng(0)
    ego = drive.T_world_from_ego(int(drive.keyframe_us[10]))[:2, 3]
    places = ego + rng.uniform(-60, 60, (4000, 2))
    origins = np.column_stack([places, np.full(len(places), 0.4)])
    hits = drive._still.cast(origins.astype(np.float32), np.tile(np.array([0, 0, -1], np.float32), (len(origins), 1)))
    ground = np.isin(hits.class_id, [CLASS_IDS[name] for name in ("road", "sidewalk", "terrain")])
    ground &= hits.instance == 0
    drivable = within_any(drive.town.polygons["drivable_area"], places)[ground]
    walkway = within_any(drive.town.polygons["walkway"], places)[ground]
    assert drivable.sum() > 500 and walkway.sum() > 200
    np.testing.assert_array_equal(drivable, hits.class_id[ground] == CLASS_IDS["road"])
    # Driveways cross walkways.
    np.testing.assert_array_equal(walkway & ~drivable, hits.class_id[ground] == CLASS_IDS["sidewalk"])


# Actors and the ego car


@pytest.mark.parametrize("seed", [0, 1])
def test_all_ten_classes_are_met_within_their_ranges(seed: int) -> None:
    drive = Drive(seed, 0, keyframes=6)
    found = set()
    for time_us in map(int, drive.keyframe_us):
        hit = np.bincount(drive.scan(time_us).instance, minlength=len(drive.actors) + 1)
        ego = drive.T_world_from_ego(time_us)[:2, 3]
        for actor in drive.actors:
            near = np.linalg.norm(actor.pose(time_us)[:2, 3] - ego) < RANGES_M.get(actor.category, 0)
            if near and hit[actor.instance]:
                found.add(actor.category)
    assert found == set(RANGES_M)


def test_nobody_overlaps(drive: Drive) -> None:
    tracks = [drive._ego] + [actor.motion for actor in drive.actors]
    half = np.array([EGO_SIZE_M, *(actor.size_lwh_m[:2] for actor in drive.actors)]) / 2
    first, second = np.triu_indices(len(tracks), 1)
    for time_us in range(drive.start_us + 33_333, drive.end_us, 700_001):
        placements = np.concatenate([track.placements(np.array([time_us])) for track in tracks])
        near = np.linalg.norm(placements[first, :2] - placements[second, :2], axis=1) < 15
        a, b = first[near], second[near]
        assert not overlap(placements[a], half[a], placements[b], half[b]).any()


def test_actors_are_annotated_as_nuscenes_does(drive: Drive) -> None:
    assert [actor.instance for actor in drive.actors] == list(range(1, len(drive.actors) + 1))
    states = {
        "human": {"pedestrian.moving", "pedestrian.standing"},
        "vehicle": {"vehicle.moving", "vehicle.stopped", "vehicle.parked"},
        "cycle": {"cycle.with_rider", "cycle.without_rider"},
        "movable_object": {""},
    }
    seen = set()
    for actor in drive.actors:
        assert actor.category in CATEGORIES
        kind = "cycle" if actor.category.endswith("cycle") else actor.category.split(".")[0]
        for time_us in map(int, drive.keyframe_us[::8]):
            attribute = actor.attribute(time_us)
            assert attribute in states[kind]
            seen.add(attribute)
            speed = float(np.linalg.norm(actor.velocity(time_us)))
            assert speed < 16
            if attribute.endswith(("parked", "standing", "stopped")):
                assert speed <= 0.2
            pose = actor.pose(time_us)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
            assert pose[2, 2] == 1
    assert seen == set().union(*states.values())


def test_velocity_is_that_of_the_poses(drive: Drive) -> None:
    time_us = int(drive.keyframe_us[20])
    moving = [actor for actor in drive.actors if np.linalg.norm(actor.velocity(time_us)) > 2]
    assert len(moving) > 5
    for actor in moving:
        step = actor.pose(time_us + 50_000)[:3, 3] - actor.pose(time_us - 50_000)[:3, 3]
        np.testing.assert_allclose(actor.velocity(time_us), step / 0.1, atol=0.35)


def test_the_ego_car_drives_stops_and_turns(drive: Drive) -> None:
    times_us = range(int(drive.keyframe_us[0]), int(drive.keyframe_us[-1]), 100_000)
    poses = np.array([drive.T_world_from_ego(time_us) for time_us in times_us])
    assert not poses[:, 2, 3].any() and (poses[:, 2, 2] == 1).all()
    speed = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1) / 0.1
    assert speed.max() < 12 and (speed > 5).mean() > 0.25 and (speed < 0.1).any()
    yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert np.ptp(yaw) == pytest.approx(np.pi / 2, abs=0.02)
    # Smooth: at most 8 m/s^2, and the car moves where it points to.
    assert np.abs(np.diff(speed)).max() < 0.8
    assert np.abs(np.diff(yaw)).max() < 0.12
    ahead = poses[1:, :2, 0]
    moved = np.diff(poses[:, :2, 3], axis=0)
    fast = speed > 1
    # Both axles are on the path, so that in a bend of 9 m the rear one slips by asin(1.2 / 9), 7.7 degrees.
    slip_deg = np.rad2deg(np.arccos((np.einsum("nc,nc->n", ahead, moved)[fast] / speed[fast] / 0.1).clip(-1, 1)))
    assert slip_deg.max() < 10 and np.median(slip_deg) < 1


def test_time_stamps(drive: Drive) -> None:
    assert (np.diff(drive.keyframe_us) == 500_000).all() and drive.keyframe_us.dtype == np.int64
    sweeps_us = [drive.sweep_us(keyframe) for keyframe in range(len(drive.keyframe_us))]
    assert [len(stamps) for stamps in sweeps_us[:3]] == [11, 10, 10]
    assert [stamps[-1] for stamps in sweeps_us] == drive.keyframe_us.tolist()
    assert (np.diff(np.concatenate(sweeps_us)) == 50_000).all()
    drive.scan(int(sweeps_us[0][0]))
    assert drive.camera_offsets_us == {
        "CAM_FRONT_LEFT": -43_000, "CAM_FRONT": -35_000, "CAM_FRONT_RIGHT": -28_000, "CAM_BACK_RIGHT": -20_000,
        "CAM_BACK": -10_000, "CAM_BACK_LEFT": -1_000,
    }  # fmt: skip
    # A camera fires as the beam passes the middle of its view, to within a few milliseconds.
    for mount in sensors.CALIBRATED_MOUNTS:
        from_left = (90 - mount.yaw_deg) % 360
        beam_us = -50_000 * (1 - from_left / 360)
        assert drive.camera_offsets_us[mount.name] == pytest.approx(beam_us, abs=4500)
    later = Drive(2, 2, keyframes=1)
    assert later.keyframe_us[0] > drive.end_us


# LiDAR


def test_sweep_is_a_full_grid_like_those_of_nuscenes(drive: Drive, sweep: Sweep, moving_us: int) -> None:
    points = sweep.points
    assert points.shape == (NUM_BEAMS, 5) and points.dtype == np.float32 and np.isfinite(points).all()
    assert (sweep.class_id.dtype, sweep.category.dtype, sweep.instance.dtype) == (np.uint8, np.uint8, np.int32)
    np.testing.assert_array_equal(points[:, 4], np.tile(np.arange(32), 1085))
    np.testing.assert_array_equal(points[:, 3], np.rint(points[:, 3]))
    range_m = np.linalg.norm(points[:, :3], axis=1)
    missing, on_car = sweep.category == NOISE, sweep.category == EGO
    assert 0.08 < missing.mean() < 0.22
    assert 0.10 < on_car.mean() < 0.13  # the real keyframe: 0.115
    assert (range_m < 2.5)[~missing & ~on_car].mean() < 0.002
    returned = ~missing & ~on_car
    assert 60 < range_m.max() < 105.2 and 8 <= np.median(points[returned, 3]) <= 40
    road = sweep.class_id == CLASS_IDS["road"]
    assert np.median(points[road, 2]) == pytest.approx(-1.84, abs=0.003)
    assert (sweep.class_id[missing | on_car] == NO_CLASS).all() and not sweep.instance[missing | on_car].any()
    drivable = sweep.category == CATEGORIES.index("flat.driveable_surface")
    np.testing.assert_array_equal(drivable, road)
    assert (sweep.instance > 0).sum() > 300
    for instance in np.unique(sweep.instance[sweep.instance > 0]):
        assert drive.actors[instance - 1].category == CATEGORIES[sweep.category[sweep.instance == instance][0]]


def test_beams_start_from_the_moving_sensor(drive: Drive, sweep: Sweep, moving_us: int) -> None:
    """No-returns are stored where the sensor was, as in the real files: up to 50 ms of driving behind."""
    assert ego_speed(drive, moving_us) > 5
    T_lidar_from_world = invert_rigid(drive.T_world_from_ego(moving_us) @ sensors.T_EGO_FROM_LIDAR)
    for column in (0, 400, 1084):
        beams = slice(32 * column, 32 * column + 32)
        missing = sweep.category[beams] == NOISE
        fired_us = moving_us - 50_000 * (1084 - column) // 1085
        pose = T_lidar_from_world @ drive.T_world_from_ego(fired_us) @ sensors.T_EGO_FROM_LIDAR
        stored = sweep.points[beams, :3][missing]
        np.testing.assert_allclose(stored, np.broadcast_to(pose[:3, 3], stored.shape), atol=0.06)
        # Returns lie on the beam: direction from the sensor's place then.
        local = transform_points(invert_rigid(pose), sweep.points[beams, :3][~missing])
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        np.testing.assert_allclose(local, sensors.lidar_directions()[beams][~missing], atol=2e-3)
    first = sweep.points[:32, :3][sweep.category[:32] == NOISE]
    assert len(first) == 0 or first[0, 1] < -0.2


def test_still_things_do_not_move_with_the_ego_car(drive: Drive, sweep: Sweep, moving_us: int) -> None:
    """Compensation: points of parked vehicles lie in their boxes, and the boxes hold hardly any others."""
    world = in_world(drive, moving_us, sweep.points)
    agreeing = hit = boxed = 0
    for actor in drive.actors:
        own = sweep.instance == actor.instance
        if actor.is_static and own.sum() > 0:
            inside = in_box(actor, moving_us, world)
            hit, boxed, agreeing = hit + own.sum(), boxed + inside.sum(), agreeing + (inside & own).sum()
            assert in_box(actor, moving_us, world[own], margin_m=0.08).all()
    assert hit > 200
    assert agreeing / hit > 0.95 and agreeing / boxed > 0.97


def test_moving_things_are_where_they_were_when_the_beam_met_them(drive: Drive) -> None:
    checked = 0
    for time_us in map(int, drive.keyframe_us[4:40:4]):
        sweep = drive.scan(time_us)
        world = in_world(drive, time_us, sweep.points)
        column = np.arange(NUM_BEAMS) // 32
        for actor in drive.actors:
            (own,) = np.nonzero(sweep.instance == actor.instance)
            if len(own) >= 10 and np.linalg.norm(actor.velocity(time_us)) > 3:
                fired_us = time_us - 50_000 * (1084 - int(np.median(column[own]))) // 1085
                assert in_box(actor, fired_us, world[own], margin_m=0.12).mean() > 0.97
                checked += 1
    assert checked > 5


def test_ranges_have_2_cm_of_noise(drive: Drive) -> None:
    still_us = next(int(time_us) for time_us in drive.keyframe_us if ego_speed(drive, int(time_us)) < 1e-9)
    sweep = drive.scan(still_us)
    # On a plane the exact range follows from the beam's slope alone, if the sensor stands still.
    slope = -sensors.lidar_directions()[:, 2]
    steep = (sweep.class_id == CLASS_IDS["road"]) & (slope > 0.2)
    error_m = np.linalg.norm(sweep.points[steep, :3].astype(np.float64), axis=1) - 1.84 / slope[steep]
    # Paint lies 5 mm higher.
    assert steep.sum() > 3000 and error_m.std() == pytest.approx(0.02, abs=0.002) and abs(error_m.mean()) < 0.004


def test_intensity_tells_materials_apart(drive: Drive) -> None:
    sweeps = [drive.scan(int(time_us)) for time_us in drive.keyframe_us[::8]]
    intensity = np.concatenate([sweep.points[:, 3] for sweep in sweeps])
    class_id = np.concatenate([sweep.class_id for sweep in sweeps])
    assert intensity.min() >= 0 and intensity.max() <= 255
    signs, all_median = intensity[class_id == CLASS_IDS["traffic sign"]], np.median(intensity[class_id != NO_CLASS])
    assert len(signs) > 20 and np.median(signs) > 3 * all_median


def test_the_ego_car_hides_the_ground_around_it() -> None:
    grid = ego_range_m().reshape(1085, 32)
    hidden = np.isfinite(grid)
    assert hidden.mean() == pytest.approx(0.115, abs=0.01)
    assert hidden[:, 0].mean() > 0.5 and not hidden[:, 12:].any()
    assert grid[hidden].max() < 2.5


# Cameras


def test_views_agree_with_boxes_at_their_own_time(drive: Drive) -> None:
    checked = 0
    for keyframe in (16, 28, 36):
        for mount in sensors.CALIBRATED_MOUNTS:
            time_us = int(drive.keyframe_us[keyframe]) + drive.camera_offsets_us[mount.name]
            view = drive.view(mount, time_us, 200, 112)
            assert view.image.shape == (112, 200, 3) and view.image.dtype == np.uint8
            np.testing.assert_array_equal(view.class_id == SKY_CLASS, np.isinf(view.depth_m))
            assert (view.depth_m > 0).all() and view.depth_m.dtype == np.float32
            camera = sensors.mounted_camera(mount, 200, 112)
            v, u = np.nonzero(view.instance)
            rays = np.column_stack([u + 0.5, v + 0.5, np.ones(len(u))]) @ np.linalg.inv(camera.intrinsics).T
            T_world_from_camera = (
                drive.T_world_from_ego(time_us) @ sensors.T_EGO_FROM_LIDAR @ camera.T_lidar_from_camera
            )
            world = transform_points(T_world_from_camera, rays * view.depth_m[v, u][:, None])
            for instance in np.unique(view.instance[v, u]):
                actor = drive.actors[instance - 1]
                own = view.instance[v, u] == instance
                # The mesh reaches down to the ground, 2 cm below the box.
                assert in_box(actor, time_us, world[own], margin_m=0.025).all()
                checked += 1
    assert checked > 40


def test_pixels_show_the_classes_of_the_points_that_project_to_them(drive: Drive) -> None:
    """Pixels of a LiDAR point have its class, but for parallax, pixel size and what moved in between."""
    points, pixels = np.zeros(256, dtype=int), np.zeros(256, dtype=int)
    agreeing, visible = [], []
    for time_us in map(int, drive.keyframe_us[::10]):
        sweep = drive.scan(time_us)
        returned = np.flatnonzero((sweep.category != NOISE) & (sweep.category != EGO))
        points += np.bincount(sweep.class_id[returned], minlength=256)
        world = in_world(drive, time_us, sweep.points[returned])
        for mount in sensors.CALIBRATED_MOUNTS:
            camera_us = time_us + drive.camera_offsets_us[mount.name]
            view, camera = drive.view(mount, camera_us, 160, 90), sensors.mounted_camera(mount, 160, 90)
            pixels += np.bincount(view.class_id.ravel(), minlength=256)
            T_lidar_from_world = invert_rigid(drive.T_world_from_ego(camera_us) @ sensors.T_EGO_FROM_LIDAR)
            uv, z_depth_m = camera.project(transform_points(T_lidar_from_world, world))
            inside = camera.in_image(uv, z_depth_m)
            u, v = uv[inside].astype(int).T
            agreeing.append(view.class_id[v, u] == sweep.class_id[returned[inside]])
            visible.append(z_depth_m[inside] < 1.03 * view.depth_m[v, u] + 0.3)
            sky = view.image[view.class_id == SKY_CLASS].astype(int)
            assert len(sky) == 0 or ((sky[:, 2] > 180).all() and (sky[:, 2] >= sky[:, 0]).all())
            assert len(np.unique(view.image.reshape(-1, 3), axis=0)) > 100
    agree, seen = np.concatenate(agreeing), np.concatenate(visible)
    assert len(agree) > 80_000
    assert agree.mean() > 0.92 and agree[seen].mean() > 0.975
    for name in ("road", "sidewalk", "building", "pole", "vegetation", "terrain", "person", "car"):
        assert points[CLASS_IDS[name]] > 100 and pixels[CLASS_IDS[name]] > 200, name
    for name in ("traffic light", "traffic sign"):
        assert points[CLASS_IDS[name]] > 5 and pixels[CLASS_IDS[name]] > 20, name
    assert points[SKY_CLASS] == 0 and pixels[SKY_CLASS] > 10_000


def test_intrinsics_follow_the_size() -> None:
    for mount in sensors.CALIBRATED_MOUNTS:
        large, small = sensors.mounted_camera(mount, 1600, 900), sensors.mounted_camera(mount, 400, 225)
        assert large.intrinsics[0, 0] == (809 if mount.name == "CAM_BACK" else pytest.approx(1266, abs=10))
        np.testing.assert_allclose(small.intrinsics[:2], large.intrinsics[:2] / 4)
        np.testing.assert_allclose(
            large.T_lidar_from_camera[:3, :3] @ large.T_camera_from_lidar[:3, :3], np.eye(3), atol=1e-12
        )
        ahead = sensors.T_EGO_FROM_LIDAR[:3, :3] @ large.T_lidar_from_camera[:3, 2]
        np.testing.assert_allclose(np.rad2deg(np.arcsin(ahead[2])), mount.pitch_deg, atol=1e-9)


def test_occlusion_and_sparseness_are_those_that_the_paper_describes(drive: Drive) -> None:
    """Many boxes hold fewer than five points; some points lie behind what their pixel shows."""
    shadowed = projected = 0
    num_points = []
    for number, time_us in enumerate(map(int, drive.keyframe_us)):
        sweep = drive.scan(time_us)
        T_lidar_from_world = invert_rigid(drive.T_world_from_ego(time_us) @ sensors.T_EGO_FROM_LIDAR)
        found = candidates(drive.actors, time_us, T_lidar_from_world, sweep.points)
        num_points.append({candidate.actor.instance: candidate.num_points for candidate in found})
        if number % 13:
            continue
        returned = (sweep.category != NOISE) & (sweep.category != EGO)
        world = in_world(drive, time_us, sweep.points[returned])
        for mount in sensors.CALIBRATED_MOUNTS:
            camera_us = time_us + drive.camera_offsets_us[mount.name]
            view, camera = drive.view(mount, camera_us), sensors.mounted_camera(mount, 400, 225)
            T_lidar_from_world = invert_rigid(drive.T_world_from_ego(camera_us) @ sensors.T_EGO_FROM_LIDAR)
            uv, z_depth_m = camera.project(transform_points(T_lidar_from_world, world))
            inside = camera.in_image(uv, z_depth_m)
            u, v = uv[inside].astype(int).T
            behind = z_depth_m[inside] - view.depth_m[v, u]
            shadowed, projected = shadowed + (behind > 0.5 + 0.02 * z_depth_m[inside]).sum(), projected + inside.sum()
    boxes_ = [num_points[k][who] for who, keyframes in annotated_keyframes(num_points).items() for k in keyframes]
    assert 30 < len(boxes_) / len(drive.keyframe_us) < 150
    assert 0.3 < np.mean(np.array(boxes_) < 5) < 0.65
    assert 0.01 < shadowed / projected < 0.12


# Determinism and errors


def digest(drive: Drive) -> str:
    time_us = int(drive.keyframe_us[1])
    view = drive.view(sensors.CALIBRATED_MOUNTS[3], time_us, 96, 54)
    poses = [actor.pose(time_us) for actor in drive.actors]
    arrays = [*drive.scan(time_us), *view, np.array(poses), drive.sun, *drive.town.polygons["walkway"]]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def test_another_process_makes_the_same_bits() -> None:
    program = (
        "from test_drive import digest\nfrom pred.data.world import Drive\nprint(digest(Drive(5, 3, keyframes=2)))"
    )
    output = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment()
    ).stdout
    drive = Drive(5, 3, keyframes=2)
    drive.view(sensors.CALIBRATED_MOUNTS[0], int(drive.keyframe_us[0]), 32, 18)  # the order of calls does not matter
    assert output.strip() == digest(drive)
    assert digest(Drive(5, 4, keyframes=2)) != digest(drive) != digest(Drive(6, 3, keyframes=2))


def environment() -> dict[str, str]:
    import os
    from pathlib import Path as File

    here = File(__file__).parent
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(here), str(here.parent.parent)])}


def test_bad_arguments(drive: Drive) -> None:
    with pytest.raises(ValueError, match="drive: index must be at least 0, got -1"):
        Drive(0, -1)
    with pytest.raises(ValueError, match=r"drive: keyframes must be in \[1, 1000\], got 0"):
        Drive(0, 0, keyframes=0)
    with pytest.raises(ValueError, match=r"drive: keyframe must be in \[0, 40\), got 40"):
        drive.sweep_us(40)
    late = drive.end_us + 1
    with pytest.raises(
        ValueError, match=rf"drive: time_us must be in \[{drive.start_us}, {drive.end_us}\], got {late}"
    ):
        drive.scan(late)
    camera = sensors.mounted_camera(sensors.CALIBRATED_MOUNTS[0], 160, 90)
    with pytest.raises(ValueError, match="camera must have the size of the picture, 400 x 225, got 160 x 90"):
        drive.view(camera, int(drive.keyframe_us[0]))
