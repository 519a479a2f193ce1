# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What is composite_alpha's own; what it shares with composite_rays is in test_composites.py."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pred.ops import composite_alpha, reference, sdf_to_alpha
from pred.ops.composite_rays import composite_rays
from tests.ops.published import published_weights
from tests.tolerances import FORWARD, GRADIENT, assert_close

OUTPUTS = ("weights", "depth", "opacity", "values")
INPUTS = ("alpha", "t", "values")


def case(
    num_rays: int = 5, samples: int = 33, channels: int = 4, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    """Opacities of all sizes, some of them exactly 0 or 1."""
    generator = torch.Generator().manual_seed(1000 * num_rays + 10 * samples + channels)
    alpha = torch.rand(num_rays, samples, generator=generator, dtype=torch.float64) ** 6
    kind = torch.rand(num_rays, samples, generator=generator)
    alpha = torch.where(kind < 0.1, 0.0, torch.where(kind > 0.98, 1.0, alpha)).to(dtype)
    t = (torch.rand(num_rays, samples, generator=generator, dtype=torch.float64).cumsum(dim=1) + 1).to(dtype)
    values = torch.randn(num_rays, samples, channels, generator=generator, dtype=torch.float64).to(dtype)
    return alpha, t, values


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
    for name, leaf, grad in zip(INPUTS, leaves, grads, strict=True):
        found[f"grad_{name}"] = torch.zeros_like(leaf) if grad is None else grad
    return {name: value.detach() for name, value in found.items()}


def test_hand_computed(backend: str) -> None:
    # T = 1, 0.5, 0.4; w = 0.5, 0.1, 0.1
    alpha = torch.tensor([[0.5, 0.2, 0.25]], dtype=torch.float64)
    t = torch.tensor([[2.0, 4.0, 8.0]], dtype=torch.float64)
    values = torch.tensor([[[1.0, 0.0], [2.0, 1.0], [4.0, 10.0]]], dtype=torch.float64)
    out = composite_alpha(alpha, t, values)
    assert out.weights[0].tolist() == pytest.approx([0.5, 0.1, 0.1])
    assert out.depth is not None and out.depth.item() == pytest.approx(2.2)
    assert out.opacity.item() == pytest.approx(0.7)
    assert out.values is not None and out.values[0].tolist() == pytest.approx([1.1, 1.1])
    middle = composite_alpha(alpha, t, depth_at="mid", normalize_depth=True)  # 3, 6 and, without an end, 8
    assert middle.values is None
    assert middle.depth is not None and middle.depth.item() == pytest.approx((1.5 + 0.6 + 0.8) / 0.7)


def test_without_ranges_there_is_no_depth(backend: str) -> None:
    alpha = torch.tensor([[0.5, 0.2]], requires_grad=True)
    out = composite_alpha(alpha, values=torch.tensor([[[1.0], [3.0]]]), depth_at="mid", normalize_depth=True)
    assert out.depth is None
    assert out.values is not None and out.values.item() == pytest.approx(0.8)
    (grad,) = torch.autograd.grad(out.values.sum() + out.opacity.sum(), alpha)
    # C + O = 2 a_0 + 4 (1 - a_0) a_1
    assert grad[0].tolist() == pytest.approx([2 - 0.8, 2.0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opaque_sample_has_the_right_gradient(backend: str, dtype: torch.dtype) -> None:
    """alpha = 1 in the middle of a ray, where forms that divide by 1 - alpha return 1.6 in place of -0.08.

    C = 1 a_0 + 2 (1 - a_0) a_1 + 3 (1 - a_0)(1 - a_1) a_2 + 4 (1 - a_0)(1 - a_1)(1 - a_2) a_3. What lies behind the
    opaque sample a_1 would be worth 3 * 0.5 + 4 * 0.5 * 0.3 = 2.1, if it let light pass:
    dC/da_0 = 1 - 2, dC/da_1 = 0.8 (2 - 2.1), and nothing arrives at a_2 and a_3.
    """
    alpha = torch.tensor([[0.2, 1.0, 0.5, 0.3]], dtype=dtype, requires_grad=True)
    values = torch.tensor([[[1.0], [2.0], [3.0], [4.0]]], dtype=dtype)
    out = composite_alpha(alpha, values=values)
    assert out.weights[0].tolist() == pytest.approx([0.2, 0.8, 0.0, 0.0])
    assert out.values is not None and out.values.item() == pytest.approx(1.8)
    (grad,) = torch.autograd.grad(out.values.sum(), alpha)
    assert grad[0].tolist() == pytest.approx([-1.0, -0.08, 0.0, 0.0], rel=1e-5, abs=1e-12)


def test_several_opaque_samples(backend: str) -> None:
    """d opacity / d alpha_i is what gets past all other samples: 0 with an opaque one among them."""
    alpha = torch.tensor([[1.0, 0.5, 1.0], [0.0, 1.0, 0.5], [0.0, 0.0, 0.0]], requires_grad=True)
    (grad,) = torch.autograd.grad(composite_alpha(alpha).opacity.sum(), alpha)
    assert grad.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [1.0, 1.0, 1.0]]


def test_opacity_gradient_behind_next_to_nothing(native: None) -> None:
    """d opacity / d alpha_i = prod_{j != i} (1 - alpha_j) to full relative accuracy, however small."""
    alpha = torch.full((1, 40), 0.5, requires_grad=True)
    (grad,) = torch.autograd.grad(composite_alpha(alpha).opacity.sum(), alpha)
    assert grad[0].tolist() == pytest.approx([0.5**39] * 40, rel=1e-6)


def test_transmittance_eps(backend: str) -> None:
    """NeuS and UniPAD: T = cumprod([1, 1 - alpha + eps]); here with an eps that shows."""
    alpha = torch.tensor([[0.5, 1.0, 0.5]], dtype=torch.float64, requires_grad=True)
    values = torch.tensor([[[1.0], [2.0], [3.0]]], dtype=torch.float64)
    out = composite_alpha(alpha, values=values, transmittance_eps=0.1)
    # T = 1, 0.6, 0.06; C = 0.5 + 2 * 0.6 + 3 * 0.03
    assert out.weights[0].tolist() == pytest.approx([0.5, 0.6, 0.03])
    assert out.values is not None and out.values.item() == pytest.approx(1.79)
    (grad,) = torch.autograd.grad(out.values.sum(), alpha)
    # Worth of what lies behind: 1.5 behind a_1, 2 + 0.1 * 1.5 behind a_0.
    assert grad[0].tolist() == pytest.approx([1 - 2.15, 0.6 * (2 - 1.5), 0.06 * 3])


def test_neus_in_its_own_words(backend: str) -> None:
    """weights = alpha * cumprod([1, 1 - alpha + 1e-7])[:-1], in float32 as there."""
    alpha, _, _ = case(7, 96, dtype=torch.float32)
    expected = published_weights(alpha)
    out = composite_alpha(alpha, transmittance_eps=1e-7)
    assert_close(out.weights, expected, FORWARD[torch.float32])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opacities_outside_of_the_unit_interval(backend: str, dtype: torch.dtype) -> None:
    """The plain formula: T = 1, -0.25, -0.375."""
    alpha = torch.tensor([[1.25, -0.5, 0.5]], dtype=dtype, requires_grad=True)
    out = composite_alpha(alpha)
    assert out.weights[0].tolist() == [1.25, 0.125, -0.1875]
    assert out.opacity.item() == 1.1875
    (grad,) = torch.autograd.grad(out.opacity.sum(), alpha)  # product of the others' 1 - alpha
    assert grad[0].tolist() == pytest.approx([0.75, -0.125, -0.375])


def test_infinite_opacity_stays_in_its_ray(backend: str) -> None:
    alpha, t, values = case(3, 20, dtype=torch.float32)
    clean = results(composite_alpha, (alpha, t, values))
    alpha[1, 5] = torch.inf
    found = results(composite_alpha, (alpha, t, values))
    for name, value in found.items():
        assert torch.equal(value[[0, 2]], clean[name][[0, 2]]), name


def test_transmittance_underflow(backend: str) -> None:
    """T = 10^-i runs out of the range of any float: weights 0.9 * 10^-i, then 0; no NaN; opacity 1."""
    alpha = torch.full((1, 400), 0.9, dtype=torch.float64).float().requires_grad_()
    out = composite_alpha(alpha, torch.arange(400.0)[None])
    assert out.weights[0, [0, 3, 20]].tolist() == pytest.approx([0.9, 9e-4, 9e-21], rel=1e-5)
    assert out.weights[0, 350:].tolist() == [0.0] * 50
    assert out.opacity.item() == pytest.approx(1.0)
    assert out.depth is not None and out.depth.item() == pytest.approx(1 / 9)  # sum of 0.9 i 10^-i
    (grad,) = torch.autograd.grad(out.depth.sum(), alpha)
    # T_i (t_i - mean range of what lies behind, i + 1 + 1 / 9)
    assert grad[0, :4].tolist() == pytest.approx([-10 / 9 * 10.0**-i for i in range(4)], rel=1e-5)
    assert grad.isfinite().all()


def test_partly_transparent_ray(backend: str) -> None:
    """Half of the light is left: the depth is half way to 0, or divided by the opacity; other rays play no part."""
    alpha, t = torch.tensor([[0.5, 0.0], [0.0, 0.0], [0.0, 1.0]]), torch.tensor([[10.0, 20.0]]).expand(3, -1)
    plain, normalized = composite_alpha(alpha, t), composite_alpha(alpha, t, normalize_depth=True)
    assert plain.depth is not None and plain.depth.tolist() == [5.0, 0.0, 20.0]
    assert normalized.depth is not None and normalized.depth.tolist() == pytest.approx([10.0, 0.0, 20.0])
    assert (1 - plain.opacity).tolist() == [0.5, 1.0, 0.0]  # what a background contributes


def test_duplicate_ranges(backend: str) -> None:
    """Two samples in one place are two samples; the middle of the section between them is that place."""
    alpha = torch.tensor([[0.5, 0.5, 0.5]])
    out = composite_alpha(alpha, torch.tensor([[4.0, 4.0, 8.0]]), depth_at="mid")
    assert out.depth is not None and out.depth.item() == 0.5 * 4 + 0.25 * 6 + 0.125 * 8


def test_tiny_opacities_count_in_full(backend: str) -> None:
    """A million sections of 1e-7 leave exp(-0.1), although 1 - 1e-7 is 1 - 1.19e-7 in float32."""
    alpha = torch.full((1, 1_000_000), 1e-7)
    assert composite_alpha(alpha).weights[0, -1].item() == pytest.approx(1e-7 * 0.9048374, rel=1e-5)


SHAPES = [(1, 1, 1), (2, 2, 3), (3, 15, 19), (3, 16, 1), (3, 17, 16), (5, 33, 17), (4, 224, 19), (2, 257, 32)]
OPTIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "mid": {"depth_at": "mid", "transmittance_eps": 1e-3},
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("options", OPTIONS)
def test_native_equals_reference(native: None, shape: tuple[int, int, int], dtype: torch.dtype, options: str) -> None:
    inputs = case(*shape, dtype=dtype)
    actual = results(composite_alpha, inputs, **OPTIONS[options])
    wide = tuple(tensor.double() for tensor in inputs)
    expected = results(reference.composite_alpha, wide, **OPTIONS[options])
    for name, value in actual.items():
        assert value.dtype == dtype
        tolerance = (GRADIENT if name.startswith("grad") else FORWARD)[dtype]
        assert_close(value.double(), expected[name], tolerance, name)


@pytest.mark.parametrize(
    "outputs", [("weights",), ("depth",), ("opacity",), ("values",), ("depth", "values")], ids="+".join
)
def test_each_output_has_its_gradient(native: None, outputs: tuple[str, ...]) -> None:
    inputs = case()
    actual = results(composite_alpha, inputs, outputs)
    expected = results(reference.composite_alpha, inputs, outputs)
    for name, value in actual.items():
        assert_close(value, expected[name], GRADIENT[torch.float64], name)


@pytest.mark.parametrize("wanted", INPUTS)
def test_each_gradient_alone(native: None, wanted: str) -> None:
    """Parts of the backward pass that nobody asks for are left out."""
    inputs = case()
    expected = results(composite_alpha, inputs)[f"grad_{wanted}"]
    generator = torch.Generator().manual_seed(7)
    leaves = [x.clone().requires_grad_(name == wanted) for name, x in zip(INPUTS, inputs, strict=True)]
    out = composite_alpha(*leaves)
    found = [getattr(out, name) for name in OUTPUTS]
    cotangents = [torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in found]
    used = [(x, cotangent) for x, cotangent in zip(found, cotangents, strict=True) if x.requires_grad]
    (grad,) = torch.autograd.grad(
        [x for x, _ in used], leaves[INPUTS.index(wanted)], [cotangent for _, cotangent in used]
    )
    assert torch.equal(grad, expected)


def test_agrees_with_composite_rays(native: None) -> None:
    """Opacities of signed distances, given to one op or made by the other."""
    t = torch.linspace(1, 20, 64, dtype=torch.float64).expand(5, -1).contiguous()
    surface = torch.linspace(3, 18, 5, dtype=torch.float64)[:, None]
    values = torch.randn(5, 64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = []
    for fused in (True, False):
        sdf = (surface - t + 0.5 * torch.sin(3 * t)).requires_grad_()
        if fused:
            out = composite_rays(sdf, 2.7, t, values, last="opaque")
        else:
            out = composite_alpha(sdf_to_alpha(sdf, 2.7, last="opaque"), t, values)
        assert out.depth is not None and out.values is not None
        (grad,) = torch.autograd.grad(out.depth.sum() + out.values.square().sum(), sdf)
        found.append((out.weights, out.depth, out.values, grad))
    for fused_result, composed in zip(*found, strict=True):
        assert_close(fused_result, composed, GRADIENT[torch.float64])


@pytest.mark.parametrize("options", [*OPTIONS.values(), {"normalize_depth": True}], ids=str)
def test_gradcheck(backend: str, options: dict[str, Any]) -> None:
    inputs = tuple(tensor.requires_grad_() for tensor in case(2, 6, 2))
    assert torch.autograd.gradcheck(lambda *x: tuple(composite_alpha(*x, **options)), inputs)


@pytest.mark.parametrize("num_rays", [0, 3])
def test_opcheck_without_some_gradients(native: None, num_rays: int) -> None:
    alpha, t, values = (tensor.float() for tensor in case(num_rays, 9, 3))
    backward = torch.ops.pred.composite_alpha_backward.default
    of_opacity = (None, None, torch.randn(num_rays), None)
    torch.library.opcheck(backward, (*of_opacity, alpha, None, None, None, 0.0, False, True, False, False))
    of_values = (None, None, None, torch.randn(num_rays, 3))
    torch.library.opcheck(backward, (*of_values, alpha, t, values, None, 1e-7, True, False, False, True))


def test_errors(backend: str) -> None:
    alpha, t, values = case()
    with pytest.raises(ValueError, match=r"composite_alpha: alpha must have shape \[R, S\], got \[33\]"):
        composite_alpha(alpha[0])
    with pytest.raises(TypeError, match="composite_alpha: alpha must be float32 or float64, got int64"):
        composite_alpha(alpha.long())
    with pytest.raises(ValueError, match=r"composite_alpha: t must have shape \[5, 33\] .*got \[5, 32\]"):
        composite_alpha(alpha, t[:, 1:])
    with pytest.raises(ValueError, match=r"composite_alpha: values must have shape \[5, 33, C\], got \[4, 33, 4\]"):
        composite_alpha(alpha, t, values[1:])
    with pytest.raises(TypeError, match="composite_alpha: t must have the dtype of alpha"):
        composite_alpha(alpha, t.float())
    with pytest.raises(ValueError, match="composite_alpha: depth_at must be one of start, mid, got 'end'"):
        composite_alpha(alpha, t, depth_at="end")
    with pytest.raises(ValueError, match="composite_alpha: transmittance_eps must be finite, got nan"):
        composite_alpha(alpha, t, transmittance_eps=float("nan"))
