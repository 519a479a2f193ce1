# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the op tests of one wheel under other versions of torch and Python, without building it again.

    python tests/wheel_check.py 2.11.0:python3.12 newest:python3.12

The wheel is built with the running Python and its torch. Each check is a torch version (or "newest") and a Python
command; it gets a virtual environment of its own in build/wheel-check, which later runs use again. Only torch, pytest,
numpy and hypothesis are installed there: the ops need nothing else.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
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
FACTS = """
import sys, torch
from pred import _native
status = _native.native_status()
assert status["available"], status["reason"]
assert status["path"].startswith(sys.prefix), status["path"]
print(f"torch {torch.__version__}, Python {sys.version.split()[0]}, wheel built with torch {status['build']['torch']}")
"""


def run(command: list[str], cwd: Path | None = None) -> None:
    """Runs a command without the variables that would change what is tested."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PRED_", "PYTHON"))}
    subprocess.run(command, check=True, cwd=cwd, env=kept | {"PRED_REQUIRE_NATIVE": "1"})


def build() -> Path:
    """The wheel."""
    target = FOLDER / "wheel"
    shutil.rmtree(target, ignore_errors=True)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q", "wheel"]
    run([*pip, "--no-build-isolation", "--no-deps", "-w", str(target), str(ROOT)])
    (wheel,) = target.glob("*.whl")
    print(f"built {wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB)", flush=True)
    return wheel


def check(wheel: Path, torch: str, python: str) -> str:
    """Installs torch and the wheel, runs the tests; returns the versions."""
    environment = FOLDER / f"torch-{torch}"
    binary = environment / "bin/python"
    if not binary.exists():
        print(f"torch {torch}: pip downloads it with its CUDA libraries, 2 to 4 GB; {environment} takes some 6 GB")
        run([python, "-m", "venv", str(environment)])
    install = [str(binary), "-m", "pip", "--disable-pip-version-check", "-q", "install"]
    run([*install, *(["-U", "torch"] if torch == "newest" else [f"torch=={torch}"]), "pytest", "numpy", "hypothesis"])
    run([*install, "--no-deps", "--force-reinstall", str(wheel)])
    with tempfile.TemporaryDirectory() as name:
        outside = Path(name)  # of the source tree, whose pred/ would be imported
        for part in COPIED:
            source, target = ROOT / part, outside / part
            target.parent.mkdir(exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("results", "__pycache__"))
            else:
                shutil.copy(source, target)
        facts = subprocess.run([str(binary), "-c", FACTS], cwd=outside, capture_output=True, text=True, check=True)
        print(facts.stdout, end="", flush=True)
        run([str(binary), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "pythonpath=.", "tests/ops"], outside)
    return facts.stdout.strip()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checks", nargs="+", metavar="TORCH:PYTHON")
    parser.add_argument("--wheel", type=Path, help="a wheel that is there already")
    options = parser.parse_args()
    wheel = options.wheel or build()
    results, failed = [], 0
    for torch, _, python in (text.partition(":") for text in options.checks):
        started = time.monotonic()
        try:
            facts, result = check(wheel, torch, python or sys.executable), "passed"
        except subprocess.CalledProcessError as error:
            print(error.stderr or "", file=sys.stderr)
            facts, result, failed = f"torch {torch}", f"FAILED ({error})", failed + 1
        results.append(f"{facts}: {result} in {time.monotonic() - started:.0f} s")
    print("\n".join(results))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
