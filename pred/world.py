# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The job `pred world make`: drives of the procedural world, written as a data set.

OUT/world.json     the settings; an OUT with others is refused
OUT/.parts/        one file per finished keyframe, for a run that continues; gone once the tables are there
OUT/<version>/     the tables; they appear last and all at once
OUT/samples, sweeps, lidarseg, maps, pseudo, depth: see `pred.data.world.nuscenes_writer`

Keyframes are made by a pool of processes, each file under a temporary name first. Every file is a function of the
settings alone, so a run may be killed at any moment and continued with any number of workers.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import pred
from pred.checkpoint import TEMPORARY_SUFFIX, write_text
from pred.data.world.nuscenes_writer import Part, WorldSettings, write_dataset, write_keyframe
from pred.progress import Progress, format_duration

MakeDrive = Callable[[int, int, int], Any]
"""(seed, scene, keyframes) to a `pred.data.world.drive.Drive`."""


class WorldFolderError(ValueError):
    """An output folder holds something else. The text names what."""


def make_world(
    out: Path, settings: WorldSettings, workers: int | None = None, make_drive: MakeDrive | None = None
) -> None:
    """Write a world to ``out``, or the rest of one.

    Args:
        out: new or empty folder, or one in which a run with equal settings was interrupted.
        settings: what is written.
        workers: processes; one per core when None. No byte depends on it.
        make_drive: replaces the procedural drives. It must be importable by name where workers is not 1.

    Raises:
        WorldFolderError: ``out`` holds other settings or foreign files.
        ValueError: ``workers`` is less than 1.
    """
    if make_drive is None:
        from pred.data.world.drive import Drive

        make_drive = Drive
    workers = (os.cpu_count() or 1) if workers is None else workers
    if workers < 1:
        raise ValueError(f"world: workers must be at least 1, got {workers}")
    _claim(out, settings)
    parts = out / ".parts"
    if (out / settings.version).is_dir():
        shutil.rmtree(parts, ignore_errors=True)
        print(f"{out}: the world is complete; nothing to do")
        return

    keyframes = [(scene, number) for scene in range(settings.scenes) for number in range(settings.keyframes)]
    missing = [key for key in keyframes if not _part_file(parts, *key).is_file()]
    start_time = time.monotonic()
    progress = Progress("keyframes", len(keyframes), done=len(keyframes) - len(missing))
    with progress, _pool(workers) as run:
        for done, _ in enumerate(run(partial(_make_keyframe, out, settings, make_drive), missing), start=1):
            rate = done / (time.monotonic() - start_time)
            progress.update(len(keyframes) - len(missing) + done, f"{rate:.2f} keyframes/s")
    elapsed_s = time.monotonic() - start_time

    for leftover in out.rglob(f".*{TEMPORARY_SUFFIX}"):
        if leftover.is_file():
            leftover.unlink()
    num_bytes = write_dataset(out, settings, _read_parts(parts, settings))
    shutil.rmtree(parts)
    rate_text = f"{len(missing)} made in {format_duration(elapsed_s)}, {len(missing) / elapsed_s:.2f} keyframes/s"
    print(
        f"{out}: {settings.scenes} scenes, {len(keyframes)} keyframes; {rate_text}; "
        f"{num_bytes / len(keyframes) / 1e6:.2f} MB per keyframe"
    )


def _make_keyframe(out: Path, settings: WorldSettings, make_drive: MakeDrive, key: tuple[int, int]) -> None:
    """Files and part of one keyframe. The part comes last: where it is, the files are whole."""
    scene, number = key
    drive = _drive(make_drive, settings.seed, scene, settings.keyframes)
    part = write_keyframe(out, settings, drive, scene, number)
    path = _part_file(out / ".parts", scene, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(part, allow_nan=False))


@lru_cache(maxsize=1)
def _drive(make_drive: MakeDrive, seed: int, scene: int, keyframes: int) -> Any:
    """Keyframes come scene by scene, so the last drive is the one that is wanted next."""
    return make_drive(seed, scene, keyframes)


def _read_parts(parts: Path, settings: WorldSettings) -> Iterator[list[Part]]:
    """Parts of all keyframes, scene by scene."""
    for scene in range(settings.scenes):
        yield [json.loads(_part_file(parts, scene, number).read_text()) for number in range(settings.keyframes)]


def _part_file(parts: Path, scene: int, number: int) -> Path:
    return parts / f"scene-{scene:04d}" / f"keyframe-{number:04d}.json"


# The folder


def _claim(out: Path, settings: WorldSettings) -> None:
    """Make the folder the settings' own, or check that it is."""
    record = out / "world.json"
    wanted = {**asdict(settings), "made_by": f"pred {pred.__version__}"}
    held = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if out.exists() and not out.is_dir():
        raise WorldFolderError(f"{out}: must be a folder, got a file")
    if not record.is_file():
        foreign = [name for name in held if not name.startswith(f".{record.name}.")]
        if foreign:
            raise WorldFolderError(f"{out}: must be new or empty, or hold an interrupted world, got {foreign[0]}")
        out.mkdir(parents=True, exist_ok=True)
        write_text(record, json.dumps(wanted, indent=2) + "\n")
        return
    try:
        found = json.loads(record.read_text())
    except ValueError as error:
        raise WorldFolderError(f"{record}: must be the settings of a world, got no valid JSON: {error}") from None
    for name in wanted:
        value = found.get(name) if isinstance(found, dict) else None
        if value != wanted[name]:
            raise WorldFolderError(f"{record}: {name} must be {wanted[name]!r} as asked for, got {value!r}")
    own = {record.name, ".parts", "samples", "sweeps", "lidarseg", "maps", "pseudo", "depth", settings.version}
    if settings.version in held:  # complete: other jobs may add to it
        return
    foreign = [name for name in held if name not in own and not name.endswith(TEMPORARY_SUFFIX)]
    if foreign:
        raise WorldFolderError(f"{out}: must hold nothing but the interrupted world, got {foreign[0]}")


# Processes

Run = Callable[[Callable[[tuple[int, int]], None], list[tuple[int, int]]], Iterable[None]]


@contextmanager
def _pool(workers: int) -> Iterator[Run]:
    """A function that runs jobs and yields once for each that is done: here, or in processes of their own.

    Processes are started afresh: forking one that has threads is not safe.
    """
    if workers == 1:
        yield map
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker) as pool:

        def run(function: Callable[[tuple[int, int]], None], keys: list[tuple[int, int]]) -> Iterator[None]:
            for job in as_completed([pool.submit(function, key) for key in keys]):
                yield job.result()

        try:
            yield run
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _start_worker() -> None:
    """Ctrl-C is the parent's to handle. A worker whose parent was killed ends: it would wait for work for ever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
