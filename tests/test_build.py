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
import tarfile
import zipfile
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
X86_LINUX = sys.platform == "linux" and platform.machine() == "x86_64"
LEVELS = ("default", "avx2", "avx512", "avx512_bf16") if X86_LINUX else ("default",)

# Instructions that a first x86-64 processor lacks: AVX and later (all begin with v), SSE3 to SSE4.2, bit manipulation.
# tzcnt is left out: compilers write the old bsf with a prefix that makes it tzcnt on new processors.
BEYOND_BASELINE = re.compile(
    r"(?!verr|verw)v.*|p?blend.*|round[ps][sd]|p(max|min)(sb|sd|ud|uw)|pmul(dq|ld|hrsw)|pmov[sz]x.*|pshufb|palignr|ptest"
    r"|pabs[bwd]|psign[bwd]|ph(add|sub).*|h(add|sub)p[sd]|addsubp[sd]|mov(ddup|shdup|sldup|be)|lddqu|dpp[sd]|pcmp(eq|gt)q"
    r"|p(ext|ins)r[bdq]|(insert|extract)ps|packusdw|pmaddubsw|mpsadbw|pcmp[ei]str.*|crc32.*|popcnt.*|lzcnt.*|andn[lq]?"
    r"|bextr.*|bls(i|r|msk).*|bzhi.*|mulx.*|pdep.*|pext|rorx.*|sa[lr]x.*|sh[lr]x.*"
)
BEYOND_AVX2 = re.compile(r"%zmm|%k[0-7]\b|%[xy]mm(1[6-9]|2\d|3[01])\b|\{1to\d+\}")
BEYOND_AVX512 = re.compile(r"bf16|v4fmadd|vp2intersect|fp16|%tmm")


def too_wide(level: str, mnemonic: str, operands: str) -> bool:
    """Whether an instruction needs more than the level promises."""
    if level == "default":
        return BEYOND_BASELINE.fullmatch(mnemonic) is not None or re.search(r"%[yz]mm\d", operands) is not None
    if level == "avx2":
        return BEYOND_AVX2.search(operands) is not None
    return level == "avx512" and BEYOND_AVX512.search(mnemonic) is not None


