# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Volume rendering along rays: weights, depth, opacity and any channels in one pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_choice, check_flags, check_tensors
from pred.ops._composite import Composite, check_options, composite_arguments, composite_reference, layout
from pred.ops.sdf_to_alpha import sdf_to_alpha_reference, sharpness_argument, valid_sharpness


def composite_rays(
    sdf: Tensor,  # [R, S] or [P]
    inv_s: Tensor | float,
    t: Tensor,  # as sdf
    values: Tensor | None = None,  # [R, S, C] or [P, C]
    *,
    ray_offsets: Tensor | None = None,  # [R + 1]
    depth_at: str = "start",
    normalize_depth: bool = False,
    last: str = "zero",
    detach_sdf: bool = False,
    detach_inv_s: bool = True,
    normalize_eps: float = 1e-10,
) -> Composite:
    """Renders depth and channels from signed distances along rays (PRED, Eq. 4 and 6).

    ``w_i = alpha_i prod_{j<i} (1 - alpha_j)`` with the opacities of :func:`pred.ops.sdf_to_alpha`;
    ``depth = sum_i w_i t_i``, ``opacity = sum_i w_i``, ``values = sum_i w_i values_i``. Weight i belongs to the section
    from ``t_i`` to ``t_{i+1}``.

    Args:
        sdf: ``[R, S]`` or ``[R, S, 1]`` signed distances in metres, float32, float64, or half precision, which is
            computed in float32.
        inv_s: sharpness per metre, finite and not negative: a number, or a tensor of one element.
        t: range of each sample in metres, shape and dtype of ``sdf``.
        values: ``[R, S, C]`` anything to be rendered, such as class probabilities, in the dtype of ``sdf``, or
            bfloat16 or float16 beside float32: read as stored, summed in float32.
        ray_offsets: ``[R + 1]`` int64, ascending from 0 to P, for packed rays of different lengths: ray r owns the
            samples from ``ray_offsets[r]`` up to ``ray_offsets[r + 1]``, none or many, of ``sdf [P]``, ``t [P]`` and
            ``values [P, C]``.
        depth_at: where a section's depth is read: its ``"start"`` ``t_i``, or its middle (``"mid"``); the last sample
            of a ray, which has no end, counts at its own ``t``.
        normalize_depth: divide the depth by ``opacity + normalize_eps``. By default a ray that is partly
            transparent is nearer than its surface, as in the paper.
        last: opacity of each ray's last sample, ``"zero"`` or ``"opaque"`` (1, so that the weights sum to 1).
        detach_sdf: treat ``sdf`` as a constant, as the semantic loss does; skips that part of the backward pass.
        detach_inv_s: with ``detach_sdf``, treat ``inv_s`` as a constant too.
        normalize_eps: see ``normalize_depth``; a ray of opacity 0 has depth 0.

    Returns:
        :class:`Composite`: ``weights`` like ``sdf``, ``depth [R]``, ``opacity [R]``, and ``values [R, C]`` in their own
        dtype or None. A ray that meets no surface has weights 0; depth, opacity and values of a ray without samples are
        0. A NaN stays in its ray (and in the gradient of ``inv_s``, which all rays share).

    Raises:
        ValueError: shape, device, an unknown choice, offsets (values are checked for CPU tensors), the value of
        ``inv_s`` (see :func:`pred.ops.sdf_to_alpha`), or 2^40 or more rays or 2^31 or more channels (compiled).
        TypeError: dtype.

    Differentiable once in ``sdf``, ``inv_s``, ``t`` and ``values``, through all outputs; exact for opacities 0 and 1.
    Deterministic for any thread count.
    """
    _native.refuse_transforms("composite_rays")
    check_options("composite_rays", depth_at, normalize_depth, normalize_eps)
    sdf, inv_s, t, values = _arguments(sdf, inv_s, t, values, ray_offsets, last, detach_sdf, detach_inv_s)
    if not _native.use_native("composite_rays", sdf):
        return composite_rays_reference(
            sdf,
            inv_s,
            t,
            values,
            ray_offsets=ray_offsets,
            depth_at=depth_at,
            normalize_depth=normalize_depth,
            last=last,
            detach_sdf=detach_sdf,
            detach_inv_s=detach_inv_s,
            normalize_eps=normalize_eps,
        )
    weights, depth, opacity, rendered, _ = _native.checked(
        torch.ops.pred.composite_rays, sdf, inv_s, t, values, ray_offsets, depth_at == "mid", last == "opaque"
    )
    if normalize_depth:
        depth = depth / (opacity + normalize_eps)
    return Composite(weights, depth, opacity, None if values is None else rendered)


