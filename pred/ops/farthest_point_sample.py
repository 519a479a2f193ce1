# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Samples of a point cloud that lie far from each other."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count, check_offsets, check_tensors
from pred.ops._clouds import frame_slices, positions, squared_distances


def farthest_point_sample(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    num_samples: int,
    start: int = 0,
) -> Tensor:  # [B, num_samples]
    """Picks points per frame, each the farthest from all those picked before it (PointNet++, section 3.2).

    ``next = argmax_i min_{s picked} |p_i - p_s|^2``; of equally far points the one with the lowest index. As in
    pointnet2 and OpenPCDet, a frame with fewer distinct positions than samples ends with its lowest index repeated:
    every point then lies on a sample, and all are equally far.

    Args:
        points: ``[N, C]`` float32, float64, bfloat16 or float16, C >= 3; the first three columns are x, y, z. Frame b
            owns the rows from ``batch_offsets[b]`` up to ``batch_offsets[b + 1]``. Any strides.
        batch_offsets: ``[B + 1]`` int64, ascending from 0 to N; frames may be empty.
        num_samples: samples per frame.
        start: number of the first sample within its frame. A frame without such a point, or in which it is not finite,
            starts at its first finite point.

    Returns:
        ``[B, num_samples]`` int64, rows of ``points`` (not numbers within the frame). A frame with n < num_samples
        finite points has n samples; the others are -1. Points with a NaN or infinite coordinate are never picked.

    Raises:
        ValueError: shape, device, offsets (values are checked for CPU tensors), negative ``num_samples`` or ``start``,
            2^31 or more points (compiled). TypeError: dtype.

    Distances are sums of three squared differences in the dtype of the points (float32 for half precision); two points
    may be infinitely far from each other. Not differentiable: the output is integer. Equal bits for any thread count
    and instruction set.
    """
    _native.refuse_transforms("farthest_point_sample")
    xyz = _arguments(points, batch_offsets, num_samples, start)
    if _native.use_native("farthest_point_sample", points):
        out: Tensor = torch.ops.pred.farthest_point_sample(xyz, batch_offsets, num_samples, start)
        return out
    return _sample(xyz, batch_offsets, num_samples, start)


def farthest_point_sample_reference(
    points: Tensor,  # [N, C]
    batch_offsets: Tensor,  # [B + 1]
    num_samples: int,
    start: int = 0,
) -> Tensor:  # [B, num_samples]
    """Plain PyTorch form of :func:`farthest_point_sample`: all distances, once per sample."""
    return _sample(_arguments(points, batch_offsets, num_samples, start), batch_offsets, num_samples, start)


def _arguments(points: Tensor, batch_offsets: Tensor, num_samples: int, start: int) -> Tensor:
    op = "farthest_point_sample"
    check_tensors(op, points=points, batch_offsets=batch_offsets)
    xyz = positions(op, "points", points)
    check_offsets(op, "batch_offsets", batch_offsets, "BN", "points", points)
    check_count(op, "num_samples", num_samples)
    check_count(op, "start", start)
    return xyz


def _sample(xyz: Tensor, batch_offsets: Tensor, num_samples: int, start: int) -> Tensor:
    samples = batch_offsets.new_full((batch_offsets.shape[0] - 1, num_samples), -1)
    for frame, rows in enumerate(frame_slices(batch_offsets)):
        position = xyz[rows]
        candidates = position.isfinite().all(dim=1).nonzero()[:, 0]  # [n], ascending
        count = min(num_samples, candidates.shape[0])
        if count == 0:
            continue
        position = position[candidates]
        # The first sample; the first candidate where `start` is none.
        chosen = int(torch.searchsorted(candidates, start)) if bool((candidates == start).any()) else 0
        distance = position.new_full((position.shape[0],), torch.inf)
        chosen_points = [chosen]
        for _ in range(1, count):
            distance = torch.minimum(distance, squared_distances(position, position[chosen]))
            chosen = int((distance == distance.max()).nonzero()[0])
            chosen_points.append(chosen)
        samples[frame, :count] = candidates[chosen_points] + rows.start
    return samples


def _fake(points: Tensor, batch_offsets: Tensor, num_samples: int, start: int) -> Tensor:
    return batch_offsets.new_empty(batch_offsets.shape[0] - 1, num_samples)


_native.register("farthest_point_sample", fake=_fake, differentiable=False)
