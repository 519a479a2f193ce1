# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A record as a picture: how near each contender comes to the measured ceiling, a panel per family of ops.

Needs matplotlib (``pip install 'pred-lidar[bench]'``). By itself: ``python -m benchmarks.picture RECORD.json``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench_ops import FAMILIES
from benchmarks.case import BACKWARD_ALONE, SECOND_ALONE
from benchmarks.compare import RecordError, load_record

COLORS = {"ours": "#1b6ca8", "eager": "#e08e29", "compiled": "#8a5fa8", "peer": "#4d9a51", "reference": "#8c8c8c"}
LOWEST_SHARE = 1e-3
BAR_INCHES, GAP_INCHES = 0.15, 0.10
LABEL_INCHES, BAR_AREA_INCHES, COLUMN_INCHES = 4.4, 5.4, 10.0
TOP_INCHES, BETWEEN_INCHES = 1.1, 0.75
TWO_COLUMNS_INCHES = 16.0
"""Taller pictures get a second column."""

Group = tuple[str, list[Mapping[str, Any]]]


class PictureError(RuntimeError):
    """matplotlib is missing, or there is nothing to draw."""


def draw(record: Mapping[str, Any], path: Path) -> Path:
    """Draws the rows with the most threads; of several eager, compiled or peer rows of a phase, the fastest.

    Phases that are a part of another one are left to the tables.

    Raises:
        PictureError: matplotlib is missing, or no row has a time and a ceiling.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise PictureError("matplotlib is missing; pip install 'pred-lidar[bench]'") from None
    threads = max(record["threads"])
    panels = _panels(record, threads)
    if not panels:
        raise PictureError("no row has a time and a ceiling")
    columns = _columns(panels)
    width = COLUMN_INCHES * len(columns)
    total = TOP_INCHES + max(sum(_panel_height(panels[family]) for family in column) for column in columns)
    figure = Figure(figsize=(width, total), dpi=100)
    figure.suptitle(
        f"Share of the measured ceiling, {threads} threads ({record['machine']['cpu']}, torch "
        f"{record['versions']['torch']})\nbehind the bars: time, and ours against the fastest eager",
        y=1 - 0.12 / total,
        fontsize=11,
    )
    shares = [_share(row) for groups in panels.values() for _, rows in groups for row in rows]
    legend: dict[str, Any] = {}
    for number, column in enumerate(columns):
        low = total - TOP_INCHES
        for family in column:
            height = _panel_height(panels[family])
            low -= height
            left, bottom = COLUMN_INCHES * number + LABEL_INCHES, low + BETWEEN_INCHES
            across, up = BAR_AREA_INCHES / width, (height - BETWEEN_INCHES) / total
            axes = figure.add_axes((left / width, bottom / total, across, up))
            legend |= _draw_panel(axes, panels[family])
            axes.set_title(family, loc="left", fontsize=11, fontweight="bold")
            axes.set_xlim(LOWEST_SHARE, max(1.0, *shares) * 10)  # room for the text behind the bars
    kinds = [kind for kind in COLORS if kind in legend]
    figure.legend(
        [legend[kind] for kind in kinds], kinds, loc="upper center", bbox_to_anchor=(0.5, 1 - 0.5 / total),
        ncols=len(kinds), fontsize=9, frameon=False,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _panels(record: Mapping[str, Any], threads: int) -> dict[str, list[Group]]:
    """Family -> case and phase -> the rows to draw."""
    families = {op: family for family, makers in FAMILIES.items() for op in makers}
    panels: dict[str, dict[str, dict[str, Mapping[str, Any]]]] = {}
    for row in record["rows"]:
        if row["threads"] != threads or row["phase"] in (BACKWARD_ALONE, SECOND_ALONE) or not _share(row):
            continue
        panel = panels.setdefault(families.get(row["op"], row["op"]), {})
        group = panel.setdefault(f"{row['case']}\n{row['phase']}", {})
        fastest = group.get(row["kind"])
        if fastest is None or row["timing"]["median_s"] < fastest["timing"]["median_s"]:
            group[row["kind"]] = row
    return {
        family: [(label, [group[kind] for kind in COLORS if kind in group]) for label, group in groups.items()]
        for family, groups in panels.items()
    }


def _share(row: Mapping[str, Any]) -> float:
    """Of the ceiling; 0 where it is not known."""
    rates = row["rates"] or {}
    return float(rates.get("copy_share") or rates.get("matrix_share") or 0)


def _columns(panels: Mapping[str, Sequence[Group]]) -> list[list[str]]:
    """Families by column, each panel in the column that is shortest so far."""
    heights = {family: _panel_height(groups) for family, groups in panels.items()}
    if sum(heights.values()) < TWO_COLUMNS_INCHES or len(panels) == 1:
        return [list(panels)]
    columns: list[list[str]] = [[], []]
    for family in panels:
        min(columns, key=lambda column: sum(heights[name] for name in column)).append(family)
    return columns


def _panel_height(groups: Sequence[Group]) -> float:
    """With its axis and title."""
    return sum(_height(group) for group in groups) + GAP_INCHES + BETWEEN_INCHES


def _height(group: Group) -> float:
    return max(2, len(group[1])) * BAR_INCHES + GAP_INCHES  # a label has two lines


def _draw_panel(axes: Any, groups: Sequence[Group]) -> dict[str, Any]:
    """Bars from top to bottom; returns one of each kind, for the legend."""
    from matplotlib.ticker import FuncFormatter

    legend: dict[str, Any] = {}
    ticks, labels, y = [], [], GAP_INCHES
    for label, rows in groups:
        middle = y + (_height((label, rows)) - GAP_INCHES) / 2
        first = middle - (len(rows) - 1) * BAR_INCHES / 2
        times = {row["kind"]: row["timing"]["median_s"] for row in rows}
        for number, row in enumerate(rows):
            at, kind, length = first + number * BAR_INCHES, row["kind"], max(_share(row), LOWEST_SHARE)
            legend[kind] = axes.barh(at, length, height=0.9 * BAR_INCHES, color=COLORS[kind])
            text = _time(times[kind])
            if kind == "ours":
                text += f", {_share(row):.0%}" + (f", {times['eager'] / times[kind]:.1f}x" if "eager" in times else "")
            elif kind == "peer":
                text += f" ({row['contender']})"
            axes.annotate(
                text, (length, at), (4, 0), textcoords="offset points", va="center", fontsize=7,
                fontweight="bold" if kind == "ours" else "normal",
                bbox={"facecolor": "white", "linewidth": 0, "pad": 0.4},  # keeps the ceiling off it
            )  # fmt: skip
        ticks.append(middle)
        labels.append(label)
        y += _height((label, rows))
    axes.set_yticks(ticks, labels, fontsize=7.5)
    axes.set_ylim(y, 0)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g} %"))
    axes.tick_params(axis="x", labelsize=8)
    axes.tick_params(axis="y", length=0)
    axes.axvline(1, color="#b01c2e", linewidth=1.2, zorder=1)
    axes.grid(axis="x", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return legend


def _time(seconds: float) -> str:
    for factor, unit in ((1, "s"), (1e3, "ms")):
        if seconds * factor >= 1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{1e6 * seconds:.3g} us"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m benchmarks.picture RECORD.json")
    record_path = Path(sys.argv[1])
    try:
        print(draw(load_record(record_path), record_path.with_suffix(".png")))
    except (RecordError, PictureError) as error:
        sys.exit(str(error))
