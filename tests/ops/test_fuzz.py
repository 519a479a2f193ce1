# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A short run of fuzz_ops.py; ``make fuzz`` makes a long one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import SANITIZED


def fuzz(*options: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    command = [sys.executable, "-m", "tests.fuzz_ops", *options]
    return subprocess.run(command, env=environment, cwd=Path(os.sep), capture_output=True, text=True)


def test_random_arguments_are_taken_or_refused(native: None) -> None:
    result = fuzz("--calls", "300" if SANITIZED else "1500", "--seed", "7", "--minutes", "5")
    assert result.returncode == 0, result.stdout + result.stderr
    assert " 0 findings" in result.stdout.splitlines()[-1]


def test_one_call_can_be_repeated(native: None) -> None:
    first, second = fuzz("--only", "3"), fuzz("--only", "3")
    assert first.returncode == 0 and first.stdout == second.stdout
    assert "pred" in first.stdout
