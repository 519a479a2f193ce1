# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Masking strategies and the held-out set."""

from __future__ import annotations

import numpy as np
import pytest

from pred.data import masking
from pred.data.masking import bev_patches, farthest_point_groups, is_held_out, visible_parts, visible_points
from pred.random import numpy_generator


@pytest.mark.parametrize(
    ("num_points", "mask_ratio", "expected"),
    [(0, 0.95, 0), (1, 0.95, 1), (3, 0.95, 1), (1000, 0.95, 50), (1000, 0.0, 1000), (1010, 0.9, 101)],
)
def test_number_of_visible_points(num_points: int, mask_ratio: float, expected: int) -> None:
    visible = visible_points(num_points, mask_ratio, numpy_generator(0, "mask"))
    assert len(visible) == expected
    assert len(np.unique(visible)) == expected
    assert (np.diff(visible) > 0).all()
    assert ((visible >= 0) & (visible < num_points)).all()


def test_masking_is_uniform() -> None:
    counts = np.zeros(200)
    for step in range(2000):
        counts[visible_points(200, 0.9, numpy_generator(0, step))] += 1
    # Binomial with mean 200 and standard deviation 13.4.
    assert abs(counts - 200).max() < 5 * 13.4


def test_whole_parts_hand_computed() -> None:
    part = np.array([7, 3, 7, 900, 3, 5, 7])
    members = {3: [1, 4], 5: [5], 7: [0, 2, 6], 900: [3]}
    seen = set()
    for step in range(100):
        visible = visible_parts(part, 0.5, numpy_generator(0, step)).tolist()
        shown = sorted({int(part[index]) for index in visible})
        assert len(shown) == 2  # of four
        assert visible == sorted(index for number in shown for index in members[number])
        seen.add(tuple(shown))
    assert len(seen) == 6
    assert visible_parts(part, 0.99, numpy_generator(0)).size > 0  # at least one part
    assert visible_parts(part, 0.0, numpy_generator(0)).tolist() == list(range(7))
    assert visible_parts(part[:0], 0.5, numpy_generator(0)).shape == (0,)


def test_bev_patches_hand_computed() -> None:
    point_range = (-2.0, -1.0, -5.0, 3.0, 1.0, 3.0)
    xy = [[-2.0, -1.0], [-1.3, -0.3], [-1.1, -1.0], [-2.0, -0.1], [2.99, 0.99], [2.5, 0.7]]
    points = np.column_stack([xy, np.linspace(-5, 2, 6)]).astype(np.float32)
    # Edges of 0.8 m from the lower corner: columns at -2, -1.2, ..., 2.8; rows at -1, -0.2, 0.6.
    cells = [(0, 0), (0, 0), (0, 1), (1, 0), (2, 6), (2, 5)]
    patches = bev_patches(points, point_range, 0.8)
    same = [[one == other for other in cells] for one in cells]
    assert np.array_equal(patches[:, None] == patches[None], same)
    assert bev_patches(points[:0], point_range, 0.8).shape == (0,)


def test_patches_are_the_cells_of_the_bev_map() -> None:
    point_range = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
    rows, columns = np.divmod(np.arange(128 * 128), 128)
    centres = np.column_stack([columns + 0.5, rows + 0.5]) * 0.8 - 51.2
    corners = np.concatenate(
        [centres + 0.399 * np.array(sign) for sign in ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))]
    )
    patches = bev_patches(corners.astype(np.float32), point_range, 0.8).reshape(5, -1)
    assert (patches == patches[0]).all() and len(np.unique(patches)) == 128 * 128


