# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The record of a run: what is known so far, as JSON, as text and as Markdown."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.allocator import current_allocator
from benchmarks.compare import against_earlier, change_table, earlier_text
from benchmarks.measure import Ceilings, machine_record
from benchmarks.report import SCHEMA, Row, Table, ceiling_table, compare, comparison_table, missing_peers, row_table


class Report:
    """What is known so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.rows: list[Row] = []
        self.ceilings: dict[int, Ceilings] = {}
        self.default_allocator: dict[str, Any] | None = None
        self.earlier: dict[str, Any] | None = None
        """What changed since the record of ``--compare``; known once the run is complete."""
        self.out: Path = options.out
        self._earlier_record: dict[str, Any] | None = options.earlier
        self._earlier_name = str(options.compare)
        self._start_time = time.monotonic()
        self._head: dict[str, Any] = {
            "command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]]),
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "allocator": current_allocator(),
            "device": options.device.type,
            "sizes": "captured" if options.replay else options.sizes,
            "threads": options.threads,
            "min_time_s": options.min_time,
            "rounds": options.rounds,
            **machine_record(options.device),
        }

    def content(self, complete: bool) -> dict[str, Any]:
        """All of it, as the JSON file holds it."""
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
        if complete and self._earlier_record is not None:
            self.earlier = against_earlier(content, self._earlier_record, self._earlier_name)
        return content | {"earlier": self.earlier}

    def write(self, complete: bool = False) -> dict[str, Any]:
        """Replaces the JSON file; returns what it holds."""
        content = self.content(complete)
        self._replace(self.out, json.dumps(content, indent=1) + "\n")
        return content

    def write_markdown(self) -> Path:
        """The tables beside the JSON file."""
        path = self.out.with_suffix(".md")
        parts = ["# Benchmark", f"`{self._head['command']}`", self._summary()]
        for title, table in self._tables():
            parts += [f"## {title}", table.markdown()]
        if missing := missing_peers(self.rows):
            parts.append(f"Peers that are not installed: {', '.join(missing)}.")
        if self.earlier:
            parts += [f"## Against {self.earlier['file']}", *(f"Warning: {text}." for text in self.earlier["warnings"])]
            parts.append(change_table(self.earlier["changes"]).markdown())
        self._replace(path, "\n\n".join(parts) + "\n")
        return path

    def show(self) -> None:
        """Prints the tables."""
        parts = [self._summary(), *(table.text() for _, table in self._tables())]
        if missing := missing_peers(self.rows):
            parts.append(f"peers that are not installed: {', '.join(missing)}")
        if self.earlier:
            parts.append(earlier_text(self.earlier))
        print("\n\n".join(parts))

    def _summary(self) -> str:
        machine, versions, native = (self._head[name] for name in ("machine", "versions", "native"))
        gpu = machine["gpu"]
        if gpu is not None:
            return (
                f"{gpu['name']}, CUDA {gpu['cuda']}, driver {gpu['driver']}, torch {versions['torch']}; "
                f"{machine['cpu']}, {machine['cores']} cores"
            )
        return (
            f"{machine['cpu']}, {machine['cores']} cores, torch {versions['torch']}, "
            f"kernels {native['cpu_capability'] or 'missing'}, malloc thresholds {self._head['allocator']}, "
            f"load average before the run {machine['load_average'][0]:.1f} (figures need an idle machine)"
        )

    def _tables(self) -> list[tuple[str, Table]]:
        default = (self.default_allocator or {}).get("comparisons", ())
        return [
            ("Ceilings", ceiling_table(self.ceilings)),
            ("Contenders", row_table(self.rows, self.ceilings)),
            ("Ours against the others", comparison_table(compare(self.rows, self.ceilings), default)),
        ]

    @staticmethod
    def _replace(path: Path, text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".part")
        partial.write_text(text)
        partial.replace(path)
