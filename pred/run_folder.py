# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What a run leaves on disk: resolved configuration, versions, logs, checkpoints, pictures, weights.

RUN/config.yaml                 resolved configuration
RUN/run.json                    versions, commit, seed, command, frames; one entry per resume
RUN/log.csv                     loss terms by step; the same bytes with and without an interruption
RUN/timing.csv                  rates by step
RUN/tensorboard/                the same for TensorBoard
RUN/checkpoints/step_*.pt       see `pred.checkpoint`
RUN/encoder.pth, encoder.pth.json  the product, once training has ended; see `pred.encoder_file`
RUN/pictures/, RUN/*.json       made by `pred view` and `pred evaluate`
"""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

import torch

import pred
from pred._native import native_status
from pred.checkpoint import TEMPORARY_SUFFIX, write_text


class RunFolderError(RuntimeError):
    """A folder that a job writes to is missing, incomplete, in use, or another's."""


@dataclass
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.yaml"

    @property
    def info(self) -> Path:
        return self.path / "run.json"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def pictures(self) -> Path:
        return self.path / "pictures"

    @property
    def encoder(self) -> Path:
        return self.path / "encoder.pth"

    def start(self, config_yaml: str) -> None:
        """Make the folder and write its configuration.

        Raises:
            RunFolderError: it already holds a run.
        """
        held = [name for name in ("config.yaml", "checkpoints", "log.csv") if (self.path / name).exists()]
        if held:
            raise RunFolderError(
                f"{self.path}: run folder must be new, got one that already holds {held[0]}; "
                f"continue it with: pred pretrain --resume {self.path}"
            )
        self.path.mkdir(parents=True, exist_ok=True)
        write_text(self.config, config_yaml)

    def require(self) -> None:
        """
        Raises:
            RunFolderError: there is no run in this folder.
        """
        if not self.path.is_dir():
            raise RunFolderError(f"{self.path}: run folder must exist, got no such folder")
        if not self.config.is_file():
            raise RunFolderError(f"{self.path}: run folder must hold config.yaml, got none: no run was started here")

    def is_imported(self) -> bool:
        """Whether the weights come from elsewhere (`pred import`), not from a training here.

        Raises:
            RunFolderError: run.json is damaged.
        """
        return "imported" in self._read_info()

    def record_start(self, facts: Mapping[str, Any], resumed_step: int | None) -> None:
        """Add this process to run.json; a resumed run keeps the record of its first start.

        Raises:
            RunFolderError: run.json of the first start is damaged.
        """
        record = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
            **environment(),
            **facts,
        }
        content = self._read_info() if resumed_step is not None else {}
        if content:
            content.setdefault("resumed", []).append({"step": resumed_step, **record})
        write_json(self.info, content or record)

    def _read_info(self) -> dict[str, Any]:
        """What run.json holds; nothing where there is none."""
        if not self.info.is_file():
            return {}
        return _read_object(self.info, "the record of the run")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Replace ``path`` with ``content`` as indented JSON, atomically."""
    write_text(path, json.dumps(content, indent=2) + "\n")


@contextmanager
def one_writer(folder: Path) -> Iterator[None]:
    """Make a folder if need be and hold it for this process. The lock leaves no file and ends with the process; what
    a killed one left half-written in the folder is removed.

    Raises:
        RunFolderError: it is a file, or another process holds it.
    """
    if folder.exists() and not folder.is_dir():
        raise RunFolderError(f"{folder}: must be a folder, got a file")
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"{folder}: must have one writer, got another process") from None
        for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
                leftover.unlink()
        yield
    finally:
        os.close(descriptor)


def claim_settings(path: Path, wanted: Mapping[str, Any], ignored: Collection[str] = ()) -> None:
    """Make the folder of ``path`` that of a job with these settings, or check that it is.

    Args:
        path: where the settings are kept, as JSON.
        wanted: settings of this job.
        ignored: names of settings that may differ.

    Raises:
        RunFolderError: it holds a job with other settings, or foreign files. The text names what differs.
    """
    folder = path.parent
    if folder.exists() and not folder.is_dir():
        raise RunFolderError(f"{folder}: must be a folder, got a file")
    if not path.is_file():
        held = sorted(file.name for file in folder.glob("*") if not file.name.endswith(TEMPORARY_SUFFIX))
        if held:
            raise RunFolderError(f"{folder}: must be new or empty, or hold {path.name}, got {held[0]}")
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)
        return
    found = _read_object(path, "the settings of the job")
    wanted = json.loads(json.dumps(wanted))
    for name in sorted({*wanted, *found} - {*ignored}):
        if found.get(name) != wanted.get(name):
            raise RunFolderError(
                f"{folder}: {name} must be {found.get(name)!r} as in {path.name}, got {wanted.get(name)!r}"
            )


def _read_object(path: Path, meaning: str) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise RunFolderError(f"{path}: must be {meaning}, got no valid JSON: {error}") from None
    if not isinstance(found, dict):
        raise RunFolderError(f"{path}: must be {meaning}, a JSON object, got {type(found).__name__}")
    return found


def environment() -> dict[str, Any]:
    """What decides the bits of a run besides its configuration: versions, backend, threads."""
    status = native_status()
    return {
        "versions": {
            "pred": pred.__version__,
            "python": platform.python_version(),
            **{name: _version(name) for name in ("torch", "numpy", "lightning-fabric")},
        },
        "commit": _commit(),
        "backend": os.environ.get("PRED_BACKEND", "auto"),
        "native": status["available"],
        "cpu_capability": status["cpu_capability"],
        "threads": torch.get_num_threads(),
        "machine": platform.machine(),
    }


class CsvLog:
    """A CSV file with one row per logged step, flushed row by row.

    Args:
        path: the file; rows of steps after ``last_step`` (written before a kill, after the checkpoint) are cut.
        last_step: steps done so far.
    """

    def __init__(self, path: Path, last_step: int) -> None:
        self._columns: list[str] | None = None
        if path.exists():
            self._columns = _cut_rows(path, last_step)
        self._file = open(path, "a", newline="")

    def write(self, row: Mapping[str, int | float]) -> None:
        """Add a row. The first row of a file fixes the columns; each further one must have the same."""
        if self._columns is None:
            self._columns = list(row)
            self._write_line(self._columns)
        if list(row) != self._columns:
            raise ValueError(f"CsvLog: row must have the columns {self._columns}, got {list(row)}")
        self._write_line(row.values())

    def _write_line(self, values: Any) -> None:
        csv.writer(self._file, lineterminator="\n").writerow(values)
        self._file.flush()

    def sync(self) -> None:
        """Make the rows durable: before a checkpoint, so that it never knows more steps than its log."""
        os.fsync(self._file.fileno())

    def __enter__(self) -> CsvLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _cut_rows(path: Path, last_step: int) -> list[str] | None:
    text = path.read_text()
    # A killed writer may leave half a line.
    complete = text[: text.rfind("\n") + 1]
    rows = list(csv.reader(io.StringIO(complete)))
    if not rows:
        write_text(path, "")
        return None
    lines = complete.splitlines(keepends=True)
    kept = [line for line, row in zip(lines[1:], rows[1:], strict=True) if int(row[0]) <= last_step]
    write_text(path, lines[0] + "".join(kept))
    return rows[0]


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the checkout this package lies in ("-dirty" if changed), or None outside of one."""
    folder = Path(pred.__file__).resolve().parent
    try:
        # A package installed below somebody else's checkout is not tracked there.
        _git(folder, "ls-files", "--error-unmatch", "__init__.py")
        return _git(folder, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
