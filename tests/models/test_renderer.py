# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ray-box intersection, sampling and compositing on fields whose image is known."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.bench_step import Step
from benchmarks.cases import TINY
from pred.models.field import FieldConfig, FieldDecoder
from pred.models.renderer import (
    RaySamples,
    RenderedRays,
    Renderer,
    RendererConfig,
    Sharpness,
    ray_box_interval,
    stratified_samples,
)
from pred.ops import DecodedField

RANGE = (-20.0, -10.0, -2.0, 20.0, 10.0, 4.0)
NO_MAP = torch.zeros(1, 1, 1, 1)


class Wall(FieldDecoder):
    """Signed distance to the plane x = 12 m from the origin's side; class 0 below y = 0, else 1."""

    def __init__(self) -> None:
        super().__init__(1, FieldConfig(hidden=2, num_classes=2), RANGE)

    def decode(
        self, projected: Tensor, points_m: Tensor, with_gradient: bool = False, semantics: bool = True
    ) -> DecodedField:
        sdf = 12 - points_m[..., 0]
        logits = 50 * F.one_hot((points_m[..., 1] > 0).long(), 2).to(points_m)
        gradient = points_m.new_tensor((-1.0, 0, 0)).expand_as(points_m)
        return DecodedField(sdf, logits if semantics else None, gradient if with_gradient else None)


def unit(*direction: float) -> Tensor:
    return F.normalize(torch.tensor(direction).float(), dim=0)


def render_wall(
    origins: Tensor, directions: Tensor, inv_s: float = 20.0, valid: Tensor | None = None, **config: Any
) -> tuple[RaySamples, RenderedRays]:
    """Rays `[R, 3]` of one frame."""
    renderer = Renderer(RendererConfig(**config), RANGE)
    count = origins.shape[0]
    every = torch.ones(count, dtype=torch.bool) if valid is None else valid
    field, sharpness = Wall(), torch.tensor(inv_s)
    samples = renderer.sample(
        field, NO_MAP, sharpness, origins[None], directions[None], every[None], torch.full((1, count), 0.5)
    )
    return samples, renderer.render(field, NO_MAP, sharpness, samples, semantics=True, with_gradient=True)


