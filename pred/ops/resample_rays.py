# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Importance sampling along rays."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count
from pred.ops.sample_pdf import pdf_arguments, samples_reference


def resample_rays(
    t: Tensor,  # [R, S]
    weights: Tensor,  # [R, S] or [R, S - 1]
    num_samples: int,
    u: Tensor | None = None,  # [R, num_samples] or [num_samples]
    mode: str = "exact",
    *,
    histogram_padding: float = 0.01,
    eps: float = 1e-5,
    min_width: float = 0.0,
) -> Tensor:  # [R, S + num_samples]
    """Adds samples where a coarse pass found weight, and merges them with the coarse ones.

    Section i, from ``t_i`` to ``t_{i+1}``, has probability ``weights_i / sum(weights)`` and constant density; sample k
    is the inverse of the cumulative distribution at ``u_k``. ``mode="neus"`` and ``"nerfstudio"`` sample as those codes
    do; see :func:`pred.ops.sample_pdf`, whose samples are merged here by a stable sort.

    Args:
        t: ``[R, S]`` ascending ranges in metres, S at least 2, float32 or float64; half precision is widened to
            float32. Equal neighbours are allowed.
        weights: ``[R, S - 1]``, or ``[R, S]`` as :func:`pred.ops.composite_rays` gives them, whose last one is ignored;
            same dtype. In mode exact negative weights count as 0, and a ray whose weights sum to 0, or to NaN or
            infinity, is sampled uniformly in ``t`` from ``t_0`` to ``t_{S-1}``.
        num_samples: samples to add to each ray.
        u: positions in [0, 1), same dtype; mode exact clips values beyond. Any order gives the same result; ascending
            is fast, and in mode exact fastest with one position in each ``[k, k + 1) / num_samples`` (stratified).
            None: their midpoints.
        mode: ``"exact"``, ``"neus"`` or ``"nerfstudio"``.
        histogram_padding: see :func:`pred.ops.sample_pdf`.
        eps: likewise.
        min_width: likewise.

    Returns:
        ``[R, S + num_samples]`` ascending along each ray, NaN last. Not differentiable: it carries no gradient.
        NaN stays in its ray.

    Raises:
        ValueError: shape, device, range or an unknown mode. TypeError: dtype.

    Deterministic for any thread count.
    """
    _native.refuse_transforms("resample_rays")
    check_count("resample_rays", "num_samples", num_samples)
    rule = (mode, histogram_padding, eps, min_width)
    t, weights, u = pdf_arguments("resample_rays", "t", t, weights, num_samples, u, *rule)
    if not _native.use_native("resample_rays", t):
        return _merged(t, weights, u, *rule)
    out: Tensor = torch.ops.pred.resample_rays(t, weights, u, *rule)
    return out


def resample_rays_reference(
    t: Tensor,  # [R, S]
    weights: Tensor,  # [R, S] or [R, S - 1]
    num_samples: int,
    u: Tensor | None = None,  # [R, num_samples] or [num_samples]
    mode: str = "exact",
    *,
    histogram_padding: float = 0.01,
    eps: float = 1e-5,
    min_width: float = 0.0,
) -> Tensor:  # [R, S + num_samples]
    """Plain PyTorch form of :func:`resample_rays`: search, interpolate, sort."""
    check_count("resample_rays", "num_samples", num_samples)
    rule = (mode, histogram_padding, eps, min_width)
    t, weights, u = pdf_arguments("resample_rays", "t", t, weights, num_samples, u, *rule)
    return _merged(t, weights, u, *rule)


def _merged(
    t: Tensor, weights: Tensor, u: Tensor, mode: str, histogram_padding: float, eps: float, min_width: float
) -> Tensor:
    samples = samples_reference(t, weights, u, mode, histogram_padding, eps, min_width)
    return torch.cat([t, samples], dim=1).sort(dim=1, stable=True).values


def _fake(
    t: Tensor, weights: Tensor, u: Tensor, mode: str, histogram_padding: float, eps: float, min_width: float
) -> Tensor:
    return t.new_empty(t.shape[0], t.shape[1] + u.shape[-1])


_native.register("resample_rays", fake=_fake, differentiable=False)
