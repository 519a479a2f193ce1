# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The ops: ours against good plain PyTorch, eager and compiled.

Three phases are timed: ``forward`` without autograd; ``forward+backward``; ``second order``, which is forward, the
first derivative in the grid as a differentiable result, and the backward pass through both, as an Eikonal term needs.

Each phase states the least traffic it could have: every input read once and every output written once per pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases
from benchmarks.cases import Sizes
from benchmarks.measure import time_interleaved
from benchmarks.report import Row, Target
from pred import ops
from pred._native import native_status
from pred.ops import reference

FORWARD, BACKWARD, SECOND = "forward", "forward+backward", "second order"
KINDS = ("ours", "eager", "compiled")

Function = Callable[..., tuple[Tensor, ...]]


@dataclass(frozen=True)
class Phase:
    """A part of an op's work, its least traffic and its targets."""

    name: str
    traffic: str
    """Formula of the bytes, in the letters of `pred.ops`."""
    traffic_bytes: int
    targets: tuple[Target, ...] = ()


@dataclass(frozen=True)
class Variant:
    """One way to compute a case."""

    function: Function
    inputs: tuple[Tensor, ...] | None = None
    """Inputs in this variant's best memory format; None: the case's own."""


@dataclass(frozen=True)
class Case:
    """One op on one input."""

    op: str
    name: str
    unit: str
    items: int
    """Number of `unit`s in one call."""
    inputs: tuple[Tensor, ...]
    ours: Function
    reference: Function
    eager: dict[str, Variant]
    """Plain PyTorch, by name; the fastest counts."""
    compiled: tuple[str, ...]
    """Which of them are compiled."""
    phases: tuple[Phase, ...]
    derivative_in: tuple[int, ...] = ()
    """Positions of the inputs that take gradients."""
    derivative_of: tuple[int, ...] = (0,)
    """Positions of the outputs that a loss would use."""
    tolerance: float = 1e-5
    """Of every result, relative to its largest magnitude; 0: equal."""
    outliers: float = 0.0
    """Share of elements that may miss the tolerance, with the reason beside it."""


def make_cases(op: str, sizes: Sizes) -> list[Case]:
    """The cases of an op; targets belong to the real sizes."""
    found = CASES[op](sizes)
    if sizes == cases.REAL:
        return found
    return [replace(case, phases=tuple(replace(phase, targets=()) for phase in case.phases)) for case in found]


def expected_results(case: Case, phase: Phase) -> list[Tensor]:
    """What the reference gives: outputs, then gradients."""
    return _prepare(case, phase, Variant(case.reference))()


def run_phase(
    case: Case,
    phase: Phase,
    expected: list[Tensor],
    threads: int,
    kinds: Sequence[str],
    min_time_s: float,
    rounds: int,
    on_step: Callable[[str], None],
) -> list[Row]:
    """Checks every contender of a phase against the reference, then times those that are right, interleaved.

    Args:
        case, phase: what to run.
        expected: from `expected_results`.
        threads: torch's threads, for compiling too (compiled code keeps their number).
        kinds: which of `KINDS` take part.
        min_time_s, rounds: see `time_interleaved`.
        on_step: told what happens next, once per contender and once before timing.
    """
    torch.set_num_threads(threads)
    if "compiled" in kinds:
        torch._dynamo.reset()  # or a second shape of the same function would be compiled for dynamic shapes
    label = f"{case.name}, {phase.name}, {threads} threads"
    rows: dict[str, Row] = {}
    runs: dict[str, Callable[[], list[Tensor]]] = {}
    for kind, name, variant in _contenders(case, kinds):
        on_step(f"{label}: {name}")
        row = rows[name] = Row(
            op=case.op,
            case=case.name,
            phase=phase.name,
            threads=threads,
            contender=name,
            kind=kind,
            unit=case.unit,
            items=case.items,
            traffic=phase.traffic,
            traffic_bytes=phase.traffic_bytes,
            targets=phase.targets,
        )
        if kind == "ours" and (reason := missing_kernel(case.op)):
            row.status = f"missing: {reason}"
            continue
        try:
            run = (_prepare_compiled if kind == "compiled" else _prepare)(case, phase, variant)
            actual = run()
        except Exception as error:  # a compiler may refuse in any way; the run goes on
            row.status = f"refused: {first_line(error)}"
            continue
        row.error, wrong = _compare(actual, expected, case)
        if wrong:
            row.status = f"wrong: {wrong}"
        else:
            runs[name] = run
    on_step(f"{label}: timing")
    for name, timing in time_interleaved(runs, threads, min_time_s, rounds).items():
        rows[name].timing = timing
    return list(rows.values())


