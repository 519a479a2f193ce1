# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The pre-training model end to end, on toy batches."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pred.data.batch import Batch, DepthRays, SemanticRays
from pred.losses import LossConfig
from pred.models.encoders import BEVBackboneConfig, EncoderConfig, PillarConfig
from pred.models.field import FieldConfig
from pred.models.pretrainer import Pretrainer, PretrainOutput, sum_of_parts
from pred.models.renderer import RendererConfig

RANGE = (-16.0, -16.0, -5.0, 16.0, 16.0, 3.0)
GROUND_M = -1.8
ENCODER = EncoderConfig(
    pillars=PillarConfig(pillar_size=(1.0, 1.0), vfe_filters=[8, 8]),
    backbone_2d=BEVBackboneConfig(
        layer_nums=[1, 1],
        layer_strides=[1, 2],
        num_filters=[8, 16],
        upsample_strides=[1, 2],
        num_upsample_filters=[8, 8],
    ),
)
FIELD = FieldConfig(hidden=32, frequencies=4, num_classes=3)
RENDERER = RendererConfig(coarse_samples=16, fine_samples=16)


def make(field: FieldConfig = FIELD, renderer: RendererConfig = RENDERER, loss: LossConfig | None = None) -> Pretrainer:
    torch.manual_seed(0)
    return Pretrainer(ENCODER, field, renderer, loss or LossConfig(), RANGE)


def toy_batch(num_frames: int = 2, num_rays: int = 24, num_points: int = 60, seed: int = 0) -> Batch:
    """Flat ground seen from the sensor: class 0 near by, 1 further away."""
    generator = torch.Generator().manual_seed(seed)

    def rays() -> tuple[dict[str, Tensor], Tensor, Tensor]:
        yaw = 2 * math.pi * torch.rand(num_frames, num_rays, generator=generator)
        radius_m = 3 + 10 * torch.rand(num_frames, num_rays, generator=generator)
        offset = torch.stack([radius_m * yaw.cos(), radius_m * yaw.sin(), torch.full_like(yaw, GROUND_M)], -1)
        depth_m = offset.norm(dim=-1)
        fields = {
            "origins": torch.zeros_like(offset),
            "directions": offset / depth_m[..., None],
            "valid": torch.ones_like(yaw, dtype=torch.bool),
            "jitter": torch.rand(num_frames, num_rays, generator=generator),
        }
        return fields, depth_m, (radius_m > 8).long()

    depth_rays, depth_m, _ = rays()
    semantic_rays, range_m, labels = rays()
    xy = 32 * torch.rand(num_frames * num_points, 2, generator=generator) - 16
    points = torch.cat([xy, torch.full_like(xy[:, :1], GROUND_M), torch.rand(len(xy), 2, generator=generator)], 1)
    return Batch(
        step=0,
        tokens=[f"frame {frame}" for frame in range(num_frames)],
        points=points,
        point_offsets=num_points * torch.arange(num_frames + 1),
        depth=DepthRays(**depth_rays, depth_m=depth_m, depth_factor=torch.ones_like(depth_m)),
        semantic=SemanticRays(
            **semantic_rays,
            range_m=range_m,
            target=F.one_hot(labels, 3).float(),
            confidence=torch.ones_like(depth_m),
        ),
        skipped=[],
    )


def gradients(model: Pretrainer, output: PretrainOutput) -> dict[str, Tensor]:
    model.zero_grad()
    output.loss.backward()
    return {name: value.grad for name, value in model.named_parameters() if value.grad is not None}


