# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pred import checkpoint
from pred.checkpoint import (
    CheckpointError,
    atomic_write,
    list_checkpoints,
    load_latest,
    load_tensors,
    save_checkpoint,
    save_tensors,
    write_text,
)


def state(value: float) -> dict[str, object]:
    return {"model": {"w": torch.full((500,), value)}, "optimizer": {"groups": [{"lr": 0.1, "betas": (0.9, 0.99)}]}}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_round_trip_keeps_bits_and_plain_values(tmp_path: Path) -> None:
    weights = torch.randn(7, 3, generator=torch.Generator().manual_seed(0))
    save_tensors(tmp_path / "a.pt", {"w": weights, "step": 3, "name": "x", "none": None, "list": [1, 2.5, (True,)]})
    loaded = load_tensors(tmp_path / "a.pt")
    assert torch.equal(loaded.pop("w"), weights)
    assert loaded == {"step": 3, "name": "x", "none": None, "list": [1, 2.5, (True,)]}


@pytest.mark.parametrize(
    ("value", "key"),
    [({"a": {"b": np.float64(1.0)}}, "a.b"), ({"a": [Path("x")]}, "a.0"), ({"f": print}, "f")],
)
def test_values_that_could_not_be_read_back_are_refused(tmp_path: Path, value: dict[str, object], key: str) -> None:
    with pytest.raises(TypeError, match=f"'{key}' must be a tensor or a plain value"):
        save_tensors(tmp_path / "a.pt", value)
    assert names(tmp_path) == []


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.txt") as file:
        file.write(b"half of the new")
        raise KeyboardInterrupt
    assert (tmp_path / "a.txt").read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_the_file_is_flushed_before_and_the_folder_after_the_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    for name in ("fsync", "replace"):
        original = getattr(checkpoint.os, name)

        def record(*arguments: Any, name: str = name, original: Any = original) -> None:
            calls.append(name)
            original(*arguments)

        monkeypatch.setattr(checkpoint.os, name, record)
    write_text(tmp_path / "a.txt", "new")
    assert calls == ["fsync", "replace", "fsync"]


def test_latest_is_the_highest_step_and_old_ones_are_deleted(tmp_path: Path) -> None:
    for step in (5, 10, 100_000_000, 15):
        save_checkpoint(tmp_path, step, state(step), keep_last=2)
    # 15 is written last: it may not delete the later one, which it does not count either.
    assert names(tmp_path) == ["step_00000010.pt", "step_00000015.pt", "step_100000000.pt"]
    latest = load_latest(tmp_path)
    assert latest is not None and latest.state["step"] == 100_000_000 and latest.damaged == []
    assert latest.path == list_checkpoints(tmp_path)[-1]


def test_no_checkpoint_is_not_an_error(tmp_path: Path) -> None:
    assert load_latest(tmp_path) is None
    assert load_latest(tmp_path / "missing") is None


def damage(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "truncated":
        content = content[: len(content) // 2]
    elif how == "empty":
        content = bytearray()
    elif how == "bit":
        value = torch.full((500,), 10.0).numpy().tobytes()
        content[content.index(value) + 100] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("how", ["truncated", "empty", "bit"])
def test_damaged_newest_is_named_and_the_previous_one_used(tmp_path: Path, how: str) -> None:
    save_checkpoint(tmp_path, 5, state(5.0), keep_last=3)
    newest = save_checkpoint(tmp_path, 10, state(10.0), keep_last=3)
    damage(newest, how)
    latest = load_latest(tmp_path)
    assert latest is not None and latest.state["step"] == 5
    assert torch.equal(latest.state["model"]["w"], torch.full((500,), 5.0))
    assert len(latest.damaged) == 1 and str(newest) in latest.damaged[0]
    # Writing goes on, and the damaged file does not count among the ones that are kept.
    save_checkpoint(tmp_path, 6, state(6.0), keep_last=1)
    assert names(tmp_path) == ["step_00000006.pt", "step_00000010.pt"]


def test_only_damaged_checkpoints_is_an_error_that_names_them(tmp_path: Path) -> None:
    for step in (5, 10):
        damage(save_checkpoint(tmp_path, step, state(step), keep_last=3), "empty")
    with pytest.raises(CheckpointError, match=r"(?s)step_00000010\.pt.*step_00000005\.pt"):
        load_latest(tmp_path)


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    torch.save({"optimizer": torch.optim.AdamW}, tmp_path / "step_00000001.pt")
    with pytest.raises(CheckpointError, match=r"step_00000001\.pt: must be a readable checkpoint"):
        load_latest(tmp_path)


def test_missing_file_and_wrong_content(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="must exist"):
        load_tensors(tmp_path / "a.pt")
    torch.save([1, 2], tmp_path / "list.pt")
    with pytest.raises(CheckpointError, match="must hold a dictionary, got list"):
        load_tensors(tmp_path / "list.pt")


def test_leftovers_of_a_killed_writer_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".step_00000003.pt.123.partial").write_bytes(b"half")
    save_checkpoint(tmp_path, 4, state(4.0), keep_last=1)
    assert names(tmp_path) == ["step_00000004.pt"]
