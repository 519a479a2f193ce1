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


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    path = tmp_path / "pred_lidar-0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("pred/build_info.json", json.dumps({"torch": "2.13.0+cpu"}))
    return path


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
    [
        ("2.15.0, 2.14.1, 2.13.0+cpu, 2.9.1", "2.15.0"),
        ("2.9.0, 2.13.1, 2.13.0", "2.13.1"),
        ("2.13.0, 2.9.1", None),
        ("2.14.0rc1, 2.13.0.post1, 2.13.0", None),
        ("2.15.0.dev20260101, 2.14.0+cpu, 2.13.0", "2.14.0+cpu"),
    ],
)
def test_newest_is_newer_than_the_wheel(
    available: str, newest: str | None, wheel: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "elsewhere")

    def answer(command: list[str], env: dict[str, str], **options: Any) -> subprocess.CompletedProcess[str]:
        assert "PYTHONPATH" not in env
        return subprocess.CompletedProcess(command, 0, f"torch (1)\nAvailable versions: {available}\n")

    monkeypatch.setattr(subprocess, "run", answer)
    assert wheel_check.newest_torch(Path("python"), wheel) == newest


@pytest.mark.parametrize("text", ["torch (1)\n", "Available versions: 2.14.0rc1\n"])
def test_an_index_without_a_release_is_an_error(text: str, wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wheel_check, "ask", lambda command: text)
    with pytest.raises(SystemExit, match="pip lists no release of torch for python:"):
        wheel_check.newest_torch(Path("python"), wheel)


def test_a_torch_that_is_not_there_is_named_last(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its environment is removed, and the exit status is 0."""
    check = wheel_check.check

    def without_install(wheel: Path, torch: str, python: str) -> tuple[str, str]:
        return check(wheel, torch, python) if torch == "newest" else (f"torch {torch}", "passed")

    def make_folder(command: list[str]) -> None:
        Path(command[-1]).mkdir()

    monkeypatch.setattr(wheel_check, "FOLDER", tmp_path)
    monkeypatch.setattr(wheel_check, "run", make_folder)
    monkeypatch.setattr(wheel_check, "ask", lambda command: "Available versions: 2.13.0\n")
    monkeypatch.setattr(wheel_check, "check", without_install)
    _, python = wheel_check.parse(f"newest:{sys.executable}")
    checks = [f"newest:{python}", f"2.11.0:{python}"]
    monkeypatch.setattr(sys, "argv", ["wheel_check.py", *checks, "--wheel", str(wheel)])
    assert wheel_check.main() == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"newest torch for {python}: NOT CHECKED: ")
    assert not (tmp_path / "torch-newest").exists()


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
