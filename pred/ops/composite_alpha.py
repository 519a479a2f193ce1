# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Volume rendering along rays from given opacities: weights, depth, opacity and any channels in one pass."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_number
from pred.ops._composite import Composite, check_options, composite_arguments, composite_reference, layout


def composite_alpha(
    alpha: Tensor,  # [R, S] or [P]
    t: Tensor | None = None,  # as alpha
    values: Tensor | None = None,  # [R, S, C] or [P, C]
    *,
    ray_offsets: Tensor | None = None,  # [R + 1]
    transmittance_eps: float = 0.0,
    depth_at: str = "start",
    normalize_depth: bool = False,
    normalize_eps: float = 1e-10,
) -> Composite:
    """Renders opacity, depth and channels from the opacities of samples along rays (Max 1995; NeRF, Eq. 3).

    ``w_i = T_i alpha_i`` with ``T_i = prod_{j<i} (1 - alpha_j + transmittance_eps)``; ``opacity = sum_i w_i``,
    ``depth = sum_i w_i t_i``, ``values = sum_i w_i values_i``. Weight i belongs to the section from ``t_i`` to
    ``t_{i+1}``.

    Args:
        alpha: ``[R, S]`` or ``[R, S, 1]`` opacities, float32, float64, or half precision, which is computed in
            float32. Meant for [0, 1]; other numbers go through the same formulas.
        t: range of each sample in metres, shape and dtype of ``alpha``; without it there is no depth.
        values: ``[R, S, C]`` anything to be rendered, in the dtype of ``alpha``, or bfloat16 or float16 beside
            float32: read as stored, summed in float32.
        ray_offsets: ``[R + 1]`` int64, ascending from 0 to P, for packed rays of different lengths: ray r owns the
            samples from ``ray_offsets[r]`` up to ``ray_offsets[r + 1]``, none or many, of ``alpha [P]``, ``t [P]`` and
            ``values [P, C]``.
        transmittance_eps: what NeuS and UniPAD (1e-7) add to each factor of the transmittance; finite.
        depth_at: where a section's depth is read: its ``"start"`` ``t_i``, or its middle (``"mid"``); the last sample
            of a ray, which has no end, counts at its own ``t``.
        normalize_depth: divide the depth by ``opacity + normalize_eps``.
        normalize_eps: see ``normalize_depth``; a ray of opacity 0 has depth 0.

    Returns:
        :class:`Composite`: ``weights`` like ``alpha``, ``depth [R]`` or None, ``opacity [R]``, and ``values [R, C]`` in
        their own dtype or None. Depth, opacity and values of a ray without samples are 0. The share of a background is
        ``1 - opacity``, as in NeuS; with ``transmittance_eps = 0`` that is the transmittance behind the last sample. A
        NaN stays in its ray.

    Raises:
        ValueError: shape, device, offsets (values are checked for CPU tensors), an unknown choice,
        ``transmittance_eps``, or 2^40 or more rays or 2^31 or more channels (compiled). TypeError: dtype.

    Differentiable once in ``alpha``, ``t`` and ``values``, through all outputs. The derivative divides by nothing: it
    is exact where opacities are 0 or 1. Deterministic for any thread count.
    """
    _native.refuse_transforms("composite_alpha")
    check_options("composite_alpha", depth_at, normalize_depth, normalize_eps)
    alpha, t, values = _arguments(alpha, t, values, ray_offsets, transmittance_eps)
    if not _native.use_native("composite_alpha", alpha):
        return composite_alpha_reference(
            alpha,
            t,
            values,
            ray_offsets=ray_offsets,
            transmittance_eps=transmittance_eps,
            depth_at=depth_at,
            normalize_depth=normalize_depth,
            normalize_eps=normalize_eps,
        )
    weights, of_t, opacity, of_values = torch.ops.pred.composite_alpha(
        alpha, t, values, ray_offsets, transmittance_eps, depth_at == "mid"
    )
    depth = None if t is None else of_t
    if depth is not None and normalize_depth:
        depth = depth / (opacity + normalize_eps)
    return Composite(weights, depth, opacity, None if values is None else of_values)


