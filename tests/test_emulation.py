# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""CUDA kernels that run on the CPU (`make emulate`): what the tests of the ops do not ask of them."""

from __future__ import annotations

import pytest
import torch

from pred import ops
from tests.conftest import EMULATED, KERNEL_ERROR
from tests.ops.examples import EXAMPLES, Example, evaluate, order_of

pytestmark = pytest.mark.skipif(not EMULATED, reason="the CUDA kernels are not emulated here: make emulate")

ORDERS = ("forward", "backward", "shuffled")


@pytest.mark.parametrize("example", EXAMPLES, ids=str)
def test_no_result_depends_on_the_order_of_threads(
    native: None, example: Example, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a barrier is missing, one of the orders reads what is not yet written."""
    for count in (3, 140):
        arguments = example.example(count, torch.float32, seed=count)
        found = []
        for order in ORDERS:
            monkeypatch.setenv("PRED_EMULATION_ORDER", order)
            found.append(evaluate(example.native, arguments, example.leaves(arguments), min(order_of(example), 1)))
        for other in found[1:]:
            assert all(torch.equal(other[name], value) for name, value in found[0].items())


def test_unknown_order_is_refused(native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_EMULATION_ORDER", "sideways")
    with pytest.raises(KERNEL_ERROR, match="PRED_EMULATION_ORDER must be forward, backward or shuffled, got sideways"):
        ops.sample_bev(torch.zeros(1, 2, 3, 4), torch.zeros(1, 5, 2))


@pytest.mark.parametrize("offsets", [[0, 3, 900], [0, 9, 5], [-3, 5, 2], [7, 7, 7], [2**62, -(2**62), 0]])
def test_wrong_offsets_touch_no_memory_of_others(native: None, offsets: list[int]) -> None:
    """They cannot be checked before the launch. The sanitizer is the judge."""
    samples, rays = 5, torch.tensor(offsets)
    sdf, t, values = torch.linspace(1, -1, samples), torch.arange(float(samples)), torch.rand(samples, 3)
    inv_s, one, two = torch.tensor(2.0), torch.ones(len(offsets) - 1), torch.ones(len(offsets) - 1, 3)
    out = torch.ops.pred.composite_rays(sdf, inv_s, t, values, rays, True, False)
    grads = (None, one, one, two)
    torch.ops.pred.composite_rays_backward(
        *grads, sdf, inv_s, t, values, rays, out[0], out[4], True, False, True, True, True, True
    )
    alpha = torch.ops.pred.sdf_to_alpha(sdf, inv_s, False, rays)
    torch.ops.pred.sdf_to_alpha_backward(alpha, sdf, inv_s, True, True, rays)
    torch.ops.pred.composite_alpha(sdf.sigmoid(), t, values, rays, 0.0, True)
    torch.ops.pred.composite_alpha_backward(*grads, sdf.sigmoid(), t, values, rays, 0.0, True, True, True, True)
    assert out[1].shape == (len(offsets) - 1,)
    points, grid = torch.rand(samples, 3), ([0.1] * 3, [0.0] * 3 + [1.0] * 3, [10] * 3)
    voxels = torch.ops.pred.voxelize(points, rays, *grid)
    assert voxels[1].shape == (samples,) and voxels[2].sum() == samples
    for most in (1, 100):  # per frame
        table, _, counts, slots = torch.ops.pred.voxelize_hard(points, rays, *grid, samples, most)
        assert table.shape[0] >= 1 and counts.sum() == (slots >= 0).sum()
    picked = torch.ops.pred.farthest_point_sample(points, rays, 4, 1)
    assert (picked >= -1).all() and (picked < samples).all()
    queries = (points, rays, torch.rand(6, 3), rays.flip(0))
    for most in (3, 200):
        near, distance = torch.ops.pred.knn(*queries, most)
        assert ((near >= 0) == distance.isfinite()).all() and (near < samples).all()
        listed, counts = torch.ops.pred.ball_query(*queries, 0.7, most)
        assert ((listed >= 0).sum(dim=1) == counts).all() and (listed < samples).all()
