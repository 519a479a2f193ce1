# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What the samplers of maps with two axes (``bev``) and three (``volume``) share: checks, references, registration."""

from __future__ import annotations

from itertools import product
from math import prod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import (
    FLOATING,
    HALF,
    as_geometry,
    check_choice,
    check_dtype,
    check_flags,
    check_like,
    check_shape,
    check_tensors,
    widen,
)


class SampledWithGrad(NamedTuple):
    """What the ``*_with_grad`` samplers return."""

    values: Tensor  # [B, N, C]
    grads: Tensor  # [B, N, A, C], d values / d grid[..., a]; A = 2 (x, y) or 3 (x, y, z)


def arguments(
    op: str, name: str, axes: int, map_: Tensor, grid: Tensor, padding_mode: str, align_corners: bool
) -> tuple[Tensor, Tensor]:
    """Checked map, here named as the caller knows it, and grid; a half-precision grid is widened to float32."""
    check_tensors(op, **{name: map_, "grid": grid})
    map_, grid = widen(map_), as_geometry(grid)
    check_shape(op, name, map_, ("B", "C", "D", "H", "W") if axes == 3 else ("B", "C", "H", "W"))
    check_shape(op, "grid", grid, (map_.shape[0], "N", axes))
    check_dtype(op, name, map_, (*FLOATING, *HALF))
    if map_.dtype in HALF:
        check_dtype(op, "grid", grid, (torch.float32,))
    check_like(op, "grid", grid, name, map_.new_empty(0, dtype=torch.float32) if map_.dtype in HALF else map_)
    check_flags(op, align_corners=align_corners)
    check_choice(op, "padding_mode", padding_mode, ("zeros", "border"))
    if 0 in map_.shape[2:]:
        what = "layer, row and column" if axes == 3 else "row and column"
        raise ValueError(f"{op}: {name} must have at least one {what}, got {list(map_.shape)}")
    return map_, grid


def reference(
    map_: Tensor,  # [B, C, (D,) H, W]
    grid: Tensor,  # [B, N, A]
    border: bool,
    align_corners: bool,
    with_grad: bool,
) -> list[Tensor]:
    """Linear interpolation by its definition: the values ``[B, N, C]``, then their derivatives along each axis."""
    batch, channels, *sizes = map_.shape
    axes, stored = len(sizes), map_.dtype
    rows = (map_.float() if stored in HALF else map_).flatten(2).transpose(1, 2)  # [B, (D) H W, C]
    size = grid.new_tensor(sizes[::-1])  # x first
    scale = (size - 1) / 2 if align_corners else size / 2
    cell = (grid + 1) / 2 * (size - 1) if align_corners else ((grid + 1) * size - 1) / 2
    scale = scale.expand_as(cell)
    if border:
        # Not clamp(): its derivative is 1 on the bounds, where F.grid_sample has 0.
        scale = torch.where((cell <= 0) | (cell >= size - 1), torch.zeros_like(scale), scale)
        cell = torch.where(cell <= 0, torch.zeros_like(cell), cell)
        cell = torch.where(cell >= size - 1, (size - 1).expand_as(cell), cell)
    finite = cell.detach().isfinite().all(dim=-1)  # [B, N]
    low = cell.detach().clamp(-2, max(sizes) + 1).floor().nan_to_num(nan=-2.0)
    frac = cell - low
    weights, slopes = (1 - frac, frac), (-scale, scale)
    outs = [rows.new_zeros(batch, grid.shape[1], channels) for _ in range(1 + axes if with_grad else 1)]
    for corner in product((0, 1), repeat=axes):
        inside, index = finite, torch.zeros_like(low[..., 0], dtype=torch.int64)
        for axis in reversed(range(axes)):
            at = low[..., axis].long() + corner[axis]
            length = sizes[axes - 1 - axis]
            inside = inside & (at >= 0) & (at < length)
            index = index * length + at
        index = torch.where(inside, index, torch.zeros_like(index))
        value = torch.gather(rows, 1, index[..., None].expand(-1, -1, channels))
        value = torch.where(inside[..., None], value, torch.zeros_like(value))
        for number in range(len(outs)):  # 0: the value; else the derivative along axis number - 1
            factors = [(slopes if a == number - 1 else weights)[corner[a]][..., a] for a in range(axes)]
            # where() on both factors, so that neither value nor derivative of an outside cell is used.
            weight = torch.where(inside, prod(factors[1:], start=factors[0]), torch.zeros_like(factors[0]))
            outs[number] = outs[number] + value * weight[..., None]
    nan = cell.detach().isnan().any(dim=-1)[..., None]
    return [torch.where(nan, torch.full_like(out, torch.nan), out).to(stored) for out in outs]


