# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""sample_bev, sample_volume and their *_with_grad forms. Most tests run for two axes and for three."""

from __future__ import annotations

import resource
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pred import ops
from pred.ops import reference, sample_bev, sample_bev_with_grad, sample_volume, sample_volume_with_grad
from tests.conftest import DEVICE, KERNEL_ERROR, SANITIZED
from tests.tolerances import FORWARD, GRADIENT, assert_close

MODES = [(padding, align) for padding in ("zeros", "border") for align in (False, True)]
HALF = [torch.bfloat16, torch.float16]


@dataclass(frozen=True)
class Sampler:
    """An op with its number of axes."""

    op: str
    axes: int
    small: tuple[int, ...]
    """Shape of a map that gradcheck can go through."""
    sizes: tuple[tuple[tuple[int, ...], int], ...]
    """Maps and numbers of samples per map."""

    def __str__(self) -> str:
        return self.op

    def call(self, name: str = "", of: Any = ops) -> Any:
        return getattr(of, self.op + name)

    def native(self, name: str = "") -> Any:
        return getattr(torch.ops.pred, self.op + name).default


BEV = Sampler(
    "sample_bev", 2, (2, 5, 7, 6), (((2, 5, 7, 6), 23), ((1, 64, 9, 17), 300), ((3, 17, 1, 1), 4), ((1, 1, 3, 2), 1))
)
VOLUME = Sampler(
    "sample_volume",
    3,
    (2, 2, 3, 2, 4),
    (((2, 3, 3, 4, 5), 23), ((1, 32, 5, 17, 9), 300), ((3, 17, 1, 1, 1), 4), ((2, 5, 4, 1, 3), 9)),
)
SAMPLERS = [BEV, VOLUME]


@pytest.fixture(params=SAMPLERS, ids=str)
def sampler(request: pytest.FixtureRequest) -> Sampler:
    found: Sampler = request.param
    return found


