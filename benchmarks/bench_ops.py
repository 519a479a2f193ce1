# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The ops: ours against good plain PyTorch, eager and compiled, and against peers.

Each phase states the least traffic it could have: every input read once and every output written once per pass.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks import cases, models, ops_boxes, ops_field, ops_points, ops_rays, ops_sampling, ops_sparse
from benchmarks.case import BACKWARD, FORWARD, SECOND_ALONE, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.measure import CPU, Run, missing_kernel, time_interleaved
from benchmarks.memory import added_peak_bytes
from benchmarks.phases import prepare, prepare_compiled
from benchmarks.report import NOT_INSTALLED, Row, Target

FAMILIES = {
    "sampling": ops_sampling.CASES,
    "field": ops_field.CASES,
    "rays": ops_rays.CASES,
    "points": ops_points.CASES,
    "models": models.CASES,
    "sparse": ops_sparse.CASES,
    "boxes": ops_boxes.CASES,
}
CASES = {op: make for family in FAMILIES.values() for op, make in family.items()}


BOUND_BY_MEMORY = ("sample_bev", "sample_volume", "composite_rays", "composite_alpha")
"""Ops that should come near the copy bandwidth of a GPU."""


def make_cases(op: str, sizes: Sizes, device: torch.device = CPU) -> list[Case]:
    """The cases of an op on a device; targets belong to the real sizes on the CPU, those of the paper on a GPU."""
    return [
        replace(case, phases=tuple(replace(phase, targets=targets(op, phase, sizes, device)) for phase in case.phases))
        for case in (case.to(device) for case in CASES[op](sizes))
    ]


def targets(op: str, phase: Phase, sizes: Sizes, device: torch.device) -> tuple[Target, ...]:
    """What a phase should reach with these sizes on a device."""
    if device.type == "cpu":
        return phase.targets if sizes == cases.REAL else ()
    near_copy = sizes == cases.PAPER and op in BOUND_BY_MEMORY and phase.name in (FORWARD, BACKWARD)
    return (Target("copy bandwidth", 0.7),) if near_copy else ()


def expected_results(case: Case, phase: Phase) -> list[Tensor]:
    """What the reference gives: outputs, then gradients."""
    return prepare(case, phase, Variant(case.reference))()


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
    """Checks the contenders of a phase; those that are right are timed, interleaved, and then called twice more to see
    what memory they take: the lower peak counts, as malloc may find its free blocks scattered.

    Args:
        case, phase, expected, threads, kinds: see `check_phase`.
        min_time_s, rounds: see `time_interleaved`.
        on_step: told what happens next, once per contender and once before timing.
    """
    rows, runs = check_phase(case, phase, expected, threads, kinds, on_step)
    on_step(f"{case.name}, {phase.name}, {threads} threads: timing")
    for name, timing in time_interleaved(runs, threads, min_time_s, rounds, case.device).items():
        rows[name].timing = timing
    for name, run in runs.items():
        peaks = [added_peak_bytes(run.ready(), case.device) for _ in range(2)]
        rows[name].peak_memory_bytes = min((peak for peak in peaks if peak is not None), default=None)
    return list(rows.values())


def check_phase(
    case: Case,
    phase: Phase,
    expected: list[Tensor],
    threads: int,
    kinds: Sequence[str],
    on_step: Callable[[str], None],
) -> tuple[dict[str, Row], dict[str, Run]]:
    """Compares every contender of a phase with the reference.

    Args:
        case, phase: what to run.
        expected: from `expected_results`.
        threads: torch's threads, for compiling too (compiled code keeps their number).
        kinds: which of `KINDS`, and "reference", take part.
        on_step: told what happens next, once per contender.

    Returns:
        A row per contender, without times, and what those that are right run; both by name.
    """
    torch.set_num_threads(threads)
    if "compiled" in kinds:
        torch._dynamo.reset()  # or a second shape of the same function would be compiled for dynamic shapes
    label = f"{case.name}, {phase.name}, {threads} threads"
    rows: dict[str, Row] = {}
    runs: dict[str, Run] = {}
    for kind, name, make_variant in _contenders(case, phase, kinds):
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
            work=phase.work,
            flop=phase.flop,
            flop_dtype=phase.flop_dtype,
            targets=phase.targets,
        )
        if kind == "ours" and case.needs_kernel and (reason := missing_kernel(case.op, case.device)):
            row.status = f"missing: {reason}"
            continue
        try:
            variant = make_variant()
        except ImportError:
            row.status = NOT_INSTALLED
            continue
        except NotImplementedError as error:
            row.status = f"refused: {first_line(error)}"
            continue
        try:
            run = (prepare_compiled if kind == "compiled" else prepare)(case, phase, variant)
            actual = run() if variant.as_ours is None else variant.as_ours(run())
        except Exception as error:  # a compiler or a peer may refuse in any way; the run goes on
            row.status = f"refused: {first_line(error)}"
            continue
        row.error, wrong = _compare(actual, expected, case)
        del actual
        if wrong:
            row.status = f"wrong: {wrong}"
        else:
            runs[name] = run
    return rows, runs


def _contenders(case: Case, phase: Phase, kinds: Sequence[str]) -> list[tuple[str, str, Callable[[], Variant]]]:
    """Kind, name, and what gives the variant."""

    def known(variant: Variant) -> Callable[[], Variant]:
        return lambda: variant

    found: list[tuple[str, str, Callable[[], Variant]]] = []
    if "ours" in kinds:
        found.append(("ours", "ours", known(Variant(case.ours))))
    if "reference" in kinds:
        found.append(("reference", "reference", known(Variant(case.reference))))
    if "eager" in kinds:
        found += [("eager", f"eager {name}", known(variant)) for name, variant in case.eager.items()]
    if "compiled" in kinds and phase.name != SECOND_ALONE:
        found += [("compiled", f"compiled {name}", known(case.eager[name])) for name in case.compiled]
    if "peers" in kinds:
        found += [("peer", name, functools.partial(make, case.device)) for name, make in case.peers.items()]
    return found


def _compare(actual: list[Tensor], expected: list[Tensor], case: Case) -> tuple[float, str]:
    """Largest relative error, and what is wrong (nothing: empty)."""
    worst, wrong = 0.0, ""
    if len(actual) != len(expected):
        return math.inf, f"{len(actual)} results, not {len(expected)}"
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


def first_line(error: Exception) -> str:
    """Of an error, short enough for a table."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else ''}"[:200]
