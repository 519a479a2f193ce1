# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Rulebooks of sparse convolutions: which active site feeds which, through which tap of the kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import check_count, check_dtype, check_flags, check_shape, check_tensors

_MAX_KEYS = 2**62
_MAX_EXTENT = 2**30
_MAX_TAPS = 4096


class Rulebook(NamedTuple):
    """Output sites of a sparse convolution, and its taps seen from both sides."""

    out_indices: Tensor  # [M', 4], (b, z, y, x), in the dtype of the input's
    out_to_in: Tensor  # [M', K] int32: the input row that an output reads through each tap, -1 where there is none
    in_to_out: Tensor  # [M, K] int32: the output row that an input feeds through each tap, -1 where there is none


def build_rulebook(
    indices: Tensor,  # [M, 4]
    batch_size: int,
    spatial_shape: Sequence[int],
    kernel_size: int | Sequence[int] = 3,
    stride: int | Sequence[int] = 1,
    padding: int | Sequence[int] = 0,
    dilation: int | Sequence[int] = 1,
    submanifold: bool = False,
) -> Rulebook:
    """Finds the pairs of sites that a sparse convolution multiplies (Graham et al., 2018; as in spconv 2.x).

    Per axis output o reads the inputs ``o stride - padding + k dilation`` for k in [0, kernel_size), as in
    ``torch.nn.functional.conv3d``. Active outputs are the sites that read at least one active input; of a submanifold
    convolution they are the inputs themselves. Taps are numbered (z, y, x), x fastest: K = kz ky kx.
    The tables of a convolution, exchanged, are those of the transposed one back to its inputs.

    Args:
        indices: ``[M, 4]`` int32 or int64 (b, z, y, x) of the active sites, distinct, in any order.
        batch_size: B; b lies in [0, B).
        spatial_shape: cells (z, y, x).
        kernel_size, stride, padding, dilation: one number, or (z, y, x). ``submanifold`` sets stride and padding.
        submanifold: outputs are the inputs, in their order; kernel sizes must be odd.

    Returns:
        ``out_indices`` in ascending (b, z, y, x) order (submanifold: those given), ``out_to_in`` and ``in_to_out``.

    Raises:
        ValueError: shape or sizes; a kernel that the padded grid does not hold; more than 2^62 sites, 4096 taps, or
            2^31 sites x taps; sites outside the grid or given twice (values are checked for CPU tensors).
        TypeError: dtype.

    Not differentiable: the outputs are integers. Equal for any thread count.
    """
    _native.refuse_transforms("build_rulebook")
    arguments = _arguments(indices, batch_size, spatial_shape, kernel_size, stride, padding, dilation, submanifold)
    if not _native.use_native("build_rulebook", indices):
        return _reference(indices, batch_size, *arguments, submanifold)
    found = _native.checked(
        torch.ops.pred.build_rulebook, indices.long(), batch_size, *(list(x) for x in arguments), submanifold
    )
    return Rulebook(found[0].to(indices.dtype), found[1], found[2])


def build_rulebook_reference(
    indices: Tensor,  # [M, 4]
    batch_size: int,
    spatial_shape: Sequence[int],
    kernel_size: int | Sequence[int] = 3,
    stride: int | Sequence[int] = 1,
    padding: int | Sequence[int] = 0,
    dilation: int | Sequence[int] = 1,
    submanifold: bool = False,
) -> Rulebook:
    """Plain PyTorch form of :func:`build_rulebook`: sites by number, found by sorting."""
    arguments = _arguments(indices, batch_size, spatial_shape, kernel_size, stride, padding, dilation, submanifold)
    return _reference(indices, batch_size, *arguments, submanifold)


Triple = tuple[int, int, int]


