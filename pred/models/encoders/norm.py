# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Batch normalisation as in OpenPCDet's encoders, for batches of any size.

One value per channel has no variance (torch raises), and none at all would make the running statistics NaN. Such a
batch, of a frame with one visible point or without any, is normalised by the running statistics and leaves them alone.
"""

import torch.nn.functional as F
from torch import Tensor, nn

EPS = 1e-3
MOMENTUM = 0.01


class BatchNorm1d(nn.BatchNorm1d):
    """Of rows `[M, C]`."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=EPS, momentum=MOMENTUM)

    def forward(self, x: Tensor) -> Tensor:
        return _by_running_statistics(self, x) if _lacks_variance(self, x) else super().forward(x)


class BatchNorm2d(nn.BatchNorm2d):
    """Of maps `[B, C, H, W]`."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=EPS, momentum=MOMENTUM)

    def forward(self, x: Tensor) -> Tensor:
        return _by_running_statistics(self, x) if _lacks_variance(self, x) else super().forward(x)


def _lacks_variance(norm: nn.BatchNorm1d | nn.BatchNorm2d, x: Tensor) -> bool:
    return norm.training and x.numel() < 2 * x.shape[1]


def _by_running_statistics(norm: nn.BatchNorm1d | nn.BatchNorm2d, x: Tensor) -> Tensor:
    return F.batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)
