# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Drives of the procedural world as a data set in the official nuScenes layout.

`write_keyframe` writes the sensor files of one keyframe and returns its part: what the tables must know of it, in the
drive's own coordinates. `write_dataset` makes maps and tables of all parts. Keyframes can therefore be made in any
order and by any process, and nothing refers to a file that is not there.

Field meanings: docs/schema_nuscenes.md of nuscenes-devkit 1.2; map expansion 1.3: its map_expansion/map_api.py.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from pred.checkpoint import atomic_write, sync_folder, write_text
from pred.data.frame import MIN_PROJECTION_DEPTH_M, Camera, invert_rigid, quaternion_of, transform_points
from pred.data.image_depth import VALUES_PER_M
from pred.data.nuscenes import LIDAR_CHANNEL
from pred.data.world.actors import Actor
from pred.data.world.annotation import annotated_keyframes, candidates
from pred.data.world.drive import CATEGORIES, Drive, View
from pred.data.world.sensors import CALIBRATED_MOUNTS, T_EGO_FROM_LIDAR, mounted_camera
from pred.data.world.town import TownMap

OFFICIAL_IMAGE_SIZES = {"nuscenes": (1600, 900), "once": (1920, 1020)}
JPEG_QUALITY = 90
DEPTH_MAX_M = 255.0
MAX_TOWN_M = 400.0
REGION_M = 475.0
"""Side of the square of map that each scene has to itself. Towns keep 75 m apart: a BEV grid of 100 m x 100 m around a
car at the rim of one, whatever its heading, shows nothing of the next."""
MAP_PIXELS_PER_M = 10

ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider",
    "pedestrian.sitting_lying_down", "pedestrian.standing", "pedestrian.moving",
)  # fmt: skip

VISIBILITY_LEVELS = ("v0-40", "v40-60", "v60-80", "v80-100")
VISIBILITY_BOUNDS = (0.4, 0.6, 0.8)

WORLD_VERSION, MINI_VERSION = "v1.0-world", "v1.0-mini"
MINI_TRAIN = (
    "scene-0061", "scene-0553", "scene-0655", "scene-0757", "scene-0796", "scene-1077", "scene-1094", "scene-1100",
)  # fmt: skip
MINI_VAL = ("scene-0103", "scene-0916")
MINI_SCENES = tuple(sorted(MINI_TRAIN + MINI_VAL))

Part = dict[str, Any]
Row = dict[str, Any]


class _Location(NamedTuple):
    """An official map: size from south-west to north-east, and the name of its mask, which the devkit looks for."""

    width_m: float
    height_m: float
    token: str


LOCATIONS = {
    "singapore-onenorth": _Location(1585.6, 2025.0, "53992ee3023e5494b90c316c183be829"),
    "singapore-hollandvillage": _Location(2808.3, 2922.9, "37819e65e09e5547b8a3ceaefba56bb2"),
    "singapore-queenstown": _Location(3228.6, 3687.1, "93406b464a165eaba6d9de76ca09f5da"),
    "boston-seaport": _Location(2979.5, 2118.1, "36092f0b03a857c6a3403e25b4b7aab3"),
}

POLYGON_LAYERS: dict[str, Row] = {
    "drivable_area": {},
    "road_segment": {"drivable_area_token": ""},
    "road_block": {"from_edge_line_token": "", "to_edge_line_token": "", "road_segment_token": ""},
    "lane": {
        "lane_type": "CAR",
        "from_edge_line_token": "",
        "to_edge_line_token": "",
        "left_lane_divider_segments": [],
        "right_lane_divider_segments": [],
    },
    "ped_crossing": {"road_segment_token": ""},
    "walkway": {},
    "stop_line": {
        "stop_line_type": "STOP_SIGN",
        "ped_crossing_tokens": [],
        "traffic_light_tokens": [],
        "road_block_token": "",
    },
    "carpark_area": {"orientation": 0.0, "road_block_token": ""},
}
"""Layers of the map expansion whose records refer to polygons, with the fields that a town leaves open."""

LINE_LAYERS: dict[str, Row] = {
    "road_divider": {"road_segment_token": ""},
    "lane_divider": {"lane_divider_segments": []},
}


