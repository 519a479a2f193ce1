# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Writes a tiny data set in the official nuScenes layout, with all thirteen tables.

Static landmarks in the world are seen by every sweep of a moving car, so accumulated sweeps and
projections have known answers: `landmarks_world` and the matrices kept in `Tree`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pred.data.world.drive import CATEGORIES

VERSION = "v1.0-test"
NUM_LANDMARKS = 400
NUM_EGO_POINTS = 7
WIDTH, HEIGHT = 64, 36
LABEL_WIDTH, LABEL_HEIGHT = 32, 18
SWEEP_PERIOD_US = 50_000
CAMERA_DELAY_US = 20_000
CAMERAS = {"CAM_BACK": math.pi, "CAM_FRONT": 0.0}
BOX_SIZE_WLH = (1.8, 4.2, 1.5)

Matrix = NDArray[np.float64]


@dataclass
class Tree:
    """What was written, and the answers a reader must find."""

    root: Path
    landmarks_world: Matrix  # [NUM_LANDMARKS, 3]
    tokens: list[str] = field(default_factory=list)
    keyframe_files: list[Path] = field(default_factory=list)
    sweep_files: list[Path] = field(default_factory=list)  # one between keyframes, in time order
    T_world_from_lidar: list[Matrix] = field(default_factory=list)  # per keyframe
    T_world_from_camera: list[dict[str, Matrix]] = field(default_factory=list)
    intrinsics: dict[str, Matrix] = field(default_factory=dict)
    T_world_from_box: list[Matrix] = field(default_factory=list)
    images: list[dict[str, Path]] = field(default_factory=list)
    labels: list[dict[str, Path]] = field(default_factory=list)
    class_files: list[Path] = field(default_factory=list)  # per keyframe, see `write_lidarseg`

    @property
    def tables(self) -> Path:
        return self.root / VERSION

    def edit(self, table: str, change: Any) -> None:
        """Rewrite a table: ``change`` gets and may modify its list of rows."""
        path = self.tables / f"{table}.json"
        rows = json.loads(path.read_text())
        change(rows)
        path.write_text(json.dumps(rows))


