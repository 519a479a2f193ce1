# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import pytest
import torch
import torch._dynamo.testing
from torch import Tensor

from pred.ops import reference, sdf_to_alpha
from tests.conftest import require_value_checks
from tests.ops.published import published_section
from tests.ops.two_samples import TWO_SAMPLES
from tests.tolerances import FORWARD, GRADIENT, assert_close, of_rounded_distances


def rays(num_rays: int = 7, samples: int = 33, dtype: torch.dtype = torch.float64) -> Tensor:
    """Distances that fall and rise, some through a surface."""
    generator = torch.Generator().manual_seed(100 * num_rays + samples)
    steps = torch.randn(num_rays, samples, generator=generator, dtype=torch.float64)
    return (2 - steps.cumsum(dim=1) * 0.3 - 0.1 * torch.arange(samples)).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", TWO_SAMPLES)
def test_hand_computed(backend: str, name: str, dtype: torch.dtype) -> None:
    before, after, inv_s, alpha, grad_before, grad_after = TWO_SAMPLES[name]
    sdf = torch.tensor([[before, after]], dtype=dtype, requires_grad=True)
    out = sdf_to_alpha(sdf, inv_s)
    out.sum().backward()
    assert out[0, 1] == 0
    rel = of_rounded_distances(before, after, inv_s, dtype)
    assert out[0, 0].item() == pytest.approx(alpha, rel=rel, abs=1e-12)
    assert sdf.grad is not None
    assert sdf.grad[0].tolist() == pytest.approx([grad_before, grad_after], rel=rel, abs=1e-12)


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
    require_value_checks(backend)
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be finite and not negative, got -?(1|inf|nan)"):
        sdf_to_alpha(torch.zeros(1, 2), torch.tensor(wrong) if as_tensor else wrong)
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be finite and not negative, got -?(1|inf|nan)"):
        sdf = torch.zeros(1, 2)
        sdf_to_alpha(sdf, torch.tensor(wrong) if as_tensor else wrong, "section", cosine=sdf, section_length=sdf)


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


# --- packed rays -----------------------------------------------------------------------------------------------------


def packed(counts: list[int], dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Distances of rays with these numbers of samples, and their offsets."""
    offsets = torch.tensor([0, *counts]).cumsum(dim=0)
    return rays(1, int(offsets[-1]) + 1, dtype)[0, :-1], offsets


COUNTS = [0, 1, 5, 0, 0, 2, 300, 1, 1, 17, 16, 0]


@pytest.mark.parametrize("last", ["zero", "opaque"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_packed_equals_ray_by_ray(backend: str, dtype: torch.dtype, last: str) -> None:
    sdf, offsets = packed(COUNTS, dtype)
    inv_s = torch.tensor(2.7, dtype=dtype, requires_grad=True)
    sdf.requires_grad_()
    cotangent = torch.linspace(-1, 2, sdf.numel(), dtype=dtype)
    one_by_one = torch.cat([sdf_to_alpha(ray[None], inv_s, last=last)[0] for ray in sdf.split(COUNTS)])
    together = sdf_to_alpha(sdf, inv_s, last=last, ray_offsets=offsets)
    assert_close(together, one_by_one, FORWARD[dtype])
    expected = torch.autograd.grad(one_by_one, (sdf, inv_s), cotangent)
    for a, e in zip(torch.autograd.grad(together, (sdf, inv_s), cotangent), expected, strict=True):
        assert_close(a, e, GRADIENT[dtype])


def test_packed_nan_stays_in_its_ray(backend: str) -> None:
    for bad in (torch.nan, torch.inf, -torch.inf):
        sdf = torch.tensor([2.0, 1.0, 1.0, 0.5, -1.0, 3.0, 2.0])
        offsets = torch.tensor([0, 2, 5, 7])
        sdf[2:5] = bad
        sdf.requires_grad_()
        alpha = sdf_to_alpha(sdf, 1.0, ray_offsets=offsets)
        alone = sdf_to_alpha(torch.tensor([[2.0, 1.0], [3.0, 2.0]]), 1.0)
        assert_close(alpha[[0, 1, 5, 6]], alone.flatten(), 1e-7)
        alpha.sum().backward()
        assert sdf.grad is not None and sdf.grad[[0, 1, 5, 6]].isfinite().all()


@pytest.mark.parametrize("counts", [[], [0], [0, 0, 0]])
def test_packed_without_samples(backend: str, counts: list[int]) -> None:
    sdf = torch.zeros(0, requires_grad=True)
    inv_s = torch.tensor(1.0, requires_grad=True)
    alpha = sdf_to_alpha(sdf, inv_s, ray_offsets=torch.tensor([0, *counts]).cumsum(dim=0))
    assert alpha.shape == (0,)
    alpha.sum().backward()
    assert inv_s.grad == 0


# --- sections and densities ------------------------------------------------------------------------------------------


def sections(
    shape: tuple[int, ...], dtype: torch.dtype = torch.float64, reach: float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Distances, cosines of any sign, and lengths."""
    generator = torch.Generator().manual_seed(shape[0])
    sdf = torch.randn(shape, generator=generator, dtype=torch.float64) * reach
    cosine = torch.randn(shape, generator=generator, dtype=torch.float64) * 0.7
    length = torch.rand(shape, generator=generator, dtype=torch.float64) * 0.6
    return sdf.to(dtype), cosine.to(dtype), length.to(dtype)


def section_results(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], inv_s: float, cos_anneal: float, eps: float
) -> list[Tensor]:
    """Value and the gradients of sdf, inv_s, cosine and section_length."""
    sdf, cosine, length = (tensor.detach().requires_grad_() for tensor in inputs)
    scale = torch.tensor(inv_s, dtype=sdf.dtype, requires_grad=True)
    alpha = function(sdf, scale, cosine, length, cos_anneal, eps)
    cotangent = torch.linspace(-1, 2, alpha.numel(), dtype=sdf.dtype).reshape(alpha.shape)
    return [alpha, *torch.autograd.grad(alpha, (sdf, scale, cosine, length), cotangent)]


