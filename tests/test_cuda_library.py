# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The CUDA library as `make cuda-compile` builds it, on a machine that need not have a GPU."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
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


def dumped(*arguments: str) -> str:
    """What cuobjdump says: that of PyPI, of the toolkit, or of PATH."""
    places = [
        *Path(sysconfig.get_path("purelib")).glob("nvidia/cu*/bin"),
        Path(shutil.which("nvcc") or "").resolve().parent,
    ]
    path = os.pathsep.join([*map(str, places), os.environ["PATH"]])
    dumper = shutil.which("cuobjdump", path=path)
    if dumper is None or shutil.which("nvdisasm", path=path) is None:
        pytest.skip("cuobjdump and nvdisasm are not installed")
    return subprocess.run(
        [dumper, *arguments], env=os.environ | {"PATH": path}, capture_output=True, text=True, check=True
    ).stdout


def test_machine_code_of_every_architecture() -> None:
    names = set(re.findall(r"sm_\d+", dumped("--list-elf", str(LIBRARY))))
    assert names >= {"sm_75", "sm_80", "sm_86", "sm_89", "sm_90"}
    assert "sm_90" in dumped("--list-ptx", str(LIBRARY))


@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
@pytest.mark.parametrize("op", ["decode_field", "project_bev", "sparse_conv"])
def test_products_run_on_tensor_cores(op: str, arch: str) -> None:
    """Of halves and of float32; fed by matrix loads from shared memory that is filled without registers between."""
    objects = LIBRARY.parent / "CMakeFiles/pred_cuda.dir/csrc/ops"
    code = dumped("-sass", "-arch", arch, str(objects / f"{op}_cuda.cu.o"))
    multiply = {"8BFloat16": r"HMMA\.16816\.F32\.BF16", "7Float16": r"HMMA\.16816\.F32 ", "f": r"HMMA\.1688\.F32\.TF32"}
    seen = set()
    for function in code.split("Function : ")[1:]:
        name = function.split(maxsplit=1)[0]
        found = re.search(r"product_kernelI(?:NS\d?_)?(8BFloat16|7Float16|f|d)E?Lb([01])E", name)
        if not found or found[1] == "d":
            continue
        kind, outer = found.groups()
        assert re.search(multiply[kind], function), name
        assert "LDGSTS.E.BYPASS.128" in function, name
        assert ("LDSM" in function) == (kind != "f" or outer == "0"), name  # not of columns of 4 bytes
        seen.add((kind, outer))
    kinds = ["8BFloat16", "f", *(["7Float16"] if op == "sparse_conv" else [])]
    assert seen == {(kind, outer) for kind in kinds for outer in "01"}


def test_two_blocks_of_products_fit_a_multiprocessor() -> None:
    """By their registers; and no kernel of the library keeps much beside them."""
    lines = dumped("--dump-resource-usage", "-arch", "sm_90", str(LIBRARY)).splitlines()
    kernels = {
        lines[i - 1].split()[1].rstrip(":"): dict(re.findall(r"(REG|STACK):(\d+)", line))
        for i, line in enumerate(lines)
        if "REG:" in line and "4pred" in lines[i - 1]
    }
    assert len(kernels) > 200
    assert max(int(use["STACK"]) for use in kernels.values()) <= 128
    products = [int(use["REG"]) for name, use in kernels.items() if re.search("product_kernelI(?!dL)", name)]
    assert products and max(products) * 512 <= 65536


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
