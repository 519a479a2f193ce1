# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The rendering step's time and memory per ray, from 1,024 rays to 16,384.

``python -m benchmarks.rays --out RECORD.json`` times the step of `benchmarks.bench_step` at each number of rays, half
of them depth rays and half semantic ones, and draws time and memory beside the JSON. What is kept for the backward pass
grows with the rays: numbers of rays for which the free memory does not suffice are left out.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.allocator import current_allocator, enter_allocator
from benchmarks.bench_step import contender
from benchmarks.cases import SIZES
from benchmarks.measure import machine_record
from benchmarks.memory import added_peak_bytes, status_bytes

NAMES = ("ours", "ours, recompute", "ours, bf16")
RAYS = (1024, 2048, 4096, 8192, 16384)
AT_MOST = 1.1
"""Time per ray at the most rays, relative to that at the fewest."""


def measure(name: str, sizes_name: str, rays: Sequence[int], rounds: int) -> list[dict[str, Any]]:
    """Median time of a step and the memory that it adds, by the number of rays."""
    found: list[dict[str, Any]] = []
    for count in rays:
        needed = 1.2 * found[-1]["added_bytes"] * count / found[-1]["rays"] if found else 0.0
        if needed > status_bytes("MemAvailable", "/proc/meminfo"):
            print(f"{name}: {count} rays left out, which would take {needed / 1e9:.0f} GB")
            break
        run = contender(name, replace(SIZES[sizes_name], step_rays=count // 2))
        added = added_peak_bytes(run) or 0  # the first call, too, warms up
        times = []
        for _ in range(rounds):
            start = time.perf_counter()
            run()
            times.append(time.perf_counter() - start)
        median = statistics.median(times)
        found.append({"rays": count, "median_s": median, "times_s": times, "added_bytes": added})
        print(f"{name}: {count:6} rays {median:7.3f} s  {1e6 * median / count:7.1f} us/ray  {added / 1e6:7.0f} MB")
    return found


def draw(record: dict[str, Any], path: Path) -> None:
    """Time and memory per ray over the number of rays."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    figure.suptitle(f"Rendering step, {record['threads']} threads ({record['machine']['cpu']})", fontsize=11)
    panels = (("microseconds per ray", "median_s", 1e6), ("kB per ray, added at most", "added_bytes", 1e-3))
    for axes, (label, key, factor) in zip(figure.subplots(1, 2), panels, strict=True):
        for name, points in record["contenders"].items():
            rays = [point["rays"] for point in points]
            axes.plot(rays, [factor * point[key] / point["rays"] for point in points], marker="o", label=name)
        axes.set_xscale("log", base=2)
        axes.set_xticks(record["rays"], [f"{count:,}" for count in record["rays"]])
        axes.set_ylim(bottom=0)
        axes.set_xlabel("rays")
        axes.set_ylabel(label)
        axes.grid(color="#dddddd")
        axes.legend()
    figure.savefig(path, dpi=100)


def main(arguments: Sequence[str]) -> int:
    """1 where the time per ray grows too much, or no series has all numbers of rays."""
    parser = argparse.ArgumentParser("python -m benchmarks.rays", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, metavar="JSON", help="the record, with a .png beside it")
    parser.add_argument("--sizes", choices=tuple(SIZES), default="real")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    rays = RAYS if options.sizes == "real" else (4, 8)
    record: dict[str, Any] = machine_record() | {"threads": options.threads, "rays": rays}
    record["contenders"] = {name: measure(name, options.sizes, rays, options.rounds) for name in NAMES}
    growth = {}
    for name, points in record["contenders"].items():
        if len(points) == len(rays):
            first, last = points[0], points[-1]
            growth[name] = last["median_s"] / last["rays"] * first["rays"] / first["median_s"]
            print(f"{name}: time per ray at {last['rays']} rays is {growth[name]:.2f} of that at {first['rays']}")
    record["growth"] = growth
    options.out.write_text(json.dumps(record, indent=1))
    draw(record, options.out.with_suffix(".png"))
    return int(not growth or any(value > AT_MOST for value in growth.values()))


if __name__ == "__main__":
    enter_allocator(current_allocator() or "raised")
    sys.exit(main(sys.argv[1:]))
