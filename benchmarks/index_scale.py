# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The frame index at the size of nuScenes and of ONCE: ``python -m benchmarks.index_scale FOLDER``.

Writes tables as large as those of nuScenes v1.0-trainval and JSON files as large as those of ONCE (a million frames,
seven million images) into FOLDER: 3 GB, kept for the next time, without sensor files. Measures, each in a process of
its own: building the index, opening it, and what loader processes that walk over random frames hold for themselves,
both forked from one that has the index open ("walk") and started afresh ("spawn").
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import machine_record
from benchmarks.memory import status_bytes
from pred.data import nuscenes, once
from pred.data.index import FILE_NAME, IndexedFrames
from pred.random import numpy_generator

VERSION = "v1.0-trainval"
NUM_SCENES, NUM_SAMPLES = 850, 34_149
"""Of nuScenes v1.0-trainval; so are the shares below."""
NUM_ONCE_FRAMES = 1_000_000
CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK", "BACK_LEFT", "BACK_RIGHT")
RADARS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK_LEFT", "BACK_RIGHT")
CHANNELS = {
    "LIDAR_TOP": ("lidar", "pcd.bin", 10),
    **{f"CAM_{name}": ("camera", "jpg", 6) for name in CAMERAS},
    **{f"RADAR_{name}": ("radar", "pcd", 6) for name in RADARS},
}
"""Modality, file suffix, and readings for each sample."""
BOXES_PER_SAMPLE = 34
INSTANCES_PER_SCENE = 76

WALKED_FRAMES = 2000

ONCE_FRAMES_PER_SEQUENCE = 1800
ONCE_ANNOTATED = 60
"""Every so many frames has boxes: some 16,000 in all."""
ONCE_BOXES = 25

Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser("python -m benchmarks.index_scale", description=__doc__)
    parser.add_argument("folder", type=Path, help="where to write the tables and the indexes")
    parser.add_argument("--samples", type=int, default=NUM_SAMPLES)
    parser.add_argument("--once-frames", type=int, default=NUM_ONCE_FRAMES)
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--json", type=Path, default=None, help="write the figures there")
    parser.add_argument("--measure", choices=list(MEASUREMENTS), default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(MEASUREMENTS[options.measure](options)))
        return
    started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    for folder, size, write in (
        (options.folder / VERSION, options.samples, write_tables),
        (options.folder / "once", options.once_frames, write_once_files),
    ):
        complete = folder / f"{size}.complete"
        if not complete.is_file():
            start_time = time.monotonic()
            num_rows = write(folder, size)
            complete.touch()
            print(f"wrote {num_rows:,} readings to {folder} in {time.monotonic() - start_time:.0f} s", flush=True)
        (folder / FILE_NAME).unlink(missing_ok=True)
    figures = {}
    for name in MEASUREMENTS:
        figures[name] = in_own_process(name, sys.argv[1:])
        print(f"{name:<16}" + "  ".join(f"{key} {value}" for key, value in figures[name].items()), flush=True)
    if options.json is not None:
        record = {
            "command": "python -m benchmarks.index_scale FOLDER",
            "samples": options.samples,
            "once_frames": options.once_frames,
            "started": started,
            **machine_record(),
            "figures": figures,
        }
        options.json.write_text(json.dumps(record, indent=2) + "\n")


