# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Field decoder: encoding, metric gradient, second order, initial surface."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pred.losses import eikonal_loss
from pred.models.field import FieldConfig, FieldDecoder
from pred.ops import sample_bev
from pred.ops.decode_field import encode

RANGE = (-8.0, -4.0, -1.0, 8.0, 4.0, 3.0)
CENTRE = torch.tensor([0.0, 0.0, 1.0])
HALF_EXTENT = torch.tensor([8.0, 4.0, 2.0])


def make(dtype: torch.dtype = torch.float64, channels: int = 3, **sizes: Any) -> tuple[FieldDecoder, Tensor, Tensor]:
    """A small decoder, a map `[2, C, 4, 8]` and points `[2, 7, 3]` inside the box."""
    torch.manual_seed(0)
    config = FieldConfig(**{"hidden": 6, "frequencies": 2, "num_classes": 4, "softplus_beta": 3.0, **sizes})
    field = FieldDecoder(channels, config, RANGE).to(dtype)
    bev = torch.randn(2, channels, 4, 8, dtype=dtype)
    points = CENTRE + HALF_EXTENT * (2 * torch.rand(2, 7, 3, dtype=dtype) - 1)
    return field, bev, points.to(dtype)


def plain_decode(field: FieldDecoder, bev: Tensor, points: Tensor) -> Tensor:
    """Network output `[B, N, 1 + K]` by the definition: concat(F(r), PE(r)) through the MLP."""
    position = (points - CENTRE) / HALF_EXTENT
    parts = [sample_bev(bev, position[..., :2]), position]
    parts += [torch.sin(2.0**k * position) for k in range(field.config.frequencies)]
    parts += [torch.cos(2.0**k * position) for k in range(field.config.frequencies)]
    values = torch.cat(parts, dim=-1)
    for layer in field.layers[:-1]:
        values = F.softplus(layer(values), field.config.softplus_beta)
    output: Tensor = field.layers[-1](values)
    return output


def plain_gradient(field: FieldDecoder, bev: Tensor, points: Tensor) -> Tensor:
    """The oracle of the analytic sweep: autograd through `plain_decode`."""
    points = points.detach().requires_grad_()
    sdf = plain_decode(field, bev, points)[..., 0] * field.config.sdf_scale_m
    (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=True)
    return gradient


def test_sizes_of_the_default() -> None:
    field = FieldDecoder(384, FieldConfig(), (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0))
    shapes = {name: tuple(value.shape) for name, value in field.state_dict().items()}
    assert shapes == {
        "layers.0.weight": (256, 384 + 39),
        "layers.0.bias": (256,),
        "layers.1.weight": (256, 256),
        "layers.1.bias": (256,),
        "layers.2.weight": (256, 256),
        "layers.2.bias": (256,),
        "layers.3.weight": (20, 256),
        "layers.3.bias": (20,),
    }


def test_encoding_by_hand() -> None:
    a, b, c = 0.5, -1.0, 0.25
    encoding = encode(torch.tensor([a, b, c], dtype=torch.float64), 2)
    expected = [a, b, c]
    expected += [math.sin(x) for x in (a, b, c)] + [math.sin(2 * x) for x in (a, b, c)]
    expected += [math.cos(x) for x in (a, b, c)] + [math.cos(2 * x) for x in (a, b, c)]
    torch.testing.assert_close(encoding, torch.tensor(expected, dtype=torch.float64))


def test_distance_and_gradient_by_hand() -> None:
    """One hidden unit that sees x and one BEV channel, no encoding beyond the coordinates."""
    field, _, _ = make(channels=1, hidden=1, layers=2, frequencies=0, sdf_scale_m=5.0, softplus_beta=2.0)
    weights = {
        "layers.0.weight": torch.tensor([[0.5, 3.0, 0.0, 0.0]]),  # channel, x, y, z
        "layers.0.bias": torch.tensor([0.25]),
        "layers.1.weight": torch.tensor([[2.0], [0], [0], [0], [0]]),  # distance, classes
        "layers.1.bias": torch.full((5,), -1.0),
    }
    field.load_state_dict(weights)
    # Cells are 2 m wide, centred at x = -7, -5, …; the map rises by 1 per cell.
    bev = torch.arange(8, dtype=torch.float64).expand(1, 1, 4, 8)
    point = torch.tensor([[[1.5, 0.5, 2.0]]], dtype=torch.float64)  # cell 4.25 of the map
    out = field(bev, point, with_gradient=True)
    z = 0.5 * 4.25 + 3.0 * (1.5 / 8) + 0.25
    softplus, slope = math.log1p(math.exp(2 * z)) / 2, 1 / (1 + math.exp(-2 * z))
    assert out.sdf.item() == pytest.approx(5 * (2 * softplus - 1), rel=1e-12)
    # Per metre: the map rises by 1 per 2 m, the coordinate by 1 per 8 m.
    expected = 5 * 2 * slope * (0.5 / 2 + 3.0 / 8)
    torch.testing.assert_close(out.gradient[0, 0], torch.tensor([expected, 0, 0], dtype=torch.float64))
    assert out.semantics.tolist() == [[[-1.0] * 4]]