def composite_alpha_reference(
    alpha: Tensor,  # [R, S] or [P]
    t: Tensor | None = None,  # as alpha
    values: Tensor | None = None,  # [R, S, C] or [P, C]
    *,
    ray_offsets: Tensor | None = None,  # [R + 1]
    transmittance_eps: float = 0.0,
    depth_at: str = "start",
    normalize_depth: bool = False,
    normalize_eps: float = 1e-10,
) -> Composite:
    """Plain PyTorch form of :func:`composite_alpha`, by ``torch.cumprod``, whose derivative at 0 is right.

    Packed rays become rows as long as the longest ray.
    """
    check_options("composite_alpha", depth_at, normalize_depth, normalize_eps)
    alpha, t, values = _arguments(alpha, t, values, ray_offsets, transmittance_eps)
    places = layout(alpha, ray_offsets)
    alpha = places.spread_or_zero(alpha)
    # In double: in float32 the product would lose opacities below 1e-7.
    clear = torch.cumprod(1 - alpha.double() + transmittance_eps, dim=1)
    transmittance = torch.cat([torch.ones_like(clear[:, :1]), clear[:, :-1]], dim=1)
    weights = torch.where(places.valid, transmittance * alpha, 0.0).to(alpha.dtype)  # inf * 0 behind a ray's end
    return composite_reference(weights, t, values, places, depth_at, normalize_depth, normalize_eps)


def _arguments(
    alpha: Tensor,
    t: Tensor | None,
    values: Tensor | None,
    ray_offsets: Tensor | None,
    transmittance_eps: float,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    check_number("composite_alpha", "transmittance_eps", transmittance_eps)
    if not -math.inf < transmittance_eps < math.inf:
        raise ValueError(f"composite_alpha: transmittance_eps must be finite, got {transmittance_eps}")
    return composite_arguments("composite_alpha", "alpha", alpha, t, values, ray_offsets)


def _fake(
    alpha: Tensor, t: Tensor | None, values: Tensor | None, ray_offsets: Tensor | None, eps: float, depth_mid: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rays = alpha.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1
    rendered = alpha.new_empty(0) if values is None else values.new_empty(rays, values.shape[-1])
    return alpha.new_empty(alpha.shape), alpha.new_empty(0 if t is None else rays), alpha.new_empty(rays), rendered


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    alpha, t, values, ray_offsets, ctx.eps, ctx.depth_mid = inputs
    _, depth, _, rendered = output
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(*([depth] if t is None else []), *([rendered] if values is None else []))
    ctx.save_for_backward(alpha, t, values if ctx.needs_input_grad[0] else None, ray_offsets)


def _backward(
    ctx: Any,
    grad_weights: Tensor | None,
    grad_depth: Tensor | None,
    grad_opacity: Tensor | None,
    grad_values: Tensor | None,
) -> tuple[Tensor | None, ...]:
    need_alpha, need_t, need_values = ctx.needs_input_grad[:3]
    grads = (grad_weights, grad_depth, grad_opacity, grad_values)
    if all(grad is None for grad in grads):
        return (None,) * 6
    needs = (need_alpha, need_t and grad_depth is not None, need_values and grad_values is not None)
    out = torch.ops.pred.composite_alpha_backward(*grads, *ctx.saved_tensors, ctx.eps, ctx.depth_mid, *needs)
    return *(grad if need else None for grad, need in zip(out, needs, strict=True)), None, None, None


def _fake_backward(
    grad_weights: Tensor | None,
    grad_depth: Tensor | None,
    grad_opacity: Tensor | None,
    grad_values: Tensor | None,
    alpha: Tensor,
    t: Tensor | None,
    values: Tensor | None,
    ray_offsets: Tensor | None,
    eps: float,
    depth_mid: bool,
    need_alpha: bool,
    need_t: bool,
    need_values: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    of_values = alpha.new_empty(0)
    if grad_values is not None:
        of_values = grad_values.new_empty((*alpha.shape, grad_values.shape[1]) if need_values else 0)
    return (
        alpha.new_empty(alpha.shape if need_alpha else 0),
        alpha.new_empty(alpha.shape if need_t else 0),
        of_values,
    )


_native.register("composite_alpha", fake=_fake, setup_context=_save, backward=_backward)
_native.register("composite_alpha_backward", fake=_fake_backward)
