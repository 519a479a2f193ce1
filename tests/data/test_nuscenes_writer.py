# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A written world is read and evaluated by the official devkit, and comes out the same after any number of kills."""

from __future__ import annotations

import fcntl
import hashlib
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pred import cli
from pred.data.frame import Camera
from pred.data.nuscenes import NuScenesFrames
from pred.data.world.nuscenes_writer import (
    ATTRIBUTES,
    CATEGORIES,
    LOCATIONS,
    MINI_SCENES,
    MINI_VAL,
    REGION_M,
    REGIONS,
    WorldSettings,
    _Picture,
    _visible_shares,
    encode_depth,
    make_token,
)
from pred.data.world.sensors import CALIBRATED_MOUNTS, T_EGO_FROM_LIDAR, mounted_camera
from pred.run_folder import RunFolderError
from pred.world import make_world
from tests.data.fake_drive import (
    ACTORS,
    BEHIND_TRUCK,
    HIDDEN,
    LATE_AND_GAPPED,
    NUM_GROUND,
    NUM_NO_RETURN,
    POINTS_PER_ACTOR,
    FakeActor,
    FakeDrive,
    FakeView,
    LargeTownDrive,
    MisnamedDrive,
    SlowDrive,
)
from tests.data.official_evaluation import check_perturbed, evaluate, evaluate_true_lidarseg

SCENES, KEYFRAMES, SEED = 2, 4, 7
WIDTH, HEIGHT = 80, 45
SETTINGS = WorldSettings(scenes=SCENES, seed=SEED, keyframes=KEYFRAMES, image_scale=0.05, exact_labels=True)
SMALL = WorldSettings(scenes=2, seed=SEED, keyframes=2, image_scale=0.02)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    make_world(folder, SETTINGS, workers=1, make_drive=FakeDrive)
    return folder


@pytest.fixture(scope="module")
def devkit(root: Path) -> Any:
    nuscenes = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
    return nuscenes.NuScenes("v1.0-world", str(root), verbose=False)


def table(root: Path, name: str, version: str = "v1.0-world") -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((root / version / f"{name}.json").read_text())
    return rows


