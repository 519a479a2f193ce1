# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Hands the native build over to CMake. All compiler flags live in CMakeLists.txt.

Environment:
    PRED_TORCH_DIR=DIR       folder of the torch package whose headers are used (default: the one found)
    PRED_REQUIRE_NATIVE=1    make a missing torch or compiler an error instead of a pure-Python install
    PRED_NATIVE=0            leave the native build out on purpose
    PRED_CUDA=auto|0|1       CUDA library; auto: where torch has CUDA and an nvcc of the same major version is there
    PRED_CUDA=emulate        its kernels run on the CPU, for tests
    PRED_SANITIZE=LIST       sanitizers, such as address,undefined
    DEBUG=1                  symbols, warnings as errors
    MAX_JOBS=N               parallel compile jobs
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
MIN_TORCH = (2, 10)


class MissingToolError(Exception):
    """The native build cannot even be tried; the text says why."""


def find_torch() -> tuple[Path, str]:
    """The torch package to build against (headers only, never imported), and its version."""
    candidates = []
    if os.environ.get("PRED_TORCH_DIR"):
        candidates.append(Path(os.environ["PRED_TORCH_DIR"]))
    else:
        # Under pip's build isolation these still name the environment that is installed into.
        candidates += [Path(sysconfig.get_path(name)) / "torch" for name in ("platlib", "purelib")]
        probe = "import importlib.util as u; s = u.find_spec('torch'); print(s.origin if s else '')"
        found = subprocess.run([sys.executable, "-I", "-c", probe], capture_output=True, text=True).stdout.strip()
        if found:
            candidates.append(Path(found).parent)
    for folder in candidates:
        version_file = folder / "version.py"
        if not version_file.exists():
            continue
        match = re.search(r"__version__ = '((\d+)\.(\d+)[^']*)'", version_file.read_text())
        if match and (int(match[2]), int(match[3])) >= MIN_TORCH:
            return folder, match[1]
        raise MissingToolError(f"torch >= 2.10 is needed, {folder} is {match[1] if match else 'of unknown version'}")
    looked = ", ".join(str(folder) for folder in dict.fromkeys(candidates))
    raise MissingToolError(
        f"torch >= 2.10 was not found (looked in {looked}); install torch first, then run: "
        "pip install --no-build-isolation . (or set PRED_TORCH_DIR)"
    )


def find_tool(name: str, others: tuple[str, ...] = ()) -> str:
    """Path of a build tool."""
    for candidate in (name, *others):
        path = shutil.which(candidate)
        if path:
            return path
    raise MissingToolError(f"{name} was not found on PATH; install it, then install this package again")


def compiler_options() -> list[str]:
    """CMake options that name the C++ compiler; CMake reads CXX, with arguments, by itself."""
    wanted = os.environ.get("CXX")
    if not wanted:
        return [f"-DCMAKE_CXX_COMPILER={find_tool('c++', ('g++', 'clang++'))}"]
    find_tool(wanted.split()[0])
    return []


def pybind11_options() -> list[str]:
    """CMake options for pred._host, which is left out where pybind11 is missing."""
    try:
        import pybind11
    except ImportError:
        return ["-DPRED_HOST=OFF"]
    return [f"-Dpybind11_DIR={pybind11.get_cmake_dir()}", f"-DPython_EXECUTABLE={sys.executable}"]


def choose_cuda(torch_dir: Path) -> tuple[str, str | None]:
    """CMake's PRED_CUDA, and why there is no CUDA library, or None."""
    wanted = os.environ.get("PRED_CUDA") or "auto"
    if wanted not in ("auto", "0", "1", "emulate"):
        raise SystemExit(f"PRED_CUDA must be auto, 0, 1 or emulate, got {wanted}")
    if wanted == "0":
        return "OFF", "left out on request (PRED_CUDA=0)"
    if wanted == "emulate":
        return "EMULATE", "emulated on the CPU (PRED_CUDA=emulate)"
    version = re.search(r"^cuda\b.*= '(\d+)", (torch_dir / "version.py").read_text(), re.MULTILINE)
    nvcc = os.environ.get("CUDACXX") or shutil.which("nvcc")
    if wanted == "1":
        if not nvcc:
            raise SystemExit("PRED_CUDA=1, but nvcc was not found on PATH")
        if not (torch_dir / "lib/libtorch_cuda.so").exists():
            raise SystemExit(f"PRED_CUDA=1, but torch in {torch_dir} was built without CUDA")
        return "ON", None
    if not version:
        return "OFF", "torch was built without CUDA"
    if not nvcc:
        return "OFF", "nvcc was not found on PATH"
    report = subprocess.run([nvcc, "--version"], capture_output=True, text=True).stdout
    release = re.search(r"release (\d+)", report)
    if not release or release[1] != version[1]:
        return "OFF", f"torch has CUDA {version[1]}, nvcc is of CUDA {release[1] if release else '(unknown)'}"
    return "ON", None


