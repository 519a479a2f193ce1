# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from pred.ops import farthest_point_sample, reference
from tests.conftest import KERNEL_ERROR, require_value_checks
from tests.ops.clouds import KINDS, cloud, offsets


def test_hand_computed(backend: str) -> None:
    nan = math.nan
    points = torch.tensor(
        [
            [0.0, 0.0, 0.0, 9.0],  # frame 0
            [1.0, 0.0, 0.0, 9.0],
            [4.0, 0.0, 0.0, nan],  # as far as the next, and before it; further columns do not matter
            [-4.0, 0.0, 0.0, 9.0],
            [nan, 0.0, 0.0, 9.0],
            [0.0, math.inf, 0.0, 9.0],
            [5.0, 5.0, 5.0, 9.0],  # frame 1: two positions
            [5.0, 5.0, 5.0, 9.0],
            [6.0, 5.0, 5.0, 9.0],
            [nan, 0.0, 0.0, 9.0],  # frame 3: nothing to pick; frame 2 is empty
        ]
    )
    samples = farthest_point_sample(points, torch.tensor([0, 6, 9, 9, 10]), 5)
    assert samples.dtype == torch.int64
    assert samples.tolist() == [[0, 2, 3, 1, -1], [6, 8, 6, -1, -1], [-1] * 5, [-1] * 5]
    samples = farthest_point_sample(points, torch.tensor([0, 6, 9, 9, 10]), 3, start=2)
    assert samples.tolist() == [[2, 3, 0], [8, 6, 6], [-1] * 3, [-1] * 3]
    # Frame 0 starts at its first finite point where number 4 is not finite, frame 1 where it has no number 4.
    assert farthest_point_sample(points, torch.tensor([0, 6, 9, 9, 10]), 1, start=4).flatten().tolist() == [
        0,
        6,
        -1,
        -1,
    ]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_native_equals_reference(native: None, dtype: torch.dtype, kind: str) -> None:
    for num_points, frames, num_samples, start in [(1, 1, 3, 0), (31, 1, 40, 5), (33, 1, 20, 32), (700, 5, 90, 3)]:
        points, batch = cloud(kind, num_points, dtype), offsets(num_points, frames)
        expected = reference.farthest_point_sample(points, batch, num_samples, start)
        assert torch.equal(farthest_point_sample(points, batch, num_samples, start), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_large_clouds_at_every_level(level: str, kind: str) -> None:
    points, batch = cloud(kind, 20000), torch.tensor([0, 9000, 20000])
    expected = reference.farthest_point_sample(points, batch, 60)
    assert torch.equal(farthest_point_sample(points, batch, 60), expected)
    assert torch.equal(farthest_point_sample(points.double(), batch, 30)[:, :1], expected[:, :1])


def test_many_samples(level: str) -> None:
    points = cloud("lidar", 150000)  # a tree of four levels
    sparse = points[::300].contiguous()
    batch = torch.tensor([0, len(sparse)])
    expected = reference.farthest_point_sample(sparse, batch, len(sparse))
    assert torch.equal(farthest_point_sample(sparse, batch, len(sparse)), expected)
    batch = torch.tensor([0, len(points)])
    expected = reference.farthest_point_sample(points, batch, 20)
    assert torch.equal(farthest_point_sample(points, batch, 300)[:, :20], expected)


def test_bitwise_equal_for_any_thread_count(native: None) -> None:
    points, batch = cloud("lidar", 60001), torch.tensor([0, 30000, 30000, 45000, 60001])
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(farthest_point_sample(points, batch, 200, 17))
    assert all(torch.equal(result, results[0]) for result in results)


def test_memory_layouts_and_columns_agree(backend: str) -> None:
    points, batch = cloud("normal", 300), torch.tensor([0, 100, 300])
    expected = farthest_point_sample(points, batch, 50)
    wide = torch.cat([points, torch.full((300, 2), math.nan)], dim=1)
    assert torch.equal(farthest_point_sample(wide, batch.repeat_interleave(2)[::2], 50), expected)
    assert torch.equal(farthest_point_sample(points.t().contiguous().t(), batch, 50), expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_points_are_compared_in_float32(backend: str, dtype: torch.dtype) -> None:
    points, batch = cloud("normal", 500, dtype), torch.tensor([0, 500])
    assert torch.equal(farthest_point_sample(points, batch, 99), farthest_point_sample(points.float(), batch, 99))


@pytest.mark.parametrize("batch", [[0], [0, 0], [0, 0, 0]])
def test_no_points(backend: str, batch: list[int]) -> None:
    samples = farthest_point_sample(torch.zeros(0, 3), torch.tensor(batch), 4)
    assert samples.shape == (len(batch) - 1, 4) and (samples == -1).all()


def test_no_samples(backend: str) -> None:
    assert farthest_point_sample(torch.zeros(5, 3), torch.tensor([0, 5]), 0).shape == (1, 0)


def test_errors(backend: str) -> None:
    points, batch = cloud("normal", 10), torch.tensor([0, 10])
    with pytest.raises(ValueError, match=r"sample: points must have shape \[N, C\] with C >= 3, got \[10, 2\]"):
        farthest_point_sample(points[:, :2], batch, 3)
    with pytest.raises(TypeError, match="farthest_point_sample: points must be float32 or .*, got int64"):
        farthest_point_sample(points.long(), batch, 3)
    with pytest.raises(TypeError, match="farthest_point_sample: batch_offsets must be int64, got int32"):
        farthest_point_sample(points, batch.int(), 3)
    for wrong in ([], [0], [1, 10], [0, 9], [0, 7, 5, 10], [0, -1, 10]):
        with pytest.raises(ValueError, match="farthest_point_sample: batch_offsets must"):
            farthest_point_sample(points, torch.tensor(wrong, dtype=torch.int64), 3)
    with pytest.raises(ValueError, match="farthest_point_sample: num_samples must be at least 0, got -1"):
        farthest_point_sample(points, batch, -1)
    with pytest.raises(ValueError, match="farthest_point_sample: start must be at least 0, got -2"):
        farthest_point_sample(points, batch, 3, start=-2)


def test_direct_calls_are_checked(native: None) -> None:
    points, call = cloud("normal", 10), torch.ops.pred.farthest_point_sample
    with pytest.raises(KERNEL_ERROR, match=r"farthest_point_sample: points must have shape \[N, 3\], got \[10, 2\]"):
        call(points[:, :2], torch.tensor([0, 10]), 3, 0)
    with pytest.raises(KERNEL_ERROR, match="farthest_point_sample: start must not be negative, got -1"):
        call(points, torch.tensor([0, 10]), 3, -1)
    require_value_checks("native")
    with pytest.raises(KERNEL_ERROR, match="farthest_point_sample: batch_offsets must ascend from 0 to N=10"):
        call(points, torch.tensor([0, 12]), 3, 0)
