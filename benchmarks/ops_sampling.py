# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the gathers from maps and volumes."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases
from benchmarks.case import BACKWARD, FORWARD, SECOND, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.report import Target
from pred import ops
from pred.ops import reference


def _sample_bev_cases(sizes: Sizes) -> list[Case]:
    bev = cases.bev_map(sizes.bev_channels, sizes.bev_cells)
    grids = {"along rays": cases.ray_grid(sizes, seed=1), "scattered": cases.scattered_grid(sizes, seed=1)}
    samples, channels = sizes.bev_rays * sizes.bev_samples_per_ray, sizes.bev_channels
    map_bytes, grid_bytes, out_bytes = bev.nbytes, 8 * samples, 4 * samples * channels
    forward = map_bytes + grid_bytes + out_bytes
    backward = forward + out_bytes + 2 * (map_bytes + grid_bytes)
    second = forward + (out_bytes + map_bytes + 2 * grid_bytes) + (3 * out_bytes + 2 * map_bytes + 3 * grid_bytes)
    return [
        Case(
            op="sample_bev",
            name=f"sample_bev {samples} samples {layout}, {channels} ch, {sizes.bev_cells}^2",
            unit="samples",
            items=samples,
            inputs=(bev, grid),
            ours=lambda bev, grid: (ops.sample_bev(bev, grid),),
            reference=lambda bev, grid: (reference.sample_bev(bev, grid),),
            eager={
                "channels_last": Variant(_eager_sample_bev),
                "NCHW": Variant(_eager_sample_bev, (bev.contiguous(), grid)),
            },
            compiled=("channels_last",),
            derivative_in=(0, 1),
            tolerance=1e-4,  # a coordinate among 180 cells is known to 1e-5 of a cell
            phases=(
                Phase(FORWARD, "4 (CHW + 2N + NC)", forward, (Target("eager", 4),)),
                Phase(BACKWARD, "4 (3 CHW + 6N + 2 NC)", backward, (Target("eager", 10),)),
                Phase(SECOND, "4 (4 CHW + 12N + 5 NC)", second, (Target("eager", 10),)),
            ),
        )
        for layout, grid in grids.items()
    ]


def _eager_sample_bev(bev: Tensor, grid: Tensor) -> tuple[Tensor, ...]:
    return (F.grid_sample(bev, grid[:, None], align_corners=False)[:, :, 0].transpose(1, 2),)


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "sample_bev": _sample_bev_cases,
}