def tree(root: Path) -> dict[str, str]:
    """Digest of every file, hidden ones included."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def kill_at_random(command: list[str], out: Path, times: int, seed: int) -> None:
    """Start a command so many times and SIGKILL its processes, up to 0.5 s after it has written data to ``out``.

    At least one kill must come before its end.
    """
    rng = random.Random(seed)
    killed = 0
    for _ in range(times):
        before = num_files(out)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
        deadline = time.monotonic() + 60
        while num_files(out) == before and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
    assert killed > 0


def num_files(folder: Path) -> int:
    """Files of data, at any depth. A folder that is renamed while it is read is passed over (``rglob`` would raise)."""
    return sum(name.endswith((".bin", ".jpg", ".png")) for _, _, names in os.walk(folder) for name in names)


# Files


def test_files(root: Path) -> None:
    assert {path.name for path in root.iterdir()} == {
        "world.json", "v1.0-world", "samples", "sweeps", "maps", "lidarseg", "pseudo", "depth",
    }  # fmt: skip
    keyframes = SCENES * KEYFRAMES
    counts = {
        "samples/LIDAR_TOP/*.pcd.bin": keyframes,
        "sweeps/LIDAR_TOP/*.pcd.bin": SCENES * (10 + 9 * (KEYFRAMES - 1)),
        "samples/CAM_*/*.jpg": 6 * keyframes,
        "sweeps/CAM_*/*.jpg": 0,
        "lidarseg/v1.0-world/*_lidarseg.bin": keyframes,
        "pseudo/exact/CAM_*/*.png": 6 * keyframes,
        "depth/exact/CAM_*/*.png": 6 * keyframes,
        "maps/expansion/*.json": 4,
        "maps/*.png": SCENES,
        "v1.0-world/*.json": 15,
    }
    assert {pattern: len(list(root.glob(pattern))) for pattern in counts} == counts
    first = FakeDrive(SEED, 0).keyframe_us[0]
    lidar = root / "samples" / "LIDAR_TOP" / f"world7-0000__LIDAR_TOP__{first}.pcd.bin"
    sweep = FakeDrive(SEED, 0).scan(int(first))
    np.testing.assert_array_equal(np.fromfile(lidar, "<f4").reshape(-1, 5), sweep.points)
    image = root / "samples" / "CAM_FRONT" / f"world7-0000__CAM_FRONT__{first - 35_000}.jpg"
    with Image.open(image) as opened:
        assert (opened.size, opened.mode, opened.format) == ((WIDTH, HEIGHT), "RGB", "JPEG")
    with Image.open(root / "pseudo" / "exact" / "CAM_FRONT" / f"{image.stem}.png") as label:
        assert (label.size, label.mode) == ((WIDTH, HEIGHT), "L")
        view = FakeDrive(SEED, 0).view(CALIBRATED_MOUNTS[0], int(first) - 35_000, WIDTH, HEIGHT)
        np.testing.assert_array_equal(np.asarray(label), view.class_id)
    with Image.open(root / "depth" / "exact" / "CAM_FRONT" / f"{image.stem}.png") as depth:
        assert (depth.size, depth.mode) == ((WIDTH, HEIGHT), "I;16")
        np.testing.assert_array_equal(np.asarray(depth), encode_depth(view.depth_m))


def test_depth_is_stored_as_in_the_kitti_benchmark() -> None:
    """256 steps a metre; none for the sky and beyond 255 m."""
    depth_m = np.array([[1.0, 2.5 / 256, 254.9999, 255.0, 255.01, np.inf]], dtype=np.float32)
    encoded = encode_depth(depth_m)
    assert encoded.dtype == np.uint16
    assert encoded.tolist() == [[256, 2, 65280, 65280, 0, 0]]


def test_tables_are_consistent(root: Path) -> None:
    tokens: dict[str, set[str]] = {}
    for path in (root / "v1.0-world").glob("*.json"):
        if path.stem != "splits":
            rows = table(root, path.stem)
            tokens[path.stem] = {row["token"] for row in rows}
            assert len(tokens[path.stem]) == len(rows) > 0, path
            if path.stem != "visibility":
                assert all(re.fullmatch("[0-9a-f]{32}", token) for token in tokens[path.stem]), path
    assert tokens["ego_pose"] == tokens["sample_data"] >= tokens["lidarseg"]
    assert [row["name"] for row in table(root, "category")] == list(CATEGORIES)
    assert [row["index"] for row in table(root, "category")] == list(range(32))
    assert [row["name"] for row in table(root, "attribute")] == list(ATTRIBUTES)
    for row in table(root, "sample_data"):
        assert (root / row["filename"]).is_file()
        assert {row["sample_token"]} <= tokens["sample"]
        assert (row["width"], row["height"]) == ((0, 0) if row["fileformat"] == "pcd" else (WIDTH, HEIGHT))
    splits = json.loads((root / "v1.0-world" / "splits.json").read_text())
    assert splits["all"] == [row["name"] for row in table(root, "scene")] == ["world-7-0000", "world-7-0001"]
    assert splits["train"] == splits["world_train"] == ["world-7-0000"]
    assert splits["val"] == splits["world_val"] == ["world-7-0001"]


def test_categories_and_attributes_are_the_official_ones() -> None:
    color_map = pytest.importorskip("nuscenes.utils.color_map", reason="nuscenes-devkit is not installed")
    assert list(color_map.get_colormap()) == list(CATEGORIES)
    splits = pytest.importorskip("nuscenes.utils.splits")
    assert sorted(splits.mini_train + splits.mini_val) == list(MINI_SCENES)
    assert splits.mini_val == list(MINI_VAL)
    utils = pytest.importorskip("nuscenes.eval.detection.utils")
    names = {utils.category_to_detection_name(category) for category, *_ in ACTORS}
    assert len(names) == 10
    relevant = {name for detection in names for name in utils.detection_name_to_rel_attributes(detection)}
    assert relevant == set(ATTRIBUTES)


def test_sweep_images(tmp_path: Path) -> None:
    settings = WorldSettings(scenes=1, seed=SEED, keyframes=2, image_scale=0.02, sweep_images=True)
    make_world(tmp_path, settings, workers=1, make_drive=FakeDrive)
    rows = [row for row in table(tmp_path, "sample_data") if "CAM_BACK__" in row["filename"]]
    assert len(rows) == 11 + 10 and sum(row["is_key_frame"] for row in rows) == 2
    assert all((tmp_path / row["filename"]).is_file() for row in rows)
    assert [row["prev"] for row in rows] == ["", *(row["token"] for row in rows[:-1])]
    assert len(list((tmp_path / "sweeps" / "CAM_BACK").iterdir())) == 19


def test_regions_lie_inside_the_official_maps_and_apart() -> None:
    assert len(set(REGIONS)) == len(REGIONS) == 108
    for region in REGIONS:
        location = LOCATIONS[region.location]
        assert 0 <= region.x_m <= location.width_m - REGION_M
        assert 0 <= region.y_m <= location.height_m - REGION_M
        assert region.x_m % REGION_M == region.y_m % REGION_M == 0


def test_tokens_are_a_function_of_their_key() -> None:
    assert make_token(1, 2, "sample", 3) == hashlib.blake2b(b"1/2/sample/3", digest_size=16).hexdigest()
    assert len({make_token(1, 23), make_token(12, 3), make_token(1, 2, 3)}) == 3


# The reader


def test_own_reader(root: Path) -> None:
    frames = NuScenesFrames(root)
    assert len(frames) == SCENES * KEYFRAMES
    for scene in range(SCENES):
        drive = FakeDrive(SEED, scene, KEYFRAMES)
        for number in range(KEYFRAMES):
            frame = frames.load(scene * KEYFRAMES + number)
            assert frame.token == make_token(SEED, scene, "sample", number)
            times = np.unique(frame.points[:, 4])
            np.testing.assert_allclose(times, 0.05 * np.arange(10), atol=1e-6)
            sweep = drive.scan(int(drive.keyframe_us[number]))
            own = frame.points[frame.is_keyframe]
            np.testing.assert_array_equal(own[:, :4], sweep.points[frame.point_index[frame.is_keyframe], :4])
            assert len(own) == len(sweep.points) - NUM_NO_RETURN
            assert [camera.name for camera in frame.cameras] == sorted(mount.name for mount in CALIBRATED_MOUNTS)
            for camera in frame.cameras:
                assert camera.load_image().shape == (HEIGHT, WIDTH, 3)
                mount = next(mount for mount in CALIBRATED_MOUNTS if mount.name == camera.name)
                np.testing.assert_allclose(camera.intrinsics, mounted_camera(mount, WIDTH, HEIGHT).intrinsics)
                assert camera.labels is not None
                time_us = int(drive.keyframe_us[number]) + drive.camera_offsets_us[camera.name]
                view = drive.view(mount, time_us, WIDTH, HEIGHT)
                np.testing.assert_array_equal(camera.labels.class_map(), view.class_id)


def test_points_of_static_objects_stay_in_their_boxes_over_ten_sweeps(root: Path) -> None:
    frame = NuScenesFrames(root).load(1)
    assert frame.boxes is not None
    for name, count in (("vehicle.bus.rigid", 10 * POINTS_PER_ACTOR), ("animal", POINTS_PER_ACTOR)):
        box = frame.boxes.names.index(name)
        offset = frame.points[:, :3] - frame.boxes.centre_m[box]
        c, s = np.cos(frame.boxes.yaw_rad[box]), np.sin(frame.boxes.yaw_rad[box])
        local = np.stack([offset[:, :2] @ [c, s], offset[:, :2] @ [-s, c], offset[:, 2]], axis=1)
        assert (np.abs(local) <= frame.boxes.size_m[box] / 2).all(axis=1).sum() == count


def test_splits_select_scenes(root: Path) -> None:
    assert len(NuScenesFrames(root, split="val")) == KEYFRAMES
    assert NuScenesFrames(root, split="world_val").token(0) == make_token(SEED, 1, "sample", 0)


# The devkit


def test_devkit_poses_and_boxes(devkit: Any) -> None:
    geometry = pytest.importorskip("nuscenes.utils.geometry_utils")
    assert [scene["nbr_samples"] for scene in devkit.scene] == [KEYFRAMES] * SCENES
    for scene_number, scene in enumerate(devkit.scene):
        drive = FakeDrive(SEED, scene_number, KEYFRAMES)
        actors = {make_token(SEED, scene_number, "instance", actor.instance): actor for actor in drive.actors}
        token = scene["first_sample_token"]
        for number in range(KEYFRAMES):
            sample = devkit.get("sample", token)
            assert sample["timestamp"] == drive.keyframe_us[number]
            path, boxes, _ = devkit.get_sample_data(sample["data"]["LIDAR_TOP"])
            points = np.fromfile(path, np.float32).reshape(-1, 5)[:, :3]
            T_lidar_from_world = np.linalg.inv(drive.T_world_from_ego(sample["timestamp"]) @ T_EGO_FROM_LIDAR)
            for box in boxes:
                annotation = devkit.get("sample_annotation", box.token)
                actor = actors[annotation["instance_token"]]
                T_lidar_from_box = T_lidar_from_world @ actor.pose(sample["timestamp"])
                np.testing.assert_allclose(box.center, T_lidar_from_box[:3, 3], atol=1e-9)
                np.testing.assert_allclose(box.rotation_matrix, T_lidar_from_box[:3, :3], atol=1e-9)
                assert box.wlh.tolist() == [actor.size_lwh_m[axis] for axis in (1, 0, 2)]
                count = geometry.points_in_box(box, points.T).sum()
                assert annotation["num_lidar_pts"] == count == drive.num_points(actor, sample["timestamp"])
                assert [devkit.get("attribute", t)["name"] for t in annotation["attribute_tokens"]] == (
                    [actor.name] if actor.name else []
                )
                if actor.instance != LATE_AND_GAPPED:
                    velocity = devkit.box_velocity(box.token)
                    np.testing.assert_allclose(velocity, actor.velocity(0), atol=1e-6)
            token = sample["next"]
        assert token == ""


def test_boxes_cover_a_track_from_its_first_return_to_its_last(devkit: Any) -> None:
    tracks: dict[str, list[int]] = {}
    scene_samples = [make_token(SEED, 0, "sample", number) for number in range(KEYFRAMES)]
    for number, token in enumerate(scene_samples):
        for annotation in devkit.get("sample", token)["anns"]:
            tracks.setdefault(devkit.get("sample_annotation", annotation)["instance_token"], []).append(number)
    assert make_token(SEED, 0, "instance", HIDDEN) not in tracks
    assert tracks[make_token(SEED, 0, "instance", LATE_AND_GAPPED)] == [1, 2, 3]
    assert tracks[make_token(SEED, 0, "instance", 1)] == [0, 1, 2, 3]
    assert len(tracks) == len(ACTORS) + 2
    gapped = devkit.get("instance", make_token(SEED, 0, "instance", LATE_AND_GAPPED))
    token, counts = gapped["first_annotation_token"], []
    while token:
        counts.append(devkit.get("sample_annotation", token)["num_lidar_pts"])
        token = devkit.get("sample_annotation", token)["next"]
    assert counts == [POINTS_PER_ACTOR, 0, POINTS_PER_ACTOR] and gapped["nbr_annotations"] == 3


def test_visibility(devkit: Any) -> None:
    """The car behind the truck shows little of itself; the one in the open all."""

    def level(instance: int) -> str:
        token = devkit.get("instance", make_token(SEED, 0, "instance", instance))["first_annotation_token"]
        annotation = devkit.get("sample_annotation", token)
        return str(devkit.get("visibility", annotation["visibility_token"])["level"])

    assert level(1) == "v80-100"
    assert level(BEHIND_TRUCK) == "v0-40"


@pytest.mark.parametrize(("depth_m", "share"), [(5.0, 0.5), (9.5, 1.0), (np.inf, 1.0)])
def test_share_of_visible_pixels(depth_m: float, share: float) -> None:
    """A cube of 2 m, 10 m ahead, fills 22.2 pixels each way; something covers columns up to its middle."""
    intrinsics = np.array([[100.0, 0.0, 100.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
    camera = Camera("CAM", intrinsics, np.eye(4), 200, 100)
    actor: Any = FakeActor(3, "vehicle.car", (2.0, 2.0, 2.0), (0.0, 0.0), 0.0, 0.0, "", 0)
    T_camera_from_world = np.eye(4)
    T_camera_from_world[2, 3] = 9.0  # the actor stands on the plane z = 0, its centre 1 m above
    view: Any = FakeView(
        np.zeros((100, 200, 3), np.uint8),
        np.zeros((100, 200), np.uint8),
        np.zeros((100, 200), np.int32),
        np.full((100, 200), np.inf, np.float32),
    )
    view.instance[39:62, 100:112] = 3
    view.depth_m[39:62, 100:112] = 9.0
    view.depth_m[:, :100] = depth_m
    picture = _Picture(view, camera, T_camera_from_world, 0)
    assert _visible_shares([picture], [actor])[0] == pytest.approx(share, abs=0.03)
    T_camera_from_world[2, 3] = -0.5  # reaches behind the camera: only what shows counts
    assert _visible_shares([picture], [actor]) == [1.0]
    assert _visible_shares([], [actor]) == [0.0]


def test_devkit_walks_ten_sweeps(devkit: Any) -> None:
    data_classes = pytest.importorskip("nuscenes.utils.data_classes")
    sample = devkit.get("sample", make_token(SEED, 1, "sample", 2))
    cloud, age = data_classes.LidarPointCloud.from_file_multisweep(
        devkit, sample, "LIDAR_TOP", "LIDAR_TOP", nsweeps=10, min_distance=1.0
    )
    np.testing.assert_allclose(np.unique(age), 0.05 * np.arange(10), atol=1e-6)
    assert (cloud.points[2] < -1.0).sum() >= 10 * NUM_GROUND
    # The ground of all sweeps lies in one plane, and each sweep's points were moved by the way driven since.
    assert np.ptp(np.sort(cloud.points[2])[: 10 * NUM_GROUND]) < 1e-3


def test_cameras_see_the_points(devkit: Any) -> None:
    """Points of the parked truck land on its pixels, through the pose of either time."""
    sample = devkit.get("sample", make_token(SEED, 0, "sample", 3))
    drive = FakeDrive(SEED, 0, KEYFRAMES)
    sweep = drive.scan(sample["timestamp"])
    hits = 0
    for mount in CALIBRATED_MOUNTS:
        camera_token = sample["data"][mount.name]
        uv, depth, _ = devkit.explorer.map_pointcloud_to_image(sample["data"]["LIDAR_TOP"], camera_token)
        view = drive.view(mount, devkit.get("sample_data", camera_token)["timestamp"], WIDTH, HEIGHT)
        assert uv.shape[1] == len(depth)
        columns, rows = uv[:2].astype(int)
        hits += int((view.instance[rows, columns] == 2).sum())
    assert hits >= (sweep.instance == 2).sum()


def test_intersections(root: Path) -> None:
    """The first of each town's two road segments."""
    for location in list(LOCATIONS)[:SCENES]:
        expansion = json.loads((root / "maps" / "expansion" / f"{location}.json").read_text())
        assert [row["is_intersection"] for row in expansion["road_segment"]] == [True, False]


