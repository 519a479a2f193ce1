# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The three terms of the pre-training objective, L = L_semantic + L_depth + 0.1 L_eikonal (PRED Eq. 8).

B frames, R rays per frame, S samples per ray, K classes. Each term is a mean over the valid rays of
all frames together; without a valid ray it is exactly 0 and so is its gradient. What an invalid ray
holds does not matter, NaN included.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

PROBABILITY_FLOOR = 1e-6
"""Added to rendered probabilities before the logarithm: they sum to the ray's opacity, maybe 0."""

NORM_FLOOR = 1e-12
"""Added under the root of the gradient's norm, whose own derivative is undefined at 0."""


@dataclass
class LossConfig:
    """Weights of the loss terms."""

    semantic_weight: float = 1.0
    """Weight of the semantic term."""
    depth_weight: float = 1.0
    """Weight of the depth term."""
    eikonal_weight: float = 0.1
    """Weight of the Eikonal term (lambda of the paper)."""
    semantic_at: Literal["ray", "return"] = "ray"
    """Where classes are compared with the pseudo label: rendered along the ray, or (direct projection, an ablation) the
    field's at the LiDAR return itself, without rendering."""
    depth_unit_m: float = 4.0
    """Depth errors are counted in this unit, metres: squared metres would drown the other terms."""

    def __post_init__(self) -> None:
        for name in ("semantic_weight", "depth_weight", "eikonal_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"LossConfig: {name} must not be negative, got {getattr(self, name)}")
        if not self.depth_unit_m > 0:
            raise ValueError(f"LossConfig: depth_unit_m must be positive, got {self.depth_unit_m}")


def semantic_loss(
    probabilities: Tensor,  # [B, R, K]
    target: Tensor,  # [B, R, K]
    confidence: Tensor,  # [B, R]
    valid: Tensor,  # [B, R] bool
) -> Tensor:
    """Confidence-weighted cross-entropy, mean of -max(s_bar) sum_k s_bar_k log(s_hat_k) (PRED Eq. 5).

    Args:
        probabilities: rendered class probabilities s_hat; they sum to the ray's opacity.
        target: pseudo-label probabilities s_bar.
        confidence: largest entry of each target.
        valid: rays that count.
    """
    probabilities, target, confidence = (_zeroed(x, valid) for x in (probabilities, target, confidence))
    cross_entropy = -(target * (probabilities + PROBABILITY_FLOOR).log()).sum(-1)
    return mean_over_valid(confidence * cross_entropy, valid)


def depth_loss(
    depth_m: Tensor,  # [B, R]
    target_m: Tensor,  # [B, R]
    valid: Tensor,  # [B, R] bool
    unit_m: float,
) -> Tensor:
    """Squared depth error in units of `unit_m`, mean of ((d_gt - d_hat) / unit)^2 (PRED Eq. 7)."""
    error = (_zeroed(target_m, valid) - _zeroed(depth_m, valid)) / unit_m
    return mean_over_valid(error.square(), valid)


def eikonal_loss(
    gradient: Tensor,  # [B, R, S, 3]
    valid: Tensor,  # [B, R] bool
) -> Tensor:
    """Mean of (|d sdf / d point| - 1)^2 over rays and samples (PRED Eq. 9), differentiable at 0."""
    norm = (_zeroed(gradient, valid).square().sum(-1) + NORM_FLOOR).sqrt()
    return mean_over_valid((norm - 1).square().mean(-1), valid)


def mean_over_valid(values: Tensor, valid: Tensor) -> Tensor:
    """Mean of `values` where `valid`; 0 with zero gradient if that is nowhere."""
    return _zeroed(values, valid).sum() / valid.sum().clamp_min(1)


def _zeroed(
    values: Tensor,  # [B, R, ...]
    valid: Tensor,  # [B, R] bool
) -> Tensor:
    """Values with 0 for the rays that are not valid.

    Applied to the inputs of a formula as well as to its result: with a NaN inside, the formula's
    derivative would be 0 * NaN. A product instead of where() would have the same fault.
    """
    mask = valid.view(*valid.shape, *[1] * (values.dim() - valid.dim()))
    return torch.where(mask, values, torch.zeros_like(values))
