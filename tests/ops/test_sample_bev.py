# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pred.ops import reference, sample_bev
from tests.tolerances import FORWARD, GRADIENT, assert_close

SIZES = [((2, 5, 7, 6), 23), ((1, 64, 9, 17), 300), ((3, 17, 1, 1), 4), ((1, 1, 3, 2), 1)]
MODES = [(padding, align) for padding in ("zeros", "border") for align in (False, True)]


def case(
    shape: tuple[int, int, int, int] = (2, 5, 7, 6), samples: int = 23, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """A map and positions of which about a third lie outside it."""
    generator = torch.Generator().manual_seed(sum(shape) + samples)
    bev = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
    grid = torch.rand(shape[0], samples, 2, generator=generator, dtype=torch.float64) * 2.6 - 1.3
    return bev, grid.to(dtype)


def gradients(function: Any, bev: Tensor, grid: Tensor, second_order: bool) -> list[Tensor]:
    """Value, first derivatives, and derivatives of a function of the first derivatives."""
    bev, grid = bev.clone().requires_grad_(), grid.clone().requires_grad_()
    out = function(bev, grid)
    cotangent = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape).requires_grad_()
    if out.numel() == 0:
        return [out]
    first = torch.autograd.grad(out, (bev, grid), cotangent, create_graph=second_order)
    if not second_order:
        return [out, *first]
    mixed = first[0].square().sum() + first[1].square().sum()
    return [out, *first, *torch.autograd.grad(mixed, (cotangent, bev, grid))]


def test_hand_computed(backend: str) -> None:
    # Two columns, one row: cell centres at x = -0.5 and 0.5. At x = 0.25: 0.25 * 2 + 0.75 * 6 = 5.
    bev = torch.tensor([[[[2.0, 6.0]]]], dtype=torch.float64, requires_grad=True)
    grid = torch.tensor([[[0.25, 0.0], [1.0, 0.0], [0.25, 2.0]]], dtype=torch.float64, requires_grad=True)
    out = sample_bev(bev, grid)
    # On the right edge half the weight lies outside; one row above the map there is nothing.
    assert out.flatten().tolist() == [5.0, 3.0, 0.0]
    assert sample_bev(bev, grid, "border").flatten().tolist() == [5.0, 6.0, 5.0]
    assert sample_bev(bev, grid, align_corners=True).flatten().tolist() == [4.5, 6.0, 4.5]
    (grad_grid,) = torch.autograd.grad(out[0, 0, 0], grid, create_graph=True)
    # d/dx: one unit of x is one cell here: 6 - 2. d/dy at the centre of the only row: towards the empty row above,
    # half a cell per unit of y: -5 / 2.
    assert grad_grid[0, 0].tolist() == [4.0, -2.5]
    (second,) = torch.autograd.grad(grad_grid[0, 0, 0], bev)
    assert second.flatten().tolist() == [-1.0, 1.0]


@pytest.mark.parametrize("padding,align", MODES)
def test_reference_is_grid_sample(padding: str, align: bool) -> None:
    bev, grid = case()
    expected = F.grid_sample(bev, grid[:, :, None], padding_mode=padding, align_corners=align)[..., 0].transpose(1, 2)
    assert_close(reference.sample_bev(bev, grid, padding, align), expected, 1e-14)


@pytest.mark.parametrize("padding,align", MODES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "shape,samples", [((2, 5, 7, 6), 23), ((1, 64, 9, 17), 300), ((3, 17, 1, 1), 4), ((1, 1, 3, 2), 1)]
)
def test_native_equals_reference(
    native: None, shape: Any, samples: int, dtype: torch.dtype, padding: str, align: bool
) -> None:
    bev, grid = case(shape, samples, dtype)
    actual = gradients(lambda b, g: sample_bev(b, g, padding, align), bev, grid, second_order=True)
    expected = gradients(lambda b, g: reference.sample_bev(b, g, padding, align), bev.double(), grid.double(), True)
    names = ["value", "grad_bev", "grad_grid", "second grad", "second bev", "second grid"]
    for name, a, e in zip(names, actual, expected, strict=True):
        assert a.dtype == dtype
        # Positions are rounded to float32 before they are scaled to cells: 1e-7 of the map's width.
        tolerance = (FORWARD if name == "value" else GRADIENT)[dtype] * (4 if dtype == torch.float32 else 1)
        assert_close(a.double(), e, tolerance, name)


def test_levels_agree(level: str) -> None:
    bev, grid = case((2, 37, 11, 13), 400, torch.float32)
    actual = gradients(sample_bev, bev, grid, second_order=True)
    expected = gradients(reference.sample_bev, bev.double(), grid.double(), second_order=True)
    for a, e in zip(actual, expected, strict=True):
        assert_close(a.double(), e, 4e-5)


@pytest.mark.parametrize("padding,align", MODES)
def test_gradcheck(backend: str, padding: str, align: bool) -> None:
    bev, grid = (tensor.requires_grad_() for tensor in case(samples=9))
    assert torch.autograd.gradcheck(lambda b, g: sample_bev(b, g, padding, align), (bev, grid))
    assert torch.autograd.gradgradcheck(lambda b, g: sample_bev(b, g, padding, align), (bev, grid))


def test_third_derivative_is_refused(native: None) -> None:
    bev, grid = (tensor.requires_grad_() for tensor in case(samples=3))
    first = torch.autograd.grad(sample_bev(bev, grid).square().sum(), grid, create_graph=True)[0]
    second = torch.autograd.grad(first.square().sum(), grid, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="sample_bev_double_backward: a further derivative"):
        torch.autograd.grad(second.square().sum(), grid)


