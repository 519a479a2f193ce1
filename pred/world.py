# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The job `pred world make`: drives of the procedural world, written as a data set.

OUT/world.json     settings and versions of libraries; an OUT with others is refused
OUT/.parts/        nuScenes: one file per finished keyframe, for a run that continues; gone once the tables are there
OUT/<version>/     nuScenes: the tables; they appear last and all at once
OUT/data/          ONCE: sequences, each appears as a whole; the lists in OUT/ImageSets come last
The rest: see `pred.data.world.nuscenes_writer` and `pred.data.world.once_layout`.

Keyframes (nuScenes) or sequences (ONCE) are made by a pool of processes, each file under a temporary name first. Every
file is a function of settings and libraries alone, so a run may be killed at any moment and continued with any number
of workers.
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
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import pred
from pred.checkpoint import TEMPORARY_SUFFIX, write_text
from pred.data import index
from pred.data.world.nuscenes_writer import Part, WorldSettings, write_dataset, write_keyframe
from pred.data.world.once_layout import once_splits, sequence_name, write_sequence, write_splits
from pred.progress import Progress, format_duration
from pred.run_folder import RunFolderError, claim_settings, one_writer

Job = tuple[int, ...]
MakeDrive = Callable[[int, int, int], Any]
"""(seed, scene, keyframes) to a `pred.data.world.drive.Drive`."""


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
        RunFolderError: ``out`` holds other settings or foreign files, or another process writes to it.
        ValueError: ``workers`` is less than 1.
    """
    if make_drive is None:
        from pred.data.world.drive import Drive

        make_drive = Drive
    workers = (os.cpu_count() or 1) if workers is None else workers
    if workers < 1:
        raise ValueError(f"world: workers must be at least 1, got {workers}")
    work = _LAYOUTS[settings.layout](out, settings, make_drive)
    with one_writer(out):
        _claim(out, settings, work)
        if work.is_complete():
            shutil.rmtree(out / ".parts", ignore_errors=True)
            print(f"{out}: the world is complete; nothing to do")
        else:
            _do(out, settings, work, workers)


class _Work(NamedTuple):
    """How a layout is made: jobs in any order and by any process, then what completes the data set.

    Attributes:
        unit: what a job makes.
        jobs: all of them.
        is_done: whether a job's files are whole.
        do: runs one job. It goes to other processes.
        finish: completes the data set; returns the bytes of all files of the keyframes.
        is_complete: whether that has happened.
        folders: names in OUT.
    """

    unit: str
    jobs: list[Job]
    is_done: Callable[[Job], bool]
    do: Callable[[Job], None]
    finish: Callable[[], int]
    is_complete: Callable[[], bool]
    folders: frozenset[str]


def _do(out: Path, settings: WorldSettings, work: _Work, workers: int) -> None:
    missing = [job for job in work.jobs if not work.is_done(job)]
    start_time = time.monotonic()
    progress = Progress(work.unit, len(work.jobs), done=len(work.jobs) - len(missing))
    keyframes_a_job = settings.scenes * settings.keyframes // len(work.jobs)
    with progress, _pool(workers) as run:
        for done, _ in enumerate(run(work.do, missing), start=1):
            rate = done * keyframes_a_job / (time.monotonic() - start_time)
            progress.update(len(work.jobs) - len(missing) + done, f"{rate:.2f} keyframes/s")
    elapsed_s = time.monotonic() - start_time

    for leftover in out.rglob(f".*{TEMPORARY_SUFFIX}"):
        if leftover.is_file():
            leftover.unlink()
    num_bytes = work.finish()
    shutil.rmtree(out / ".parts", ignore_errors=True)
    made, keyframes = len(missing) * keyframes_a_job, settings.scenes * settings.keyframes
    print(
        f"{out}: {settings.scenes} scenes, {keyframes} keyframes; {made} made in {format_duration(elapsed_s)}, "
        f"{made / elapsed_s:.2f} keyframes/s; {num_bytes / keyframes / 1e6:.2f} MB per keyframe"
    )


# The layouts


def _nuscenes(out: Path, settings: WorldSettings, make_drive: MakeDrive) -> _Work:
    """A job is a keyframe, (scene, number)."""
    parts = out / ".parts"
    return _Work(
        unit="keyframes",
        jobs=[(scene, number) for scene in range(settings.scenes) for number in range(settings.keyframes)],
        is_done=lambda job: _part_file(parts, *job).is_file(),
        do=partial(_make_keyframe, out, settings, make_drive),
        finish=lambda: write_dataset(out, settings, _read_parts(parts, settings)),
        is_complete=(out / settings.version).is_dir,
        folders=frozenset({"samples", "sweeps", "lidarseg", "maps", "pseudo", "depth", settings.version}),
    )


def _once(out: Path, settings: WorldSettings, make_drive: MakeDrive) -> _Work:
    """A job is a sequence, (scene,)."""
    lists = [out / "ImageSets" / f"{split}.txt" for split in once_splits(settings.scenes)]
    return _Work(
        unit="sequences",
        jobs=[(scene,) for scene in range(settings.scenes)],
        is_done=lambda job: (out / "data" / sequence_name(*job)).is_dir(),
        do=partial(_make_sequence, out, settings, make_drive),
        finish=lambda: write_splits(out, settings),
        is_complete=lambda: all(path.is_file() for path in lists),
        folders=frozenset({"data", "ImageSets", "pseudo", "depth"}),
    )


_LAYOUTS: dict[str, Callable[[Path, WorldSettings, MakeDrive], _Work]] = {"nuscenes": _nuscenes, "once": _once}


def _make_sequence(out: Path, settings: WorldSettings, make_drive: MakeDrive, job: Job) -> None:
    write_sequence(out, settings, _drive(make_drive, settings.seed, *job, settings.keyframes), *job)


def _make_keyframe(out: Path, settings: WorldSettings, make_drive: MakeDrive, job: Job) -> None:
    """Files and part of one keyframe. The part comes last: where it is, the files are whole."""
    scene, number = job
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


def _libraries() -> dict[str, str]:
    """Versions of the packages on which the bytes of the files depend."""
    return {name: metadata.version(name) for name in ("embreex", "numpy", "pillow")}


def _claim(out: Path, settings: WorldSettings, work: _Work) -> None:
    """Make the folder the settings' own, or check that it is."""
    record = out / "world.json"
    wanted = {**asdict(settings), "made_by": f"pred {pred.__version__}", "libraries": _libraries()}
    if work.is_complete():  # no more files of the world come; other jobs may add theirs
        claim_settings(record, wanted, ignored=("libraries",))
        return
    claim_settings(record, wanted)
    own = {record.name, ".parts", index.FILE_NAME, *work.folders}
    held = sorted(path.name for path in out.iterdir())
    foreign = [name for name in held if name not in own and not name.endswith(TEMPORARY_SUFFIX)]
    if foreign:
        raise RunFolderError(f"{out}: must hold nothing but the interrupted world, got {foreign[0]}")


# Processes

Run = Callable[[Callable[[Job], None], list[Job]], Iterable[None]]


@contextmanager
def _pool(workers: int) -> Iterator[Run]:
    """A function that runs jobs and yields once for each that is done: here, or in processes of their own.

    Processes are started afresh: forking one that has threads is not safe.
    """
    if workers == 1:
        yield map
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker) as pool:

        def run(function: Callable[[Job], None], jobs: list[Job]) -> Iterator[None]:
            for done in as_completed([pool.submit(function, job) for job in jobs]):
                yield done.result()

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
