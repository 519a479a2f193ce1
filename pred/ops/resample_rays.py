# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Importance sampling along rays."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import FLOATING, check_dtype, check_like, check_shape, check_tensors, widen


def resample_rays(
    t: Tensor,  # [R, S]
    weights: Tensor,  # [R, S] or [R, S - 1]
    num_samples: int,
    u: Tensor | None = None,  # [R, num_samples] or [num_samples]
) -> Tensor:  # [R, S + num_samples]
    """Adds samples where a coarse pass found weight, and merges them with the coarse ones.

    Section i, from ``t_i`` to ``t_{i+1}``, has probability ``weights_i / sum(weights)`` and constant density; sample k
    is the inverse of the cumulative distribution at ``u_k``.

    Args:
        t: ``[R, S]`` ascending ranges in metres, S at least 2, float32 or float64. Equal neighbours are allowed.
        weights: ``[R, S - 1]``, or ``[R, S]`` as :func:`pred.ops.composite_rays` gives them, whose last one is ignored;
            same dtype. Negative weights count as 0. A ray whose weights sum to 0, or to NaN or infinity, is sampled
            uniformly in ``t`` from ``t_0`` to ``t_{S-1}``.
        num_samples: samples to add to each ray.
        u: positions in [0, 1), same dtype; values beyond are clipped. Any order gives the same result; ascending is
            fast, and fastest with one position in each ``[k, k + 1) / num_samples`` (stratified). None: their
            midpoints.

    Returns:
        ``[R, S + num_samples]`` ascending along each ray, NaN last. Not differentiable: it carries no gradient.
        NaN stays in its ray.

    Raises:
        ValueError: shape or device. TypeError: dtype.

    Deterministic for any thread count.
    """
    if not _native.use_native("resample_rays", t):
        return resample_rays_reference(t, weights, num_samples, u)
    out: Tensor = torch.ops.pred.resample_rays(*_arguments(t, weights, num_samples, u))
    return out


@torch.no_grad()
def resample_rays_reference(
    t: Tensor,  # [R, S]
    weights: Tensor,  # [R, S] or [R, S - 1]
    num_samples: int,
    u: Tensor | None = None,  # [R, num_samples] or [num_samples]
) -> Tensor:  # [R, S + num_samples]
    """Plain PyTorch form of :func:`resample_rays`: search, interpolate, sort."""
    t, weights, u = _arguments(t, weights, num_samples, u)
    last = t.shape[1] - 2  # last section
    length = t[:, 1:] - t[:, :-1]
    mass = weights[:, : last + 1].clamp(min=0)
    total = mass.sum(dim=1, keepdim=True)
    usable = (total >= torch.finfo(t.dtype).tiny) & (total < torch.inf)
    mass = torch.where(usable, mass, length.clamp(min=0))
    cumulative = torch.nn.functional.pad(mass.cumsum(dim=1), (1, 0))
    total = cumulative[:, -1:]
    cdf = torch.where(total > 0, cumulative / total, cumulative)  # ends with 1; 0 where all t are equal
    u = u.clamp(0, 1 - torch.finfo(t.dtype).eps / 2).expand(t.shape[0], -1).contiguous()
    section = (torch.searchsorted(cdf, u, right=True) - 1).clamp(0, last)
    low, high = cdf.gather(1, section), cdf.gather(1, section + 1)
    fraction = (u - low) / torch.where(high > low, high - low, 1)
    fraction = torch.where(total.isfinite(), fraction, torch.nan)  # t is not finite
    samples = t.gather(1, section) + fraction * length.gather(1, section)
    return torch.cat([t, samples], dim=1).sort(dim=1).values


def _arguments(t: Tensor, weights: Tensor, num_samples: int, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    op = "resample_rays"
    check_tensors(op, t=t, weights=weights, **({} if u is None else {"u": u}))
    t, weights = (widen(x.detach()[..., 0] if x.dim() == 3 and x.shape[2] == 1 else x.detach()) for x in (t, weights))
    check_shape(op, "t", t, ("R", "S"))
    check_dtype(op, "t", t, FLOATING)
    rays, samples = t.shape
    if samples < 2:
        raise ValueError(f"{op}: t must have at least 2 samples per ray, got {samples}")
    if num_samples < 0:
        raise ValueError(f"{op}: num_samples must be 0 or more, got {num_samples}")
    if weights.shape != (rays, samples) and weights.shape != (rays, samples - 1):
        raise ValueError(
            f"{op}: weights must have shape [{rays}, {samples}] or [{rays}, {samples - 1}], got {list(weights.shape)}"
        )
    check_like(op, "weights", weights, "t", t)
    if u is None:
        u = (torch.arange(num_samples, dtype=t.dtype, device=t.device) + 0.5) / max(num_samples, 1)
        return t, weights, u
    u = widen(u.detach())
    if u.shape != (rays, num_samples) and u.shape != (num_samples,):
        raise ValueError(f"{op}: u must have shape [{rays}, {num_samples}] or [{num_samples}], got {list(u.shape)}")
    check_like(op, "u", u, "t", t)
    return t, weights, u


def _fake(t: Tensor, weights: Tensor, u: Tensor) -> Tensor:
    return t.new_empty(t.shape[0], t.shape[1] + u.shape[-1])


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.mark_non_differentiable(output)


def _backward(ctx: Any, grad: Tensor) -> tuple[None, None, None]:
    return None, None, None


_native.register("resample_rays", fake=_fake, setup_context=_save, backward=_backward)
