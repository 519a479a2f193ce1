# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Opacity of ray samples from signed distances or densities."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import (
    FLOATING,
    as_geometry,
    check_choice,
    check_dtype,
    check_like,
    check_number,
    check_offsets,
    check_shape,
    check_tensors,
)


def sdf_to_alpha(
    sdf: Tensor,  # [R, S], [R, S, 1] or [P]
    inv_s: Tensor | float | None = None,
    mode: str = "pair",
    last: str = "zero",
    *,
    cosine: Tensor | None = None,  # as sdf
    section_length: Tensor | None = None,  # as sdf
    cos_anneal: float = 1.0,
    eps: float = 0.0,
    ray_offsets: Tensor | None = None,  # [R + 1]
) -> Tensor:  # [R, S] or [P]
    """Opacity of each sample of a ray, in one of three ways. ``Phi(d) = sigmoid(inv_s d)``.

    ``"pair"`` (PRED, Eq. 4) takes the signed distances at a sample and at the next one:
    ``alpha_i = max((Phi(d_i) - Phi(d_{i+1})) / Phi(d_i), 0)``, computed as
    ``sigmoid(-inv_s d_{i+1}) * -expm1(-inv_s max(d_i - d_{i+1}, 0))``, which neither cancels nor divides 0 by 0.

    ``"section"`` (NeuS, Eq. 13 and its code; UniPAD, PonderV2) takes one distance and the angle between ray and normal.
    The distance falls at the rate ``f = relu(0.5 - 0.5 cosine) (1 - cos_anneal) + relu(-cosine) cos_anneal``, so that
    the section's ends are at ``d_prev = d + f section_length / 2`` and ``d_next = d - f section_length / 2``. With
    ``eps = 0``, ``alpha = (Phi(d_prev) - Phi(d_next)) / Phi(d_prev)`` in the closed form above; with ``eps > 0``,
    ``clip((Phi(d_prev) - Phi(d_next) + eps) / (Phi(d_prev) + eps), 0, 1)`` in this order of operations, as published
    (``eps = 1e-5``). The published form is wrong inside of surfaces (opacity 1 where the distance rises) and in free
    space (opacity ``eps`` per sample); it is there for parity.

    ``"density"`` (NeRF, nerfacc): ``alpha = 1 - exp(-density section_length)`` by ``expm1``.

    Args:
        sdf: signed distances along each ray in metres, positive in front of the surface; ``[R, S]`` or ``[R, S, 1]``,
            or ``[P]``: packed rays (also ``[P, 1]``) in mode pair, any samples in the other modes. In mode section, the
            distance at the middle of the section (NeuS) or at its start (UniPAD); in mode density, the density per
            metre. float32 or float64; half precision is widened to float32.
        inv_s: sharpness per metre, finite and not negative: a number, or a tensor of one element on the device of
            ``sdf``. None in mode density.
        mode: ``"pair"``, ``"section"`` or ``"density"``.
        last: mode pair: opacity of a ray's last sample, which has no successor: ``"zero"`` or ``"opaque"`` (1).
        cosine: mode section: product of ray direction and normal, not clipped; shape and dtype of ``sdf``.
        section_length: modes section and density: metres from each sample to the next; shape and dtype of ``sdf``.
        cos_anneal: mode section: 0 (a ray counts as half facing the surface, so that none is without gradient, NeuS's
            start) to 1 (the true angle).
        eps: mode section: 0, or the published formula's constant.
        ray_offsets: mode pair: packed rays, ray r being samples ``[ray_offsets[r], ray_offsets[r + 1])`` of ``[P]``;
            int64, ascending from 0 to P.

    Returns:
        ``[R, S]`` (also for ``[R, S, 1]``) or ``[P]`` (also for packed ``[P, 1]``). In [0, 1]; exactly 0 where the
        distance does not fall (except with ``eps > 0``). A negative density gives a negative opacity, as its formula
        does. A NaN stays in its ray, in modes section and density in its sample.

    Raises:
        ValueError: shape, device, range, an unknown choice, an argument that the mode does not have, or the value of
            ``inv_s`` or ``ray_offsets`` (except for tensors on another device than the CPU, where a wrong ``inv_s``
            makes everything NaN). TypeError: dtype.

    Differentiable once in ``sdf``, ``inv_s``, ``cosine`` and ``section_length``. The derivative of ``max`` at a tie and
    of ``relu`` at 0 is 0; that of ``clip`` on its bounds is 1, as in PyTorch. Deterministic for any thread count.
    """
    _native.refuse_transforms("sdf_to_alpha")
    _check_mode(mode, inv_s, last, cosine, section_length, cos_anneal, eps, ray_offsets)
    arguments: tuple[Any, ...]
    if inv_s is None:
        op, arguments = "sdf_to_alpha_density", (*_elementwise(sdf, section_length=section_length),)
    elif mode == "section":
        sharpness, tensors = _section(sdf, inv_s, cosine, section_length)
        op, arguments = (
            "sdf_to_alpha_section",
            (tensors[0], sharpness, *tensors[1:], _scalar(cos_anneal, tensors[0]), eps),
        )
    else:
        checked = _pair(sdf, inv_s, ray_offsets)
        op, arguments = "sdf_to_alpha", (*checked, last == "opaque", ray_offsets)
    if not _native.use_native("sdf_to_alpha", sdf):
        return sdf_to_alpha_reference(
            sdf,
            inv_s,
            mode,
            last,
            cosine=cosine,
            section_length=section_length,
            cos_anneal=cos_anneal,
            eps=eps,
            ray_offsets=ray_offsets,
        )
    out: Tensor = _native.checked(getattr(torch.ops.pred, op), *arguments)
    return out