def case(shape: Sequence[int], samples: int = 23, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """A map and positions of which about a third lie outside it."""
    generator = torch.Generator().manual_seed(sum(shape) + samples)
    volume = torch.randn(tuple(shape), generator=generator, dtype=torch.float64).to(dtype)
    grid = torch.rand(shape[0], samples, len(shape) - 2, generator=generator, dtype=torch.float64) * 2.6 - 1.3
    return volume, grid.to(dtype)


def grid_sample(volume: Tensor, grid: Tensor, padding: str = "zeros", align: bool = False) -> Tensor:
    """The oracle, in the samplers' shapes."""
    view = grid[:, :, None] if volume.dim() == 4 else grid[:, :, None, None]
    out = F.grid_sample(volume, view, padding_mode=padding, align_corners=align)
    return out.flatten(2).transpose(1, 2)


def cotangent_like(out: Tensor) -> Tensor:
    return torch.linspace(-1, 1, out.numel(), dtype=out.dtype).reshape(out.shape)


def gradients(function: Any, volume: Tensor, grid: Tensor, second_order: bool) -> list[Tensor]:
    """Value, first derivatives, and derivatives of a function of the first derivatives."""
    volume, grid = volume.clone().requires_grad_(), grid.clone().requires_grad_()
    out = function(volume, grid)
    cotangent = cotangent_like(out).requires_grad_()
    if out.numel() == 0:
        return [out]
    first = torch.autograd.grad(out, (volume, grid), cotangent, create_graph=second_order)
    if not second_order:
        return [out, *first]
    mixed = first[0].square().sum() + first[1].square().sum()
    return [out, *first, *torch.autograd.grad(mixed, (cotangent, volume, grid))]


def gradients_with_grad(function: Any, volume: Tensor, grid: Tensor) -> list[Tensor]:
    """Both outputs, and gradients through each alone and through both."""
    volume, grid = volume.clone().requires_grad_(), grid.clone().requires_grad_()
    outs = function(volume, grid)
    used: list[tuple[Tensor, ...]] = [(outs[0],), (outs[1],), tuple(outs)]
    results = [out.detach() for out in outs]
    for some in used:
        cotangents = [cotangent_like(out).cos() for out in some]
        results += torch.autograd.grad(some, (volume, grid), cotangents, retain_graph=True)
    return results


def test_hand_computed_bev(backend: str) -> None:
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

    values, grads = sample_bev_with_grad(bev, grid)
    assert torch.equal(values, out)
    # On the edge x = 1 the slope is towards the empty column, and half a row up the value halves over one unit of y.
    assert grads[0, :, :, 0].tolist() == [[4.0, -2.5], [-6.0, -1.5], [0.0, 0.0]]
    (grad_bev,) = torch.autograd.grad(grads[0, 0, 0, 0], bev)
    assert grad_bev.flatten().tolist() == [-1.0, 1.0]


def test_hand_computed_volume(backend: str) -> None:
    # Cells (z, y, x), two along each axis, hold 100 z + 10 y + x; with align_corners their centres are at -1 and 1.
    number = torch.arange(2, dtype=torch.float64)
    volume = (100 * number[:, None, None] + 10 * number[:, None] + number)[None, None].requires_grad_()
    grid = torch.tensor([[[-1.0, 1.0, -1.0], [0.5, 0.0, -0.5], [0.0, 0.0, 3.0]]], dtype=torch.float64)
    # Cell (0, 1, 0); then x = 0.75, y = 0.5, z = 0.25 cells; then a whole cell above the volume.
    assert sample_volume(volume, grid, align_corners=True).flatten().tolist() == [10.0, 30.75, 0.0]
    assert sample_volume(volume, grid, "border", True).flatten().tolist() == [10.0, 30.75, 105.5]
    values, grads = sample_volume_with_grad(volume, grid.requires_grad_(), align_corners=True)
    assert values.flatten().tolist() == [10.0, 30.75, 0.0]
    assert grads[0, 1, :, 0].tolist() == [0.5, 5.0, 50.0]  # half a cell per unit
    # d/dx of the weights at y = 0.5, z = 0.25: (1 - z) / 2 in both rows of layer 0 and z / 2 in layer 1, times half a
    # cell per unit.
    (grad_volume,) = torch.autograd.grad(grads[0, 1, 0, 0], volume)
    assert grad_volume[0, 0, :, :, 1].tolist() == [[0.1875, 0.1875], [0.0625, 0.0625]]
    assert torch.equal(grad_volume[..., 0], -grad_volume[..., 1])


def oracle_is_twice_differentiable() -> bool:
    """F.grid_sample is not in every torch."""
    volume, grid = torch.ones(1, 1, 2, 2), torch.zeros(1, 1, 1, 2, requires_grad=True)
    (slope,) = torch.autograd.grad(F.grid_sample(volume, grid, align_corners=False).sum(), grid, create_graph=True)
    try:
        torch.autograd.grad(slope.sum(), grid)
    except RuntimeError:
        return False
    return True


@pytest.mark.parametrize("padding,align", MODES)
@pytest.mark.parametrize("size", range(5))
@pytest.mark.skipif(not oracle_is_twice_differentiable(), reason="F.grid_sample of this torch has no second derivative")
def test_equals_grid_sample(backend: str, sampler: Sampler, size: int, padding: str, align: bool) -> None:
    shape, samples = (*sampler.sizes, (sampler.small, 0))[size]
    volume, grid = case(shape, samples)
    actual = gradients(lambda m, g: sampler.call()(m, g, padding, align), volume, grid, second_order=True)
    expected = gradients(lambda m, g: grid_sample(m, g, padding, align), volume, grid, second_order=True)
    for a, e in zip(actual, expected, strict=True):
        assert_close(a, e, GRADIENT[torch.float64])
    if samples == 0:
        return

    def values_and_slopes(volume: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
        out = grid_sample(volume, grid, padding, align)
        slopes = [torch.autograd.grad(out[..., c].sum(), grid, create_graph=True)[0] for c in range(volume.shape[1])]
        return out, torch.stack(slopes, dim=-1)

    actual = gradients_with_grad(lambda m, g: sampler.call("_with_grad")(m, g, padding, align), volume, grid)
    expected = gradients_with_grad(values_and_slopes, volume, grid)
    for a, e in zip(actual, expected, strict=True):
        assert_close(a, e, GRADIENT[torch.float64])


@pytest.mark.parametrize("padding,align", MODES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", range(4))
def test_native_equals_reference(
    native: None, sampler: Sampler, size: int, dtype: torch.dtype, padding: str, align: bool
) -> None:
    volume, grid = case(*sampler.sizes[size], dtype)

    def both(name: str, of: Any) -> Callable[[Tensor, Tensor], Any]:
        return lambda m, g: sampler.call(name, of)(m, g, padding, align)

    actual = gradients(both("", ops), volume, grid, second_order=True)
    expected = gradients(both("", reference), volume.double(), grid.double(), second_order=True)
    actual += gradients_with_grad(both("_with_grad", ops), volume, grid)
    expected += gradients_with_grad(both("_with_grad", reference), volume.double(), grid.double())
    for number, (a, e) in enumerate(zip(actual, expected, strict=True)):
        assert a.dtype == dtype
        # Positions are rounded to float32 before they are scaled to cells: 1e-7 of the map's width.
        tolerance = (FORWARD if number == 0 else GRADIENT)[dtype] * (4 if dtype == torch.float32 else 1)
        assert_close(a.double(), e, tolerance, f"result {number}")


@pytest.mark.parametrize("padding,align", MODES)
def test_gradcheck(backend: str, deterministic: None, sampler: Sampler, padding: str, align: bool) -> None:
    torch.set_num_threads(1)  # thousands of tiny calls
    volume, grid = (tensor.requires_grad_() for tensor in case(sampler.small, samples=7))
    assert torch.autograd.gradcheck(lambda m, g: sampler.call()(m, g, padding, align), (volume, grid))
    assert torch.autograd.gradgradcheck(lambda m, g: sampler.call()(m, g, padding, align), (volume, grid))
    assert torch.autograd.gradcheck(
        lambda m, g: tuple(sampler.call("_with_grad")(m, g, padding, align)), (volume, grid)
    )


def test_gradients_that_nobody_needs_are_not_computed(native: None, sampler: Sampler) -> None:
    volume, grid = case(sampler.small)
    for name in ("", "_with_grad"):
        needs = [(True, True), (True, False), (False, True)]
        results: list[list[Tensor | None]] = []
        for need_volume, need_grid in needs:
            leaves = volume.clone().requires_grad_(need_volume), grid.clone().requires_grad_(need_grid)
            outs = sampler.call(name)(*leaves)
            sum(out.sin().sum() for out in (outs if name else [outs])).backward()
            results.append([leaf.grad for leaf in leaves])
        (both_volume, both_grid), (only_volume, no_grid), (no_volume, only_grid) = results
        assert no_grid is None and no_volume is None
        assert only_volume is not None and both_volume is not None and only_grid is not None and both_grid is not None
        assert_close(only_volume, both_volume, GRADIENT[torch.float64])
        assert_close(only_grid, both_grid, GRADIENT[torch.float64])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("samples", [0, 5])
def test_opcheck(native: None, sampler: Sampler, samples: int, dtype: torch.dtype) -> None:
    volume, grid = case(sampler.small, samples)
    volume, grid = volume.to(dtype), grid.float()
    grad = torch.randn(2, samples, volume.shape[1], dtype=dtype)
    grads = torch.randn(2, samples, sampler.axes, volume.shape[1], dtype=dtype)
    # A derivative in half precision is no more exact than its rounding, so only float32 is differentiated here.
    differentiable = dtype == torch.float32
    for tensor in (volume, grid, grad):
        tensor.requires_grad_(differentiable)
    torch.library.opcheck(sampler.native(), (volume, grid, False, False))
    torch.library.opcheck(sampler.native("_with_grad"), (volume, grid, False, False))
    torch.library.opcheck(sampler.native("_backward"), (grad, volume, grid, True, False, True, True, True))
    # Their own derivatives are refused, so their inputs carry none here.
    volume, grid, grad = volume.detach(), grid.detach(), grad.detach()
    for of_map, of_grid in [(volume, grid), (None, grid), (volume, None)]:
        arguments = (of_map, of_grid, grad, volume, grid, False, False, True, True, True, True)
        torch.library.opcheck(sampler.native("_double_backward"), arguments)
    for some in [(grad, grads), (None, grads), (grad, None)]:
        torch.library.opcheck(
            sampler.native("_with_grad_backward"), (*some, volume, grid, False, False, True, True, True)
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_bitwise_equal_for_any_thread_count(
    native: None, deterministic: None, sampler: Sampler, dtype: torch.dtype
) -> None:
    volume, grid = case((2, 33, *(4, 40, 30)[-sampler.axes :]), 5000)
    volume, grid = volume.to(dtype), grid.float()
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        found = gradients(sampler.call(), volume, grid, second_order=True)
        results.append(found + gradients_with_grad(sampler.call("_with_grad"), volume, grid))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_memory_layouts_agree(backend: str, sampler: Sampler) -> None:
    volume, grid = case(sampler.small)
    expected = sampler.call()(volume, grid)
    channels_last = torch.channels_last if sampler.axes == 2 else torch.channels_last_3d
    for layout in [
        volume.contiguous(memory_format=channels_last),
        volume.transpose(2, 3).contiguous().transpose(2, 3),
        volume[:1].expand(2, *volume.shape[1:]),
    ]:
        assert torch.equal(sampler.call()(layout, grid)[0], expected[0])
    strided = grid.repeat_interleave(2, dim=1)[:, ::2]
    assert torch.equal(sampler.call()(volume, strided), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("batch,samples,channels", [(0, 4, 3), (2, 0, 3), (0, 0, 3), (2, 4, 0)])
def test_empty(backend: str, sampler: Sampler, batch: int, samples: int, channels: int, dtype: torch.dtype) -> None:
    volume = torch.randn(batch, channels, *[4] * sampler.axes, dtype=dtype, requires_grad=True)
    grid = torch.zeros(batch, samples, sampler.axes, requires_grad=True)
    out = sampler.call()(volume, grid)
    values, grads = sampler.call("_with_grad")(volume, grid)
    assert out.shape == values.shape == (batch, samples, channels)
    assert grads.shape == (batch, samples, sampler.axes, channels)
    (first,) = torch.autograd.grad(out.sum(), grid, create_graph=True)
    (out.sum() + values.sum() + grads.sum() + first.sum()).backward()
    assert volume.grad is not None and volume.grad.shape == volume.shape and not volume.grad.any()
    assert grid.grad is not None and grid.grad.shape == grid.shape


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30])
@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_bad_coordinate_stays_in_its_sample(backend: str, sampler: Sampler, padding: str, bad: float) -> None:
    others = [0, 1, 3, 4, 5]
    for axis in range(sampler.axes):
        volume, grid = case((1, 3, *(3, 5, 4)[-sampler.axes :]), 6, torch.float32)
        clean = sampler.call("_with_grad")(volume, grid[:, others], padding)
        grid[0, 2, :] = 0.1
        grid[0, 2, axis] = bad
        volume.requires_grad_()
        grid.requires_grad_()
        values, grads = sampler.call("_with_grad")(volume, grid, padding)
        assert torch.equal(values, sampler.call()(volume, grid, padding).nan_to_num(0.0)) or bad != bad
        assert torch.equal(values[:, others], clean.values) and torch.equal(grads[:, others], clean.grads)
        if bad != bad:
            assert values[0, 2].isnan().all() and grads[0, 2].isnan().all()
            assert sampler.call()(volume, grid, padding)[0, 2].isnan().all()
        elif padding == "zeros":
            assert not values[0, 2].any() and not grads[0, 2].any()
        else:
            assert values[0, 2].isfinite().all() and not grads[0, 2, axis].any()
        loss = sum(out.nan_to_num(0.0).square().sum() for out in (values, grads, sampler.call()(volume, grid, padding)))
        assert isinstance(loss, Tensor)
        loss.backward()
        assert volume.grad is not None and volume.grad.isfinite().all()
        assert grid.grad is not None and grid.grad[0, others].isfinite().all()


@pytest.mark.parametrize("dtype", HALF)
def test_half_is_float32_rounded_once(level: str, sampler: Sampler, dtype: torch.dtype) -> None:
    """Every op on a half-precision map does what it does on the widened map, before the rounding."""
    volume, grid = case((2, 37, *(4, 20, 9)[-sampler.axes :]), 700)
    volume, grid = volume.to(dtype), grid.float()
    grad = torch.randn(2, 700, 37).to(dtype)
    grads = torch.randn(2, 700, sampler.axes, 37).to(dtype)
    of_map, of_grid = torch.randn(volume.shape).to(dtype), torch.randn(grid.shape)
    unit = torch.finfo(dtype).eps / 2
    for name, arguments in {
        "": (volume, grid, False, False),
        "_with_grad": (volume, grid, True, False),
        "_backward": (grad, volume, grid, False, True, True, True, True),
        "_with_grad_backward": (grad, grads, volume, grid, True, True, True, True, True),
        "_double_backward": (of_map, of_grid, grad, volume, grid, False, False, True, True, True, True),
    }.items():
        wide = [value.float() if isinstance(value, Tensor) else value for value in arguments]
        actual, expected = sampler.native(name)(*arguments), sampler.native(name)(*wide)
        pairs = zip(actual, expected, strict=True) if isinstance(actual, tuple) else [(actual, expected)]
        for a, e in pairs:
            # Only gradients of the grid have its shape; they stay float32.
            assert a.dtype == (torch.float32 if a.shape == grid.shape else dtype)
            assert_close(a, e.to(a.dtype), GRADIENT[torch.float32] if a.dtype == torch.float32 else 2 * unit, name)
            # The compiler may fuse multiply and add in one and not in the other: near a tie they round apart.
            assert a.dtype == torch.float32 or (a == e.to(a.dtype)).float().mean() > 0.98, name


@pytest.mark.parametrize("dtype", HALF)
def test_half_equals_reference(backend: str, sampler: Sampler, dtype: torch.dtype) -> None:
    volume, grid = case(sampler.small)
    volume = volume.to(dtype)
    for given in (grid.float(), grid.to(dtype)):
        values, grads = sampler.call("_with_grad")(volume, given)
        assert values.dtype == grads.dtype == dtype
        assert torch.equal(values, sampler.call()(volume, given))
        expected = sampler.call("_with_grad", reference)(volume.double(), given.double())
        unit = torch.finfo(dtype).eps / 2
        assert_close(values.double(), expected.values, unit)
        assert_close(grads.double(), expected.grads, unit)
    leaves = volume.clone().requires_grad_(), grid.float().requires_grad_()
    out = sampler.call()(*leaves)
    cotangent = cotangent_like(out)
    (grad_grid,) = torch.autograd.grad(out, leaves[1], cotangent, create_graph=True)
    (grad_volume,) = torch.autograd.grad(grad_grid.square().sum() + out.double().sum(), leaves[0])
    assert grad_grid.dtype == torch.float32 and grad_volume.dtype == dtype
    exact = gradients(sampler.call(of=reference), volume.double(), grid.float().double(), second_order=False)
    assert_close(grad_grid.double(), exact[2], 4 * unit)  # its cotangent is rounded


@pytest.mark.parametrize("dtype", HALF)
def test_every_half_number_passes_unchanged(level: str, dtype: torch.dtype) -> None:
    bits = torch.arange(-(1 << 15), 1 << 15).to(torch.int16)
    bev = bits.view(dtype).view(1, 16, 1, 4096).contiguous(memory_format=torch.channels_last)
    x = (2 * torch.arange(4096, dtype=torch.float64) + 1) / 4096 - 1
    grid = torch.stack([x, torch.zeros_like(x)], dim=-1)[None].float()
    out = sample_bev(bev, grid)[0].transpose(0, 1).reshape(-1)
    numbers = bits.view(dtype)
    # A weight of 0 times an infinite or NaN neighbour is NaN.
    finite = bev[0, :, 0].isfinite()
    finite[:, :-1] &= bev[0, :, 0, 1:].isfinite()
    keep = finite.reshape(-1)
    assert keep.sum() > 60000
    assert torch.equal(out[keep], numbers[keep])
    assert out[numbers.isnan()].isnan().all()


@pytest.mark.parametrize("dtype", HALF)
def test_rounding_to_half_is_to_nearest_even(level: str, dtype: torch.dtype) -> None:
    """Means of two neighbouring numbers are ties; means of others round as torch does."""
    numbers = torch.arange(0, 1 << 15).to(torch.int16).view(dtype)
    numbers = torch.cat([numbers[numbers.isfinite()], -numbers[numbers.isfinite()]])
    other = numbers.roll(-1)
    bev = torch.stack([numbers, other], dim=-1)[None, :, None]  # [1, C, 1, 2]
    out = sample_bev(bev, torch.zeros(1, 1, 2))[0, 0]
    assert torch.equal(out, (numbers.float() * 0.5 + other.float() * 0.5).to(dtype))


@pytest.mark.large
@pytest.mark.skipif(SANITIZED, reason="the sanitizer keeps notes on every page")
@pytest.mark.skipif(DEVICE != "cpu", reason="a device's memory has no pages that nobody writes")
def test_more_than_2_to_the_31_elements(native: None) -> None:
    """Pages of the map that nobody writes cost no memory, and one channel is channels-last: nothing is copied."""
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    height, width = 46341, 46342
    assert height * width > 1 << 31
    # NumPy asks for zeroed pages, where torch writes the zeros.
    bev = torch.from_numpy(np.zeros((1, 1, height, width), np.int16)).view(torch.bfloat16)
    bev[0, 0, -2:, -2:] = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    # Between the last four cells, at the last one, at the first one; in cells.
    exact = torch.tensor([[[width - 1.5, height - 1.5], [width - 1.0, height - 1.0], [0.0, 0.0]]], dtype=torch.float64)
    aligned = (2 * exact / torch.tensor([width - 1, height - 1]) - 1).float()
    for volume, position in [(bev, aligned), (bev[:, :, None], F.pad(aligned, (0, 1)))]:
        sampler = SAMPLERS[position.shape[-1] - 2]
        position.requires_grad_()
        # A float32 coordinate is known to 6e-8 of half the map: 1.4e-3 cells.
        out = sampler.call()(volume, position, align_corners=True)
        assert_close(out.flatten().double(), torch.tensor([2.5, 4.0, 0.0], dtype=torch.float64), 4e-3)
        (first,) = torch.autograd.grad(out.float().sum(), position)
        values, grads = sampler.call("_with_grad")(volume, position, align_corners=True)
        assert torch.equal(values, out)
        # Values rise by 1 per column and by 2 per row there.
        expected = torch.tensor([(width - 1) / 2, height - 1.0])
        assert_close(grads[0, 0, :2, 0].float(), expected, 4e-3)
        assert_close(first[0, 0, :2], expected, 4e-3)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_kib < 1 << 20


def test_errors(backend: str) -> None:
    bev, grid = case(BEV.small)
    for name, sample in {"sample_bev": sample_bev, "sample_bev_with_grad": sample_bev_with_grad}.items():
        with pytest.raises(ValueError, match=rf"{name}: grid must have shape \[2, N, 2\], got \[3, 23, 2\]"):
            sample(bev, grid[:1].expand(3, -1, -1))
        with pytest.raises(ValueError, match=rf"{name}: bev must have shape \[B, C, H, W\]"):
            sample(bev[0], grid)
        with pytest.raises(TypeError, match=f"{name}: grid must have the dtype of bev"):
            sample(bev, grid.float())
        with pytest.raises(TypeError, match=f"{name}: grid must have the dtype of bev"):
            sample(bev, grid.half())
        with pytest.raises(TypeError, match=f"{name}: bev must be float32 or float64 or bfloat16 or .*, got int64"):
            sample(bev.long(), grid.long())
        with pytest.raises(TypeError, match=f"{name}: grid must be float32, got float64"):
            sample(bev.bfloat16(), grid)
        with torch.autocast("cpu", torch.bfloat16), pytest.raises(TypeError, match="grid must have the dtype of bev"):
            sample(bev.float(), grid.double())
        with pytest.raises(ValueError, match=f"{name}: padding_mode must be one of zeros, border, got 'reflection'"):
            sample(bev, grid, "reflection")
        with pytest.raises(ValueError, match=f"{name}: bev must have at least one row and column"):
            sample(bev[:, :, :0], grid)
    volume, grid = case(VOLUME.small)
    with pytest.raises(ValueError, match=r"sample_volume: grid must have shape \[2, N, 3\], got \[2, 23, 2\]"):
        sample_volume(volume, grid[..., :2])
    with pytest.raises(
        ValueError, match=r"sample_volume: volume must have shape \[B, C, D, H, W\], got \[2, 2, 2, 4\]"
    ):
        sample_volume(volume[:, :, 0], grid)
    with pytest.raises(ValueError, match="sample_volume: volume must have at least one layer, row and column"):
        sample_volume(volume[:, :, :0], grid)


def test_direct_calls_are_checked(native: None, sampler: Sampler) -> None:
    volume, grid = case(sampler.small)
    with pytest.raises(KERNEL_ERROR, match=f"{sampler.op}: grid must be float64 with a float64"):
        sampler.native()(volume, grid.float(), False, False)
    with pytest.raises(KERNEL_ERROR, match=f"{sampler.op}: grid must be float32 with a float32 or half"):
        sampler.native()(volume.half(), grid, False, False)
    with pytest.raises(KERNEL_ERROR, match=f"{sampler.op}_backward: grad must have shape \\[2, 23, .\\], got"):
        sampler.native("_backward")(
            torch.zeros(2, 22, volume.shape[1]).double(), volume, grid, False, False, True, True, True
        )
    with pytest.raises(KERNEL_ERROR, match=f"{sampler.op}_with_grad_backward: grad_grads must have 4 dimensions"):
        sampler.native("_with_grad_backward")(None, volume[0, 0], volume, grid, False, False, True, True, True)
    with pytest.raises(KERNEL_ERROR, match=f"{sampler.op}_with_grad_backward: one gradient must be given"):
        sampler.native("_with_grad_backward")(None, None, volume, grid, False, False, True, True, True)