def in_own_process(name: str, arguments: list[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.index_scale", *arguments, "--measure", name]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    figures: dict[str, Any] = json.loads(output.splitlines()[-1])
    return figures


# Measurements


def timed(call: Callable[[], Any], file: Path) -> tuple[Any, dict[str, Any]]:
    """Result and figures of a call that makes or opens ``file``."""
    before = status_bytes("VmRSS")
    start_time = time.monotonic()
    result = call()
    seconds = time.monotonic() - start_time
    peak, now = status_bytes("VmHWM"), status_bytes("VmRSS")
    figures = {
        "seconds": round(seconds, 3),
        "file_mb": file.stat().st_size // 1_000_000,
        "rss_before_mb": before // 1_000_000,
        "rss_mb": now // 1_000_000,
        "peak_rss_mb": peak // 1_000_000,
    }
    return result, figures


def nuscenes_frames(options: argparse.Namespace) -> IndexedFrames:
    return nuscenes.NuScenesFrames(options.folder, VERSION)


def once_frames(options: argparse.Namespace) -> IndexedFrames:
    return once.OnceFrames(options.folder / "once", labels="none")


def measure_nuscenes(options: argparse.Namespace) -> dict[str, Any]:
    """Build or, where it is there, open."""
    frames, figures = timed(lambda: nuscenes_frames(options), options.folder / VERSION / FILE_NAME)
    return {"frames": len(frames), **figures}


def measure_once(options: argparse.Namespace) -> dict[str, Any]:
    frames, figures = timed(lambda: once_frames(options), options.folder / "once" / FILE_NAME)
    json_mb = sum(path.stat().st_size for path in (options.folder / "once").glob("data/*/*.json")) // 1_000_000
    return {"frames": len(frames), "images": len(frames._index.images.path), "json_mb": json_mb, **figures}


def measure_workers(
    frames_of: Callable[[argparse.Namespace], IndexedFrames], method: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Memory that only one process has, added by opening the index (spawn) and loading random frames."""
    context: Any = multiprocessing.get_context(method)
    barrier, results = context.Barrier(options.workers), context.Queue()
    frames: IndexedFrames | bytes = frames_of(options)
    if method == "spawn":
        frames = pickle.dumps(frames)
    arguments = [(frames, worker, barrier, results) for worker in range(options.workers)]
    processes = [context.Process(target=walk, args=of_worker) for of_worker in arguments]
    for process in processes:
        process.start()
    figures = [results.get() for _ in processes]
    for process in processes:
        process.join()
    dirty, clean, seconds = (max(column) for column in zip(*figures, strict=True))
    return {
        "workers": options.workers,
        "private_dirty_mb": round(dirty / 1e6, 1),
        "private_clean_mb": round(clean / 1e6, 1),
        "us_per_frame": round(seconds / WALKED_FRAMES * 1e6),
    }


def walk(given: IndexedFrames | bytes, worker: int, barrier: Any, results: Any) -> None:
    dirty_before, clean_before = private_bytes()
    frames = pickle.loads(given) if isinstance(given, bytes) else given
    load_without_files()
    rows = numpy_generator(0, worker).integers(0, len(frames), WALKED_FRAMES)
    start_time = time.monotonic()
    for row in rows:
        frames.load(int(row))
    seconds = time.monotonic() - start_time
    barrier.wait()  # all are alive: a page that two of them use is not private
    dirty, clean = private_bytes()
    barrier.wait()
    results.put((dirty - dirty_before, clean - clean_before, seconds))


def private_bytes() -> tuple[int, int]:
    dirty, clean = (status_bytes(f"Private_{name}", "/proc/self/smaps_rollup") for name in ("Dirty", "Clean"))
    return dirty, clean


def load_without_files() -> None:
    """All of `load` except the files, which are not there."""
    nuscenes.read_sweep = lambda path: np.zeros((1, 5), dtype=np.float32)
    once.read_scan = lambda path: np.zeros((1, 4), dtype=np.float32)
    once.rgb_image_size = lambda path: (1920, 1020)
    Path.is_file = lambda self: True  # type: ignore[method-assign]


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "nuscenes build": measure_nuscenes,
    "nuscenes open": measure_nuscenes,
    "nuscenes walk": partial(measure_workers, nuscenes_frames, "fork"),
    "nuscenes spawn": partial(measure_workers, nuscenes_frames, "spawn"),
    "once build": measure_once,
    "once open": measure_once,
    "once walk": partial(measure_workers, once_frames, "fork"),
    "once spawn": partial(measure_workers, once_frames, "spawn"),
}


# Tables like those of nuScenes


def write_tables(folder: Path, num_samples: int) -> int:
    """All that the reader needs, formatted as the originals are; returns the number of rows of sample_data."""
    folder.mkdir(parents=True, exist_ok=True)
    num_scenes = max(1, round(num_samples * NUM_SCENES / NUM_SAMPLES))
    scene_of = [sample * num_scenes // num_samples for sample in range(num_samples)]
    sensors = list(CHANNELS)
    write_table(folder, "sensor", (sensor_row(number, sensors) for number in range(len(sensors))))
    write_table(
        folder,
        "calibrated_sensor",
        (calibration_row(scene, number, sensors) for scene in range(num_scenes) for number in range(len(sensors))),
    )
    write_table(folder, "scene", ({"token": token("scene", n), "name": f"scene-{n:04d}"} for n in range(num_scenes)))
    write_table(folder, "category", ({"token": token("category", n), "name": f"vehicle.kind{n}"} for n in range(23)))
    instances = INSTANCES_PER_SCENE * num_scenes
    write_table(
        folder,
        "instance",
        ({"token": token("instance", n), "category_token": token("category", n % 23)} for n in range(instances)),
    )
    write_table(folder, "sample", (sample_row(sample, scene_of) for sample in range(num_samples)))
    write_table(folder, "sample_annotation", (box_row(n, scene_of) for n in range(BOXES_PER_SAMPLE * num_samples)))
    write_table(folder, "sample_data", (row for row, _ in data_rows(num_samples, scene_of)))
    return write_table(folder, "ego_pose", (row for _, row in data_rows(num_samples, scene_of)))


def write_table(folder: Path, name: str, rows: Iterator[Row]) -> int:
    """Written as ``json.dump(rows, indent=0)`` does."""
    encode = json.JSONEncoder(separators=(",\n", ": ")).encode
    count = 0
    with open(folder / f"{name}.json", "w") as file:
        file.write("[")
        for row in rows:
            file.write(f"{',' if count else ''}\n{encode(row)}")
            count += 1
        file.write("\n]")
    return count


def token(kind: str, number: int) -> str:
    """32 characters, as the originals have, and as hard to compress."""
    return f"{hash_of(kind) * (number + 1) % (1 << 128):032x}"


def hash_of(kind: str) -> int:
    return int.from_bytes(kind.encode().ljust(8, b"x"), "little") ** 2 | 1


def sensor_row(number: int, sensors: list[str]) -> Row:
    return {"token": token("sensor", number), "channel": sensors[number], "modality": CHANNELS[sensors[number]][0]}


def calibration_row(scene: int, number: int, sensors: list[str]) -> Row:
    is_camera = CHANNELS[sensors[number]][0] == "camera"
    return {
        "token": token("calibrated", scene * len(sensors) + number),
        "sensor_token": token("sensor", number),
        "translation": [1.70079118954, 0.0159456324149, 1.51095763913],
        "rotation": [0.5, -0.5, 0.5, -0.5],
        "camera_intrinsic": [[1266.4, 0.0, 816.2], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]] if is_camera else [],
    }


def sample_row(sample: int, scene_of: list[int]) -> Row:
    return {
        "token": token("sample", sample),
        "timestamp": sample_time_us(sample),
        "prev": token("sample", sample - 1) if sample else "",
        "next": token("sample", sample + 1),
        "scene_token": token("scene", scene_of[sample]),
    }


def box_row(number: int, scene_of: list[int]) -> Row:
    sample = number // BOXES_PER_SAMPLE
    instance = scene_of[sample] * INSTANCES_PER_SCENE + number % BOXES_PER_SAMPLE
    return {
        "token": token("annotation", number),
        "sample_token": token("sample", sample),
        "instance_token": token("instance", instance),
        "visibility_token": "4",
        "attribute_tokens": [token("attribute", number % 8)],
        "translation": [373.214 + number % 97, 1130.48 + number % 89, 1.25],
        "size": [0.621, 0.669, 1.642],
        "rotation": [0.9831098797903927, 0.0, 0.0, -0.18301629506281616],
        "prev": token("annotation", number - 1),
        "next": token("annotation", number + 1),
        "num_lidar_pts": 5,
        "num_radar_pts": 0,
    }


def data_rows(num_samples: int, scene_of: list[int]) -> Iterator[tuple[Row, Row]]:
    """Rows of sample_data with their ego poses, channel after channel within a sample."""
    number = 0
    readings = sum(count for _, _, count in CHANNELS.values())
    for sample in range(num_samples):
        first_of_scene = sample == 0 or scene_of[sample - 1] != scene_of[sample]
        for sensor, (channel, (modality, suffix, count)) in enumerate(CHANNELS.items()):
            for reading in range(count):
                is_keyframe = reading == 0
                time_us = sample_time_us(sample) + reading * 500_000 // count
                folder = "samples" if is_keyframe else "sweeps"
                name = f"n015-2018-07-24-11-22-45+0800__{channel}__{time_us}.{suffix}"
                # The last reading of the sample before lies a sample's readings back, less those since.
                previous = number - 1 if reading else number - readings + count - 1
                own_token = token("data", number)
                yield (
                    {
                        "token": own_token,
                        "sample_token": token("sample", sample),
                        "ego_pose_token": own_token,
                        "calibrated_sensor_token": token("calibrated", scene_of[sample] * len(CHANNELS) + sensor),
                        "timestamp": time_us,
                        "fileformat": suffix.split(".")[0],
                        "is_key_frame": is_keyframe,
                        "height": 900 if modality == "camera" else 0,
                        "width": 1600 if modality == "camera" else 0,
                        "filename": f"{folder}/{channel}/{name}",
                        "prev": "" if first_of_scene and is_keyframe else token("data", previous),
                        "next": token("data", number + 1),
                    },
                    {
                        "token": own_token,
                        "timestamp": time_us,
                        "rotation": [
                            0.5720320396729045,
                            -0.0016977771610471074,
                            0.011798001930183783,
                            -0.8201446642457809,
                        ],
                        "translation": [411.3039349319818 + 1e-6 * number, 1180.8903791765097, 0.0],
                    },
                )
                number += 1


def sample_time_us(sample: int) -> int:
    return 1_532_402_927_647_951 + 500_000 * sample


# JSON files like those of ONCE


def write_once_files(root: Path, num_frames: int) -> int:
    """The JSON file of each sequence; returns the number of images that they speak of."""
    for sequence in range(-(-num_frames // ONCE_FRAMES_PER_SEQUENCE)):
        first = sequence * ONCE_FRAMES_PER_SEQUENCE
        rows = range(first, min(first + ONCE_FRAMES_PER_SEQUENCE, num_frames))
        name = f"{sequence:06d}"
        folder = root / "data" / name
        folder.mkdir(parents=True, exist_ok=True)
        content = {
            "meta_info": {"weather": "sunny", "period": "morning", "image_size": [1920, 1020]},
            "calib": {camera: once_calibration(sequence) for camera in once.CAMERAS},
            "frames": [once_frame(name, row) for row in rows],
        }
        (folder / f"{name}.json").write_text(json.dumps(content))
    return num_frames * len(once.CAMERAS)


def once_calibration(sequence: int) -> Row:
    return {
        "cam_to_velo": [[0.0, 0.0, -1.0, -0.03], [1.0, 0.0, 0.0, 0.11], [0.0, -1.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]],
        "cam_intrinsic": [[964.3214 + 0.01 * sequence, 0.0, 977.4321], [0.0, 966.1134, 517.4312], [0.0, 0.0, 1.0]],
        "distortion": [[-0.3199812, 0.1151423, -0.0004217, 0.0011043, -0.0210034]],
    }


def once_frame(sequence: str, row: int) -> Row:
    turn = np.sin(0.01 * row), np.cos(0.01 * row)
    # Two of a hundred have no pose.
    pose = [0.0, 0.0, *turn, 0.4912345678 * row, -1.23456789 * row, 0.0123456789] if row % 50 else [0.0] * 7
    frame: Row = {"sequence_id": sequence, "frame_id": str(1_616_100_000_000 + 500 * row), "pose": pose}
    if row % ONCE_ANNOTATED == 0:
        box = [12.3456789 + row % 7, -23.4567891, -0.7654321, 4.5678912, 1.8765432, 1.5432198, 1.6789123]
        frame["annos"] = {
            "names": ["Car"] * ONCE_BOXES,
            "boxes_3d": [box] * ONCE_BOXES,
            "boxes_2d": {camera: [[712.3456789, 412.3456789, 801.23, 498.7]] * ONCE_BOXES for camera in once.CAMERAS},
        }
    return frame


if __name__ == "__main__":
    main()