def output_shape(shape: Triple, kernel: Triple, stride: Triple, padding: Triple, dilation: Triple) -> Triple:
    """Cells (z, y, x) of a convolution's output, as of ``conv3d``; fewer than 1 where the kernel does not fit."""
    z, y, x = (
        (shape[axis] + 2 * padding[axis] - dilation[axis] * (kernel[axis] - 1) - 1) // stride[axis] + 1
        for axis in range(3)
    )
    return z, y, x


def _reference(
    indices: Tensor,
    batch_size: int,
    shape: Triple,
    kernel: Triple,
    stride: Triple,
    padding: Triple,
    dilation: Triple,
    submanifold: bool,
) -> Rulebook:
    device, num_sites = indices.device, indices.shape[0]
    out_shape = output_shape(shape, kernel, stride, padding, dilation)
    sites = indices.long()
    check_sites("build_rulebook", sites, batch_size, shape)
    tap = torch.cartesian_prod(*(torch.arange(size, device=device) for size in kernel)).view(-1, 3)
    scaled = sites[:, None, 1:] + torch.tensor(padding, device=device) - tap * torch.tensor(dilation, device=device)
    step, extent = torch.tensor(stride, device=device), torch.tensor(out_shape, device=device)
    fed = scaled.div(step, rounding_mode="floor")  # [M, K, 3]
    valid = ((scaled % step == 0) & (fed >= 0) & (fed < extent)).all(dim=2)
    key = _number(sites[:, None, 0], fed, out_shape)
    if submanifold:
        keys, row_of = _number(sites[:, 0], sites[:, 1:], shape).sort()
        out_indices = indices.clone()
    else:
        keys = key[valid].unique()
        row_of = torch.arange(keys.shape[0], device=device)
        z, y, x = out_shape
        columns = [keys // (x * y * z), keys // (x * y) % z, keys // x % y, keys % x]
        out_indices = torch.stack(columns, dim=1).to(indices.dtype)
    num_out = out_indices.shape[0]
    if num_out == 0:
        return Rulebook(
            out_indices, tap.new_empty(0, tap.shape[0]).int(), tap.new_full((num_sites, tap.shape[0]), -1).int()
        )
    position = torch.searchsorted(keys, key.contiguous()).clamp_max(num_out - 1)
    valid &= keys[position] == key
    in_to_out = torch.where(valid, row_of[position], -1)
    out_to_in = torch.full((num_out, tap.shape[0]), -1, device=device)
    site, through = valid.nonzero(as_tuple=True)
    out_to_in[in_to_out[site, through], through] = site
    return Rulebook(out_indices, out_to_in.int(), in_to_out.int())


def _number(frame: Tensor, zyx: Tensor, shape: Triple) -> Tensor:
    return ((frame * shape[0] + zyx[..., 0]) * shape[1] + zyx[..., 1]) * shape[2] + zyx[..., 2]


def check_sites(op: str, sites: Tensor, batch_size: int, shape: Triple) -> None:
    """``sites [M, 4]`` int64 must lie inside the grid and be distinct; looked at in eager CPU calls."""
    if torch.compiler.is_compiling() or sites.device.type != "cpu":
        return
    extent = sites.new_tensor([batch_size, *shape])
    outside = ((sites < 0) | (sites >= extent)).any(dim=1).nonzero()
    if outside.numel():
        row = int(outside[0, 0])
        raise ValueError(
            f"{op}: indices must lie inside batch_size {batch_size} and spatial_shape {list(shape)}, got "
            f"{sites[row].tolist()} in row {row}"
        )
    keys, order = _number(sites[:, 0], sites[:, 1:], shape).sort(stable=True)
    repeated = (keys[1:] == keys[:-1]).nonzero()[:, 0]
    if repeated.numel():
        later = int(order[repeated + 1].min())
        first = int(order[(keys == keys[order == later]).nonzero()[0, 0]])
        raise ValueError(f"{op}: indices must be distinct, got one site in rows {first} and {later}")


def _arguments(
    indices: Tensor,
    batch_size: int,
    spatial_shape: Sequence[int],
    kernel_size: int | Sequence[int],
    stride: int | Sequence[int],
    padding: int | Sequence[int],
    dilation: int | Sequence[int],
    submanifold: bool,
) -> tuple[Triple, Triple, Triple, Triple, Triple]:
    op = "build_rulebook"
    check_tensors(op, indices=indices)
    check_shape(op, "indices", indices, ("M", 4))
    check_dtype(op, "indices", indices, (torch.int32, torch.int64))
    check_count(op, "batch_size", batch_size)
    check_flags(op, submanifold=submanifold)
    shape = triple(op, "spatial_shape", spatial_shape, 1)
    kernel = triple(op, "kernel_size", kernel_size, 1)
    spread = triple(op, "dilation", dilation, 1)
    step, pad = triple(op, "stride", stride, 1), triple(op, "padding", padding, 0)
    if submanifold:
        if any(size % 2 == 0 for size in kernel):
            raise ValueError(f"{op}: kernel_size must be odd for a submanifold convolution, got {list(kernel)}")
        step = (1, 1, 1)
        pad = centred_padding(op, kernel, spread)
    if math.prod(kernel) > _MAX_TAPS:
        raise ValueError(f"{op}: kernel_size must give at most {_MAX_TAPS} taps, got {list(kernel)}")
    out_shape = output_shape(shape, kernel, step, pad, spread)
    if min(out_shape) < 1:
        raise ValueError(
            f"{op}: spatial_shape must hold the kernel, got {list(shape)} for kernel_size {list(kernel)}, padding "
            f"{list(pad)}, dilation {list(spread)}"
        )
    check_grid(op, batch_size, shape)
    check_grid(op, batch_size, out_shape)
    return shape, kernel, step, pad, spread


def centred_padding(op: str, kernel: Triple, dilation: Triple) -> Triple:
    """The padding that keeps a grid's cells, of a kernel of odd sizes."""
    z, y, x = (spread * (size // 2) for spread, size in zip(dilation, kernel, strict=True))
    if not torch.compiler.is_compiling() and max(z, y, x) > _MAX_EXTENT:
        raise ValueError(
            f"{op}: dilation must keep half the kernel within 2^30 cells, got {list(dilation)} for kernel_size "
            f"{list(kernel)}"
        )
    return z, y, x


def check_grid(op: str, batch_size: int, shape: Triple) -> None:
    """Cells must have numbers that int64 holds."""
    if max(1, batch_size) * math.prod(shape) > _MAX_KEYS:
        raise ValueError(
            f"{op}: spatial_shape must give at most 2^62 sites in all frames, got {list(shape)} in {batch_size}"
        )


def triple(op: str, name: str, value: Any, least: int = 0) -> Triple:
    """A whole number for each of z, y and x, of at least ``least`` and at most 2^30."""
    numbers = tuple(value) if hasattr(value, "__len__") else (value,) * 3
    if len(numbers) != 3:
        raise ValueError(f"{op}: {name} must hold 3 numbers (z, y, x), got {len(numbers)}")
    for number in numbers:
        check_count(op, name, number, least)
        if not torch.compiler.is_compiling() and number > _MAX_EXTENT:
            raise ValueError(f"{op}: {name} must be at most 2^30, got {number}")
    z, y, x = numbers if torch.compiler.is_compiling() else (int(number) for number in numbers)
    return z, y, x


def _fake(
    indices: Tensor,
    batch_size: int,
    spatial_shape: list[int],
    kernel_size: list[int],
    stride: list[int],
    padding: list[int],
    dilation: list[int],
    submanifold: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    num_sites, taps = indices.shape[0], math.prod(kernel_size)
    num_out = num_sites if submanifold else torch.library.get_ctx().new_dynamic_size()
    return (
        indices.new_empty(num_out, 4),
        indices.new_empty(num_out, taps, dtype=torch.int32),
        indices.new_empty(num_sites, taps, dtype=torch.int32),
    )


_native.register("build_rulebook", fake=_fake, differentiable=False)
