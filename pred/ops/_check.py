# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Argument checks of the public ops, one message form: ``op: argument must <rule>, got <fact>``."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

import torch
from torch import Tensor

FLOATING = (torch.float32, torch.float64)
HALF = (torch.bfloat16, torch.float16)


def check_tensors(op: str, **arguments: object) -> None:
    """Each must be a dense tensor."""
    for name, value in arguments.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{op}: {name} must be a tensor, got {type(value).__name__}")
        if value.layout != torch.strided:
            raise TypeError(f"{op}: {name} must be dense, got a tensor of layout {value.layout}")


def check_shape(op: str, name: str, tensor: Tensor, shape: Sequence[int | str], where: str = "") -> None:
    """``shape`` mixes exact sizes (int) and free ones (their letter)."""
    sizes = tensor.shape
    fits = len(sizes) == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(sizes, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join(str(size) for size in shape)
        single = len(sizes) == len(shape) - 1 and shape[0] in ("B", "R")
        hint = f"; if there is only one: {name}.unsqueeze(0)" if single else ""
        raise ValueError(f"{op}: {name} must have shape [{wanted}]{where}, got {list(sizes)}{hint}")


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
    return tensor.float() if tensor.dtype in HALF and torch.is_autocast_enabled(tensor.device.type) else tensor


def as_geometry(tensor: Tensor, dims: int | None = None) -> Tensor:
    """In float32 if it is narrower: positions, distances and weights are too coarse in half precision.

    With ``dims``, a last dimension of 1 beyond them is dropped: ``[R, S, 1]`` becomes ``[R, S]``.
    """
    if dims is not None and tensor.dim() == dims + 1 and tensor.shape[-1] == 1:
        tensor = tensor[..., 0]
    return tensor.float() if tensor.dtype in HALF else tensor


def check_features(op: str, name: str, features: Tensor, other_name: str, geometry: Tensor) -> None:
    """``features`` must have the device and dtype of ``geometry``, or be half precision beside float32."""
    half = features.dtype in HALF and geometry.dtype == torch.float32
    check_like(op, name, features.new_empty(0, dtype=torch.float32) if half else features, other_name, geometry)


def check_number(op: str, name: str, value: object) -> None:
    """``value`` must be a plain number that a float holds. In a compiled graph it may be symbolic, and is not looked
    at."""
    if torch.compiler.is_compiling():
        return
    if isinstance(value, Tensor) or not hasattr(value, "__float__"):
        raise TypeError(f"{op}: {name} must be a number, got {type(value).__name__}")
    try:
        float(value)
    except (TypeError, ValueError):  # an array of several, or of text
        raise TypeError(f"{op}: {name} must be a number, got {type(value).__name__}") from None
    except OverflowError:
        raise ValueError(f"{op}: {name} must be in the range of float64, got a larger whole number") from None


def check_floats(op: str, name: str, values: Sequence[float], count: int) -> list[float]:
    """``count`` finite numbers."""
    try:
        size = len(values)
    except TypeError:  # a tensor or array of no dimensions too
        raise TypeError(f"{op}: {name} must hold {count} numbers, got {type(values).__name__}") from None
    if size != count:  # before a tensor of any size is made a list
        raise ValueError(f"{op}: {name} must hold {count} finite numbers, got {size}")
    for value in values:
        check_number(op, name, value)
    floats = [float(value) for value in values]
    if not all(math.isfinite(value) for value in floats):
        raise ValueError(f"{op}: {name} must hold {count} finite numbers, got {floats}")
    return floats


def check_count(op: str, name: str, value: int, least: int = 0) -> None:
    """``value`` must be an integer of at least ``least``. In a compiled graph it is not looked at, as above."""
    if torch.compiler.is_compiling():
        return
    try:
        whole = not isinstance(value, (bool, Tensor)) and operator.index(value) == value
    except TypeError:  # arrays of several numbers have an __index__ too
        whole = False
    if not whole:
        raise TypeError(f"{op}: {name} must be an integer, got {type(value).__name__}")
    if value < least:
        raise ValueError(f"{op}: {name} must be at least {least}, got {value}")


def check_flags(op: str, **flags: object) -> None:
    """Each must be True or False."""
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise TypeError(f"{op}: {name} must be True or False, got {type(value).__name__}")


def check_choice(op: str, name: str, value: str, choices: Sequence[str]) -> None:
    """``value`` must be one of ``choices``."""
    if not isinstance(value, str):
        raise TypeError(f"{op}: {name} must be one of {', '.join(choices)}, got {type(value).__name__}")
    if value not in choices:
        raise ValueError(f"{op}: {name} must be one of {', '.join(choices)}, got {value!r}")


def check_offsets(op: str, name: str, offsets: Tensor, letters: str, other_name: str, other: Tensor) -> None:
    """``offsets`` must be int64 and ascend from 0 to the rows of ``other``; values are looked at in eager CPU calls.

    ``letters``: of what the offsets divide the rows into, and of the rows, such as ``"RP"`` for rays and samples.
    """
    parts, rows = letters[0], letters[1]
    check_shape(op, name, offsets, (f"{parts} + 1",))
    check_dtype(op, name, offsets, (torch.int64,))
    if offsets.device != other.device:
        raise ValueError(f"{op}: {name} must be on the device of {other_name} ({other.device}), got {offsets.device}")
    if offsets.shape[0] == 0:
        raise ValueError(f"{op}: {name} must have shape [{parts} + 1] with {parts} >= 0, got [0]")
    if torch.compiler.is_compiling() or offsets.device.type != "cpu":
        return
    count = other.shape[0]
    if offsets[0] != 0 or offsets[-1] != count or (offsets[1:] < offsets[:-1]).any():
        shown = offsets.tolist() if offsets.shape[0] <= 16 else f"{offsets[:8].tolist()} ... {int(offsets[-1])}"
        raise ValueError(f"{op}: {name} must ascend from 0 to {rows}={count}, got {shown}")