def test_groups_hand_computed() -> None:
    # Three clusters on a line; from any first sample, the farthest points of the others follow.
    points = np.zeros((9, 5), dtype=np.float32)
    points[:, 0] = [0.0, 0.1, 0.2, 10.0, 10.1, 10.2, 30.0, 30.1, 30.2]
    for step in range(20):
        group = farthest_point_groups(points, 3, numpy_generator(0, step)).reshape(3, 3)
        assert (group == group[:, :1]).all() and sorted(group[:, 0]) == [0, 1, 2]
    # As many groups as points, or more: each is one.
    for num_groups in (9, 50):
        assert sorted(farthest_point_groups(points, num_groups, numpy_generator(0))) == list(range(9))
    assert len(set(farthest_point_groups(points, 1, numpy_generator(0)))) == 1
    assert farthest_point_groups(points[:0], 3, numpy_generator(0)).shape == (0,)


def test_points_join_their_nearest_centre() -> None:
    points = (np.random.default_rng(0).normal(size=(2000, 5)) * [30, 30, 1, 1, 1]).astype(np.float32)
    group = farthest_point_groups(points, 64, numpy_generator(0))
    assert sorted(set(group)) == list(range(64))
    # Group g belongs to sample g, which is one of its own points.
    start = int(numpy_generator(0).integers(2000))
    samples = [start]
    distance = np.full(2000, np.inf)
    for _ in range(63):
        distance = np.minimum(distance, np.linalg.norm(points[:, :3] - points[samples[-1], :3], axis=1))
        samples.append(int(distance.argmax()))
    nearest = np.linalg.norm(points[:, None, :3] - points[samples][None, :, :3], axis=2).argmin(axis=1)
    assert (group == nearest).mean() > 0.999


@pytest.mark.parametrize("mask_ratio", [0.5, 0.7, 0.95])
@pytest.mark.parametrize("strategy", ["patch", "group"])
def test_share_of_visible_points(strategy: str, mask_ratio: float) -> None:
    # Dense near the sensor, as a LiDAR cloud.
    rng = np.random.default_rng(0)
    angle, range_m = rng.uniform(0, 2 * np.pi, 20_000), 50 * rng.uniform(0.05, 1, 20_000) ** 2
    points = np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle), rng.uniform(-2, 1, 20_000)])
    shares = []
    for step in range(20):
        part = (
            bev_patches(points.astype(np.float32), (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0), 0.8)
            if strategy == "patch"
            else farthest_point_groups(points.astype(np.float32), 512, numpy_generator(1, step))
        )
        visible = visible_parts(part, mask_ratio, numpy_generator(0, step))
        num_parts = len(np.unique(part))
        assert len(np.unique(part[visible])) == round((1 - mask_ratio) * num_parts)
        assert not np.isin(np.delete(part, visible), part[visible]).any()  # whole parts
        shares.append(len(visible) / len(points))
    # Each part has the same chance, whatever its size.
    assert abs(np.mean(shares) - (1 - mask_ratio)) < 5 * np.std(shares) / np.sqrt(20)


def test_splitmix64_matches_published_numbers() -> None:
    state = np.uint64(1234567) + np.arange(1, 4, dtype=np.uint64) * masking._GOLDEN_GAMMA
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert masking._splitmix64(state).tolist() == expected


def test_held_out_set_is_pinned() -> None:
    # A change of this set would let training see what earlier evaluations held out.
    held = np.flatnonzero(is_held_out(np.arange(60), "ca9a282c9e77460f8360f564131a8af5", 0.1))
    assert held.tolist() == HELD_OUT


HELD_OUT = [1, 10, 15, 19, 47, 50]


def test_held_out_share_and_independence() -> None:
    index = np.arange(200_000)
    held = is_held_out(index, "token", 0.1)
    assert abs(held.mean() - 0.1) < 0.003
    # Another frame holds out other returns: 1 % in common.
    assert abs((held & is_held_out(index, "other token", 0.1)).mean() - 0.01) < 0.001
    # A larger fraction keeps the smaller one's returns.
    assert is_held_out(index, "token", 0.2)[held].all()
    # The choice is that of the point, not of its place among others.
    shuffled = numpy_generator(0).permutation(index)
    assert np.array_equal(is_held_out(shuffled, "token", 0.1), held[shuffled])
    assert not is_held_out(index, "token", 0.0).any()
    assert is_held_out(index[:0], "token", 0.1).shape == (0,)
