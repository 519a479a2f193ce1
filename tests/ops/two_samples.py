# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Hand-computed opacities between two samples, for every op that forms them from signed distances."""

from __future__ import annotations

import math


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


TWO_SAMPLES = {
    "crossing": (1.0, -1.0, 1.0, 1 - math.exp(-1), math.exp(-1) * sigmoid(-1), -sigmoid(-1)),
    "deep inside, falling": (-2.0, -2.1, 64.0, 1 - math.exp(-6.4), 64 * math.exp(-6.4), -64 * math.exp(-6.4)),
    "inside, rising": (-3.0, -2.9, 64.0, 0.0, 0.0, 0.0),
    "inside, nearly flat": (
        -1.0,
        -1.0001,
        64.0,
        1 - math.exp(-0.0064),
        64 * math.exp(-0.0064),
        -64 * math.exp(-0.0064),
    ),
    "free space": (10.0, 9.9, 64.0, 0.0, 0.0, 0.0),
    "free space, a long section": (10.0, 9.0, 64.0, 0.0, 0.0, 0.0),
    "small crossing": (
        0.3,
        0.29,
        20.0,
        1 - sigmoid(5.8) / sigmoid(6),
        20 * sigmoid(5.8) / sigmoid(6) * sigmoid(-6),
        -20 * sigmoid(5.8) / sigmoid(6) * sigmoid(-5.8),
    ),
    "tie": (0.5, 0.5, 64.0, 0.0, 0.0, 0.0),
    "opaque": (7.8125, -7.8125, 64.0, 1.0, 0.0, 0.0),
}
"""(d_i, d_i+1, s, alpha, d alpha / d d_i, d alpha / d d_i+1), by the definition 1 - Phi(d_i+1) / Phi(d_i), whose
derivatives are s ratio (1 - Phi) of either end; where that is 0 / 0 in floating point, by its limit
1 - exp(s (d_i+1 - d_i))."""
