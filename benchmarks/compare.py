# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ours now against ours in an earlier record; also by itself: ``python -m benchmarks.compare NEW.json OLD.json``."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import SCHEMA, Table, key_of

Record = Mapping[str, Any]

# What figures depend on, and where a record has it.
_CIRCUMSTANCES = {
    "processor": ("machine", "cpu"),
    "cores": ("machine", "cores"),
    "GPU": ("machine", "gpu", "name"),
    "torch": ("versions", "torch"),
    "instruction set": ("native", "cpu_capability"),
    "sizes": ("sizes",),
    "allocator": ("allocator",),
}


class RecordError(ValueError):
    """A file is no record that this version can read."""


def load_record(path: Path) -> dict[str, Any]:
    """Reads what ``python -m benchmarks`` wrote.

    Raises:
        RecordError: the file is missing, broken, or of another schema.
    """
    try:
        record = json.loads(path.read_text())
    except FileNotFoundError:
        raise RecordError(f"{path}: must be a record of python -m benchmarks, got no such file") from None
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: must be a record of python -m benchmarks, got unreadable JSON: {error}") from None
    if not isinstance(record, dict) or "schema" not in record:
        raise RecordError(f"{path}: must be a record of python -m benchmarks, got JSON without a schema")
    if record["schema"] != SCHEMA:
        raise RecordError(f"{path}: must have schema {SCHEMA}, got {record['schema']}: another version wrote it")
    missing = [name for name in ("rows", "comparisons", "machine", "versions") if name not in record]
    if missing:
        raise RecordError(f"{path}: must be a whole record, got one without {', '.join(missing)}")
    return record


def differing_circumstances(now: Record, then: Record) -> list[str]:
    """Why the two may not be compared: one line for each difference in machine, versions and settings."""
    found = []
    for name, path in _CIRCUMSTANCES.items():
        here, there = _at(now, path), _at(then, path)
        if here != there:
            found.append(f"{name} differs: {here} now, {there} then")
    return found + [f"the {name} record is not complete" for name, record in (("new", now), ("earlier", then))
                    if not record.get("complete")]  # fmt: skip


def changes(now: Record, then: Record) -> list[dict[str, Any]]:
    """Ours now and then, for every case, phase and number of threads that both records hold.

    ``speedup`` is the earlier time over the time now. ``vs_eager_change`` is the factor against eager now over the
    one then, in which the machine's speed of the day cancels. ``verdict`` is "faster" or "slower" where the ranges over
    the rounds do not meet: those of the factors against eager, or of the times where there is no eager.
    """
    ours_then = {key_of(row): row["timing"] for row in then["rows"] if row["kind"] == "ours" and row["timing"]}
    eager_then, eager_now = (_factors(record) for record in (then, now))
    found = []
    for row in now["rows"]:
        key, timing = key_of(row), row["timing"]
        if row["kind"] != "ours" or timing is None or key not in ours_then:
            continue
        before = ours_then[key]
        change: dict[str, Any] = {name: row[name] for name in ("op", "case", "phase", "threads")}
        change |= {"now_s": timing["median_s"], "then_s": before["median_s"]}
        change["speedup"] = before["median_s"] / timing["median_s"]
        factor_now, factor_then = eager_now.get(key), eager_then.get(key)
        if factor_now and factor_then:
            change |= {"vs_eager_now": factor_now["ratio"], "vs_eager_then": factor_then["ratio"]}
            change["vs_eager_change"] = factor_now["ratio"] / factor_then["ratio"]
            here, there = ((factor["lowest_round"], factor["highest_round"]) for factor in (factor_now, factor_then))
        else:
            change |= {"vs_eager_now": None, "vs_eager_then": None, "vs_eager_change": None}
            here, there = (_speeds(times) for times in (timing, before))
        change["verdict"] = "faster" if here[0] > there[1] else "slower" if here[1] < there[0] else "within noise"
        found.append(change)
    return found


def relative(change: Mapping[str, Any]) -> float:
    """The change against eager where it is known, else that of the time; below 1 is slower."""
    against_eager = change["vs_eager_change"]
    return float(change["speedup"] if against_eager is None else against_eager)


def change_table(found: Sequence[Mapping[str, Any]]) -> Table:
    """The table of changes."""
    header = (
        *("case", "phase", "threads", "ms then", "ms now", "speed"),
        *("vs eager then", "vs eager now", "vs eager", "change"),
    )
    lines = []
    previous = ""
    for change in found:
        shown = "" if change["case"] == previous else change["case"]
        previous = change["case"]
        lines.append(
            [
                shown,
                change["phase"],
                str(change["threads"]),
                f"{1e3 * change['then_s']:.3f}",
                f"{1e3 * change['now_s']:.3f}",
                _factor(change["speedup"]),
                _factor(change["vs_eager_then"]),
                _factor(change["vs_eager_now"]),
                _factor(change["vs_eager_change"]),
                "" if change["verdict"] == "within noise" else change["verdict"],
            ]
        )
    return Table(header, lines, right=(2, 3, 4, 5, 6, 7, 8))


def against_earlier(now: Record, then: Record, name: str) -> dict[str, Any]:
    """What a record keeps of its comparison with an earlier one."""
    return {
        "file": name,
        "started": then.get("started"),
        "commit": _at(then, ("git", "commit")),
        "warnings": differing_circumstances(now, then),
        "changes": changes(now, then),
    }


def earlier_text(earlier: Mapping[str, Any]) -> str:
    """What is printed of it."""
    found = earlier["changes"]
    lines = [f"against {earlier['file']} of {earlier['started']}, commit {earlier['commit']}"]
    lines += [f"warning: {warning}" for warning in earlier["warnings"]]
    if not found:
        return "\n".join([*lines, "no case, phase and number of threads is in both"])
    count = {verdict: sum(change["verdict"] == verdict for change in found) for verdict in ("faster", "slower")}
    lines += [change_table(found).text(), f"{count['faster']} faster, {count['slower']} slower of {len(found)}"]
    return "\n".join(lines)


def _at(record: Record, path: Sequence[str]) -> Any:
    value: Any = record
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _factors(record: Record) -> dict[tuple[str, str, int], dict[str, Any] | None]:
    return {key_of(comparison): comparison["speedup"].get("eager") for comparison in record["comparisons"]}


def _speeds(timing: Mapping[str, Any]) -> tuple[float, float]:
    """Lowest and highest of the rounds, calls per second."""
    return 1 / max(timing["round_medians_s"]), 1 / min(timing["round_medians_s"])


def _factor(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}x"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m benchmarks.compare NEW.json OLD.json")
    try:
        new, old = (load_record(Path(name)) for name in sys.argv[1:])
    except RecordError as error:
        sys.exit(str(error))
    print(earlier_text(against_earlier(new, old, sys.argv[2])))
