# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""CUDA kernels beside the CPU's, and what only a device has: streams, graphs, other devices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from benchmarks.bench_step import VARIANTS, Step
from benchmarks.cases import TINY
from pred import _native, ops
from pred.models.field import FieldDecoder
from tests.conftest import DEVICE
from tests.ops.examples import EXAMPLES, Arguments, Example, Source, Wide, evaluate, order_of
from tests.tolerances import FORWARD, GRADIENT, assert_close

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
    pytest.mark.skipif(not _native.native_status()["cuda"], reason=f"{_native.native_status()['cuda_reason']}"),
    pytest.mark.skipif(DEVICE != "cpu", reason="CPU tensors go through the GPU too: nothing to compare with"),
]

DTYPES = [torch.float32, torch.float64]
ATOMIC = ("sample_bev", "sample_bev_with_grad", "sample_volume", "sample_volume_with_grad", "decode_field")
"""Whose gradients have another order of sums without deterministic algorithms."""


def has_kernel(op: str) -> bool:
    return torch._C._dispatch_has_kernel_for_dispatch_key(f"pred::{op}", "CUDA")


CUDA_EXAMPLES = [example for example in EXAMPLES if _native.available() and has_kernel(example.op)]


def on_device(arguments: Arguments, device: str = "cuda") -> Arguments:
    moved: Arguments = tree_map_only(Tensor, lambda tensor: tensor.to(device), arguments)
    return moved


def run(example: Example, arguments: Arguments) -> dict[str, Tensor]:
    return evaluate(example.native, arguments, example.leaves(arguments), order_of(example))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("example", CUDA_EXAMPLES, ids=str)
def test_parity_with_the_cpu(native: None, deterministic: None, example: Example, dtype: torch.dtype) -> None:
    check_parity(example, dtype)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("example", [example for example in CUDA_EXAMPLES if example.op in ATOMIC], ids=str)
def test_parity_of_atomics_with_the_cpu(native: None, example: Example, dtype: torch.dtype) -> None:
    check_parity(example, dtype)


def check_parity(example: Example, dtype: torch.dtype) -> None:
    for source in (*(Source(count, count) for count in (1, 37, 260)), Wide(37, 37)):
        arguments = example.arguments(source, dtype)
        expected, actual = run(example, arguments), run(example, on_device(arguments))
        assert list(actual) == list(expected)
        for name, value in actual.items():
            assert value.device.type == "cuda", name
            if not value.is_floating_point():
                assert torch.equal(value.cpu(), expected[name]), name
                continue
            tolerance = (GRADIENT if name.startswith(("grad_", "second_")) else FORWARD)[dtype]
            assert_close(value.cpu(), expected[name], tolerance * example.tolerance, name)


@pytest.mark.parametrize("example", CUDA_EXAMPLES, ids=str)
def test_the_same_bits_every_time(native: None, deterministic: None, example: Example) -> None:
    arguments = on_device(example.example(example.many, torch.float32))
    first, second = run(example, arguments), run(example, arguments)
    assert all(torch.equal(second[name], value) for name, value in first.items())


@pytest.mark.parametrize("example", CUDA_EXAMPLES, ids=str)
def test_work_is_queued_on_the_current_stream(native: None, deterministic: None, example: Example) -> None:
    """Results are right where the stream has other work before it, and the host has not waited."""
    arguments = on_device(example.example(example.many, torch.float32))
    expected = run(example, arguments)
    stream = torch.cuda.Stream()
    busy = torch.randn(4096, 4096, device="cuda")
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        late = tree_map_only(Tensor, torch.zeros_like, arguments)
        for _ in range(20):
            busy = busy @ busy / 64
        for name, value in arguments.items():
            if isinstance(value, Tensor):
                late[name].copy_(value)
        actual = run(example, late)
    torch.cuda.current_stream().wait_stream(stream)
    assert all(torch.equal(actual[name], value) for name, value in expected.items())


def test_rendering_is_captured_in_a_graph(native: None, deterministic: None) -> None:
    sdf = torch.randn(64, 40, device="cuda", requires_grad=True)
    t, values = torch.rand(64, 40).cumsum(1).cuda(), torch.rand(64, 40, 5, device="cuda", requires_grad=True)
    bev = torch.randn(1, 16, 20, 20, device="cuda", requires_grad=True)
    grid = torch.rand(1, 200, 2, device="cuda") * 2 - 1
    inv_s, u = torch.tensor(2.7, device="cuda", requires_grad=True), torch.rand(16, device="cuda").sort().values
    leaves = (sdf, values, bev, inv_s)

    def step() -> tuple[Tensor, ...]:
        out = ops.composite_rays(sdf, inv_s, t, values)
        resampled = ops.resample_rays(t, out.weights.detach(), 16, u)
        assert out.depth is not None and out.values is not None
        loss = out.depth.square().sum() + out.values.square().sum() + ops.sample_bev(bev, grid).square().sum()
        return (resampled, *torch.autograd.grad(loss, leaves))

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):  # warm up, as torch asks for
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        for leaf in leaves:
            leaf.mul_(0.9)
    graph.replay()
    for actual, expected in zip(captured, step(), strict=True):
        assert torch.equal(actual, expected)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_step_is_captured_in_a_graph(native: None, deterministic: None, name: str) -> None:
    """The whole of it: coarse pass, resampling, decoding, compositing, losses and their gradients."""
    step = Step(TINY, FieldDecoder, torch.device("cuda"), **VARIANTS[name])

    def results() -> tuple[Tensor, ...]:
        loss = step.loss()
        return (loss.detach(), *torch.autograd.grad(loss, step.leaves))

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            results()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = results()
    with torch.no_grad():
        for leaf in step.leaves:
            leaf.mul_(0.9)
    graph.replay()
    for actual, expected in zip(captured, results(), strict=True):
        assert torch.equal(actual, expected)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="there is one CUDA device")
@pytest.mark.parametrize("example", CUDA_EXAMPLES, ids=str)
def test_the_tensors_device_counts(native: None, deterministic: None, example: Example) -> None:
    arguments = example.example(example.many, torch.float32)
    first, second = run(example, on_device(arguments, "cuda:0")), run(example, on_device(arguments, "cuda:1"))
    assert all(second[name].device.index == 1 and torch.equal(second[name].cpu(), first[name].cpu()) for name in first)


def test_devices_must_agree(native: None) -> None:
    with pytest.raises((ValueError, RuntimeError), match="grid"):
        ops.sample_bev(torch.zeros(1, 2, 3, 4, device="cuda"), torch.zeros(1, 5, 2))


@pytest.mark.skipif(torch.__version__ < "2.13", reason="torch prints the cause, and hands out none")
def test_memory_that_does_not_suffice_is_the_cause(native: None) -> None:
    grid = torch.zeros(1, 1, 2, device="cuda").expand(1, 1 << 40, 2)
    with pytest.raises(RuntimeError, match="pred::sample_bev: .*out of memory"):
        ops.sample_bev(torch.zeros(1, 2, 3, 4, device="cuda"), grid)
