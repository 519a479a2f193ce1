# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from pred.ops import Neighbors, knn, reference
from tests.conftest import KERNEL_ERROR, require_value_checks
from tests.ops.clouds import KINDS, cloud, offsets


def same(actual: Neighbors, expected: Neighbors) -> bool:
    return all(a.dtype == e.dtype and torch.equal(a, e) for a, e in zip(actual, expected, strict=True))


def test_hand_computed(backend: str) -> None:
    nan, inf = math.nan, math.inf
    points = torch.tensor(
        [
            [0.0, 0.0, 0.0, nan],  # frame 0; further columns do not matter
            [2.0, 0.0, 0.0, 9.0],
            [0.0, 2.0, 0.0, 9.0],  # as near to the first query as the one before
            [nan, 0.0, 0.0, 9.0],
            [0.0, 0.0, 3.0, 9.0],
            [1.0, 1.0, 1.0, 9.0],  # frame 2
        ]
    )
    queries = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, inf, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 3.0]])
    found = knn(points, torch.tensor([0, 5, 5, 6]), queries, torch.tensor([0, 3, 4, 5]), 3)
    assert found.indices.tolist() == [[0, 1, 2], [4, 0, 1], [-1, -1, -1], [-1, -1, -1], [5, -1, -1]]
    assert found.squared_distance.tolist() == [[0, 4, 4], [1, 4, 8], [inf] * 3, [inf] * 3, [4, inf, inf]]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_native_equals_reference(native: None, dtype: torch.dtype, kind: str) -> None:
    for num_points, frames in [(1, 1), (31, 1), (33, 2), (700, 5)]:
        points, batch = cloud(kind, num_points, dtype), offsets(num_points, frames)
        other = cloud(kind, 37, dtype, seed=1)
        for queries, query_batch in (
            (points[:150], offsets(min(num_points, 150), frames)),
            (other, offsets(37, frames)),
        ):
            for k in (0, 1, 8, 9, 31, 64, 65, 150):
                arguments = (points, batch, queries, query_batch, k)
                assert same(knn(*arguments), reference.knn(*arguments))


@pytest.mark.parametrize("kind", KINDS)
def test_large_clouds_at_every_level(level: str, kind: str) -> None:
    points, batch = cloud(kind, 20000), torch.tensor([0, 9000, 20000])
    queries = torch.cat([points[::999], cloud(kind, 9, seed=1), 1e7 * cloud("normal", 3)])
    query_batch = torch.tensor([0, 15, len(queries)])
    for k in (1, 16, 20, 100):
        assert same(knn(points, batch, queries, query_batch, k), reference.knn(points, batch, queries, query_batch, k))
    wide = (points.double(), batch, queries.double(), query_batch, 20)
    assert same(knn(*wide), reference.knn(*wide))


def test_tree_of_four_levels(level: str) -> None:
    points = cloud("lidar", 150000)
    arguments = (points, torch.tensor([0, 150000]), points[::20001] + 0.05, torch.tensor([0, 8]), 24)
    assert same(knn(*arguments), reference.knn(*arguments))


@pytest.mark.parametrize("kind", ["normal", "lattice", "not finite"])
def test_long_lists(native: None, kind: str) -> None:
    points, queries = cloud(kind, 3000), cloud(kind, 21, seed=1)
    for k in (127, 128, 129, 1000, 4000):
        arguments = (points, torch.tensor([0, 400, 3000]), queries, torch.tensor([0, 9, 21]), k)
        assert same(knn(*arguments), reference.knn(*arguments))


def test_distances_are_sums_of_squared_differences(level: str) -> None:
    """Not contracted: equal to the bit to what PyTorch's plain arithmetic gives, at every level."""
    points, queries = cloud("normal", 3000), cloud("normal", 500, seed=1)
    found = knn(points, torch.tensor([0, 3000]), queries, torch.tensor([0, 500]), 5)
    dx, dy, dz = (points[found.indices] - queries[:, None]).unbind(-1)
    assert torch.equal(found.squared_distance, dx * dx + dy * dy + dz * dz)


def test_bitwise_equal_for_any_thread_count(native: None) -> None:
    points, batch = cloud("lidar", 50001), torch.tensor([0, 20000, 20000, 50001])
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(knn(points, batch, points[::3], torch.tensor([0, 6000, 6000, 16667]), 12))
    assert all(same(result, results[0]) for result in results)


