# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks``: times the ops and the rendering step, prints tables, writes JSON."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.bench_ops import CASES, expected_results, make_cases, run_phase
from benchmarks.bench_step import run_step
from benchmarks.case import KINDS
from benchmarks.cases import SIZES
from benchmarks.measure import (
    COPY_BYTES,
    ROUNDS,
    Ceilings,
    current_allocator,
    enter_allocator,
    machine_record,
    measure_ceilings,
)
from benchmarks.report import SCHEMA, Row, compare, format_ceilings, format_comparisons, format_rows
from pred._native import native_status

OPS = (*CASES, "step")
QUICK = 5
STEP_UNITS = 64  # the rendering step takes about as long as so many phases of ops

EPILOG = """
ours      pred.ops on the compiled kernels, map in channels-last memory
eager     good plain PyTorch; where several ways are timed, ratios are against the fastest
compiled  torch.compile of an eager way; "refused" says why there is none
reference (step) the same model on the PyTorch references of pred.ops

ms is the median of all calls, IQR the distance of the quartiles; contenders take turns, and "rounds" is the range of
the ratio over the turns. GB/s counts the least traffic an op could have (formula in the JSON), "of ceiling" its share
of the copy bandwidth measured in the same run with as many threads. Inputs that fit into the last-level cache can pass
100 %. Everything runs with malloc's thresholds raised (the program restarts itself with MALLOC_MMAP_THRESHOLD_ and
MALLOC_TRIM_THRESHOLD_ set), so that page faults of large fresh outputs do not count; the ratio with the default
allocator, measured in a shorter run, stands beside.
"""


def main() -> None:
    """Runs the command line."""
    options = parse(sys.argv[1:])
    enter_allocator("default" if options.default_allocator else "raised")
    os.environ["PRED_BACKEND"] = "native" if native_status()["available"] else "reference"
    report = run(options)
    if not options.quiet:
        report.show()
        print(f"\nwritten: {report.out}")
    if any(row.status.startswith("wrong") for row in report.rows):
        sys.exit("some contender differs from the reference: see the rows marked 'wrong'")


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options; exits with a message where they are wrong."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--ops", type=_list_of(OPS), default=list(OPS), help=f"some of {','.join(OPS)}")
    parser.add_argument("--sizes", choices=tuple(SIZES), default="real", help="real LiDAR sizes, or tiny ones")
    parser.add_argument(
        "--threads",
        type=_thread_counts,
        default=None,
        help="such as 1,2; default: 1 and all cores; the rendering step is run with the most only",
    )
    parser.add_argument("--contenders", type=_list_of(KINDS), default=list(KINDS), help=f"some of {','.join(KINDS)}")
    parser.add_argument(
        "--min-time", type=float, default=0.6, metavar="S", help="seconds per contender and phase (default 0.6)"
    )
    parser.add_argument("--quick", action="store_true", help="a fifth of the time, three rounds, one allocator")
    parser.add_argument(
        "--out", type=Path, default=None, metavar="JSON", help="the record; default: benchmarks/results/<UTC time>.json"
    )
    parser.add_argument(
        "--default-allocator", action="store_true", help="leave malloc's thresholds as they are, in this run only"
    )
    parser.add_argument("--quiet", action="store_true", help="print no tables")
    options = parser.parse_args(arguments)
    if not options.min_time > 0:
        parser.error(f"--min-time must be above 0, got {options.min_time}")
    options.out = options.out or Path(time.strftime("benchmarks/results/%Y%m%dT%H%M%SZ.json", time.gmtime()))
    options.threads = options.threads or sorted({1, torch.get_num_threads()})
    options.rounds = 3 if options.quick else ROUNDS
    if options.quick:
        options.min_time /= QUICK
    return options


def _list_of(choices: Sequence[str]) -> Any:
    def parse(text: str) -> list[str]:
        names = text.split(",")
        for name in names:
            if name not in choices:
                raise argparse.ArgumentTypeError(f"must name some of {', '.join(choices)}, got {name!r}")
        return names

    return parse


def _thread_counts(text: str) -> list[int]:
    try:
        counts = sorted({int(part) for part in text.split(",")})
    except ValueError:
        counts = [0]
    if counts[0] < 1:
        raise argparse.ArgumentTypeError(f"must be positive numbers such as 1,2, got {text!r}")
    return counts


