# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The loader, the thread pool and the choice of backend and instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pred import _native
from pred.ops import sample_bev
from tests.conftest import KERNEL_ERROR


def test_two_threads_really_run(native: None) -> None:
    torch.set_num_threads(2)
    out = torch.full((64,), -1, dtype=torch.int64)
    torch.ops.pred.parallel_probe(out, 1, -1)
    assert out.min() >= 0 and len(out.unique()) == 2
    torch.set_num_threads(1)
    torch.ops.pred.parallel_probe(out, 1, -1)
    assert len(out.unique()) == 1


@pytest.mark.parametrize("threads", [1, 2])
def test_text_of_a_workers_exception_is_kept(native: None, threads: int) -> None:
    torch.set_num_threads(threads)
    out = torch.zeros(64, dtype=torch.int64)
    with pytest.raises(KERNEL_ERROR, match="parallel_probe: index 63 was asked to fail"):
        torch.ops.pred.parallel_probe(out, 1, 63)


@pytest.mark.parametrize(
    "text, kind",
    [
        ("knn: k must be at least 1, got 0", ValueError),
        ("std::bad_alloc", MemoryError),
        ("something else", RuntimeError),
    ],
)
def test_kernel_errors_of_newer_torch_get_their_type_back(text: str, kind: type[Exception]) -> None:
    def op() -> None:
        raise RuntimeError(text)

    with pytest.raises(kind, match=text) as raised:
        _native.checked(op)
    assert type(raised.value) is kind


def test_direct_calls_are_checked(native: None) -> None:
    bev, grid = torch.zeros(1, 2, 3, 4), torch.zeros(1, 5, 2)
    with pytest.raises(KERNEL_ERROR, match=r"sample_bev: grid must have shape \[1, N, 2\], got \[2, 5, 2\]"):
        torch.ops.pred.sample_bev(bev, grid.expand(2, -1, -1), False, False)
    with pytest.raises(KERNEL_ERROR, match="sample_bev: dtype must be float32, float64, bfloat16 or float16, got Int"):
        torch.ops.pred.sample_bev(bev.int(), grid, False, False)


@pytest.mark.skipif(torch.__version__ < "2.13", reason="torch prints the cause, and hands out none")
def test_memory_that_does_not_suffice_is_the_cause(native: None) -> None:
    """And not only that a call of torch failed, as its headers say."""
    grid = torch.zeros(1, 1, 2).expand(1, 1 << 44, 2)
    with pytest.raises(RuntimeError, match=r"pred::sample_bev: .*can't allocate memory"):
        torch.ops.pred.sample_bev(torch.zeros(1, 2, 3, 4), grid, False, False)


@pytest.mark.parametrize(
    "transform", [torch.func.grad, lambda f: lambda x: torch.func.jvp(f, (x,), (torch.ones_like(x),))]
)
def test_transforms_are_refused_by_name(backend: str, transform: Callable[..., Callable[[Tensor], object]]) -> None:
    """A compiled op would give a derivative of 0 in forward mode."""
    grid = torch.zeros(1, 6, 2)
    with pytest.raises(RuntimeError, match="sample_bev: transforms of torch.func are not supported"):
        transform(lambda bev: sample_bev(bev, grid).sum())(torch.ones(1, 3, 4, 5))


def test_forward_mode_is_refused_by_name(backend: str) -> None:
    bev, grid = torch.ones(1, 3, 4, 5), torch.zeros(1, 6, 2)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(bev, bev)
        with pytest.raises(RuntimeError, match="sample_bev: forward-mode derivatives are not supported"):
            sample_bev(dual, grid)


def test_direct_calls_with_empty_maps_are_refused(native: None) -> None:
    for shape in [(1, 7, 0, 4), (1, 7, 4, 0)]:
        with pytest.raises(KERNEL_ERROR, match="sample_bev: bev must have at least one cell along each axis"):
            torch.ops.pred.sample_bev(torch.empty(shape), torch.zeros(1, 1, 2), False, False)


def test_unknown_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_BACKEND", "fast")
    with pytest.raises(ValueError, match="PRED_BACKEND must be auto, native or reference, got 'fast'"):
        sample_bev(torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 2))


def test_unknown_instruction_set(native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_CPU_CAPABILITY", "sse9")
    with pytest.raises(KERNEL_ERROR, match="PRED_CPU_CAPABILITY must be one of default, avx2, .*, got sse9"):
        sample_bev(torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 2))


