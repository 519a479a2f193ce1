# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest
import torch

from pred.ops import Ball, ball_query, reference
from tests.conftest import KERNEL_ERROR, require_value_checks
from tests.ops.clouds import KINDS, cloud, offsets


def same(actual: Ball, expected: Ball) -> bool:
    return all(a.dtype == e.dtype == torch.int64 and torch.equal(a, e) for a, e in zip(actual, expected, strict=True))


def test_hand_computed(backend: str) -> None:
    nan, inf = math.nan, math.inf
    points = torch.tensor(
        [
            [3.0, 0.0, 0.0, nan],  # frame 0; further columns do not matter
            [0.0, 2.0, 0.0, 9.0],  # on the sphere: outside
            [1.0, 0.0, 1.0, 9.0],
            [nan, 0.0, 0.0, 9.0],
            [0.0, 0.0, 0.0, 9.0],
            [0.0, -1.0, 0.0, 9.0],
            [1.0, 1.0, 1.0, 9.0],  # frame 2
        ]
    )
    queries = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, inf, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.5]])
    found = ball_query(points, torch.tensor([0, 6, 6, 7]), queries, torch.tensor([0, 3, 4, 5]), 2.0, 2)
    assert found.indices.tolist() == [[2, 4], [0, -1], [-1, -1], [-1, -1], [6, -1]]
    assert found.counts.tolist() == [2, 1, 0, 0, 1]


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
            for radius, max_points in ((0.01, 3), (1.0, 1), (5.0, 16), (40.0, 100), (1e20, 8), (math.inf, 5), (2.0, 0)):
                arguments = (points, batch, queries, query_batch, radius, max_points)
                assert same(ball_query(*arguments), reference.ball_query(*arguments))


@pytest.mark.parametrize("kind", KINDS)
def test_large_clouds_at_every_level(level: str, kind: str) -> None:
    points, batch = cloud(kind, 20000), torch.tensor([0, 9000, 20000])
    queries = torch.cat([points[::999], cloud(kind, 9, seed=1), 1e7 * cloud("normal", 3)])
    query_batch = torch.tensor([0, 15, len(queries)])
    for radius, max_points in ((0.1, 8), (2.0, 16), (15.0, 64), (1e4, 33)):
        arguments = (points, batch, queries, query_batch, radius, max_points)
        assert same(ball_query(*arguments), reference.ball_query(*arguments))


def test_tree_of_four_levels(level: str) -> None:
    points = cloud("lidar", 150000)
    for radius in (0.3, 2.0, 30.0):
        arguments = (points, torch.tensor([0, 150000]), points[::20001] + 0.05, torch.tensor([0, 8]), radius, 32)
        assert same(ball_query(*arguments), reference.ball_query(*arguments))


def test_bitwise_equal_for_any_thread_count(native: None) -> None:
    points, batch = cloud("lidar", 50001), torch.tensor([0, 20000, 20000, 50001])
    results = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        results.append(ball_query(points, batch, points[::3], torch.tensor([0, 6000, 6000, 16667]), 0.8, 12))
    assert all(same(result, results[0]) for result in results)


def test_as_pointnet2_fills_its_lists(backend: str) -> None:
    """The conversion that the docstring gives, against that convention written out."""
    points, queries = cloud("lattice", 200), cloud("normal", 60)
    frame, query_frame = torch.tensor([0, 200]), torch.tensor([0, 60])
    indices = ball_query(points, frame, queries, query_frame, 1.7, 6).indices
    converted = torch.where(indices < 0, indices[:, :1], indices).clamp_min(0)
    for query, row in zip(queries, converted.tolist(), strict=True):
        inside = [i for i, point in enumerate(points) if float((point - query).square().sum()) < 1.7**2][:6]
        assert row == (inside + inside[:1] * (6 - len(inside)) if inside else [0] * 6)


def test_memory_layouts_and_columns_agree(backend: str) -> None:
    points, queries = cloud("normal", 300), cloud("normal", 40, seed=1)
    batch, query_batch = torch.tensor([0, 100, 300]), torch.tensor([0, 15, 40])
    expected = ball_query(points, batch, queries, query_batch, 9.0, 6)
    wide = torch.cat([points, torch.full((300, 2), math.nan)], dim=1)
    strided = query_batch.repeat_interleave(2)[::2]
    assert same(ball_query(wide, batch, queries.t().contiguous().t(), strided, 9.0, 6), expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_points_are_compared_in_float32(backend: str, dtype: torch.dtype) -> None:
    points, batch = cloud("normal", 500, dtype), torch.tensor([0, 500])
    found = ball_query(points, batch, points, batch, 4.0, 7)
    assert same(found, ball_query(points.float(), batch, points.float(), batch, 4.0, 7))


@pytest.mark.parametrize("batch", [[0], [0, 0], [0, 0, 0]])
@pytest.mark.parametrize("num_points,num_queries", [(0, 0), (0, 5), (5, 0)])
def test_empty(backend: str, num_points: int, num_queries: int, batch: list[int]) -> None:
    if len(batch) == 1 and (num_points or num_queries):
        return
    batch_offsets, query_offsets = [*batch[:-1], num_points], [*batch[:-1], num_queries]
    points, queries = torch.zeros(num_points, 3), torch.ones(num_queries, 3)
    found = ball_query(points, torch.tensor(batch_offsets), queries, torch.tensor(query_offsets), 9.0, 4)
    assert found.indices.shape == (num_queries, 4) and found.counts.shape == (num_queries,)
    assert (found.indices == -1).all() and not found.counts.any()


def test_errors(backend: str) -> None:
    points, batch = cloud("normal", 10), torch.tensor([0, 10])
    with pytest.raises(ValueError, match=r"ball_query: points must have shape \[N, C\] with C >= 3, got \[10, 2\]"):
        ball_query(points[:, :2], batch, points, batch, 1.0, 3)
    with pytest.raises(TypeError, match="ball_query: queries must have the dtype of points"):
        ball_query(points, batch, points.double(), batch, 1.0, 3)
    with pytest.raises(ValueError, match=r"ball_query: query_offsets must ascend from 0 to M=10, got \[0, 9\]"):
        ball_query(points, batch, points, torch.tensor([0, 9]), 1.0, 3)
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"ball_query: radius must be positive, got {wrong}"):
            ball_query(points, batch, points, batch, wrong, 3)
    with pytest.raises(ValueError, match="ball_query: max_points must be at least 0, got -1"):
        ball_query(points, batch, points, batch, 1.0, -1)


def test_direct_calls_are_checked(native: None) -> None:
    points, batch, call = cloud("normal", 10), torch.tensor([0, 10]), torch.ops.pred.ball_query
    with pytest.raises(KERNEL_ERROR, match="ball_query: radius must be positive, got -1"):
        call(points, batch, points, batch, -1.0, 3)
    with pytest.raises(KERNEL_ERROR, match="ball_query: max_points must not be negative, got -1"):
        call(points, batch, points, batch, 1.0, -1)
    require_value_checks("native")
    with pytest.raises(KERNEL_ERROR, match="ball_query: batch_offsets must ascend from 0 to N=10"):
        call(points, torch.tensor([0, 12]), points, batch, 1.0, 3)
