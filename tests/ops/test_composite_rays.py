# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from pred.ops import Composite, composite_rays, reference
from tests.conftest import require_value_checks
from tests.ops.two_samples import TWO_SAMPLES, sigmoid
from tests.tolerances import FORWARD, GRADIENT, assert_close, of_rounded_distances

OUTPUTS = ("weights", "depth", "opacity", "values")
INPUTS = ("sdf", "inv_s", "t", "values")


def case(
    num_rays: int = 5, samples: int = 33, channels: int = 4, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rays through soft and sharp surfaces, some of which they leave again."""
    generator = torch.Generator().manual_seed(1000 * num_rays + 10 * samples + channels)
    t = (torch.rand(num_rays, samples, generator=generator, dtype=torch.float64).cumsum(dim=1) + 1).to(dtype)
    wiggle = torch.randn(num_rays, samples, generator=generator, dtype=torch.float64)
    surface = torch.linspace(2, 12, num_rays, dtype=torch.float64)[:, None]
    sdf = (surface - t.double() * 0.8 + 0.4 * wiggle).to(dtype)
    values = torch.randn(num_rays, samples, channels, generator=generator, dtype=torch.float64).to(dtype)
    return sdf, torch.tensor(2.7, dtype=dtype), t, values


def results(
    function: Any, inputs: tuple[Tensor, ...], outputs: tuple[str, ...] = OUTPUTS, **options: Any
) -> dict[str, Tensor]:
    """Outputs, and derivatives of a sum of the named outputs with fixed random cotangents."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    out = function(*leaves, **options)
    found = {name: getattr(out, name) for name in OUTPUTS}
    generator = torch.Generator().manual_seed(7)
    total = leaves[0].new_zeros(())
    for name in outputs:
        cotangent = torch.randn(found[name].shape, generator=generator, dtype=torch.float64)
        total = total + (found[name] * cotangent.to(found[name].dtype)).sum()
    grads = torch.autograd.grad(total, leaves, allow_unused=True)
    zero = {f"grad_{name}": torch.zeros_like(leaf) for name, leaf in zip(INPUTS, leaves, strict=True)}
    found |= {key: value if grad is None else grad for (key, value), grad in zip(zero.items(), grads, strict=True)}
    return {name: value.detach() for name, value in found.items()}


def depth(out: Composite) -> Tensor:
    assert out.depth is not None
    return out.depth


def test_hand_computed(backend: str) -> None:
    # s = 1: Phi = 0.7310586, 0.5, 0.2689414. Weights telescope: w_0 = w_1 = 0.2310586 / 0.7310586, and 1 / e is left.
    sdf = torch.tensor([[1.0, 0.0, -1.0]], dtype=torch.float64, requires_grad=True)
    t = torch.tensor([[2.0, 4.0, 8.0]], dtype=torch.float64, requires_grad=True)
    values = torch.eye(3, dtype=torch.float64)[None]
    w, rest = 0.23105857863 / 0.73105857863, math.exp(-1)
    out = composite_rays(sdf, 1.0, t, values)
    assert out.weights[0].tolist() == pytest.approx([w, w, 0.0], abs=1e-10)
    assert out.opacity.item() == pytest.approx(1 - rest)
    assert depth(out).item() == pytest.approx(6 * w)
    assert out.values is not None and out.values[0].tolist() == pytest.approx([w, w, 0.0], abs=1e-10)
    # opacity = 1 - Phi(d_2) / Phi(d_0), whose derivatives are those of Phi.
    grads = torch.autograd.grad(out.opacity, sdf)[0][0].tolist()
    assert grads == pytest.approx([0.26894142 * 0.19661193 / 0.53444665, 0.0, -0.19661193 / 0.73105858], abs=1e-7)
    (grad_t,) = torch.autograd.grad(depth(composite_rays(sdf, 1.0, t)), t)
    assert grad_t[0].tolist() == pytest.approx([w, w, 0.0], abs=1e-10)
    # The middles of the sections are 3 and 6.
    assert depth(composite_rays(sdf, 1.0, t, depth_at="mid")).item() == pytest.approx(9 * w)
    assert depth(composite_rays(sdf, 1.0, t, normalize_depth=True)).item() == pytest.approx(3.0)
    opaque = composite_rays(sdf, 1.0, t, values, last="opaque")
    assert opaque.weights[0].tolist() == pytest.approx([w, w, rest])
    assert opaque.opacity.item() == pytest.approx(1.0)
    assert depth(opaque).item() == pytest.approx(6 * w + 8 * rest)
    assert depth(composite_rays(sdf, 1.0, t, depth_at="mid", last="opaque")).item() == pytest.approx(9 * w + 8 * rest)


def test_opaque_sample_has_the_right_gradient(backend: str) -> None:
    """alpha = 1 exactly in the middle of a ray: a division by 1 - alpha would be wrong or NaN there.

    With the section between samples 1 and 2 opaque, values behind it do not count, and d C / d alpha_0 = c_0 - c_1.
    """
    sdf = torch.tensor([[0.5, 0.2, -50.0, -51.0]], dtype=torch.float64, requires_grad=True)
    t = torch.tensor([[1.0, 2.0, 3.0, 4.0]], dtype=torch.float64)
    values = torch.tensor([[[1.0], [2.0], [3.0], [4.0]]], dtype=torch.float64)
    out = composite_rays(sdf, 20.0, t, values)
    alpha_0 = 1 - (1 + math.exp(-10)) / (1 + math.exp(-4))
    assert out.weights[0].tolist() == pytest.approx([alpha_0, 1 - alpha_0, 0.0, 0.0], abs=1e-12)
    assert out.values is not None
    (grad,) = torch.autograd.grad(out.values.sum(), sdf)
    # C = 2 - alpha_0; alpha_0 = 1 - Phi(d_1) / Phi(d_0) with Phi' = 20 Phi (1 - Phi).
    ratio, rest_0, rest_1 = 1 - alpha_0, 1 - 1 / (1 + math.exp(-10)), 1 - 1 / (1 + math.exp(-4))
    assert grad[0].tolist() == pytest.approx([-20 * ratio * rest_0, 20 * ratio * rest_1, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sharp", [500.0, -500.0])
def test_sharp_surfaces_stay_finite(backend: str, sharp: float, dtype: torch.dtype) -> None:
    """s d = +-500, rising, falling, crossing: finite values and gradients, those of the definition."""
    rows = [[1.0, 0.5, 0.2, 0.1], [-1.0, -0.5, 0.5, 1.0], [1.0, -1.0, 1.0, -1.0], [-0.2, -0.5, -0.7, -1.0]]
    sdf = torch.tensor(rows, dtype=dtype) * (1 if sharp > 0 else -1)
    inputs = (sdf, torch.tensor(abs(sharp), dtype=dtype), torch.arange(1.0, 5.0, dtype=dtype).expand(4, -1))
    found = results(composite_rays, (*inputs, torch.ones(4, 4, 2, dtype=dtype)))
    assert all(value.isfinite().all() for value in found.values())
    assert (found["weights"] >= 0).all() and (found["opacity"] <= 1 + 1e-6).all()
    # A rising ray meets nothing, the others the section that crosses, or the first one inside.
    sections = [None, None, 0, 0] if sharp > 0 else [None, 1, 1, None]
    for weights, section in zip(found["weights"], sections, strict=True):
        expected = torch.zeros(4, dtype=dtype)
        if section is not None:
            expected[section] = 1.0
        assert (weights - expected).abs().max() <= 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", TWO_SAMPLES)
def test_two_samples(backend: str, name: str, dtype: torch.dtype) -> None:
    """Where the quotient of sigmoids is 0 / 0 or cancels, and where NeuS's epsilons make alpha 1 or 1e-5."""
    before, after, inv_s, opacity, grad_before, grad_after = TWO_SAMPLES[name]
    sdf = torch.tensor([[before, after]], dtype=dtype, requires_grad=True)
    out = composite_rays(sdf, inv_s, torch.tensor([[3.0, 5.0]], dtype=dtype))
    rel = of_rounded_distances(before, after, inv_s, dtype)
    assert out.opacity.item() == pytest.approx(opacity, rel=rel, abs=1e-12)
    assert depth(out).item() == pytest.approx(3 * opacity, rel=rel, abs=1e-12)
    (grad,) = torch.autograd.grad(out.opacity.sum(), sdf)
    assert grad[0].tolist() == pytest.approx([grad_before, grad_after], rel=rel, abs=1e-12)


def test_last_sample(backend: str) -> None:
    """It has no successor: weight 0, and what is left stays left; or opaque, and takes it all."""
    sdf, t = torch.logit(torch.tensor([[0.8, 0.4]])), torch.tensor([[10.0, 20.0]])  # alpha_0 = 1 - 0.4 / 0.8
    out, opaque = composite_rays(sdf, 1.0, t), composite_rays(sdf, 1.0, t, last="opaque")
    assert out.weights[0].tolist() == pytest.approx([0.5, 0.0])
    assert opaque.weights[0].tolist() == pytest.approx([0.5, 0.5])
    assert depth(opaque).item() == pytest.approx(15.0) and opaque.opacity.item() == pytest.approx(1.0)
    one = composite_rays(sdf[:, :1], 1.0, t[:, :1])
    assert one.weights.tolist() == [[0.0]] and depth(one).item() == 0
    assert depth(composite_rays(sdf[:, :1], 1.0, t[:, :1], last="opaque")).item() == 10


def test_partly_transparent_ray(backend: str) -> None:
    """Half of the light is left: the depth is half way to 0, or divided by the opacity; other rays play no part."""
    sdf = torch.logit(torch.tensor([[0.8, 0.4], [0.4, 0.8]]))
    t = torch.tensor([[10.0, 20.0], [1.0, 90.0]])
    assert depth(composite_rays(sdf, 1.0, t)).tolist() == pytest.approx([5.0, 0.0])
    assert depth(composite_rays(sdf, 1.0, t, normalize_depth=True)).tolist() == pytest.approx([10.0, 0.0])


def test_duplicate_ranges(backend: str) -> None:
    """Samples in one place have one distance: the section between them is empty, the others are as without it."""
    sdf = torch.tensor([[1.0, 0.0, 0.0, -1.0]], requires_grad=True)
    out = composite_rays(sdf, 1.0, torch.tensor([[2.0, 4.0, 4.0, 8.0]]))
    w = 0.23105857863 / 0.73105857863
    assert out.weights[0].tolist() == pytest.approx([w, 0.0, w, 0.0])
    assert depth(out).item() == pytest.approx(6 * w)
    (grad,) = torch.autograd.grad(depth(out).sum(), sdf)
    assert grad.isfinite().all()


def test_infinite_distances(backend: str) -> None:
    """inf in front and -inf behind are no surface and a certain one; two of a kind are NaN, in their ray alone."""
    inf = torch.inf
    sdf = torch.tensor([[inf, 0.0, -inf, -inf], [inf, inf, 0.0, -1.0], [1.0, 0.0, -1.0, -1.0]])
    out = composite_rays(sdf, 1.0, torch.tensor([[1.0, 2.0, 4.0, 8.0]]).expand(3, -1))
    assert out.weights[0, :2].tolist() == pytest.approx([0.5, 0.5])
    assert out.opacity[1].isnan()
    w = 0.23105857863 / 0.73105857863
    assert depth(out)[2].item() == pytest.approx(3 * w)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_huge_sharpness(backend: str, dtype: torch.dtype) -> None:
    """s = 1e6: a step at the crossing, whose derivative is 0 in floating point."""
    sdf = torch.tensor([[2.0, 1.0, -1.0, -2.0]], dtype=dtype, requires_grad=True)
    out = composite_rays(sdf, 1e6, torch.tensor([[1.0, 2.0, 4.0, 8.0]], dtype=dtype))
    assert out.weights.tolist() == [[0.0, 1.0, 0.0, 0.0]] and depth(out).item() == 2.0
    (grad,) = torch.autograd.grad(depth(out).sum(), sdf)
    assert not grad.any()


def test_free_space_is_empty(backend: str) -> None:
    """223 samples of s d >> 1 add up to nothing: no phantom opacity that fogs the depth behind it."""
    sdf = torch.linspace(30, 2, 224)[None]
    out = composite_rays(sdf, 64.0, torch.linspace(1, 50, 224)[None])
    assert out.opacity.item() < 1e-30 and depth(out).item() < 1e-28


def test_transmittance_underflow(backend: str) -> None:
    """400 samples down to s d = -511: T_i = Phi_i / Phi_0 runs out of the range of any float; weights vanish, nothing
    becomes NaN, and they add up to 1.

    With w_i = (Phi_i - Phi_{i+1}) / Phi_0, Phi_0 = 1 / 2 and ranges in steps of h, depth = t_0 + 2 h sum_{i>0} Phi_i.
    """
    inv_s, step = 64.0, 49 / 399
    sdf = -torch.arange(400.0)[None] * 0.02
    sdf.requires_grad_()
    out = composite_rays(sdf, inv_s, torch.linspace(1, 50, 400)[None])
    phi = [sigmoid(max(-inv_s * 0.02 * i, -700)) for i in range(400)]
    expected = 1 + 2 * step * sum(phi[1:])
    assert out.weights[0, [0, 3, 20]].tolist() == pytest.approx(
        [2 * (phi[i] - phi[i + 1]) for i in (0, 3, 20)], rel=1e-5
    )
    assert out.weights[0, 350:].tolist() == [0.0] * 50
    assert out.opacity.item() == pytest.approx(1.0, abs=1e-6)
    assert depth(out).item() == pytest.approx(expected, rel=1e-6)
    (grad,) = torch.autograd.grad(depth(out).sum(), sdf)
    # d depth / d Phi_0 = (t_0 - depth) / Phi_0, d depth / d Phi_k = 2 h; dPhi / dd = s Phi (1 - Phi).
    slopes = [inv_s * (1 - expected) / 2, *(2 * step * inv_s * p * (1 - p) for p in phi[1:60])]
    # Distances rounded to float32 change the slopes by up to 64 * 1.2 * 6e-8, and ranges up to 8 their steps of 1/8 by
    # half as much. The reference also rounds optical depths of up to 75, which changes a transmittance by up to 4e-6,
    # and a slope is the difference of neighbouring ranges, up to 60 steps long, that are multiplied by such numbers.
    rel = 1e-5 if backend == "native" else 1e-4
    assert grad[0, :60].tolist() == pytest.approx(slopes, rel=rel, abs=1e-30)
    assert grad.isfinite().all() and not grad[0, 350:].any()


SHAPES = [(1, 1, 1), (2, 2, 3), (3, 15, 19), (3, 16, 1), (3, 17, 16), (5, 33, 17), (4, 224, 19), (2, 257, 32)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "options", [{}, {"depth_at": "mid", "last": "opaque", "normalize_depth": True}], ids=["default", "mid"]
)
def test_native_equals_reference(
    native: None, shape: tuple[int, int, int], dtype: torch.dtype, options: dict[str, Any]
) -> None:
    inputs = case(*shape, dtype=dtype)
    actual = results(composite_rays, inputs, **options)
    wide = tuple(tensor.double() for tensor in inputs)
    expected = results(reference.composite_rays, wide, **options)
    for name, value in actual.items():
        assert value.dtype == dtype
        tolerance = (GRADIENT if name.startswith("grad") else FORWARD)[dtype]
        assert_close(value.double(), expected[name], tolerance, name)


@pytest.mark.parametrize(
    "outputs", [("weights",), ("depth",), ("opacity",), ("values",), ("depth", "values")], ids="+".join
)
def test_each_output_has_its_gradient(native: None, outputs: tuple[str, ...]) -> None:
    inputs = case()
    actual = results(composite_rays, inputs, outputs)
    expected = results(reference.composite_rays, inputs, outputs)
    for name, value in actual.items():
        assert_close(value, expected[name], GRADIENT[torch.float64], name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 31, 40, 64, 65, 130])
def test_any_number_of_channels(level: str, channels: int, dtype: torch.dtype) -> None:
    """Channels go through vectors of every width, several at a time, with a remainder; also without any distance."""
    inputs = case(2, 83, channels, dtype)
    for options in ({}, {"detach_sdf": True}):
        actual = results(composite_rays, inputs, ("values",), **options)
        expected = results(
            reference.composite_rays, tuple(tensor.double() for tensor in inputs), ("values",), **options
        )
        for name, value in actual.items():
            tolerance = (GRADIENT if name.startswith("grad") else FORWARD)[dtype]
            assert_close(value.double(), expected[name], tolerance, name)


def test_large_gradient_equals_that_of_its_parts(native: None) -> None:
    """A gradient of 16 MiB and more is stored past the caches."""
    inputs = case(301, 225, 64, torch.float32)
    whole = results(composite_rays, inputs, ("values",))
    assert whole["grad_values"].nbytes > 16 << 20
    generator = torch.Generator().manual_seed(7)
    cotangent = torch.randn(301, 64, generator=generator, dtype=torch.float64).float()
    for rays in (slice(0, 150), slice(150, 301)):
        sdf, inv_s, t, values = inputs
        part = values[rays].clone().requires_grad_()
        out = composite_rays(sdf[rays], inv_s, t[rays], part)
        assert out.values is not None
        (grad,) = torch.autograd.grad((out.values * cotangent[rays]).sum(), part)
        assert torch.equal(grad, whole["grad_values"][rays])


@pytest.mark.parametrize("last", ["zero", "opaque"])
@pytest.mark.parametrize("depth_at", ["start", "mid"])
def test_gradcheck(backend: str, last: str, depth_at: str) -> None:
    inputs = tuple(tensor.requires_grad_() for tensor in case(2, 6, 2))
    assert torch.autograd.gradcheck(lambda *x: tuple(composite_rays(*x, last=last, depth_at=depth_at)), inputs)


def test_detached_distance(backend: str) -> None:
    sdf, inv_s, t, values = (tensor.requires_grad_() for tensor in case())
    out = composite_rays(sdf, inv_s, t, values, detach_sdf=True)
    assert out.values is not None
    total = out.values.sum() + depth(out).sum()
    grads = torch.autograd.grad(total, (sdf, inv_s, t, values), allow_unused=True)
    assert grads[0] is None and grads[1] is None
    assert grads[2] is not None and grads[3] is not None
    full = composite_rays(sdf, inv_s, t, values)
    assert full.values is not None
    expected = torch.autograd.grad(full.values.sum() + depth(full).sum(), (t, values))
    assert torch.equal(grads[2], expected[0]) and torch.equal(grads[3], expected[1])
    kept = composite_rays(sdf, inv_s, t, detach_sdf=True, detach_inv_s=False)
    of_sdf, of_inv_s = torch.autograd.grad(depth(kept).sum(), (sdf, inv_s), allow_unused=True)
    assert of_sdf is None and of_inv_s is not None and of_inv_s != 0


@pytest.mark.parametrize("num_rays", [0, 3])
def test_opcheck_without_some_gradients(native: None, num_rays: int) -> None:
    sdf, inv_s, t, values = (tensor.float() for tensor in case(num_rays, 9, 3))
    weights, _, _, _, remaining = torch.ops.pred.composite_rays(sdf, inv_s, t, values, None, False, False)
    backward, saved = torch.ops.pred.composite_rays_backward.default, (None, weights, remaining)
    of_depth = (None, torch.randn(num_rays), None, None, sdf, inv_s, t, None)
    torch.library.opcheck(backward, (*of_depth, *saved, True, True, True, False, True, False))
    of_values = (None, None, None, torch.randn(num_rays, 3), sdf, inv_s, t, values)
    torch.library.opcheck(backward, (*of_values, *saved, False, False, False, False, False, True))


@pytest.mark.parametrize("which", ["sdf", "t", "values"])
def test_nan_stays_in_its_ray(backend: str, which: str) -> None:
    inputs = case(4, 40, 3, torch.float32)
    clean = results(composite_rays, inputs)
    dirty = tuple(tensor.clone() for tensor in inputs)
    dirty[INPUTS.index(which)][1, 11] = torch.nan
    found = results(composite_rays, dirty)
    others = [0, 2, 3]
    for name, value in found.items():
        if name != "grad_inv_s":  # shared by all rays
            assert torch.equal(value[others], clean[name][others]), name
    assert any(value[1].isnan().any() for name, value in found.items() if name != "grad_inv_s")


@pytest.mark.parametrize("samples", [16, 21])
@pytest.mark.parametrize("output", OUTPUTS)
def test_nan_gradient_stays_in_its_ray(backend: str, output: str, samples: int) -> None:
    sdf, inv_s, t, values = case(4, samples, 3, torch.float32)
    leaves = [tensor.clone().requires_grad_() for tensor in (sdf, t, values)]
    out = composite_rays(leaves[0], inv_s, leaves[1], leaves[2])
    cotangents = {name: torch.ones_like(getattr(out, name)) for name in OUTPUTS}
    clean = torch.autograd.grad([getattr(out, name) for name in OUTPUTS], leaves, list(cotangents.values()), True)
    cotangents[output][1] = torch.nan
    found = torch.autograd.grad([getattr(out, name) for name in OUTPUTS], leaves, list(cotangents.values()))
    for name, actual, expected in zip(("sdf", "t", "values"), found, clean, strict=True):
        assert torch.equal(actual[[0, 2, 3]], expected[[0, 2, 3]]), name


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0)])
@pytest.mark.parametrize("channels", [0, 2])
def test_empty(backend: str, shape: tuple[int, int], channels: int) -> None:
    inputs = (torch.randn(shape), torch.tensor(2.7), torch.randn(shape), torch.randn(*shape, channels))
    found = results(composite_rays, inputs)
    for name, tensor in zip(INPUTS, inputs, strict=True):
        assert found[f"grad_{name}"].shape == tensor.shape and not found[f"grad_{name}"].any()
    assert found["depth"].shape == (shape[0],) and found["values"].shape == (shape[0], channels)
    assert not found["depth"].any() and not found["opacity"].any() and not found["values"].any()