def register(op: str) -> None:
    """Registers shapes and derivatives of the sampler ``op``, of its backward ops and of ``op_with_grad``."""
    ops = torch.ops.pred

    def fake(map_: Tensor, grid: Tensor, border: bool, align_corners: bool) -> Tensor:
        return map_.new_empty(map_.shape[0], grid.shape[1], map_.shape[1])

    def save(ctx: Any, inputs: Any, output: Any) -> None:
        map_, grid, ctx.border, ctx.align_corners = inputs
        ctx.save_for_backward(map_, grid)

    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        map_, grid = ctx.saved_tensors
        need_map, need_grid = ctx.needs_input_grad[:2]
        grad_map, grad_grid = getattr(ops, f"{op}_backward")(
            grad, map_, grid, ctx.border, ctx.align_corners, need_map, need_grid, _native.deterministic()
        )
        return grad_map if need_map else None, grad_grid if need_grid else None, None, None

    def fake_backward(
        grad: Tensor, map_: Tensor, grid: Tensor, border: bool, align_corners: bool, need_map: bool, need_grid: bool,
        deterministic: bool,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        return _like_map(map_, need_map), _like(grid, need_grid)

    def save_backward(ctx: Any, inputs: Any, output: Any) -> None:
        grad, map_, grid, ctx.border, ctx.align_corners, ctx.need_map, ctx.need_grid, _ = inputs
        ctx.save_for_backward(grad, map_, grid)
        ctx.set_materialize_grads(False)

    def double_backward(
        ctx: Any, grad_grad_map: Tensor | None, grad_grad_grid: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        grad, map_, grid = ctx.saved_tensors
        needs = ctx.needs_input_grad[:3]
        grad_grad_map = grad_grad_map if ctx.need_map else None
        grad_grad_grid = grad_grad_grid if ctx.need_grid else None
        if grad_grad_map is None and grad_grad_grid is None:
            return (None,) * 8
        grads = getattr(ops, f"{op}_double_backward")(
            grad_grad_map,
            grad_grad_grid,
            grad,
            map_,
            grid,
            ctx.border,
            ctx.align_corners,
            *needs,
            _native.deterministic(),
        )
        return (*(value if need else None for value, need in zip(grads, needs, strict=True)), *(None,) * 5)

    def fake_double_backward(
        grad_grad_map: Tensor | None,
        grad_grad_grid: Tensor | None,
        grad: Tensor,
        map_: Tensor,
        grid: Tensor,
        border: bool,
        align_corners: bool,
        need_grad: bool,
        need_map: bool,
        need_grid: bool,
        deterministic: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        return _like(grad, need_grad), _like_map(map_, need_map), _like(grid, need_grid)

    def fake_with_grad(map_: Tensor, grid: Tensor, border: bool, align_corners: bool) -> tuple[Tensor, Tensor]:
        batch, samples, axes = grid.shape
        channels = map_.shape[1]
        return map_.new_empty(batch, samples, channels), map_.new_empty(batch, samples, axes, channels)

    def save_with_grad(ctx: Any, inputs: Any, output: Any) -> None:
        save(ctx, inputs, output)
        ctx.set_materialize_grads(False)

    def with_grad_backward(
        ctx: Any, grad_values: Tensor | None, grad_grads: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        if grad_values is None and grad_grads is None:
            return None, None, None, None
        map_, grid = ctx.saved_tensors
        need_map, need_grid = ctx.needs_input_grad[:2]
        grad_map, grad_grid = getattr(ops, f"{op}_with_grad_backward")(
            grad_values,
            grad_grads,
            map_,
            grid,
            ctx.border,
            ctx.align_corners,
            need_map,
            need_grid,
            _native.deterministic(),
        )
        return grad_map if need_map else None, grad_grid if need_grid else None, None, None

    def fake_with_grad_backward(
        grad_values: Tensor | None,
        grad_grads: Tensor | None,
        map_: Tensor,
        grid: Tensor,
        border: bool,
        align_corners: bool,
        need_map: bool,
        need_grid: bool,
        deterministic: bool,
    ) -> tuple[Tensor, Tensor]:
        return _like_map(map_, need_map), _like(grid, need_grid)

    _native.register(op, fake=fake, setup_context=save, backward=backward)
    _native.register(f"{op}_backward", fake=fake_backward, setup_context=save_backward, backward=double_backward)
    _native.register(f"{op}_double_backward", fake=fake_double_backward)
    _native.register(f"{op}_with_grad", fake=fake_with_grad, setup_context=save_with_grad, backward=with_grad_backward)
    _native.register(f"{op}_with_grad_backward", fake=fake_with_grad_backward)


def _like(tensor: Tensor, needed: bool) -> Tensor:
    return tensor.new_empty(tensor.shape) if needed else tensor.new_empty(0)


def _like_map(map_: Tensor, needed: bool) -> Tensor:
    """In channels-last memory."""
    if not needed:
        return map_.new_empty(0)
    batch, channels, *sizes = map_.shape
    return map_.new_empty(batch, *sizes, channels).movedim(-1, 1)