def _contenders(case: Case, kinds: Sequence[str]) -> list[tuple[str, str, Variant]]:
    """Kind, name and variant."""
    found: list[tuple[str, str, Variant]] = []
    if "ours" in kinds:
        found.append(("ours", "ours", Variant(case.ours)))
    if "eager" in kinds:
        found += [("eager", f"eager {name}", variant) for name, variant in case.eager.items()]
    if "compiled" in kinds:
        found += [("compiled", f"compiled {name}", case.eager[name]) for name in case.compiled]
    return found


def compiled(function: Callable[..., Any]) -> Any:
    """``torch.compile`` for fixed shapes; from torch 2.13 on, `function` may call ``autograd.grad``."""
    if hasattr(torch._dynamo.config, "trace_autograd_ops"):
        torch._dynamo.config.trace_autograd_ops = True
    return torch.compile(function, dynamic=False)


def _prepare_compiled(case: Case, phase: Phase, variant: Variant) -> Callable[[], list[Tensor]]:
    """As `_prepare`; what is differentiated twice can only be compiled as a whole."""
    if phase.name == SECOND:
        run: Callable[[], list[Tensor]] = compiled(_prepare(case, phase, variant))
        return run
    return _prepare(case, phase, Variant(compiled(variant.function), variant.inputs))


def _prepare(case: Case, phase: Phase, variant: Variant) -> Callable[[], list[Tensor]]:
    """One call of a phase, on the variant's own leaves and incoming gradients; returns all results."""
    function = variant.function
    inputs = [
        tensor.detach().requires_grad_(position in case.derivative_in and phase.name != FORWARD)
        for position, tensor in enumerate(case.inputs if variant.inputs is None else variant.inputs)
    ]
    if phase.name == FORWARD:

        def forward() -> list[Tensor]:
            with torch.no_grad():
                return list(function(*inputs))

        return forward

    leaves = [inputs[position] for position in case.derivative_in]
    probe = function(*inputs)
    grads = [_incoming(probe[position], seed) for seed, position in enumerate(case.derivative_of)]
    if phase.name == BACKWARD:

        def backward() -> list[Tensor]:
            outputs = function(*inputs)
            used = [outputs[position] for position in case.derivative_of]
            return [*(out.detach() for out in outputs), *torch.autograd.grad(used, leaves, grads)]

        return backward

    # sample_bev only: output 0, map and grid
    grid = inputs[1]
    cotangent = _incoming(probe[0], len(grads)).requires_grad_()
    grad_grad = _incoming(grid, len(grads) + 1)

    def second() -> list[Tensor]:
        (out,) = function(*inputs)
        (slope,) = torch.autograd.grad(out, grid, cotangent, create_graph=True)
        results = torch.autograd.grad([out, slope], [*leaves, cotangent], [grads[0], grad_grad])
        return [out.detach(), slope.detach(), *results]

    return second


def _incoming(like: Tensor, seed: int) -> Tensor:
    """The same random gradient for every contender, in the memory layout of its own output."""
    values = torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=like.dtype)
    return torch.empty_like(like).copy_(values)