def test_maps(root: Path, devkit: Any) -> None:
    map_api = pytest.importorskip("nuscenes.map_expansion.map_api")
    for location in LOCATIONS:
        assert map_api.NuScenesMap(str(root), location).version == "1.3"
    assert [devkit.get("log", scene["log_token"])["location"] for scene in devkit.scene] == list(LOCATIONS)[:2]
    for scene in range(SCENES):
        sample = devkit.get("sample", make_token(SEED, scene, "sample", 0))
        log = devkit.get("log", devkit.get("scene", sample["scene_token"])["log_token"])
        pose = devkit.get("ego_pose", sample["data"]["LIDAR_TOP"])
        x, y = pose["translation"][:2]
        # The town reaches from (-60, -60) to (120, 60) in coordinates in which the drive starts at the origin.
        np.testing.assert_allclose([x, y], [REGION_M / 2 - 30, REGION_M / 2], atol=1e-9)
        mask = devkit.get("map", log["map_token"])["mask"]
        places = np.array([[0, 0], [59.5, 59.5], [100, 9.5], [100, 10.5], [60.5, 20], [-59.5, -59.5], [-60.5, 0]])
        inside = mask.is_on_mask(*(places + [x, y]).T)
        assert inside.tolist() == [True, True, True, False, False, True, False]

        town = map_api.NuScenesMap(str(root), log["location"])
        layers = {
            "drivable_area": 120 * 120 + 60 * 20,
            "road_segment": 20 * 20 + 60 * 20,
            "road_block": 60 * 10,
            "lane": 60 * 10,
            "ped_crossing": 4 * 20,
            "walkway": 60 * 4,
            "stop_line": 10,
            "carpark_area": 20 * 20,
        }
        for layer, area in layers.items():
            key = "polygon_tokens" if layer == "drivable_area" else "polygon_token"
            tokens = np.ravel([record[key] for record in getattr(town, layer)])
            polygons = [town.extract_polygon(token) for token in tokens]
            assert sum(polygon.area for polygon in polygons) == pytest.approx(area), layer
            assert all(polygon.exterior.is_ccw for polygon in polygons)
        patch = (x + 30, y, 120, 180)
        masks = town.get_map_mask(patch, 0, list(layers), (1200, 1800))
        for layer, area, found in zip(layers, layers.values(), masks.sum(axis=(1, 2)) / 100, strict=True):
            # The devkit counts the pixels on both rims of a polygon.
            assert area <= found <= 1.15 * area, layer
        dividers = town.get_map_mask(patch, 0, ["road_divider", "lane_divider"], (480, 720))
        assert (dividers.sum(axis=(1, 2)) > 200).all()
        assert town.layers_on_point(x + 62, y - 2)["ped_crossing"] != ""
        assert town.layers_on_point(x + 62, y - 30)["drivable_area"] == ""


