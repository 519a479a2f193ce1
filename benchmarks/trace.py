# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A Chrome trace (chrome://tracing, ui.perfetto.dev) of one call of each contender, every call in a named range.

Compiled ops show as ``pred::<op>`` inside their range, as the dispatcher calls them.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile, record_function

from benchmarks.bench_ops import check_phase, expected_results
from benchmarks.bench_step import CONTENDERS, contender
from benchmarks.case import Case, Phase
from benchmarks.cases import Sizes
from benchmarks.measure import CPU
from benchmarks.phases import phases_of


def write_trace(
    path: Path,
    cases: Sequence[Case],
    step: Sizes | None,
    threads: int,
    kinds: Sequence[str],
    device: torch.device = CPU,
) -> None:
    """Calls each contender once outside the trace, then once inside.

    Args:
        path: JSON file to write.
        cases: of ops.
        step: sizes of the rendering step; None: without it.
        threads: torch's threads.
        kinds: which of `KINDS` take part.
        device: of the rendering step; the cases have theirs.
    """
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # it tells of each start and stop on standard error
    torch.set_num_threads(threads)
    trace: dict[str, Any] = {"traceEvents": []}
    for case in cases:
        for phase in phases_of(case):
            _, runs = check_phase(case, phase, expected_results(case, phase), threads, kinds, lambda what: None)
            _add(trace, {range_name(case, phase, name): run.ready() for name, run in runs.items()}, device)
    if step is not None:
        steps = {f"pred::step, {name}": contender(name, step, device) for name in CONTENDERS if name in kinds}
        for run in steps.values():
            run()
        _add(trace, steps, device)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(trace))


def range_name(case: Case, phase: Phase, contender: str) -> str:
    """Name of a call's range."""
    return f"pred::{case.name}, {phase.name}, {contender}"


def _add(trace: dict[str, Any], runs: Mapping[str, Callable[[], object]], device: torch.device) -> None:
    """A profile of its own, so that checks and compilation stay out; all share one clock."""
    activities = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if device.type == "cuda" else [])
    with profile(activities=activities, record_shapes=True) as profiler:
        for name, run in runs.items():
            with record_function(name):
                run()
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(part))
        found = json.loads(part.read_text())
    trace["traceEvents"] += found.pop("traceEvents")
    trace.update(found)
