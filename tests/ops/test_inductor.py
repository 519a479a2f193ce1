# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A chain of ops through torch.compile's own code generator; other tests compile with backend aot_eager, which runs the
graph without one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from pred.ops import composite_rays, sample_bev, sdf_to_alpha
from tests.conftest import SANITIZED
from tests.tolerances import assert_close


@pytest.fixture
def inductor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Skips where it compiles nothing at all. What it writes is the test's own."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch._dynamo.reset()
    try:
        torch.compile(torch.sin, backend="inductor")(torch.ones(3))
    except Exception as error:
        pytest.skip(f"torch.compile has no working C++ compiler: {str(error).splitlines()[0]}")


def render(bev: Tensor, grid: Tensor, inv_s: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """A distance and features from a map, opacities, and a composite: what a training step differentiates."""
    rays, samples = t.shape
    features = sample_bev(bev, grid).view(rays, samples, -1)
    sdf = features[..., 0].tanh() + 4 - t
    alpha = sdf_to_alpha(sdf, inv_s)
    out = composite_rays(sdf, inv_s, t, features[..., 1:].softmax(dim=-1))
    assert out.depth is not None and out.values is not None
    loss = (out.depth - 3).square().mean() - out.values.clamp(min=1e-6).log().mean() + alpha.square().mean()
    return loss, out.depth


@pytest.mark.skipif(SANITIZED, reason="the generated code is not ours")
def test_a_training_step_through_inductor(native: None, inductor: None) -> None:
    compiled = torch.compile(render, backend="inductor", fullgraph=True, dynamic=True)  # one compilation
    for rays in (8, 13):
        generator = torch.Generator().manual_seed(rays)
        t = torch.rand(rays, 24, generator=generator).cumsum(dim=1)
        grid = torch.rand(1, rays * 24, 2, generator=generator) * 2 - 1
        leaves = [torch.randn(1, 5, 9, 8, generator=generator), grid, torch.tensor(2.7), t]
        found = []
        for function in (compiled, render):
            inputs = [tensor.clone().requires_grad_() for tensor in leaves]
            loss, depth = function(*inputs)
            found.append([loss.detach(), depth.detach(), *torch.autograd.grad(loss, inputs)])
        for name, actual, expected in zip(("loss", "depth", "bev", "grid", "inv_s", "t"), *found, strict=True):
            assert_close(actual, expected, 1e-5, name)
