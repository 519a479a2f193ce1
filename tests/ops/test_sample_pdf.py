# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch._dynamo.testing
from torch import Tensor

from pred.ops import reference, resample_rays, sample_pdf
from tests.tolerances import FORWARD, PLACE, assert_close

UNIPAD: dict[str, Any] = {"mode": "nerfstudio", "histogram_padding": 0.0, "min_width": 1e-5}
RULES: dict[str, dict[str, Any]] = {
    "exact": {"mode": "exact"},
    "neus": {"mode": "neus"},
    "nerfstudio": {"mode": "nerfstudio"},
    "unipad": UNIPAD,
}


def case(num_rays: int = 6, edges: int = 24, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Rays with most of their weight in a few sections."""
    generator = torch.Generator().manual_seed(100 * num_rays + edges)
    t = 1 + torch.rand(num_rays, edges, generator=generator, dtype=torch.float64).cumsum(dim=1)
    weights = torch.rand(num_rays, edges - 1, generator=generator, dtype=torch.float64) ** 6
    return t.to(dtype), weights.to(dtype)


def call(name: str, edges: Tensor, weights: Tensor, n: int | None = None, u: Tensor | None = None) -> Tensor:
    return sample_pdf(edges, weights, n, u, **RULES[name])


# --- the published formulas, written out -----------------------------------------------------------------------------


def positions(bins: Tensor, n: int) -> Tensor:
    """The middles of n even strata, as linspace gives them in NeuS and nerfstudio."""
    return (
        torch.linspace(0.5 / max(n, 1), 1 - 0.5 / max(n, 1), n, dtype=bins.dtype).expand(bins.shape[0], n).contiguous()
    )


def neus(bins: Tensor, weights: Tensor, u: Tensor) -> Tensor:
    """NeuS (and NeRF)."""
    weights = weights + 1e-5
    pdf = weights / weights.sum(-1, keepdim=True)
    cdf = torch.cat([torch.zeros_like(pdf[..., :1]), pdf.cumsum(-1)], -1)
    index = torch.searchsorted(cdf, u, right=True)
    below, above = (index - 1).clamp(min=0), index.clamp(max=cdf.shape[-1] - 1)
    cdf_below, cdf_above = cdf.gather(-1, below), cdf.gather(-1, above)
    bin_below, bin_above = bins.gather(-1, below), bins.gather(-1, above)
    width = cdf_above - cdf_below
    width = torch.where(width < 1e-5, torch.ones_like(width), width)
    return bin_below + (u - cdf_below) / width * (bin_above - bin_below)


def nerfstudio(bins: Tensor, weights: Tensor, u: Tensor, unipad: bool = False) -> Tensor:
    """PDFSampler of nerfstudio, and of UniPAD."""
    weights = weights if unipad else weights + 0.01
    total = weights.sum(-1, keepdim=True)
    padding = torch.relu(1e-5 - total)
    pdf = (weights + padding / weights.shape[-1]) / (total + padding)
    cdf = torch.min(torch.ones_like(pdf), pdf.cumsum(-1))
    cdf = torch.cat([torch.zeros_like(cdf[..., :1]), cdf], -1)
    index = torch.searchsorted(cdf, u, right=True)
    below, above = (index - 1).clamp(0, bins.shape[-1] - 1), index.clamp(0, bins.shape[-1] - 1)
    cdf_below, cdf_above = cdf.gather(-1, below), cdf.gather(-1, above)
    bin_below, bin_above = bins.gather(-1, below), bins.gather(-1, above)
    if unipad:
        width = cdf_above - cdf_below
        t = torch.clip((u - cdf_below) / torch.where(width < 1e-5, torch.ones_like(width), width), 0, 1)
    else:
        t = torch.clip(torch.nan_to_num((u - cdf_below) / (cdf_above - cdf_below), 0), 0, 1)
    return bin_below + t * (bin_above - bin_below)


PUBLISHED: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "neus": neus,
    "nerfstudio": nerfstudio,
    "unipad": functools.partial(nerfstudio, unipad=True),
}


def assert_samples(actual: Tensor, expected: Tensor, edges: Tensor, mass: Tensor, tolerance: float) -> None:
    """Equal, where rounding does not decide.

    A rounding of u or of the cdf by ``tolerance`` moves a sample by tolerance / p of its section's length (p its
    probability), and in an almost empty section, or one that counts as empty, by up to the whole section: so far may
    sample k be from the expected one, and it may lie in the section before or behind.
    """
    assert actual.shape == expected.shape
    length = edges.diff(dim=1).abs()
    probability = mass / mass.sum(dim=1, keepdim=True)
    jump = torch.where(probability < 2e-5, length, length * (tolerance / probability).clamp(max=1))
    section = (torch.searchsorted(edges.contiguous(), expected.contiguous(), right=True) - 1).clamp(
        0, length.shape[1] - 1
    )
    allowed = tolerance * edges.abs().amax(dim=1, keepdim=True)
    reach = torch.stack([jump.gather(1, (section + k).clamp(0, length.shape[1] - 1)) for k in (-1, 0, 1)]).amax(dim=0)
    assert ((actual - expected).abs() <= allowed + reach).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 2, 1), (5, 17, 16), (33, 97, 128), (4, 33, 0)])
@pytest.mark.parametrize("given", ["middles", "stratified", "random"])
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_rules(level: str, name: str, given: str, shape: tuple[int, int, int], dtype: torch.dtype) -> None:
    num_rays, num_edges, n = shape
    edges, weights = case(num_rays, num_edges, dtype)
    noise = torch.rand(num_rays, n, generator=torch.Generator().manual_seed(3), dtype=dtype)
    u = {"middles": positions(edges, n), "stratified": (torch.arange(n) + noise) / max(n, 1), "random": noise}[given]
    u = u.to(dtype)
    expected = PUBLISHED[name](edges, weights, u)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    added = {"neus": 1e-5, "nerfstudio": 0.01, "unipad": 0.0}[name]
    for actual in (call(name, edges, weights, n, u), *([call(name, edges, weights, n)] if given == "middles" else [])):
        assert_samples(actual, expected, edges, weights + added, tolerance)
    # The same rounding as the published code takes nearly all the way: no sample of these moves at all.
    if given != "random":
        close = (call(name, edges, weights, n, u) - expected).abs() <= tolerance * edges.abs().max()
        assert close.double().mean() > 0.98 if n else True


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("shape", [(1, 2, 1), (3, 16, 17), (33, 97, 128), (4, 33, 0), (9, 1500, 3)])
def test_native_equals_reference(level: str, shape: tuple[int, int, int], name: str, dtype: torch.dtype) -> None:
    num_rays, num_edges, n = shape
    edges, weights = case(num_rays, num_edges, dtype)
    weights = weights + 0.02  # so that float32 resolves every section
    u = torch.rand(num_rays, n, generator=torch.Generator().manual_seed(3), dtype=dtype)
    for given in (u, u.sort(dim=1).values, None):
        actual = call(name, edges, weights, n, given)
        expected = reference.sample_pdf(
            edges.double(),
            weights.double(),
            n,
            None if given is None else given.double(),
            **RULES[name],
        )
        assert actual.dtype == dtype
        assert_close(actual.double(), expected, PLACE[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 33, 128])
def test_exact_agrees_with_resample_rays(backend: str, n: int, dtype: torch.dtype) -> None:
    edges, weights = case(20, 96, dtype)
    weights[3], weights[4, ::2] = 0, 0
    merged = torch.cat([edges, sample_pdf(edges, weights, n)], dim=1).sort(dim=1).values
    assert_close(resample_rays(edges, weights, n), merged, FORWARD[dtype])


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_hand_computed(backend: str) -> None:
    # Sections [0, 1], [1, 3], [3, 4] with probabilities 1/4, 1/2, 1/4: cdf 0, 0.25, 0.75, 1.
    edges = torch.tensor([[0.0, 1.0, 3.0, 4.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 2.0, 1.0]], dtype=torch.float64)
    assert sample_pdf(edges, weights, 4)[0].tolist() == [0.5, 1.5, 2.5, 3.5]
    assert torch.equal(
        sample_pdf(edges[..., None], torch.tensor([[1.0, 2.0, 1.0, 99.0]]).double(), 4)[0],
        sample_pdf(edges, weights, 4)[0],
    )
    u = torch.tensor([0.5, 0.0, 0.25, 0.875], dtype=torch.float64)  # in their own order
    assert sample_pdf(edges, weights, u=u)[0].tolist() == [2.0, 0.0, 1.0, 3.5]
    assert torch.equal(sample_pdf(edges, weights, u=u[None]), sample_pdf(edges, weights, 4, u))
    # With 1 added to each weight: 2, 3, 2 of 7; u = 1/2 is 1.5 of 3 sevenths into the middle section.
    padded = sample_pdf(edges, weights, u=u[:1], mode="nerfstudio", histogram_padding=1.0)
    assert padded.tolist() == [[pytest.approx(2.0)]]
    # The same in NeuS, where all sections are narrower than eps = 1 and so count as 1 wide.
    wide = sample_pdf(edges, weights, u=u[3:], mode="neus", eps=1.0)
    assert wide.tolist() == [[pytest.approx(3 + 0.875 - 5 / 7)]]


@pytest.mark.parametrize("weight", [0.0, 1e-12, 1e-7])
def test_useless_weights(backend: str, weight: float) -> None:
    """Three sections of lengths 1, 1, 8: exact samples are uniform in t if the sum is 0, by section otherwise; NeuS and
    nerfstudio make the sections equally likely."""
    edges = torch.tensor([[0.0, 1.0, 2.0, 10.0]], dtype=torch.float64)
    weights = torch.full((1, 3), weight, dtype=torch.float64)
    by_section = [0.5, 1.5, 6.0]
    exact = [10 / 6, 5.0, 50 / 6] if weight == 0 else by_section
    assert call("exact", edges, weights, 3)[0].tolist() == pytest.approx(exact)
    for name in PUBLISHED:
        assert call(name, edges, weights, 3)[0].tolist() == pytest.approx(by_section), name


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf"), 1e-45])
def test_exact_falls_back_to_uniform(backend: str, bad: float) -> None:
    edges, weights = torch.tensor([[2.0, 3.0, 10.0]]), torch.full((1, 2), bad)
    assert sample_pdf(edges, weights, 4)[0].tolist() == pytest.approx([3.0, 5.0, 7.0, 9.0])


def test_end_of_the_distribution(backend: str) -> None:
    """Ten weights of 0.1 sum to 0.99999994 or 1.0000001 in float32; the exact cdf ends at 1, and u = 1 lies before the
    empty sections at the end. The published codes put u = 1 at the last edge."""
    edges = torch.arange(13.0)[None]
    weights = torch.tensor([10 * [0.1] + 2 * [0.0]])
    u = torch.tensor([1 - 2**-24, 1.0])
    assert call("exact", edges, weights, u=u)[0].tolist() == pytest.approx([10.0, 10.0])
    assert (call("exact", edges, weights, u=u) <= 10).all()
    for name in ("nerfstudio", "neus"):
        assert call(name, edges, weights, u=u)[0, 1] == 12


def test_flat_bins(backend: str) -> None:
    """A section of probability 2e-6 holds u = 0.5. Exact: half way along. NeuS and UniPAD: such a section is 1 wide in
    the cdf, so that its samples are at its start; nerfstudio with its padding is half way again."""
    edges = torch.tensor([[0.0, 1.0, 2.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 2e-6, 1.0]], dtype=torch.float64)
    u = torch.tensor([0.5], dtype=torch.float64)
    assert call("exact", edges, weights, u=u).item() == pytest.approx(1.5)
    assert call("unipad", edges, weights, u=u).item() == pytest.approx(1.0, abs=2e-6)
    assert sample_pdf(edges, weights, u=u, mode="neus", eps=1e-5).item() == pytest.approx(1.0, abs=1e-5)
    assert call("nerfstudio", edges, weights, u=u).item() == pytest.approx(1.5)


@pytest.mark.parametrize("name", RULES)
def test_duplicate_edges(backend: str, name: str) -> None:
    edges = torch.tensor([[1.0, 1.0, 2.0, 2.0], [3.0, 3.0, 3.0, 3.0]])
    samples = call(name, edges, torch.ones(2, 3), 5)
    assert samples.isfinite().all() and (samples.diff(dim=1) >= 0).all()
    assert (samples[1] == 3).all() and (samples[0] >= 1).all() and (samples[0] <= 2).all()


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("which", ["edges", "weights", "u"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), -2.0])
def test_bad_values_stay_in_their_ray(backend: str, which: str, name: str, bad: float) -> None:
    edges, weights = case(4, 24, torch.float32)
    u = torch.rand(4, 9, generator=torch.Generator().manual_seed(0))
    clean = call(name, edges, weights, u=u)
    {"edges": edges, "weights": weights, "u": u}[which][1, 5] = bad
    samples = call(name, edges, weights, u=u)
    assert torch.equal(samples[[0, 2, 3]], clean[[0, 2, 3]])
    if which == "u":
        others = torch.arange(9) != 5
        assert torch.equal(samples[1, others], clean[1, others])
    if name in PUBLISHED:  # to the letter
        expected = PUBLISHED[name](edges, weights, u)
        assert torch.equal(samples.isnan(), expected.isnan())
        if which != "weights":
            finite = expected.isfinite()
            assert_close(samples[finite], expected[finite], FORWARD[torch.float32])


@pytest.mark.parametrize("name", RULES)
def test_resample_rays_is_samples_and_sort(level: str, name: str) -> None:
    for dtype in (torch.float32, torch.float64):
        edges, weights = case(37, 40, dtype)
        u = torch.rand(37, 30, generator=torch.Generator().manual_seed(1), dtype=dtype)
        edges[3] = edges[3].flip(0)
        edges[4, 7] = torch.nan
        for given in (None, u, u.sort(dim=1).values):
            merged = torch.cat([edges, call(name, edges, weights, 30, given)], dim=1).sort(dim=1, stable=True).values
            actual = resample_rays(edges, weights, 30, given, **RULES[name])
            if name in PUBLISHED:
                assert torch.equal(actual[actual.isfinite()], merged[merged.isfinite()])
            assert_close(actual, merged, FORWARD[dtype])


def test_published_resampling(backend: str) -> None:
    """NeuS: sample_pdf, then cat and sort."""
    z, weights = case(20, 65)
    expected = torch.cat([z, neus(z, weights, positions(z, 16))], dim=1).sort(dim=1).values
    assert_close(resample_rays(z, weights, 16, mode="neus"), expected, FORWARD[torch.float64])


# --- as an op --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_half_precision_is_widened(backend: str, half: torch.dtype) -> None:
    edges, weights = (tensor.to(half) for tensor in case())
    u = torch.rand(9, generator=torch.Generator().manual_seed(0)).to(half)
    samples = sample_pdf(edges, weights, u=u)
    assert samples.dtype == torch.float32
    assert torch.equal(samples, sample_pdf(edges.float(), weights.float(), u=u.float()))
    assert torch.equal(resample_rays(edges, weights, 4), resample_rays(edges.float(), weights.float(), 4))


def test_layouts_agree(backend: str) -> None:
    edges, weights = case(5, 24)
    expected = sample_pdf(edges, weights, 7)
    assert torch.equal(sample_pdf(edges.T.contiguous().T, weights.T.contiguous().T, 7), expected)
    assert torch.equal(sample_pdf(edges[..., None], weights[..., None], 7), expected)
    assert torch.equal(sample_pdf(edges, torch.nn.functional.pad(weights, (0, 1), value=9.0), 7), expected)


def test_errors(backend: str) -> None:
    edges, weights = case()
    with pytest.raises(ValueError, match=r"sample_pdf: weights must have shape \[6, 24\] or \[6, 23\], got \[6, 21\]"):
        sample_pdf(edges, weights[:, 2:], 4)
    with pytest.raises(ValueError, match="sample_pdf: edges must have at least 2 samples per ray, got 1"):
        sample_pdf(edges[:, :1], weights[:, :1], 4)
    with pytest.raises(ValueError, match="sample_pdf: num_samples must be at least 0, got -1"):
        sample_pdf(edges, weights, -1)
    with pytest.raises(ValueError, match="sample_pdf: num_samples must be given where u is not, got None"):
        sample_pdf(edges, weights)
    with pytest.raises(ValueError, match="sample_pdf: mode must be one of exact, neus, nerfstudio, got 'unipad'"):
        sample_pdf(edges, weights, 4, mode="unipad")
    with pytest.raises(ValueError, match="sample_pdf: eps must be finite and not negative, got -1"):
        sample_pdf(edges, weights, 4, mode="neus", eps=-1.0)
    with pytest.raises(TypeError, match="sample_pdf: weights must have the dtype of edges"):
        sample_pdf(edges, weights.float(), 4)
    with pytest.raises(TypeError, match="sample_pdf: edges must be float32 or float64, got int64"):
        sample_pdf(edges.long(), weights, 4)
    with pytest.raises(ValueError, match=r"sample_pdf: u must have shape \[6, 4\] or \[4\], got \[3\]"):
        sample_pdf(edges, weights, 4, torch.zeros(3, dtype=edges.dtype))
    with pytest.raises(ValueError, match=r"sample_pdf: u must have shape \[6, 3\] or \[3\], got \[5, 3\]"):
        sample_pdf(edges, weights, u=torch.zeros(5, 3, dtype=edges.dtype))
    with pytest.raises(ValueError, match="resample_rays: mode must be one of exact, neus, nerfstudio, got 'x'"):
        resample_rays(edges, weights, 4, mode="x")
