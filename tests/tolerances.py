# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Tolerances of native against reference, by dtype. A looser one in a test carries its cause in a comment."""

from __future__ import annotations

import torch
from torch import Tensor

FORWARD = {torch.float32: 2e-6, torch.float64: 1e-13}
GRADIENT = {torch.float32: 1e-5, torch.float64: 1e-12}
PLACE = {torch.float32: 2e-6, torch.float64: 2e-14}
"""Of new samples, over the largest range. A rounding of u or of the cumulative distribution, 6e-8 or 1e-16, moves a
sample by rounding / p of its section. In the least probable sections of these tests (p = 0.0013, 1/49 of the largest
range; of more samples both are smaller alike) that is 16 roundings: 1e-6 in float32 by each of the two. In float64 the
distribution carries the roundings of a sum of 100 and more. Measured: 1.2e-6 and 1e-14."""


def of_rounded_distances(before: float, after: float, inv_s: float, dtype: torch.dtype) -> float:
    """Relative error of the opacity between two signed distances, and of its derivatives, that their rounding makes: it
    changes exp(s (after - before)) by s times as much, and 1 - exp() by its share in their difference."""
    eps, difference = torch.finfo(dtype).eps, abs(before - after) or 1.0
    return 8 * eps + eps * max(abs(before), abs(after)) * (inv_s + 1 / difference)


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected magnitude (at least 1e-30); inf where NaNs do not coincide."""
    if actual.shape != expected.shape:
        raise AssertionError(f"shape {tuple(actual.shape)} against {tuple(expected.shape)}")
    if not torch.equal(actual.isnan(), expected.isnan()):
        return float("inf")
    actual, expected = actual.detach().nan_to_num(0.0).double(), expected.detach().nan_to_num(0.0).double()
    if actual.numel() == 0:
        return 0.0
    scale = max(float(expected.abs().max()), 1e-30)
    return float((actual - expected).abs().max()) / scale


def assert_close(actual: Tensor, expected: Tensor, tolerance: float, what: str = "") -> None:
    """Norm-wise comparison; the message names the place of the largest difference."""
    error = relative_error(actual, expected)
    if not error <= tolerance:
        place = ""
        if actual.numel() and error != float("inf"):
            flat = int((actual - expected).abs().nan_to_num(0.0).argmax())
            place = f" at flat index {flat}: {actual.flatten()[flat]} against {expected.flatten()[flat]}"
        raise AssertionError(f"{what or 'value'}: relative error {error:.3g} > {tolerance:.3g}{place}")