def test_an_outlier_costs_no_memory(native: None) -> None:
    points = cloud("normal", 5000)
    points[17] = torch.tensor([1e30, -1e30, 1e30])
    arguments = (points, torch.tensor([0, 5000]), points[:50], torch.tensor([0, 50]), 4)
    assert same(knn(*arguments), reference.knn(*arguments))


def test_memory_layouts_and_columns_agree(backend: str) -> None:
    points, queries = cloud("normal", 300), cloud("normal", 40, seed=1)
    batch, query_batch = torch.tensor([0, 100, 300]), torch.tensor([0, 15, 40])
    expected = knn(points, batch, queries, query_batch, 6)
    wide = torch.cat([points, torch.full((300, 2), math.nan)], dim=1)
    strided = query_batch.repeat_interleave(2)[::2]
    assert same(knn(wide, batch, queries.t().contiguous().t(), strided, 6), expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_points_are_compared_in_float32(backend: str, dtype: torch.dtype) -> None:
    points, batch = cloud("normal", 500, dtype), torch.tensor([0, 500])
    found = knn(points, batch, points, batch, 7)
    assert found.squared_distance.dtype == torch.float32
    assert same(found, knn(points.float(), batch, points.float(), batch, 7))
    assert same(found, knn(points.float(), batch, points, batch, 7))  # half beside float32


@pytest.mark.parametrize("batch", [[0], [0, 0], [0, 0, 0]])
@pytest.mark.parametrize("num_points,num_queries", [(0, 0), (0, 5), (5, 0)])
def test_empty(backend: str, num_points: int, num_queries: int, batch: list[int]) -> None:
    if len(batch) == 1 and (num_points or num_queries):
        return
    batch_offsets, query_offsets = [*batch[:-1], num_points], [*batch[:-1], num_queries]
    found = knn(
        torch.zeros(num_points, 3),
        torch.tensor(batch_offsets),
        torch.ones(num_queries, 3),
        torch.tensor(query_offsets),
        4,
    )
    assert found.indices.shape == found.squared_distance.shape == (num_queries, 4)
    assert (found.indices == -1).all() and (found.squared_distance == math.inf).all()


def test_errors(backend: str) -> None:
    points, batch = cloud("normal", 10), torch.tensor([0, 10])
    with pytest.raises(ValueError, match=r"knn: points must have shape \[N, C\] with C >= 3, got \[10, 2\]"):
        knn(points[:, :2], batch, points, batch, 3)
    with pytest.raises(ValueError, match=r"knn: queries must have shape \[N, C\] with C >= 3, got \[10\]"):
        knn(points, batch, points[:, 0], batch, 3)
    with pytest.raises(TypeError, match="knn: points must be float32 or .*, got int64"):
        knn(points.long(), batch, points, batch, 3)
    with pytest.raises(TypeError, match="knn: queries must have the dtype of points"):
        knn(points, batch, points.double(), batch, 3)
    with pytest.raises(TypeError, match="knn: query_offsets must be int64, got int32"):
        knn(points, batch, points, batch.int(), 3)
    with pytest.raises(ValueError, match=r"knn: query_offsets must have shape \[2\] as batch_offsets, got \[3\]"):
        knn(points, batch, points, torch.tensor([0, 5, 10]), 3)
    for wrong in ([], [0], [1, 10], [0, 9], [0, 7, 5, 10], [0, -1, 10]):
        with pytest.raises(ValueError, match="knn: batch_offsets must"):
            knn(points, torch.tensor(wrong, dtype=torch.int64), points, batch, 3)
        with pytest.raises(ValueError, match="knn: query_offsets must"):
            knn(points, batch, points, torch.tensor(wrong, dtype=torch.int64), 3)
    with pytest.raises(ValueError, match="knn: k must be at least 0, got -1"):
        knn(points, batch, points, batch, -1)


def test_direct_calls_are_checked(native: None) -> None:
    points, batch, call = cloud("normal", 10), torch.tensor([0, 10]), torch.ops.pred.knn
    with pytest.raises(KERNEL_ERROR, match="knn: query_offsets must have shape \\[2\\], got"):
        call(points, batch, points, torch.tensor([0, 5, 10]), 3)
    with pytest.raises(KERNEL_ERROR, match="knn: k must not be negative, got -1"):
        call(points, batch, points, batch, -1)
    require_value_checks("native")
    with pytest.raises(KERNEL_ERROR, match="knn: batch_offsets must ascend from 0 to N=10"):
        call(points, torch.tensor([0, 12]), points, batch, 3)
    with pytest.raises(KERNEL_ERROR, match="knn: query_offsets must ascend from 0 to M=10"):
        call(points, batch, points, torch.tensor([0, 9]), 3)
