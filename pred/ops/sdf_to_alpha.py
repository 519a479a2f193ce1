# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Opacity of ray samples from signed distances."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import FLOATING, check_choice, check_dtype, check_shape, check_tensors, widen


def sdf_to_alpha(
    sdf: Tensor,  # [R, S]
    inv_s: Tensor | float,
    mode: str = "pair",
    last: str = "zero",
) -> Tensor:  # [R, S]
    """Opacity of each sample from the signed distances at it and at the next one (PRED, Eq. 4).

    ``alpha_i = max((Phi(d_i) - Phi(d_{i+1})) / Phi(d_i), 0)`` with ``Phi(d) = sigmoid(inv_s d)``, computed as
    ``sigmoid(-inv_s d_{i+1}) * -expm1(-inv_s max(d_i - d_{i+1}, 0))``, which neither cancels nor divides 0 by 0.

    Args:
        sdf: ``[R, S]`` or ``[R, S, 1]`` signed distances along each ray, float32 or float64, in metres; positive in
            front of the surface.
        inv_s: sharpness per metre, finite and not negative: a number, or a tensor of one element on the device of
            ``sdf``.
        mode: ``"pair"`` is what exists.
        last: opacity of the last sample, which has no successor: ``"zero"`` or ``"opaque"`` (1).

    Returns:
        ``[R, S]`` in [0, 1]; exactly 0 where the distance does not fall. A NaN distance stays in its ray.

    Raises:
        ValueError: shape, device, ``mode``, ``last``, or the value of ``inv_s`` (except for a tensor on another device
            than the CPU, where a wrong value makes everything NaN). TypeError: dtype.

    Differentiable once in ``sdf`` and ``inv_s``; the derivative of ``max`` at a tie is 0. Deterministic for any thread
    count.
    """
    if not _native.use_native("sdf_to_alpha", sdf):
        return sdf_to_alpha_reference(sdf, inv_s, mode, last)
    sdf, inv_s = sdf_arguments("sdf_to_alpha", sdf, inv_s, mode, last)
    out: Tensor = torch.ops.pred.sdf_to_alpha(sdf, inv_s, last == "opaque")
    return out


def sdf_to_alpha_reference(
    sdf: Tensor,  # [R, S]
    inv_s: Tensor | float,
    mode: str = "pair",
    last: str = "zero",
) -> Tensor:  # [R, S]
    """Plain PyTorch form of :func:`sdf_to_alpha`, differentiable any number of times."""
    sdf, inv_s = sdf_arguments("sdf_to_alpha", sdf, inv_s, mode, last)
    inv_s = valid_sharpness("sdf_to_alpha", inv_s)
    drop = torch.relu(sdf[:, :-1] - sdf[:, 1:])  # relu: derivative 0 at a tie
    alpha = torch.sigmoid(-inv_s * sdf[:, 1:]) * -torch.expm1(-inv_s * drop)
    end = torch.full_like(sdf[:, :1], 1.0 if last == "opaque" else 0.0)
    return torch.cat([alpha, end], dim=1)


def sdf_arguments(op: str, sdf: Tensor, inv_s: Tensor | float, mode: str, last: str) -> tuple[Tensor, Tensor]:
    """Checked ``sdf`` as ``[R, S]`` and ``inv_s`` as a tensor without dimensions, of one dtype."""
    check_tensors(op, sdf=sdf)
    check_choice(op, "mode", mode, ("pair",))
    check_choice(op, "last", last, ("zero", "opaque"))
    if sdf.dim() == 3 and sdf.shape[2] == 1:
        sdf = sdf[..., 0]
    check_shape(op, "sdf", sdf, ("R", "S"))
    sdf = widen(sdf)
    check_dtype(op, "sdf", sdf, FLOATING)
    if not isinstance(inv_s, Tensor):
        if not (inv_s >= 0 and math.isfinite(inv_s)):
            raise ValueError(f"{op}: inv_s must be finite and not negative, got {inv_s}")
        return sdf, sdf.new_full((), inv_s)
    if inv_s.numel() != 1:
        raise ValueError(f"{op}: inv_s must have one element, got shape {list(inv_s.shape)}")
    if not inv_s.is_floating_point():
        raise TypeError(f"{op}: inv_s must be a floating-point tensor, got {inv_s.dtype}")
    if inv_s.device != sdf.device:
        raise ValueError(f"{op}: inv_s must be on the device of sdf ({sdf.device}), got {inv_s.device}")
    return sdf, inv_s.reshape(()).to(sdf.dtype)


def valid_sharpness(op: str, inv_s: Tensor) -> Tensor:
    """The sharpness; a value that means nothing is an error where reading it is free, and NaN elsewhere."""
    valid = (inv_s >= 0) & inv_s.isfinite()
    if inv_s.device.type == "cpu" and not torch.compiler.is_compiling() and not valid:
        raise ValueError(f"{op}: inv_s must be finite and not negative, got {float(inv_s)}")
    return torch.where(valid, inv_s, torch.nan)


def _fake(sdf: Tensor, inv_s: Tensor, opaque: bool) -> Tensor:
    return sdf.new_empty(sdf.shape)


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    sdf, inv_s, _ = inputs
    ctx.save_for_backward(sdf, inv_s)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    sdf, inv_s = ctx.saved_tensors
    need_sdf, need_inv_s = ctx.needs_input_grad[:2]
    grad_sdf, grad_inv_s = torch.ops.pred.sdf_to_alpha_backward(grad, sdf, inv_s, need_sdf, need_inv_s)
    return grad_sdf if need_sdf else None, grad_inv_s if need_inv_s else None, None


def _fake_backward(grad: Tensor, sdf: Tensor, inv_s: Tensor, need_sdf: bool, need_inv_s: bool) -> tuple[Tensor, Tensor]:
    return sdf.new_empty(sdf.shape if need_sdf else 0), sdf.new_empty(() if need_inv_s else 0)


_native.register("sdf_to_alpha", fake=_fake, setup_context=_save, backward=_backward)
_native.register("sdf_to_alpha_backward", fake=_fake_backward)
