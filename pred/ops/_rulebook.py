# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a rulebook's tables, for the ops that follow them."""

from __future__ import annotations

import torch
from torch import Tensor

from pred.ops._check import FLOATING, HALF, check_dtype, check_shape, check_tensors


def check_tables(op: str, features: Tensor, out_to_in: Tensor, in_to_out: Tensor) -> None:
    """``features [M, C]``, ``out_to_in [M', K]`` and ``in_to_out [M, K]``, whose numbers are rows of the other side."""
    check_tensors(op, features=features, out_to_in=out_to_in, in_to_out=in_to_out)
    check_shape(op, "features", features, ("M", "C"))
    check_dtype(op, "features", features, FLOATING + HALF)
    check_shape(op, "out_to_in", out_to_in, ("M'", "K"))
    check_shape(op, "in_to_out", in_to_out, (features.shape[0], out_to_in.shape[1]), " as features and out_to_in")
    for name, table, numbers in (
        ("out_to_in", out_to_in, features.shape[0]),
        ("in_to_out", in_to_out, out_to_in.shape[0]),
    ):
        check_dtype(op, name, table, (torch.int32,))
        if table.device != features.device:
            raise ValueError(f"{op}: {name} must be on the device of features ({features.device}), got {table.device}")
        if torch.compiler.is_compiling() or table.device.type != "cpu" or table.numel() == 0:
            continue
        low, high = (int(x) for x in table.aminmax())
        if low < -1 or high >= numbers:
            wrong = ((table < -1) | (table >= numbers)).nonzero()[0].tolist()
            raise ValueError(
                f"{op}: {name} must lie in [-1, {numbers}), got {int(table[wrong[0], wrong[1]])} in row {wrong[0]}"
            )


def padded(rows: Tensor) -> Tensor:
    """With a row of zeros at the end, which a table's -1 reads."""
    return torch.cat([rows, rows.new_zeros(1, rows.shape[1])])
