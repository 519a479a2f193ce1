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
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchmarks import cases, ops_points, ops_rays, ops_sampling
from benchmarks.case import BACKWARD, FORWARD, SECOND, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.measure import time_interleaved
from benchmarks.report import Row
from pred._native import native_status

CASES = ops_sampling.CASES | ops_rays.CASES | ops_points.CASES


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