def test_other_devices_take_the_reference_with_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_BACKEND", "auto")
    monkeypatch.setattr(_native, "_MISSING", None)
    monkeypatch.setattr(_native, "_warned_cuda", set())
    bev, grid = torch.zeros(1, 1, 1, 1, device="meta"), torch.zeros(1, 1, 2, device="meta")
    with pytest.warns(RuntimeWarning, match="sample_bev: no meta kernel; the PyTorch reference is used"):
        assert not _native.use_native("sample_bev", bev)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not _native.use_native("sample_bev", bev)
    monkeypatch.setenv("PRED_BACKEND", "native")
    with pytest.raises(RuntimeError, match="sample_bev: PRED_BACKEND=native, but there is no kernel for device 'meta'"):
        sample_bev(bev, grid)


def test_status_names_the_level_in_force(level: str) -> None:
    status = _native.native_status()
    assert status["available"] and status["reason"] is None
    assert status["cpu_capability"] == level
    assert level in status["build"]["levels"].split(",")


PURE_PYTHON = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import torch
    from pred import _native
    from pred.ops import composite_rays, resample_rays, sample_bev, sdf_to_alpha, segment_reduce, voxelize
    assert not _native.available()
texts = [str(w.message) for w in caught if "compiled kernels are missing" in str(w.message)]
assert len(texts) == 1 and "never built" in texts[0] and "--no-build-isolation" in texts[0], texts
points = torch.tensor([[0.5, 0.5, 0.5], [9.0, 0.0, 0.0]])
voxels = voxelize(points, torch.tensor([0, 2]), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 2.0, 2.0, 2.0))
assert voxels.point_to_voxel.tolist() == [0, -1]
assert segment_reduce(points, torch.tensor([0, -1]), 1, "sum").tolist() == [[0.5, 0.5, 0.5]]
assert sample_bev(torch.ones(1, 1, 2, 2), torch.zeros(1, 1, 2)).item() == 1.0
sdf = torch.tensor([[1.0, -1.0]], requires_grad=True)
t = torch.tensor([[1.0, 2.0]])
out = composite_rays(sdf, 2.7, t)
out.depth.sum().backward()
assert sdf.grad.isfinite().all() and sdf.grad.any()
assert torch.equal(sdf_to_alpha(sdf, 2.7)[:, 1], torch.zeros(1))
assert resample_rays(t, out.weights.detach(), 2).shape == (1, 4)
print("pure python works")
"""


def test_pure_python_package_works(tmp_path: Path) -> None:
    """Without libraries every op runs on its reference, with one warning that names the reason and the cure."""
    source = Path(_native.__file__).parent
    for path in source.rglob("*.py"):
        target = tmp_path / "pred" / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PRED_")}
    environment["PYTHONPATH"] = str(tmp_path)
    result = subprocess.run(
        [sys.executable, "-c", PURE_PYTHON], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "pure python works"
    environment["PRED_BACKEND"] = "native"
    failing = subprocess.run(
        [
            sys.executable,
            "-c",
            "import torch, pred.ops as o; o.sample_bev(torch.ones(1, 1, 1, 1), torch.ones(1, 1, 2))",
        ],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert failing.returncode != 0
    assert "PRED_BACKEND=native, but the compiled kernels are missing (the package was never built)" in failing.stderr


def test_none_in_place_of_a_tensor_is_named(native: None) -> None:
    index = torch.empty(0, dtype=torch.int64, device="meta")
    with pytest.raises(TypeError, match="segment_reduce: an argument is None in place of a tensor"):
        torch.ops.pred.segment_reduce(None, index, 50, "mean")


def test_any_number_of_empty_rays(native: None) -> None:
    assert torch.ops.pred.sdf_to_alpha(torch.empty(2**62, 0), torch.tensor(2.7), False, None).shape == (2**62, 0)


def test_sizes_whose_products_overflow_are_refused(native: None) -> None:
    with pytest.raises(KERNEL_ERROR, match=r"composite_alpha: alpha must have fewer than 2\^40 rays, got 2305843"):
        torch.ops.pred.composite_alpha(torch.empty(2**61, 0), None, None, None, 0.0, False)
    with pytest.raises(KERNEL_ERROR, match=r"composite_alpha: values must have fewer than 2\^31 channels, got 2305843"):
        values = torch.empty(3, 0, 2**61)
        torch.ops.pred.composite_alpha(torch.zeros(3, 0), None, values, None, 0.0, False)
    with pytest.raises(KERNEL_ERROR, match=r"voxelize_hard_backward: grad must have fewer than 2\^63 slots, got shape"):
        torch.ops.pred.voxelize_hard_backward(torch.empty(2**62, 2, 0), torch.tensor([0, -1]))
    with pytest.raises(KERNEL_ERROR, match=r"voxelize_hard: max_points must be less than 2\^63 / C with C=4, got 23"):
        grid = ([0.1] * 3, [0.0] * 3 + [1.0] * 3, [10] * 3)
        torch.ops.pred.voxelize_hard(torch.zeros(0, 4), torch.tensor([0, 0]), *grid, 2**61, 1)
