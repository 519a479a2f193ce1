# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred doctor`: what is installed, what is in force, and why something is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import sys
from importlib import metadata
from typing import Any

import torch

import pred
from pred._native import native_status
from pred.data.sweeps import HOST_ERROR

EXTRAS = {
    # module to look for: (extra, what it is for)
    "nuscenes": ("nuscenes", "official nuScenes devkit: split names and official metrics"),
}


def report() -> list[tuple[str, list[tuple[str, str]]]]:
    """Sections of (name, value) lines."""
    return [("versions", _versions()), ("kernels", _kernels()), ("machine", _machine()), ("extras", _extras())]


def print_report() -> None:
    """Show the report on standard output, in plain text that can be pasted into a bug report."""
    for title, lines in report():
        print(title)
        for name, value in lines:
            print(f"  {name:<20} {value}")


def _versions() -> list[tuple[str, str]]:
    lines = [("pred", pred.__version__), ("python", f"{platform.python_version()} ({sys.executable})")]
    for name in ("torch", "numpy", "lightning-fabric", "jsonargparse", "embreex"):
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = f"missing; pip install {name}"
        lines.append((name, version))
    lines[2] = ("torch", torch.__version__)  # with the build, such as +cpu
    return lines


def _kernels() -> list[tuple[str, str]]:
    status = native_status()
    requested = os.environ.get("PRED_BACKEND") or "auto"
    lines = [
        ("backend", f"{_backend(requested, status)}"),
        ("PRED_BACKEND", requested if "PRED_BACKEND" in os.environ else "not set (auto)"),
        ("library", str(status["path"]) if status["available"] else f"missing: {status['reason']}"),
    ]
    if not status["available"]:
        lines.append(("remedy", "install torch first, then: pip install --no-build-isolation . (in the source folder)"))
    else:
        lines.append(("instruction set", f"{status['cpu_capability']} ({_capability_source()})"))
    lines += [(f"build {name}", str(value)) for name, value in status["build"].items()]
    host = "loaded" if HOST_ERROR is None else f"not used, loader workers take NumPy instead: {HOST_ERROR}"
    lines.append(("pred._host", host))
    return lines


def _backend(requested: str, status: dict[str, Any]) -> str:
    if requested == "reference":
        return "reference, as PRED_BACKEND asks"
    if requested not in ("auto", "native"):
        return f"none: PRED_BACKEND must be auto, native or reference, got {requested!r}"
    if status["available"]:
        return "native for CPU tensors"
    if requested == "native":
        return "none: PRED_BACKEND=native, but the library is missing"
    return "reference (plain PyTorch), because the library is missing"


def _capability_source() -> str:
    forced = os.environ.get("PRED_CPU_CAPABILITY")
    return f"PRED_CPU_CAPABILITY={forced}" if forced else "the best this CPU has; PRED_CPU_CAPABILITY overrides"


def _machine() -> list[tuple[str, str]]:
    lines = [
        ("platform", platform.platform()),
        ("cores", str(os.cpu_count())),
        ("torch threads", str(torch.get_num_threads())),
    ]
    if torch.cuda.is_available():
        names = {torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())}
        lines.append(("cuda", f"{torch.cuda.device_count()} device(s): {', '.join(sorted(names))}"))
        missing = native_status()["cuda_reason"]
        lines.append(("cuda kernels", f"none: {missing}; CUDA tensors use the references" if missing else "loaded"))
    elif torch.version.cuda is None:
        lines.append(("cuda", "not available: this torch is built without CUDA"))
    else:
        lines.append(("cuda", f"not available: torch is built for CUDA {torch.version.cuda}, but finds no device"))
    return lines


def _extras() -> list[tuple[str, str]]:
    lines = []
    for module, (extra, purpose) in EXTRAS.items():
        present = importlib.util.find_spec(module) is not None
        state = "present" if present else f"missing; pip install 'pred-lidar[{extra}]'"
        lines.append((extra, f"{state} ({purpose})"))
    return lines