@pytest.mark.parametrize(
    "origin, direction, near_m, expected",
    [
        ((0, 0, 0), (1, 0, 0), 1.0, (1.0, 20.0)),
        ((0, 0, 0), (-1, 0, 0), 0.0, (0.0, 20.0)),
        ((0, 0, 0), (0, 0, -1), 1.0, (1.0, 2.0)),
        ((0, 0, 0), (0.6, 0.8, 0), 1.0, (1.0, 12.5)),  # leaves by y = 10
        ((-30, 0, 0), (1, 0, 0), 1.0, (10.0, 50.0)),  # enters from outside
        ((0, 0, 0), (1, -0.0, -0.0), 1.0, (1.0, 20.0)),  # negative zeros
        ((0, 0, 0), (1, 1e-6, -1e-30), 1.0, (1.0, 20.0)),  # almost parallel to two faces
    ],
)
def test_ray_box_interval(
    origin: tuple[float, ...], direction: tuple[float, ...], near_m: float, expected: tuple[float, float]
) -> None:
    t_near, t_far, valid = ray_box_interval(torch.tensor(origin).float(), torch.tensor(direction), RANGE, near_m)
    assert valid
    assert (t_near.item(), t_far.item()) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    "origin, direction",
    [
        ((30, 0, 0), (1, 0, 0)),  # looks away
        ((0, 30, 0), (1, 0, 0)),  # passes beside, parallel to the box
        ((0, 30, 0), (1, 0.01, 0)),
        ((19.5, 0, 0), (1, 0, 0)),  # leaves before near_m
        ((0, 0, 0), (0, 0, 0)),
        ((0, 10, 0), (1, 0, 0)),  # within a face
        ((math.nan, 0, 0), (1, 0, 0)),
        ((0, 0, 0), (1, math.nan, 0)),
        ((0, 0, math.inf), (1, 0, 0)),
        ((0, 0, 0), (math.inf, 0, 0)),
    ],
)
def test_rays_that_miss_the_box(origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
    t_near, t_far, valid = ray_box_interval(torch.tensor(origin).float(), torch.tensor(direction).float(), RANGE, 1.0)
    assert not valid
    assert (t_near.item(), t_far.item()) == (1.0, 2.0)


def test_stratified_samples_by_hand() -> None:
    t = stratified_samples(torch.tensor([1.0, 0.0]), torch.tensor([9.0, 1.0]), torch.tensor([0.5, 0.0]), 4)
    assert t.tolist() == [[2, 4, 6, 8], [0, 0.25, 0.5, 0.75]]


def test_sharpness_is_clipped_and_keeps_finite_derivatives() -> None:
    sharpness = Sharpness(2.7)
    assert sharpness().item() == pytest.approx(2.7, rel=1e-6)
    assert list(sharpness.state_dict()) == ["v"]
    for v, expected, slope in [(0.1, math.e, 10 * math.e), (50.0, 1e6, 0.0), (-50.0, 1e-6, 0.0)]:
        sharpness.zero_grad()
        with torch.no_grad():
            sharpness.v.fill_(v)
        sharpness().backward()
        assert sharpness().item() == pytest.approx(expected, rel=1e-5)
        assert sharpness.v.grad is not None
        assert sharpness.v.grad.item() == pytest.approx(slope, rel=1e-5)


def test_samples_lie_in_order_within_the_box(backend: str) -> None:
    directions = torch.stack([unit(1, 0, 0), unit(1, 0.3, 0.1), unit(-1, 0, -0.1)])
    samples, _ = render_wall(torch.zeros(3, 3), directions, coarse_samples=16, fine_samples=24)
    assert samples.t_m.shape == (1, 3, 40)
    assert samples.points_m.shape == (1, 3, 40, 3)
    assert (samples.t_m.diff(dim=-1) >= 0).all()
    low, high = torch.tensor(RANGE).view(2, 3)
    assert ((samples.points_m >= low) & (samples.points_m <= high)).all()
    torch.testing.assert_close(samples.points_m[0], directions[:, None] * samples.t_m[0][..., None])
    # Fine samples gather at the wall, 12 m away for the first ray.
    assert ((samples.t_m[0, 0] - 12).abs() < 1.5).sum() >= 24


def test_depth_opacity_and_classes_of_a_wall(backend: str) -> None:
    directions = torch.stack([unit(1, 0, 0.05), unit(4, 1, 0), unit(4, -1, 0), unit(-1, 0.2, 0)])
    _, rendered = render_wall(torch.zeros(4, 3), directions, depth_at="mid")
    expected_m = 12 / directions[:3, 0]
    torch.testing.assert_close(rendered.depth_m[0, :3], expected_m, rtol=0, atol=0.05)
    torch.testing.assert_close(rendered.opacity[0], torch.tensor([1.0, 1, 1, 0]), rtol=0, atol=1e-3)
    assert rendered.depth_m[0, 3] == 0  # looks away from the wall: the distance only rises
    assert rendered.semantics is not None and rendered.gradient is not None
    torch.testing.assert_close(rendered.semantics.sum(-1), rendered.opacity)
    assert rendered.semantics[0, 1].argmax() == 1
    assert rendered.semantics[0, 2].argmax() == 0
    assert rendered.gradient.shape == (1, 4, 96 + 128, 3)
    assert rendered.hit.all()


def test_depth_conventions(backend: str) -> None:
    """A section's weight counts at its start by default; a middle lies half a section further."""
    ray = torch.zeros(1, 3), unit(1, 0, 0)[None]
    sizes: dict[str, Any] = {"coarse_samples": 38, "fine_samples": 0, "inv_s": 500.0}  # strata of 0.5 m from 1 to 20
    _, start = render_wall(*ray, **sizes)
    _, middle = render_wall(*ray, depth_at="mid", **sizes)
    # Samples at 1.25, 1.75, …: the surface lies between 11.75 and 12.25.
    assert start.depth_m.item() == pytest.approx(11.75, abs=1e-4)
    assert middle.depth_m.item() == pytest.approx(12.0, abs=1e-4)


def test_normalized_depth(backend: str) -> None:
    """A soft wall that the ray leaves half-way: the depth is short unless divided by the opacity."""
    ray = torch.zeros(1, 3), unit(1, 0.84, 0)[None]  # leaves by y = 10 near x = 11.9
    _, plain = render_wall(*ray, inv_s=2.0)
    _, normalized = render_wall(*ray, inv_s=2.0, normalize_depth=True)
    assert 0.3 < plain.opacity.item() < 0.7
    assert normalized.depth_m.item() == pytest.approx(plain.depth_m.item() / plain.opacity.item(), rel=1e-4)


def test_resample_sharpness_is_the_models_own_by_default() -> None:
    ray = torch.zeros(1, 3), unit(1, 0, 0)[None]
    soft, _ = render_wall(*ray, inv_s=0.5)
    fixed, _ = render_wall(*ray, inv_s=0.5, resample_inv_s=20.0)
    own, _ = render_wall(*ray, inv_s=20.0)
    assert torch.equal(fixed.t_m, own.t_m)
    near_wall = [((samples.t_m - 12).abs() < 0.5).sum().item() for samples in (fixed, soft)]
    assert near_wall[0] >= 128 > 2 * near_wall[1]


@pytest.mark.parametrize("sharp", [500.0, 1e6])
def test_sharp_surface_is_finite(sharp: float, backend: str) -> None:
    directions = unit(1, 0, 0)[None]
    _, rendered = render_wall(torch.zeros(1, 3), directions, inv_s=sharp)
    assert rendered.depth_m.item() == pytest.approx(12.0, abs=0.3)
    assert rendered.opacity.item() == pytest.approx(1.0, abs=1e-5)


def test_bad_rays_stay_alone(backend: str) -> None:
    directions = torch.stack([unit(1, 0, 0), unit(1, 0.1, 0), unit(1, 0.2, 0), unit(1, 0, 0)])
    origins = torch.zeros(4, 3)
    _, clean = render_wall(origins, directions)
    directions[1, 0] = math.nan
    origins[2, 1] = 1000.0
    valid = torch.tensor([True, True, True, False])
    samples, rendered = render_wall(origins, directions, valid=valid)
    assert rendered.hit.tolist() == [[True, False, False, False]]
    assert rendered.depth_m[0, 0] == clean.depth_m[0, 0]
    assert samples.points_m.isfinite().all()
    assert all(value.isfinite().all() for value in rendered if value is not None)


def test_no_rays() -> None:
    samples, rendered = render_wall(torch.zeros(0, 3), torch.zeros(0, 3))
    assert samples.t_m.shape == (1, 0, 224)
    assert rendered.depth_m.shape == (1, 0)
    assert rendered.semantics is not None and rendered.semantics.shape == (1, 0, 2)


def test_sampling_is_constant_and_rendering_is_not() -> None:
    """detach_sdf leaves derivatives to the classes alone."""
    torch.manual_seed(0)
    field = FieldDecoder(2, FieldConfig(hidden=8, num_classes=3), RANGE)
    renderer = Renderer(RendererConfig(coarse_samples=8, fine_samples=8), RANGE)
    projected = field.project(torch.randn(1, 2, 4, 4))
    sharpness = Sharpness(2.7)
    rays = torch.zeros(1, 1, 3), unit(1, 0, 0).view(1, 1, 3)
    every, middle = torch.ones(1, 1, dtype=torch.bool), torch.full((1, 1), 0.5)
    samples = renderer.sample(field, projected, sharpness(), *rays, every, middle)
    assert not samples.t_m.requires_grad and not samples.points_m.requires_grad

    rendered = renderer.render(field, projected, sharpness(), samples, semantics=True, detach_sdf=True)
    assert rendered.semantics is not None
    (rendered.semantics[..., 0] + rendered.depth_m + rendered.opacity).sum().backward()
    output = field.get_parameter("layers.3.weight").grad
    assert output is not None
    assert torch.equal(output[0], torch.zeros(8)) and output[1:].abs().sum() > 0
    assert sharpness.v.grad is None

    renderer.render(field, projected.detach(), sharpness(), samples).depth_m.sum().backward()
    assert sharpness.v.grad is not None and sharpness.v.grad != 0


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"coarse_samples": 1}, "coarse_samples must be at least 2, got 1"),
        ({"fine_samples": -1}, "fine_samples must not be negative"),
        ({"samples_per_part": 0}, "samples_per_part must be at least 1"),
        ({"near_m": math.nan}, "near_m must not be negative, got nan"),
        ({"initial_inv_s": 0.0}, "initial_inv_s must be in"),
        ({"resample_inv_s": 1e7}, "resample_inv_s must be in"),
    ],
)
def test_bad_configuration(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RendererConfig(**changes)


class NoHost(TorchDispatchMode):
    """Refuses to read a tensor's number."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert func is not torch.ops.aten._local_scalar_dense.default, "a number is read from a tensor"
        return func(*args, **(kwargs or {}))


def test_a_step_needs_nothing_from_the_host(native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a CUDA graph cannot hold: tensors made of the host's numbers, and numbers read from tensors."""
    step = Step(TINY, FieldDecoder)

    def refuse(*_: Any, **__: Any) -> Tensor:
        raise AssertionError("a tensor is made of the host's numbers")

    with monkeypatch.context() as patched, NoHost():
        patched.setattr(torch, "tensor", refuse)
        patched.setattr(Tensor, "new_tensor", refuse)
        gradients = torch.autograd.grad(step.loss(), step.leaves)
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_rays_of_a_part_depend_on_the_device() -> None:
    renderer = Renderer(RendererConfig(coarse_samples=96, fine_samples=128), RANGE)
    assert renderer.rays_per_part(torch.device("cpu")) == 73 and renderer.rays_per_part(torch.device("cuda")) == 1170
    renderer = Renderer(RendererConfig(coarse_samples=96, fine_samples=128, samples_per_part=1000), RANGE)
    assert renderer.rays_per_part(torch.device("cpu")) == renderer.rays_per_part(torch.device("cuda")) == 4