class CMakeBuild(build_ext):
    """Builds the native libraries into the package folder and writes pred/build_info.json there."""

    def run(self) -> None:
        package = ROOT / "pred" if self.inplace else Path(self.build_lib).resolve() / "pred"
        package.mkdir(parents=True, exist_ok=True)
        try:
            if os.environ.get("PRED_NATIVE", "1") == "0":
                raise MissingToolError("left out on request (PRED_NATIVE=0)")
            record = self.build_native(package)
        except MissingToolError as reason:
            if os.environ.get("PRED_REQUIRE_NATIVE") == "1":
                raise SystemExit(f"PRED_REQUIRE_NATIVE=1, but {reason}") from None
            for stale in (*package.glob("libpred_*"), *package.glob("_host*.so")):
                stale.unlink()
            record = {"native": False, "reason": str(reason)}
        (package / "build_info.json").write_text(json.dumps(record, indent=1) + "\n")

    def build_native(self, package: Path) -> dict[str, object]:
        torch_dir, torch_version = find_torch()
        cuda, no_cuda = choose_cuda(torch_dir)
        cmake, ninja = find_tool("cmake"), find_tool("ninja")
        compiler = compiler_options()
        debug = os.environ.get("DEBUG") == "1"
        sanitize = os.environ.get("PRED_SANITIZE", "")
        kind = ("sanitize" if sanitize else "debug" if debug else "release") + ("-emulate" if cuda == "EMULATE" else "")
        build = Path(self.build_temp).resolve() / kind
        build.mkdir(parents=True, exist_ok=True)
        # The compiler and ninja are named each time: pip's isolated copies of an earlier build are gone.
        if (build / "CMakeCache.txt").exists():
            (build / "CMakeCache.txt").unlink()
        configure = [
            cmake, "-G", "Ninja", "-S", str(ROOT), "-B", str(build),
            f"-DCMAKE_MAKE_PROGRAM={ninja}",
            *compiler,
            f"-DCMAKE_BUILD_TYPE={'RelWithDebInfo' if debug or sanitize else 'Release'}",
            f"-DCMAKE_INSTALL_PREFIX={package}",
            f"-DPRED_TORCH_DIR={torch_dir}",
            f"-DPRED_SANITIZE={sanitize}",
            f"-DPRED_CUDA={cuda}",
            f"-DPRED_WERROR={'ON' if debug else 'OFF'}",
            *pybind11_options(),
        ]  # fmt: skip
        jobs = os.environ.get("MAX_JOBS")
        subprocess.run(configure, check=True)
        subprocess.run([cmake, "--build", str(build), *(["-j", jobs] if jobs else [])], check=True)
        for stale in package.glob("libpred_*"):  # of an earlier build, with other options
            stale.unlink()
        subprocess.run([cmake, "--install", str(build)], check=True)
        return {"native": True, "reason": None, "torch": torch_version, "cuda": no_cuda is None, "no_cuda": no_cuda}

    def get_outputs(self) -> list[str]:
        package = Path(self.build_lib) / "pred"
        patterns = ("libpred_*", "_host*.so", "build_info.json")
        return [str(path) for pattern in patterns for path in package.glob(pattern)]

    def get_output_mapping(self) -> dict[str, str]:
        return {}


class PlatformWheel(bdist_wheel):
    """``py3-none-<platform>``: the op library knows neither Python's nor torch's C++ ABI."""

    def finalize_options(self) -> None:
        super().finalize_options()
        self.root_is_pure = False

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[Extension("pred._native_libraries", sources=[])],
    cmdclass={"build_ext": CMakeBuild, "bdist_wheel": PlatformWheel},
)
