# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from benchmarks.cases import POINT_RANGE_M, lidar_points
from pred.ops import HardVoxels, reference, voxelize_hard
from tests.conftest import KERNEL_ERROR, LAUNCHED, require_value_checks

RANGE = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
SIZES = [(0.1, 0.1, 0.2), (0.2, 0.2, 8.0), (3.2, 1.6, 0.4)]
HALF = [torch.bfloat16, torch.float16]


def cloud(num_points: int = 3000, columns: int = 5, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Points around the sensor, of which some lie outside RANGE."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(num_points, columns, generator=generator, dtype=torch.float64)
    return (points * torch.tensor([20.0, 20.0, 2.0] + [1.0] * (columns - 3), dtype=torch.float64)).to(dtype)


def same(actual: HardVoxels, expected: HardVoxels) -> bool:
    assert actual.coords.dtype == actual.counts.dtype == torch.int64
    return all(
        a.dtype == e.dtype and torch.equal(a.detach(), e.detach()) for a, e in zip(actual, expected, strict=True)
    )


def by_definition(
    points: Tensor, offsets: Sequence[int], size: Sequence[float], bounds: Sequence[float], limits: tuple[int, int]
) -> HardVoxels:
    """One point after the other, as PointToVoxel does; the voxel of a point in the arithmetic of its dtype."""
    max_points, max_voxels = limits
    voxels: list[list[Tensor]] = []
    coords: list[list[int]] = []
    low, edge = points.new_tensor(bounds[:3]), points.new_tensor(size)
    for frame, (begin, end) in enumerate(zip(offsets, offsets[1:], strict=False)):
        number: dict[tuple[int, ...], int] = {}
        for point in points[begin:end]:
            if not all(bounds[i] <= point[i] < points.new_tensor(bounds[i + 3]) for i in range(3)):
                continue
            cell = tuple(int(index) for index in ((point[:3] - low) / edge).floor().flip(0))
            if cell not in number:
                if len(number) == max_voxels:
                    continue
                number[cell] = len(voxels)
                voxels.append([])
                coords.append([frame, *cell])
            if len(voxels[number[cell]]) < max_points:
                voxels[number[cell]].append(point)
    table = points.new_zeros(len(voxels), max_points, points.shape[1])
    for row, kept in enumerate(voxels):
        table[row, : len(kept)] = torch.stack(kept)
    counts = torch.tensor([len(kept) for kept in voxels], dtype=torch.int64)
    return HardVoxels(table, torch.tensor(coords, dtype=torch.int64).view(-1, 4), counts)


def test_hand_computed(backend: str) -> None:
    # 4 x 2 x 2 voxels (x, y, z) of 1 x 1 x 0.5; two points per voxel, two voxels per frame.
    points = torch.tensor(
        [
            [3.5, 1.5, 0.75, 1.0],  # first voxel
            [4.0, 0.0, 0.0, 2.0],  # outside
            [0.5, 0.5, 0.25, 3.0],  # second voxel
            [1.5, 0.5, 0.25, 4.0],  # third voxel: dropped
            [3.1, 1.1, 0.5, 5.0],
            [3.2, 1.2, 0.6, 6.0],  # third point of the first voxel: dropped
            [1.6, 0.5, 0.25, 7.0],  # frame 2: what frame 0 dropped does not matter here
            [math.nan, 0.5, 0.25, 8.0],
            [0.5, 0.5, 0.25, math.nan],  # further columns do not matter
        ],
        requires_grad=True,
    )
    voxels, coords, counts = voxelize_hard(
        points, torch.tensor([0, 6, 6, 9]), (1.0, 1.0, 0.5), (0.0, 0.0, 0.0, 4.0, 2.0, 1.0), 2, 2
    )
    assert coords.tolist() == [[0, 1, 1, 3], [0, 0, 0, 0], [2, 0, 0, 1], [2, 0, 0, 0]]
    assert counts.tolist() == [2, 1, 1, 1]
    assert voxels[..., 0].nan_to_num(9.0).tolist() == [
        [points[0, 0].item(), points[4, 0].item()],
        [0.5, 0.0],
        [points[6, 0].item(), 0.0],
        [0.5, 0.0],
    ]
    assert voxels[:3, :, 3].tolist() == [[1.0, 5.0], [3.0, 0.0], [7.0, 0.0]] and voxels[3, 0, 3].isnan()
    (grad,) = torch.autograd.grad(voxels, points, torch.arange(1.0, 33.0).view(4, 2, 4))
    assert grad[:, 0].tolist() == [1.0, 0.0, 9.0, 0.0, 5.0, 0.0, 17.0, 0.0, 25.0]


@pytest.mark.parametrize("limits", [(1, 1), (3, 7), (5, 40), (100, 10000)])
def test_by_definition(backend: str, limits: tuple[int, int]) -> None:
    points, offsets = cloud(400), [0, 150, 150, 151, 400]
    points[::7] = points[::7].nan_to_num() * 0.01  # crowded voxels
    size = (1.6, 3.2, 2.0)
    expected = by_definition(points, offsets, size, RANGE, limits)
    assert same(voxelize_hard(points, torch.tensor(offsets), size, RANGE, *limits), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, *HALF])
