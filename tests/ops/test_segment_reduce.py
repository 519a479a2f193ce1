# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from pred.ops import reference, segment_reduce
from tests.conftest import KERNEL_ERROR, LAUNCHED, SANITIZED, require_value_checks
from tests.tolerances import FORWARD, GRADIENT, assert_close

REDUCTIONS = ("sum", "mean", "max")


def case(
    rows: int = 40, channels: int = 5, segments: int = 12, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """Features and an index in which some rows are skipped and, with many segments, some segments are empty."""
    generator = torch.Generator().manual_seed(rows + 7 * channels + segments)
    features = torch.randn(rows, channels, generator=generator, dtype=torch.float64).to(dtype)
    return features, torch.randint(-1, segments, (rows,), generator=generator)


def gradients(function: Any, features: Tensor, index: Tensor, segments: int, reduce: str) -> list[Tensor]:
    """Value, gradient, and the gradient of a function of the gradient."""
    features = features.clone().requires_grad_()
    out = function(features, index, segments, reduce)
    cotangent = torch.linspace(-1, 2, out.numel(), dtype=out.dtype).reshape(out.shape).requires_grad_()
    (first,) = torch.autograd.grad(out, features, cotangent, create_graph=True)
    (second,) = torch.autograd.grad(first.pow(3).sum(), cotangent)
    return [out.detach(), first.detach(), second]


def test_hand_computed(backend: str) -> None:
    features = torch.tensor([[1.0, 2.0], [3.0, -1.0], [5.0, 5.0], [-4.0, 0.5]], requires_grad=True)
    index = torch.tensor([1, 1, -1, 0])
    expected = {
        "sum": [[-4.0, 0.5], [4.0, 1.0], [0.0, 0.0]],
        "mean": [[-4.0, 0.5], [2.0, 0.5], [0.0, 0.0]],
        "max": [[-4.0, 0.5], [3.0, 2.0], [0.0, 0.0]],
    }
    slopes = {
        "sum": [[3.0, 4.0], [3.0, 4.0], [0.0, 0.0], [1.0, 2.0]],
        "mean": [[1.5, 2.0], [1.5, 2.0], [0.0, 0.0], [1.0, 2.0]],
        "max": [[0.0, 4.0], [3.0, 0.0], [0.0, 0.0], [1.0, 2.0]],
    }
    for reduce in REDUCTIONS:
        out = segment_reduce(features, index, 3, reduce)
        assert out.tolist() == expected[reduce]
        grad = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
        assert torch.autograd.grad(out, features, grad)[0].tolist() == slopes[reduce]


def test_first_of_equal_maxima_takes_the_gradient(backend: str) -> None:
    features = torch.tensor([[1.0], [2.0], [2.0], [-0.0], [0.0], [-math.inf], [-math.inf]], requires_grad=True)
    out = segment_reduce(features, torch.tensor([0, 0, 0, 1, 1, 2, 2]), 3, "max")
    assert out.flatten().tolist() == [2.0, 0.0, -math.inf] and math.copysign(1.0, out[1].item()) == -1.0
    (grad,) = torch.autograd.grad(out, features, torch.ones_like(out))
    assert grad.flatten().tolist() == [0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize("reduce", REDUCTIONS)
def test_nan_stays_in_its_segment_and_channel(backend: str, reduce: str) -> None:
    features, index = case(dtype=torch.float32)
    index[:6] = torch.tensor([3, 3, 3, 3, -1, 2])
    clean = segment_reduce(features, index, 12, reduce)
    features[1:3, 2] = math.nan  # two of segment 3
    features[4] = math.nan  # a skipped row
    features.requires_grad_()
    out = segment_reduce(features, index, 12, reduce)
    assert out[3, 2].isnan() and out.isnan().sum() == 1
    mask = ~out.isnan()
    assert torch.equal(out[mask], clean[mask])
    (grad,) = torch.autograd.grad(out, features, torch.ones_like(out))
    assert grad.isfinite().all() and not grad[4].any()
    if reduce == "max":  # the first NaN
        assert grad[:6, 2].tolist() == [0.0, 1.0, 0.0, 0.0, 0.0, grad[5, 2].item()]


@pytest.mark.parametrize("reduce", REDUCTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "rows,channels,segments", [(40, 5, 12), (500, 64, 90), (900, 3, 2000), (300, 17, 1), (1, 1, 1), (64, 0, 4)]
)
def test_native_equals_reference(
    native: None, rows: int, channels: int, segments: int, dtype: torch.dtype, reduce: str
) -> None:
    features, index = case(rows, channels, segments, dtype)
    actual = gradients(segment_reduce, features, index, segments, reduce)
    expected = gradients(reference.segment_reduce, features.double(), index, segments, reduce)
    for name, a, e in zip(["value", "gradient", "second gradient"], actual, expected, strict=True):
        assert a.dtype == dtype
        # A sum of n rows carries the rounding of n additions.
        scale = max(1, rows // segments // 8) if dtype == torch.float32 else 1
        assert_close(a.double(), e, (FORWARD if name == "value" else GRADIENT)[dtype] * scale, name)
    if reduce == "max":
        assert torch.equal(actual[0].double(), expected[0])


@pytest.mark.parametrize("reduce", REDUCTIONS)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("rows,channels,segments", [(500, 67, 90), (900, 3, 2000), (1, 1, 1), (0, 4, 3), (64, 0, 4)])
def test_half_storage_is_float32_rounded_once(
    level: str, rows: int, channels: int, segments: int, dtype: torch.dtype, reduce: str
) -> None:
    features, index = case(rows, channels, segments, dtype)
    out, first, second = gradients(segment_reduce, features, index, segments, reduce)
    assert out.dtype == first.dtype == second.dtype == dtype
    # Both add the rows of a segment in their order, in float32.
    assert torch.equal(out, segment_reduce(features.float(), index, segments, reduce).to(dtype))
    expected = gradients(reference.segment_reduce, features, index, segments, reduce)
    assert torch.equal(first, expected[1])
    # One rounding to half precision, of a sum in another order.
    assert_close(out.double(), expected[0].double(), torch.finfo(dtype).eps)
    assert_close(second.double(), expected[2].double(), 2 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_sums_of_many_half_rows_lose_nothing(backend: str, dtype: torch.dtype) -> None:
    features, index = torch.ones(20000, 3, dtype=dtype), torch.zeros(20000, dtype=torch.int64)
    assert segment_reduce(features, index, 1, "sum").tolist() == [[torch.tensor(20000.0).to(dtype).item()] * 3]
    features[1:] *= 2.0**-9
    mean = (1 + 19999 * 2.0**-9) / 20000
    assert segment_reduce(features, index, 1, "mean").tolist() == [[torch.tensor(mean).to(dtype).item()] * 3]


@pytest.mark.parametrize("reduce", REDUCTIONS)
def test_levels_agree_bitwise(level: str, monkeypatch: pytest.MonkeyPatch, reduce: str) -> None:
    for dtype in (torch.float32, torch.float64, torch.bfloat16, torch.float16):
        features, index = case(3000, 67, 400, dtype)
        actual = gradients(segment_reduce, features, index, 400, reduce)
        monkeypatch.setenv("PRED_CPU_CAPABILITY", "default")
        expected = gradients(segment_reduce, features, index, 400, reduce)
        monkeypatch.setenv("PRED_CPU_CAPABILITY", level)
        assert all(torch.equal(a, e) for a, e in zip(actual, expected, strict=True))


@pytest.mark.parametrize("reduce", REDUCTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_bitwise_equal_for_any_thread_count(native: None, dtype: torch.dtype, reduce: str) -> None:
    features, index = case(20000, 19, 3000, dtype)
    index[5000:12000] = 77  # one long segment
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(gradients(segment_reduce, features, index, 3000, reduce))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("reduce", REDUCTIONS)
def test_gradcheck(backend: str, reduce: str) -> None:
    features, index = case(15, 3, 7)
    features.requires_grad_()
    assert torch.autograd.gradcheck(lambda f: segment_reduce(f, index, 7, reduce), features)
    assert torch.autograd.gradgradcheck(lambda f: segment_reduce(f, index, 7, reduce), features)
    # Through a product, so that the second derivative in the features is not zero.
    assert torch.autograd.gradgradcheck(lambda f: segment_reduce(f * f.sin(), index, 7, reduce), features)


@pytest.mark.parametrize("reduce", REDUCTIONS)
@pytest.mark.parametrize("rows,segments", [(0, 3), (0, 0), (4, 0), (4, 3)])
def test_nothing_to_reduce(backend: str, rows: int, segments: int, reduce: str) -> None:
    features = torch.full((rows, 5), math.nan, requires_grad=True)
    out = segment_reduce(features, torch.full((rows,), -1), segments, reduce)
    assert out.shape == (segments, 5) and not out.any()
    out.sum().backward()
    assert features.grad is not None and features.grad.shape == (rows, 5) and not features.grad.any()


def test_errors(backend: str) -> None:
    features, index = case()
    with pytest.raises(ValueError, match=r"segment_reduce: features must have shape \[N, C\], got \[40\]"):
        segment_reduce(features[:, 0], index, 12)
    with pytest.raises(ValueError, match=r"segment_reduce: index must have shape \[40\] as features, got \[39\]"):
        segment_reduce(features, index[1:], 12)
    with pytest.raises(TypeError, match="segment_reduce: features must be float32 or .* or float16, got int64"):
        segment_reduce(features.long(), index, 12)
    with pytest.raises(TypeError, match="segment_reduce: index must be int64, got int32"):
        segment_reduce(features, index.int(), 12)
    with pytest.raises(ValueError, match="segment_reduce: reduce must be one of sum, mean, max, got 'min'"):
        segment_reduce(features, index, 12, "min")
    with pytest.raises(ValueError, match="segment_reduce: num_segments must be at least 0, got -1"):
        segment_reduce(features, index, -1)


def test_index_is_checked(backend: str) -> None:
    require_value_checks(backend)
    features, index = case()
    for wrong in (12, -2, 2**62, -(2**62)):
        index[[17, 30]] = wrong
        message = rf"segment_reduce: index must lie in \[-1, num_segments=12\), got {wrong} in row 17"
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with pytest.raises(ValueError, match=message):
                segment_reduce(features, index, 12)


def test_direct_calls_with_meta_tensors_are_checked(native: None) -> None:
    features, index = torch.empty(5, 3, device="meta"), torch.empty(5, dtype=torch.int64, device="meta")
    with pytest.raises(ValueError, match="segment_reduce: reduce must be one of sum, mean, max, got 'zeros'"):
        torch.ops.pred.segment_reduce(features, index, 4, "zeros")


def test_direct_calls_are_checked(native: None) -> None:
    features, index = case()
    backward = torch.ops.pred.segment_reduce_backward
    with pytest.raises(KERNEL_ERROR, match=r"segment_reduce: index must have shape \[40\], got \[3\]"):
        torch.ops.pred.segment_reduce(features, index[:3], 12, "sum")
    with pytest.raises(KERNEL_ERROR, match="dtype must be float32, float64, bfloat16 or float16, got Long"):
        torch.ops.pred.segment_reduce(features.long(), index, 12, "sum")
    with pytest.raises(KERNEL_ERROR, match=r"saved must belong to grad of shape \[12, 5\], got \[12, 4\]"):
        backward(features[:12], index, torch.zeros(12, 4, dtype=torch.int32), "max")
    require_value_checks("native")
    with pytest.raises(KERNEL_ERROR, match=r"index must lie in \[-1, num_segments=11\)"):
        backward(features[:11], torch.full((4,), 11), torch.empty(0, dtype=torch.int32), "sum")


@pytest.mark.skipif(not LAUNCHED, reason="the index is checked")
@pytest.mark.parametrize("reduce", ["sum", "mean", "max"])
def test_unchecked_numbers_count_as_none(native: None, reduce: str) -> None:
    features, index = case()
    none, wrong = index.clone(), index.clone()
    none[[3, 17, 30]] = -1
    wrong[[3, 17, 30]] = torch.tensor([12, -5, 2**62])
    expected, saved = torch.ops.pred.segment_reduce(features, none, 12, reduce)
    assert torch.equal(torch.ops.pred.segment_reduce(features, wrong, 12, reduce)[0], expected)
    backward = torch.ops.pred.segment_reduce_backward
    assert torch.equal(backward(expected, wrong, saved, reduce), backward(expected, none, saved, reduce))


SCRATCH_THAT_DOES_NOT_FIT = """
import resource, sys, torch
from pred.ops import segment_reduce
if sys.argv[1] == "limit":  # ten more GiB of address space
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (10 << 30), resource.getrlimit(resource.RLIMIT_AS)[1]))
try:
    segment_reduce(torch.empty(0, 1, dtype=torch.bfloat16), torch.empty(0, dtype=torch.int64), 1 << 31)
except MemoryError:
    print("MemoryError")
"""


@pytest.mark.skipif(LAUNCHED, reason="kernels that are launched have their scratch from torch")
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not tell the process's size")
def test_scratch_that_does_not_fit(native: None) -> None:
    """The 2^31 bfloat16 of the result fit, their 8 GiB of float32 sums do not. In a process of its own, since malloc
    goes on elsewhere after a failure. The sanitizers, which take terabytes of address space, have their own limit
    (Makefile)."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", SCRATCH_THAT_DOES_NOT_FIT, "none" if SANITIZED else "limit"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "MemoryError\n", done.stderr