def write_tree(root: Path, scenes: tuple[str, ...] = ("scene-a",), keyframes: int = 2, seed: int = 0) -> Tree:
    """Each scene: sweep, keyframe, sweep, keyframe, ...; two cameras; PNG and .npy labels."""
    rng = np.random.default_rng(seed)
    # Around the car, which drives 1.6 m at most, and clear of it.
    angle, radius = rng.uniform(-math.pi, math.pi, NUM_LANDMARKS), rng.uniform(7.0, 30.0, NUM_LANDMARKS)
    height = rng.uniform(-0.5, 3.5, NUM_LANDMARKS)
    landmarks = np.stack([600.0 + radius * np.cos(angle), 1600.0 + radius * np.sin(angle), height], axis=1)
    tree = Tree(root, landmarks)
    tables = _static_tables(scenes)
    lidar_mount = _mount(rng, (0.94, 0.0, 1.84), _yaw(-math.pi / 2))
    mounts = {
        # Optical axes: z ahead, x to the right, y down.
        name: _mount(rng, (1.5 * math.cos(yaw), 0.1, 1.5), _product(_yaw(yaw), (0.5, -0.5, 0.5, -0.5)))
        for name, yaw in CAMERAS.items()
    }
    for channel, mount in {"LIDAR_TOP": lidar_mount, **mounts}.items():
        intrinsics: list[list[float]] = []
        if channel in mounts:
            focal = float(rng.uniform(45, 55))
            intrinsics = [[focal, 0.0, WIDTH / 2 + 0.7], [0.0, focal, HEIGHT / 2 - 0.4], [0.0, 0.0, 1.0]]
            tree.intrinsics[channel] = np.array(intrinsics)
        tables["sensor"].append(
            {
                "token": f"sensor-{channel}",
                "channel": channel,
                "modality": "camera" if channel in mounts else "lidar",
            }
        )
        tables["calibrated_sensor"].append(
            {
                "token": f"calibrated-{channel}",
                "sensor_token": f"sensor-{channel}",
                **_pose_row(*mount),
                "camera_intrinsic": intrinsics,
            }
        )

    for scene_number, scene in enumerate(scenes):
        start_us = 1_500_000_000_000_000 + scene_number * 60_000_000
        samples = [f"{scene}-sample-{number}" for number in range(keyframes)]
        sweeps = [f"{scene}-sweep-{number}" for number in range(2 * keyframes)]
        boxes = [f"{scene}-box-{number}" for number in range(keyframes)]
        for number, token in enumerate(samples):
            time_us = start_us + (2 * number + 1) * SWEEP_PERIOD_US
            tables["sample"].append(
                {
                    "token": token,
                    "timestamp": time_us,
                    "scene_token": scene,
                    **_neighbours(samples, number),
                }
            )
            tree.tokens.append(token)
            tree.images.append({})
            tree.labels.append({})
            tree.T_world_from_camera.append({})
            box_rotation = _product(_yaw(float(rng.uniform(-3, 3))), _tilt(rng, 0.03))
            box_translation = tuple(landmarks[number].tolist())
            tree.T_world_from_box.append(_matrix(box_translation, box_rotation))
            tables["sample_annotation"].append(
                {
                    "token": boxes[number],
                    "sample_token": token,
                    "instance_token": f"{scene}-instance",
                    "visibility_token": "4",
                    "attribute_tokens": [],
                    **_pose_row(box_translation, box_rotation),
                    "size": list(BOX_SIZE_WLH),
                    "num_lidar_pts": 5,
                    "num_radar_pts": 0,
                    **_neighbours(boxes, number),
                }
            )
        tables["instance"].append(
            {
                "token": f"{scene}-instance",
                "category_token": "category-car",
                "nbr_annotations": keyframes,
                "first_annotation_token": boxes[0],
                "last_annotation_token": boxes[-1],
            }
        )
        for number, token in enumerate(sweeps):
            time_us = start_us + number * SWEEP_PERIOD_US
            is_keyframe = number % 2 == 1
            folder = "samples" if is_keyframe else "sweeps"
            name = f"{folder}/LIDAR_TOP/{token}.pcd.bin"
            T_world_from_lidar = _matrix(*_ego_pose(time_us - start_us)) @ _matrix(*lidar_mount)
            _write_sweep(root / name, landmarks, T_world_from_lidar, rng)
            sample = samples[number // 2]
            _add_data(tables, token, sample, "LIDAR_TOP", time_us, start_us, name, is_keyframe)
            tables["sample_data"][-1].update(_neighbours(sweeps, number))
            if not is_keyframe:
                tree.sweep_files.append(root / name)
                continue
            tree.keyframe_files.append(root / name)
            tree.T_world_from_lidar.append(T_world_from_lidar)
            frame = len(tree.T_world_from_lidar) - 1
            for channel, mount in mounts.items():
                camera_us = time_us + CAMERA_DELAY_US
                stem = f"{token}-{channel}"
                name = f"samples/{channel}/{stem}.jpg"
                _add_data(tables, stem, sample, channel, camera_us, start_us, name, True)
                pose = _matrix(*_ego_pose(camera_us - start_us)) @ _matrix(*mount)
                tree.T_world_from_camera[frame][channel] = pose
                tree.images[frame][channel] = _write_image(root / name, rng)
                suffix = ".png" if channel == "CAM_FRONT" else ".npy"
                label = root / "pseudo" / "made-up" / channel / f"{stem}{suffix}"
                tree.labels[frame][channel] = _write_label(label, rng)
    for name, rows in tables.items():
        path = root / VERSION / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows))
    half = max(1, len(scenes) // 2)
    splits = {"first": list(scenes[:half]), "second": list(scenes[half:])}
    (root / VERSION / "splits.json").write_text(json.dumps(splits))
    return tree


def write_lidarseg(tree: Tree, seed: int = 0) -> None:
    """Random point classes of every keyframe, and the official categories with their indices."""
    rng = np.random.default_rng(seed)
    tokens = {"human.pedestrian.adult": "category-person", "vehicle.car": "category-car"}
    categories = [
        {"token": tokens.get(name, f"category-{index}"), "name": name, "description": "", "index": index}
        for index, name in enumerate(CATEGORIES)
    ]
    (tree.tables / "category.json").write_text(json.dumps(categories))
    rows = []
    for path in tree.keyframe_files:
        token = path.name.removesuffix(".pcd.bin")
        name = f"lidarseg/{VERSION}/{token}_lidarseg.bin"
        num_points = path.stat().st_size // 20
        tree.class_files.append(tree.root / name)
        tree.class_files[-1].parent.mkdir(parents=True, exist_ok=True)
        rng.integers(0, len(CATEGORIES), num_points).astype(np.uint8).tofile(tree.class_files[-1])
        rows.append({"token": token, "sample_data_token": token, "filename": name})
    (tree.tables / "lidarseg.json").write_text(json.dumps(rows))


def _static_tables(scenes: tuple[str, ...]) -> dict[str, list[dict[str, Any]]]:
    names = ("sample", "sample_data", "sample_annotation", "ego_pose", "sensor", "calibrated_sensor", "instance")
    return {
        **{name: [] for name in names},
        "category": [
            {"token": "category-person", "name": "human.pedestrian.adult", "description": ""},
            {"token": "category-car", "name": "vehicle.car", "description": ""},
        ],
        "attribute": [],
        "visibility": [{"token": "4", "level": "v80-100", "description": ""}],
        "log": [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": "singapore-onenorth"}],
        "map": [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/map.png"}],
        "scene": [
            {
                "token": scene,
                "name": scene,
                "log_token": "log",
                "nbr_samples": 2,
                "first_sample_token": f"{scene}-sample-0",
                "last_sample_token": f"{scene}-sample-1",
                "description": "",
            }
            for scene in scenes
        ],
    }


def _add_data(
    tables: dict[str, list[dict[str, Any]]],
    token: str,
    sample: str,
    channel: str,
    time_us: int,
    start_us: int,
    name: str,
    is_keyframe: bool,
) -> None:
    is_image = channel != "LIDAR_TOP"
    tables["ego_pose"].append({"token": token, "timestamp": time_us, **_pose_row(*_ego_pose(time_us - start_us))})
    tables["sample_data"].append(
        {
            "token": token,
            "sample_token": sample,
            "ego_pose_token": token,
            "calibrated_sensor_token": f"calibrated-{channel}",
            "timestamp": time_us,
            "fileformat": "jpg" if is_image else "pcd",
            "is_key_frame": is_keyframe,
            "height": HEIGHT if is_image else 0,
            "width": WIDTH if is_image else 0,
            "filename": name,
            "prev": "",
            "next": "",
        }
    )


def _write_sweep(path: Path, landmarks: Matrix, T_world_from_lidar: Matrix, rng: np.random.Generator) -> None:
    homogeneous = np.column_stack([landmarks, np.ones(len(landmarks))])
    xyz = (np.linalg.inv(T_world_from_lidar) @ homogeneous.T).T[:, :3]
    own_car = rng.uniform([-0.9, -1.5, -1.5], [0.9, 2.5, -0.5], (NUM_EGO_POINTS, 3))
    sweep = np.zeros((NUM_EGO_POINTS + len(xyz), 5), dtype=np.float32)
    sweep[:, :3] = np.concatenate([own_car, xyz])
    sweep[:, 3] = rng.integers(0, 256, len(sweep))
    sweep[:, 4] = np.arange(len(sweep)) % 32
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep.tofile(path)


def _write_image(path: Path, rng: np.random.Generator) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(path)
    return path


def _write_label(path: Path, rng: np.random.Generator) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        ids = rng.choice([0, 1, 2, 8, 13, 19], (LABEL_HEIGHT, LABEL_WIDTH)).astype(np.uint8)
        Image.fromarray(ids).save(path)
    else:
        probabilities = rng.dirichlet(np.full(19, 0.1), (LABEL_HEIGHT, LABEL_WIDTH))
        np.save(path, np.moveaxis(probabilities, -1, 0).astype(np.float16))
    return path


def _ego_pose(elapsed_us: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """8 m/s along a left bend, starting far from the world's origin as real logs do."""
    elapsed = elapsed_us * 1e-6
    heading = 0.3 + 0.5 * elapsed
    x = 600.0 + 8.0 * elapsed * math.cos(heading)
    y = 1600.0 + 8.0 * elapsed * math.sin(heading)
    return (x, y, 0.0), _yaw(heading)


def _mount(
    rng: np.random.Generator, translation: tuple[float, ...], rotation: tuple[float, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return translation, _product(rotation, _tilt(rng, 0.01))


def _pose_row(translation: tuple[float, ...], rotation: tuple[float, ...]) -> dict[str, list[float]]:
    return {"translation": list(translation), "rotation": list(rotation)}


def _neighbours(tokens: list[str], number: int) -> dict[str, str]:
    padded = ["", *tokens, ""]
    return {"prev": padded[number], "next": padded[number + 2]}


def _yaw(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))


def _tilt(rng: np.random.Generator, size: float) -> tuple[float, float, float, float]:
    """A small random rotation."""
    x, y, z = rng.normal(0.0, size, 3).tolist()
    norm = math.sqrt(1 + x * x + y * y + z * z)
    return (1 / norm, x / norm, y / norm, z / norm)


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Quaternion product (w, x, y, z): first b, then a."""
    scalar = a[0] * b[0] - np.dot(a[1:], b[1:])
    vector = a[0] * np.array(b[1:]) + b[0] * np.array(a[1:]) + np.cross(a[1:], b[1:])
    return (float(scalar), *vector.tolist())


def _matrix(translation: tuple[float, ...], rotation: tuple[float, ...]) -> Matrix:
    """[4, 4] by Rodrigues' formula, unlike the reader's closed form."""
    angle = 2 * math.atan2(float(np.linalg.norm(rotation[1:])), rotation[0])
    x, y, z = np.array(rotation[1:]) / max(float(np.linalg.norm(rotation[1:])), 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    matrix[:3, 3] = translation
    return matrix
