# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pred.ops import reference, sdf_to_alpha
from tests.tolerances import FORWARD, GRADIENT, assert_close


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def rays(num_rays: int = 7, samples: int = 33, dtype: torch.dtype = torch.float64) -> Tensor:
    """Distances that fall and rise, some through a surface."""
    generator = torch.Generator().manual_seed(100 * num_rays + samples)
    steps = torch.randn(num_rays, samples, generator=generator, dtype=torch.float64)
    return (2 - steps.cumsum(dim=1) * 0.3 - 0.1 * torch.arange(samples)).to(dtype)


# (d_i, d_i+1, s, alpha, d alpha / d d_i, d alpha / d d_i+1), by the definition with Phi(d) = sigmoid(s d) and, where
# that is 0 / 0 in floating point, by its limit 1 - exp(s (d_i+1 - d_i)).
CASES = {
    "crossing": (1.0, -1.0, 1.0, 1 - math.exp(-1), 0.26894142 * 0.19661193 / 0.73105858**2, -0.26894142),
    "deep inside, falling": (-2.0, -2.1, 64.0, 0.9983384, 0.1063388, -0.1063388),
    "inside, rising": (-3.0, -2.9, 64.0, 0.0, 0.0, 0.0),
    "inside, nearly flat": (-1.0, -1.0001, 64.0, 1 - math.exp(-0.0064), 63.5917, -63.5917),
    "free space": (10.0, 9.9, 64.0, 0.0, 0.0, 0.0),
    "small crossing": (0.3, 0.29, 20.0, 5.4715e-4, 20 * sigmoid(-5.8) * math.exp(-0.2), None),
    "tie": (0.5, 0.5, 64.0, 0.0, 0.0, 0.0),
    "opaque": (7.8125, -7.8125, 64.0, 1.0, 0.0, 0.0),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CASES)
def test_hand_computed(backend: str, name: str, dtype: torch.dtype) -> None:
    before, after, inv_s, alpha, grad_before, grad_after = CASES[name]
    sdf = torch.tensor([[before, after]], dtype=dtype, requires_grad=True)
    out = sdf_to_alpha(sdf, inv_s)
    out.sum().backward()
    assert out[0, 1] == 0
    # A difference of 1e-4 between float32 numbers near 1 is exact to 6e-4 only.
    rel = 1e-3 if dtype == torch.float32 and name == "inside, nearly flat" else 3e-5
    assert out[0, 0].item() == pytest.approx(alpha, rel=rel, abs=1e-12)
    assert sdf.grad is not None
    assert sdf.grad[0, 0].item() == pytest.approx(grad_before, rel=1e-4, abs=1e-12)
    if grad_after is not None:
        assert sdf.grad[0, 1].item() == pytest.approx(grad_after, rel=1e-4, abs=1e-12)


def test_last_sample(backend: str) -> None:
    sdf = torch.tensor([[1.0, -1.0]])
    assert sdf_to_alpha(sdf, 1.0)[0, 1] == 0
    assert sdf_to_alpha(sdf, 1.0, last="opaque")[0, 1] == 1
    assert sdf_to_alpha(sdf[:, :1], 1.0, last="opaque").tolist() == [[1.0]]


@pytest.mark.parametrize("inv_s", [1e-3, 0.37, 2.7, 64.0, 500.0])
def test_float32_is_accurate_where_it_is_small(level: str, inv_s: float) -> None:
    """Relative error against the definition in float64, for distances of up to s d = +-500 and tiny differences."""
    generator = torch.Generator().manual_seed(0)
    before = (torch.rand(4000, generator=generator) * 2 - 1) * 500 / max(inv_s, 50)
    step = 10 ** (torch.rand(4000, generator=generator) * 6 - 5) / max(inv_s, 1)
    sdf = torch.stack([before, before - step], dim=1)
    scale = torch.tensor(inv_s)
    wide, wide_scale = sdf.double(), scale.double()
    falls = (wide[:, 0] - wide[:, 1]).clamp(min=0)
    expected = torch.sigmoid(-wide_scale * wide[:, 1]) * -torch.expm1(-wide_scale * falls)
    actual = sdf_to_alpha(sdf, scale)[:, 0].double()
    normal = expected > 1e-30  # below, float32 runs out of range
    assert normal.sum() > 1000
    assert ((actual - expected).abs() / expected)[normal].max() <= 1e-6
    assert (actual[~normal] <= 1.1e-30).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_sharpness(backend: str, dtype: torch.dtype) -> None:
    """The clip range of common parametrisations, 1e-6 to 1e6, and 0."""
    sdf = torch.tensor([[2.0, 1.0, -1.0, -2.0, 3.0]], dtype=dtype)
    soft = sdf_to_alpha(sdf, torch.tensor(1e-6, dtype=dtype))[0]
    assert soft.tolist() == pytest.approx([5e-7, 1e-6, 5e-7, 0.0, 0.0], rel=2e-6)
    assert sdf_to_alpha(sdf, torch.tensor(1e6, dtype=dtype))[0].tolist() == [0.0, 1.0, 1.0, 0.0, 0.0]
    assert sdf_to_alpha(sdf, torch.tensor(0.0, dtype=dtype))[0].tolist() == [0.0] * 5