def sdf_to_alpha_reference(
    sdf: Tensor,  # [R, S], [R, S, 1] or [P]
    inv_s: Tensor | float | None = None,
    mode: str = "pair",
    last: str = "zero",
    *,
    cosine: Tensor | None = None,  # as sdf
    section_length: Tensor | None = None,  # as sdf
    cos_anneal: float = 1.0,
    eps: float = 0.0,
    ray_offsets: Tensor | None = None,  # [R + 1]
) -> Tensor:  # [R, S] or [P]
    """Plain PyTorch form of :func:`sdf_to_alpha`, differentiable any number of times."""
    _check_mode(mode, inv_s, last, cosine, section_length, cos_anneal, eps, ray_offsets)
    if inv_s is None:
        density, length = _elementwise(sdf, section_length=section_length)
        return -torch.expm1(-density * length)
    if mode == "section":
        inv_s, (sdf, cosine, length) = _section(sdf, inv_s, cosine, section_length)
        inv_s = valid_sharpness("sdf_to_alpha", inv_s)
        fall = torch.relu(0.5 - 0.5 * cosine) * (1 - cos_anneal) + torch.relu(-cosine) * cos_anneal
        half = fall * length * 0.5
        if eps == 0:
            drop = fall * length
            drop = torch.where(drop < 0, torch.zeros_like(drop), drop)  # clamp() has a derivative of 1 or 0 at 0
            return _closed_form(inv_s, sdf - half, drop)
        start, end = torch.sigmoid(inv_s * (sdf + half)), torch.sigmoid(inv_s * (sdf - half))
        return ((start - end + eps) / (start + eps)).clip(0, 1)
    sdf, inv_s = _pair(sdf, inv_s, ray_offsets)
    inv_s = valid_sharpness("sdf_to_alpha", inv_s)
    end_alpha = 1.0 if last == "opaque" else 0.0
    if ray_offsets is None:
        alpha = _closed_form(inv_s, sdf[:, 1:], torch.relu(sdf[:, :-1] - sdf[:, 1:]))  # relu: derivative 0 at a tie
        return torch.cat([alpha, torch.full_like(sdf[:, :1], end_alpha)], dim=1)
    sample = torch.arange(sdf.shape[0], device=sdf.device)
    ray_end = ray_offsets[1:].contiguous()
    is_last = sample + 1 == ray_end[torch.searchsorted(ray_end, sample, right=True)]
    after = sdf[torch.where(is_last, sample, sample + 1)]
    return torch.where(is_last, end_alpha, _closed_form(inv_s, after, torch.relu(sdf - after)))


def _closed_form(inv_s: Tensor, next_sdf: Tensor, drop: Tensor) -> Tensor:
    return torch.sigmoid(-inv_s * next_sdf) * -torch.expm1(-inv_s * drop)