@dataclass(frozen=True)
class WorldSettings:
    """Everything that decides the bytes of a written world.

    Attributes:
        scenes: number of drives.
        seed: draws towns, drives and sensor noise.
        keyframes: keyframes per drive, 2 a second.
        image_scale: size of the images against 1600 x 900 (nuScenes) or 1920 x 1020 (ONCE); the intrinsics follow.
        layout: ``nuscenes`` or ``once``, whose worlds have neither ``version`` nor ``sweep_images``.
        version: name of the table folder: ``v1.0-world``, or ``v1.0-mini``, whose ten scenes bear the official names.
        sweep_images: also write pictures at the times of the LiDAR sweeps between keyframes.
        exact_labels: also write exact class maps as pseudo labels, and exact depth maps.

    Raises:
        ValueError: a value is out of range.
    """

    scenes: int
    seed: int = 0
    keyframes: int = 40
    image_scale: float = 0.25
    layout: str = "nuscenes"
    version: str = WORLD_VERSION
    sweep_images: bool = False
    exact_labels: bool = False

    def __post_init__(self) -> None:
        if self.layout not in OFFICIAL_IMAGE_SIZES:
            raise ValueError(f"world: layout must be {' or '.join(OFFICIAL_IMAGE_SIZES)}, got {self.layout!r}")
        if self.scenes < 1 or (self.layout == "nuscenes" and self.scenes > len(REGIONS)):
            raise ValueError(
                f"world: scenes must be in [1, {len(REGIONS)}], as many towns as the official maps have room for, "
                f"got {self.scenes}; more scenes: a second world with another seed"
            )
        if self.keyframes < 1:
            raise ValueError(f"world: keyframes must be at least 1, got {self.keyframes}")
        if not 0.02 <= self.image_scale <= 1.0:
            raise ValueError(f"world: image_scale must be in [0.02, 1], got {self.image_scale}")
        if self.layout == "once" and (self.version != WORLD_VERSION or self.sweep_images):
            given = "images of sweeps" if self.sweep_images else self.version
            raise ValueError(f"world: layout once must have no version and no images of sweeps, got {given}")
        if self.version not in (WORLD_VERSION, MINI_VERSION):
            raise ValueError(f"world: version must be {WORLD_VERSION} or {MINI_VERSION}, got {self.version!r}")
        if self.version == MINI_VERSION and self.scenes != len(MINI_SCENES):
            raise ValueError(f"world: scenes must be {len(MINI_SCENES)} for {MINI_VERSION}, got {self.scenes}")

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images in pixels."""
        width, height = (round(pixels * self.image_scale) for pixels in OFFICIAL_IMAGE_SIZES[self.layout])
        return width, height

    def scene_name(self, scene: int) -> str:
        return MINI_SCENES[scene] if self.version == MINI_VERSION else f"world-{self.seed}-{scene:04d}"

    def log_name(self, scene: int) -> str:
        """First part of the names of the scene's files."""
        return f"world{self.seed}-{scene:04d}"

    def splits(self) -> dict[str, list[str]]:
        """Scene names by split. The last fifth, but at least one of several scenes, is for validation.

        The devkit keeps the names ``train`` and ``val`` for version v1.0-trainval: its evaluation takes ``world_train``
        and ``world_val``, the same lists.
        """
        names = [self.scene_name(scene) for scene in range(self.scenes)]
        if self.version == MINI_VERSION:
            return {"mini_train": list(MINI_TRAIN), "mini_val": list(MINI_VAL), "all": names}
        num_train = len(names) - max(len(names) // 5, min(1, len(names) - 1))
        train, val = names[:num_train], names[num_train:]
        return {"train": train, "val": val, "all": names, "world_train": train, "world_val": val}


class Region(NamedTuple):
    """The square of an official map that a scene's town is put into; south-west corner in metres."""

    location: str
    x_m: float
    y_m: float

    def offset(self, town: dict[str, Any]) -> NDArray[np.float64]:
        """[3] translation from the town's coordinates to the map's: centre to centre."""
        low, high = _extent(town)
        return np.append(np.array([self.x_m, self.y_m]) + REGION_M / 2 - (low + high) / 2, 0.0)


def _regions() -> list[Region]:
    """All squares in the order of the scenes: the locations take turns, each is filled from its south-west corner."""
    squares = {}
    for name, location in LOCATIONS.items():
        columns, rows = int(location.width_m // REGION_M), int(location.height_m // REGION_M)
        squares[name] = [
            Region(name, column * REGION_M, row * REGION_M) for row in range(rows) for column in range(columns)
        ]
    turns = max(map(len, squares.values()))
    return [of_location[turn] for turn in range(turns) for of_location in squares.values() if turn < len(of_location)]


REGIONS = _regions()


def make_token(*key: int | str) -> str:
    """32 hexadecimal digits: blake2b of the parts of the key."""
    return hashlib.blake2b("/".join(map(str, key)).encode(), digest_size=16).hexdigest()


# One keyframe


def write_keyframe(root: Path, settings: WorldSettings, drive: Drive, scene: int, keyframe: int) -> Part:
    """Write the LiDAR sweeps since the keyframe before, the pictures and the point labels of one keyframe.

    Each file is written under a temporary name, synced and renamed.

    Returns:
        The keyframe's part, of plain values. Poses are those of the drive's own world.

    Raises:
        ValueError: the town is larger than `MAX_TOWN_M`.
    """
    keyframe_us = int(drive.keyframe_us[keyframe])
    sweeps_us = [int(time_us) for time_us in drive.sweep_us(keyframe)]
    files = _Files(root, settings, drive, scene)
    for time_us in sweeps_us:
        sweep = drive.scan(time_us)
        path = files.add(LIDAR_CHANNEL, time_us, is_keyframe=time_us == keyframe_us)
        files.write(path, sweep.points.astype("<f4", copy=False).tobytes())
        if time_us == keyframe_us:
            points = sweep.points
            token = _data_token(settings, scene, LIDAR_CHANNEL, time_us)
            files.write(_lidarseg_file(settings, token), sweep.category.astype(np.uint8, copy=False).tobytes())
    pictures = []
    for time_us in sweeps_us if settings.sweep_images else [keyframe_us]:
        for mount in CALIBRATED_MOUNTS:
            camera_us = time_us + drive.camera_offsets_us[mount.name]
            view = drive.view(mount, camera_us, *settings.image_size)
            path = files.add(mount.name, camera_us, is_keyframe=time_us == keyframe_us)
            files.write_image(path, view.image, format="JPEG", quality=JPEG_QUALITY)
            if time_us != keyframe_us:
                continue
            if settings.exact_labels:
                name = f"exact/{mount.name}/{Path(path).stem}.png"
                files.write_image(f"pseudo/{name}", view.class_id, format="PNG")
                files.write_image(f"depth/{name}", encode_depth(view.depth_m), format="PNG")
            camera = mounted_camera(mount, *settings.image_size)
            T_world_from_lidar = drive.T_world_from_ego(camera_us) @ T_EGO_FROM_LIDAR
            T_camera_from_world = camera.T_camera_from_lidar @ invert_rigid(T_world_from_lidar)
            pictures.append(_Picture(view, camera, T_camera_from_world, camera_us))
    T_lidar_from_world = invert_rigid(drive.T_world_from_ego(keyframe_us) @ T_EGO_FROM_LIDAR)
    found = candidates(drive.actors, keyframe_us, T_lidar_from_world, points)
    shares = _visible_shares(pictures, [candidate.actor for candidate in found])
    part = {
        "time_us": keyframe_us,
        "data": files.data,
        "actors": [
            _actor_part(candidate.actor, keyframe_us, candidate.num_points, share)
            for candidate, share in zip(found, shares, strict=True)
        ],
        "bytes": files.num_bytes,
    }
    if keyframe == 0:
        part["town"] = _town_part(drive.town)
    return part


def encode_depth(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth as the KITTI depth benchmark stores it: 256 steps a metre; 0 for none and for more than `DEPTH_MAX_M`."""
    return np.rint(np.where(depth_m <= DEPTH_MAX_M, depth_m, 0.0) * VALUES_PER_M).astype(np.uint16)


class _Picture(NamedTuple):
    view: View
    camera: Camera
    T_camera_from_world: NDArray[np.float64]
    time_us: int


class _Files:
    """Writes the files of a keyframe below ``root`` and keeps what the table sample_data needs."""

    def __init__(self, root: Path, settings: WorldSettings, drive: Drive, scene: int) -> None:
        self.data: list[Row] = []
        self.num_bytes = 0
        self._root, self._drive = root, drive
        self._log_name = settings.log_name(scene)

    def add(self, channel: str, time_us: int, is_keyframe: bool) -> str:
        """Note a measurement; returns its file name."""
        folder, suffix = "samples" if is_keyframe else "sweeps", "pcd.bin" if channel == LIDAR_CHANNEL else "jpg"
        filename = f"{folder}/{channel}/{self._log_name}__{channel}__{time_us}.{suffix}"
        self.data.append(
            {
                "channel": channel,
                "time_us": time_us,
                "is_keyframe": is_keyframe,
                "filename": filename,
                "ego_pose": _pose_fields(self._drive.T_world_from_ego(time_us)),
            }
        )
        return filename

    def write(self, filename: str, content: bytes) -> None:
        with atomic_write(self._path(filename)) as file:
            file.write(content)
        self.num_bytes += len(content)

    def write_image(self, filename: str, image: NDArray[np.uint8 | np.uint16], **options: Any) -> None:
        with atomic_write(self._path(filename)) as file:
            Image.fromarray(image).save(file, **options)
            self.num_bytes += file.tell()

    def _path(self, filename: str) -> Path:
        path = self._root / filename
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _actor_part(actor: Actor, time_us: int, num_points: int, visible_share: float) -> Row:
    attribute = actor.attribute(time_us)
    if actor.category not in CATEGORIES or (attribute and attribute not in ATTRIBUTES):
        raise ValueError(
            f"world: category and attribute of actor {actor.instance} must be official names, "
            f"got {actor.category!r} and {attribute!r}"
        )
    return {
        "instance": actor.instance,
        "category": actor.category,
        "attribute": attribute,
        "size_lwh_m": list(actor.size_lwh_m),
        "pose": _pose_fields(actor.pose(time_us)),
        "num_lidar_pts": num_points,
        "visibility": 1 + int(np.searchsorted(VISIBILITY_BOUNDS, visible_share, side="right")),
    }


def _visible_shares(pictures: Sequence[_Picture], actors: Sequence[Actor]) -> list[float]:
    """Share of each actor's pixels, over all pictures, that shows the actor: own / (own + hidden).

    Hidden are those pixels inside the outline of its box that show something nearer than the box. What lies outside the
    pictures does not count; an actor in no picture has share 0.
    """
    own, hidden = np.zeros(len(actors)), np.zeros(len(actors))
    largest = max((actor.instance for actor in actors), default=0)
    for picture in pictures:
        shown = np.bincount(picture.view.instance.ravel(), minlength=1 + largest)
        for number, actor in enumerate(actors):
            own[number] += shown[actor.instance]
            hidden[number] += _hidden_pixels(picture, actor)
    shares: list[float] = (own / np.maximum(own + hidden, 1)).tolist()
    return shares


_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def _hidden_pixels(picture: _Picture, actor: Actor) -> int:
    """Pixels inside the outline of a box that show something nearer. Boxes that reach behind the camera have none."""
    view, camera = picture.view, picture.camera
    T_camera_from_box = picture.T_camera_from_world @ actor.pose(picture.time_us)
    corners = transform_points(T_camera_from_box, _CORNERS * actor.size_lwh_m)
    if corners[:, 2].min() < MIN_PROJECTION_DEPTH_M:
        return 0
    uv = corners @ camera.intrinsics.T
    uv = uv[:, :2] / uv[:, 2:]
    left, top = np.floor(uv.min(axis=0)).astype(int).clip(0)
    right, bottom = np.minimum(np.ceil(uv.max(axis=0)).astype(int), (camera.width, camera.height))
    if left >= right or top >= bottom:
        return 0
    outline = Image.new("L", (int(right - left), int(bottom - top)))
    draw = ImageDraw.Draw(outline)
    for face in _FACES:
        draw.polygon([(float(u - left), float(v - top)) for u, v in uv[list(face)]], fill=1)
    window = np.s_[top:bottom, left:right]
    nearer = (view.depth_m[window] < corners[:, 2].min()) & (view.instance[window] != actor.instance)
    return int((nearer & (np.asarray(outline) > 0)).sum())


def _town_part(town: TownMap) -> Row:
    part = {
        "polygons": {layer: [polygon.tolist() for polygon in town.polygons.get(layer, [])] for layer in POLYGON_LAYERS},
        "intersections": [
            number
            for number, segment in enumerate(town.polygons["road_segment"])
            if any(np.array_equal(segment, intersection) for intersection in town.intersections)
        ],
        "lines": {layer: [line.tolist() for line in town.lines.get(layer, [])] for layer in LINE_LAYERS},
    }
    low, high = _extent(part)
    if (high - low > MAX_TOWN_M).any():
        raise ValueError(f"world: town must be at most {MAX_TOWN_M:g} m wide, got {', '.join(map(str, high - low))} m")
    return part


def _extent(town: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """South-west and north-east corner [2] of a town's map."""
    shapes = [shape for kind in ("polygons", "lines") for layer in town[kind].values() for shape in layer]
    points = np.concatenate([np.asarray(shape, dtype=np.float64) for shape in shapes] or [np.zeros((1, 2))])
    return points.min(axis=0), points.max(axis=0)


# The data set


def write_dataset(root: Path, settings: WorldSettings, scenes: Iterable[Sequence[Part]]) -> int:
    """Write the maps and, last and at once, the folder of tables; returns the bytes of all files of the keyframes.

    Args:
        root: the data set.
        settings: those of the parts.
        scenes: parts of all keyframes, scene by scene.
    """
    tables, maps = _Tables(), {location: _Map(location) for location in LOCATIONS}
    _add_fixed_rows(tables, settings)
    logs: dict[str, list[str]] = {}
    num_bytes = 0
    for scene, parts in enumerate(scenes):
        region = REGIONS[scene]
        offset = region.offset(parts[0]["town"])
        maps[region.location].add_town(make_token(settings.seed, scene, "town"), parts[0]["town"], offset)
        logs.setdefault(region.location, []).append(_add_scene(tables, settings, scene, parts, offset))
        num_bytes += sum(part["bytes"] for part in parts)
    for location, log_tokens in logs.items():
        token = LOCATIONS[location].token
        tables.add("map", token=token, category="semantic_prior", filename=f"maps/{token}.png", log_tokens=log_tokens)
    (root / "maps" / "expansion").mkdir(parents=True, exist_ok=True)
    for location, town_map in maps.items():
        write_text(root / "maps" / "expansion" / f"{location}.json", json.dumps(town_map.expansion) + "\n")
        if location in logs:
            with atomic_write(root / "maps" / f"{LOCATIONS[location].token}.png") as file:
                town_map.mask().save(file, format="PNG")
    temporary = root / f".{settings.version}.partial"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    tables.write(temporary)
    write_text(temporary / "splits.json", json.dumps(settings.splits(), indent=2) + "\n")
    temporary.rename(root / settings.version)
    sync_folder(root)
    return num_bytes


class _Tables:
    """Rows of all tables as lines of JSON."""

    NAMES = (
        "category", "attribute", "visibility", "instance", "sensor", "calibrated_sensor", "ego_pose", "log", "scene",
        "sample", "sample_data", "sample_annotation", "map", "lidarseg",
    )  # fmt: skip

    def __init__(self) -> None:
        self._lines: dict[str, list[str]] = {name: [] for name in self.NAMES}

    def add(self, table: str, **row: Any) -> None:
        self._lines[table].append(json.dumps(row, allow_nan=False))

    def write(self, folder: Path) -> None:
        for name, lines in self._lines.items():
            write_text(folder / f"{name}.json", "[\n" + ",\n".join(lines) + "\n]\n")


def _add_fixed_rows(tables: _Tables, settings: WorldSettings) -> None:
    """Rows that all scenes share."""
    for index, name in enumerate(CATEGORIES):
        tables.add("category", token=make_token("category", name), name=name, description="", index=index)
    for name in ATTRIBUTES:
        tables.add("attribute", token=make_token("attribute", name), name=name, description="")
    for number, level in enumerate(VISIBILITY_LEVELS, start=1):
        tables.add("visibility", token=str(number), level=level, description="")
    _add_sensor(tables, LIDAR_CHANNEL, "lidar", T_EGO_FROM_LIDAR, [])
    for mount in CALIBRATED_MOUNTS:
        camera = mounted_camera(mount, *settings.image_size)
        T_ego_from_camera = T_EGO_FROM_LIDAR @ camera.T_lidar_from_camera
        _add_sensor(tables, mount.name, "camera", T_ego_from_camera, camera.intrinsics.tolist())


def _add_sensor(
    tables: _Tables,
    channel: str,
    modality: str,
    T_ego_from_sensor: NDArray[np.float64],
    intrinsics: list[list[float]],
) -> None:
    sensor = make_token("sensor", channel)
    tables.add("sensor", token=sensor, channel=channel, modality=modality)
    tables.add(
        "calibrated_sensor",
        token=make_token("calibrated_sensor", channel),
        sensor_token=sensor,
        **_pose_fields(T_ego_from_sensor),
        camera_intrinsic=intrinsics,
    )


def _add_scene(
    tables: _Tables, settings: WorldSettings, scene: int, parts: Sequence[Part], offset: NDArray[np.float64]
) -> str:
    """Rows of one scene; returns the token of its log."""
    log, scene_token = (make_token(settings.seed, scene, kind) for kind in ("log", "scene"))
    samples = [make_token(settings.seed, scene, "sample", number) for number in range(len(parts))]
    tables.add(
        "log",
        token=log,
        logfile=settings.log_name(scene),
        vehicle="world",
        date_captured=datetime.fromtimestamp(parts[0]["time_us"] // 1_000_000, timezone.utc).date().isoformat(),
        location=REGIONS[scene].location,
    )
    tables.add(
        "scene",
        token=scene_token,
        log_token=log,
        nbr_samples=len(samples),
        first_sample_token=samples[0],
        last_sample_token=samples[-1],
        name=settings.scene_name(scene),
        description=f"Procedural town, seed {settings.seed}, scene {scene}",
    )
    for number, (token, part) in enumerate(zip(samples, parts, strict=True)):
        tables.add(
            "sample",
            token=token,
            timestamp=part["time_us"],
            scene_token=scene_token,
            **_neighbours(samples, number),
        )
    _add_sample_data(tables, settings, scene, samples, parts, offset)
    _add_annotations(tables, settings, scene, samples, parts, offset)
    return log


def _add_sample_data(
    tables: _Tables,
    settings: WorldSettings,
    scene: int,
    samples: Sequence[str],
    parts: Sequence[Part],
    offset: NDArray[np.float64],
) -> None:
    for channel in (LIDAR_CHANNEL, *(mount.name for mount in CALIBRATED_MOUNTS)):
        rows = [
            (sample, row)
            for sample, part in zip(samples, parts, strict=True)
            for row in part["data"]
            if row["channel"] == channel
        ]
        tokens = [_data_token(settings, scene, channel, row["time_us"]) for _, row in rows]
        width, height = (0, 0) if channel == LIDAR_CHANNEL else settings.image_size
        for number, (token, (sample, row)) in enumerate(zip(tokens, rows, strict=True)):
            tables.add("ego_pose", token=token, timestamp=row["time_us"], **_moved(row["ego_pose"], offset))
            tables.add(
                "sample_data",
                token=token,
                sample_token=sample,
                ego_pose_token=token,
                calibrated_sensor_token=make_token("calibrated_sensor", channel),
                timestamp=row["time_us"],
                fileformat="pcd" if channel == LIDAR_CHANNEL else "jpg",
                is_key_frame=row["is_keyframe"],
                height=height,
                width=width,
                filename=row["filename"],
                **_neighbours(tokens, number),
            )
            if channel == LIDAR_CHANNEL and row["is_keyframe"]:
                tables.add("lidarseg", token=token, sample_data_token=token, filename=_lidarseg_file(settings, token))


def _add_annotations(
    tables: _Tables,
    settings: WorldSettings,
    scene: int,
    samples: Sequence[str],
    parts: Sequence[Part],
    offset: NDArray[np.float64],
) -> None:
    actors = [{actor["instance"]: actor for actor in part["actors"]} for part in parts]
    num_points = [{instance: row["num_lidar_pts"] for instance, row in rows.items()} for rows in actors]
    for instance, numbers in annotated_keyframes(num_points).items():
        track = [(number, actors[number][instance]) for number in numbers]
        instance_token = make_token(settings.seed, scene, "instance", instance)
        tokens = [make_token(settings.seed, scene, "annotation", instance, number) for number, _ in track]
        tables.add(
            "instance",
            token=instance_token,
            category_token=make_token("category", track[0][1]["category"]),
            nbr_annotations=len(tokens),
            first_annotation_token=tokens[0],
            last_annotation_token=tokens[-1],
        )
        for position, (token, (number, actor)) in enumerate(zip(tokens, track, strict=True)):
            length, width, height = actor["size_lwh_m"]
            tables.add(
                "sample_annotation",
                token=token,
                sample_token=samples[number],
                instance_token=instance_token,
                visibility_token=str(actor["visibility"]),
                attribute_tokens=[make_token("attribute", actor["attribute"])] if actor["attribute"] else [],
                **_moved(actor["pose"], offset),
                size=[width, length, height],
                num_lidar_pts=actor["num_lidar_pts"],
                num_radar_pts=0,
                **_neighbours(tokens, position),
            )


class _Map:
    """One official map with the towns put into it."""

    def __init__(self, location: str) -> None:
        self._location = LOCATIONS[location]
        self._drivable: list[NDArray[np.float64]] = []
        names = ("polygon", "line", "node", *POLYGON_LAYERS, *LINE_LAYERS, "traffic_light", "lane_connector")
        self.expansion: dict[str, Any] = {
            "version": "1.3",
            "canvas_edge": [self._location.width_m, self._location.height_m],
            **{name: [] for name in names},
            "arcline_path_3": {},
            "connectivity": {},
        }

    def add_town(self, token: str, town: Row, offset: NDArray[np.float64]) -> None:
        for layer, open_fields in POLYGON_LAYERS.items():
            for number, shape in enumerate(town["polygons"][layer]):
                polygon = make_token(token, layer, number, "polygon")
                nodes = self._add_nodes(polygon, np.asarray(shape) + offset[:2])
                self.expansion["polygon"].append({"token": polygon, "exterior_node_tokens": nodes, "holes": []})
                geometry = {"polygon_tokens": [polygon]} if layer == "drivable_area" else {"polygon_token": polygon}
                row = {"token": make_token(token, layer, number), **geometry, **open_fields}
                if layer == "road_segment":
                    row["is_intersection"] = number in town["intersections"]
                self.expansion[layer].append(row)
        for layer, open_fields in LINE_LAYERS.items():
            for number, shape in enumerate(town["lines"][layer]):
                line = make_token(token, layer, number, "line")
                nodes = self._add_nodes(line, np.asarray(shape) + offset[:2])
                self.expansion["line"].append({"token": line, "node_tokens": nodes})
                self.expansion[layer].append(
                    {"token": make_token(token, layer, number), "line_token": line, **open_fields}
                )
        self._drivable += [np.asarray(shape) + offset[:2] for shape in town["polygons"]["drivable_area"]]

    def _add_nodes(self, token: str, points: NDArray[np.float64]) -> list[str]:
        nodes = [make_token(token, number) for number in range(len(points))]
        for node, (x, y) in zip(nodes, points.tolist(), strict=True):
            self.expansion["node"].append({"token": node, "x": x, "y": y})
        return nodes

    def mask(self) -> Image.Image:
        """Drivable area, 10 pixels per metre, south-west corner at the bottom left; no larger than the towns need."""
        corners = [polygon.max(axis=0) for polygon in self._drivable] or [np.ones(2)]
        width, height = np.ceil(np.max(corners, axis=0) * MAP_PIXELS_PER_M).astype(int).tolist()
        mask = Image.new("L", (width + 1, height + 1))
        draw = ImageDraw.Draw(mask)
        for polygon in self._drivable:
            pixels = polygon * (MAP_PIXELS_PER_M, -MAP_PIXELS_PER_M) + (0, height + 1)
            draw.polygon([(u, v) for u, v in pixels.tolist()], fill=255)
        return mask


# Fields


def _data_token(settings: WorldSettings, scene: int, channel: str, time_us: int) -> str:
    return make_token(settings.seed, scene, channel, time_us)


def _lidarseg_file(settings: WorldSettings, token: str) -> str:
    return f"lidarseg/{settings.version}/{token}_lidarseg.bin"


def _neighbours(tokens: Sequence[str], number: int) -> Row:
    return {
        "prev": tokens[number - 1] if number else "",
        "next": tokens[number + 1] if number + 1 < len(tokens) else "",
    }


def _pose_fields(T_a_from_b: NDArray[np.float64]) -> Row:
    """Translation and quaternion (w, x, y, z) of a rigid transform."""
    return {
        "translation": T_a_from_b[:3, 3].tolist(),
        "rotation": quaternion_of(T_a_from_b[:3, :3]).tolist(),
    }


def _moved(pose: Row, offset: NDArray[np.float64]) -> Row:
    return {**pose, "translation": (np.asarray(pose["translation"]) + offset).tolist()}
