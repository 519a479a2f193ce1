# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The build: what the libraries export and need, and the ways of installing them."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
X86_LINUX = sys.platform == "linux" and platform.machine() == "x86_64"
LEVELS = ("default", "avx2", "avx512", "avx512_bf16") if X86_LINUX else ("default",)

pytestmark = pytest.mark.skipif(
    not (ROOT / "setup.py").exists() or shutil.which("cmake") is None or shutil.which("ninja") is None,
    reason="needs the source tree, cmake and ninja",
)


def run(*command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PRED_")}
    return subprocess.run(command, env=kept | environment, cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CMake build of its own, warnings being errors."""
    folder = tmp_path_factory.mktemp("build")
    torch_dir = Path(torch.__file__).parent
    options = [f"-DPRED_TORCH_DIR={torch_dir}", "-DPRED_HOST=OFF", "-DPRED_WERROR=ON"]
    configured = run("cmake", "-G", "Ninja", "-S", str(ROOT), "-B", str(folder), *options)
    assert configured.returncode == 0, configured.stdout + configured.stderr
    built = run("cmake", "--build", str(folder))
    assert built.returncode == 0, built.stdout
    return folder


@pytest.mark.skipif(not X86_LINUX, reason="reads ELF files")
def test_undefined_symbols_are_stable(build: Path) -> None:
    """The library takes nothing from torch but its C shim, so that it loads under other torch versions."""
    listed = run("nm", "-D", "--undefined-only", str(build / "libpred_cpu.so"))
    names = [line.split()[-1].split("@")[0] for line in listed.stdout.splitlines()]
    assert any(name.startswith("aoti_torch_") for name in names)
    cxx_torch = [name for name in names if re.match(r"_ZN?K?\d*(2at|3c10|5torch)", name)]
    assert cxx_torch == []
    needed = run("readelf", "-d", str(build / "libpred_cpu.so")).stdout
    libraries = set(re.findall(r"NEEDED.*\[(.*)\]", needed))
    assert not [name for name in libraries if "gomp" in name or "python" in name or "cuda" in name]
    assert "RPATH" not in needed and "RUNPATH" not in needed


@pytest.mark.skipif(sys.platform != "linux", reason="reads ELF files")
@pytest.mark.parametrize("level", LEVELS)
def test_kernel_objects_export_nothing_that_could_be_merged(build: Path, level: str) -> None:
    objects = list((build / f"CMakeFiles/kernels_{level}.dir").rglob("*.o"))
    assert objects
    for path in objects:
        for line in run("nm", "-C", str(path)).stdout.splitlines():
            kind, name = line[17:18], line[19:]
            assert kind not in "VvWwu", f"{path.name} exports the weak symbol {name}"
            if kind in "TDRB":
                assert name.startswith(f"pred::isa_{level}::"), f"{path.name} exports {name}"


@pytest.mark.skipif(not X86_LINUX, reason="other processors have one level")
def test_baseline_objects_use_no_wide_registers(build: Path) -> None:
    folders = ("kernels_default", "pred_cpu")
    objects = [path for name in folders for path in (build / f"CMakeFiles/{name}.dir").rglob("*.o")]
    assert objects
    for path in objects:
        assert not re.search(r"%[yz]mm\d", run("objdump", "-d", str(path)).stdout), path
    wide = build / "CMakeFiles/kernels_avx512.dir/csrc/ops/sample_bev_cpu.cpp.o"
    assert "%zmm" in run("objdump", "-d", str(wide)).stdout  # the check above can see them


def test_wheel_serves_every_python(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-build-isolation", "--no-deps"]
    result = run(*pip, "-w", str(tmp_path), str(ROOT), PRED_REQUIRE_NATIVE="1")
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert re.fullmatch(r"pred_lidar-[\d.]+-py3-none-\w+\.whl", wheel.name)
    names = zipfile.ZipFile(wheel).namelist()
    assert "pred/libpred_cpu.so" in names and "pred/configs/nuscenes_pillars.yaml" in names
    assert any(name.startswith("pred/_host.") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "csrc/"))]


def test_without_torch_headers_the_install_is_pure_python(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-build-isolation", "--no-deps"]
    nowhere = str(tmp_path / "nowhere")
    target = tmp_path / "site"
    result = run(*pip, "--target", str(target), str(ROOT), PRED_TORCH_DIR=nowhere)
    assert result.returncode == 0, result.stdout + result.stderr
    assert not list((target / "pred").glob("*.so"))
    record = json.loads((target / "pred/build_info.json").read_text())
    assert record["native"] is False
    assert f"torch >= 2.10 was not found (looked in {nowhere}" in record["reason"]
    assert "--no-build-isolation" in record["reason"]
    refused = run(*pip, "--target", str(tmp_path / "other"), str(ROOT), PRED_TORCH_DIR=nowhere, PRED_REQUIRE_NATIVE="1")
    assert refused.returncode != 0
    assert "PRED_REQUIRE_NATIVE=1, but torch >= 2.10 was not found" in refused.stdout + refused.stderr


def test_compiler_may_have_arguments(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-build-isolation", "--no-deps"]
    compiler = tmp_path / "c++"
    compiler.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\nexec c++ "$@"\n')
    compiler.chmod(0o755)
    environment = {"CXX": f"{compiler} -DPRED_TEST_ARGUMENT=1", "PRED_REQUIRE_NATIVE": "1"}
    result = run(*pip, "--target", str(tmp_path / "site"), str(ROOT), **environment)
    assert result.returncode == 0, result.stdout + result.stderr
    compiled = [
        line for line in (tmp_path / "calls").read_text().splitlines() if "sample_bev" in line and " -c " in line
    ]
    assert compiled and all("PRED_TEST_ARGUMENT" in line for line in compiled)


def test_a_failing_compiler_is_an_error(tmp_path: Path) -> None:
    """Only an absent torch or compiler falls back to pure Python."""
    compiler = tmp_path / "c++"
    compiler.write_text("#!/bin/sh\nexit 1\n")
    compiler.chmod(0o755)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-build-isolation", "--no-deps"]
    result = run(*pip, "--target", str(tmp_path / "site"), str(ROOT), CXX=str(compiler))
    assert result.returncode != 0