@pytest.mark.parametrize("samples", [0, 5])
def test_opcheck(native: None, samples: int) -> None:
    bev, grid = (tensor.float().requires_grad_() for tensor in case(samples=samples))
    grad = torch.randn(2, samples, 5, requires_grad=True)
    torch.library.opcheck(torch.ops.pred.sample_bev.default, (bev, grid, False, False))
    torch.library.opcheck(torch.ops.pred.sample_bev_backward.default, (grad, bev, grid, True, False, True, True))
    # Its own derivative is refused, so its inputs carry none here.
    plain = [tensor.detach() for tensor in (bev, grid, grad, bev, grid)]
    for of_bev, of_grid in [(plain[0], plain[1]), (None, plain[1]), (plain[0], None)]:
        torch.library.opcheck(
            torch.ops.pred.sample_bev_double_backward.default,
            (of_bev, of_grid, *plain[2:], False, False, True, True, True),
        )


def test_compiles_to_one_graph(backend: str) -> None:
    bev, grid = (tensor.requires_grad_() for tensor in case())
    compiled = torch.compile(lambda b, g: sample_bev(b, g).sin().sum(), fullgraph=True, backend="aot_eager")
    actual = torch.autograd.grad(compiled(bev, grid), (bev, grid))
    expected = torch.autograd.grad(sample_bev(bev, grid).sin().sum(), (bev, grid))
    for a, e in zip(actual, expected, strict=True):
        assert_close(a, e, 1e-14)


def test_bitwise_equal_for_any_thread_count(native: None) -> None:
    bev, grid = case((2, 33, 40, 30), 5000, torch.float32)
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(gradients(sample_bev, bev, grid, second_order=True))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_memory_layouts_agree(backend: str) -> None:
    bev, grid = case((2, 8, 5, 4))
    expected = sample_bev(bev, grid)
    layouts = [bev.contiguous(memory_format=torch.channels_last), bev.transpose(2, 3).contiguous().transpose(2, 3)]
    for layout in layouts:
        assert torch.equal(sample_bev(layout, grid), expected)
    strided = grid.repeat_interleave(2, dim=1)[:, ::2]
    assert torch.equal(sample_bev(bev, strided), expected)


@pytest.mark.parametrize("batch,samples", [(0, 4), (2, 0), (0, 0)])
def test_empty(backend: str, batch: int, samples: int) -> None:
    bev = torch.randn(batch, 3, 4, 4, requires_grad=True)
    grid = torch.zeros(batch, samples, 2, requires_grad=True)
    out = sample_bev(bev, grid)
    assert out.shape == (batch, samples, 3)
    out.sum().backward()
    assert bev.grad is not None and bev.grad.shape == bev.shape and not bev.grad.any()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30])
@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_bad_coordinate_stays_in_its_sample(backend: str, padding: str, bad: float) -> None:
    bev, grid = case((1, 3, 5, 4), 6, torch.float32)
    clean = gradients(lambda b, g: sample_bev(b, g, padding), bev, grid[:, [0, 1, 3, 4, 5]], second_order=False)
    grid[0, 2, 0] = bad
    bev.requires_grad_()
    grid.requires_grad_()
    out = sample_bev(bev, grid, padding)
    others = [0, 1, 3, 4, 5]
    assert torch.equal(out[:, others], clean[0])
    expected = {"zeros": 0.0}.get(padding)
    if bad != bad:
        assert out[0, 2].isnan().all()
    elif expected is not None:
        assert not out[0, 2].any()
    else:
        assert out[0, 2].isfinite().all()
    out.nan_to_num(0.0).square().sum().backward()
    assert bev.grad is not None and bev.grad.isfinite().all()
    assert grid.grad is not None and grid.grad[0, others].isfinite().all()


def test_errors(backend: str) -> None:
    bev, grid = case()
    with pytest.raises(ValueError, match=r"sample_bev: grid must have shape \[2, N, 2\], got \[3, 23, 2\]"):
        sample_bev(bev, grid[:1].expand(3, -1, -1))
    with pytest.raises(ValueError, match=r"sample_bev: bev must have shape \[B, C, H, W\]"):
        sample_bev(bev[0], grid)
    with pytest.raises(TypeError, match="sample_bev: grid must have the dtype of bev"):
        sample_bev(bev, grid.float())
    with pytest.raises(TypeError, match="sample_bev: bev must be float32 or float64"):
        sample_bev(bev.long(), grid.long())
    with pytest.raises(TypeError, match="sample_bev: bev must be float32 or float64, got bfloat16"):
        sample_bev(bev.bfloat16(), grid.bfloat16())
    with torch.autocast("cpu", torch.bfloat16), pytest.raises(TypeError, match="grid must have the dtype of bev"):
        sample_bev(bev.float(), grid.double())
    with pytest.raises(ValueError, match="sample_bev: padding_mode must be one of zeros, border"):
        sample_bev(bev, grid, "reflection")
    with pytest.raises(ValueError, match="at least one row and column"):
        sample_bev(bev[:, :, :0], grid)


def test_autocast_computes_in_float32(backend: str) -> None:
    bev, grid = case(dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        out = sample_bev(bev.bfloat16(), grid)
    assert out.dtype == torch.float32
    assert_close(out, sample_bev(bev.bfloat16().float(), grid), 1e-6)
