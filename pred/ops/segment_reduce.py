# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Sum, mean or maximum of the feature rows that share a segment."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import FLOATING, HALF, check_choice, check_count, check_dtype, check_shape, check_tensors, widen


def segment_reduce(
    features: Tensor,  # [N, C]
    index: Tensor,  # [N]
    num_segments: int,
    reduce: str = "sum",
) -> Tensor:  # [num_segments, C]
    """Reduces rows by segment: ``out[s, c] = reduce over {i : index[i] = s} of features[i, c]``.

    Args:
        features: ``[N, C]`` float32, float64, bfloat16 or float16. Half precision is added up in float32.
        index: ``[N]`` int64 in [0, num_segments), in any order; rows with -1 are skipped.
        num_segments: rows of the output.
        reduce: ``"sum"``, ``"mean"`` or ``"max"``.

    Returns:
        ``[num_segments, C]`` in the dtype of the features, rounded once; 0 for segments without rows. A NaN makes its
        segment and channel NaN, in ``"max"`` too (as ``torch.amax``).

    Raises:
        ValueError: shape, device, ``reduce``, 2^31 or more rows (compiled), or an index outside [-1, num_segments)
            (checked for CPU tensors, before anything is written). TypeError: dtype.

    Differentiable any number of times in ``features``. Of equal maxima the first row takes the gradient; with NaN
    present it is the first NaN. Deterministic for any thread count: rows are added in their order.
    """
    _native.refuse_transforms("segment_reduce")
    features = _arguments(features, index, num_segments, reduce)
    if not _native.use_native("segment_reduce", features):
        return segment_reduce_reference(features, index, num_segments, reduce)
    out: Tensor = _native.checked(torch.ops.pred.segment_reduce, features, index, num_segments, reduce)[0]
    return out


def segment_reduce_reference(
    features: Tensor,  # [N, C]
    index: Tensor,  # [N]
    num_segments: int,
    reduce: str = "sum",
) -> Tensor:  # [num_segments, C]
    """Plain PyTorch form of :func:`segment_reduce`, differentiable any number of times."""
    features = _arguments(features, index, num_segments, reduce)
    dtype = features.dtype
    features = features if dtype == torch.float64 else features.float()
    if not torch.compiler.is_compiling() and index.device.type == "cpu":
        _check_index(index, num_segments)
    # One more segment takes the skipped rows.
    segment = torch.where(index < 0, torch.full_like(index, num_segments), index)
    if reduce == "max":
        return _max_reference(features, segment, num_segments).to(dtype)
    total = features.new_zeros(num_segments + 1, features.shape[1]).index_add(0, segment, features)[:-1]
    if reduce == "sum":
        return total.to(dtype)
    count = features.new_zeros(num_segments + 1).index_add(0, segment, features.new_ones(features.shape[0]))[:-1]
    return (total / count.clamp_min(1)[:, None]).to(dtype)


def _arguments(features: Tensor, index: Tensor, num_segments: int, reduce: str) -> Tensor:
    op = "segment_reduce"
    check_tensors(op, features=features, index=index)
    features = widen(features)
    check_shape(op, "features", features, ("N", "C"))
    check_shape(op, "index", index, (features.shape[0],), " as features")
    check_dtype(op, "features", features, FLOATING + HALF)
    check_dtype(op, "index", index, (torch.int64,))
    check_choice(op, "reduce", reduce, tuple(_SAVED_DIMS))
    if index.device != features.device:
        raise ValueError(f"{op}: index must be on the device of features ({features.device}), got {index.device}")
    check_count(op, "num_segments", num_segments)
    return features


def _max_reference(features: Tensor, segment: Tensor, num_segments: int) -> Tensor:
    num_rows, channels = features.shape
    values = features.detach()
    column = segment[:, None].expand(num_rows, channels)
    best = values.new_full((num_segments + 1, channels), -torch.inf).scatter_reduce(0, column, values, "amax")
    row = torch.arange(num_rows, device=segment.device)[:, None].expand(num_rows, channels)
    candidate = torch.where((values == best[segment]) | values.isnan(), row, torch.full_like(row, num_rows))
    # [num_segments + 1, C], num_rows where a segment is empty: the row of zeros appended below
    first = torch.full_like(best, num_rows, dtype=torch.int64).scatter_reduce(0, column, candidate, "amin")
    padded = torch.cat([features, features.new_zeros(1, channels)])
    return padded.gather(0, first[:-1])


def _check_index(index: Tensor, num_segments: int) -> None:
    wrong = ((index < -1) | (index >= num_segments)).nonzero()
    if wrong.numel():
        row = int(wrong[0, 0])
        raise ValueError(
            f"segment_reduce: index must lie in [-1, num_segments={num_segments}), got {int(index[row])} in row {row}"
        )


_SAVED_DIMS = {"sum": 0, "mean": 1, "max": 2}
"""Beside the result the kernel returns what the derivative needs: row counts (mean), winning rows (max)."""


def _fake(features: Tensor, index: Tensor, num_segments: int, reduce: str) -> tuple[Tensor, Tensor]:
    channels = features.shape[1]
    check_choice("segment_reduce", "reduce", reduce, tuple(_SAVED_DIMS))
    saved = index.new_empty((num_segments, channels)[: _SAVED_DIMS[reduce]] or (0,), dtype=torch.int32)
    return features.new_empty(num_segments, channels), saved


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    _, index, _, ctx.reduce = inputs
    ctx.save_for_backward(index, output[1])


def _backward(ctx: Any, grad: Tensor, grad_saved: None) -> tuple[Tensor | None, ...]:
    index, saved = ctx.saved_tensors
    return torch.ops.pred.segment_reduce_backward(grad, index, saved, ctx.reduce), None, None, None


def _fake_backward(grad: Tensor, index: Tensor, saved: Tensor, reduce: str) -> Tensor:
    return grad.new_empty(index.shape[0], grad.shape[1])


def _save_backward(ctx: Any, inputs: Any, output: Any) -> None:
    grad, index, saved, ctx.reduce = inputs
    ctx.num_segments = grad.shape[0]
    ctx.save_for_backward(index, saved)


def _double_backward(ctx: Any, grad_grad: Tensor) -> tuple[Tensor | None, ...]:
    """The backward pass is linear in ``grad``; its transpose is the reduction itself, with the winners kept."""
    index, saved = ctx.saved_tensors
    if ctx.reduce == "max":
        padded = torch.cat([grad_grad, grad_grad.new_zeros(1, grad_grad.shape[1])])
        winner = torch.where(saved < 0, grad_grad.shape[0], saved).long()
        return padded.gather(0, winner), None, None, None
    return torch.ops.pred.segment_reduce(grad_grad, index, ctx.num_segments, ctx.reduce)[0], None, None, None


_native.register("segment_reduce", fake=_fake, setup_context=_save, backward=_backward)
_native.register(
    "segment_reduce_backward", fake=_fake_backward, setup_context=_save_backward, backward=_double_backward
)
