# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pred.ops import reference, resample_rays
from tests.tolerances import FORWARD, PLACE, assert_close


def case(num_rays: int = 6, samples: int = 24, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Rays with most of their weight in a few sections."""
    generator = torch.Generator().manual_seed(100 * num_rays + samples)
    t = 1 + torch.rand(num_rays, samples, generator=generator, dtype=torch.float64).cumsum(dim=1)
    weights = torch.rand(num_rays, samples, generator=generator, dtype=torch.float64) ** 6
    return t.to(dtype), weights.to(dtype)


def test_hand_computed(backend: str) -> None:
    # Sections [0, 1], [1, 3], [3, 4] with probabilities 1/4, 1/2, 1/4; cdf 0, 0.25, 0.75, 1; the last
    # weight is ignored.
    t = torch.tensor([[0.0, 1.0, 3.0, 4.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 2.0, 1.0, 99.0]], dtype=torch.float64)
    # u = 1/8, 3/8, 5/8, 7/8: middle of the first, a quarter and three quarters of the second, middle of the last.
    out = resample_rays(t, weights, 4)
    assert out[0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.5, 3.0, 3.5, 4.0]
    assert torch.equal(resample_rays(t, weights[:, :3], 4), out)
    u = torch.tensor([0.0, 0.25, 0.5], dtype=torch.float64)
    assert resample_rays(t, weights, 3, u)[0].tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 3.0, 4.0]
    assert torch.equal(resample_rays(t, weights, 3, u[None]), resample_rays(t, weights, 3, u))


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf"), 1e-45])
def test_useless_weights_are_uniform(backend: str, bad: float) -> None:
    t = torch.tensor([[2.0, 3.0, 10.0]])
    weights = torch.full((1, 2), bad)
    out = resample_rays(t, weights, 4)  # (k + 1/2) / 4 of the way from 2 to 10
    assert out[0].tolist() == pytest.approx([2.0, 3.0, 3.0, 5.0, 7.0, 9.0, 10.0])


def test_empty_sections_hold_no_sample(backend: str) -> None:
    # cdf 0, 0, 1/2, 1/2, 1: u = 0 starts the second section, u = 1/2 the last, and nothing lies in the others.
    t = torch.tensor([[0.0, 1.0, 2.0, 5.0, 6.0]])
    weights = torch.tensor([[0.0, 3.0, 0.0, 3.0]])
    u = torch.tensor([0.0, 0.25, 0.5, 0.75])
    assert resample_rays(t, weights, 4, u)[0].tolist() == [0.0, 1.0, 1.0, 1.5, 2.0, 5.0, 5.0, 5.5, 6.0]
    assert resample_rays(t, weights, 1)[0].tolist() == [0.0, 1.0, 2.0, 5.0, 5.0, 6.0]  # u = 1/2


def test_negative_weights_count_as_zero(backend: str) -> None:
    t = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
    out = resample_rays(t, torch.tensor([[-5.0, 1.0, 0.0]]), 2)
    assert out[0].tolist() == pytest.approx([0.0, 1.0, 1.25, 1.75, 2.0, 3.0])


def test_all_weight_in_the_last_section(backend: str) -> None:
    """The cdf ends at 1 exactly, so that u just below 1 stays on the ray."""
    t = torch.linspace(1, 5, 9)[None]
    weights = torch.zeros(1, 8)
    weights[0, -1] = 0.3
    u = torch.tensor([0.0, 0.5, 1 - 2**-24])
    out = resample_rays(t, weights, 3, u)
    assert out.max() <= 5 and (out[0, 8:] >= 4.5).all()


def test_duplicate_and_degenerate_positions(backend: str) -> None:
    t = torch.tensor([[1.0, 1.0, 2.0, 2.0], [3.0, 3.0, 3.0, 3.0]])
    out = resample_rays(t, torch.ones(2, 4), 5)
    assert out.isfinite().all() and (out.diff(dim=1) >= 0).all()
    assert (out[1] == 3).all() and out[0].min() == 1 and out[0].max() == 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "shape", [(1, 2, 1), (3, 15, 16), (3, 16, 17), (5, 17, 15), (7, 96, 128), (4, 33, 0), (64, 48, 7)]
)
@pytest.mark.parametrize("given", [False, True])
def test_native_equals_reference(native: None, shape: tuple[int, int, int], dtype: torch.dtype, given: bool) -> None:
    num_rays, samples, new = shape
    t, weights = case(num_rays, samples, dtype)
    u = torch.rand(num_rays, new, generator=torch.Generator().manual_seed(3), dtype=dtype).sort(dim=1).values
    actual = resample_rays(t, weights, new, u if given else None)
    expected = reference.resample_rays(t.double(), weights.double(), new, u.double() if given else None)
    assert actual.shape == (num_rays, samples + new) and actual.dtype == dtype
    # Where the cdf is flat, a rounding of u or cdf moves a sample along the section: as far as 1e-7 / weight.
    assert_close(actual.double(), expected, 1e-5 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", ["midpoints", "shifted", "stratified", "random", "clustered", "same"])
@pytest.mark.parametrize("shape", [(33, 96, 128), (9, 17, 200), (9, 130, 3), (5, 2, 40)])
def test_levels_agree(level: str, shape: tuple[int, int, int], spread: str, dtype: torch.dtype) -> None:
    """Every way in which u can lie, against the definition: the samples' places in the distribution are u."""
    num_rays, samples, new = shape
    t, weights = case(num_rays, samples)
    weights = weights + 0.02  # so that float32 resolves every section
    generator = torch.Generator().manual_seed(5)
    noise = torch.rand(num_rays, new, generator=generator, dtype=torch.float64)
    u = {
        "midpoints": (torch.arange(new) + 0.5).expand(num_rays, -1) / new,
        "shifted": (torch.arange(new) + noise[:, :1]) / new,
        "stratified": (torch.arange(new) + noise) / new,
        "random": noise.sort(dim=1).values,
        "clustered": noise.sort(dim=1).values ** 8,
        "same": noise[:, :1].expand(-1, new),
    }[spread].double()
    actual = resample_rays(t.to(dtype), weights.to(dtype), new, u.to(dtype))
    expected = reference.resample_rays(t, weights, new, u)
    assert (actual.diff(dim=1) >= 0).all()
    assert_close(actual.double(), expected, PLACE[dtype])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_old_sample_is_lost(level: str, dtype: torch.dtype) -> None:
    """Sums of weights like 0.3 and 0.6 may fall by a rounding where sections are empty."""
    generator = torch.Generator().manual_seed(11)
    weights = torch.randint(0, 7, (4000, 21), generator=generator).to(dtype) / 10
    weights = torch.where(torch.rand(weights.shape, generator=generator) < 0.5, 0, weights)
    weights[0] = torch.tensor([0.3, 0.4, 0.6, 0.0, 0.1] + 16 * [0.0])
    t = torch.arange(22, dtype=dtype).expand(4000, -1)
    noise = torch.rand(1, 1, generator=generator, dtype=dtype)
    for u in (None, (torch.arange(33) + noise) / 33, torch.rand(4000, 33, generator=generator, dtype=dtype)):
        u = None if u is None else u.expand(4000, -1).sort(dim=1).values
        merged = resample_rays(t, weights, 33, u)
        found = torch.searchsorted(merged, t.contiguous()).clamp(max=merged.shape[1] - 1)
        assert torch.equal(merged.gather(1, found), t)
        assert (merged.diff(dim=1) >= 0).all()


def test_last_position_belongs_to_the_last_weight(level: str) -> None:
    """u = 1 is clipped below 1, and so lies before the empty sections at the end."""
    t = torch.arange(5.0)[None]
    out = resample_rays(t, torch.tensor([[1.0, 1.0, 0.0, 0.0]]), 4, (torch.arange(4.0) + 1) / 4)[0]
    assert out.tolist() == pytest.approx([0.0, 0.5, 1.0, 1.0, 1.5, 2.0, 2.0, 3.0, 4.0])


def test_result_is_sorted_and_keeps_the_old_samples(backend: str) -> None:
    t, weights = case(20, 96, torch.float32)
    out = resample_rays(t, weights, 128)
    assert (out.diff(dim=1) >= 0).all()
    for ray in range(20):
        assert torch.isin(t[ray], out[ray]).all()


@pytest.mark.parametrize("which", ["t", "weights", "u"])
def test_nan_stays_in_its_ray(backend: str, which: str) -> None:
    t, weights = case(4, 24, torch.float32)
    u = torch.rand(4, 9, generator=torch.Generator().manual_seed(0)).sort(dim=1).values
    clean = resample_rays(t, weights, 9, u)
    {"t": t, "weights": weights, "u": u}[which][1, 5] = torch.nan
    out = resample_rays(t, weights, 9, u)
    assert torch.equal(out[[0, 2, 3]], clean[[0, 2, 3]])
    assert out.shape == clean.shape


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_order_of_u_does_not_matter(backend: str, dtype: torch.dtype) -> None:
    t, weights = case(5, 40, dtype)
    u = torch.rand(5, 30, generator=torch.Generator().manual_seed(1), dtype=dtype)
    assert_close(resample_rays(t, weights, 30, u), resample_rays(t, weights, 30, u.sort(dim=1).values), FORWARD[dtype])


@pytest.mark.parametrize("kind", ["t descends", "t is infinite", "t is NaN", "u is NaN", "all are NaN"])
def test_any_input_gives_a_sorted_row(backend: str, kind: str) -> None:
    t, weights = case(3, 24, torch.float32)
    u = torch.rand(3, 50, generator=torch.Generator().manual_seed(0)).sort(dim=1).values
    if kind == "t descends":
        t = t.flip(1)
    elif kind == "t is infinite":
        t[:, -1] = torch.inf
    if kind in ("t is NaN", "all are NaN"):
        t[:, 3] = torch.nan
    if kind in ("u is NaN", "all are NaN"):
        u[:, 7] = torch.nan
    if kind == "all are NaN":
        weights[:] = torch.nan
    out, expected = resample_rays(t, weights, 50, u), reference.resample_rays(t, weights, 50, u)
    assert torch.equal(out.isnan(), expected.isnan())
    assert (out.diff(dim=1) >= 0).logical_or(out[:, 1:].isnan()).logical_or(out[:, 1:] == torch.inf).all()
    finite = expected.isfinite()
    assert_close(out[finite], expected[finite], FORWARD[torch.float32])


def test_unsorted_and_outlying_u_touch_no_foreign_memory(backend: str) -> None:
    t, weights = case(3, 10, torch.float32)
    u = torch.tensor([0.9, 0.1, 5.0, -3.0, float("inf"), 0.5])
    out = resample_rays(t, weights, 6, u)
    assert (out.diff(dim=1) >= 0).all()
    assert (out >= t[:, :1]).all() and (out <= t[:, -1:]).all()


@pytest.mark.parametrize("unit, num_samples", [(0.53096, 13), (1 / 3, 46), (0.1, 24)])
def test_no_sample_is_lost_where_rounding_makes_the_distribution_fall(
    level: str, unit: float, num_samples: int
) -> None:
    # Sums of multiples of one number; a few of these rays fall by a rounding just where a u lies.
    num_rays, edges = 8000, 50 if unit != 0.1 else 24
    t = torch.arange(1, edges + 1, dtype=torch.float64).expand(num_rays, edges)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randint(0, 4, (num_rays, edges - 1), generator=generator).double() * unit
    merged = resample_rays(t, weights, num_samples)
    place = torch.searchsorted(merged, t.contiguous()).clamp_max(merged.shape[1] - 1)
    assert torch.equal(merged.gather(1, place), t)


def test_no_sample_is_lost_where_a_slope_overflows(level: str) -> None:
    t = torch.tensor([[0.0, 3e38, 3.1e38]])
    merged = resample_rays(t, torch.tensor([[3e-30, 1.0]]), 4)
    # All new samples lie in the second section; the old ones stand around them.
    assert merged[0, 0] == 0 and merged[0, 1] == t[0, 1] and merged[0, -1] == t[0, 2]
    assert merged.isfinite().all() and (merged.diff() >= 0).all()


def test_errors(backend: str) -> None:
    t, weights = case()
    with pytest.raises(
        ValueError, match=r"resample_rays: weights must have shape \[6, 24\] or \[6, 23\], got \[6, 22\]"
    ):
        resample_rays(t, weights[:, 2:], 4)
    with pytest.raises(ValueError, match="resample_rays: t must have at least 2 samples per ray, got 1"):
        resample_rays(t[:, :1], weights[:, :1], 4)
    with pytest.raises(ValueError, match="resample_rays: num_samples must be at least 0, got -1"):
        resample_rays(t, weights, -1)
    with pytest.raises(TypeError, match="resample_rays: weights must have the dtype of t"):
        resample_rays(t, weights.float(), 4)
    with pytest.raises(ValueError, match=r"resample_rays: u must have shape \[6, 4\] or \[4\], got \[3\]"):
        resample_rays(t, weights, 4, torch.zeros(3, dtype=t.dtype))