# Official evaluation


@pytest.mark.parametrize("split", ["all", "world_val"])
def test_perfect_predictions(devkit: Any, split: str, tmp_path: Path) -> None:
    found = evaluate(devkit, split, tmp_path, lambda box: None)
    assert found["mean_ap"] == pytest.approx(1.0, abs=1e-6)
    assert found["nd_score"] == pytest.approx(1.0, abs=1e-6)
    assert all(error == pytest.approx(0.0, abs=1e-6) for error in found["tp_errors"].values())


def test_perturbed_predictions(devkit: Any, tmp_path: Path) -> None:
    check_perturbed(devkit, tmp_path, shift_m=0.3)


def test_mini_names_and_lidarseg_evaluation(tmp_path: Path) -> None:
    settings = WorldSettings(scenes=10, seed=3, keyframes=1, image_scale=0.02, version="v1.0-mini")
    make_world(tmp_path / "world", settings, workers=1, make_drive=FakeDrive)
    nuscenes = pytest.importorskip("nuscenes.nuscenes", reason="nuscenes-devkit is not installed")
    devkit = nuscenes.NuScenes("v1.0-mini", str(tmp_path / "world"), verbose=False)
    assert {scene["name"] for scene in devkit.scene} == set(MINI_SCENES)
    assert len(devkit.lidarseg) == 10
    for split in ("mini_train", "mini_val"):
        found = evaluate_true_lidarseg(devkit, split, tmp_path)
        assert found["miou"] == 1.0
        assert [name for name, iou in found["iou_per_class"].items() if np.isnan(iou)] == ["ignore"]
        assert len(NuScenesFrames(tmp_path / "world", split=split)) == (8 if split == "mini_train" else 2)


