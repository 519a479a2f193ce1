# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the gathers from maps and volumes."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases
from benchmarks.case import BACKWARD, FORWARD, SECOND, Case, Function, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.report import Target
from pred import ops
from pred.ops import SampledWithGrad, reference


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


def _volume_inputs(sizes: Sizes) -> tuple[Tensor, Tensor]:
    """A channels-last volume of UniPAD's proportions (32 channels, 5 x 180 x 180) and samples along rays."""
    channels, cells, layers = max(1, sizes.bev_channels // 4), sizes.bev_cells, 5
    generator = torch.Generator().manual_seed(0)
    volume = torch.randn(1, layers, cells, cells, channels, generator=generator).permute(0, 4, 1, 2, 3)
    plan = cases.ray_grid(sizes, seed=1)
    height = cases.off_lattice(2 * torch.rand(*plan.shape[:2], 1, generator=generator) - 1, layers)
    return volume, torch.cat([plan, height], dim=-1)


def _half_cases(sizes: Sizes) -> list[Case]:
    """The map in bfloat16, the grid in float32; eager has to bring both to one dtype."""
    bev = cases.bev_map(sizes.bev_channels, sizes.bev_cells).bfloat16()
    grid = cases.ray_grid(sizes, seed=1)
    samples, channels = grid.shape[1], sizes.bev_channels
    map_bytes, grid_bytes, out_bytes = bev.nbytes, grid.nbytes, 2 * samples * channels
    forward = map_bytes + grid_bytes + out_bytes
    backward = forward + out_bytes + 2 * (map_bytes + grid_bytes)
    return [
        Case(
            op="sample_bev",
            name=f"sample_bev {samples} samples along rays, {channels} ch, {sizes.bev_cells}^2, bfloat16 map",
            unit="samples",
            items=samples,
            inputs=(bev, grid),
            ours=lambda bev, grid: (ops.sample_bev(bev, grid),),
            reference=lambda bev, grid: (reference.sample_bev(bev, grid),),
            eager={
                "widened": Variant(lambda bev, grid: (_grid_sample(bev.float(), grid).to(bev.dtype),)),
            },
            compiled=("widened",),
            derivative_in=(0, 1),
            tolerance=1e-2,  # one rounding to bfloat16
            phases=(
                Phase(FORWARD, "2 CHW + 8N + 2 NC", forward),
                Phase(BACKWARD, "6 CHW + 24N + 4 NC", backward),
            ),
        )
    ]


def _sample_volume_cases(sizes: Sizes) -> list[Case]:
    volume, grid = _volume_inputs(sizes)
    samples, channels = grid.shape[1], volume.shape[1]
    map_bytes, grid_bytes, out_bytes = volume.nbytes, grid.nbytes, 4 * samples * channels
    forward = map_bytes + grid_bytes + out_bytes
    backward = forward + out_bytes + 2 * (map_bytes + grid_bytes)
    second = forward + (out_bytes + map_bytes + 2 * grid_bytes) + (3 * out_bytes + 2 * map_bytes + 3 * grid_bytes)
    return [
        Case(
            op="sample_volume",
            name=f"sample_volume {samples} samples along rays, {_volume_text(volume)}",
            unit="samples",
            items=samples,
            inputs=(volume, grid),
            ours=lambda volume, grid: (ops.sample_volume(volume, grid),),
            reference=lambda volume, grid: (reference.sample_volume(volume, grid),),
            eager=_formats(lambda volume, grid: (_grid_sample(volume, grid),), volume, grid),
            compiled=("channels_last",),
            derivative_in=(0, 1),
            tolerance=1e-4,
            phases=(
                Phase(FORWARD, "4 (CDHW + 3N + NC)", forward),
                Phase(BACKWARD, "4 (3 CDHW + 9N + 2 NC)", backward),
                Phase(SECOND, "4 (4 CDHW + 18N + 5 NC)", second),
            ),
        )
    ]


def _with_grad_case(op: str, text: str, map_: Tensor, grid: Tensor) -> Case:
    """Values and slopes of the mean over the channels, as a signed distance would be formed, both used by the loss.

    Plain PyTorch gets slopes of one scalar field for the price of one derivative; those of every channel, which ours
    returns, would cost it one pass per channel.
    """
    samples, channels, axes = grid.shape[1], map_.shape[1], grid.shape[2]
    outs = 4 * samples * channels * (1 + axes)
    forward = map_.nbytes + grid.nbytes + outs
    ours, oracle = getattr(ops, op), getattr(reference, op)
    letters = "CHW" if axes == 2 else "CDHW"

    def field(sample: Callable[[Tensor, Tensor], SampledWithGrad]) -> Function:
        def run(map_: Tensor, grid: Tensor) -> tuple[Tensor, ...]:
            values, grads = sample(map_, grid)
            return values, grads.mean(dim=-1)

        return run

    def eager(map_: Tensor, grid: Tensor) -> tuple[Tensor, ...]:
        differentiable = torch.is_grad_enabled()
        with torch.enable_grad():
            position = grid if grid.requires_grad else grid.detach().requires_grad_()
            values = _grid_sample(map_, position)
            (slopes,) = torch.autograd.grad(values.mean(dim=-1).sum(), position, create_graph=differentiable)
        return values, slopes

    return Case(
        op=op,
        name=f"{op} {text}",
        unit="samples",
        items=samples,
        inputs=(map_, grid),
        ours=field(ours),
        reference=field(oracle),
        eager=_formats(eager, map_, grid),
        compiled=("channels_last",),
        derivative_in=(0, 1),
        derivative_of=(0, 1),
        tolerance=1e-4,
        phases=(
            Phase(FORWARD, f"4 ({letters} + {axes}N + {1 + axes} NC)", forward),
            Phase(
                BACKWARD,
                f"4 (3 {letters} + {3 * axes}N + {2 * (1 + axes)} NC)",
                forward + outs + 2 * (map_.nbytes + grid.nbytes),
            ),
        ),
    )


def _bev_with_grad_cases(sizes: Sizes) -> list[Case]:
    bev, grid = cases.bev_map(sizes.bev_channels, sizes.bev_cells), cases.ray_grid(sizes, seed=1)
    text = f"{grid.shape[1]} samples along rays, {sizes.bev_channels} ch, {sizes.bev_cells}^2"
    return [_with_grad_case("sample_bev_with_grad", text, bev, grid)]


def _volume_with_grad_cases(sizes: Sizes) -> list[Case]:
    volume, grid = _volume_inputs(sizes)
    text = f"{grid.shape[1]} samples along rays, {_volume_text(volume)}"
    return [_with_grad_case("sample_volume_with_grad", text, volume, grid)]


def _volume_text(volume: Tensor) -> str:
    return f"{volume.shape[1]} ch, " + "x".join(str(size) for size in volume.shape[2:])


def _formats(function: Function, map_: Tensor, grid: Tensor) -> dict[str, Variant]:
    """Plain PyTorch on both memory formats of the map."""
    return {"channels_last": Variant(function), "channels_first": Variant(function, (map_.contiguous(), grid))}


@functools.cache
def grid_sample_is_twice_differentiable() -> bool:
    """Not before torch 2.13."""
    map_ = torch.zeros(1, 1, 2, 2)
    grid = torch.zeros(1, 1, 1, 2, requires_grad=True)
    try:
        (slope,) = torch.autograd.grad(F.grid_sample(map_, grid, align_corners=False).sum(), grid, create_graph=True)
        torch.autograd.grad(slope.sum(), grid)
    except RuntimeError:
        return False
    return True


def plain_gather(bev: Tensor, grid: Tensor, twice: bool) -> Tensor:  # [B, N, C]
    """`F.grid_sample`; four plain gathers where it must be differentiated twice and torch cannot."""
    if twice and not grid_sample_is_twice_differentiable():
        return reference.sample_bev(bev, grid)
    return _grid_sample(bev, grid)


def _eager_sample_bev(bev: Tensor, grid: Tensor) -> tuple[Tensor, ...]:
    return (_grid_sample(bev, grid),)


def _grid_sample(map_: Tensor, grid: Tensor) -> Tensor:  # [B, N, C]
    view = grid[:, None] if map_.dim() == 4 else grid[:, None, None]
    return F.grid_sample(map_, view, align_corners=False).flatten(2).transpose(1, 2)


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "sample_bev": lambda sizes: _sample_bev_cases(sizes) + _half_cases(sizes),
    "sample_bev_with_grad": _bev_with_grad_cases,
    "sample_volume": _sample_volume_cases,
    "sample_volume_with_grad": _volume_with_grad_cases,
}
