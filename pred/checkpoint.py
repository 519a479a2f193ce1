# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Files that survive a kill at any moment: atomic writes, checkpoints of tensors and plain values.

A file is written under a temporary name in its own folder, flushed to the disk and then renamed, so a name either holds
the old content or the whole new one. Checkpoints load with ``weights_only=True``: reading one never runs code.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch

_NAME = re.compile(r"step_(\d{8,})\.pt")
_REFUSED = re.compile(r"GLOBAL ([\w.]+)")
_ZIP_START = b"PK\x03\x04"
TEMPORARY_SUFFIX = ".partial"


class CheckpointError(RuntimeError):
    """A checkpoint cannot be used. The text names the file."""


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Open a binary file that replaces ``path`` when the block ends without an error, and vanishes otherwise."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def remove_leftovers(path: Path) -> None:
    """Remove what killed processes left of ``path``, which nobody may be writing now."""
    for leftover in path.parent.glob(f".{path.name}.*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` with ``text`` (UTF-8), atomically."""
    with atomic_write(path) as file:
        file.write(text.encode())


def save_tensors(path: Path, state: Mapping[str, Any]) -> None:
    """Write a nested mapping of tensors and plain values, atomically.

    Raises:
        TypeError: a value is neither a tensor nor plain (bool, int, float, str, None; dict, list, tuple of these), so
            that it could not be read back with ``weights_only=True``. The text names its key.
    """
    _check_plain(state, "")
    with atomic_write(path) as file:
        torch.save(dict(state), file)


def load_tensors(path: Path) -> dict[str, Any]:
    """Read a dictionary of tensors and plain values onto the CPU: what `save_tensors` wrote, or a file of others.

    Raises:
        CheckpointError: the file is missing, truncated or damaged, or holds anything but tensors and plain values.
    """
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                # torch.load itself does not compare checksums: a flipped bit would become a wrong weight.
                damaged = archive.testzip()
            if damaged is not None:
                raise CheckpointError(f"{path}: must be intact, got a wrong checksum in its part {damaged}")
        elif path.stat().st_size == 0:
            raise CheckpointError(f"{path}: must be a readable checkpoint, got an empty file")
        elif _starts_as_zip(path):
            raise CheckpointError(f"{path}: must be a readable checkpoint, got a truncated one: it has no end")
        # What is no zip archive may be of the form before torch 1.6.
        state = torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except FileNotFoundError:
        raise CheckpointError(f"{path}: must exist, got no such file") from None
    # Damage shows as BadZipFile, EOFError, RuntimeError, UnpicklingError, zlib.error, KeyError, ...
    except Exception as error:
        raise CheckpointError(f"{path}: must be a readable checkpoint, got {_reason(error)}") from None
    if not isinstance(state, dict):
        raise CheckpointError(f"{path}: must hold a dictionary, got {type(state).__name__}")
    return state


def _starts_as_zip(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(len(_ZIP_START)) == _ZIP_START


def _reason(error: Exception) -> str:
    """What is wrong with a file that torch did not load."""
    refused = _REFUSED.search(str(error))
    if refused is None:
        return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
    name = refused[1]
    if name.startswith("numpy"):
        what = f"a NumPy value ({name}), which torch 2.6 and later do not load: somewhere beside the weights"
    else:
        what = f"an object of {name}, which only code from the file could make: nothing of it was run"
    return (
        f"{what}. Where the file comes from somebody you trust, write the weights alone, with plain values: "
        "state = torch.load(FILE, map_location='cpu', weights_only=False); torch.save({'model_state': "
        "dict(state['model_state'])}, NEW) (mmdetection3d: 'state_dict')"
    )


@dataclass
class LatestCheckpoint:
    """The newest checkpoint that could be read.

    Attributes:
        path: its file.
        state: its content.
        damaged: what was wrong with each newer one.
    """

    path: Path
    state: dict[str, Any]
    damaged: list[str] = field(default_factory=list)


def checkpoint_path(folder: Path, step: int) -> Path:
    """Name of the checkpoint written after ``step`` steps."""
    return folder / f"step_{step:08d}.pt"


def list_checkpoints(folder: Path) -> list[Path]:
    """Checkpoints of a folder in ascending order of their step; empty where the folder is missing."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if _NAME.fullmatch(path.name)), key=_step_of)


def save_checkpoint(folder: Path, step: int, state: Mapping[str, Any], keep_last: int) -> Path:
    """Write ``state`` as the checkpoint of ``step`` and delete all but the last ``keep_last`` up to it."""
    if keep_last < 1:
        raise ValueError(f"save_checkpoint: keep_last must be at least 1, got {keep_last}")
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):  # of a run that was killed while it wrote
        leftover.unlink(missing_ok=True)
    path = checkpoint_path(folder, step)
    save_tensors(path, {**state, "step": step})
    # A later one can only be a damaged file that the resumed run has yet to replace: it must not push out a good one.
    for old in [other for other in list_checkpoints(folder) if _step_of(other) <= step][:-keep_last]:
        old.unlink()
    return path


def load_latest(folder: Path) -> LatestCheckpoint | None:
    """The newest readable checkpoint of a folder, or None where there is none at all.

    Raises:
        CheckpointError: there are checkpoints, but none can be read; the text names each and what is wrong with it.
    """
    damaged: list[str] = []
    for path in reversed(list_checkpoints(folder)):
        try:
            return LatestCheckpoint(path, load_tensors(path), damaged)
        except CheckpointError as error:
            damaged.append(str(error))
    if damaged:
        raise CheckpointError(
            f"{folder}: must hold a readable checkpoint, got only damaged ones:\n" + "\n".join(damaged)
        )
    return None


def _step_of(path: Path) -> int:
    match = _NAME.fullmatch(path.name)
    assert match is not None
    return int(match[1])


def _check_plain(value: Any, key: str) -> None:
    if value is None or type(value) in (bool, int, float, str) or isinstance(value, torch.Tensor):
        return
    if isinstance(value, Mapping):
        for name, item in value.items():
            if type(name) not in (str, int):
                raise TypeError(f"save_tensors: keys must be str or int, got {type(name).__name__} in '{key}'")
            _check_plain(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _check_plain(item, f"{key}.{index}")
    else:
        raise TypeError(f"save_tensors: '{key}' must be a tensor or a plain value, got {type(value).__name__}")


def sync_folder(folder: Path) -> None:
    """Make a rename durable. Not every system can open a folder."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
