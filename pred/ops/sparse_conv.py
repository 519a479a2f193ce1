# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Sparse 3D convolution along a rulebook."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_like, check_shape, check_tensors, widen
from pred.ops._rulebook import check_tables, padded

_BLOCK_ROWS = 512


def sparse_conv(
    features: Tensor,  # [M, C]
    weight: Tensor,  # [O, kz, ky, kx, C] or [O, K, C]
    out_to_in: Tensor,  # [M', K]
    in_to_out: Tensor,  # [M, K]
    bias: Tensor | None = None,  # [O]
) -> Tensor:  # [M', O]
    """Convolves the active sites: ``out[o] = bias + sum over k, i = out_to_in[o, k] >= 0, of W[:, k] features[i]``.

    With the tables of :func:`build_rulebook` this is ``torch.nn.functional.conv3d`` with zeros at the other sites, read
    at the active outputs (Graham et al., 2018). The tables exchanged give the transposed convolution.

    Args:
        features: ``[M, C]`` float32, float64, bfloat16 or float16. Half precision is added up in float32.
        weight: ``[O, kz, ky, kx, C]``, spconv 2.x's KRSC layout, or ``[O, K, C]``; in the dtype of the features.
        out_to_in, in_to_out: int32, both of one rulebook. The forward pass reads the first, the features' gradient the
            second: tables that do not belong together give a gradient of another function.
        bias: ``[O]`` or None.

    Returns:
        ``[M', O]`` in the dtype of the features, rounded once. A NaN stays in the outputs that read it.

    Raises:
        ValueError: shape, device, 2^31 or more rows, or numbers of a table that are not rows (checked for CPU tensors).
        TypeError: dtype.

    Differentiable any number of times in features, weight and bias. Deterministic for any thread count: products are
    added tap by tap; the weight's gradient in blocks of rows that depend on sizes only.
    """
    op = "sparse_conv"
    _native.refuse_transforms(op)
    features, weight, bias = _arguments(features, weight, out_to_in, in_to_out, bias)
    if not _native.use_native(op, features):
        return _reference(features, weight, out_to_in, bias)
    out: Tensor = _native.checked(
        torch.ops.pred.sparse_conv, features, weight, bias, out_to_in, in_to_out, _native.tf32()
    )
    return out


def sparse_conv_reference(
    features: Tensor,  # [M, C]
    weight: Tensor,  # [O, kz, ky, kx, C] or [O, K, C]
    out_to_in: Tensor,  # [M', K]
    in_to_out: Tensor,  # [M, K]
    bias: Tensor | None = None,  # [O]
) -> Tensor:  # [M', O]
    """Plain PyTorch form of :func:`sparse_conv`: one gather and one product per tap."""
    features, weight, bias = _arguments(features, weight, out_to_in, in_to_out, bias)
    return _reference(features, weight, out_to_in, bias)


def _reference(features: Tensor, weight: Tensor, out_to_in: Tensor, bias: Tensor | None) -> Tensor:
    dtype = features.dtype
    wide = torch.promote_types(dtype, torch.float32)
    with torch.autocast(features.device.type, enabled=False):
        rows, weight = padded(features.to(wide)), weight.to(wide)
        out = rows.new_zeros(out_to_in.shape[0], weight.shape[0])
        if bias is not None:
            out = out + bias.to(wide)
        for tap in range(weight.shape[1]):
            source = out_to_in[:, tap].long()
            product = rows[torch.where(source < 0, features.shape[0], source)] @ weight[:, tap].T
            out = out + torch.where(source[:, None] < 0, 0.0, product)  # not 0 x inf
    return out.to(dtype)


