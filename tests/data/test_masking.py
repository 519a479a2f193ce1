# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Point-wise masking and the held-out set."""

from __future__ import annotations

import numpy as np
import pytest

from pred.data import masking
from pred.data.masking import is_held_out, visible_points
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
