# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Loss terms against hand-computed values, and what invalid rays may not do."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pred.losses import LossConfig, depth_loss, eikonal_loss, mean_over_valid, semantic_loss

ALL = torch.tensor([[True, True]])


def test_semantic_loss_by_hand() -> None:
    rendered = torch.tensor([[[0.5, 0.25], [0.0, 1.0]]], dtype=torch.float64)
    target = torch.tensor([[[1.0, 0.0], [0.4, 0.6]]], dtype=torch.float64)
    confidence = torch.tensor([[1.0, 0.6]], dtype=torch.float64)
    first = -math.log(0.5 + 1e-6)
    second = -0.6 * (0.4 * math.log(1e-6) + 0.6 * math.log(1 + 1e-6))
    loss = semantic_loss(rendered, target, confidence, ALL)
    assert loss.item() == pytest.approx((first + second) / 2, rel=1e-12)


def test_semantic_loss_of_a_transparent_ray_is_finite() -> None:
    rendered = torch.zeros(1, 1, 2, requires_grad=True)
    target = torch.tensor([[[1.0, 0.0]]])
    loss = semantic_loss(rendered, target, torch.ones(1, 1), torch.tensor([[True]]))
    loss.backward()
    assert loss.item() == pytest.approx(-math.log(1e-6), rel=1e-6)
    assert rendered.grad is not None and rendered.grad.isfinite().all()


def test_depth_loss_by_hand() -> None:
    loss = depth_loss(torch.tensor([[8.0, 3.0]]), torch.tensor([[10.0, 2.0]]), ALL, unit_m=2.0)
    assert loss.item() == pytest.approx((1.0 + 0.25) / 2)


def test_eikonal_loss_by_hand() -> None:
    # Two rays of two samples: lengths 1 and 3, then 0 and 5.
    gradient = torch.tensor([[[[1.0, 0, 0], [1, 2, 2]], [[0, 0, 0], [0, 3, 4]]]])
    loss = eikonal_loss(gradient, ALL)
    assert loss.item() == pytest.approx(((0 + 4) / 2 + (1 + 16) / 2) / 2, rel=1e-5)


def test_eikonal_loss_is_differentiable_where_the_gradient_vanishes() -> None:
    gradient = torch.zeros(1, 1, 3, 3, dtype=torch.float64, requires_grad=True)
    eikonal_loss(gradient, torch.tensor([[True]])).backward()
    assert gradient.grad is not None
    assert torch.equal(gradient.grad, torch.zeros_like(gradient))


def test_invalid_rays_do_not_count() -> None:
    one = torch.tensor([[True, False]])
    assert mean_over_valid(torch.tensor([[3.0, 5.0]]), one).item() == 3.0
    assert depth_loss(torch.tensor([[1.0, 9.0]]), torch.tensor([[2.0, 0.0]]), one, 1.0).item() == 1.0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_invalid_rays_may_hold_anything(bad: float) -> None:
    one = torch.tensor([[True, False]])
    depth = torch.tensor([[1.0, bad]], requires_grad=True)
    rendered = torch.tensor([[[0.5, 0.5], [bad, bad]]], requires_grad=True)
    gradient = torch.tensor([[[[1.0, 1, 1]], [[bad, bad, bad]]]], requires_grad=True)
    loss = (
        depth_loss(depth, torch.tensor([[2.0, bad]]), one, 1.0)
        + semantic_loss(rendered, torch.full((1, 2, 2), 0.5), torch.ones(1, 2), one)
        + eikonal_loss(gradient, one)
    )
    assert loss.isfinite()


def test_no_valid_ray_gives_zero_and_zero_gradient() -> None:
    none = torch.tensor([[False, False]])
    depth = torch.tensor([[1.0, 2.0]], requires_grad=True)
    rendered = torch.full((1, 2, 2), 0.3, requires_grad=True)
    gradient = torch.ones(1, 2, 4, 3, requires_grad=True)
    loss = (
        depth_loss(depth, torch.zeros(1, 2), none, 1.0)
        + semantic_loss(rendered, torch.ones(1, 2, 2), torch.ones(1, 2), none)
        + eikonal_loss(gradient, none)
    )
    loss.backward()
    assert loss.item() == 0.0
    for leaf in (depth, rendered, gradient):
        assert leaf.grad is not None and torch.equal(leaf.grad, torch.zeros_like(leaf))


def test_gradients_of_all_terms() -> None:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        values = torch.rand(shape, generator=generator, dtype=torch.float64) + 0.1
        return values.requires_grad_()

    valid = torch.tensor([[True, False, True]])
    target = torch.rand(1, 3, 4, generator=generator, dtype=torch.float64)
    confidence, depth_m = target.amax(-1), target.sum(-1)
    assert torch.autograd.gradcheck(lambda x: semantic_loss(x, target, confidence, valid), draw(1, 3, 4))
    assert torch.autograd.gradcheck(lambda x: depth_loss(x, depth_m, valid, 3.0), draw(1, 3))
    assert torch.autograd.gradcheck(lambda x: eikonal_loss(x, valid), draw(1, 3, 2, 3))


@pytest.mark.parametrize("name", ["semantic_weight", "depth_weight", "eikonal_weight"])
def test_negative_weight_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must not be negative, got -1"):
        LossConfig(**{name: -1.0})  # type: ignore[arg-type]


def test_depth_unit_must_be_positive() -> None:
    with pytest.raises(ValueError, match="depth_unit_m must be positive, got 0"):
        LossConfig(depth_unit_m=0.0)