class Function:
    """Machine code of one function."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.code: list[tuple[str, str]] = []  # mnemonic, operands
        self.calls: set[int] = set()  # addresses of functions, those it jumps to included


def functions(path: Path) -> dict[int, Function]:
    """By address: the copies of a static function in several objects have one name."""
    found: dict[int, Function] = {}
    function = Function("")
    for line in run("objdump", "-d", "--no-show-raw-insn", str(path)).stdout.splitlines():
        if line.endswith(">:"):
            address, _, name = line.partition(" <")
            function = found.setdefault(int(address, 16), Function(name[:-2]))
        elif "\t" in line:
            words = line.split("\t", 1)[1].split(None, 1)
            while words and words[0] in ("lock", "rep", "repz", "repnz", "notrack", "bnd", "data16", "cs"):
                words = words[1].split(None, 1) if len(words) > 1 else []
            if not words:
                continue
            operands = words[1] if len(words) > 1 else ""
            function.code.append((words[0], operands))
            target = re.match(r"([0-9a-f]+) <[^>]*?(?:\+0x([0-9a-f]+))?>$", operands)
            if target and words[0].startswith(("call", "j")):
                function.calls.add(int(target[1], 16) - int(target[2] or "0", 16))
    return found


def level_of(symbol: str) -> str | None:
    """The level of a mangled name, None of code outside of the kernels."""
    found = re.search(r"\disa_(default|avx512_bf16|avx512|avx2)", symbol)
    return found[1] if found else None


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
    assert not [name for name in names if re.match(r"_ZN?K?4pred", name)]  # all of ours is in it
    needed = run("readelf", "-d", str(build / "libpred_cpu.so")).stdout
    libraries = set(re.findall(r"NEEDED.*\[(.*)\]", needed))
    assert not [name for name in libraries if "gomp" in name or "python" in name or "cuda" in name]
    assert "RPATH" not in needed and "RUNPATH" not in needed


@pytest.mark.skipif(sys.platform != "linux", reason="reads ELF files")
@pytest.mark.parametrize("level", LEVELS)
def test_kernel_objects_share_nothing_that_could_be_merged(build: Path, level: str) -> None:
    """Of one function that several levels define, the linker would keep any: a wide one, say. And nothing of a wide
    level may run before the level is chosen."""
    objects = list((build / f"CMakeFiles/kernels_{level}.dir").rglob("*.o"))
    assert {path.name for path in objects} == {f"{path.name}.o" for path in (ROOT / "csrc/ops").glob("*_cpu.cpp")}
    for path in objects:
        for line in run("nm", "-C", str(path)).stdout.splitlines():
            kind, name = line[17:18], line[19:]
            assert kind not in "VvWwuC", f"{path.name} exports the weak symbol {name}"
            if kind in "TDRBSG":
                assert name.startswith(f"pred::isa_{level}::"), f"{path.name} exports {name}"
            if kind == "U":  # C functions such as memcpy; no C++ runtime, no torch
                allowed = re.fullmatch(r"[a-z][a-z0-9]*|__stack_chk_fail|_GLOBAL_OFFSET_TABLE_|__(asan|ubsan)\w*", name)
                assert allowed, f"{path.name} needs {name}"
        sections = run("readelf", "-SW", str(path)).stdout
        assert not re.search(r"\.(init_array|ctors|init)\b", sections), f"{path.name} runs code when it is loaded"


@pytest.mark.skipif(not X86_LINUX, reason="other processors have one level")
@pytest.mark.parametrize("level", LEVELS)
def test_kernel_objects_keep_to_their_instruction_set(build: Path, level: str) -> None:
    for path in (build / f"CMakeFiles/kernels_{level}.dir").rglob("*.o"):
        for function in functions(path).values():
            wrong = [code for code in function.code if too_wide(level, *code)]
            assert not wrong, f"{path.name}: {function.name}: {wrong[:3]}"


@pytest.mark.skipif(not X86_LINUX, reason="other processors have one level")
def test_library_reaches_no_wide_instruction_but_through_its_tables(build: Path) -> None:
    """In the linked library: each function keeps to its level, code outside of the kernels to the baseline; no level
    calls a function of another one, and none is called but through a table."""
    linked = functions(build / "libpred_cpu.so")
    levels = {address: level for address, function in linked.items() if (level := level_of(function.name))}
    assert set(levels.values()) == set(LEVELS)
    waiting = list(levels)
    while waiting:  # static functions of headers that a kernel calls have no level in their name
        address = waiting.pop()
        for target in linked[address].calls:
            if target not in linked or "@plt" in linked[target].name:
                continue
            if target not in levels:
                levels[target] = levels[address]
                waiting.append(target)
            assert levels[target] == levels[address], f"{linked[address].name} calls {linked[target].name}"
    seen = set()
    for address, function in linked.items():
        level = levels.get(address)
        wrong = [code for code in function.code if too_wide(level or "default", *code)]
        assert not wrong, f"{function.name}: {wrong[:3]}"
        if level is None:
            called = [linked[target].name for target in function.calls if target in levels]
            assert not called, f"{function.name} calls {called}"
        elif any("%zmm" in operands or "%ymm" in operands for _, operands in function.code):
            seen.add(level)
    assert seen == {"avx2", "avx512", "avx512_bf16"}  # the check can see them


@pytest.fixture(scope="module")
def source_archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    build_sdist = "import sys, setuptools.build_meta as backend; backend.build_sdist(sys.argv[1])"
    result = run(sys.executable, "-c", build_sdist, str(folder))
    assert result.returncode == 0, result.stdout + result.stderr
    (archive,) = folder.glob("pred_lidar-*.tar.gz")
    return archive


def test_source_archive_holds_every_source_and_no_build(source_archive: Path) -> None:
    with tarfile.open(source_archive) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = run("git", "ls-files", "csrc", "pred", "tests", "benchmarks", "docs", "CMakeLists.txt", "Makefile")
    if tracked.returncode:
        pytest.skip("not a git checkout, whose files would say what must be there")
    assert set(tracked.stdout.splitlines()) - names == set()
    assert not [name for name in names if name.endswith((".so", ".pyc")) or name == "pred/build_info.json"]


def test_wheel_serves_every_python(tmp_path: Path, source_archive: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--no-build-isolation", "--no-deps"]
    result = run(*pip, "-w", str(tmp_path), str(source_archive), PRED_REQUIRE_NATIVE="1")
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


@pytest.mark.parametrize(
    ("value", "nvcc", "reason"),
    [
        ("1", "/nowhere/nvcc", "PRED_CUDA=1, but torch in .* was built without CUDA"),
        ("2", "", "PRED_CUDA must be auto, 0, 1 or emulate, got 2"),
    ],
)
def test_cuda_that_cannot_be_had_is_an_error_at_once(tmp_path: Path, value: str, nvcc: str, reason: str) -> None:
    if (Path(torch.__file__).parent / "lib/libtorch_cuda.so").exists() and value == "1":
        pytest.skip("this torch was built with CUDA")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-build-isolation", "--no-deps"]
    result = run(*pip, "--target", str(tmp_path / "site"), str(ROOT), PRED_CUDA=value, CUDACXX=nvcc)
    assert result.returncode != 0
    assert re.search(reason, result.stdout + result.stderr)
    assert not (tmp_path / "site").exists()
