# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The CUDA library as `make cuda-compile` builds it, on a machine that need not have a GPU."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = Path(os.environ.get("PRED_TEST_CUDA_LIBRARY", "/nowhere"))

pytestmark = pytest.mark.skipif(not LIBRARY.exists(), reason="no PRED_TEST_CUDA_LIBRARY: make cuda-compile")


def listed(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def cuda_ops() -> list[str]:
    found = re.search(r"set\(OPS ([^)]*)\)", (ROOT / "CMakeLists.txt").read_text())
    assert found
    return found[1].split()


def test_undefined_symbols_are_stable() -> None:
    """Nothing from torch but its C shim: the library loads under other versions."""
    lines = listed("nm", "-D", "--undefined-only", str(LIBRARY)).splitlines()
    names = [line.split()[-1].split("@")[0] for line in lines]
    assert "aoti_torch_get_current_cuda_stream" in names
    assert [name for name in names if re.match(r"_ZN?K?\d*(2at|3c10|5torch|4pred)", name)] == []
    needed = set(re.findall(r"NEEDED.*\[(.*)\]", listed("readelf", "-d", str(LIBRARY))))
    assert "libtorch_cuda.so" in needed
    assert not [name for name in needed if re.search("gomp|python|cublas|cudnn", name)]


def test_machine_code_of_every_architecture() -> None:
    dumper = shutil.which("cuobjdump") or str(Path(os.path.realpath(shutil.which("nvcc") or "")).with_name("cuobjdump"))
    if not Path(dumper).exists():
        pytest.skip("cuobjdump is not installed")
    names = set(re.findall(r"sm_\d+", listed(dumper, "--list-elf", str(LIBRARY))))
    assert names >= {"sm_75", "sm_80", "sm_86", "sm_89", "sm_90"}
    assert "sm_90" in listed(dumper, "--list-ptx", str(LIBRARY))


def test_every_op_and_its_gradient_is_registered(tmp_path: Path) -> None:
    """Loaded beside a stand-in for torch's CUDA library; no kernel runs."""
    runtime = LIBRARY.resolve().parent / "libcudart.txt"
    code = """
import sys, torch
import pred
torch.ops.load_library(sys.argv[1])
for name in torch._C._dispatch_get_all_op_names():
    if name.startswith("pred::") and torch._C._dispatch_has_kernel_for_dispatch_key(name, "CUDA"):
        print(name.removeprefix("pred::"))
"""
    folders = [str(LIBRARY.resolve().parent), *runtime.read_text().split()]
    environment = os.environ | {"LD_LIBRARY_PATH": ":".join(folders)}
    done = subprocess.run(
        [sys.executable, "-c", code, str(LIBRARY.resolve())], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    registered = set(done.stdout.split())
    schemas = set(re.findall(r'"(\w+)\(', (ROOT / "csrc/library.cpp").read_text()))
    expected = {name for name in schemas for op in cuda_ops() if re.fullmatch(rf"{op}(_\w+)?", name)}
    assert registered == expected
