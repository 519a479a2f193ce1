# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Which points the encoder sees, and which returns training never touches.

Three strategies (PRED, figure "Masking strategy and masking ratio"): a share of the points, of the non-empty patches of
a BEV grid, or of the groups around far-apart centres is hidden.
"""

from __future__ import annotations

import hashlib
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from pred.ops import farthest_point_sample, knn

MaskStrategy = Literal["point", "patch", "group"]


def visible_points(num_points: int, mask_ratio: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Point-wise masking (PRED section 3.2): ascending indices of the points that stay visible.

    ``round((1 - mask_ratio) * num_points)`` points, but at least one of any, drawn uniformly
    without replacement.
    """
    if num_points == 0:
        return np.zeros(0, dtype=np.int64)
    num_visible = max(1, round((1.0 - mask_ratio) * num_points))
    return np.sort(rng.choice(num_points, num_visible, replace=False, shuffle=False))


def visible_parts(part: NDArray[np.int64], mask_ratio: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Ascending indices of the points in the parts that stay visible, as many parts as `visible_points` leaves points.

    Args:
        part: [N] number of the part that each point belongs to.
        mask_ratio: share of the non-empty parts that is hidden.
        rng: the random numbers.
    """
    parts, part_of_point = np.unique(part, return_inverse=True)
    visible = np.zeros(len(parts), dtype=np.bool_)
    visible[visible_points(len(parts), mask_ratio, rng)] = True
    return np.flatnonzero(visible[part_of_point])


def bev_patches(points: NDArray[np.float32], point_range: tuple[float, ...], patch_size_m: float) -> NDArray[np.int64]:
    """[N] number of the square patch of the BEV plane that each point is in.

    Args:
        points: [N, C] x, y, ... inside the range, metres.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), metres; patches are counted from its lower corner.
        patch_size_m: edge of a patch, metres.
    """
    cell = np.floor((points[:, :2].astype(np.float64) - point_range[:2]) / patch_size_m).astype(np.int64)
    patches_in_x = int(np.ceil((point_range[3] - point_range[0]) / patch_size_m)) + 1
    return cell[:, 1] * patches_in_x + cell[:, 0]


def farthest_point_groups(points: NDArray[np.float32], num_groups: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """[N] number of the group that each point is in: that of the nearest of ``num_groups`` farthest-point samples.

    Point-BERT (CVPR 2022) takes the k nearest points of each sample. A LiDAR cloud is dense near the sensor, and the
    samples are not: with k = N / ``num_groups`` more than half of the points are in no group. So each point joins its
    nearest sample here: it is in one group, whose size varies, and each has the same chance to be seen.

    Args:
        points: [N, C] x, y, z, ...
        num_groups: groups; of fewer distinct points, each is a group.
        rng: draws the first sample.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    xyz = torch.from_numpy(np.ascontiguousarray(points[:, :3]))
    rows = torch.tensor([0, len(points)])
    samples = farthest_point_sample(xyz, rows, num_groups, start=int(rng.integers(len(points))))[0]
    centres = xyz[samples[samples >= 0]]
    nearest: NDArray[np.int64] = knn(centres, torch.tensor([0, len(centres)]), xyz, rows, k=1).indices[:, 0].numpy()
    return nearest


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
