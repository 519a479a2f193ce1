# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Maximum over the active sites that an output reads."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import widen
from pred.ops._rulebook import check_tables, padded


def sparse_max_pool(
    features: Tensor,  # [M, C]
    out_to_in: Tensor,  # [M', K]
    in_to_out: Tensor,  # [M, K]
) -> Tensor:  # [M', C]
    """Pools the active sites: ``out[o, c] = max over k, i = out_to_in[o, k] >= 0, of features[i, c]``.

    Sites that are not active do not take part: a maximum may be negative. (So does spconv 2.x, but for its native
    algorithm, which starts from 0.)

    Args:
        features: ``[M, C]`` float32, float64, bfloat16 or float16.
        out_to_in, in_to_out: int32, both of one rulebook (:func:`build_rulebook`).

    Returns:
        ``[M', C]``; 0 for an output that reads nothing. A NaN makes its outputs NaN, as ``torch.amax``.

    Raises:
        ValueError: shape, device, 2^31 or more rows, or numbers of a table that are not rows (checked for CPU tensors).
        TypeError: dtype.

    Differentiable any number of times in ``features``. Of equal maxima the first tap's takes the gradient; with NaN
    present it is the first NaN. Deterministic for any thread count.
    """
    op = "sparse_max_pool"
    _native.refuse_transforms(op)
    features = widen(features) if isinstance(features, Tensor) else features
    check_tables(op, features, out_to_in, in_to_out)
    if not _native.use_native(op, features):
        return _reference(features, out_to_in)
    out: Tensor = _native.checked(torch.ops.pred.sparse_max_pool, features, out_to_in, in_to_out)[0]
    return out


def sparse_max_pool_reference(
    features: Tensor,  # [M, C]
    out_to_in: Tensor,  # [M', K]
    in_to_out: Tensor,  # [M, K]
) -> Tensor:  # [M', C]
    """Plain PyTorch form of :func:`sparse_max_pool`."""
    features = widen(features) if isinstance(features, Tensor) else features
    check_tables("sparse_max_pool", features, out_to_in, in_to_out)
    return _reference(features, out_to_in)


def _reference(features: Tensor, out_to_in: Tensor) -> Tensor:
    if out_to_in.shape[1] == 0:
        return features.new_zeros(out_to_in.shape[0], features.shape[1]) + 0 * features.sum(dim=0)
    table = out_to_in.long()
    read = (table >= 0)[..., None]
    rows = torch.where(table < 0, features.shape[0], table)
    values = padded(features)[rows]  # [M', K, C]
    held = torch.where(read, values.detach(), -torch.inf)
    best = held.amax(dim=1, keepdim=True)
    candidate = ((held == best) | held.isnan()) & read
    first = candidate.int().argmax(dim=1, keepdim=True)  # the first of equal ones; any tap where none is read
    return values.gather(1, first)[:, 0] * read.any(dim=1)


def _fake(features: Tensor, out_to_in: Tensor, in_to_out: Tensor) -> tuple[Tensor, Tensor]:
    shape = (out_to_in.shape[0], features.shape[1])
    return features.new_empty(shape), out_to_in.new_empty(shape)


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(output[1], inputs[2])


def _backward(ctx: Any, grad: Tensor, grad_winner: None) -> tuple[Tensor | None, ...]:
    winner, in_to_out = ctx.saved_tensors
    return torch.ops.pred.sparse_max_pool_backward(grad, winner, in_to_out), None, None


def _fake_backward(grad: Tensor, winner: Tensor, in_to_out: Tensor) -> Tensor:
    return grad.new_empty(in_to_out.shape[0], grad.shape[1])


def _save_backward(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(inputs[1])


def _double_backward(ctx: Any, grad_grad: Tensor) -> tuple[Tensor | None, ...]:
    """The backward pass is linear in ``grad``; its transpose reads the winners."""
    (winner,) = ctx.saved_tensors
    row = torch.where(winner < 0, grad_grad.shape[0], winner).long()
    return padded(grad_grad).gather(0, row), None, None


_native.register("sparse_max_pool", fake=_fake, setup_context=_save, backward=_backward)
_native.register(
    "sparse_max_pool_backward", fake=_fake_backward, setup_context=_save_backward, backward=_double_backward
)
