# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""More than 2^31 elements in one tensor, in little memory: its pages are only read, and the system keeps no page of its
own for zeros that nobody has written. What the ops return, and copy, is small. The samplers' test is theirs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import memory
from pred.ops import composite_alpha, composite_rays, segment_reduce, voxelize
from tests.conftest import SANITIZED

pytestmark = [
    pytest.mark.large,
    pytest.mark.skipif(SANITIZED, reason="the sanitizer keeps notes on every page"),
]


@pytest.fixture(autouse=True)
def _little_memory() -> Iterator[None]:
    before = memory.reset_peak()
    yield
    if before is not None:  # the system can tell
        assert memory.status_bytes("VmHWM") - before < 1 << 30


def zeros(*shape: int) -> Tensor:
    """bfloat16. NumPy asks for zeroed pages, where torch writes the zeros."""
    tensor = torch.from_numpy(np.zeros(shape, np.int16)).view(torch.bfloat16)
    assert tensor.numel() > 1 << 31
    return tensor


def test_composites(native: None) -> None:
    """Values of 2 rays with 2^15 samples and more than 2^15 channels; the last sample of the last ray is not 0."""
    samples, channels = 1 << 15, (1 << 15) + 1
    values = zeros(2, samples, channels)
    values[-1, -1, -3:] = torch.tensor([1.0, 2.0, 3.0])
    t = torch.arange(float(samples)).expand(2, -1)
    alpha = torch.zeros(2, samples)
    alpha[:, -2:] = 0.5
    alpha.requires_grad_()
    out = composite_alpha(alpha, t, values)
    assert out.values is not None and not out.values[0].any() and not out.values[1, :-3].any()
    assert out.values[1, -3:].tolist() == [0.25, 0.5, 0.75]
    (grad,) = torch.autograd.grad(out.values[1, -1], alpha)
    # 3 times what gets past all other samples: half of the light, all of which the last sample would take.
    assert not grad[0].any() and grad[1, -1] == 1.5 and (grad[1, :-2] == -0.75).all() and grad[1, -2] == -1.5
    sdf = torch.full((2, samples), 100.0)
    sdf[:, -1] = -100.0
    rendered = composite_rays(sdf, 1.0, t, values, last="opaque").values
    assert rendered is not None and not rendered.any()  # the section before the last sample takes it all
    rendered = composite_rays(-sdf, 1.0, t, values, last="opaque").values
    assert rendered is not None and rendered[1, -3:].tolist() == [1.0, 2.0, 3.0] and rendered.sum() == 6


@pytest.mark.parametrize("reduce", ["sum", "mean", "max"])
def test_segment_reduce(native: None, reduce: str) -> None:
    rows, channels = 1 << 20, (1 << 11) + 1
    features = zeros(rows, channels)
    features[-1, -2:] = torch.tensor([4.0, 8.0])
    index = torch.arange(rows) % 4
    out = segment_reduce(features, index, 4, reduce)
    share = 4 / rows if reduce == "mean" else 1
    assert not out[:3].any() and not out[3, :-2].any() and out[3, -2:].tolist() == [4 * share, 8 * share]


def test_voxelize(native: None) -> None:
    """Points in rows of 2^17 columns."""
    points = zeros((1 << 14) + 1, 1 << 17)
    points[-1, :3] = torch.tensor([1.5, 2.5, 3.5])
    count = points.shape[0]
    found = voxelize(points, torch.tensor([0, count]), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 4.0, 4.0, 4.0))
    assert found.coords.tolist() == [[0, 0, 0, 0], [0, 3, 2, 1]] and found.counts.tolist() == [count - 1, 1]
    assert found.point_to_voxel[-1] == 1 and not found.point_to_voxel[:-1].any()