@pytest.mark.parametrize("columns", [3, 4, 5, 7])
@pytest.mark.parametrize("size", SIZES)
def test_native_equals_reference(native: None, size: tuple[float, ...], columns: int, dtype: torch.dtype) -> None:
    points = cloud(3000, columns, dtype)
    offsets = torch.tensor([0, 0, 1000, 1000, 2900, 3000, 3000])
    for limits in ((1, 3000), (4, 500), (20, 70)):
        expected = reference.voxelize_hard(points, offsets, size, RANGE, *limits)
        assert expected.counts.max() <= limits[0] and expected.counts.min() >= 1
        assert same(voxelize_hard(points, offsets, size, RANGE, *limits), expected)
        strided = torch.stack([points, points + 1], dim=2)[..., 0]
        assert not strided.is_contiguous() and same(voxelize_hard(strided, offsets, size, RANGE, *limits), expected)
        transposed = points.t().contiguous().t()
        assert same(voxelize_hard(transposed, offsets, size, RANGE, *limits), expected)


@pytest.mark.parametrize("size,limits", [(SIZES[0], (10, 60000)), (SIZES[1], (20, 30000)), (SIZES[0], (5, 9000))])
def test_levels_and_threads_on_lidar_points(level: str, size: tuple[float, ...], limits: tuple[int, int]) -> None:
    points, offsets = lidar_points(40001), torch.tensor([0, 10000, 10000, 40001])
    expected = reference.voxelize_hard(points, offsets, size, POINT_RANGE_M, *limits)
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        assert same(voxelize_hard(points, offsets, size, POINT_RANGE_M, *limits), expected)


def test_one_voxel_across_blocks_of_the_sort(native: None) -> None:
    points, offsets = cloud(70001), torch.tensor([0, 70001])
    points[20000:60000] = points[20000]
    for size in (*SIZES, (0.0001, 0.0001, 0.0001)):  # the last needs keys of more than 64 bits
        for limits in ((3, 500), (50000, 3)):
            expected = reference.voxelize_hard(points[:, :3], offsets, size, RANGE, *limits)
            assert same(voxelize_hard(points[:, :3], offsets, size, RANGE, *limits), expected)


def test_points_of_half_precision_are_compared_in_float32(backend: str) -> None:
    for dtype in HALF:
        points, offsets = cloud(500, dtype=dtype), torch.tensor([0, 500])
        voxels = voxelize_hard(points, offsets, SIZES[0], RANGE, 3, 400)
        wide = voxelize_hard(points.float(), offsets, SIZES[0], RANGE, 3, 400)
        assert voxels.voxels.dtype == dtype and torch.equal(voxels.voxels.float(), wide.voxels)
        assert torch.equal(voxels.coords, wide.coords) and torch.equal(voxels.counts, wide.counts)
        points.requires_grad_()
        voxelize_hard(points, offsets, SIZES[0], RANGE, 3, 400).voxels.sum().backward()
        assert points.grad is not None and points.grad.dtype == dtype
        assert points.grad.sum(dtype=torch.float32) == 5 * voxels.counts.sum()


