# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Trilinear gather from a volume at ray samples."""

from __future__ import annotations

import torch
from torch import Tensor

from pred import _native
from pred.ops._sampling import SampledWithGrad, arguments, reference, register


def sample_volume(
    volume: Tensor,  # [B, C, D, H, W]
    grid: Tensor,  # [B, N, 3]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Samples a volume at continuous positions, as ``F.grid_sample`` does (trilinear, mode ``"bilinear"``).

    ``out[b, n, c] = sum_k w_k(grid[b, n]) volume[b, c, cell_k]`` over the eight surrounding cells.

    Args:
        volume: ``[B, C, D, H, W]`` float32, float64, bfloat16 or float16; layer = z, row = y, column = x.
            Channels-last memory avoids a copy. Half precision is read as it is and summed in float32.
        grid: ``[B, N, 3]`` positions (x, y, z) in [-1, 1]: float64 with a float64 map, else float32 (half precision is
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

    Differentiable twice in ``volume`` and ``grid`` (a third derivative raises). Where the value has a kink, on the
    planes through cell centres, the derivative is the one towards larger coordinates; at the outermost centres with
    border padding it is 0, as in ``F.grid_sample``. The gradient of a half-precision map is summed in float32 over
    all samples and rounded once. Deterministic for any number of threads.
    """
    _native.refuse_transforms("sample_volume")
    volume, grid = _arguments("sample_volume", volume, grid, padding_mode, align_corners)
    if not _native.use_native("sample_volume", volume):
        return sample_volume_reference(volume, grid, padding_mode, align_corners)
    out: Tensor = torch.ops.pred.sample_volume(volume, grid, padding_mode == "border", align_corners)
    return out


def sample_volume_with_grad(
    volume: Tensor,  # [B, C, D, H, W]
    grid: Tensor,  # [B, N, 3]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> SampledWithGrad:  # [B, N, C], [B, N, 3, C]
    """:func:`sample_volume` and its derivative in the position, in one pass.

    ``values[b, n, c] = sum_k w_k(grid[b, n]) volume[b, c, cell_k]``, ``grads[b, n, a, c] = sum_k (d w_k / d grid_a)
    volume[b, c, cell_k]`` over the eight surrounding cells. A normal or an Eikonal term of a field that is made of
    samples needs only the first derivative of these outputs, and so lives inside ``torch.compile``.

    Args:
        volume, grid, padding_mode, align_corners: as in :func:`sample_volume`.

    Returns:
        ``values`` ``[B, N, C]`` and ``grads`` ``[B, N, 3, C]``, the derivative by ``grid[b, n, a]``, a = x, y, z,
        in the map's dtype. A NaN coordinate gives NaN in both, in its own sample.

    Raises:
        As :func:`sample_volume`.

    Differentiable once in ``volume`` and ``grid``, through both outputs; a second derivative raises. Kinks,
    rounding and determinism as in :func:`sample_volume`.
    """
    _native.refuse_transforms("sample_volume_with_grad")
    volume, grid = _arguments("sample_volume_with_grad", volume, grid, padding_mode, align_corners)
    if not _native.use_native("sample_volume_with_grad", volume):
        return sample_volume_with_grad_reference(volume, grid, padding_mode, align_corners)
    return SampledWithGrad(
        *torch.ops.pred.sample_volume_with_grad(volume, grid, padding_mode == "border", align_corners)
    )


def sample_volume_reference(
    volume: Tensor,  # [B, C, D, H, W]
    grid: Tensor,  # [B, N, 3]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> Tensor:  # [B, N, C]
    """Plain PyTorch form of :func:`sample_volume`: by its definition, differentiable any number of times."""
    volume, grid = _arguments("sample_volume", volume, grid, padding_mode, align_corners)
    (values,) = reference(volume, grid, padding_mode == "border", align_corners, with_grad=False)
    return values


def sample_volume_with_grad_reference(
    volume: Tensor,  # [B, C, D, H, W]
    grid: Tensor,  # [B, N, 3]
    padding_mode: str = "zeros",
    align_corners: bool = False,
) -> SampledWithGrad:  # [B, N, C], [B, N, 3, C]
    """Plain PyTorch form of :func:`sample_volume_with_grad`, differentiable any number of times."""
    volume, grid = _arguments("sample_volume_with_grad", volume, grid, padding_mode, align_corners)
    values, *grads = reference(volume, grid, padding_mode == "border", align_corners, with_grad=True)
    return SampledWithGrad(values, torch.stack(grads, dim=2))


def _arguments(op: str, volume: Tensor, grid: Tensor, padding_mode: str, align_corners: bool) -> tuple[Tensor, Tensor]:
    return arguments(op, "volume", 3, volume, grid, padding_mode, align_corners)


register("sample_volume")