def _check_mode(
    mode: str,
    inv_s: Tensor | float | None,
    last: str,
    cosine: Tensor | None,
    section_length: Tensor | None,
    cos_anneal: float,
    eps: float,
    ray_offsets: Tensor | None,
) -> None:
    op = "sdf_to_alpha"
    check_choice(op, "mode", mode, ("pair", "section", "density"))
    check_choice(op, "last", last, ("zero", "opaque"))
    needed = {"pair": ("inv_s",), "section": ("inv_s", "cosine", "section_length"), "density": ("section_length",)}
    given = {"inv_s": inv_s, "cosine": cosine, "section_length": section_length, "ray_offsets": ray_offsets}
    for name, value in given.items():
        if value is None and name in needed[mode]:
            raise ValueError(f"{op}: {name} must be given in mode {mode!r}, got None")
        if value is not None and name not in needed[mode] and not (name == "ray_offsets" and mode == "pair"):
            raise ValueError(f"{op}: {name} must be None in mode {mode!r}, got a value")
    if mode != "pair" and last != "zero":
        raise ValueError(f"{op}: last must be 'zero' in mode {mode!r}, where every sample has an end, got {last!r}")
    check_number(op, "cos_anneal", cos_anneal)
    check_number(op, "eps", eps)
    if not 0 <= cos_anneal <= 1:
        raise ValueError(f"{op}: cos_anneal must be in [0, 1], got {cos_anneal}")
    if not 0 <= eps < math.inf:
        raise ValueError(f"{op}: eps must be finite and not negative, got {eps}")


def _elementwise(sdf: Tensor, **others: Tensor | None) -> list[Tensor]:
    """``sdf``, or the densities, ``[R, S]`` or ``[P]``, and other tensors of its shape."""
    op = "sdf_to_alpha"
    check_tensors(op, sdf=sdf, **others)
    sdf = as_geometry(sdf, 2)
    if sdf.dim() not in (1, 2):
        raise ValueError(f"{op}: sdf must have shape [R, S], [R, S, 1] or [P], got {list(sdf.shape)}")
    check_dtype(op, "sdf", sdf, FLOATING)
    tensors = [sdf]
    for name, other in others.items():
        assert other is not None  # by _check_mode
        tensors.append(as_geometry(other, 2))
        check_shape(op, name, tensors[-1], sdf.shape, " as sdf")
        check_like(op, name, tensors[-1], "sdf", sdf)
    return tensors


def _section(
    sdf: Tensor, inv_s: Tensor | float, cosine: Tensor | None, section_length: Tensor | None
) -> tuple[Tensor, list[Tensor]]:
    tensors = _elementwise(sdf, cosine=cosine, section_length=section_length)
    return sharpness_argument("sdf_to_alpha", inv_s, tensors[0]), tensors


def _pair(sdf: Tensor, inv_s: Tensor | float, ray_offsets: Tensor | None) -> tuple[Tensor, Tensor]:
    op = "sdf_to_alpha"
    check_tensors(op, sdf=sdf, **({} if ray_offsets is None else {"ray_offsets": ray_offsets}))
    sdf = as_geometry(sdf, 2 if ray_offsets is None else 1)
    check_shape(op, "sdf", sdf, ("R", "S") if ray_offsets is None else ("P",))
    check_dtype(op, "sdf", sdf, FLOATING)
    if ray_offsets is not None:
        check_offsets(op, "ray_offsets", ray_offsets, "RP", "sdf", sdf)
    return sdf, sharpness_argument(op, inv_s, sdf)


def sharpness_argument(op: str, inv_s: Tensor | float, sdf: Tensor) -> Tensor:
    """The sharpness as a tensor without dimensions, of the dtype of ``sdf``."""
    if not isinstance(inv_s, Tensor):
        check_number(op, "inv_s", inv_s)
        if not 0 <= inv_s < math.inf:
            raise ValueError(f"{op}: inv_s must be finite and not negative, got {inv_s}")
        return _scalar(float(inv_s), sdf)
    check_tensors(op, inv_s=inv_s)
    if inv_s.numel() != 1:
        raise ValueError(f"{op}: inv_s must have one element, got shape {list(inv_s.shape)}")
    if not inv_s.is_floating_point():
        raise TypeError(f"{op}: inv_s must be a floating-point tensor, got {inv_s.dtype}")
    if inv_s.device != sdf.device:
        raise ValueError(f"{op}: inv_s must be on the device of sdf ({sdf.device}), got {inv_s.device}")
    return inv_s.reshape(()).to(sdf.dtype)