def _arguments(
    features: Tensor, weight: Tensor, out_to_in: Tensor, in_to_out: Tensor, bias: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    op = "sparse_conv"
    check_tensors(op, features=features, weight=weight, **({} if bias is None else {"bias": bias}))
    features, weight, bias = widen(features), widen(weight), None if bias is None else widen(bias)
    check_tables(op, features, out_to_in, in_to_out)
    taps, channels = out_to_in.shape[1], features.shape[1]
    if weight.dim() == 5:
        check_shape(op, "weight", weight, ("O", "kz", "ky", "kx", channels), " with C of features")
        weight = weight.flatten(1, 3)
    check_shape(op, "weight", weight, ("O", taps, channels), " with K of out_to_in and C of features")
    check_like(op, "weight", weight, "features", features)
    if bias is not None:
        check_shape(op, "bias", bias, (weight.shape[0],), " with O of weight")
        check_like(op, "bias", bias, "features", features)
    return features, weight, bias


def _fake(
    features: Tensor, weight: Tensor, bias: Tensor | None, out_to_in: Tensor, in_to_out: Tensor, tf32: bool
) -> Tensor:
    return features.new_empty(out_to_in.shape[0], weight.shape[0])


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    features, weight, bias, out_to_in, in_to_out, _ = inputs
    ctx.save_for_backward(features, weight, out_to_in, in_to_out)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    features, weight, out_to_in, in_to_out = ctx.saved_tensors
    need_features, need_weight, need_bias = ctx.needs_input_grad[:3]
    grad_features = grad_weight = grad_bias = None
    if need_features or need_weight:
        grad_features, grad_weight = torch.ops.pred.sparse_conv_backward(
            grad, features, weight, out_to_in, in_to_out, need_features, need_weight, _native.tf32()
        )
    if need_bias:
        grad_bias = _sum_of_rows(grad)
    return (grad_features if need_features else None, grad_weight if need_weight else None, grad_bias, *(None,) * 3)


def _sum_of_rows(rows: Tensor) -> Tensor:
    """``[O]`` of ``[M, O]``, in blocks: equal for any number of threads, and precise for any number of rows."""
    block = torch.arange(rows.shape[0], device=rows.device) // _BLOCK_ROWS
    num_blocks = (rows.shape[0] + _BLOCK_ROWS - 1) // _BLOCK_ROWS
    wide = rows.to(torch.promote_types(rows.dtype, torch.float32))
    sums = torch.ops.pred.segment_reduce(wide, block, num_blocks, "sum")[0].double()
    total = torch.ops.pred.segment_reduce(sums, torch.zeros_like(block[:num_blocks]), 1, "sum")[0][0]
    return total.to(rows.dtype)


def _fake_backward(
    grad: Tensor,
    features: Tensor,
    weight: Tensor,
    out_to_in: Tensor,
    in_to_out: Tensor,
    need_features: bool,
    need_weight: bool,
    tf32: bool,
) -> tuple[Tensor, Tensor]:
    outputs, taps, inputs = weight.shape
    return (
        features.new_empty(features.shape[0] if need_features else 0, inputs),
        weight.new_empty(outputs if need_weight else 0, taps, inputs),
    )


def _save_backward(ctx: Any, inputs: Any, output: Any) -> None:
    grad, features, weight, out_to_in, in_to_out, ctx.need_features, ctx.need_weight, _ = inputs
    ctx.save_for_backward(grad, features, weight, out_to_in, in_to_out)


def _double_backward(ctx: Any, grad_features: Tensor | None, grad_weight: Tensor | None) -> tuple[Tensor | None, ...]:
    """The backward pass is bilinear: in ``grad`` and the weight for the features', in ``grad`` and the features for the
    weight's. Its derivatives are the convolution and its gradients again."""
    grad, features, weight, out_to_in, in_to_out = ctx.saved_tensors
    need_grad, need_features, need_weight = ctx.needs_input_grad[:3]
    found: list[Tensor | None] = [None, None, None]
    conv, backward = torch.ops.pred.sparse_conv, torch.ops.pred.sparse_conv_backward
    tables, tf32 = (out_to_in, in_to_out), _native.tf32()
    if ctx.need_features and grad_features is not None:
        if need_grad:
            found[0] = conv(grad_features, weight, None, *tables, tf32)
        if need_weight:
            found[2] = backward(grad, grad_features, weight, *tables, False, True, tf32)[1]
    if ctx.need_weight and grad_weight is not None:
        if need_grad:
            more = conv(features, grad_weight, None, *tables, tf32)
            found[0] = more if found[0] is None else found[0] + more
        if need_features:
            found[1] = backward(grad, features, grad_weight, *tables, True, False, tf32)[0]
    return (*found, *(None,) * 5)


_native.register("sparse_conv", fake=_fake, setup_context=_save, backward=_backward)
_native.register("sparse_conv_backward", fake=_fake_backward, setup_context=_save_backward, backward=_double_backward)