@pytest.mark.parametrize("layers, frequencies", [(2, 2), (3, 0), (4, 6)])
def test_equals_the_definition(layers: int, frequencies: int, backend: str) -> None:
    field, bev, points = make(layers=layers, frequencies=frequencies)
    expected = plain_decode(field, bev, points)
    for with_gradient in (False, True):
        out = field(bev, points, with_gradient=with_gradient)
        torch.testing.assert_close(out.sdf, expected[..., 0] * field.config.sdf_scale_m)
        torch.testing.assert_close(out.semantics, expected[..., 1:])
    torch.testing.assert_close(out.gradient, plain_gradient(field, bev, points))


def test_float32_gradient(backend: str) -> None:
    field, bev, points = make(torch.float32, hidden=64, channels=16, frequencies=6, softplus_beta=100.0)
    gradient = field(bev, points, with_gradient=True).gradient
    expected = plain_gradient(field.double(), bev.double(), points.double())
    torch.testing.assert_close(gradient.double(), expected, rtol=1e-4, atol=1e-4)


def test_gradient_is_the_slope_in_metres() -> None:
    field, bev, points = make()
    gradient = field(bev, points, with_gradient=True).gradient
    step_m = 1e-6
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step_m
        rise = field(bev, points + shift).sdf - field(bev, points - shift).sdf
        torch.testing.assert_close(gradient[..., axis], rise / (2 * step_m), rtol=1e-5, atol=1e-7)


def test_second_order_equals_plain_autograd(backend: str) -> None:
    field, bev, points = make(layers=4, frequencies=3)
    leaves = [bev.requires_grad_(), *field.parameters()]

    def derivatives(gradient: Tensor, sdf: Tensor) -> tuple[Tensor, ...]:
        loss = (gradient.square().sum(-1).add(1e-3).sqrt() - 1).square().mean() + sdf.square().mean()
        return torch.autograd.grad(loss, leaves)

    out = field(bev, points, with_gradient=True, semantics=False)
    sdf = plain_decode(field, bev, points)[..., 0] * field.config.sdf_scale_m
    for actual, expected in zip(
        derivatives(out.gradient, out.sdf),
        derivatives(plain_gradient(field, bev, points), sdf),
        strict=True,
    ):
        torch.testing.assert_close(actual, expected)


def test_gradcheck_of_the_eikonal_loss(backend: str) -> None:
    """Second order through the gather, the encoding and the MLP, for every parameter and the map."""
    field, bev, points = make(hidden=3, layers=3, frequencies=1, num_classes=1, channels=2)
    points = points[:, :3]
    names = [name for name, _ in field.named_parameters()]

    def loss(bev: Tensor, *parameters: Tensor) -> Tensor:
        out = torch.func.functional_call(field, dict(zip(names, parameters, strict=True)), (bev, points, True, False))
        return eikonal_loss(out.gradient[:, :, None], torch.ones(2, 3, dtype=torch.bool)) + out.sdf.sum()

    assert torch.autograd.gradcheck(loss, (bev.requires_grad_(), *field.parameters()))


def test_points_receive_derivatives() -> None:
    field, bev, points = make()
    for with_gradient in (False, True):
        leaf = points.clone().requires_grad_()
        out = field(bev, leaf, with_gradient=with_gradient)
        (slope,) = torch.autograd.grad(out.sdf.sum(), leaf)
        torch.testing.assert_close(slope, plain_gradient(field, bev, points))


def test_without_semantics_the_rest_is_the_same() -> None:
    field, bev, points = make()
    full = field(bev, points, with_gradient=True)
    short = field(bev, points, with_gradient=True, semantics=False)
    assert short.semantics is None
    torch.testing.assert_close(short.sdf, full.sdf)
    assert torch.equal(short.gradient, full.gradient)


def test_no_grad_leaves_no_graph() -> None:
    field, bev, points = make()
    expected = field(bev, points, with_gradient=True)
    with torch.no_grad():
        out = field(bev, points, with_gradient=True)
    assert not any(value.requires_grad for value in out)
    assert torch.equal(out.gradient, expected.gradient)
    assert field(bev, points).gradient is None


