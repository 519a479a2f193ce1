# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What a run found: rows, their comparison with each other and with the machine's ceilings, and the tables of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from benchmarks.measure import Ceilings, Timing

SCHEMA = 1
NOT_INSTALLED = "not installed"
MEASURED_MEMORY_BYTES = 1e6
"""Peaks below are not compared: pages and the allocator's own needs are too large a part of them."""


@dataclass(frozen=True)
class Target:
    """What a phase should reach: so many times the speed of a contender, a share of a ceiling, or a part of the memory
    (4: a quarter)."""

    against: Literal["eager", "compiled", "peer", "copy bandwidth", "matrix rate", "eager's memory"]
    at_least: float


@dataclass
class Row:
    """One contender in one phase of one case."""

    op: str
    case: str
    phase: str
    threads: int
    contender: str
    kind: str
    """``ours``, ``eager``, ``compiled``, ``peer``, or ``reference``."""
    unit: str
    items: int
    """Number of `unit`s in one call."""
    traffic: str = ""
    """Formula of the least bytes moved."""
    traffic_bytes: int = 0
    work: str = ""
    """Formula of the useful arithmetic, where matrix products are the limit."""
    flop: int = 0
    flop_dtype: str = "float32"
    """Of the products' operands."""
    status: str = "ok"
    """``ok``, or why there is no time: ``refused: ...``, ``missing: ...``, ``wrong: ...``, ``not installed``."""
    error: float | None = None
    """Largest difference to the reference, relative to the largest magnitude of each result."""
    timing: Timing | None = None
    peak_memory_bytes: int | None = None
    """Of one call, beyond what the process held before it (see `benchmarks.memory`)."""
    targets: tuple[Target, ...] = ()

    def record(self, ceilings: Mapping[int, Ceilings]) -> dict[str, Any]:
        """For the JSON file: all of it, and rates."""
        record = asdict(self)
        del record["targets"]
        record["timing"] = self.timing.record() if self.timing else None
        record["rates"] = self.rates(ceilings)
        return record

    def rates(self, ceilings: Mapping[int, Ceilings]) -> dict[str, float] | None:
        """Work per second, and shares of the ceilings with the same number of threads."""
        if self.timing is None:
            return None
        seconds, ceiling = self.timing.median_s, ceilings[self.threads]
        rates = {"items_per_s": self.items / seconds}
        if self.traffic_bytes:
            rates["bytes_per_s"] = self.traffic_bytes / seconds
            rates["copy_share"] = rates["bytes_per_s"] / ceiling.copy_bytes_per_s
        if self.flop:
            rates["flop_per_s"] = self.flop / seconds
            half = self.flop_dtype == "bfloat16"
            rates["matrix_share"] = rates["flop_per_s"] / (
                ceiling.bfloat16_flop_per_s if half else ceiling.matrix_flop_per_s
            )
        return rates


def compare(rows: Sequence[Row], ceilings: Mapping[int, Ceilings]) -> list[dict[str, Any]]:
    """Ours against the fastest of each other kind, fewer threads and the targets, phase by phase."""
    groups: dict[tuple[str, str, int], list[Row]] = {}
    fewest: dict[tuple[str, str], Row] = {}  # ours with the fewest threads, which come first
    for row in rows:
        groups.setdefault((row.case, row.phase, row.threads), []).append(row)
    comparisons = []
    for (case, phase, threads), group in groups.items():
        timed = [row for row in group if row.timing is not None]
        best = {
            kind: min((row for row in timed if row.kind == kind), key=_median, default=None)
            for kind in ("ours", "reference", "eager", "compiled", "peer")
        }
        ours = best.pop("ours")
        comparison: dict[str, Any] = {"op": group[0].op, "case": case, "phase": phase, "threads": threads}
        against = {kind: _speedup(ours, other) for kind, other in best.items() if ours and other}
        comparison["speedup"] = against
        alone = fewest.setdefault((case, phase), ours) if ours else None
        if ours and alone and alone is not ours:
            comparison["scaling"] = {"threads": alone.threads, "ratio": _median(alone) / _median(ours)}
        rates = (ours.rates(ceilings) if ours else None) or {}
        reached = {kind: speedup["ratio"] for kind, speedup in against.items()}
        reached |= {
            name: rates[key]
            for name, key in (("copy bandwidth", "copy_share"), ("matrix rate", "matrix_share"))
            if key in rates
        }
        eager = best["eager"]
        comparison["memory"] = None
        if ours and eager and ours.peak_memory_bytes and (eager.peak_memory_bytes or 0) >= MEASURED_MEMORY_BYTES:
            assert eager.peak_memory_bytes is not None
            reached["eager's memory"] = eager.peak_memory_bytes / ours.peak_memory_bytes
            comparison["memory"] = {"contender": eager.contender, "share": 1 / reached["eager's memory"]}
        comparison["targets"] = [
            asdict(target)
            | {
                "reached": reached.get(target.against),
                "met": reached[target.against] >= target.at_least if target.against in reached else None,
            }
            for target in group[0].targets
        ]
        comparisons.append(comparison)
    return comparisons


