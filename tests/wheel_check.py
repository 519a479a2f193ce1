# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the op tests of one wheel under other versions of torch and Python, without building it again.

    python tests/wheel_check.py 2.11.0:python3.12 newest:python3.12

The wheel is built with the running Python and its torch. Each check is a torch version and a Python command; "newest"
is the newest torch of the package index, if that is newer than the wheel's. Each gets a virtual environment in
build/wheel-check, made anew and removed once its tests have passed. Only torch, pytest, numpy and hypothesis are
installed there: the ops need nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build/wheel-check"
COPIED = (
    "tests/conftest.py",
    "tests/tolerances.py",
    "tests/fuzz_ops.py",
    "tests/ops",
    "benchmarks",
)  # inputs are shared
NOT_CHECKED = "NOT CHECKED"
RELEASE = re.compile(r"\d+(\.\d+)+(\+.*)?")
FACTS = """
import sys, torch
from pred import _native
status = _native.native_status()
assert status["available"], status["reason"]
assert status["path"].startswith(sys.prefix), status["path"]
print(f"torch {torch.__version__}, Python {sys.version.split()[0]}, wheel built with torch {status['build']['torch']}")
"""


def clean_env() -> dict[str, str]:
    """Without the variables that would change what is tested."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PRED_", "PYTHON"))}
    return kept | {"PRED_REQUIRE_NATIVE": "1"}


def run(command: list[str], cwd: Path | None = None) -> None:
    subprocess.run(command, check=True, cwd=cwd, env=clean_env())


def ask(command: list[str], cwd: Path | None = None) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=cwd, env=clean_env()).stdout


def build() -> Path:
    """The wheel."""
    target = FOLDER / "wheel"
    shutil.rmtree(target, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q", "wheel"]
    run([*pip, "--no-build-isolation", "--no-deps", "-w", str(target), str(ROOT)])
    (wheel,) = target.glob("*.whl")
    print(f"built {wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB)", flush=True)
    return wheel


def find_python(command: str) -> str:
    """The path of a Python that runs, and can make environments; there is no second choice."""
    code = "import sys, ensurepip, venv; print(sys.executable)"
    try:
        found = subprocess.run([command, "-c", code], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(
            f"wheel_check: Python {command!r} does not run:\n{getattr(error, 'stderr', None) or error}\n"
            "Name one that does: make wheel-check WHEEL_PYTHON=/path/to/python, or all checks:\n"
            'make wheel-check WHEEL_CHECKS="2.11.0:/path/to/python newest:/path/to/python"'
        )
    return found.stdout.strip()


def parse(text: str) -> tuple[str, str]:
    """Torch version and path of the Python of one check."""
    torch, _, python = text.partition(":")
    if not (torch == "newest" or re.fullmatch(r"\d+(\.\d+)+", torch)) or not python:
        sys.exit(f"wheel_check: a check must be TORCH:PYTHON, such as 2.11.0:python3.12, got {text!r} (WHEEL_CHECKS)")
    return torch, find_python(python)


def release(version: str) -> tuple[int, ...]:
    """2.13.0+cpu as (2, 13, 0); 2.14.0rc1, or a nightly that the wheel was built with, as (2, 14, 0)."""
    found = re.match(r"\d+(\.\d+)*", version)
    assert found is not None, version
    return tuple(int(number) for number in found.group().split("."))


def newest_torch(python: Path, wheel: Path) -> str | None:
    """The newest torch that the index has for this Python, if it is newer than the one the wheel was built with."""
    built = json.loads(zipfile.ZipFile(wheel).read("pred/build_info.json"))["torch"]
    command = [str(python), "-m", "pip", "--disable-pip-version-check", "index", "versions", "torch"]
    answer = ask(command)
    listed = re.search(r"^Available versions: (.*)$", answer, re.MULTILINE)
    found = [version for version in listed.group(1).split(", ") if RELEASE.fullmatch(version)] if listed else []
    if not found:
        sys.exit(f"wheel_check: pip lists no release of torch for {python}:\n{answer}")
    newest = max(found, key=release)
    return newest if release(newest) > release(built) else None


def check(wheel: Path, torch: str, python: str) -> tuple[str, str]:
    """Installs torch and the wheel, runs the tests; returns the versions and the result."""
    environment = FOLDER / f"torch-{torch}"
    binary = environment / "bin/python"
    run([python, "-m", "venv", "--clear", str(environment)])
    if torch == "newest":
        found = newest_torch(binary, wheel)
        if found is None:
            shutil.rmtree(environment)
            return f"newest torch for {python}", f"{NOT_CHECKED}: the index has none that is newer than the wheel's"
        torch = found
    print(f"torch {torch}: pip downloads 2 to 4 GB with its CUDA libraries; {environment} takes some 6 GB", flush=True)
    install = [str(binary), "-m", "pip", "--disable-pip-version-check", "-q", "install"]
    run([*install, f"torch=={torch}", "pytest", "numpy", "hypothesis"])
    run([*install, "--no-deps", str(wheel)])
    with tempfile.TemporaryDirectory() as name:
        outside = Path(name)  # of the source tree, whose pred/ would be imported
        for part in COPIED:
            source, target = ROOT / part, outside / part
            target.parent.mkdir(exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("results", "__pycache__"))
            else:
                shutil.copy(source, target)
        facts = ask([str(binary), "-c", FACTS], outside)
        print(facts, end="", flush=True)
        run([str(binary), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "pythonpath=.", "tests/ops"], outside)
    shutil.rmtree(environment)
    return facts.strip(), "passed"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", metavar="TORCH:PYTHON")
    parser.add_argument("--wheel", type=Path, help="a wheel that is there already")
    options = parser.parse_args()
    checks = [parse(text) for text in options.checks]  # before the wheel is built
    wheel = options.wheel or build()
    results: list[str] = []
    skipped: list[str] = []
    failed = 0
    for torch, python in checks:
        started = time.monotonic()
        try:
            facts, result = check(wheel, torch, python)
        except subprocess.CalledProcessError as error:
            print(error.stderr or "", file=sys.stderr)
            facts, result, failed = f"torch {torch}", f"FAILED ({error})", failed + 1
        line = f"{facts}: {result} in {time.monotonic() - started:.0f} s"
        (skipped if result.startswith(NOT_CHECKED) else results).append(line)
    print("\n".join(results + skipped))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
