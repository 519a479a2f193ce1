# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Bilinear gather from a BEV map at ray samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import FLOATING, check_choice, check_dtype, check_like, check_shape, check_tensors, widen


def sample_bev(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Samples a BEV map at continuous positions, as ``F.grid_sample`` (bilinear) does.

    ``out[b, n, c] = sum_k w_k(grid[b, n]) bev[b, c, cell_k]`` over the four surrounding cells.

    Args:
        bev: ``[B, C, H, W]`` float32 or float64; row = y, column = x. Channels-last memory avoids a copy.
        grid: ``[B, N, 2]`` positions (x, y) in [-1, 1], same dtype. With ``align_corners=False`` -1 and 1 are the
            outer edges of the map, with True the centres of its outer cells.
        padding_mode: ``"zeros"`` reads 0 outside the map, ``"border"`` the nearest cell.
        align_corners: as in ``F.grid_sample``.

    Returns:
        ``[B, N, C]``. A NaN coordinate gives NaN in its own sample and contributes to no gradient but its own.

    Raises:
        ValueError: shape, device or ``padding_mode``. TypeError: dtype.

    Differentiable twice in ``bev`` and ``grid`` (a third derivative raises). Where the value has a kink, on the lines
    through cell centres, the derivative is the one towards larger coordinates; at the outermost centres with border
    padding it is 0, as in ``F.grid_sample``. Deterministic for any thread count.
    """
    if not _native.use_native("sample_bev", bev):
        return sample_bev_reference(bev, grid, padding_mode, align_corners)
    bev, grid = _arguments(bev, grid, padding_mode)
    out: Tensor = torch.ops.pred.sample_bev(bev, grid, padding_mode == "border", align_corners)
    return out


def sample_bev_reference(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Plain PyTorch form of :func:`sample_bev`: interpolation by its definition, differentiable any number of times."""
    bev, grid = _arguments(bev, grid, padding_mode)
    batch, channels, height, width = bev.shape
    sizes = grid.new_tensor([width, height])
    if align_corners:
        cell = (grid + 1) / 2 * (sizes - 1)
    else:
        cell = ((grid + 1) * sizes - 1) / 2
    if padding_mode == "border":
        # Not clamp(): its derivative is 1 on the bounds, where F.grid_sample has 0.
        cell = torch.where(cell <= 0, torch.zeros_like(cell), cell)
        cell = torch.where(cell >= sizes - 1, (sizes - 1).expand_as(cell), cell)
    finite = cell.detach().isfinite().all(dim=-1)  # [B, N]
    low = cell.detach().clamp(-2, max(height, width) + 1).floor().nan_to_num(nan=-2.0)
    frac = cell - low
    rows = bev.flatten(2).transpose(1, 2)  # [B, H * W, C]
    out = rows.new_zeros(batch, grid.shape[1], channels)
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = low[..., 0].long() + dx, low[..., 1].long() + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & finite
            index = torch.where(inside, y * width + x, torch.zeros_like(x))
            wx = frac[..., 0] if dx else 1 - frac[..., 0]
            wy = frac[..., 1] if dy else 1 - frac[..., 1]
            value = torch.gather(rows, 1, index[..., None].expand(-1, -1, channels))
            # where() on both factors, so that neither value nor derivative of an outside cell is used.
            weight = torch.where(inside, wx * wy, torch.zeros_like(wx))
            out = out + torch.where(inside[..., None], value, torch.zeros_like(value)) * weight[..., None]
    nan = cell.detach().isnan().any(dim=-1)
    return torch.where(nan[..., None], torch.full_like(out, torch.nan), out)


def _arguments(bev: Tensor, grid: Tensor, padding_mode: str) -> tuple[Tensor, Tensor]:
    op = "sample_bev"
    check_tensors(op, bev=bev, grid=grid)
    bev, grid = widen(bev), widen(grid)
    check_shape(op, "bev", bev, ("B", "C", "H", "W"))
    check_shape(op, "grid", grid, (bev.shape[0], "N", 2))
    check_dtype(op, "bev", bev, FLOATING)
    check_like(op, "grid", grid, "bev", bev)
    check_choice(op, "padding_mode", padding_mode, ("zeros", "border"))
    if bev.shape[2] == 0 or bev.shape[3] == 0:
        raise ValueError(f"{op}: bev must have at least one row and column, got {list(bev.shape)}")
    return bev, grid


def _fake(bev: Tensor, grid: Tensor, border: bool, align_corners: bool) -> Tensor:
    return bev.new_empty(bev.shape[0], grid.shape[1], bev.shape[1])


def _save(ctx: Any, inputs: Any, output: Any) -> None:
    bev, grid, ctx.border, ctx.align_corners = inputs
    ctx.save_for_backward(bev, grid)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    bev, grid = ctx.saved_tensors
    need_bev, need_grid = ctx.needs_input_grad[:2]
    grad_bev, grad_grid = torch.ops.pred.sample_bev_backward(
        grad, bev, grid, ctx.border, ctx.align_corners, need_bev, need_grid
    )
    return grad_bev if need_bev else None, grad_grid if need_grid else None, None, None


def _empty_channels_last(bev: Tensor) -> Tensor:
    batch, channels, height, width = bev.shape
    return bev.new_empty(batch, height, width, channels).permute(0, 3, 1, 2)


def _fake_backward(
    grad: Tensor, bev: Tensor, grid: Tensor, border: bool, align_corners: bool, need_bev: bool, need_grid: bool
) -> tuple[Tensor, Tensor]:
    grad_bev = _empty_channels_last(bev) if need_bev else bev.new_empty(0)
    return grad_bev, grid.new_empty(grid.shape) if need_grid else grid.new_empty(0)


def _save_backward(ctx: Any, inputs: Any, output: Any) -> None:
    grad, bev, grid, ctx.border, ctx.align_corners, ctx.need_bev, ctx.need_grid = inputs
    ctx.save_for_backward(grad, bev, grid)
    ctx.set_materialize_grads(False)


def _double_backward(
    ctx: Any, grad_grad_bev: Tensor | None, grad_grad_grid: Tensor | None
) -> tuple[Tensor | None, ...]:
    grad, bev, grid = ctx.saved_tensors
    needs = ctx.needs_input_grad[:3]
    grad_grad_bev = grad_grad_bev if ctx.need_bev else None
    grad_grad_grid = grad_grad_grid if ctx.need_grid else None
    if grad_grad_bev is None and grad_grad_grid is None:
        return (None,) * 7
    grads = torch.ops.pred.sample_bev_double_backward(
        grad_grad_bev, grad_grad_grid, grad, bev, grid, ctx.border, ctx.align_corners, *needs
    )
    return *(value if need else None for value, need in zip(grads, needs, strict=True)), None, None, None, None


def _fake_double_backward(
    grad_grad_bev: Tensor | None,
    grad_grad_grid: Tensor | None,
    grad: Tensor,
    bev: Tensor,
    grid: Tensor,
    border: bool,
    align_corners: bool,
    need_grad: bool,
    need_bev: bool,
    need_grid: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    return (
        grad.new_empty(grad.shape) if need_grad else grad.new_empty(0),
        _empty_channels_last(bev) if need_bev else bev.new_empty(0),
        grid.new_empty(grid.shape) if need_grid else grid.new_empty(0),
    )


_native.register("sample_bev", fake=_fake, setup_context=_save, backward=_backward)
_native.register("sample_bev_backward", fake=_fake_backward, setup_context=_save_backward, backward=_double_backward)
_native.register("sample_bev_double_backward", fake=_fake_double_backward)