# Kills


def die_at_replacement(out: Path, settings: WorldSettings, number: int) -> None:
    """Make a world, but end without warning at the ``number``-th replacement of a file: before it if even."""
    replace, count = os.replace, 0

    def counted(*arguments: Any) -> None:
        nonlocal count
        count += 1
        if count == number and number % 2 == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*arguments)
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = counted  # type: ignore[assignment]
    make_world(out, settings, workers=1, make_drive=FakeDrive)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of a small world that was made in one go."""
    folder = tmp_path_factory.mktemp("small")
    make_world(folder, SMALL, workers=1, make_drive=FakeDrive)
    return tree(folder)


@pytest.mark.parametrize("numbers", [(1, 2, 3, 40, 20, 17, 5, 33), (94, 15, 4, 8, 12, 1, 2, 16)])
def test_killed_at_any_file(small: dict[str, str], tmp_path: Path, numbers: tuple[int, ...]) -> None:
    out = tmp_path / "world"
    context = multiprocessing.get_context("fork")
    killed = 0
    for number in numbers:
        process = context.Process(target=die_at_replacement, args=(out, SMALL, number))
        process.start()
        process.join(60)
        killed += process.exitcode == -signal.SIGKILL
        version = out / SMALL.version
        assert not version.exists() or len(list(version.glob("*.json"))) == 15
        for name, digest in tree(out).items():
            if not name.endswith(".partial") and name in small:
                assert digest == small[name], name
    assert killed >= 6
    make_world(out, SMALL, workers=1, make_drive=FakeDrive)
    assert tree(out) == small


def test_kill_between_the_tables_and_the_end(small: dict[str, str], tmp_path: Path, monkeypatch: Any) -> None:
    out = tmp_path / "world"
    with monkeypatch.context() as patch:
        patch.setattr("pred.world.write_dataset", lambda *arguments: list(arguments[2]) and 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make_world(out, SMALL, workers=1, make_drive=FakeDrive)
    parts = shutil.copytree(out / ".parts", tmp_path / "parts")
    make_world(out, SMALL, workers=1, make_drive=FakeDrive)
    assert tree(out) == small
    shutil.copytree(parts, out / ".parts")
    make_world(out, SMALL, workers=1, make_drive=FakeDrive)
    assert tree(out) == small


PROGRAM = """
import sys
from pathlib import Path
from pred.data.world.nuscenes_writer import WorldSettings
from pred.world import make_world
from tests.data.fake_drive import SlowDrive
settings = WorldSettings(scenes=2, seed=7, keyframes=2, image_scale=0.02)
make_world(Path(sys.argv[1]), settings, workers=2, make_drive=SlowDrive)
"""


def test_two_workers_killed_and_continued(small: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / "world"
    # The first keyframe's files show that the workers are at work.
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(out)], start_new_session=True)
    wait_for(lambda: len(list(out.rglob("*.pcd.bin"))) > 5)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    wait_for(lambda: not any_process_of(process.pid))
    assert not (out / SMALL.version).exists()
    for name, digest in tree(out).items():
        assert name.endswith(".partial") or name.startswith(".parts/") or digest == small[name], name
    make_world(out, SMALL, workers=2, make_drive=SlowDrive)
    assert tree(out) == small


def wait_for(condition: Any) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def any_process_of(session: int) -> bool:
    try:
        os.killpg(session, 0)
    except ProcessLookupError:
        return False
    return True


# Refusals


def test_complete_world_is_left_alone(root: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    make_world(root, SETTINGS, workers=1, make_drive=FakeDrive)
    assert "the world is complete; nothing to do" in capfd.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seed": 8}, r"seed must be 7 as in world\.json, got 8"),
        ({"scenes": 3}, r"scenes must be 2 as in world\.json, got 3"),
        ({"image_scale": 0.1}, r"image_scale must be 0\.05 as in world\.json, got 0\.1"),
        ({"exact_labels": False}, r"exact_labels must be True as in world\.json, got False"),
    ],
)
def test_other_settings_are_refused(root: Path, change: dict[str, Any], text: str) -> None:
    before = tree(root)
    with pytest.raises(RunFolderError, match=text):
        make_world(root, WorldSettings(**{**vars(SETTINGS), **change}), workers=1, make_drive=FakeDrive)
    assert tree(root) == before


def test_foreign_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunFolderError, match=r"must be new or empty, or hold world\.json, got file"):
        make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    with pytest.raises(RunFolderError, match="file: must be a folder, got a file"):
        make_world(tmp_path / "file", SMALL, workers=1, make_drive=FakeDrive)
    interrupted = tmp_path / "interrupted"
    with pytest.raises(ValueError, match="category and attribute of actor 1 must be official names"):
        make_world(interrupted, SMALL, workers=1, make_drive=MisnamedDrive)
    (interrupted / "notes.txt").touch()
    with pytest.raises(RunFolderError, match=r"must hold nothing but the interrupted world, got notes\.txt"):
        make_world(interrupted, SMALL, workers=1, make_drive=FakeDrive)
    (interrupted / "notes.txt").unlink()
    (interrupted / "world.json").write_text("{")
    with pytest.raises(RunFolderError, match=r"world\.json: must be the settings of the job, got no valid JSON"):
        make_world(interrupted, SMALL, workers=1, make_drive=FakeDrive)


def test_second_writer_is_refused(tmp_path: Path) -> None:
    """The lock lasts as long as its holder: a killed one leaves nothing that blocks."""
    folder = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    try:
        with pytest.raises(RunFolderError, match="must have one writer, got another process"):
            make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    finally:
        os.close(folder)
    assert list(tmp_path.iterdir()) == []
    make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)


def test_other_libraries(tmp_path: Path, small: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted world needs the versions it was begun with; a complete one does not mind."""
    with monkeypatch.context() as patch:
        patch.setattr("pred.world.write_dataset", lambda *arguments: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    other = {"embreex": "0.0.1", "numpy": "0.0.1", "pillow": "0.0.1"}
    with monkeypatch.context() as patch:
        patch.setattr("pred.world._libraries", lambda: other)
        with pytest.raises(RunFolderError, match=r"libraries must be .* as in world\.json, got \{'embreex': '0\.0\.1'"):
            make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    assert tree(tmp_path) == small
    monkeypatch.setattr("pred.world._libraries", lambda: other)
    make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)