def _compare(actual: list[Tensor], expected: list[Tensor], case: Case) -> tuple[float, str]:
    """Largest relative error, and what is wrong (nothing: empty)."""
    worst, wrong = 0.0, ""
    for number, (have, want) in enumerate(zip(actual, expected, strict=True)):
        if have.shape != want.shape:
            return math.inf, f"result {number} has shape {list(have.shape)}, not {list(want.shape)}"
        if want.numel() == 0:
            continue
        if not torch.equal(have.isnan(), want.isnan()):
            return math.inf, f"result {number} is NaN in other places"
        difference = (have - want).abs().double() / want.abs().max().double().clamp_min(1e-30)
        worst = max(worst, float(difference.max()))
        missed = float((~(difference <= case.tolerance)).double().mean())
        if missed > case.outliers:
            wrong = wrong or f"result {number} differs by {float(difference.max()):.2g}"
    return worst, wrong


def missing_kernel(op: str) -> str | None:
    """Why an op has no compiled kernel; None where it has one."""
    reason: str | None = native_status()["reason"]
    if reason is None and not hasattr(torch.ops.pred, op):
        return f"the compiled library has no {op}"
    return reason


def first_line(error: Exception) -> str:
    """Of an error, short enough for a table."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else ''}"[:200]


# --- sample_bev ---------------------------------------------------------------------------------------


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


# --- rays ---------------------------------------------------------------------------------------------


def _sdf_to_alpha_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, _, _ = cases.ray_samples(sizes)
    rays, samples = sdf.shape
    return [
        Case(
            op="sdf_to_alpha",
            name=f"sdf_to_alpha {rays}x{samples}",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s),
            ours=lambda sdf, inv_s: (ops.sdf_to_alpha(sdf, inv_s),),
            reference=lambda sdf, inv_s: (reference.sdf_to_alpha(sdf, inv_s),),
            eager={"closed form": Variant(lambda sdf, inv_s: (F.pad(_eager_alpha(sdf, inv_s), (0, 1)),))},
            compiled=("closed form",),
            derivative_in=(0,),
            phases=(
                Phase(FORWARD, "4 (2 RS)", 2 * sdf.nbytes),
                Phase(BACKWARD, "4 (5 RS)", 5 * sdf.nbytes),
            ),
        )
    ]


def _composite_rays_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, t, values = cases.ray_samples(sizes)
    rays, samples = sdf.shape
    plane, block = sdf.nbytes, values.nbytes
    variants = {"cumprod": Variant(_eager_composite_cumprod), "cumsum": Variant(_eager_composite_cumsum)}

    def ours(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor for tensor in ops.composite_rays(*inputs) if tensor is not None)

    def plain(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor for tensor in reference.composite_rays(*inputs) if tensor is not None)

    return [
        Case(
            op="composite_rays",
            name=f"composite_rays {rays}x{samples}, depth only",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            derivative_in=(0,),
            derivative_of=(1,),
            phases=(
                Phase(FORWARD, "4 (3 RS)", 3 * plane),
                Phase(BACKWARD, "4 (6 RS)", 6 * plane, (Target("eager", 10),)),
            ),
        ),
        Case(
            op="composite_rays",
            name=f"composite_rays {rays}x{samples}, depth and {sizes.classes} classes",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t, values),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            derivative_in=(0, 3),
            derivative_of=(1, 3),
            phases=(
                Phase(FORWARD, "4 (3 RS + RSC)", 3 * plane + block),
                Phase(
                    BACKWARD,
                    "4 (6 RS + 3 RSC)",
                    6 * plane + 3 * block,
                    (Target("eager", 3), Target("compiled", 2), Target("copy bandwidth", 0.7)),
                ),
            ),
        ),
    ]


def _eager_alpha(sdf: Tensor, inv_s: Tensor) -> Tensor:  # [R, S - 1]
    here, after = sdf[:, :-1], sdf[:, 1:]
    return torch.sigmoid(-inv_s * after) * -torch.expm1(-inv_s * F.relu(here - after))


def _eager_composite_cumprod(sdf: Tensor, inv_s: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    alpha = _eager_alpha(sdf, inv_s)
    clear = torch.cumprod(1 - alpha[:, :-1], dim=1)
    return _eager_sums(torch.cat([alpha[:, :1], alpha[:, 1:] * clear], dim=1), t, values)


def _eager_composite_cumsum(sdf: Tensor, inv_s: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    alpha = _eager_alpha(sdf, inv_s)
    clear = torch.exp(torch.cumsum(torch.log1p(-alpha[:, :-1]), dim=1))
    return _eager_sums(torch.cat([alpha[:, :1], alpha[:, 1:] * clear], dim=1), t, values)


def _eager_sums(weights: Tensor, t: Tensor, values: Tensor | None) -> tuple[Tensor, ...]:
    weights = F.pad(weights, (0, 1))
    sums = weights, (weights * t).sum(dim=1), weights.sum(dim=1)
    return sums if values is None else (*sums, torch.bmm(weights[:, None], values)[:, 0])


def _resample_rays_cases(sizes: Sizes) -> list[Case]:
    t, weights = cases.coarse_rays(sizes)
    rays, samples, added = *t.shape, sizes.fine_samples
    return [
        Case(
            op="resample_rays",
            name=f"resample_rays {rays}x{samples} + {added}",
            unit="rays",
            items=rays,
            inputs=(t, weights),
            ours=lambda t, weights: (ops.resample_rays(t, weights, added),),
            reference=lambda t, weights: (reference.resample_rays(t, weights, added),),
            eager={"searchsorted + sort": Variant(lambda t, weights: (_eager_resample(t, weights, added),))},
            compiled=("searchsorted + sort",),
            # Where the distribution is flat, a sample jumps across the gap if the sum is rounded differently.
            outliers=1e-4,
            phases=(
                Phase(
                    FORWARD,
                    "4 R (3 S + n)",
                    t.nbytes + weights.nbytes + 4 * rays * (samples + added),
                    (Target("eager", 30),),
                ),
            ),
        )
    ]


def _eager_resample(t: Tensor, weights: Tensor, added: int) -> Tensor:
    mass = weights[:, :-1]
    total = mass.sum(dim=1, keepdim=True)
    mass = torch.where(total > 0, mass, t[:, 1:] - t[:, :-1])
    cdf = F.pad(mass.cumsum(dim=1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    u = ((torch.arange(added, dtype=t.dtype) + 0.5) / added).expand(t.shape[0], -1).contiguous()
    after = torch.searchsorted(cdf, u, right=True).clamp_max(t.shape[1] - 1)
    before = after - 1
    low, high = cdf.gather(1, before), cdf.gather(1, after)
    start, end = t.gather(1, before), t.gather(1, after)
    samples = torch.lerp(start, end, (u - low) / (high - low))
    return torch.cat([t, samples], dim=1).sort(dim=1).values


# --- points -------------------------------------------------------------------------------------------


def _voxelize_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)
    offsets = torch.tensor([0, sizes.points])
    size = (sizes.voxel_m,) * 3
    voxels = reference.voxelize(points, offsets, size, cases.POINT_RANGE_M)
    return [
        Case(
            op="voxelize",
            name=f"voxelize {sizes.points} points, {sizes.voxel_m} m",
            unit="points",
            items=sizes.points,
            inputs=(points, offsets),
            ours=lambda points, offsets: ops.voxelize(points, offsets, size, cases.POINT_RANGE_M),
            reference=lambda points, offsets: reference.voxelize(points, offsets, size, cases.POINT_RANGE_M),
            eager={
                "unique": Variant(lambda points, offsets: _eager_voxelize(points, offsets, size, _unique)),
                "sort": Variant(lambda points, offsets: _eager_voxelize(points, offsets, size, _sorted_unique)),
            },
            compiled=("unique",),
            tolerance=0.0,
            phases=(
                Phase(
                    FORWARD,
                    "4 N D + 8 N + 40 M",
                    points.nbytes + 8 * sizes.points + 40 * len(voxels.counts),
                    (Target("eager", 5),),
                ),
            ),
        )
    ]


def _eager_voxelize(
    points: Tensor, offsets: Tensor, size: tuple[float, ...], unique: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
) -> tuple[Tensor, ...]:
    low, high = (points.new_tensor(bound) for bound in (cases.POINT_RANGE_M[:3], cases.POINT_RANGE_M[3:]))
    nx, ny, nz = (
        round((above - below) / edge)
        for below, above, edge in zip(cases.POINT_RANGE_M[:3], cases.POINT_RANGE_M[3:], size, strict=True)
    )
    xyz = points[:, :3]
    x, y, z = ((xyz - low) / points.new_tensor(size)).long().unbind(dim=1)
    frame = torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff(), output_size=len(points))
    key = ((frame * nz + z) * ny + y) * nx + x
    inside = ((xyz >= low) & (xyz < high)).all(dim=1)
    keys, voxel, counts = unique(key[inside])
    point_to_voxel = torch.full_like(key, -1)
    point_to_voxel[inside] = voxel
    coords = torch.stack([keys // (nx * ny * nz), keys // (nx * ny) % nz, keys // nx % ny, keys % nx], dim=1)
    return coords, point_to_voxel, counts


def _unique(key: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    keys, inverse, counts = torch.unique(key, return_inverse=True, return_counts=True)
    return keys, inverse, counts


def _sorted_unique(key: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    ordered, order = key.sort()
    keys, inverse, counts = torch.unique_consecutive(ordered, return_inverse=True, return_counts=True)
    return keys, torch.empty_like(inverse).scatter_(0, order, inverse), counts


def _segment_reduce_cases(sizes: Sizes) -> list[Case]:
    points = cases.lidar_points(sizes.points)
    height_m = cases.POINT_RANGE_M[5] - cases.POINT_RANGE_M[2]
    pillars = reference.voxelize(
        points, torch.tensor([0, sizes.points]), (sizes.pillar_m, sizes.pillar_m, height_m), cases.POINT_RANGE_M
    )
    index, segments = pillars.point_to_voxel, len(pillars.counts)
    features = torch.randn(sizes.points, sizes.features, generator=torch.Generator().manual_seed(0))
    rows, out = features.nbytes, 4 * segments * sizes.features
    return [
        Case(
            op="segment_reduce",
            name=f"segment_reduce {reduce} {sizes.points}x{sizes.features} to {segments}",
            unit="points",
            items=sizes.points,
            inputs=(features, index),
            ours=lambda features, index, reduce=reduce: (ops.segment_reduce(features, index, segments, reduce),),
            reference=lambda features, index, reduce=reduce: (
                reference.segment_reduce(features, index, segments, reduce),
            ),
            eager={
                name: Variant(lambda *inputs, function=function, reduce=reduce: (function(*inputs, segments, reduce),))
                for name, function in _EAGER_SEGMENTS.items()
                if not (reduce == "max" and name == "index_add")
            },
            compiled=("scatter_reduce",),
            derivative_in=(0,),
            phases=(
                Phase(FORWARD, "4 NC + 8 N + 4 MC", rows + index.nbytes + out),
                Phase(BACKWARD, "8 NC + 16 N + 8 MC", 2 * (rows + index.nbytes + out)),
            ),
        )
        for reduce in ("mean", "max", "sum")
    ]


def _eager_index_add(features: Tensor, index: Tensor, segments: int, reduce: str) -> Tensor:
    total = features.new_zeros(segments, features.shape[1]).index_add(0, index, features)
    return total / torch.bincount(index, minlength=segments).clamp_min(1)[:, None] if reduce == "mean" else total


def _eager_scatter_reduce(features: Tensor, index: Tensor, segments: int, reduce: str) -> Tensor:
    empty = features.new_zeros(segments, features.shape[1])
    name = {"max": "amax"}.get(reduce, reduce)
    return empty.scatter_reduce(0, index[:, None].expand_as(features), features, name, include_self=False)


_EAGER_SEGMENTS = {"scatter_reduce": _eager_scatter_reduce, "index_add": _eager_index_add}

CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "sample_bev": _sample_bev_cases,
    "sdf_to_alpha": _sdf_to_alpha_cases,
    "composite_rays": _composite_rays_cases,
    "resample_rays": _resample_rays_cases,
    "voxelize": _voxelize_cases,
    "segment_reduce": _segment_reduce_cases,
}