def _median(row: Row) -> float:
    assert row.timing is not None
    return row.timing.median_s


def _speedup(ours: Row, other: Row) -> dict[str, Any]:
    """How many times faster ours is: by the medians, and in the worst and best of the rounds."""
    assert ours.timing is not None and other.timing is not None
    by_round = [
        theirs / mine for theirs, mine in zip(other.timing.round_medians_s, ours.timing.round_medians_s, strict=False)
    ]
    return {
        "contender": other.contender,
        "ratio": other.timing.median_s / ours.timing.median_s,
        "lowest_round": min(by_round),
        "highest_round": max(by_round),
    }


@dataclass(frozen=True)
class Table:
    """Text in columns; those without content are left out."""

    header: tuple[str, ...]
    lines: list[list[str]]
    right: tuple[int, ...] = ()
    """Columns aligned to the right."""

    def text(self) -> str:
        """Aligned by spaces."""
        columns = self._columns()
        widths = {column: max(len(line[column]) for line in [self.header, *self.lines]) for column in columns}

        def aligned(line: Sequence[str]) -> str:
            cells = (
                line[column].rjust(widths[column]) if column in self.right else line[column].ljust(widths[column])
                for column in columns
            )
            return "  ".join(cells).rstrip()

        rule = "  ".join("-" * widths[column] for column in columns)
        return "\n".join([aligned(self.header), rule, *(aligned(line) for line in self.lines)])

    def markdown(self) -> str:
        """As GitHub shows it."""
        columns = self._columns()

        def joined(cells: Sequence[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = joined(["---:" if column in self.right else "---" for column in columns])
        lines = (joined([line[column] for column in columns]) for line in [self.header, *self.lines])
        return "\n".join([next(lines), rule, *lines])

    def _columns(self) -> list[int]:
        return [column for column in range(len(self.header)) if any(line[column] for line in self.lines)]


def row_table(rows: Sequence[Row], ceilings: Mapping[int, Ceilings]) -> Table:
    """The table of contenders, without peers that are not there."""
    header = ("case", "phase", "threads", "contender", "ms", "IQR ms", "rate", "GB/s", "of ceiling", "peak MB", "")
    lines = []
    previous = ""
    for row in rows:
        if row.status == NOT_INSTALLED:
            continue
        shown = "" if row.case == previous else row.case
        previous = row.case
        line = [shown, row.phase, str(row.threads), row.contender]
        rates = row.rates(ceilings)
        if row.timing is None or rates is None:
            lines.append([*line, "-", "", "", "", "", "", row.status])
            continue
        ceiling = ""
        if "copy_share" in rates:
            ceiling = f"{rates['copy_share']:.0%} copy"
        elif "matrix_share" in rates:
            ceiling = f"{rates['matrix_share']:.0%} matrix"
        note = "" if row.status == "ok" else row.status
        if row.kind == "peer" and row.timing.busy_cores is not None:
            note = f"{row.timing.busy_cores:.1f} cores busy"
        lines.append(
            [
                *line,
                f"{1e3 * row.timing.median_s:.3f}",
                f"{1e3 * (row.timing.q75_s - row.timing.q25_s):.3f}",
                f"{_short(rates['items_per_s'])} {row.unit}/s",
                f"{rates['bytes_per_s'] / 1e9:.2f}" if "bytes_per_s" in rates else "",
                ceiling,
                f"{row.peak_memory_bytes / 1e6:.1f}" if row.peak_memory_bytes is not None else "",
                note,
            ]
        )
    return Table(header, lines, right=(2, 4, 5, 6, 7, 8, 9))


def missing_peers(rows: Sequence[Row]) -> list[str]:
    """Names of the peers that are not installed."""
    return sorted({row.contender for row in rows if row.status == NOT_INSTALLED})


def comparison_table(
    comparisons: Sequence[Mapping[str, Any]], default_allocator: Sequence[Mapping[str, Any]] = ()
) -> Table:
    """The table of ratios and targets, with the default allocator's ratio beside."""
    others = {key_of(comparison): comparison for comparison in default_allocator}
    header = (
        *("case", "phase", "threads", "vs reference", "vs eager", "rounds", "vs compiled", "vs peer", "memory"),
        *("default malloc: vs eager", "scaling", "target"),
    )
    lines = []
    previous = ""
    for comparison in comparisons:
        shown = "" if comparison["case"] == previous else comparison["case"]
        previous = comparison["case"]
        against = comparison["speedup"].get("eager") or comparison["speedup"].get("reference")
        memory, peer = comparison.get("memory"), comparison["speedup"].get("peer")
        lines.append(
            [
                shown,
                comparison["phase"],
                str(comparison["threads"]),
                _ratio(comparison, "reference"),
                _ratio(comparison, "eager"),
                f"{against['lowest_round']:.1f} to {against['highest_round']:.1f}" if against else "",
                _ratio(comparison, "compiled"),
                f"{_ratio(comparison, 'peer')} {peer['contender']}" if peer else "",
                f"{memory['share']:.2f}x eager" if memory else "",
                _ratio(others.get(key_of(comparison), {"speedup": {}}), "eager"),
                _scaling(comparison),
                "; ".join(_verdict(target) for target in comparison["targets"]),
            ]
        )
    return Table(header, lines, right=(2, 3, 4, 5, 6, 7, 8, 9, 10))


def ceiling_table(ceilings: Mapping[int, Ceilings]) -> Table:
    """The measured ceilings."""
    lines = [
        [
            str(threads),
            f"{item.copy_bytes_per_s / 1e9:.1f} GB/s",
            f"{item.matrix_flop_per_s / 1e9:.1f} GFLOP/s",
            f"{item.bfloat16_flop_per_s / 1e9:.1f} GFLOP/s",
        ]
        for threads, item in ceilings.items()
    ]
    return Table(("threads", "copy bandwidth", "matrix rate", "in bfloat16"), lines, right=(0, 1, 2, 3))


def key_of(comparison: Mapping[str, Any]) -> tuple[str, str, int]:
    """Case, phase and threads: what a comparison is of."""
    return comparison["case"], comparison["phase"], comparison["threads"]


def _ratio(comparison: Mapping[str, Any], kind: str) -> str:
    speedup = comparison["speedup"].get(kind)
    return f"{speedup['ratio']:.2f}x" if speedup else ""


def _scaling(comparison: Mapping[str, Any]) -> str:
    scaling = comparison.get("scaling")
    return f"{scaling['ratio']:.2f}x of {scaling['threads']}" if scaling else ""


def _verdict(target: Mapping[str, Any]) -> str:
    against, at_least, reached = target["against"], target["at_least"], target["reached"]
    if against in ("copy bandwidth", "matrix rate"):
        wanted, reached = f"{at_least:.0%} of {against}", reached and f"{reached:.0%}"
    elif against == "eager's memory":
        wanted, reached = f"1/{at_least:g} of {against}", reached and f"1/{reached:.2f}"
    else:
        wanted, reached = f"{at_least:g}x {against}", reached and f"{reached:.2f}x"
    if reached is None:
        return f"{wanted}: not measured"
    return f"{wanted}: {'met' if target['met'] else 'falls short'} ({reached})"


def _short(value: float) -> str:
    for factor, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g}{letter}"
    return f"{value:.3g}"
