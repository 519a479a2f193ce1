# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of whole encoder parts.

DSVT-P, useful arithmetic in multiply-adds: M pillars, C channels, F feed-forward channels, l pillars in a pillar's own
set, averaged over pillars and layers. Each of the 2 x blocks layers takes 4 C^2 (query, key, value, output) and 2 C F
per pillar, and 2 l C for its attention; backward twice as much. Repeated slots, position embeddings and what is
computed twice are not counted.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from benchmarks import cases
from benchmarks.case import BACKWARD, FORWARD, Case, Function, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.plain_dsvt import PlainDSVT
from pred.models.encoders.dsvt import DSVT, DSVTConfig, set_partition

UNUSED_BIAS = "position_embedding_head.0.bias"
"""Batch normalisation takes it out again: its gradient is rounding."""


def _dsvt_cases(sizes: Sizes) -> list[Case]:
    config, grid = DSVTConfig(), (sizes.dsvt_cells, sizes.dsvt_cells)
    torch.manual_seed(0)
    ours, plain = DSVT(config, grid), PlainDSVT(config, grid)
    parameters = {name: value.detach() for name, value in ours.named_parameters()}
    names = list(parameters)
    found = []
    for pillars in sizes.dsvt_pillars:
        coords = cases.lidar_pillars(pillars, sizes.dsvt_cells, sizes.dsvt_m)
        features = torch.randn(len(coords), config.d_model, generator=torch.Generator().manual_seed(1))
        reference = _call(plain, names)
        forward = 2 * useful_multiply_adds(config, coords, grid)
        work = "2 (2 blocks) M (4 C^2 + 2 C F + 2 l C)"
        found.append(
            Case(
                op="dsvt",
                name=f"DSVT-P, nuScenes, {len(coords)} pillars",
                unit="pillars",
                items=len(coords),
                inputs=(features, coords, *parameters.values()),
                modules=(ours, plain),
                ours=_call(ours, names),
                reference=reference,
                eager={"nn.MultiheadAttention": Variant(reference)},
                compiled=(),  # the number of sets depends on the coordinates
                derivative_in=(0, *(2 + i for i, name in enumerate(names) if not name.endswith(UNUSED_BIAS))),
                # Two orders of summation in float32, through eight layers and batch normalisation
                tolerance=1e-3,
                needs_kernel=False,
                phases=(
                    Phase(FORWARD, "", 0, work=work, flop=forward),
                    Phase(BACKWARD, "", 0, work=f"3 {work}", flop=3 * forward),
                ),
            )
        )
    return found


def useful_multiply_adds(config: DSVTConfig, coords: Tensor, grid: tuple[int, int]) -> int:
    """Of a forward pass; see the head of this module."""
    channels, found = config.d_model, 0
    for block in range(config.num_blocks):
        window, shift = config.windows[block % 2]
        length = set_partition(coords, grid, window, shift, config.set_size).offsets.diff()
        products = len(coords) * (4 * channels**2 + 2 * channels * config.ffn_channels)
        found += 2 * (products + 2 * channels * int(length.square().sum()))
    return found


def _call(model: nn.Module, names: list[str]) -> Function:
    def call(features: Tensor, coords: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
        values = dict(zip(names, parameters, strict=True))
        return (torch.func.functional_call(model, values, (features, coords, 1)),)

    return call


CASES: dict[str, Callable[[Sizes], list[Case]]] = {"dsvt": _dsvt_cases}
