# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What NeuS and UniPAD publish, written out in plain PyTorch with their constants, clips and order of operations."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def published_section(
    sdf: Tensor, inv_s: Tensor, cosine: Tensor, length: Tensor, cos_anneal: float, eps: float
) -> Tensor:
    """NeuS's opacity, from its paper and supplement, and UniPAD's ``get_alpha``. They differ in where on the section
    ``sdf`` is read; both have ``eps`` 1e-5."""
    falling = -(F.relu(-cosine * 0.5 + 0.5) * (1.0 - cos_anneal) + F.relu(-cosine) * cos_anneal)
    prev_cdf = torch.sigmoid((sdf - falling * length * 0.5) * inv_s)
    next_cdf = torch.sigmoid((sdf + falling * length * 0.5) * inv_s)
    return ((prev_cdf - next_cdf + eps) / (prev_cdf + eps)).clip(0.0, 1.0)


def published_weights(alpha: Tensor) -> Tensor:  # [R, S]
    """Of both."""
    ones = torch.ones_like(alpha[:, :1])
    return alpha * torch.cumprod(torch.cat([ones, 1.0 - alpha + 1e-7], -1), -1)[:, :-1]