def test_outside_the_range_box_the_map_is_zero() -> None:
    field, bev, _ = make()
    far = torch.tensor([[[30.0, 1.0, 0.0], [0.0, -20.0, 1.0]]], dtype=torch.float64).expand(2, -1, -1)
    out = field(bev, far, with_gradient=True)
    empty = field(torch.zeros_like(bev), far, with_gradient=True)
    assert all(torch.equal(a, b) and a.isfinite().all() for a, b in zip(out, empty, strict=True))


def test_no_points() -> None:
    field, bev, points = make()
    out = field(bev, points[:, :0], with_gradient=True)
    assert out.sdf.shape == (2, 0)
    assert out.semantics.shape == (2, 0, 4)
    assert out.gradient.shape == (2, 0, 3)


def test_a_nan_point_stays_alone() -> None:
    field, bev, points = make()
    clean = field(bev, points, with_gradient=True)
    points[0, 3, 1] = math.nan
    out = field(bev, points, with_gradient=True)
    keep = torch.ones(2, 7, dtype=torch.bool)
    keep[0, 3] = False
    assert torch.equal(out.sdf[keep], clean.sdf[keep])
    assert torch.equal(out.gradient[keep], clean.gradient[keep])


@pytest.mark.parametrize("beta", [1.0, 100.0])
def test_large_activations_stay_finite(beta: float) -> None:
    field, bev, points = make(torch.float32, softplus_beta=beta)
    bev = (1e4 * bev).requires_grad_()
    out = field(bev, points, with_gradient=True)
    assert all(value.isfinite().all() for value in out)
    (out.gradient.square().sum() + out.sdf.square().sum()).backward()
    assert bev.grad is not None and bev.grad.isfinite().all()


@pytest.mark.parametrize("hidden, layers, beta", [(128, 3, 100.0), (64, 2, 10.0), (256, 4, 1.0), (64, 5, 10.0)])
@pytest.mark.parametrize("point_range", [RANGE, (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)])
@pytest.mark.parametrize("level", [0.0, 0.5])
def test_initial_distance_falls_from_the_centre_through_zero(
    hidden: int, layers: int, beta: float, point_range: tuple[float, float, float, float, float, float], level: float
) -> None:
    torch.manual_seed(1)
    config = FieldConfig(hidden=hidden, layers=layers, softplus_beta=beta)
    field = FieldDecoder(32, config, point_range)
    low, high = torch.tensor(point_range).view(2, 3)
    centre, half_extent = (low + high) / 2, (high - low) / 2
    on_faces = torch.cat([torch.eye(3), -torch.eye(3)]) * half_extent
    bev = torch.full((1, 32, 4, 4), level)
    sdf = field(bev, torch.cat([centre[None], centre + on_faces])[None]).sdf[0]
    assert sdf[0] > 0.3 * half_extent.min()
    assert (sdf[1:] < -0.05 * half_extent.min()).all()


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"layers": 1}, "layers must be at least 2, got 1"),
        ({"hidden": 0}, "hidden must be at least 1"),
        ({"softplus_beta": 0.0}, "softplus_beta must be positive"),
        ({"sdf_scale_m": math.nan}, "sdf_scale_m must be positive"),
    ],
)
def test_bad_configuration(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FieldConfig(**changes)


class _Sizes(TorchDispatchMode):
    """Shapes of all results of torch's ops."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: set[tuple[int, ...]] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        results = out if isinstance(out, tuple | list) else [out]
        self.shapes |= {tuple(x.shape) for x in results if isinstance(x, Tensor)}
        return out


@pytest.mark.parametrize("recompute", [False, True])
def test_no_row_of_hidden_width_per_sample(recompute: bool, native: None) -> None:
    """But for what is kept for the backward pass."""
    hidden, samples = 96, 531
    field = FieldDecoder(5, FieldConfig(hidden=hidden, layers=3, num_classes=4, recompute=recompute), RANGE)
    bev, points = torch.randn(1, 5, 8, 8, requires_grad=True), torch.rand(1, samples, 3)
    with _Sizes() as sizes:
        out = field(bev, points, with_gradient=True)
        assert out.semantics is not None and out.gradient is not None
        (out.sdf.sum() + out.semantics.sum() + out.gradient.square().sum()).backward()
    wide = {shape for shape in sizes.shapes if samples in shape and hidden in shape}
    assert wide == (set() if recompute else {(2, samples, hidden), (1, samples, hidden)})
