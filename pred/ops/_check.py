# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Argument checks of the public ops, one message form: ``op: argument must <rule>, got <fact>``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLOATING = (torch.float32, torch.float64)
HALF = (torch.bfloat16, torch.float16)


def check_shape(op: str, name: str, tensor: Tensor, shape: Sequence[int | str], where: str = "") -> None:
    """``shape`` mixes exact sizes (int) and free ones (their letter)."""
    sizes = tensor.shape
    fits = len(sizes) == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(sizes, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join(str(size) for size in shape)
        raise ValueError(f"{op}: {name} must have shape [{wanted}]{where}, got {list(sizes)}")


def check_dtype(op: str, name: str, tensor: Tensor, dtypes: Sequence[torch.dtype]) -> None:
    """``dtypes`` are the allowed ones."""
    if tensor.dtype not in dtypes:
        wanted = " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
        raise TypeError(f"{op}: {name} must be {wanted}, got {str(tensor.dtype).removeprefix('torch.')}")


def check_like(op: str, name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """``tensor`` must have the dtype and device of ``other``."""
    if tensor.dtype != other.dtype:
        raise TypeError(f"{op}: {name} must have the dtype of {other_name} ({other.dtype}), got {tensor.dtype}")
    if tensor.device != other.device:
        raise ValueError(f"{op}: {name} must be on the device of {other_name} ({other.device}), got {tensor.device}")


def widen(tensor: Tensor) -> Tensor:
    """In a half-precision (autocast) region: the tensor in float32 if it is narrower."""
    half = tensor.dtype in (torch.bfloat16, torch.float16)
    return tensor.float() if half and torch.is_autocast_enabled(tensor.device.type) else tensor


def as_geometry(tensor: Tensor) -> Tensor:
    """In float32 if it is narrower: distances, ranges and weights are too coarse in half precision."""
    return tensor.float() if tensor.dtype in HALF else tensor


def check_offsets(op: str, name: str, offsets: Tensor, rows: str, size: str, owner_name: str, owner: Tensor) -> None:
    """``offsets`` must be ``[rows + 1]`` int64 on the device of ``owner``, ascending from 0 to its first size; values
    are looked at where that is free."""
    check_shape(op, name, offsets, (f"{rows} + 1",))
    check_dtype(op, name, offsets, (torch.int64,))
    if offsets.device != owner.device:
        raise ValueError(f"{op}: {name} must be on the device of {owner_name} ({owner.device}), got {offsets.device}")
    if offsets.shape[0] == 0:
        raise ValueError(f"{op}: {name} must have shape [{rows} + 1] with {rows} >= 0, got [0]")
    if torch.compiler.is_compiling() or offsets.device.type != "cpu":
        return
    total = owner.shape[0]
    if offsets[0] != 0 or offsets[-1] != total or (offsets[1:] < offsets[:-1]).any():
        shown = str(offsets.tolist()) if len(offsets) <= 16 else f"{offsets[:8].tolist()} ... {int(offsets[-1])}"
        raise ValueError(f"{op}: {name} must ascend from 0 to {size}={total}, got {shown}")


def check_choice(op: str, name: str, value: str, choices: Sequence[str]) -> None:
    """``value`` must be one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{op}: {name} must be one of {', '.join(choices)}, got {value!r}")
