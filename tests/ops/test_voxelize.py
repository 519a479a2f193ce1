# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pred.ops import Voxels, reference, segment_reduce, voxelize
from tests.conftest import KERNEL_ERROR, require_value_checks

RANGE = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
SIZES = [(0.1, 0.1, 0.2), (0.2, 0.2, 8.0), (0.075, 0.15, 0.4)]
RANGES = [RANGE, RANGE, (-54.0, -54.0, -5.0, 54.0, 54.0, 3.0)]


def cloud(num_points: int = 3000, columns: int = 5, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Points around the sensor, of which some lie outside RANGE."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(num_points, columns, generator=generator, dtype=torch.float64)
    return (points * torch.tensor([20.0, 20.0, 2.0] + [1.0] * (columns - 3), dtype=torch.float64)).to(dtype)


def same(actual: Voxels, expected: Voxels) -> bool:
    return all(a.dtype == e.dtype == torch.int64 and torch.equal(a, e) for a, e in zip(actual, expected, strict=True))


def test_hand_computed(backend: str) -> None:
    # 4 x 2 x 2 voxels (x, y, z) of 1 x 1 x 0.5.
    points = torch.tensor(
        [
            [3.5, 1.5, 0.75, 9.0],
            [0.0, -0.0, 0.0, math.nan],  # the lower corner is inside; further columns do not matter
            [4.0, 0.0, 0.0, 0.0],  # upper bound
            [1.0, 0.5, 0.25, 0.0],  # on the face between x = 0 and 1
            [0.5, 2.0, 0.0, 0.0],  # upper bound
            [1.5, 0.5, 0.5, 0.0],  # on the face between z = 0 and 1
            [0.9, 0.9, 0.4, 0.0],
            [-0.1, 0.0, 0.0, 0.0],  # frame 1 (frame 0 has the seven before)
            [0.5, 0.5, 0.5, 0.0],
            [0.5, math.nan, 0.5, 0.0],  # frame 3; frame 2 is empty
            [math.inf, 0.5, 0.5, 0.0],
            [0.5, 0.5, -math.inf, 0.0],
            [0.2, 0.2, 0.2, 0.0],
        ]
    )
    voxels = voxelize(points, torch.tensor([0, 7, 9, 9, 13]), (1.0, 1.0, 0.5), (0.0, 0.0, 0.0, 4.0, 2.0, 1.0))
    expected = [[0, 0, 0, 0], [0, 0, 0, 1], [0, 1, 0, 1], [0, 1, 1, 3], [1, 1, 0, 0], [3, 0, 0, 0]]
    assert voxels.coords.tolist() == expected
    assert voxels.point_to_voxel.tolist() == [3, 0, -1, 1, -1, 2, 0, -1, 4, -1, -1, -1, 5]
    assert voxels.counts.tolist() == [2, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("columns", [3, 5])
@pytest.mark.parametrize("size,point_range", list(zip(SIZES, RANGES, strict=True)))
def test_native_equals_reference(
    native: None,
    size: tuple[float, ...],
    point_range: tuple[float, ...],
    columns: int,
    dtype: torch.dtype,
) -> None:
    points = cloud(3000, columns, dtype)
    offsets = torch.tensor([0, 0, 1000, 1000, 2900, 3000, 3000])
    expected = reference.voxelize(points, offsets, size, point_range)
    assert 0 < expected.coords.shape[0] < 3000 and (expected.point_to_voxel == -1).any()
    assert same(voxelize(points, offsets, size, point_range), expected)
    strided = torch.stack([points, points + 1], dim=2)[..., 0]
    assert not strided.is_contiguous() and same(voxelize(strided, offsets, size, point_range), expected)
    transposed = points.t().contiguous().t()
    assert same(voxelize(transposed, offsets, size, point_range), expected)
    assert same(voxelize(points[:, :3], offsets.repeat_interleave(2)[::2], size, point_range), expected)


def edges(dtype: torch.dtype, size: float, low: float, high: float) -> Tensor:
    """Every voxel edge as written, computed in ``dtype`` and rounded from float64, and its two neighbours."""
    steps = torch.arange(-1, round((high - low) / size) + 2)
    exact = (low + steps.double() * size).to(dtype)
    rounded = torch.tensor(low, dtype=dtype) + steps.to(dtype) * torch.tensor(size, dtype=dtype)
    values = torch.cat([exact, rounded])
    up, down = values.new_tensor(math.inf), values.new_tensor(-math.inf)
    return torch.cat([values, values.nextafter(up), values.nextafter(down)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "size,low,high", [(0.1, -51.2, 51.2), (0.075, -54.0, 54.0), (0.05, 0.0, 70.4), (0.3, -0.3, 3.0)]
)
def test_edges_at_every_level(level: str, size: float, low: float, high: float, dtype: torch.dtype) -> None:
    x = edges(dtype, size, low, high)
    points = torch.stack([x, x.flip(0), x.roll(7)], dim=1)
    arguments = (torch.tensor([0, len(x)]), (size,) * 3, (low,) * 3 + (high,) * 3)
    actual, expected = voxelize(points, *arguments), reference.voxelize(points, *arguments)
    assert same(actual, expected)
    assert actual.coords.min() == 0 and actual.coords.max() == round((high - low) / size) - 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quotient_that_rounds_up_to_the_grid_size(backend: str, dtype: torch.dtype) -> None:
    low, high, size, cells = -1.0, 1.0, 0.1, 20
    point = torch.tensor(high, dtype=dtype).nextafter(torch.tensor(0.0, dtype=dtype))
    assert (point - low) / torch.tensor(size, dtype=dtype) == cells  # the case is what its name says
    voxels = voxelize(point.repeat(1, 3), torch.tensor([0, 1]), (size,) * 3, (low,) * 3 + (high,) * 3)
    assert voxels.coords.tolist() == [[0, cells - 1, cells - 1, cells - 1]]
    upper = torch.full((1, 3), high, dtype=dtype)
    assert voxelize(upper, torch.tensor([0, 1]), (size,) * 3, (low,) * 3 + (high,) * 3).point_to_voxel.tolist() == [-1]


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_points_of_half_precision_are_compared_in_float32(level: str, dtype: torch.dtype) -> None:
    points, offsets = cloud(3000, dtype=dtype), torch.tensor([0, 1000, 3000])
    for size, point_range in [*zip(SIZES, RANGES, strict=True), ((0.0001,) * 3, RANGE)]:
        expected = reference.voxelize(points.float(), offsets, size, point_range)
        assert same(voxelize(points, offsets, size, point_range), expected)
        assert same(voxelize(points.t().contiguous().t(), offsets, size, point_range), expected)
        assert same(reference.voxelize(points, offsets, size, point_range), expected)


def test_awkward_coordinates_at_every_level(level: str) -> None:
    values = [
        math.nan,
        math.inf,
        -math.inf,
        1e30,
        -1e30,
        3.4e38,
        -0.0,
        0.0,
        1e-45,
        -1e-45,
        51.2,
        -51.2,
        2.9999998,
        -5.0,
    ]
    points = torch.cartesian_prod(*[torch.tensor(values)] * 3)
    for size, point_range in zip(SIZES, RANGES, strict=True):
        arguments = (torch.tensor([0, 100, len(points)]), size, point_range)
        assert same(voxelize(points, *arguments), reference.voxelize(points, *arguments))
        around_zero = (torch.tensor([0, len(points)]), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 4.0, 4.0, 4.0))
        assert same(voxelize(points, *around_zero), reference.voxelize(points, *around_zero))


@pytest.mark.parametrize(
    "point_range", [(0.0,) * 3 + (3e38,) * 3, (-3e38,) * 3 + (3e38,) * 3, (0.0,) * 3 + (2e-44,) * 3]
)
def test_sizes_at_the_limits_of_float32(native: None, point_range: tuple[float, ...]) -> None:
    size = ((point_range[3] - point_range[0]) / 8,) * 3
    points = torch.linspace(0, 1, 60)[:, None].expand(60, 3) * point_range[3]
    arguments = (torch.tensor([0, 60]), size, point_range)
    assert same(voxelize(points, *arguments), reference.voxelize(points, *arguments))


@pytest.mark.parametrize("num_points", [300, 40000])
def test_keys_of_more_than_32_bits(native: None, num_points: int) -> None:
    points = cloud(num_points)
    points[num_points // 2 :, :3] = points[: num_points - num_points // 2, :3]
    offsets = torch.tensor([0, num_points // 2, num_points])
    for size in [(0.02, 0.02, 0.01), (0.0001, 0.0001, 0.0001)]:  # 34 and 58 key bits
        assert same(voxelize(points, offsets, size, RANGE), reference.voxelize(points, offsets, size, RANGE))


@pytest.mark.parametrize("size", SIZES[:2])
def test_bitwise_equal_for_any_thread_count(native: None, size: tuple[float, ...]) -> None:
    points, offsets = cloud(70001), torch.tensor([0, 20000, 20000, 70001])
    points[30000:60000] = points[30000]  # one voxel across several blocks of the sort
    expected = reference.voxelize(points, offsets, size, RANGE)
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        assert same(voxelize(points, offsets, size, RANGE), expected)


@pytest.mark.parametrize("columns", [3, 5])
@pytest.mark.parametrize("offsets", [[0], [0, 0], [0, 0, 0]])
def test_no_points(backend: str, offsets: list[int], columns: int) -> None:
    voxels = voxelize(torch.zeros(0, columns), torch.tensor(offsets), SIZES[0], RANGE)
    assert voxels.coords.shape == (0, 4) and voxels.point_to_voxel.shape == (0,) and voxels.counts.shape == (0,)
    assert all(output.dtype == torch.int64 for output in voxels)


def test_all_points_outside(backend: str) -> None:
    points = torch.full((7, 5), 100.0)
    voxels = voxelize(points, torch.tensor([0, 3, 7]), SIZES[0], RANGE)
    assert voxels.coords.shape == (0, 4) and voxels.counts.shape == (0,)
    assert voxels.point_to_voxel.tolist() == [-1] * 7


@torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True)
def test_voxel_means_compile_to_one_graph(native: None) -> None:
    def mean_per_pillar(points: Tensor, offsets: Tensor) -> Tensor:
        voxels = voxelize(points, offsets, SIZES[1], RANGE)
        return segment_reduce(points, voxels.point_to_voxel, voxels.coords.shape[0], "mean")

    compiled = torch.compile(mean_per_pillar, fullgraph=True, backend="aot_eager")
    for num_points in (40, 90):
        points, offsets = cloud(num_points), torch.tensor([0, 10, num_points])
        assert torch.equal(compiled(points, offsets), mean_per_pillar(points, offsets))


def test_errors(backend: str) -> None:
    points, offsets = cloud(10), torch.tensor([0, 10])
    with pytest.raises(ValueError, match=r"voxelize: points must have shape \[N, C\] with C >= 3, got \[10, 2\]"):
        voxelize(points[:, :2], offsets, SIZES[0], RANGE)
    with pytest.raises(TypeError, match="voxelize: points must be float32 or .* or float16, got int64"):
        voxelize(points.long(), offsets, SIZES[0], RANGE)
    with pytest.raises(TypeError, match="voxelize: batch_offsets must be int64, got int32"):
        voxelize(points, offsets.int(), SIZES[0], RANGE)
    with pytest.raises(ValueError, match=r"voxelize: batch_offsets must have shape \[B \+ 1\], got \[1, 2\]"):
        voxelize(points, offsets[None], SIZES[0], RANGE)
    for wrong in ([], [0], [1, 10], [0, 9], [0, 11], [0, 7, 5, 10], [0, 12, 10], [0, -1, 10]):
        with pytest.raises(ValueError, match="voxelize: batch_offsets must"):
            voxelize(points, torch.tensor(wrong, dtype=torch.int64), SIZES[0], RANGE)
    with pytest.raises(ValueError, match=r"batch_offsets must ascend from 0 to N=10, got \[0, 7, 5, 10\]"):
        voxelize(points, torch.tensor([0, 7, 5, 10]), SIZES[0], RANGE)
    with pytest.raises(TypeError, match="voxelize: voxel_size must hold 3 numbers, got Tensor"):
        voxelize(points, offsets, torch.tensor(0.3), RANGE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="voxelize: voxel_size must hold 3 finite numbers, got 17179869184"):
        voxelize(points, offsets, torch.ones(1).expand(1 << 34), RANGE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="voxelize: voxel_size must hold 3 finite numbers, got"):
        voxelize(points, offsets, (0.1, 0.1), RANGE)
    with pytest.raises(ValueError, match="voxelize: point_range must hold 6 finite numbers, got"):
        voxelize(points, offsets, SIZES[0], (*RANGE[:5], math.nan))
    for bad in (0.0, -0.1):
        with pytest.raises(ValueError, match=f"voxelize: voxel_size must be positive, got {bad} along y"):
            voxelize(points, offsets, (0.1, bad, 0.1), RANGE)
    with pytest.raises(ValueError, match="voxelize: point_range must have min < max, got 3.0 and 3.0 along z"):
        voxelize(points, offsets, SIZES[0], (*RANGE[:2], 3.0, *RANGE[3:]))
    with pytest.raises(ValueError, match="must be a whole multiple of voxel_size, got 341.333 voxels .* along x"):
        voxelize(points, offsets, (0.3, 0.1, 0.2), RANGE)
    with pytest.raises(ValueError, match="must be a whole multiple of voxel_size, got 0.08 voxels .* along z"):
        voxelize(points, offsets, (0.1, 0.1, 100.0), RANGE)
    with pytest.raises(ValueError, match="voxel_size must give at most 2.30 voxels per axis, got 1.024e"):
        voxelize(points, offsets, (1e-10, 0.1, 0.1), RANGE)
    # Exactly 2^21 * 2^21 * 2^20 voxels fit once, not twice.
    edge = 2.0**-20
    tight = ((edge, edge, edge), (0.0, 0.0, 0.0, 2.0, 2.0, 1.0))
    assert voxelize(points, offsets, *tight).point_to_voxel.shape == (10,)
    with pytest.raises(ValueError, match=r"B nz ny nx <= 2\^62 .* a grid of 2097152 x 2097152 x 1048576 for 2 frames"):
        voxelize(points, torch.tensor([0, 5, 10]), *tight)


def test_direct_calls_are_checked(native: None) -> None:
    points, size, point_range = cloud(10), list(SIZES[1]), list(RANGE)
    call = torch.ops.pred.voxelize
    with pytest.raises(KERNEL_ERROR, match=r"voxelize: grid_size must lie in \[1, 2\^30\], got 0"):
        call(points, torch.tensor([0, 10]), size, point_range, [512, 0, 1])
    for wrong_size in (0.0, -0.1, math.nan):
        with pytest.raises(KERNEL_ERROR, match="voxelize: voxel_size must be positive, got"):
            call(points, torch.tensor([0, 10]), [0.1, wrong_size, 8.0], point_range, [512, 512, 1])
    with pytest.raises(KERNEL_ERROR, match="must hold 3, 6 and 3 numbers, got 3, 6 and 2"):
        call(points, torch.tensor([0, 10]), size, point_range, [512, 512])
    with pytest.raises(KERNEL_ERROR, match=r"grid_size must give at most 2\^62 voxels in all frames, got 2\^63"):
        call(points, torch.tensor([0, 10]), size, point_range, [2**30, 2**30, 8])
    require_value_checks("native")
    for wrong in ([], [0], [1, 10], [0, 11], [0, 20, 10]):
        with pytest.raises(KERNEL_ERROR, match="voxelize: batch_offsets must ascend from 0 to N=10"):
            call(points, torch.tensor(wrong, dtype=torch.int64), size, point_range, [512, 512, 1])