@pytest.mark.parametrize("wrong", [-1.0, torch.inf, torch.nan])
def test_sharpness_is_checked(backend: str, wrong: float) -> None:
    require_value_checks(backend)
    sdf, _, t, values = case()
    with pytest.raises(ValueError, match="composite_rays: inv_s must be finite and not negative, got -?(1|inf|nan)"):
        composite_rays(sdf, torch.tensor(wrong, dtype=torch.float64), t, values)


def test_layouts_agree(backend: str) -> None:
    sdf, inv_s, t, values = case()
    expected = composite_rays(sdf, inv_s, t, values)
    strided = values.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    for out in (
        composite_rays(sdf[..., None], inv_s.reshape(1), t[..., None], values),
        composite_rays(sdf.T.contiguous().T, 2.7, t, strided),
    ):
        for actual, wanted in zip(out, expected, strict=True):
            assert actual is not None and wanted is not None
            assert_close(actual, wanted, 1e-15)


def test_errors(backend: str) -> None:
    sdf, inv_s, t, values = case()
    with pytest.raises(ValueError, match=r"composite_rays: t must have shape \[5, 33\] .*got \[5, 32\]"):
        composite_rays(sdf, inv_s, t[:, 1:])
    with pytest.raises(ValueError, match=r"composite_rays: values must have shape \[5, 33, C\], got \[4, 33, 4\]"):
        composite_rays(sdf, inv_s, t, values[1:])
    with pytest.raises(TypeError, match="composite_rays: t must have the dtype of sdf"):
        composite_rays(sdf, inv_s, t.float())
    with pytest.raises(ValueError, match="composite_rays: depth_at must be one of start, mid"):
        composite_rays(sdf, inv_s, t, depth_at="end")
    with pytest.raises(ValueError, match=r"composite_rays: inv_s must have one element, got shape \[2\]"):
        composite_rays(sdf, torch.ones(2, dtype=torch.float64), t)
    with pytest.raises(ValueError, match="composite_rays: inv_s must be finite and not negative"):
        composite_rays(sdf, -1.0, t)