def _scalar(value: float, like: Tensor) -> Tensor:
    """A number that may change with every training step, as a tensor; torch.compile would make new_full() a constant
    of the graph."""
    return like.new_ones(()) * value


def valid_sharpness(op: str, inv_s: Tensor) -> Tensor:
    """The sharpness; a value that means nothing is an error where reading it is free, and NaN elsewhere."""
    valid = (inv_s >= 0) & inv_s.isfinite()
    if inv_s.device.type == "cpu" and not torch.compiler.is_compiling() and not valid:
        raise ValueError(f"{op}: inv_s must be finite and not negative, got {float(inv_s)}")
    return torch.where(valid, inv_s, torch.nan)


def _wanted(tensors: tuple[Tensor, ...], needs: tuple[bool, ...]) -> tuple[Tensor | None, ...]:
    return tuple(tensor if need else None for tensor, need in zip(tensors, needs, strict=True))


def _fake(sdf: Tensor, inv_s: Tensor, opaque: bool, ray_offsets: Tensor | None = None) -> Tensor:
    return sdf.new_empty(sdf.shape)


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    sdf, inv_s, _, ray_offsets = inputs
    ctx.save_for_backward(sdf, inv_s, ray_offsets)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    sdf, inv_s, ray_offsets = ctx.saved_tensors
    needs = ctx.needs_input_grad[:2]
    grads = torch.ops.pred.sdf_to_alpha_backward(grad, sdf, inv_s, *needs, ray_offsets)
    return *_wanted(grads, needs), None, None


def _fake_backward(
    grad: Tensor, sdf: Tensor, inv_s: Tensor, need_sdf: bool, need_inv_s: bool, ray_offsets: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    return sdf.new_empty(sdf.shape if need_sdf else 0), sdf.new_empty(() if need_inv_s else 0)


def _fake_section(
    sdf: Tensor, inv_s: Tensor, cosine: Tensor, section_length: Tensor, cos_anneal: Tensor, eps: float
) -> Tensor:
    return sdf.new_empty(sdf.shape)


def _save_section(ctx: Any, inputs: Any, output: Any) -> None:
    *tensors, ctx.eps = inputs
    ctx.save_for_backward(*tensors)


def _backward_section(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    needs = ctx.needs_input_grad[:4]
    grads = torch.ops.pred.sdf_to_alpha_section_backward(grad, *ctx.saved_tensors, ctx.eps, *needs)
    return *_wanted(grads, needs), None, None


def _fake_section_backward(
    grad: Tensor,
    sdf: Tensor,
    inv_s: Tensor,
    cosine: Tensor,
    section_length: Tensor,
    cos_anneal: Tensor,
    eps: float,
    need_sdf: bool,
    need_inv_s: bool,
    need_cosine: bool,
    need_section_length: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    shapes = [sdf.shape if need else (0,) for need in (need_sdf, need_cosine, need_section_length)]
    of_sdf, of_cosine, of_length = (sdf.new_empty(shape) for shape in shapes)
    return of_sdf, sdf.new_empty(() if need_inv_s else 0), of_cosine, of_length


def _fake_density(density: Tensor, section_length: Tensor) -> Tensor:
    return density.new_empty(density.shape)


def _save_density(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs)


def _backward_density(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    needs = ctx.needs_input_grad
    return _wanted(torch.ops.pred.sdf_to_alpha_density_backward(grad, *ctx.saved_tensors, *needs), needs)


def _fake_density_backward(
    grad: Tensor, density: Tensor, section_length: Tensor, need_density: bool, need_section_length: bool
) -> tuple[Tensor, Tensor]:
    shapes = [density.shape if need else (0,) for need in (need_density, need_section_length)]
    return density.new_empty(shapes[0]), density.new_empty(shapes[1])


_native.register("sdf_to_alpha", fake=_fake, setup_context=_save, backward=_backward)
_native.register("sdf_to_alpha_backward", fake=_fake_backward)
_native.register("sdf_to_alpha_section", fake=_fake_section, setup_context=_save_section, backward=_backward_section)
_native.register("sdf_to_alpha_section_backward", fake=_fake_section_backward)
_native.register("sdf_to_alpha_density", fake=_fake_density, setup_context=_save_density, backward=_backward_density)
_native.register("sdf_to_alpha_density_backward", fake=_fake_density_backward)
