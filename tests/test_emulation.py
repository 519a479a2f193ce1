# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""CUDA kernels on a GPU (`make test-cuda`) or run by the CPU (`make emulate`): what no test of an op asks of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pred import _native, ops
from pred.ops.decode_field import project_bev
from tests.conftest import DEVICE, EMULATED, KERNEL_ERROR, LAUNCHED
from tests.ops.examples import EXAMPLES, Example, Source, Wide, evaluate, order_of
from tests.tolerances import FORWARD, GRADIENT, assert_close, relative_error

pytestmark = pytest.mark.skipif(not LAUNCHED, reason="no CUDA kernels are run here: make emulate")
emulated = pytest.mark.skipif(not EMULATED, reason="the CUDA kernels are not emulated here: make emulate")

ORDERS = ("forward", "backward", "shuffled")


@emulated
@pytest.mark.parametrize("example", EXAMPLES, ids=str)
def test_no_result_depends_on_the_order_of_threads(
    native: None, deterministic: None, example: Example, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a barrier is missing, one of the orders reads what is not yet written."""
    for source in (Source(3, 3), Source(140, 140), Wide(30, 30)):
        arguments = example.arguments(source, torch.float32)
        found = []
        for order in ORDERS:
            monkeypatch.setenv("PRED_EMULATION_ORDER", order)
            found.append(evaluate(example.native, arguments, example.leaves(arguments), min(order_of(example), 1)))
        for other in found[1:]:
            assert all(torch.equal(other[name], value) for name, value in found[0].items())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
@pytest.mark.parametrize("op", ["sample_bev", "sample_volume"])
def test_atomics_give_the_same_gradients(native: None, op: str, dtype: torch.dtype) -> None:
    """Up to the order of sums: samples along rays, of which many in one cell, outside, NaN, and of several maps."""
    axes, generator = (2 if op == "sample_bev" else 3), torch.Generator().manual_seed(0)
    for channels, frames, samples in ((5, 2, 100), (8, 3, 37), (160, 1, 200)):
        map_ = torch.randn(frames, channels, *(6, 7, 5)[:axes], generator=generator).to(dtype)
        steps = torch.linspace(-1.3, 1.3, samples, dtype=torch.float64)[None, :, None] ** 3
        grid = steps * torch.randn(frames, 1, axes, generator=generator)
        grid[:, 10] = torch.nan
        grid = grid.to(torch.float64 if dtype == torch.float64 else torch.float32)
        grad = torch.randn(frames, samples, channels, generator=generator).to(dtype)
        grads = torch.randn(frames, samples, axes, channels, generator=generator).to(dtype)
        of_map, of_grid = torch.randn(map_.shape, generator=generator).to(dtype), torch.randn_like(grid)
        for border in (False, True):
            for name, arguments in {
                "_backward": (grad, map_, grid, border, False, True, False),
                "_with_grad_backward": (grad, grads, map_, grid, border, False, True, False),
                "_double_backward": (of_map, of_grid, grad, map_, grid, border, False, False, True, False),
            }.items():
                backward = getattr(torch.ops.pred, op + name)
                ordered, atomic = (backward(*arguments, deterministic) for deterministic in (True, False))
                for here, there in zip(ordered, atomic, strict=True):
                    assert here.shape == there.shape and torch.equal(here.isnan(), there.isnan()), name
                    # Half precision has no atomics: the same bits
                    assert_close(there.nan_to_num(), here.nan_to_num(), GRADIENT.get(dtype, 0.0), name)


def test_tf32_where_torch_allows_it(native: None, request: pytest.FixtureRequest) -> None:
    """One product of factors rounded to 11 bits in place of three; what is not a number stays none."""
    generator = torch.Generator().manual_seed(0)
    bev, weight = torch.randn(1, 40, 9, 11, generator=generator), torch.randn(24, 40, generator=generator)
    grad = torch.randn(1, 24, 9, 11, generator=generator)
    table = torch.arange(99, dtype=torch.int32)[:, None]
    rows = bev[0].flatten(1).T.contiguous()

    def results() -> list[Tensor]:
        return [
            project_bev(bev, weight),
            *torch.ops.pred.project_bev_backward(grad, bev, weight, True, True, _native.tf32()),
            ops.sparse_conv(rows, weight[:, None], table, table),
        ]

    precise = results()
    request.addfinalizer(lambda: torch.set_float32_matmul_precision("highest"))
    torch.set_float32_matmul_precision("high")
    for here, there in zip(precise, results(), strict=True):
        error = relative_error(there, here)
        assert 1e-5 < error < 1e-3
    exact = torch.einsum("oc,bchw->bohw", weight.double(), bev.double())
    assert relative_error(precise[0], exact) < FORWARD[torch.float32]
    bev[0, 3, 2, 5] = torch.nan
    assert project_bev(bev, weight)[0, :, 2, 5].isnan().all()


def shifted(tensor: Tensor) -> Tensor:
    """Where no access of 16 bytes can begin."""
    return torch.empty(tensor.numel() + 1, dtype=tensor.dtype, device=DEVICE)[1:].view(tensor.shape).copy_(tensor)


def test_tensors_that_begin_anywhere(native: None, deterministic: None) -> None:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    rows, grid, grad, weight = normal(1, 7, 6, 8), normal(1, 30, 2) / 2, normal(1, 30, 8), normal(12, 8)
    sdf, t, values = normal(5, 40), normal(5, 40).abs().cumsum(1), normal(5, 40, 8)
    points, features = normal(50, 5), normal(42, 8)
    table = torch.arange(42, dtype=torch.int32, device=DEVICE)[:, None]
    found, rendered = [], []
    for place in (lambda tensor: tensor.to(DEVICE), shifted):
        bev = place(rows).permute(0, 3, 1, 2).requires_grad_()
        out = ops.sample_bev(bev, place(grid))
        rays = ops.composite_rays(place(sdf), 2.0, place(t), place(values))
        voxels = ops.voxelize(
            place(points)[:, :3], torch.tensor([0, 50], device=DEVICE), [0.5] * 3, [-2.0] * 3 + [2.0] * 3
        )
        results = [out, *torch.autograd.grad(out, bev, place(grad)), rays.weights, rays.depth, *voxels]
        results += [
            project_bev(bev, place(weight)),
            ops.sparse_conv(place(features), place(weight)[:, None], table, table),
        ]
        found.append(results)
        assert rays.values is not None
        rendered.append(rays.values)
    assert_close(rendered[1], rendered[0], FORWARD[torch.float32])  # as many samples at a time as packs of channels fit
    for here, there in zip(*found, strict=True):
        assert here is not None and there is not None and torch.equal(here, there)


def test_atomics_of_samples_that_touch_nothing(native: None) -> None:
    """A whole run of them, at the end of the tensors. The sanitizer is the judge."""
    bev, grid = torch.ones(1, 3, 4, 4), torch.full((1, 16, 2), -3.0)
    grad = torch.ones(1, 16, 3)
    grad_bev, _ = torch.ops.pred.sample_bev_backward(grad, bev, grid, False, False, True, False, False)
    assert not grad_bev.any()


@emulated
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
    boxes = torch.tensor([[0.5, 0.5, 0.5, 9, 9, 9, 0]]).repeat(200, 1)
    for box_offsets in (rays, rays.flip(0)):
        inside = torch.ops.pred.points_in_boxes(points, boxes, rays, box_offsets)
        assert ((inside >= -1) & (inside < 200)).all()
    picked = torch.ops.pred.farthest_point_sample(points, rays, 4, 1)
    assert (picked >= -1).all() and (picked < samples).all()
    queries = (points, rays, torch.rand(6, 3), rays.flip(0))
    for most in (3, 200):
        near, distance = torch.ops.pred.knn(*queries, most)
        assert ((near >= 0) == distance.isfinite()).all() and (near < samples).all()
        listed, counts = torch.ops.pred.ball_query(*queries, 0.7, most)
        assert ((listed >= 0).sum(dim=1) == counts).all() and (listed < samples).all()
