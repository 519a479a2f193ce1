# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures. Tests of real data read PRED_TEST_DATA, the folder that holds nuscenes_tiny/; tests against other
frameworks read PRED_TEST_FIXTURES, the folder that holds once_golden.json (results of the official ONCE evaluation) and
state_dicts/<model>.txt (names, shapes and types of the tensors of OpenPCDet's and DSVT's detectors)."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map_only

from pred import _native

EMULATED = bool(_native.native_status()["emulated"])
"""The compiled ops are the CUDA kernels, which run on the CPU (``make emulate``)."""
DEVICE = os.environ.get("PRED_TEST_DEVICE", "cpu")
"""Where compiled ops run; with ``cuda``, CPU tensors too (`_redirect`)."""
LAUNCHED = EMULATED or DEVICE != "cpu"
LEVELS = ("default",) if LAUNCHED else ("default", "avx2", "avx512", "avx512_bf16")
SANITIZED = os.environ.get("PRED_TEST_SANITIZED") == "1"
"""The run is to find memory errors in the compiled code; tests of a reference alone are left out."""

KERNEL_ERROR = (ValueError, RuntimeError)
"""What a check in a kernel raises: torch makes a RuntimeError of it in later versions (2.15)."""


def pytest_configure(config: pytest.Config) -> None:
    if SANITIZED and not _native.native_status()["build"].get("sanitizers"):
        raise pytest.UsageError(f"{_native.native_status()['path']} was not built with sanitizers")
    if DEVICE != "cpu" and not (torch.cuda.is_available() and _native.native_status()["cuda"]):
        why = _native.native_status()["cuda_reason"] or "torch sees no CUDA device"
        raise pytest.UsageError(f"PRED_TEST_DEVICE={DEVICE}, but no CUDA kernel can run: {why}")


def _redirect() -> torch.library.Library:
    """Takes CPU tensors of compiled ops to the device and their results back, so that every test of an op tests the
    device's kernels. As long as the library that is returned lives."""
    library = torch.library.Library("pred", "IMPL")
    for full_name in torch._C._dispatch_get_all_op_names():
        namespace, _, name = full_name.partition("::")
        if namespace == "pred" and torch._C._dispatch_has_kernel_for_dispatch_key(full_name, DEVICE.upper()):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it overrides the CPU's kernel
                library.impl(name, functools.partial(_on_device, getattr(torch.ops.pred, name).default), "CPU")
    return library


def _on_device(op: Callable[..., Any], *arguments: Any) -> Any:
    results = op(*tree_map_only(torch.Tensor, lambda tensor: tensor.to(DEVICE), arguments))
    return tree_map_only(torch.Tensor, lambda tensor: tensor.cpu(), results)


_REDIRECTED = _redirect() if DEVICE != "cpu" else None


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    """A test that changes the number of threads does not change it for the next."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def deterministic() -> Iterator[None]:
    """The test is about sums that have the same bits every time."""
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(before[0], warn_only=before[1])


@pytest.fixture(params=["native"] if SANITIZED else ["native", "reference"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Runs the test on the compiled kernels and on the references."""
    if request.param == "native":
        require_native()
    monkeypatch.setenv("PRED_BACKEND", request.param)
    return str(request.param)


@pytest.fixture
def native(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces the compiled kernels, so that a reference is never compared with itself."""
    require_native()
    monkeypatch.setenv("PRED_BACKEND", "native")


@pytest.fixture(params=LEVELS)
def level(request: pytest.FixtureRequest, native: None, monkeypatch: pytest.MonkeyPatch) -> str:
    """Runs the test on every instruction-set level that this machine has."""
    monkeypatch.setenv("PRED_CPU_CAPABILITY", request.param)
    try:
        _native.native_status()
    except KERNEL_ERROR as error:
        pytest.skip(str(error))
    return str(request.param)


def require_value_checks(backend: str) -> None:
    """Kernels that are launched check no values: that would make the host wait for the device."""
    if LAUNCHED and backend == "native":
        pytest.skip("kernels that are launched check no values")


def require_native() -> None:
    """Missing kernels are a visible skip, and a failure where PRED_REQUIRE_NATIVE=1."""
    if _native.available():
        return
    reason = f"compiled kernels are missing: {_native.native_status()['reason']}"
    if os.environ.get("PRED_REQUIRE_NATIVE") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def nuscenes_tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of the real keyframe, in a copy of its folders with links to its files: the reader adds its index."""
    folder = os.environ.get("PRED_TEST_DATA")
    if not folder:
        pytest.skip("PRED_TEST_DATA is not set: no real data")
    root = Path(folder) / "nuscenes_tiny"
    if not root.is_dir():
        pytest.fail(f"PRED_TEST_DATA is set, but {root} is not a folder")
    linked = tmp_path_factory.mktemp("data") / root.name
    shutil.copytree(root.resolve(), linked, copy_function=os.symlink)
    return linked


@pytest.fixture(scope="session")
def once_golden() -> dict[str, Any]:
    """Boxes, predictions and what the official ONCE evaluation makes of them."""
    folder = os.environ.get("PRED_TEST_FIXTURES")
    if not folder:
        pytest.skip("PRED_TEST_FIXTURES is not set: no results of the official ONCE evaluation")
    golden: dict[str, Any] = json.loads((Path(folder) / "once_golden.json").read_text())
    return golden


@pytest.fixture(scope="session")
def published_encoder() -> Callable[[str], dict[str, tuple[tuple[int, ...], str]]]:
    """Shape and type of every tensor of the encoder of one of the published detectors, by name, in their order."""
    folder = os.environ.get("PRED_TEST_FIXTURES")
    if not folder:
        pytest.skip("PRED_TEST_FIXTURES is not set: no state dicts of published detectors")

    def read(model: str) -> dict[str, tuple[tuple[int, ...], str]]:
        tensors: dict[str, tuple[tuple[int, ...], str]] = {}
        for line in (Path(folder) / "state_dicts" / f"{model}.txt").read_text().splitlines():
            if found := re.fullmatch(r"((?:vfe|backbone_3d|backbone_2d)\.\S+) \((.*)\) (\w+)", line):
                tensors[found[1]] = (tuple(int(size) for size in found[2].split(",") if size.strip()), found[3])
        assert len(tensors) > 100, model
        return tensors

    return read
