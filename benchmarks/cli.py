# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What ``python -m benchmarks`` does, once the allocator is set up."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from benchmarks.bench_ops import expected_results, make_cases, run_phase
from benchmarks.bench_step import STEP, run_step
from benchmarks.capture import CaptureError, capture_steps, captured_cases
from benchmarks.case import Case
from benchmarks.cases import SIZES
from benchmarks.compare import relative
from benchmarks.measure import measure_ceilings
from benchmarks.options import parse
from benchmarks.phases import phases_of
from benchmarks.picture import PictureError, draw
from benchmarks.progress import Progress
from benchmarks.record import Report
from benchmarks.trace import write_trace
from pred._native import native_status

STEP_UNITS = 64  # the rendering step takes about as long as so many phases of ops


def main() -> None:
    """Runs the command line."""
    options = parse(sys.argv[1:])
    os.environ["PRED_BACKEND"] = "native" if native_status()["available"] else "reference"
    try:
        if options.trace:
            step = SIZES[options.sizes] if STEP in options.ops and not options.replay else None
            kinds, threads = chosen_kinds(options), max(options.threads)
            write_trace(options.trace, chosen_cases(options), step, threads, kinds, options.device)
            print(f"written: {options.trace}; open it in chrome://tracing or ui.perfetto.dev")
        elif options.capture:
            print(capture_steps(options.capture, options.capture_from, SIZES[options.sizes]))
        else:
            sys.exit(finish(run(options), options))
    except CaptureError as error:
        sys.exit(str(error))


def run(options: argparse.Namespace) -> Report:
    """Times everything asked for. The file grows case by case, so that an interrupted run leaves its part."""
    report = Report(options)
    cases = chosen_cases(options)
    kinds = chosen_kinds(options)
    with_step = STEP in options.ops and not options.replay
    plain_kinds = [kind for kind in options.contenders if kind in ("ours", "eager")]
    with_default = bool(cases and plain_kinds) and options.device.type == "cpu"
    with_default = with_default and not (options.default_allocator or options.quick or options.replay)
    phases = sum(len(phases_of(case)) for case in cases) * len(options.threads)
    progress = Progress(2 * len(options.threads) + phases + STEP_UNITS * with_step + phases // 2 * with_default)

    _add_ceilings(report, options, progress)
    for case in cases:
        for phase in phases_of(case):
            torch.set_num_threads(max(options.threads))
            expected = expected_results(case, phase)
            for threads in options.threads:
                report.rows += run_phase(
                    case, phase, expected, threads, kinds, options.min_time, options.rounds, progress.show
                )
                progress.advance()
        report.write()
    if with_step:
        done = progress.done

        def on_step(what: str) -> None:
            progress.show(what)
            progress.advance(STEP_UNITS // 16)  # eight contenders, their timing, memory of seven

        report.rows += run_step(
            options.sizes, max(options.threads), options.contenders, options.min_time, on_step, options.device
        )
        progress.done = done + STEP_UNITS
        report.write()
    if with_default:
        progress.show("the same with the default allocator")
        report.default_allocator = _run_with_default_allocator(options, plain_kinds)
        progress.advance(phases // 2)
    _add_ceilings(report, options, progress)
    return report


def chosen_cases(options: argparse.Namespace) -> list[Case]:
    """Of the ops asked for; those of a capture where there is one."""
    ops = [op for op in options.ops if op != STEP]
    if options.replay:
        return [case.to(options.device) for case in captured_cases(options.replay, ops)]
    return [case for op in ops for case in make_cases(op, SIZES[options.sizes], options.device)]


def chosen_kinds(options: argparse.Namespace) -> list[str]:
    """Who takes part; a capture has no plain PyTorch but the references."""
    return ["ours", "reference"] if options.replay else options.contenders


def finish(report: Report, options: argparse.Namespace) -> int | str:
    """Writes and prints what was found; returns what to exit with."""
    content = report.write(complete=True)
    if not options.quiet:
        written = [report.out, report.write_markdown()]
        report.show()
        try:
            written.append(draw(content, report.out.with_suffix(".png")))
        except PictureError as error:
            print(f"\nno picture: {error}")
        print(f"\nwritten: {', '.join(map(str, written))}")
    if any(row.status.startswith("wrong") and row.kind != "peer" for row in report.rows):
        return "some contender differs from the reference: see the rows marked 'wrong'"
    if report.earlier and options.fail_below is not None:
        slower = [change for change in report.earlier["changes"] if change["verdict"] == "slower"]
        worst = min(map(relative, slower), default=1.0)
        if worst < options.fail_below:
            return f"--fail-below {options.fail_below:g}: the worst change since {options.compare} is {worst:.2f}x"
    return 0


def _add_ceilings(report: Report, options: argparse.Namespace, progress: Progress) -> None:
    """Measured before and after all else; the better counts."""
    for threads in options.threads:
        progress.show(f"ceilings with {threads} threads")
        found = measure_ceilings(threads, options.min_time, options.device, options.sizes == "tiny")
        report.ceilings[threads] = found.better(report.ceilings.get(threads, found))
        progress.advance()


def _run_with_default_allocator(options: argparse.Namespace, kinds: list[str]) -> dict[str, Any]:
    """Ours and eager in a process of their own: rows and comparisons of a short run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.json"
        command = [sys.executable, "-m", "benchmarks", "--default-allocator", "--quick", "--quiet", "--out", str(out)]
        command += ["--ops", ",".join(op for op in options.ops if op != STEP), "--sizes", options.sizes]
        command += ["--threads", ",".join(map(str, options.threads)), "--contenders", ",".join(kinds)]
        command += ["--min-time", str(options.min_time)]
        done = subprocess.run(command)
        if not out.is_file():
            raise RuntimeError(f"benchmarks: the run with the default allocator ended with {done.returncode}")
        result = json.loads(out.read_text())
    return {name: result[name] for name in ("allocator", "environment", "min_time_s", "rounds", "rows", "comparisons")}
