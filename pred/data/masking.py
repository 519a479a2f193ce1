# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Which points the encoder sees, and which returns training never touches."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def visible_points(num_points: int, mask_ratio: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Point-wise masking (PRED section 3.2): ascending indices of the points that stay visible.

    ``round((1 - mask_ratio) * num_points)`` points, but at least one of any, drawn uniformly
    without replacement.
    """
    if num_points == 0:
        return np.zeros(0, dtype=np.int64)
    num_visible = max(1, round((1.0 - mask_ratio) * num_points))
    return np.sort(rng.choice(num_points, num_visible, replace=False, shuffle=False))


def is_held_out(point_index: NDArray[np.int64], token: str, fraction: float) -> NDArray[np.bool_]:
    """[N] mask of the returns kept for evaluation: about ``fraction`` of them, fixed for ever.

    Return i is held out if output i of a splitmix64 generator, seeded with blake2b of the frame
    token, is below the fraction. The choice depends on nothing else: no seed, no step, no range.
    """
    seed = int.from_bytes(hashlib.blake2b(token.encode(), digest_size=8).digest(), "little")
    state = np.uint64(seed) + (point_index.astype(np.uint64) + np.uint64(1)) * _GOLDEN_GAMMA
    uniform = (_splitmix64(state) >> np.uint64(11)) * 2.0**-53
    return uniform < fraction


_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)


def _splitmix64(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Output function of splitmix64 (Steele, Lea and Flood, OOPSLA 2014); wraps modulo 2^64."""
    mixed = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))