def test_large_town_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"town must be at most 400 m wide, got 560\.0, 120\.0 m"):
        make_world(tmp_path, SMALL, workers=1, make_drive=LargeTownDrive)


def test_settings_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"scenes must be in \[1, 108\].*got 109; more scenes: a second world"):
        WorldSettings(scenes=109)
    with pytest.raises(ValueError, match="keyframes must be at least 1, got 0"):
        WorldSettings(scenes=1, keyframes=0)
    with pytest.raises(ValueError, match=r"image_scale must be in \[0\.02, 1\], got nan"):
        WorldSettings(scenes=1, image_scale=float("nan"))
    with pytest.raises(ValueError, match="scenes must be 10 for v1.0-mini, got 2"):
        WorldSettings(scenes=2, version="v1.0-mini")
    with pytest.raises(ValueError, match="version must be v1.0-world or v1.0-mini, got 'v1.0-test'"):
        WorldSettings(scenes=2, version="v1.0-test")
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        make_world(Path("nowhere"), SMALL, workers=0, make_drive=FakeDrive)
    assert WorldSettings(scenes=1).splits()["val"] == []
    assert len(WorldSettings(scenes=20).splits()["val"]) == 4


# The command


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    seen: dict[str, Any] = {}
    monkeypatch.setattr("pred.world.make_world", lambda out, settings, workers: seen.update(vars(settings), out=out))
    options = "--scenes 10 --seed 5 --keyframes 3 --image-scale 0.5 --as v1.0-mini --exact-labels --workers 2"
    assert cli.main(["world", "make", str(tmp_path), *options.split()]) == 0
    assert seen == {
        "scenes": 10, "seed": 5, "keyframes": 3, "image_scale": 0.5, "layout": "nuscenes", "version": "v1.0-mini",
        "sweep_images": False, "exact_labels": True, "out": tmp_path,
    }  # fmt: skip
    assert cli.main(["world", "make", str(tmp_path), "--scenes", "0"]) == 1
    assert "scenes must be in [1, 108]" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["world", "make", str(tmp_path), "--scenes", "1", "--image_scale", "1"])
    assert "did you mean --image-scale?" in capfd.readouterr().err