def ours(sdf: Tensor, inv_s: Tensor, cosine: Tensor, length: Tensor, cos_anneal: float, eps: float) -> Tensor:
    return sdf_to_alpha(sdf, inv_s, "section", cosine=cosine, section_length=length, cos_anneal=cos_anneal, eps=eps)


def ours_reference(sdf: Tensor, inv_s: Tensor, cosine: Tensor, length: Tensor, cos_anneal: float, eps: float) -> Tensor:
    return reference.sdf_to_alpha(
        sdf, inv_s, "section", cosine=cosine, section_length=length, cos_anneal=cos_anneal, eps=eps
    )


NAMES = ("alpha", "grad_sdf", "grad_inv_s", "grad_cosine", "grad_section_length")


@pytest.mark.parametrize("cos_anneal", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("inv_s", [0.37, 2.7, 20.1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_section_is_the_published_formula(backend: str, dtype: torch.dtype, inv_s: float, cos_anneal: float) -> None:
    """NeuS and UniPAD with their epsilon: value and every derivative."""
    inputs = sections((31, 37), dtype)
    actual = section_results(ours, inputs, inv_s, cos_anneal, 1e-5)
    expected = section_results(published_section, inputs, inv_s, cos_anneal, 1e-5)
    for name, a, e in zip(NAMES, actual, expected, strict=True):
        assert_close(a, e, 1e-5 if dtype == torch.float32 else 1e-12, name)


@pytest.mark.parametrize("cos_anneal", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("inv_s", [0.37, 2.7, 20.1])
def test_section_without_epsilon_is_the_papers_formula(backend: str, inv_s: float, cos_anneal: float) -> None:
    """Where float64 evaluates the paper's formula: s d within +-20, so that Phi is not tiny."""
    inputs = sections((31, 37), reach=8 / max(inv_s, 4))
    actual = section_results(ours, inputs, inv_s, cos_anneal, 0.0)
    expected = section_results(published_section, inputs, inv_s, cos_anneal, 0.0)
    for name, a, e in zip(NAMES, actual, expected, strict=True):
        assert_close(a, e, 1e-12, name)


@pytest.mark.parametrize("eps", [0.0, 1e-5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1,), (1023,), (1025,), (5000,), (3, 15), (3, 16), (40, 224)])
def test_section_native_equals_reference(native: None, shape: tuple[int, ...], dtype: torch.dtype, eps: float) -> None:
    inputs = sections(shape, dtype, reach=0.3 if shape == (1,) else 3.0)
    wide = tuple(tensor.double() for tensor in inputs)
    actual = section_results(ours, inputs, 2.7, 0.4, eps)
    expected = section_results(ours_reference, wide, 2.7, 0.4, eps)
    # With eps, Phi(d_prev) - Phi(d_next) cancels, in the published code as here: 6e-8 of 1 remains, of opacities 0.5.
    forward = 2 * FORWARD[dtype] if eps else FORWARD[dtype]
    for name, a, e in zip(NAMES, actual, expected, strict=True):
        assert_close(a.double(), e, forward if name == "alpha" else GRADIENT[dtype], name)


# (d, cosine, length, s): opacity with eps = 0 by hand, its derivative in d, and what NeuS's formula gives in float32.
# Phi(d_prev) -> 0 inside: alpha -> 1 - exp(-s fall length), d alpha / d d_next -> 0; 1 - Phi(-s d_next) Phi(...) small.
SECTION_CASES = {
    # From -2 to -2.1 at s = 64: 1 - exp(-6.4). NeuS: (0 - 0 + eps) / (0 + eps).
    "deep inside, falling": (-2.05, -1.0, 0.1, 64.0, 1 - math.exp(-6.4), 1.0),
    # From -3 to -2.9: the distance rises, so that nothing is in the way.
    "inside, rising": (-2.95, 1.0, 0.1, 64.0, 0.0, 1.0),
    # From -1 to -1.0001: 1 - exp(-0.0064).
    "inside, nearly flat": (-1.00005, -1.0, 1e-4, 64.0, 1 - math.exp(-0.0064), 1.0),
    # Far in front of everything. NeuS: (1 - 1 + eps) / (1 + eps).
    "free space": (10.0, -1.0, 0.1, 64.0, 0.0, 1e-5 / (1 + 1e-5)),
    # From 0.3 to 0.29 at s = 20: sigmoid(-5.8) (1 - exp(-0.2)).
    "small crossing": (0.295, -1.0, 0.01, 20.0, 1 / (1 + math.exp(5.8)) * (1 - math.exp(-0.2)), None),
    # Phi(0.5) = 0.622459, Phi(-0.5) = 0.377541: 1 - exp(-0.5)... = 0.244919 / 0.622459.
    "crossing": (0.0, -1.0, 1.0, 1.0, 0.244918662 / 0.622459331, (0.244918662 + 1e-5) / (0.622459331 + 1e-5)),
    # Two equal ranges enclose nothing. NeuS: eps / (Phi(32) + eps).
    "no length": (0.5, -1.0, 0.0, 64.0, 0.0, 1e-5 / (1 + 1e-5)),
    "opaque": (0.0, -1.0, 15.625, 64.0, 1.0, 1.0),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SECTION_CASES)
def test_section_by_hand(backend: str, name: str, dtype: torch.dtype) -> None:
    distance, angle, step, inv_s, alpha, neus = SECTION_CASES[name]
    sdf, cosine, length = (torch.tensor([x], dtype=dtype) for x in (distance, angle, step))
    scale = torch.tensor(inv_s, dtype=dtype)
    exact = ours(sdf, scale, cosine, length, 1.0, 0.0)
    assert exact.item() == pytest.approx(alpha, rel=1e-5, abs=1e-12)
    published = ours(sdf, scale, cosine, length, 1.0, 1e-5)
    assert published.item() == pytest.approx(
        published_section(sdf, scale, cosine, length, 1.0, 1e-5).item(), rel=1e-5, abs=1e-7
    )
    if neus is not None and not (dtype == torch.float64 and name == "inside, nearly flat"):
        assert published.item() == pytest.approx(neus, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_section_gradients_where_neus_has_none(backend: str, dtype: torch.dtype) -> None:
    """Inside a surface alpha = 1 - exp(-s fall length): d alpha / d length = 64 exp(-6.4) = 0.10634, and 63.59 for the
    nearly flat section, where the published formula has 0."""
    for distance, step, slope in ((-2.05, 0.1, 64 * math.exp(-6.4)), (-1.00005, 1e-4, 64 * math.exp(-0.0064))):
        inputs = tuple(torch.tensor([x], dtype=dtype) for x in (distance, -1.0, step))

        def gradient(eps: float, inputs: tuple[Tensor, ...] = inputs) -> tuple[float, float]:
            sdf, cosine, length = (tensor.clone().requires_grad_() for tensor in inputs)
            ours(sdf, torch.tensor(64.0, dtype=dtype), cosine, length, 1.0, eps).backward()
            assert cosine.grad is not None and length.grad is not None
            return cosine.grad.item(), length.grad.item()

        of_cosine, of_length = gradient(0.0)
        assert of_length == pytest.approx(slope, rel=1e-4)
        assert of_cosine == pytest.approx(-slope * step, rel=1e-4)
        if dtype == torch.float32:
            assert gradient(1e-5) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_free_space_is_transparent(backend: str) -> None:
    """223 sections in front of a wall: NeuS's epsilon makes a fog of weight 0.0022."""
    sdf, cosine, length = (torch.full((1, 223), x) for x in (10.0, -1.0, 0.1))
    for eps, fog in ((0.0, 0.0), (1e-5, 1 - (1 - 1e-5) ** 223)):
        alpha = ours(sdf, torch.tensor(64.0), cosine, length, 1.0, eps)
        transmittance = torch.cumprod(torch.cat([torch.ones(1, 1), 1 - alpha], dim=1), dim=1)
        assert (alpha * transmittance[:, :-1]).sum().item() == pytest.approx(fog, rel=1e-2, abs=0.0)


@pytest.mark.parametrize("inv_s", [1e-3, 0.37, 2.7, 64.0, 500.0])
def test_section_float32_is_accurate_where_it_is_small(level: str, inv_s: float) -> None:
    """Relative error against the closed form in float64, for s d up to +-500 and steps down to 1e-5."""
    generator = torch.Generator().manual_seed(0)
    sdf = (torch.rand(4000, generator=generator) * 2 - 1) * 500 / max(inv_s, 50)
    length = 10 ** (torch.rand(4000, generator=generator) * 6 - 5) / max(inv_s, 1)
    cosine, scale = torch.full_like(sdf, -1.0), torch.tensor(inv_s)
    # The end of the section as rounded to float32: its error counts s times, which is not the formula's fault.
    end, wide = (sdf - length * 0.5).double(), scale.double()
    expected = torch.sigmoid(-wide * end) * -torch.expm1(-wide * length.double())
    actual = ours(sdf, scale, cosine, length, 1.0, 0.0).double()
    normal = expected > 1e-30
    assert normal.sum() > 1000
    assert ((actual - expected).abs() / expected)[normal].max() <= 1e-6


def test_section_gradcheck(backend: str) -> None:
    sdf, cosine, length = (tensor.requires_grad_() for tensor in sections((4, 5)))
    inv_s = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)
    for eps in (0.0, 1e-5):
        for cos_anneal in (0.0, 0.6, 1.0):
            function = functools.partial(ours, cos_anneal=cos_anneal, eps=eps)
            assert torch.autograd.gradcheck(function, (sdf, inv_s, cosine, length))


@pytest.mark.parametrize("eps", [0.0, 1e-5])
def test_section_at_its_kinks(backend: str, eps: float) -> None:
    """relu has derivative 0 at 0 (cosine 0 with anneal 1, cosine 1 with anneal 0), clip passes on its bounds."""
    sdf, inv_s = torch.tensor([0.2, 0.2, -90.0], dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    cosine = torch.tensor([0.0, 1.0, 0.5], dtype=torch.float64)
    for cos_anneal in (0.0, 1.0):
        inputs = (sdf, cosine, torch.tensor([0.5, 0.5, 0.5], dtype=torch.float64))
        actual = section_results(ours, inputs, float(inv_s), cos_anneal, eps)
        expected = section_results(published_section, inputs, float(inv_s), cos_anneal, eps)
        # With eps the derivative in sdf is a difference of numbers near 0.2, of 8e-6: 1e-17 / 8e-6.
        for name, a, e in zip(NAMES, actual, expected, strict=True):
            if a.dim():
                assert_close(a[:2], e[:2], 2e-11, name)
    negative = (sdf, -torch.ones_like(sdf), torch.tensor([-0.5, 0.0, -0.1], dtype=torch.float64))
    alpha, grad_sdf, _, grad_cosine, grad_length = section_results(ours, negative, 1.0, 1.0, eps)
    assert alpha[0] == 0 and grad_cosine[0] == 0 and grad_length[0] == 0
    assert grad_length[1] != 0 and grad_sdf[0] == 0


@pytest.mark.parametrize("mode", ["section", "published", "density"])
def test_nan_stays_in_its_sample(backend: str, mode: str) -> None:
    for which in range(2 if mode == "density" else 3):
        for bad in (torch.nan, torch.inf, -torch.inf):
            inputs = [tensor.clone() for tensor in sections((40,), torch.float32)]
            inputs[0] = inputs[0].abs() if mode == "density" else inputs[0]
            inputs = inputs[:2] if mode == "density" else inputs

            def call(tensors: list[Tensor]) -> Tensor:
                if mode == "density":
                    return sdf_to_alpha(tensors[0], mode="density", section_length=tensors[1])
                return ours(
                    tensors[0], torch.tensor(2.7), tensors[1], tensors[2], 0.5, 1e-5 if mode == "published" else 0.0
                )

            clean = call(inputs)
            inputs[which][7] = bad
            leaves = [tensor.requires_grad_() for tensor in inputs]
            alpha = call(leaves)
            others = torch.arange(40) != 7
            assert torch.equal(alpha[others], clean[others])
            assert alpha[7].isnan() or bad is not torch.nan
            for gradient in torch.autograd.grad(alpha.sum(), leaves):
                assert gradient[others].isfinite().all()


def test_density_by_hand(backend: str) -> None:
    """Steps of 1 through densities 0.4, 0.8, 0: 1 - e^-0.4 and so on; a tiny product is itself."""
    density = torch.tensor([0.4, 0.8, 0.0, 1e-9, 200.0, -1.0], requires_grad=True)
    length = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.0, 0.5], requires_grad=True)
    alpha = sdf_to_alpha(density, mode="density", section_length=length)
    expected = [0.32967995, 0.55067104, 0.0, 1e-9, 1.0, 1 - math.exp(0.5)]
    assert alpha.tolist() == pytest.approx(expected, rel=1e-6)
    alpha.sum().backward()
    assert density.grad is not None and length.grad is not None
    kept = [math.exp(-0.4), math.exp(-0.8), 1.0, 1.0, 0.0, math.exp(0.5)]
    assert density.grad.tolist() == pytest.approx([*kept[:5], 0.5 * kept[5]], rel=1e-6, abs=1e-30)
    assert length.grad.tolist() == pytest.approx(
        [d * k for d, k in zip(density.tolist(), kept, strict=True)], rel=1e-6, abs=1e-30
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1,), (511,), (5000,), (3, 224)])
def test_density_is_the_published_formula(level: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    density, _, length = sections(shape, dtype)
    results = []
    for ours_too in (True, False):
        # The formula in float64: as 1 - exp() it cancels.
        kind = dtype if ours_too else torch.float64
        leaves = [(3 * density.abs()).to(kind).requires_grad_(), length.to(kind).requires_grad_()]
        if ours_too:
            alpha = sdf_to_alpha(leaves[0], mode="density", section_length=leaves[1])
        else:
            alpha = 1 - torch.exp(-leaves[0] * leaves[1])
        cotangent = torch.linspace(-1, 2, alpha.numel(), dtype=kind).reshape(shape)
        results.append([alpha, *torch.autograd.grad(alpha, leaves, cotangent)])
    for name, a, e in zip(("alpha", "grad_density", "grad_length"), *results, strict=True):
        assert_close(a.double(), e, (FORWARD if name == "alpha" else GRADIENT)[dtype], name)


def test_density_gradcheck(backend: str) -> None:
    density, _, length = (tensor.requires_grad_() for tensor in sections((4, 5)))
    assert torch.autograd.gradcheck(lambda d, x: sdf_to_alpha(d, mode="density", section_length=x), (density, length))


def test_annealing_does_not_compile_again(native: None) -> None:
    """The angle's annealing changes with every step of a training."""
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")
    torch._dynamo.reset()
    compiled = torch.compile(
        lambda d, c, x, anneal: ours(d, d.new_full((), 2.7), c, x, anneal, 0.0), fullgraph=True, backend=counter
    )
    inputs = sections((30,))
    for step in range(12):
        expected = ours(inputs[0], inputs[0].new_full((), 2.7), *inputs[1:], step / 20, 0.0)
        assert_close(compiled(*inputs, step / 20), expected, 1e-13)
    assert counter.frame_count <= 2  # the first number, and all others


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_half_precision_is_widened(backend: str, half: torch.dtype) -> None:
    """Values and gradients are those of the same numbers in float32; gradients come back in half precision."""
    inputs = [tensor.to(half).requires_grad_() for tensor in sections((3, 8))]
    wide = [tensor.detach().float().requires_grad_() for tensor in inputs]
    inv_s = torch.tensor(2.7)
    for call in (
        lambda d, c, x: ours(d, inv_s, c, x, 0.5, 0.0),
        lambda d, c, x: sdf_to_alpha(d, inv_s) + 0 * c + 0 * x,
        lambda d, c, x: sdf_to_alpha(d, mode="density", section_length=x) + 0 * c,
    ):
        actual, expected = call(*inputs), call(*wide)
        assert actual.dtype == torch.float32
        assert torch.equal(actual, expected)
        grads = torch.autograd.grad(actual.sum(), inputs)
        for a, e in zip(grads, torch.autograd.grad(expected.sum(), wide), strict=True):
            assert a.dtype == half
            assert_close(a, e.to(half), 1e-7)


def test_section_layouts_agree(backend: str) -> None:
    sdf, cosine, length = sections((6, 8))
    scale = torch.tensor(2.7, dtype=torch.float64)
    expected = ours(sdf, scale, cosine, length, 0.3, 0.0)
    assert torch.equal(ours(sdf[..., None], scale, cosine[..., None], length, 0.3, 0.0), expected)
    flat = ours(sdf.flatten(), scale, cosine.flatten(), length.flatten(), 0.3, 0.0)
    assert_close(flat, expected.flatten(), 1e-15)
    transposed = ours(sdf.T.contiguous().T, scale, cosine.T.contiguous().T, length, 0.3, 0.0)
    assert torch.equal(transposed, expected)
    density = sdf_to_alpha(sdf[..., None], mode="density", section_length=length[..., None])
    assert torch.equal(density, sdf_to_alpha(sdf, mode="density", section_length=length))


@pytest.mark.parametrize("shape", [(0,), (0, 5), (3, 0), (0, 0), (0, 5, 1)])
def test_empty_sections(backend: str, shape: tuple[int, ...]) -> None:
    sdf, cosine, length = (torch.zeros(shape, requires_grad=True) for _ in range(3))
    inv_s = torch.tensor(2.7, requires_grad=True)
    out = ours(sdf, inv_s, cosine, length, 1.0, 0.0)
    assert out.shape == shape[:2]
    out.sum().backward()
    assert inv_s.grad == 0
    assert sdf_to_alpha(sdf, mode="density", section_length=length).shape == shape[:2]


def test_errors(backend: str) -> None:
    sdf = rays(2, 4)

    def section(sdf: Tensor = sdf, inv_s: Tensor | float | None = 2.7, **options: object) -> Tensor:
        given = {"cosine": sdf, "section_length": sdf, **options}
        return sdf_to_alpha(sdf, inv_s, mode="section", **given)  # type: ignore[arg-type]

    with pytest.raises(ValueError, match="sdf_to_alpha: mode must be one of pair, section, density, got 'neus'"):
        sdf_to_alpha(sdf, 2.7, mode="neus")
    with pytest.raises(ValueError, match="sdf_to_alpha: last must be one of zero, opaque"):
        sdf_to_alpha(sdf, 2.7, last="one")
    with pytest.raises(ValueError, match=r"sdf_to_alpha: sdf must have shape \[R, S\], got \[4\]"):
        sdf_to_alpha(sdf[0], 2.7)
    with pytest.raises(TypeError, match="sdf_to_alpha: sdf must be float32 or float64, got int64"):
        sdf_to_alpha(sdf.long(), 2.7)
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be given in mode 'pair', got None"):
        sdf_to_alpha(sdf)
    with pytest.raises(ValueError, match="sdf_to_alpha: inv_s must be None in mode 'density', got a value"):
        sdf_to_alpha(sdf, 2.7, "density", section_length=sdf)
    with pytest.raises(ValueError, match="sdf_to_alpha: cosine must be None in mode 'pair', got a value"):
        sdf_to_alpha(sdf, 2.7, cosine=sdf)
    with pytest.raises(ValueError, match="sdf_to_alpha: cosine must be given in mode 'section', got None"):
        section(cosine=None)
    with pytest.raises(ValueError, match=r"sdf_to_alpha: section_length must have shape \[2, 4\] as sdf, got \[2, 3\]"):
        section(section_length=sdf[:, 1:])
    with pytest.raises(TypeError, match="sdf_to_alpha: cosine must have the dtype of sdf"):
        section(cosine=sdf.float())
    with pytest.raises(ValueError, match="sdf_to_alpha: last must be 'zero' in mode 'section'.*, got 'opaque'"):
        section(last="opaque")
    with pytest.raises(ValueError, match=r"sdf_to_alpha: cos_anneal must be in \[0, 1\], got 1.5"):
        section(cos_anneal=1.5)
    with pytest.raises(ValueError, match="sdf_to_alpha: eps must be finite and not negative, got -1e-05"):
        section(eps=-1e-5)
    with pytest.raises(ValueError, match="sdf_to_alpha: ray_offsets must be None in mode 'section', got a value"):
        section(ray_offsets=torch.tensor([0, 2]))
    flat = sdf.flatten()
    for wrong in ([1, 8], [0, 7], [0, 5, 4, 8], [0, 9, 8], [-1, 8]):
        with pytest.raises(ValueError, match="sdf_to_alpha: ray_offsets must ascend from 0 to P=8, got"):
            sdf_to_alpha(flat, 2.7, ray_offsets=torch.tensor(wrong))
    with pytest.raises(ValueError, match=r"sdf_to_alpha: ray_offsets must have shape \[R \+ 1\]"):
        sdf_to_alpha(flat, 2.7, ray_offsets=torch.tensor([], dtype=torch.int64))
    with pytest.raises(TypeError, match="sdf_to_alpha: ray_offsets must be int64, got int32"):
        sdf_to_alpha(flat, 2.7, ray_offsets=torch.tensor([0, 8], dtype=torch.int32))
    with pytest.raises(ValueError, match=r"sdf_to_alpha: sdf must have shape \[P\], got \[2, 4\]"):
        sdf_to_alpha(sdf, 2.7, ray_offsets=torch.tensor([0, 4, 8]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_sharpness_and_distances_give_no_nan(dtype: torch.dtype, level: str) -> None:
    largest = torch.finfo(dtype).max
    smallest = torch.finfo(dtype).tiny
    # Far, near, and on the surface; the sections fall, rise and stay.
    sdf = torch.tensor([[1.0, 0.5, 0.0, -1.0, 2.0, 2.0], [1e33, 1e-33, -1e-33, -1e33, 0.0, 1e33]], dtype=dtype)
    for inv_s in (smallest, 1e-20, 1e20, 5.8e34, largest / 2, largest):
        near = sdf.clone().requires_grad_()
        sharpness = torch.tensor(inv_s, dtype=dtype, requires_grad=True)
        alpha = sdf_to_alpha(near, sharpness)
        expected = reference.sdf_to_alpha(sdf.double() if inv_s < 1e300 else sdf, inv_s)
        assert_close(alpha, expected.to(dtype), FORWARD[dtype])
        # At a surface that s makes a step the derivative is as large as s, or infinite; it is never NaN.
        for grad in torch.autograd.grad(alpha.sum(), (near, sharpness)):
            assert not grad.isnan().any(), (inv_s, grad)


def test_huge_distances_under_a_small_sharpness(level: str) -> None:
    sdf = torch.tensor([[3e36, 2e36, -1e36, -3e38]])
    expected = reference.sdf_to_alpha(sdf.double(), 1e-36)
    assert_close(sdf_to_alpha(sdf, 1e-36), expected.float(), FORWARD[torch.float32])
    sdf = torch.tensor([[1e303, -1e303, -3e305]], dtype=torch.float64)
    for inv_s in (1e-305, 1e-303, 0.0):
        assert_close(sdf_to_alpha(sdf, inv_s), reference.sdf_to_alpha(sdf, inv_s), FORWARD[torch.float64])


def test_packed_column_is_packed(backend: str) -> None:
    sdf, offsets = torch.tensor([3.0, 1.0, -1.0, 2.0, -2.0]), torch.tensor([0, 3, 5])
    alpha = sdf_to_alpha(sdf[:, None], 2.7, ray_offsets=offsets)
    assert torch.equal(alpha, sdf_to_alpha(sdf, 2.7, ray_offsets=offsets))
