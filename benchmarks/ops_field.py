# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the field decoder.

Useful arithmetic, in multiply-adds per sample (P encoding width, h hidden, L hidden layers, r output rows, C map
channels): the trunk takes m = P h + (L - 1) h^2. Forward m + r h, and m for the gradient; backward twice as much. The
map's projection takes C h per cell, its backward pass twice as much. What is computed twice counts once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases
from benchmarks.case import BACKWARD, FORWARD, Case, Function, Phase, Variant
from benchmarks.cases import POINT_RANGE_M, Sizes
from benchmarks.ops_sampling import plain_gather
from benchmarks.report import Target
from pred import ops
from pred.models.field import FieldConfig, FieldDecoder
from pred.ops import DecodedField, reference

FREQUENCIES, BETA, SDF_SCALE_M = 6, 10.0, 10.0


def _decode_field_cases(sizes: Sizes) -> list[Case]:
    bev = cases.bev_map(sizes.bev_channels, sizes.bev_cells)
    points = _points(sizes)
    torch.manual_seed(0)
    config = FieldConfig(
        hidden=sizes.step_hidden,
        num_classes=sizes.classes,
        frequencies=FREQUENCIES,
        softplus_beta=BETA,
        sdf_scale_m=SDF_SCALE_M,
    )
    field = FieldDecoder(sizes.bev_channels, config, POINT_RANGE_M)
    layers = [parameter.detach() for parameter in field.parameters()]  # weight, bias, weight ...
    inputs = (bev, points, *layers)
    samples, width, hidden = points.shape[1], 3 + 6 * FREQUENCIES, sizes.step_hidden
    trunk, rows = width * hidden + (config.layers - 2) * hidden**2, (1 + sizes.classes) * hidden
    project = sizes.bev_cells**2 * sizes.bev_channels * hidden
    found = []
    for kind, options, with_gradient, targets in (
        ("fp32", {}, True, (Target("eager", 4), Target("compiled", 2.5), Target("matrix rate", 0.75))),
        ("fp32, recompute", {"recompute": True}, True, ()),
        ("bf16", {"precision": "bf16"}, True, (Target("eager", 8),)),
        ("fp32, no gradient", {}, False, ()),
    ):
        passes = 2 if with_gradient else 1
        forward = 2 * (samples * (passes * trunk + rows) + project)
        function = _call(ops.decode_field, with_gradient, options)
        dtype = "bfloat16" if "precision" in options else "float32"
        text = "2 (N (2 m + r h) + C h HW)" if with_gradient else "2 (N (m + r h) + C h HW)"
        found.append(
            Case(
                op="decode_field",
                name=f"decode_field {samples} samples, {config.layers} layers of {hidden}, {kind}",
                unit="samples",
                items=samples,
                inputs=inputs,
                ours=function,
                reference=_call(reference.decode_field, with_gradient, {}),
                eager={
                    "create_graph": Variant(_plain(with_gradient)),
                    "func.grad": Variant(_functional(with_gradient)),
                },
                compiled=("create_graph", "func.grad"),
                derivative_in=(0, *range(2, len(inputs))),
                derivative_of=tuple(range(3 if with_gradient else 2)),
                tolerance=1e-1 if "precision" in options else 1e-3,
                phases=(
                    Phase(FORWARD, "", 0, work=text, flop=forward, flop_dtype=dtype),
                    Phase(BACKWARD, "", 0, targets, work=f"3 {text}", flop=3 * forward, flop_dtype=dtype),
                ),
            )
        )
    return found


def _points(sizes: Sizes) -> Tensor:
    """Samples along rays, in metres, off the lines through cell centres."""
    plan = cases.ray_grid(sizes, seed=1)
    extent = torch.tensor(POINT_RANGE_M[3:]) - torch.tensor(POINT_RANGE_M[:3])
    generator = torch.Generator().manual_seed(2)
    height = 2 * torch.rand(*plan.shape[:2], 1, generator=generator) - 1
    centre = (torch.tensor(POINT_RANGE_M[3:]) + torch.tensor(POINT_RANGE_M[:3])) / 2
    return torch.cat([plan, height], dim=-1) * extent / 2 + centre


def _outputs(field: DecodedField) -> tuple[Tensor, ...]:
    return tuple(value for value in field if value is not None)


def _call(function: Callable[..., DecodedField], with_gradient: bool, options: dict[str, Any]) -> Function:
    def run(bev: Tensor, points: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        settings = {"frequencies": FREQUENCIES, "softplus_beta": BETA, "sdf_scale": SDF_SCALE_M} | options
        weights, biases = layers[::2], layers[1::2]
        return _outputs(function(bev, points, weights, biases, POINT_RANGE_M, with_gradient=with_gradient, **settings))

    return run


def _network(bev: Tensor, points: Tensor, layers: Sequence[Tensor], twice: bool) -> tuple[Tensor, Tensor]:
    """As one would write it: gather, concatenate, MLP."""
    low, high = points.new_tensor(POINT_RANGE_M).view(2, 3)
    position = (points - (low + high) / 2) / ((high - low) / 2)
    features = plain_gather(bev, position[..., :2], twice)
    octaves = 2.0 ** torch.arange(FREQUENCIES, device=points.device)
    angles = (position[..., None, :] * octaves[:, None]).flatten(-2)
    values = torch.cat([features, position, angles.sin(), angles.cos()], dim=-1)
    for weight, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        values = F.softplus(F.linear(values, weight, bias), BETA)
    output = F.linear(values, layers[-2], layers[-1])
    return output[..., 0] * SDF_SCALE_M, output[..., 1:]


def _plain(with_gradient: bool) -> Function:
    def run(bev: Tensor, points: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        if not with_gradient:
            return _network(bev, points, layers, False)
        learns = torch.is_grad_enabled()
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            sdf, semantics = _network(bev, points, layers, True)
            (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=learns)
        return sdf, semantics, gradient

    return run


def _functional(with_gradient: bool) -> Function:
    def run(bev: Tensor, points: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        def total(points: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
            sdf, semantics = _network(bev, points, layers, with_gradient)
            return sdf.sum(), (sdf, semantics)

        if not with_gradient:
            return total(points)[1]
        gradient, (sdf, semantics) = torch.func.grad(total, has_aux=True)(points)
        return sdf, semantics, gradient

    return run


CASES: dict[str, Callable[[Sizes], list[Case]]] = {"decode_field": _decode_field_cases}
