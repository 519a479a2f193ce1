# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""``pred data check``: goes through all files of a data set and tells what is missing or broken.

A layout is a function that finds the files and yields one check per file, in `LAYOUTS`.
"""

from __future__ import annotations

import os
import re
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from pred.data import folder as own
from pred.data import nuscenes, once
from pred.data.frame import FrameError, check_image_header, read_rgb, rgb_image_size
from pred.data.index import FrameIndex
from pred.data.labels import PseudoLabel, find_label_file, label_folder
from pred.data.tables import Row, read_json, read_table, reading_progress
from pred.progress import Progress, format_duration

MAX_EXAMPLES = 3
CHECKS_AT_ONCE = 1024

DEVKIT_TABLES = ("attribute", "visibility", "log", "map")
"""Tables that the official devkit demands and this package does not read."""

Check = Callable[[], None]
"""Raises `FrameError`, or OSError, if a file is missing or broken."""


class DataCheckError(ValueError):
    """The data set has problems, which were reported."""


@dataclass
class Problems:
    """Problems with the same rule.

    Attributes:
        count: how many.
        examples: texts of the first ones, each naming its file.
    """

    count: int = 0
    examples: list[str] = field(default_factory=list)


@dataclass
class Report:
    """What a check found.

    Attributes:
        layout: name of the layout.
        counts: what the data set holds: scenes, frames, ...
        problems: by rule.
        notes: what may be intended.
    """

    layout: str = ""
    counts: dict[str, int] = field(default_factory=dict)
    problems: dict[str, Problems] = field(default_factory=dict)
    notes: Counter[str] = field(default_factory=Counter)
    _lock: Lock = field(default_factory=Lock, repr=False)

    @property
    def num_problems(self) -> int:
        """All problems."""
        return sum(problems.count for problems in self.problems.values())

    def add(self, problem: FrameError) -> None:
        """Count a problem."""
        # One rule, whatever the row, token or size it speaks of.
        rule = re.sub(r"\S*\d\S*", "…", problem.what.split(", got")[0])
        problems = self.problems.setdefault(rule, Problems())
        problems.count += 1
        if len(problems.examples) < MAX_EXAMPLES:
            problems.examples.append(str(problem))

    def note(self, text: str) -> None:
        """Count what may be intended; also from several threads."""
        with self._lock:
            self.notes[text] += 1

    def attempt(self, check: Check) -> None:
        """Run a check and count what it raises."""
        problem = _problem(check)
        if problem is not None:
            self.add(problem)

    def lines(self) -> Iterator[str]:
        """The report as text."""
        counts = ", ".join(f"{count:,} {name}" for name, count in self.counts.items())
        yield f"{self.layout}: {counts}"
        for rule, problems in sorted(self.problems.items(), key=lambda item: -item[1].count):
            yield f"{problems.count:,} x {rule}"
            yield from (f"    {example}" for example in problems.examples)
            if problems.count > len(problems.examples):
                yield f"    ... and {problems.count - len(problems.examples):,} more"
        for note, count in self.notes.items():
            yield f"note: {note}" if count == 1 else f"note: {count:,} x {note}"


def check_data(
    root: Path,
    version: str | None = None,
    labels: str | None = "auto",
    fast: bool = False,
    console: Console | None = None,
) -> Report:
    """Check all files of a data set and print what is missing or broken.

    Args:
        root: folder of the data set, in one of `LAYOUTS`.
        version: table folder (nuScenes only).
        labels: folder of pseudo labels, as ``data.labels``.
        fast: read headers and sizes only.
        console: where to print; standard output by default.

    Raises:
        FrameError: the layout is not known.
    """
    start_time = time.monotonic()
    report = Report()
    name = find_layout(root, version)
    total, checks = LAYOUTS[name](root, version, labels, fast, report)
    workers = os.cpu_count() or 1
    with Progress("checking files", total, console=console) as progress, ThreadPoolExecutor(workers) as pool:
        done, checks_start_time = 0, time.monotonic()
        while batch := list(islice(checks, CHECKS_AT_ONCE)):
            for problem in pool.map(_problem, batch):
                done += 1
                if problem is not None:
                    report.add(problem)
                rate = done / max(time.monotonic() - checks_start_time, 1e-9)
                progress.update(done, f"{rate:.0f} files/s, {count_problems(report.num_problems)}")
        for line in report.lines():
            progress.message(line)
        duration = format_duration(time.monotonic() - start_time)
        read = f"{total:,} files{' (headers and sizes only)' if fast else ''}"
        progress.message(f"{count_problems(report.num_problems)} in {read}, {duration}")
    return report


def count_problems(count: int) -> str:
    """``no problem``, ``1 problem``, ``2 problems``."""
    return f"{count:,} problem{'s' if count > 1 else ''}" if count else "no problem"


def find_layout(root: Path, version: str | None = None) -> str:
    """Name of the layout of a data set, a key of `LAYOUTS`.

    Raises:
        FrameError: there is none.
    """
    if not root.is_dir():
        raise FrameError(root, "must be a folder, got no such folder")
    if version is not None or any(path.is_dir() for path in root.glob("v1.0-*")):
        return "nuscenes"
    if any(root.glob(f"*/{own.DESCRIPTION}")):
        return "folder"
    if (root / "data").is_dir():
        return "once"
    raise FrameError(
        root,
        f"must hold nuScenes tables (v1.0-*/, or name them: --version), drives (*/{own.DESCRIPTION}) "
        "or ONCE's sequences (data/), got none of them",
    )


def check_nuscenes(
    root: Path, version: str | None, labels: str | None, fast: bool, report: Report
) -> tuple[int, Iterator[Check]]:
    """Tables, sweeps, keyframe images and their labels."""
    tables = root / version if version else nuscenes.only_table_folder(root)
    report.layout = f"nuScenes layout, {tables}"
    for name in DEVKIT_TABLES:
        if not (tables / f"{name}.json").is_file():
            report.note(f"{tables / name}.json is missing: only the official devkit needs it")
    index = nuscenes.build_index(tables, report.add)
    _check_readings(tables, report)
    sweeps, images = index.sweeps, index.images
    label_files = _label_folder(root, labels, report)
    scenes = set(index.recording.to_pylist())
    report.attempt(partial(_check_splits, tables / "splits.json", scenes))
    report.counts = {
        "scenes": len(scenes),
        "frames": len(index),
        "sweeps": len(sweeps.path),
        "images": len(images.path),
        "boxes": len(index.boxes.name),
    }
    for frame in np.flatnonzero(index.sweep < 0):
        report.add(nuscenes.no_keyframe(tables, str(index.token[frame])))
    later = (sweeps.previous >= 0) & (sweeps.time_us <= sweeps.time_us[sweeps.previous])
    for row in np.flatnonzero(later):
        what = f"sweep {sweeps.path[row]} must be later than the one before it, got {sweeps.time_us[row]} us"
        report.add(FrameError(tables / "sample_data.json", what))
    starts = int(np.count_nonzero(sweeps.previous < 0))
    if starts > len(scenes):
        report.note(f"{starts:,} sweeps have none before them, but there are only {len(scenes):,} scenes")
    if len(set(np.diff(images.offsets).tolist())) > 1:
        report.note("some frames have fewer camera images than others")

    def checks() -> Iterator[Check]:
        for path in sweeps.path:
            file = root / str(path)
            yield partial(nuscenes.check_sweep_size, file) if fast else partial(_read, nuscenes.read_sweep, file)
        for row, path in enumerate(images.path):
            file = root / str(path)
            channel = str(index.calibrations.channel[images.calibration[row]])
            labels_of_camera = None if label_files is None else label_files / channel
            size = int(images.width[row]), int(images.height[row])
            yield from _image_checks(file, file.stem, *size, labels_of_camera, fast, report)

    files_per_image = 1 if label_files is None else 2
    return len(sweeps.path) + files_per_image * len(images.path), checks()


def _check_readings(tables: Path, report: Report) -> None:
    """Rows of sample_data among each other: tokens, prev and next, keyframes. What is wrong with a row by itself
    was reported before; such rows are left out."""
    path = tables / "sample_data.json"

    def read(name: str, read_row: Callable[[Row], Any]) -> dict[str, str]:
        return dict(read_table(tables / f"{name}.json", read_row, report=lambda problem: None))

    channels = read("sensor", lambda row: (row["token"], row["channel"]))
    channel_of = read("calibrated_sensor", lambda row: (row["token"], channels[row["sensor_token"]]))
    scene_of = read("sample", lambda row: (row["token"], row["scene_token"]))
    numbers = array("q")  # five for each row: hashes, since the texts of millions of rows take gigabytes

    def read_row(row: Row) -> None:
        sample, channel = row["sample_token"], channel_of[row["calibrated_sensor_token"]]
        links = [hash(row[key]) if row[key] else 0 for key in ("token", "prev", "next")]
        keyframe = hash((sample, channel)) if row["is_key_frame"] else 0
        numbers.extend((*links, hash((scene_of[sample], channel)), keyframe))

    with reading_progress("checking sample_data", [path]) as advance:
        read_table(path, read_row, lambda problem: None, advance)
    columns = np.frombuffer(numbers, dtype=np.int64).reshape(-1, 5).T
    token, chain, keyframe = columns[0], columns[3], columns[4]

    def add(rows: NDArray[np.int64], what: str, others: NDArray[np.int64] | None = None) -> None:
        for number, row in enumerate(rows.tolist()):
            got = "no such row" if others is None else f"row {others[number] + 1}"
            report.add(FrameError(path, f"row {row + 1} {what}, got {got}"))

    for values, what in (
        (token, "must have a token of its own"),
        (keyframe, "must be the only keyframe of its sample and channel"),
    ):
        order = np.argsort(values, kind="stable")
        again = np.flatnonzero((np.diff(values[order]) == 0) & (values[order][1:] != 0))
        add(order[again + 1], what, order[again])
    order = np.argsort(token, kind="stable")
    for key, link in (("prev", columns[1]), ("next", columns[2])):
        named = np.flatnonzero(link)
        place = np.minimum(np.searchsorted(token[order], link[named]), len(token) - 1)
        found = order[place]
        there = token[found] == link[named]
        add(named[~there], f"must name a {key} that is in the table")
        strange = there & (chain[found] != chain[named])
        add(named[strange], f"must have its {key} in its own scene and channel", found[strange])


def check_folder(
    root: Path, version: str | None, labels: str | None, fast: bool, report: Report
) -> tuple[int, Iterator[Check]]:
    """Descriptions, poses, scans, images and their labels of own drives."""
    report.layout = f"folder of drives, {root}"
    label_files = _label_folder(root, labels, report)
    folders = own.drive_folders(root)
    report.attempt(partial(_check_splits, root / "splits.json", {path.name for path in folders}))
    drives: list[own.Drive] = []
    for path in folders:
        report.attempt(lambda path=path: drives.append(own.read_drive(path)))  # type: ignore[misc]
    scans = sum(len(drive.stems) for drive in drives)
    images = sum(len(drive.stems) * len(drive.cameras) for drive in drives)
    report.counts = {"drives": len(folders), "frames": scans, "images": images}
    for drive in drives:
        named = set(drive.stems.tolist())
        extra = [file for file in (drive.folder / own.SCANS).glob(f"*{drive.suffix}") if file.stem not in named]
        if extra:
            report.note(f"{len(extra):,} scans of {drive.folder} are not used: {own.POSES} has no line for them")

    def checks() -> Iterator[Check]:
        for drive in drives:
            for scan, stem in enumerate(drive.stems.tolist()):
                file = drive.scan_file(scan)
                check = partial(own.check_scan_header, file, drive.columns)
                yield check if fast else partial(_read, own.read_scan, file, drive.columns)
                for camera in drive.cameras:
                    image = own.find_image_file(drive.folder / camera.name, stem)
                    labels_of_camera = None if label_files is None else label_files / drive.folder.name / camera.name
                    size = camera.width, camera.height
                    yield from _image_checks(image, stem, *size, labels_of_camera, fast, report)

    files_per_image = 1 if label_files is None else 2
    return scans + files_per_image * images, checks()


def check_once(
    root: Path, version: str | None, labels: str | None, fast: bool, report: Report
) -> tuple[int, Iterator[Check]]:
    """Lists, JSON files, scans, images and their labels of ONCE."""
    report.layout = f"ONCE layout, {root}"
    label_files = _label_folder(root, labels, report)
    names = once.sequence_names(root)
    for split in sorted((root / "ImageSets").glob("*.txt")):
        report.attempt(partial(_check_once_split, split, set(names)))
    index = once.build_index(root, report.add)
    images, poses = index.images, index.sweeps.pose
    report.counts = {
        "sequences": len(names),
        "frames": len(index),
        "annotated frames": int(np.count_nonzero(index.boxes.annotated)),
        "images": len(images.path),
        "boxes": len(index.boxes.name),
    }
    without_pose = int(np.count_nonzero(poses < 0))
    if without_pose:
        report.note(f"{without_pose:,} frames have no pose; they are placed at the origin")
    # Images of one camera of one sequence are as far apart as its frames have cameras.
    cameras_of_frame = np.diff(images.offsets)
    used, first, count = np.unique(images.calibration, return_index=True, return_counts=True)
    lenses = [
        (int(calibration), range(start, start + step * number, step))
        for calibration, start, number in zip(used, first.tolist(), count.tolist(), strict=True)
        if any(index.calibrations.distortion[calibration].as_py())
        for step in [cameras_of_frame[once.frame_of(images, start)]]
    ]

    def checks() -> Iterator[Check]:
        for calibration, rows in lenses:
            yield partial(_check_lens, root, index, calibration, rows)
        for frame in range(len(index)):
            scan = root / str(index.sweeps.path[frame])
            yield partial(once.check_scan_size, scan) if fast else partial(_read, once.read_scan, scan)
            for row in range(*images.offsets[frame : frame + 2]):
                image = root / str(images.path[row])
                yield partial(_check_image, image, None, label_files is not None, fast, report)
                if label_files is not None:
                    folder = label_files / image.relative_to(root / "data").parent
                    yield partial(_check_once_label, image, folder, fast)

    files_per_image = 1 if label_files is None else 2
    return len(lenses) + len(index) + files_per_image * len(images.path), checks()


LAYOUTS: dict[str, Callable[[Path, str | None, str | None, bool, Report], tuple[int, Iterator[Check]]]] = {
    "nuscenes": check_nuscenes,
    "folder": check_folder,
    "once": check_once,
}
"""By the name of `find_layout`. Each gets root, version, labels, whether to read headers only, and the report. It adds
what concerns the data set as a whole to the report, and gives the number of files to check and a check for each."""


def _read(read: Callable[..., object], *arguments: object) -> None:
    read(*arguments)


def _image_checks(
    image: Path, stem: str, width: int, height: int, labels: Path | None, fast: bool, report: Report
) -> Iterator[Check]:
    """Image and, where ``labels`` is the folder of its camera, the label of it."""
    yield partial(_check_image, image, (width, height), labels is not None, fast, report)
    if labels is not None:
        yield partial(_check_label, labels, stem, width, height, fast)


def _check_image(image: Path, size: tuple[int, int] | None, required: bool, fast: bool, report: Report) -> None:
    if not required and not image.is_file():
        report.note("image is missing; training without labels does without")
        return
    if size is None:
        rgb_image_size(image)
    else:
        check_image_header(image, *size)
    if not fast:
        read_rgb(image)


def _check_label(folder: Path, stem: str, width: int, height: int, fast: bool) -> None:
    file = find_label_file(folder, stem)
    if not fast:
        PseudoLabel(file, width, height).class_map()
    elif file.stat().st_size == 0:
        raise FrameError(file, "label must be a readable file, got an empty one")


def _check_lens(root: Path, index: FrameIndex, calibration: int, images: range) -> None:
    """Whether the distortion of one camera of one sequence can be undone; ``images`` are rows of its images."""
    for row in images:
        try:
            width, height = rgb_image_size(root / str(index.images.path[row]))
        except FrameError:
            continue  # which the image's own check says
        once.pinhole_intrinsics(root, index, calibration, width, height)
        return


def _check_once_label(image: Path, folder: Path, fast: bool) -> None:
    try:
        width, height = rgb_image_size(image)
    except FrameError:
        return  # which the image's own check says
    _check_label(folder, image.stem, width, height, fast)


def _check_once_split(path: Path, sequences: set[str]) -> None:
    unknown = sorted({*once.split_names(path.parents[1], path.stem)} - sequences)
    if unknown:
        raise FrameError(path, f"must name sequences that are there, got {len(unknown)} others such as {unknown[0]}")


def _check_splits(path: Path, recordings: set[str]) -> None:
    if not path.is_file():
        return
    splits = read_json(path)
    if not isinstance(splits, dict) or not all(isinstance(names, list) for names in splits.values()):
        raise FrameError(path, "must map split names to lists of names, got something else")
    unknown = sorted({str(name) for names in splits.values() for name in names} - recordings)
    if unknown:
        raise FrameError(path, f"must name recordings that are there, got {len(unknown)} others such as {unknown[0]}")


def _label_folder(root: Path, labels: str | None, report: Report) -> Path | None:
    try:
        found = label_folder(root, labels)
    except FrameError as problem:
        report.add(problem)
        return None
    if found is None:
        report.note("no pseudo labels: training will be LiDAR-only")
    else:
        report.note(f"pseudo labels: {found}")
    return found


def _problem(check: Check) -> FrameError | None:
    try:
        check()
    except FrameError as problem:
        return problem
    except OSError as error:  # a folder that may not be read, a broken disk
        return FrameError(error.filename or "?", f"must be readable, got {error.strerror}")
    return None
