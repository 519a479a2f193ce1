# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Argument checks of the public ops, one message form: ``op: argument must <rule>, got <fact>``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLOATING = (torch.float32, torch.float64)


def check_tensors(op: str, **arguments: object) -> None:
    """Each must be a tensor."""
    for name, value in arguments.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{op}: {name} must be a tensor, got {type(value).__name__}")


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


def check_choice(op: str, name: str, value: str, choices: Sequence[str]) -> None:
    """``value`` must be one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{op}: {name} must be one of {', '.join(choices)}, got {value!r}")
