# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Bilinear gather from a BEV map at ray samples."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._sampling import SampledWithGrad, arguments, reference, register


def sample_bev(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Samples a BEV map at continuous positions, as ``F.grid_sample`` does (bilinear, mode ``"bilinear"``).

    ``out[b, n, c] = sum_k w_k(grid[b, n]) bev[b, c, cell_k]`` over the four surrounding cells.

    Args:
        bev: ``[B, C, H, W]`` float32, float64, bfloat16 or float16; row = y, column = x.
            Channels-last memory avoids a copy. Half precision is read as it is and summed in float32.
        grid: ``[B, N, 2]`` positions (x, y) in [-1, 1]: float64 with a float64 map, else float32 (half precision is
            widened). With ``align_corners=False`` -1 and 1 are the outer faces of the map, with True the centres
            of its outer cells.
        padding_mode: ``"zeros"`` reads 0 outside the map, ``"border"`` the nearest cell.
        align_corners: as in ``F.grid_sample``.

    Returns:
        ``[B, N, C]`` in the map's dtype. A NaN coordinate gives NaN in its own sample and contributes to no gradient
        but its own. Empty for ``B = 0`` or ``N = 0``.

    Raises:
        ValueError: shape, device or ``padding_mode``; in the backward pass of a map, 2^31 or more samples B N
            (compiled). TypeError: dtype.

    Differentiable twice in ``bev`` and ``grid`` (a third derivative raises). Where the value has a kink, on the
    lines through cell centres, the derivative is the one towards larger coordinates; at the outermost centres with
    border padding it is 0, as in ``F.grid_sample``. The gradient of a half-precision map is summed in float32 over
    all samples and rounded once. Deterministic for any number of threads.
    """
    _native.refuse_transforms("sample_bev")
    bev, grid = _arguments("sample_bev", bev, grid, padding_mode, align_corners)
    if not _native.use_native("sample_bev", bev):
        return sample_bev_reference(bev, grid, padding_mode, align_corners)
    out: Tensor = torch.ops.pred.sample_bev(bev, grid, padding_mode == "border", align_corners)
    return out


def sample_bev_with_grad(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> SampledWithGrad:  # [B, N, C], [B, N, 2, C]
    """:func:`sample_bev` and its derivative in the position, in one pass.

    ``values[b, n, c] = sum_k w_k(grid[b, n]) bev[b, c, cell_k]``, ``grads[b, n, a, c] = sum_k (d w_k / d grid_a)
    bev[b, c, cell_k]`` over the four surrounding cells. A normal or an Eikonal term of a field that is made of
    samples needs only the first derivative of these outputs, and so lives inside ``torch.compile``.

    Args:
        bev, grid, padding_mode, align_corners: as in :func:`sample_bev`.

    Returns:
        ``values`` ``[B, N, C]`` and ``grads`` ``[B, N, 2, C]``, the derivative by ``grid[b, n, a]``, a = x, y,
        in the map's dtype. A NaN coordinate gives NaN in both, in its own sample.

    Raises:
        As :func:`sample_bev`.

    Differentiable once in ``bev`` and ``grid``, through both outputs; a second derivative raises. Kinks,
    rounding and determinism as in :func:`sample_bev`.
    """
    _native.refuse_transforms("sample_bev_with_grad")
    bev, grid = _arguments("sample_bev_with_grad", bev, grid, padding_mode, align_corners)
    if not _native.use_native("sample_bev_with_grad", bev):
        return sample_bev_with_grad_reference(bev, grid, padding_mode, align_corners)
    return SampledWithGrad(*torch.ops.pred.sample_bev_with_grad(bev, grid, padding_mode == "border", align_corners))


def sample_bev_reference(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Plain PyTorch form of :func:`sample_bev`: by its definition, differentiable any number of times."""
    bev, grid = _arguments("sample_bev", bev, grid, padding_mode, align_corners)
    (values,) = reference(bev, grid, padding_mode == "border", align_corners, with_grad=False)
    return values


def sample_bev_with_grad_reference(
    bev: Tensor,  # [B, C, H, W]
    grid: Tensor,  # [B, N, 2]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> SampledWithGrad:  # [B, N, C], [B, N, 2, C]
    """Plain PyTorch form of :func:`sample_bev_with_grad`, differentiable any number of times."""
    bev, grid = _arguments("sample_bev_with_grad", bev, grid, padding_mode, align_corners)
    values, *grads = reference(bev, grid, padding_mode == "border", align_corners, with_grad=True)
    return SampledWithGrad(values, torch.stack(grads, dim=2))


def _arguments(op: str, bev: Tensor, grid: Tensor, padding_mode: str, align_corners: bool) -> tuple[Tensor, Tensor]:
    return arguments(op, "bev", 2, bev, grid, padding_mode, align_corners)


register("sample_bev")