def spconv_voxels(
    points: Tensor, size: Sequence[float], limits: tuple[int, int], bounds: Sequence[float] = RANGE
) -> tuple[Tensor, Tensor, Tensor]:
    utils = pytest.importorskip("spconv.pytorch.utils", reason="spconv is not installed")
    make = utils.PointToVoxel(list(size), list(bounds), points.shape[1], limits[1], limits[0])
    voxels, coords, counts = make(points)
    return voxels.clone(), coords.long(), counts.long()


@pytest.mark.parametrize("limits", [(1, 200000), (10, 60000), (20, 3000), (5, 100)])
@pytest.mark.parametrize("size", SIZES)
def test_equals_spconv(backend: str, size: tuple[float, ...], limits: tuple[int, int]) -> None:
    for points in (cloud(5000), lidar_points(20000), cloud(3000, columns=4), cloud(0)):
        expected = spconv_voxels(points, size, limits)
        voxels, coords, counts = voxelize_hard(points, torch.tensor([0, len(points)]), size, RANGE, *limits)
        assert torch.equal(coords[:, 1:], expected[1]) and not coords[:, 0].any()
        assert torch.equal(voxels, expected[0]) and torch.equal(counts, expected[2])


def test_difference_from_spconv_at_the_upper_bound(backend: str) -> None:
    size, bounds = (0.1,) * 3, (-1.0,) * 3 + (1.0,) * 3
    below = torch.tensor(1.0).nextafter(torch.tensor(0.0))
    assert (below + 1.0) / torch.tensor(0.1) == 20  # just below the bound, and the quotient rounds up
    point = torch.stack([below, torch.zeros(()), torch.zeros(())])[None]
    assert voxelize_hard(point, torch.tensor([0, 1]), size, bounds, 1, 1).coords.tolist() == [[0, 10, 10, 19]]
    assert spconv_voxels(point, size, (1, 1), bounds)[1].shape == (0, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_equal_the_reference(native: None, dtype: torch.dtype) -> None:
    points, offsets = cloud(5000, dtype=dtype).requires_grad_(), torch.tensor([0, 2000, 5000])
    results = []
    for function in (voxelize_hard, reference.voxelize_hard):
        voxels = function(points, offsets, SIZES[2], RANGE, 6, 300).voxels
        cotangent = torch.linspace(-1, 2, voxels.numel(), dtype=dtype).view(voxels.shape).requires_grad_()
        (first,) = torch.autograd.grad(voxels, points, cotangent, create_graph=True)
        (second,) = torch.autograd.grad(first.pow(3).sum(), cotangent)
        results.append((first.detach(), second))
    for actual, expected in zip(*results, strict=True):
        assert torch.equal(actual, expected)


def test_gradcheck(backend: str) -> None:
    points, offsets = cloud(14, 3, torch.float64).requires_grad_(), torch.tensor([0, 5, 14])

    def voxels(points: Tensor) -> Tensor:
        return voxelize_hard(points, offsets, (12.8, 12.8, 8.0), RANGE, 2, 5).voxels

    assert torch.autograd.gradcheck(voxels, points)
    assert torch.autograd.gradgradcheck(lambda points: voxels(points * points.sin()), points)


def test_gradient_is_equal_for_any_thread_count(level: str) -> None:
    points, offsets = cloud(40000).requires_grad_(), torch.tensor([0, 40000])
    gradients = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        voxels = voxelize_hard(points, offsets, SIZES[2], RANGE, 5, 2000).voxels
        gradients.append(torch.autograd.grad(voxels.square().sum(), points)[0])
    assert all(torch.equal(gradient, gradients[0]) for gradient in gradients)


@pytest.mark.parametrize("columns", [3, 5])
@pytest.mark.parametrize("offsets", [[0], [0, 0], [0, 0, 0]])
def test_no_points(backend: str, offsets: list[int], columns: int) -> None:
    points = torch.zeros(0, columns, requires_grad=True)
    voxels = voxelize_hard(points, torch.tensor(offsets), SIZES[0], RANGE, 7, 9)
    assert voxels.voxels.shape == (0, 7, columns) and voxels.coords.shape == (0, 4) and voxels.counts.shape == (0,)
    voxels.voxels.sum().backward()
    assert points.grad is not None and points.grad.shape == (0, columns)


def test_all_points_outside(backend: str) -> None:
    points = torch.full((7, 5), 100.0, requires_grad=True)
    voxels = voxelize_hard(points, torch.tensor([0, 3, 7]), SIZES[0], RANGE, 2, 9)
    assert voxels.voxels.shape == (0, 2, 5) and voxels.counts.shape == (0,)
    voxels.voxels.sum().backward()
    assert points.grad is not None and not points.grad.any()


def test_errors(backend: str) -> None:
    points, offsets = cloud(10), torch.tensor([0, 10])
    with pytest.raises(ValueError, match=r"voxelize_hard: points must have shape \[N, C\] with C >= 3, got \[10, 2\]"):
        voxelize_hard(points[:, :2], offsets, SIZES[0], RANGE, 1, 1)
    with pytest.raises(TypeError, match="voxelize_hard: points must be float32 or .*, got int64"):
        voxelize_hard(points.long(), offsets, SIZES[0], RANGE, 1, 1)
    with pytest.raises(TypeError, match="voxelize_hard: batch_offsets must be int64, got int32"):
        voxelize_hard(points, offsets.int(), SIZES[0], RANGE, 1, 1)
    for wrong in ([], [0], [1, 10], [0, 9], [0, 7, 5, 10], [0, -1, 10]):
        with pytest.raises(ValueError, match="voxelize_hard: batch_offsets must"):
            voxelize_hard(points, torch.tensor(wrong, dtype=torch.int64), SIZES[0], RANGE, 1, 1)
    with pytest.raises(ValueError, match="voxelize_hard: max_points must be at least 1, got 0"):
        voxelize_hard(points, offsets, SIZES[0], RANGE, 0, 1)
    with pytest.raises(ValueError, match="voxelize_hard: max_voxels must be at least 1, got -3"):
        voxelize_hard(points, offsets, SIZES[0], RANGE, 1, -3)
    with pytest.raises(ValueError, match="voxelize_hard: voxel_size must be positive, got 0.0 along y"):
        voxelize_hard(points, offsets, (0.1, 0.0, 0.1), RANGE, 1, 1)


def test_direct_calls_are_checked(native: None) -> None:
    points, size, bounds = cloud(10), list(SIZES[1]), list(RANGE)
    forward, backward = torch.ops.pred.voxelize_hard, torch.ops.pred.voxelize_hard_backward
    with pytest.raises(KERNEL_ERROR, match="voxelize_hard: max_points must be at least 1, got 0"):
        forward(points, torch.tensor([0, 10]), size, bounds, [512, 512, 1], 0, 1)
    require_value_checks("native")
    for wrong in ([], [0], [1, 10], [0, 20, 10]):
        with pytest.raises(KERNEL_ERROR, match="voxelize_hard: batch_offsets must ascend from 0 to N=10"):
            forward(points, torch.tensor(wrong, dtype=torch.int64), size, bounds, [512, 512, 1], 1, 1)
    with pytest.raises(KERNEL_ERROR, match="voxelize_hard_backward: point_to_slot must be less than 6, got 6"):
        backward(torch.zeros(2, 3, 5), torch.tensor([0, -1, 6]))


@pytest.mark.skipif(not LAUNCHED, reason="slots are checked")
def test_unchecked_slots_count_as_none(native: None) -> None:
    grad = torch.rand(2, 3, 5)
    out = torch.ops.pred.voxelize_hard_backward(grad, torch.tensor([4, 6, -1, -7, 2**62, -(2**62), 0]))
    assert torch.equal(out, torch.cat([grad[1, 1:2], torch.zeros(5, 5), grad[0, :1]]))
