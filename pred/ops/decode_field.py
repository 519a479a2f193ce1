# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Signed distance, class logits and the distance's gradient of an MLP that is conditioned on a BEV map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pred import _native
from pred.ops._check import (
    FLOATING,
    HALF,
    as_geometry,
    check_choice,
    check_count,
    check_dtype,
    check_features,
    check_flags,
    check_floats,
    check_like,
    check_number,
    check_shape,
    check_tensors,
    widen,
)
from pred.ops.sample_bev import sample_bev_reference, sample_bev_with_grad_reference

OP = "decode_field"
MAX_HIDDEN = 4096
MAX_LAYERS = 16
MAX_FREQUENCIES = 16


class DecodedField(NamedTuple):
    """What :func:`decode_field` returns."""

    sdf: Tensor
    """``[B, N]`` signed distance, metres, positive in free space."""
    semantics: Tensor | None
    """``[B, N, K]`` class logits; None where the output layer has one row."""
    gradient: Tensor | None
    """``[B, N, 3]`` d sdf / d point, metres per metre; None where it was not asked for."""


class _Settings(NamedTuple):
    """What is not a tensor."""

    point_range: tuple[float, ...]
    frequencies: int
    softplus_beta: float
    sdf_scale: float

    def box(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Centre and half extent of the range box, metres."""
        low, high = like.new_tensor(self.point_range, dtype=torch.float64).view(2, 3)
        return ((low + high) / 2).to(like), ((high - low) / 2).to(like)


def project_bev(
    bev: Tensor,  # [B, C, H, W]
    weight: Tensor,  # [hidden, C + 3 + 6 F]
    precision: Literal["fp32", "bf16"] = "fp32",
) -> Tensor:  # [B, hidden, H, W]
    """The first layer's share of the map, for callers that decode several sets of points from one map.

    Bilinear sampling is linear, so the layer's feature columns may be applied before it: once per cell of the map
    in place of once per point. ``decode_field(project_bev(bev, weights[0]), ..., projected=True)`` equals
    ``decode_field(bev, ...)``.

    Args:
        bev: ``[B, C, H, W]`` float32 or float64, or half precision, which is widened.
        weight: weight of the decoder's first layer, float64 with a float64 map, else float32; its first C columns are
            applied.
        precision: as in :func:`decode_field`.

    Returns:
        ``[B, hidden, H, W]`` in the weight's dtype, with ``"bf16"`` in bfloat16, and in channels-last memory.
        Differentiable once; deterministic for any number of threads. With ``"bf16"``, torch adds the gradients of
        several uses in bfloat16.

    Raises:
        ValueError: shapes, devices. TypeError: dtypes.
    """
    op = "project_bev"
    _native.refuse_transforms(op)
    check_tensors(op, bev=bev, weight=weight)
    check_shape(op, "bev", bev, ("B", "C", "H", "W"))
    check_dtype(op, "bev", bev, FLOATING + HALF)
    channels = bev.shape[1]
    if weight.dim() != 2 or weight.shape[1] < channels or weight.numel() == 0 or channels == 0:
        raise ValueError(f"{op}: weight must have shape [hidden, {channels} or more], got {list(weight.shape)}")
    check_dtype(op, "weight", weight, FLOATING)
    check_features(op, "bev", bev, "weight", weight)
    _check_precision(op, precision, "weight", weight)
    columns = weight[:, :channels]
    if not _native.use_native(op, bev):
        return _project_reference(bev.to(weight.dtype), columns)
    with torch.autocast(bev.device.type, enabled=False):  # which would widen the map
        projected: Tensor = torch.ops.pred.project_bev(bev.to(_storage(precision, weight)), columns, _native.tf32())
    return projected


def decode_field(
    bev: Tensor,  # [B, C, H, W]
    points: Tensor,  # [B, N, 3]
    weights: Sequence[Tensor],  # [hidden, C + 3 + 6 F], [hidden, hidden] ..., [1 + K, hidden]
    biases: Sequence[Tensor],  # [hidden] ..., [1 + K]
    point_range: Sequence[float],
    *,
    frequencies: int,
    softplus_beta: float,
    sdf_scale: float = 1.0,
    with_gradient: bool = False,
    projected: bool = False,
    precision: Literal["fp32", "bf16"] = "fp32",
    recompute: bool = False,
) -> DecodedField:
    """Decodes points by a BEV feature, a positional encoding and an MLP with Softplus (PRED Eq. 3).

    ``n = (point - centre) / half_extent`` of the range box; ``x = concat(F(n_x, n_y), n, sin(2^k n), cos(2^k n))``,
    k = 0 .. F - 1, with F bilinear in the map (zeros outside, cells between the box's faces); hidden layers
    ``a = log(1 + exp(beta (W x + b))) / beta``; output ``W a + b``, whose first row times ``sdf_scale`` is the signed
    distance and whose other K rows are class logits. All of it, the distance's gradient, and the gradients of all
    three are computed tile by tile in one pass each, without ``create_graph``; `docs/decoder.md` derives them.

    Args:
        bev: ``[B, C, H, W]`` map, row = y, column = x, spanning the range box.
        points: ``[B, N, 3]`` positions in metres in the map's frame, float32 or float64; half precision is widened.
        weights, biases: of the Linear layers, at least two; hidden layers have one width, in the dtype of ``points``.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), metres.
        frequencies: F, octaves of the encoding.
        softplus_beta: sharpness of the Softplus, positive.
        sdf_scale: metres of signed distance per unit of the output layer's first row.
        with_gradient: also return d sdf / d point.
        projected: ``bev`` is :func:`project_bev` of the map, ``[B, hidden, H, W]``.
        precision: of products and of what is kept for the backward pass, for float32: ``"bf16"`` rounds their
            operands to bfloat16 and sums in float32; parameters and their gradients stay float32.
        recompute: keep nothing for the backward pass but the arguments; else a row per hidden layer and sample, and
            with ``with_gradient`` a second one for all but the last. Results differ by rounding.

    Returns:
        :class:`DecodedField` in the dtype of ``points``.

    Raises:
        ValueError: shapes, devices, ranges. TypeError: dtypes.

    Differentiable once in ``bev``, ``points``, ``weights`` and ``biases``, through all three outputs; a further
    derivative raises. Where the bilinear map has a kink, on lines through cell centres, ``gradient`` is the one
    towards larger coordinates. Deterministic for any number of threads.
    """
    _native.refuse_transforms(OP)
    check_flags(OP, with_gradient=with_gradient, projected=projected, recompute=recompute)
    points, weights, biases, settings = _arguments(
        bev, points, weights, biases, point_range, frequencies, softplus_beta, sdf_scale, projected
    )
    _check_precision(OP, precision, "points", points)
    with torch.autocast(points.device.type, enabled=False):
        if not _native.use_native(OP, points):
            return _reference(bev, points, weights, biases, settings, with_gradient, projected)
        bev = bev.to(_storage(precision, points)) if projected else project_bev(bev, weights[0], precision)
        return _compiled(bev, points, weights, biases, settings, with_gradient, recompute)


def _compiled(
    projected: Tensor,
    points: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    settings: _Settings,
    with_gradient: bool,
    recompute: bool,
) -> DecodedField:
    first = weights[0]
    channels = first.shape[1] - 3 - 6 * settings.frequencies
    rows = [first[:, channels:], *weights[1:]]
    parameters = torch.cat([part.reshape(-1) for pair in zip(rows, biases, strict=True) for part in pair])
    widths = [first.shape[1] - channels, *(weight.shape[0] for weight in weights)]
    learns = torch.is_grad_enabled() and (projected.requires_grad or points.requires_grad or parameters.requires_grad)
    sdf, semantics, gradient, *_ = torch.ops.pred.decode_field(
        projected, points, parameters, widths, *settings, with_gradient, learns and not recompute, _native.tf32()
    )
    return DecodedField(sdf, semantics if widths[-1] > 1 else None, gradient if with_gradient else None)


def decode_field_reference(
    bev: Tensor,  # [B, C, H, W]
    points: Tensor,  # [B, N, 3]
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    point_range: Sequence[float],
    *,
    frequencies: int,
    softplus_beta: float,
    sdf_scale: float = 1.0,
    with_gradient: bool = False,
    projected: bool = False,
    precision: Literal["fp32", "bf16"] = "fp32",
    recompute: bool = False,
) -> DecodedField:
    """Plain PyTorch form of :func:`decode_field`; ``precision`` and ``recompute`` change nothing here.

    Differentiable any number of times, the compiled form once.
    """
    check_flags(OP, with_gradient=with_gradient, projected=projected, recompute=recompute)
    points, weights, biases, settings = _arguments(
        bev, points, weights, biases, point_range, frequencies, softplus_beta, sdf_scale, projected
    )
    _check_precision(OP, precision, "points", points)
    with torch.autocast(points.device.type, enabled=False):
        return _reference(bev, points, weights, biases, settings, with_gradient, projected)


def _arguments(
    bev: Tensor,
    points: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    point_range: Sequence[float],
    frequencies: int,
    softplus_beta: float,
    sdf_scale: float,
    projected: bool,
) -> tuple[Tensor, list[Tensor], list[Tensor], _Settings]:
    """Checked; half-precision points are widened, and parameters in a half-precision region."""
    for name, tensors in (("weights", weights), ("biases", biases)):
        if not isinstance(tensors, Sequence):
            raise TypeError(f"{OP}: {name} must be a list of tensors, got {type(tensors).__name__}")
    layers = {f"weights[{i}]": weight for i, weight in enumerate(weights)}
    layers |= {f"biases[{i}]": bias for i, bias in enumerate(biases)}
    check_tensors(OP, bev=bev, points=points, **layers)
    points = as_geometry(points)
    weights, biases = [widen(weight) for weight in weights], [widen(bias) for bias in biases]
    check_shape(OP, "bev", bev, ("B", "C", "H", "W"))
    check_shape(OP, "points", points, (bev.shape[0], "N", 3))
    check_dtype(OP, "points", points, FLOATING)
    if bev.shape[2] == 0 or bev.shape[3] == 0:
        raise ValueError(f"{OP}: bev must have at least one cell along each axis, got {list(bev.shape)}")
    check_features(OP, "bev", bev, "points", points)
    if not 2 <= len(weights) <= MAX_LAYERS:
        raise ValueError(f"{OP}: weights must be of 2 to {MAX_LAYERS} layers, got {len(weights)}")
    if len(biases) != len(weights):
        raise ValueError(f"{OP}: biases must be as many as weights, {len(weights)}, got {len(biases)}")
    check_count(OP, "frequencies", frequencies)
    if frequencies > MAX_FREQUENCIES:
        raise ValueError(f"{OP}: frequencies must be at most {MAX_FREQUENCIES}, got {frequencies}")
    encoding = 3 + 6 * frequencies
    check_shape(OP, "weights[0]", weights[0], ("hidden", "C + 3 + 6 F"))
    hidden, inputs = weights[0].shape
    if not 1 <= hidden <= MAX_HIDDEN:
        raise ValueError(f"{OP}: weights[0] must have 1 to {MAX_HIDDEN} rows, got {hidden}")
    if bev.shape[1] == 0:
        raise ValueError(f"{OP}: bev must have at least one channel, got {list(bev.shape)}")
    if projected:
        check_shape(OP, "bev", bev, ("B", hidden, "H", "W"), " with projected=True")
        if inputs < encoding:
            raise ValueError(f"{OP}: weights[0] must have at least 3 + 6 F = {encoding} columns, got {inputs}")
    else:
        check_shape(OP, "weights[0]", weights[0], ("hidden", bev.shape[1] + encoding))
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        last = i == len(weights) - 1
        check_shape(OP, f"weights[{i}]", weight, ("1 + K" if last else hidden, inputs if i == 0 else hidden))
        check_shape(OP, f"biases[{i}]", bias, (weight.shape[0],))
        check_like(OP, f"weights[{i}]", weight, "points", points)
        check_like(OP, f"biases[{i}]", bias, "points", points)
    if weights[-1].shape[0] == 0:
        raise ValueError(f"{OP}: weights[{len(weights) - 1}] must have at least one row, got 0")
    numbers = torch.finfo(points.dtype)
    for name, value in (("softplus_beta", softplus_beta), ("sdf_scale", sdf_scale)):
        check_number(OP, name, value)
        if not numbers.tiny <= value <= numbers.max:
            raise ValueError(f"{OP}: {name} must be positive, finite and normal in {points.dtype}, got {value}")
    box = check_floats(OP, "point_range", point_range, 6)
    if not all(low < high for low, high in zip(box, box[3:], strict=False)):
        raise ValueError(f"{OP}: point_range must be x, y, z of the lower, then of the upper corner, got {box}")
    if not all(numbers.tiny <= (high - low) / 2 <= numbers.max for low, high in zip(box, box[3:], strict=False)):
        raise ValueError(f"{OP}: point_range must have extents that are finite and normal in {points.dtype}, got {box}")
    return points, weights, biases, _Settings(tuple(box), frequencies, float(softplus_beta), float(sdf_scale))


def _check_precision(op: str, precision: str, name: str, tensor: Tensor) -> None:
    check_choice(op, "precision", precision, ("fp32", "bf16"))
    if precision == "bf16" and tensor.dtype != torch.float32:
        raise TypeError(f"{op}: precision must be 'fp32' where {name} is {tensor.dtype}, got 'bf16'")


def _storage(precision: str, like: Tensor) -> torch.dtype:
    """Dtype of the rows that are multiplied and kept."""
    return torch.bfloat16 if precision == "bf16" else like.dtype


# --- Reference -------------------------------------------------------------------------------------
def encode(position: Tensor, frequencies: int) -> Tensor:
    """Positional encoding ``[..., 3 + 6 F]`` of scaled coordinates ``[..., 3]``: n, sin(2^k n), cos(2^k n)."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=position.dtype, device=position.device)
    angles = (position[..., None, :] * octaves[:, None]).flatten(-2)
    return torch.cat([position, angles.sin(), angles.cos()], dim=-1)


def _reference(
    bev: Tensor,
    points: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    settings: _Settings,
    with_gradient: bool,
    projected: bool,
) -> DecodedField:
    centre, half_extent = settings.box(points)
    position = (points - centre) / half_extent
    encoding = encode(position, settings.frequencies)
    bev = bev.to(points.dtype)
    grid_map = bev if projected else _project_reference(bev, weights[0][:, : bev.shape[1]])

    if with_gradient:
        sampled, map_slopes = sample_bev_with_grad_reference(grid_map, position[..., :2])
    else:
        sampled = sample_bev_reference(grid_map, position[..., :2])

    columns = weights[0][:, weights[0].shape[1] - encoding.shape[-1] :]
    activation = sampled + F.linear(encoding, columns, biases[0])
    slopes = []
    for i in range(len(weights) - 1):
        if i > 0:
            activation = F.linear(activation, weights[i], biases[i])
        if with_gradient:
            activation, slope = _SoftplusAndSlope.apply(activation, settings.softplus_beta)
            slopes.append(slope)
        else:
            activation = _softplus(activation, settings.softplus_beta)
    output = F.linear(activation, weights[-1], biases[-1])

    gradient = None
    if with_gradient:
        by_activation = slopes[-1] * (weights[-1][0] * settings.sdf_scale)
        for weight, slope in zip(weights[-2:0:-1], slopes[-2::-1], strict=True):
            by_activation = (by_activation @ weight) * slope
        by_position = _encoding_gradient(by_activation @ columns, encoding, settings.frequencies)
        by_grid = (map_slopes * by_activation[..., None, :]).sum(-1)
        gradient = (by_position + F.pad(by_grid, (0, 1))) / half_extent
    semantics = output[..., 1:] if output.shape[-1] > 1 else None
    return DecodedField(output[..., 0] * settings.sdf_scale, semantics, gradient)


def _project_reference(bev: Tensor, weight: Tensor) -> Tensor:
    return F.linear(bev.permute(0, 2, 3, 1), weight).permute(0, 3, 1, 2)


def _encoding_gradient(by_encoding: Tensor, encoding: Tensor, frequencies: int) -> Tensor:
    """Gradient of the scaled coordinates from that of their encoding."""
    width = 3 * frequencies
    by_position, by_sine, by_cosine = by_encoding.split([3, width, width], dim=-1)
    _, sine, cosine = encoding.split([3, width, width], dim=-1)
    octaves = 2.0 ** torch.arange(frequencies, dtype=encoding.dtype, device=encoding.device)
    by_angle = (cosine * by_sine - sine * by_cosine).unflatten(-1, (frequencies, 3))
    return by_position + (by_angle * octaves[:, None]).sum(-2)


def _softplus(activation: Tensor, beta: float) -> Tensor:
    """By its definition; ``F.softplus`` is the identity from 20 / beta on, 2e-9 / beta off."""
    return torch.logaddexp(activation * beta, activation.new_zeros(())) / beta


class _SoftplusAndSlope(torch.autograd.Function):
    """Softplus and its derivative, sigmoid(beta z), with one cheap backward for both; differentiable any number of
    times."""

    @staticmethod
    def forward(ctx: Any, activation: Tensor, beta: float) -> tuple[Tensor, Tensor]:
        slope = torch.sigmoid(activation * beta)
        ctx.save_for_backward(slope)
        ctx.beta = beta
        return _softplus(activation, beta), slope

    @staticmethod
    def backward(ctx: Any, grad_value: Tensor, grad_slope: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        # d slope / d activation = beta slope (1 - slope)
        return slope * (grad_value + ctx.beta * (1 - slope) * grad_slope), None


# --- Compiled ops ----------------------------------------------------------------------------------
def _channels_last(like: Tensor, channels: int) -> Tensor:
    frames, _, height, width = like.shape
    return like.new_empty(frames, height, width, channels).permute(0, 3, 1, 2)


def _project_fake(bev: Tensor, weight: Tensor, tf32: bool) -> Tensor:
    return _channels_last(bev, weight.shape[0])


def _project_save(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:2])


def _project_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    need = ctx.needs_input_grad
    with torch.autocast(grad.device.type, enabled=False):
        found = torch.ops.pred.project_bev_backward(grad, *ctx.saved_tensors, need[0], need[1], _native.tf32())
    return (*(value if wanted else None for value, wanted in zip(found, need[:2], strict=True)), None)


def _project_backward_fake(
    grad: Tensor, bev: Tensor, weight: Tensor, need_bev: bool, need_weight: bool, tf32: bool
) -> tuple[Tensor, Tensor]:
    return (
        _channels_last(bev, bev.shape[1]) if need_bev else bev.new_empty(0),
        weight.new_empty(weight.shape[0] if need_weight else 0, weight.shape[1]),
    )


def _fake(
    projected: Tensor,
    points: Tensor,
    parameters: Tensor,
    widths: Sequence[int],
    point_range: Sequence[float],
    frequencies: int,
    softplus_beta: float,
    sdf_scale: float,
    with_gradient: bool,
    keep: bool,
    tf32: bool,
) -> tuple[Tensor, ...]:
    frames, count = points.shape[:2]
    hidden = len(widths) - 2
    stride = (widths[1] + 31) // 32 * 32

    def kept(layers: int) -> Tensor:
        return projected.new_empty((layers, frames * count, stride) if keep and layers > 0 else (0, 0, 0))

    return (
        points.new_empty(frames, count),
        points.new_empty(frames, count, widths[-1] - 1),
        points.new_empty(frames, count if with_gradient else 0, 3),
        kept(hidden),
        kept(hidden - 1 if with_gradient else 0),
    )


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    projected, points, parameters, *settings, ctx.with_gradient, _, _ = inputs
    ctx.settings = settings
    ctx.save_for_backward(projected, points, parameters, *output[3:])
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
    sdf, semantics, gradient, *_ = grads
    none = (None,) * 8
    if sdf is None and semantics is None and gradient is None:
        return (None, None, None, *none)
    need = ctx.needs_input_grad
    projected, points, parameters, *kept = ctx.saved_tensors
    with torch.autocast(points.device.type, enabled=False):  # which would widen the map and what was kept
        found = torch.ops.pred.decode_field_backward(
            sdf, semantics, gradient if ctx.with_gradient else None, projected, points, parameters, *kept,
            *ctx.settings, need[0], need[1], need[2], _native.deterministic(), _native.tf32(),
        )  # fmt: skip
    return (*(value if wanted else None for value, wanted in zip(found, need, strict=False)), *none)


def _backward_fake(
    grad_sdf: Tensor | None,
    grad_semantics: Tensor | None,
    grad_gradient: Tensor | None,
    projected: Tensor,
    points: Tensor,
    parameters: Tensor,
    activation: Tensor,
    chain: Tensor,
    widths: Sequence[int],
    point_range: Sequence[float],
    frequencies: int,
    softplus_beta: float,
    sdf_scale: float,
    need_projected: bool,
    need_points: bool,
    need_parameters: bool,
    deterministic: bool,
    tf32: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    frames, count = points.shape[:2]
    return (
        _channels_last(projected, projected.shape[1]) if need_projected else projected.new_empty(0),
        points.new_empty(frames if need_points else 0, count, 3),
        parameters.new_empty(parameters.shape[0] if need_parameters else 0),
    )


_native.register("project_bev", fake=_project_fake, setup_context=_project_save, backward=_project_backward)
_native.register("project_bev_backward", fake=_project_backward_fake)
_native.register("decode_field", fake=_fake, setup_context=_save, backward=_backward)
_native.register("decode_field_backward", fake=_backward_fake)