@pytest.mark.parametrize("wrong", [-1.0, torch.inf, torch.nan])
@pytest.mark.parametrize("as_tensor", [False, True])
def test_sharpness_is_checked(backend: str, wrong: float, as_tensor: bool) -> None:
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be finite and not negative, got -?(1|inf|nan)"):
        sdf_to_alpha(torch.zeros(1, 2), torch.tensor(wrong) if as_tensor else wrong)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 15), (3, 16), (3, 17), (5, 224), (40, 33)])
def test_native_equals_reference(native: None, shape: tuple[int, int], dtype: torch.dtype) -> None:
    results = []
    for function, kind in [(sdf_to_alpha, dtype), (reference.sdf_to_alpha, torch.float64)]:
        sdf = rays(*shape, dtype).to(kind).requires_grad_()
        inv_s = torch.tensor(2.7, dtype=dtype).to(kind).requires_grad_()
        out = function(sdf, inv_s)
        cotangent = torch.linspace(-1, 2, out.numel(), dtype=kind).reshape(out.shape)
        results.append([out, *torch.autograd.grad(out, (sdf, inv_s), cotangent)])
    for name, actual, expected in zip(("alpha", "grad_sdf", "grad_inv_s"), *results, strict=True):
        assert_close(actual.double(), expected, (FORWARD if name == "alpha" else GRADIENT)[dtype], name)


def test_gradcheck(backend: str) -> None:
    sdf = rays(3, 9).requires_grad_()
    inv_s = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sdf_to_alpha, (sdf, inv_s))
    assert torch.autograd.gradcheck(lambda d, s: sdf_to_alpha(d, s, last="opaque"), (sdf, inv_s))


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0), (2, 1)])
def test_empty(backend: str, shape: tuple[int, int]) -> None:
    sdf, inv_s = torch.randn(shape, requires_grad=True), torch.tensor(2.7, requires_grad=True)
    out = sdf_to_alpha(sdf, inv_s)
    assert out.shape == shape
    out.sum().backward()
    assert sdf.grad is not None and sdf.grad.shape == shape and not sdf.grad.any()
    assert inv_s.grad is not None and inv_s.grad == 0


@pytest.mark.parametrize("num_rays", [0, 3])
def test_opcheck(native: None, num_rays: int) -> None:
    sdf, inv_s = rays(num_rays, 9).float().requires_grad_(), torch.tensor(2.7, requires_grad=True)
    torch.library.opcheck(torch.ops.pred.sdf_to_alpha.default, (sdf, inv_s, False))
    arguments = (torch.randn(num_rays, 9), sdf.detach(), inv_s.detach(), True, True)
    torch.library.opcheck(torch.ops.pred.sdf_to_alpha_backward.default, arguments)


def test_further_derivative_is_refused(native: None) -> None:
    sdf = rays(2, 5).requires_grad_()
    (first,) = torch.autograd.grad(sdf_to_alpha(sdf, 2.7).sum(), sdf, create_graph=True)
    with pytest.raises(RuntimeError, match="sdf_to_alpha_backward: a further derivative"):
        first.square().sum().backward()


def test_compiles_to_one_graph(backend: str) -> None:
    inputs = (rays(3, 20).requires_grad_(), torch.tensor(1.3, dtype=torch.float64, requires_grad=True))

    def loss(sdf: Tensor, inv_s: Tensor) -> Tensor:
        return sdf_to_alpha(sdf, inv_s).square().sum()

    actual = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend="aot_eager")(*inputs), inputs)
    for a, e in zip(actual, torch.autograd.grad(loss(*inputs), inputs), strict=True):
        assert_close(a, e, 1e-13)


def test_bitwise_equal_for_any_thread_count(native: None) -> None:
    found = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        sdf, inv_s = rays(700, 97, torch.float32).requires_grad_(), torch.tensor(2.7, requires_grad=True)
        out = sdf_to_alpha(sdf, inv_s)
        found.append([out, *torch.autograd.grad(out.square().sum(), (sdf, inv_s))])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_nan_stays_in_its_ray(backend: str) -> None:
    sdf = rays(3, 20, torch.float32)
    clean = sdf_to_alpha(sdf, 2.7)
    sdf[1, 7] = torch.nan
    out = sdf_to_alpha(sdf, 2.7)
    assert torch.equal(out[[0, 2]], clean[[0, 2]])
    assert out[1].isnan().any()


def test_layouts_agree(backend: str) -> None:
    sdf = rays(4, 21)
    expected = sdf_to_alpha(sdf, 2.7)
    assert torch.equal(sdf_to_alpha(sdf[..., None], 2.7), expected)
    assert torch.equal(sdf_to_alpha(sdf.T.contiguous().T, torch.tensor([2.7], dtype=torch.float64)), expected)


def test_errors(backend: str) -> None:
    sdf = rays(2, 4)
    with pytest.raises(ValueError, match="sdf_to_alpha: mode must be one of pair, got 'section'"):
        sdf_to_alpha(sdf, 2.7, mode="section")
    with pytest.raises(ValueError, match="sdf_to_alpha: last must be one of zero, opaque"):
        sdf_to_alpha(sdf, 2.7, last="one")
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be finite and not negative, got -1"):
        sdf_to_alpha(sdf, -1.0)
    with pytest.raises(ValueError, match=r"sdf_to_alpha: sdf must have shape \[R, S\], got \[4\]"):
        sdf_to_alpha(sdf[0], 2.7)
    with pytest.raises(TypeError, match="sdf_to_alpha: sdf must be float32 or float64, got int64"):
        sdf_to_alpha(sdf.long(), 2.7)
