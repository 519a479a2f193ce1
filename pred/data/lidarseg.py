# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Exact classes of LiDAR points: nuScenes-lidarseg files, and the classes in which they are compared with images.

`Frame.semantics` holds Cityscapes train ids, whatever the source. nuScenes-lidarseg has others: buildings, walls,
fences, poles, lights and signs are one there, and riders belong to their cycle. A point of such a class gets one
Cityscapes id that stands for it, and comparisons merge both sides into the classes that both label sets can tell apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import CLASS_NAMES, FrameError, require_inside
from pred.data.tables import Row, read_table

NO_CLASS = 255
"""Cityscapes id of points without a class."""

MERGED_CLASSES = {
    "road": ("road",),
    "sidewalk": ("sidewalk",),
    "terrain": ("terrain",),
    "vegetation": ("vegetation",),
    "manmade": ("building", "wall", "fence", "pole", "traffic light", "traffic sign"),
    "bus": ("bus",),
    "truck": ("truck",),
    "car": ("car",),
    "cycle": ("motorcycle", "bicycle", "rider"),
    "person": ("person",),
}
"""Cityscapes classes of each merged class, from wide surfaces to small objects. Sky and train are in none."""

MERGED_NAMES = tuple(MERGED_CLASSES)
NUM_MERGED = len(MERGED_NAMES)

LIDARSEG_CLASSES = {
    "noise": None,
    "animal": None,
    "human.pedestrian.adult": "person",
    "human.pedestrian.child": "person",
    "human.pedestrian.construction_worker": "person",
    "human.pedestrian.personal_mobility": None,
    "human.pedestrian.police_officer": "person",
    "human.pedestrian.stroller": None,
    "human.pedestrian.wheelchair": None,
    "movable_object.barrier": None,
    "movable_object.debris": None,
    "movable_object.pushable_pullable": None,
    "movable_object.trafficcone": None,
    "static_object.bicycle_rack": None,
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "truck",
    "vehicle.emergency.ambulance": None,
    "vehicle.emergency.police": None,
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "truck",
    "vehicle.truck": "truck",
    "flat.driveable_surface": "road",
    "flat.other": None,
    "flat.sidewalk": "sidewalk",
    "flat.terrain": "terrain",
    "static.manmade": "building",
    "static.other": None,
    "static.vegetation": "vegetation",
    "vehicle.ego": None,
}
"""The Cityscapes class that stands for each of the 32 official names (nuscenes-devkit, color_map.py); None: Cityscapes
has none that fits, or (police, ambulance) the name says nothing about the shape."""


def _merged_ids() -> NDArray[np.int64]:
    ids = np.full(256, -1, dtype=np.int64)
    for merged, members in enumerate(MERGED_CLASSES.values()):
        ids[[CLASS_NAMES.index(name) for name in members]] = merged
    return ids


_MERGED_IDS = _merged_ids()


def merged_classes(class_ids: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """Merged class, an index of `MERGED_NAMES`, of Cityscapes train ids in 0..255; -1 of sky, train and no class."""
    return _MERGED_IDS[class_ids]


def class_files(tables: Path) -> dict[str, str]:
    """Label file below the root by sweep file below the root, of all sweeps with point classes.

    Args:
        tables: version folder with lidarseg.json. Its sample_data.json, of which the frame index keeps no tokens, is
            read too: 1.2 GB in nuScenes.

    Raises:
        FrameError: a table is missing or damaged, or a token is unknown.
    """

    def read_row(row: Row) -> tuple[str, str]:
        return row["sample_data_token"], require_inside(str(row["filename"]))

    label_files = dict(read_table(tables / "lidarseg.json", read_row))

    def read_sweep_row(row: Row) -> tuple[str, str] | None:
        return (row["token"], row["filename"]) if row["token"] in label_files else None

    sweep_files = dict(read_table(tables / "sample_data.json", read_sweep_row))
    for token in label_files:
        if token not in sweep_files:
            raise FrameError(tables / "lidarseg.json", f"sample_data_token must be in sample_data.json, got {token}")
    return {sweep_files[token]: file for token, file in label_files.items()}


def class_ids_of_categories(tables: Path) -> NDArray[np.int64]:
    """[256] Cityscapes train id by category index of the version folder; -1 where no category has the index.

    Raises:
        FrameError: category.json is missing or damaged, or a category is not official.
    """
    path = tables / "category.json"
    ids = np.full(256, -1, dtype=np.int64)

    def read_row(row: Row) -> tuple[int, str]:
        index, name = row["index"], row["name"]
        if not (isinstance(index, int) and 0 <= index < 256):
            raise ValueError(f"index {index!r}, which is not in 0..255")
        return index, name

    for index, name in read_table(path, read_row):
        if name not in LIDARSEG_CLASSES:
            raise FrameError(path, f"names with an index must be those of nuScenes-lidarseg, got {name!r}")
        class_name = LIDARSEG_CLASSES[name]
        ids[index] = NO_CLASS if class_name is None else CLASS_NAMES.index(class_name)
    return ids


def read_point_classes(
    path: Path,
    num_points: int,
    class_ids: NDArray[np.int64],  # [256], from `class_ids_of_categories`
) -> NDArray[np.int64]:  # [num_points] Cityscapes train ids, 255 = none
    """Classes of the points of one sweep file, in its order.

    Raises:
        FrameError: the file is missing, has another length, or holds an index that no category has.
    """
    try:
        categories = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except FileNotFoundError:
        raise FrameError(path, "point classes must exist, got no such file") from None
    except OSError as error:
        raise FrameError(path, f"point classes must be readable, got {error}") from None
    if len(categories) != num_points:
        raise FrameError(path, f"point classes must be one byte for each of {num_points} points, got {len(categories)}")
    classes = class_ids[categories]
    if (classes < 0).any():
        unknown = categories[np.argmin(classes)]
        raise FrameError(path, f"point classes must be indices of category.json, got {unknown}")
    return classes