def composite_rays_reference(
    sdf: Tensor,  # [R, S] or [P]
    inv_s: Tensor | float,
    t: Tensor,  # as sdf
    values: Tensor | None = None,  # [R, S, C] or [P, C]
    *,
    ray_offsets: Tensor | None = None,  # [R + 1]
    depth_at: str = "start",
    normalize_depth: bool = False,
    last: str = "zero",
    detach_sdf: bool = False,
    detach_inv_s: bool = True,
    normalize_eps: float = 1e-10,
) -> Composite:
    """Plain PyTorch form of :func:`composite_rays`, with optical depths ``tau = -log(1 - alpha)``.

    Packed rays become rows as long as the longest ray.
    """
    check_options("composite_rays", depth_at, normalize_depth, normalize_eps)
    sdf, inv_s, t, values = _arguments(sdf, inv_s, t, values, ray_offsets, last, detach_sdf, detach_inv_s)
    inv_s = valid_sharpness("composite_rays", inv_s)
    places = layout(sdf, ray_offsets)
    sdf = places.spread(sdf)
    end = torch.full_like(sdf, 1.0 if last == "opaque" else 0.0)
    alpha = torch.where(places.last, end, sdf_to_alpha_reference(sdf, inv_s))
    # 1 - alpha_i = Phi(d_{i+1}) / Phi(d_i). The difference of logarithms is inexact for small alpha, log1p for large;
    # where() twice keeps the other branch's derivative finite.
    log_phi = torch.nn.functional.logsigmoid(inv_s * sdf)
    section = alpha[:, :-1]
    thin = ~(section > 0.5)  # so that NaN stays NaN
    thin_tau = -torch.log1p(-torch.where(thin, section, torch.zeros_like(section)))
    tau = torch.where(thin, thin_tau, log_phi[:, :-1] - log_phi[:, 1:])
    transmittance = torch.exp(-torch.cat([torch.zeros_like(sdf[:, :1]), tau.cumsum(dim=1)], dim=1))
    weights = torch.where(places.valid, transmittance * alpha, torch.zeros_like(alpha))
    return composite_reference(weights, t, values, places, depth_at, normalize_depth, normalize_eps)


def _arguments(
    sdf: Tensor,
    inv_s: Tensor | float,
    t: Tensor,
    values: Tensor | None,
    ray_offsets: Tensor | None,
    last: str,
    detach_sdf: bool,
    detach_inv_s: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    op = "composite_rays"
    check_tensors(op, t=t)
    check_flags(op, detach_sdf=detach_sdf, detach_inv_s=detach_inv_s)
    sdf, ranges, values = composite_arguments(op, "sdf", sdf, t, values, ray_offsets)
    assert ranges is not None
    check_choice(op, "last", last, ("zero", "opaque"))
    inv_s = sharpness_argument(op, inv_s, sdf)
    if detach_sdf:
        sdf = sdf.detach()
        inv_s = inv_s.detach() if detach_inv_s else inv_s
    return sdf, inv_s, ranges, values


def _fake(
    sdf: Tensor,
    inv_s: Tensor,
    t: Tensor,
    values: Tensor | None,
    ray_offsets: Tensor | None,
    depth_mid: bool,
    last_opaque: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rays = sdf.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1
    rendered = sdf.new_empty(0) if values is None else values.new_empty(rays, values.shape[-1])
    return sdf.new_empty(sdf.shape), sdf.new_empty(rays), sdf.new_empty(rays), rendered, sdf.new_empty(rays)


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    sdf, inv_s, t, values, ray_offsets, ctx.depth_mid, ctx.last_opaque = inputs
    weights, _, _, rendered, remaining = output
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(remaining, *([rendered] if values is None else []))
    distances = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
    ctx.save_for_backward(sdf, inv_s, t, values if distances else None, ray_offsets, weights, remaining)


def _backward(
    ctx: Any,
    grad_weights: Tensor | None,
    grad_depth: Tensor | None,
    grad_opacity: Tensor | None,
    grad_values: Tensor | None,
    _: Tensor | None,
) -> tuple[Tensor | None, ...]:
    need_sdf, need_inv_s, need_t, need_values = ctx.needs_input_grad[:4]
    grads = (grad_weights, grad_depth, grad_opacity, grad_values)
    if all(grad is None for grad in grads):
        return (None,) * 7
    needs = (need_sdf, need_inv_s, need_t and grad_depth is not None, need_values and grad_values is not None)
    out = torch.ops.pred.composite_rays_backward(*grads, *ctx.saved_tensors, ctx.depth_mid, ctx.last_opaque, *needs)
    return *(grad if need else None for grad, need in zip(out, needs, strict=True)), None, None, None


def _fake_backward(
    grad_weights: Tensor | None,
    grad_depth: Tensor | None,
    grad_opacity: Tensor | None,
    grad_values: Tensor | None,
    sdf: Tensor,
    inv_s: Tensor,
    t: Tensor,
    values: Tensor | None,
    ray_offsets: Tensor | None,
    weights: Tensor,
    remaining: Tensor,
    depth_mid: bool,
    last_opaque: bool,
    need_sdf: bool,
    need_inv_s: bool,
    need_t: bool,
    need_values: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    of_values = sdf.new_empty(0)
    if grad_values is not None:
        of_values = grad_values.new_empty((*sdf.shape, grad_values.shape[1]) if need_values else 0)
    return (
        sdf.new_empty(sdf.shape if need_sdf else 0),
        sdf.new_empty(() if need_inv_s else 0),
        sdf.new_empty(sdf.shape if need_t else 0),
        of_values,
    )


_native.register("composite_rays", fake=_fake, setup_context=_save, backward=_backward)
_native.register("composite_rays_backward", fake=_fake_backward)
