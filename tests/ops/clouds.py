# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Point clouds that are awkward for a search in space."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.cases import lidar_points

KINDS = ("lidar", "normal", "lattice", "line", "equal", "outlier", "clusters", "scales", "huge", "not finite")


def cloud(kind: str, num_points: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:  # [N, 3]
    """Points of one of ``KINDS``."""
    generator = torch.Generator().manual_seed(seed + num_points)
    points = 20 * torch.randn(num_points, 3, generator=generator, dtype=torch.float64)
    if kind == "lidar":
        points = lidar_points(max(num_points, 1), seed)[:num_points, :3].double()
    elif kind == "lattice":  # many equal distances and equal points
        points = (points / 10).round()
    elif kind == "line":
        points[:, 1:] = 3.0
    elif kind == "equal":
        points[:] = 7.0
    elif kind == "outlier":
        points[num_points // 2 :][:1] = 1e6
    elif kind == "clusters":
        points = points / 20 + 1e5 * torch.randint(-3, 4, (num_points, 1), generator=generator)
    elif kind == "scales":
        points *= 10 ** (16 * torch.rand(num_points, 1, generator=generator, dtype=torch.float64) - 8)
    elif kind == "huge":  # distances overflow in float32
        points *= 1e18
    elif kind == "not finite":
        points.view(-1)[::7] = math.nan
        points.view(-1)[3::31] = math.inf
        points.view(-1)[5::37] = -math.inf
    return points.to(dtype)


def offsets(num_rows: int, frames: int) -> Tensor:  # [B + 1]
    """Frames of unequal sizes, some of them empty."""
    inner = sorted((num_rows * (7 * frame % 11)) // 11 for frame in range(1, frames))
    return torch.tensor([0, *inner, num_rows])