def run(options: argparse.Namespace) -> Report:
    """Runs everything asked for. The file grows case by case, so that an interrupted run leaves its part."""
    report = Report(options)
    sizes = SIZES[options.sizes]
    cases = [case for op in options.ops if op != "step" for case in make_cases(op, sizes)]
    with_step = "step" in options.ops
    with_default = bool(cases) and not options.default_allocator and not options.quick and bool(_plain_kinds(options))
    phases = sum(len(case.phases) for case in cases) * len(options.threads)
    progress = Progress(2 * len(options.threads) + phases + STEP_UNITS * with_step + phases // 2 * with_default)

    _add_ceilings(report, options, progress)
    for case in cases:
        for phase in case.phases:
            torch.set_num_threads(max(options.threads))
            expected = expected_results(case, phase)
            for threads in options.threads:
                report.rows += run_phase(
                    case,
                    phase,
                    expected,
                    threads,
                    options.contenders,
                    options.min_time,
                    options.rounds,
                    progress.show,
                )
                progress.advance()
        report.write()
    if with_step:
        done = progress.done

        def on_step(what: str) -> None:
            progress.show(what)
            progress.advance(STEP_UNITS // 8)  # four contenders, their timing, memory of three

        report.rows += run_step(options.sizes, max(options.threads), options.contenders, options.min_time, on_step)
        progress.done = done + STEP_UNITS
        report.write()
    if with_default:
        progress.show("the same with the default allocator")
        report.default_allocator = _run_with_default_allocator(options)
        progress.advance(phases // 2)
    _add_ceilings(report, options, progress)
    report.write(complete=True)
    return report


class Report:
    """What is known so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.rows: list[Row] = []
        self.ceilings: dict[int, Ceilings] = {}
        self.default_allocator: dict[str, Any] | None = None
        self.out: Path = options.out
        self._start_time = time.monotonic()
        self._head: dict[str, Any] = {
            "command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "allocator": current_allocator(),
            "sizes": options.sizes,
            "threads": options.threads,
            "min_time_s": options.min_time,
            "rounds": options.rounds,
            **machine_record(),
        }

    def write(self, complete: bool = False) -> None:
        """Replaces the record."""
        content = {
            "schema": SCHEMA,
            "complete": complete,
            **self._head,
            "duration_s": round(time.monotonic() - self._start_time, 1),
            "ceilings": [ceilings.record() for ceilings in self.ceilings.values()],
            "rows": [row.record(self.ceilings) for row in self.rows],
            "comparisons": compare(self.rows, self.ceilings),
            "default_allocator": self.default_allocator,
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        partial = self.out.with_name(self.out.name + ".part")
        partial.write_text(json.dumps(content, indent=1) + "\n")
        partial.replace(self.out)

    def show(self) -> None:
        """Prints the tables."""
        default = (self.default_allocator or {}).get("comparisons", ())
        machine, versions, native = (self._head[name] for name in ("machine", "versions", "native"))
        print(
            f"{machine['cpu']}, {machine['cores']} cores, torch {versions['torch']}, "
            f"kernels {native['cpu_capability'] or 'missing'}, malloc thresholds {self._head['allocator']}, "
            f"load average before the run {machine['load_average'][0]:.1f} (figures need an idle machine)\n"
        )
        print(format_ceilings(self.ceilings), end="\n\n")
        print(format_rows(self.rows, self.ceilings), end="\n\n")
        print(format_comparisons(compare(self.rows, self.ceilings), default))


def _add_ceilings(report: Report, options: argparse.Namespace, progress: Progress) -> None:
    """Measured before and after all else; the better counts."""
    copy_bytes = COPY_BYTES if options.sizes == "real" else 1 << 20
    for threads in options.threads:
        progress.show(f"ceilings with {threads} threads")
        found = measure_ceilings(threads, options.min_time, copy_bytes)
        report.ceilings[threads] = found.better(report.ceilings.get(threads, found))
        progress.advance()


def _plain_kinds(options: argparse.Namespace) -> list[str]:
    """Contenders of the run with the default allocator."""
    return [kind for kind in options.contenders if kind != "compiled"]


def _run_with_default_allocator(options: argparse.Namespace) -> dict[str, Any]:
    """Ours and eager in a process of their own: rows and comparisons of a short run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.json"
        command = [sys.executable, "-m", "benchmarks", "--default-allocator", "--quick", "--quiet", "--out", str(out)]
        command += ["--ops", ",".join(op for op in options.ops if op != "step"), "--sizes", options.sizes]
        command += ["--threads", ",".join(map(str, options.threads)), "--contenders", ",".join(_plain_kinds(options))]
        command += ["--min-time", str(options.min_time)]
        done = subprocess.run(command)
        if not out.is_file():
            raise RuntimeError(f"benchmarks: the run with the default allocator ended with {done.returncode}")
        result = json.loads(out.read_text())
    return {name: result[name] for name in ("allocator", "environment", "min_time_s", "rounds", "rows", "comparisons")}


class Progress:
    """What is being done and about how much time is left, on standard error."""

    PLAIN_LINE_INTERVAL_S = 5.0

    def __init__(self, total: int) -> None:
        self._total = total
        self.done = 0
        self._start_time = time.monotonic()
        self._shown_time = -math.inf
        self._overwrite = sys.stderr.isatty()

    def show(self, what: str) -> None:
        """What happens next."""
        now = time.monotonic()
        if not self._overwrite and now - self._shown_time < self.PLAIN_LINE_INTERVAL_S:
            return
        self._shown_time = now
        left = "-:--"
        if self.done:
            seconds = round((now - self._start_time) * (self._total - self.done) / self.done)
            left = f"{seconds // 60}:{seconds % 60:02}"
        line = f"[{self.done}/{self._total}, about {left} left] {what}"
        sys.stderr.write(f"\r\x1b[K{line[:120]}" if self._overwrite else line + "\n")
        sys.stderr.flush()

    def advance(self, units: int = 1) -> None:
        """So much more is done."""
        self.done += units
        if self.done >= self._total and self._overwrite:
            sys.stderr.write("\r\x1b[K")


if __name__ == "__main__":
    main()