def test_summary(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make_world(tmp_path, SMALL, workers=1, make_drive=FakeDrive)
    text = capfd.readouterr().out
    found = re.search(r"2 scenes, 4 keyframes; 4 made in 0:\d\d, [\d.]+ keyframes/s; ([\d.]+) MB per keyframe", text)
    assert found is not None
    files = [path for folder in ("samples", "sweeps", "lidarseg") for path in (tmp_path / folder).rglob("*.*")]
    num_bytes = sum(path.stat().st_size for path in files if path.is_file())
    assert float(found[1]) == pytest.approx(num_bytes / 4 / 1e6, abs=0.006)


def test_a_procedural_drive_is_written_and_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command on the simulator itself: ten-sweep input from the first keyframe on, and boxes that hold the points
    of what they stand for."""
    out = tmp_path / "world"
    command = ["world", "make", str(out), "--scenes", "1", "--seed", "3", "--keyframes", "1", "--image-scale", "0.1"]
    assert cli.main([*command, "--exact-labels", "--workers", "1"]) == 0
    assert "1 scenes, 1 keyframes" in capsys.readouterr().out
    frame = NuScenesFrames(out, split="all").load(0)
    assert len(np.unique(frame.points[:, 4])) == 10 and frame.boxes is not None
    assert [camera.load_image().shape for camera in frame.cameras] == 6 * [(90, 160, 3)]
    labels = [camera.labels for camera in frame.cameras]
    assert all(label is not None and len(np.unique(label.class_map())) > 3 for label in labels)

    own = frame.points[frame.is_keyframe, :3].astype(np.float64)
    (label_file,) = (out / "lidarseg/v1.0-world").iterdir()
    category = np.fromfile(label_file, dtype=np.uint8)[frame.point_index[frame.is_keyframe]]
    for kind in ("vehicle.car", "vehicle.truck", "human.pedestrian.adult"):
        points = own[category == CATEGORIES.index(kind)]
        inside = np.zeros(len(points), dtype=bool)
        for row in (row for row, name in enumerate(frame.boxes.names) if name == kind):
            cosine, sine = np.cos(frame.boxes.yaw_rad[row]), np.sin(frame.boxes.yaw_rad[row])
            local = (points - frame.boxes.centre_m[row]) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
            inside |= (np.abs(local) <= frame.boxes.size_m[row] / 2 + 0.1).all(axis=1)  # range noise of 2 cm
        assert len(points) > 20 and inside.mean() > 0.99, (kind, len(points), inside.mean())