def assert_same_gradients(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert actual.keys() == expected.keys()
    largest = max(gradient.norm() for gradient in expected.values())
    for name, gradient in actual.items():
        error = (gradient - expected[name]).norm()
        assert error <= 1e-3 * max(expected[name].norm(), 1e-3 * largest), name


def test_loss_falls_on_a_toy_batch(backend: str) -> None:
    torch.set_num_threads(1)  # quicker for so little work
    model, batch = make(), toy_batch()
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    first = model(batch)
    for _ in range(40):
        output = model(batch)
        optimizer.zero_grad()
        output.loss.backward()
        optimizer.step()
    assert output.terms["semantic"] < 0.5 * first.terms["semantic"]
    assert output.terms["depth"] < 0.5 * first.terms["depth"]
    assert output.terms["eikonal"] < first.terms["eikonal"]
    assert output.depth_mae_m < 0.7 * first.depth_mae_m


def test_output_figures() -> None:
    loss = LossConfig(semantic_weight=0.5, depth_weight=2.0, eikonal_weight=0.25)
    model, batch = make(loss=loss), toy_batch()
    batch.depth.valid[0, :5] = False
    output = model(batch)
    terms = output.terms
    expected = 0.5 * terms["semantic"] + 2.0 * terms["depth"] + 0.25 * terms["eikonal"]
    assert output.loss.item() == pytest.approx(expected.item(), rel=1e-6)
    assert list(terms) == ["semantic", "depth", "eikonal"]
    assert not any(term.requires_grad for term in terms.values())
    assert output.num_rays == 2 * 48 - 5
    assert output.inv_s.item() == pytest.approx(2.7, rel=1e-6)
    assert output.zero_opacity_share == 0
    assert 0 < output.depth_mae_m < 16


def test_every_ray_starts_opaque() -> None:
    model = make(field=FieldConfig(hidden=64, num_classes=3)).train()
    batch = toy_batch(num_rays=400)
    with torch.no_grad():
        bev = model.encode(batch.points, batch.point_offsets)
        view = model.render(bev, batch.depth.origins, batch.depth.directions)
    assert view.opacity.mean() > 0.9
    assert view.opacity.min() > 0.1


def test_lidar_only(backend: str) -> None:
    model, batch = make(), toy_batch()
    full = model(batch)
    output = model(replace(batch, semantic=None))
    assert output.terms["semantic"] == 0
    torch.testing.assert_close(output.terms["depth"], full.terms["depth"])
    assert output.num_rays == 48
    grads = gradients(model, output)
    # Only the distance is taught.
    assert grads["field.layers.3.weight"][0].abs().sum() > 0
    assert torch.equal(grads["field.layers.3.weight"][1:], torch.zeros(3, 32))


def test_semantic_rays_do_not_teach_the_distance() -> None:
    model = make(loss=LossConfig(depth_weight=0.0, eikonal_weight=0.0))
    grads = gradients(model, model(toy_batch()))
    head = grads["field.layers.3.weight"]
    assert torch.equal(head[0], torch.zeros(32)) and head[1:].abs().sum() > 0
    assert grads["field.layers.3.bias"][0] == 0
    assert grads["sharpness.v"] == 0
    assert grads["encoder.vfe.pfn_layers.0.linear.weight"].abs().sum() > 0


def test_depth_factor_turns_range_into_depth() -> None:
    model, batch = make().eval(), toy_batch()
    factor = 0.5 + 0.5 * torch.rand(batch.depth.depth_m.shape, generator=torch.Generator().manual_seed(1))
    scaled = replace(batch.depth, depth_factor=factor, depth_m=torch.zeros_like(factor))
    output = model(replace(batch, depth=scaled))
    plain = model(replace(batch, depth=replace(scaled, depth_factor=torch.ones_like(factor))))
    assert 0.5 * plain.depth_mae_m < output.depth_mae_m < plain.depth_mae_m


def with_bad_rays(batch: Batch, bad: float) -> Batch:
    """The batch with four more rays of each kind that must not count."""

    def append(values: Tensor, filler: Tensor) -> Tensor:
        return torch.cat([values, filler.expand(values.shape[0], 4, *values.shape[2:])], dim=1)

    def extend(rays: DepthRays | SemanticRays) -> dict[str, Tensor]:
        extended = {name: append(value, torch.tensor(bad)) for name, value in vars(rays).items() if name != "valid"}
        # Not valid; NaN or beyond the box though valid.
        valid = torch.tensor([[False, False, True, True]]).expand(rays.valid.shape[0], -1)
        extended["valid"] = torch.cat([rays.valid, valid], dim=1)
        extended["origins"][:, -1] = torch.tensor([100.0, 0.0, 0.0])
        extended["directions"][:, -1] = torch.tensor([1.0, 0.0, 0.0])
        return extended

    assert batch.semantic is not None
    return replace(batch, depth=DepthRays(**extend(batch.depth)), semantic=SemanticRays(**extend(batch.semantic)))


@pytest.mark.parametrize("semantic_at", ["ray", "return"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_bad_rays_contribute_nothing(bad: float, semantic_at: Literal["ray", "return"], backend: str) -> None:
    loss = LossConfig(semantic_at=semantic_at)
    model = make(loss=loss)
    clean = model(toy_batch())
    expected = gradients(model, clean)
    model = make(loss=loss)
    output = model(with_bad_rays(toy_batch(), bad))
    assert output.num_rays == clean.num_rays
    torch.testing.assert_close(output.loss, clean.loss)
    assert_same_gradients(gradients(model, output), expected)


def test_semantics_at_the_returns_need_no_rendering() -> None:
    """The term is the cross-entropy of the field at the returns, and where the rays come from does not matter."""
    model, batch = make(loss=LossConfig(semantic_at="return")).eval(), toy_batch()
    assert batch.semantic is not None
    rays = batch.semantic
    returns = rays.origins + rays.directions * rays.range_m[..., None]
    logits = model.field(model.encode(batch.points, batch.point_offsets), returns).semantics
    expected = -(rays.target * (logits.softmax(-1) + 1e-6).log()).sum(-1).mean()
    torch.testing.assert_close(model(batch).terms["semantic"], expected.detach())
    shift = torch.tensor([0.5, -0.25, 0.1])
    range_m = (returns - shift).norm(dim=-1)
    moved = replace(
        rays,
        origins=shift.expand_as(returns),
        directions=(returns - shift) / range_m[..., None],
        range_m=range_m,
    )
    torch.testing.assert_close(model(replace(batch, semantic=moved)).terms["semantic"], expected.detach())


def test_no_valid_ray_gives_zero_loss_and_gradient(backend: str) -> None:
    model, batch = make(), toy_batch()
    batch.depth.valid.fill_(False)
    assert batch.semantic is not None
    batch.semantic.valid.fill_(False)
    output = model(batch)
    assert output.loss.item() == 0 and output.num_rays == 0
    assert output.depth_mae_m == 0 and output.zero_opacity_share == 0
    for name, gradient in gradients(model, output).items():
        assert torch.equal(gradient, torch.zeros_like(gradient)), name


@pytest.mark.parametrize("num_points", [0, 1])
def test_almost_no_points(num_points: int, backend: str) -> None:
    model = make()
    batch = toy_batch(num_frames=1)
    batch = replace(batch, points=batch.points[:num_points], point_offsets=torch.tensor([0, num_points]))
    output = model(batch)
    assert output.loss.isfinite()
    assert all(gradient.isfinite().all() for gradient in gradients(model, output).values())


@pytest.mark.parametrize("v", [50.0, -50.0], ids=["sharp", "soft"])
def test_extreme_sharpness_stays_finite(v: float, backend: str) -> None:
    model, batch = make(), toy_batch()
    with torch.no_grad():
        model.sharpness.v.fill_(v)
    output = model(batch)
    assert output.loss.isfinite()
    assert output.inv_s.item() == pytest.approx(1e6 if v > 0 else 1e-6, rel=1e-4)
    assert all(gradient.isfinite().all() for gradient in gradients(model, output).values())


def test_native_equals_reference(native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for backend in ("native", "reference"):
        monkeypatch.setenv("PRED_BACKEND", backend)
        model = make()
        output = model(toy_batch())
        results.append((output.loss, gradients(model, output)))
    (loss, actual), (expected_loss, expected) = results
    torch.testing.assert_close(loss, expected_loss, rtol=1e-5, atol=0)
    assert_same_gradients(actual, expected)


def test_derivatives_against_finite_differences() -> None:
    """The whole loss along one direction of all parameters, with sample positions held fixed."""
    model = make(field=replace(FIELD, softplus_beta=3.0), renderer=replace(RENDERER, fine_samples=0)).double().eval()
    batch = toy_batch(num_frames=1, num_rays=6)
    depth = DepthRays(**{k: v.double() if v.is_floating_point() else v for k, v in vars(batch.depth).items()})
    assert batch.semantic is not None
    semantic = SemanticRays(**{k: v.double() if v.is_floating_point() else v for k, v in vars(batch.semantic).items()})
    with torch.no_grad():  # away from the kink of ReLU, where the empty cells of a new encoder lie
        for parameter in model.encoder.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    # The semantic rays' distances are constants of the loss, so they are left out of the difference.
    batch = replace(batch, depth=depth, semantic=None, points=batch.points.double())
    grads = gradients(model, model(batch))
    generator = torch.Generator().manual_seed(2)
    direction = {
        name: torch.randn(value.shape, generator=generator, dtype=torch.float64) for name, value in grads.items()
    }
    slope = sum((grads[name] * direction[name]).sum().item() for name in grads)
    losses = []
    for step in (1e-6, -1e-6):
        moved = copy.deepcopy(model)
        with torch.no_grad():
            for name, parameter in moved.named_parameters():
                if name in direction:
                    parameter.add_(step * direction[name])
            losses.append(moved(batch).loss.item())
    assert slope == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-5)
    assert model(replace(batch, semantic=semantic)).loss.dtype == torch.float64


def test_bf16_autocast_is_close_to_float32() -> None:
    model, batch = make(), toy_batch()
    expected = copy.deepcopy(model)(batch)
    with torch.autocast("cpu", torch.bfloat16):
        output = model(batch)
        assert model.encode(batch.points, batch.point_offsets).dtype == torch.float32
    assert output.loss.dtype == torch.float32
    assert output.loss.item() == pytest.approx(expected.loss.item(), rel=0.05)
    assert all(gradient.isfinite().all() for gradient in gradients(model, output).values())


@pytest.mark.parametrize("samples_per_part", [1, 100, 10**9])
def test_parts_change_nothing(samples_per_part: int) -> None:
    """One ray, three rays or all rays at a time; some parts without a valid ray."""
    results = []
    for samples in (16384, samples_per_part):
        model = make(renderer=replace(RENDERER, samples_per_part=samples))
        batch = toy_batch()
        batch.depth.valid[0, 4:12] = False
        output = model(batch)
        results.append((output, gradients(model, output)))
    (expected, expected_gradients), (output, output_gradients) = results
    torch.testing.assert_close(output.loss, expected.loss)
    torch.testing.assert_close(output.terms, expected.terms)
    torch.testing.assert_close(output[2:], expected[2:])
    assert_same_gradients(output_gradients, expected_gradients)


def test_sum_of_parts_adds_in_float32() -> None:
    """A thousand ones are a thousand, which bfloat16 loses count of at 256."""
    x = torch.zeros(3, dtype=torch.bfloat16, requires_grad=True)
    sum_of_parts(lambda x: (x.sum() for _ in range(1000)), [x], []).backward()
    assert x.grad is not None and x.grad.dtype == torch.bfloat16 and x.grad.tolist() == [1000.0] * 3


def test_sum_of_parts_is_the_sum() -> None:
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(3, generator=generator, dtype=torch.float64, requires_grad=True)
    unused = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    frozen = torch.randn(3, generator=generator, dtype=torch.float64)

    def parts(x: Tensor, y: Tensor) -> Iterator[Tensor]:
        yield (x * weight).sum()
        yield (x.exp() * y * frozen).sum()

    def total(x: Tensor) -> Tensor:
        # The input comes from the parameter too: both ways must count, once each.
        return 3 * sum_of_parts(parts, [x * weight, frozen], [weight, unused])

    x = torch.randn(3, generator=generator, dtype=torch.float64, requires_grad=True)
    plain = 3 * sum(parts(x * weight, frozen), torch.zeros(()))
    torch.testing.assert_close(total(x), plain)
    actual = torch.autograd.grad(total(x), [x, weight, unused])
    expected = torch.autograd.grad(plain, [x, weight])
    torch.testing.assert_close(actual, (*expected, torch.zeros_like(unused)))
    with torch.no_grad():
        torch.testing.assert_close(total(x), plain)


def test_without_gradients_the_loss_is_the_same() -> None:
    model, batch = make().eval(), toy_batch()
    with torch.no_grad():
        output = model(batch)
    assert not output.loss.requires_grad
    torch.testing.assert_close(output.loss, model(batch).loss)
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    assert not model(batch).loss.requires_grad


def test_same_bits_twice(backend: str) -> None:
    runs = []
    for _ in range(2):
        model = make()
        output = model(toy_batch())
        runs.append({"loss": output.loss, **gradients(model, output)})
    for name, value in runs[0].items():
        assert torch.equal(value, runs[1][name]), name


def test_rendering_in_chunks(backend: str) -> None:
    model, batch = make().eval(), toy_batch()
    bev = model.encode(batch.points, batch.point_offsets)
    origins, directions = batch.depth.origins.clone(), batch.depth.directions
    origins[:, 3] = 1000.0
    whole = model.render(bev, origins, directions)
    parts = model.render(bev, origins, directions, chunk=7)
    assert whole.depth_m.shape == (2, 24) and whole.semantics.shape == (2, 24, 3)
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
        assert not one.requires_grad
        assert one[:, 3].abs().sum() == 0 and one[:, :3].abs().sum() > 0
    torch.testing.assert_close(whole.semantics.sum(-1), whole.opacity, rtol=1e-4, atol=1e-5)
    nothing = model.render(bev, origins[:, :0], directions[:, :0])
    assert nothing.depth_m.shape == (2, 0) and nothing.semantics.shape == (2, 0, 3)
