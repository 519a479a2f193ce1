# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What make wheel-check decides before it downloads anything."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tests import wheel_check


def test_a_missing_python_is_an_error_that_names_the_variable() -> None:
    with pytest.raises(SystemExit, match=r"'python0.0' does not run:(.|\n)*WHEEL_PYTHON=(.|\n)*WHEEL_CHECKS="):
        wheel_check.parse("2.11.0:python0.0")


@pytest.mark.parametrize("text", ["2.11.0", "newest", "newest:", "latest:python3", ":python3"])
def test_a_check_without_torch_or_python_is_an_error(text: str) -> None:
    with pytest.raises(SystemExit, match="must be TORCH:PYTHON"):
        wheel_check.parse(text)


def test_a_check_names_torch_and_python() -> None:
    torch, python = wheel_check.parse(f"newest:{sys.executable}")
    assert torch == "newest" and Path(python).exists()


@pytest.mark.parametrize(
    ("available", "newest"),
    [("2.15.0, 2.14.1, 2.13.0+cpu, 2.9.1", "2.15.0"), ("2.9.0, 2.13.1, 2.13.0", "2.13.1"), ("2.13.0, 2.9.1", None)],
)
def test_newest_is_newer_than_the_wheel(
    available: str, newest: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel = tmp_path / "pred_lidar-0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("pred/build_info.json", json.dumps({"torch": "2.13.0+cpu"}))

    def answer(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0, f"torch (1)\nAvailable versions: {available}\n")

    monkeypatch.setattr(subprocess, "run", answer)
    assert wheel_check.newest_torch(Path("python"), wheel) == newest


def test_environments_are_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an earlier check left is gone when the next one installs."""
    left = tmp_path / "torch-2.11.0/lib/left.py"
    left.parent.mkdir(parents=True)
    left.touch()
    run = wheel_check.run

    def until_install(command: list[str], cwd: Path | None = None) -> None:
        if "install" in command:
            raise StopIteration
        run([*command, "--without-pip"])

    monkeypatch.setattr(wheel_check, "FOLDER", tmp_path)
    monkeypatch.setattr(wheel_check, "run", until_install)
    with pytest.raises(StopIteration):
        wheel_check.check(Path("wheel"), "2.11.0", sys.executable)
    assert not left.exists() and (tmp_path / "torch-2.11.0/bin/python").exists()
