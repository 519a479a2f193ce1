# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What pre-training on a made world learns: rendering against projected labels, trained against untrained encoders.

``python -m benchmarks.world_study ROOT --out FOLDER`` trains `world_pillars` on the ``train`` split of a world (made
with ``--exact-labels``) once per variant and seed, measures it on the ``val`` split by ``pred evaluate rendering``
and ``pred evaluate probe``, prints tables in Markdown, and writes them with every figure as JSON. All variants have the
same network, rays, steps and data; they differ in the options below. Further options go to `pred pretrain`, such as
``--data.labels`` for labels of a segmenter in place of the perfect ones. What is finished in FOLDER is not done again.
"""

from __future__ import annotations

import csv
import json
import statistics
import subprocess
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import machine_record
from pred.run_folder import claim_settings, one_writer, write_json

EVALUATED_FRAMES = 16
"""Four of each unseen scene, for the rendering: each has some 60,000 rays."""
DEPTH_MAPS = "--data.image_depth=depth/exact"
PERFECT_LABELS = "--data.labels=pseudo/exact"
VARIANTS = {
    "rendering": [],
    "projection": ["--loss.semantic_at=return"],
    "projection, depth filter": ["--loss.semantic_at=return", DEPTH_MAPS, "--data.depth_filter=[0.5, 0.05]"],
    "projection, rendered": ["--data.semantic_view=lidar"],
}
"""Options of `pred pretrain` by variant; docs/method.md describes them."""

Figure = Callable[[dict[str, Any], dict[str, Any]], float | None]
"""(evaluation_rendering.json, evaluation_probe.json) of a run to a number."""


def _semantics(network: str, group: str, key: str = "accuracy") -> Figure:
    return lambda rendering, probe: rendering[network]["returns"][group][key]


FIGURES: dict[str, tuple[str, Figure]] = {
    "class of occluded returns": ("%", _semantics("trained", "occluded")),
    "…, mean over classes": ("%", _semantics("trained", "occluded", "mean_class_accuracy")),
    "class of returns in an image": ("%", _semantics("trained", "in_image")),
    "median depth error": ("m", lambda rendering, probe: rendering["trained"]["depth_median_m"]),
    "mean depth error": ("m", lambda rendering, probe: rendering["trained"]["depth_mean_m"]),
    "probe mIoU": ("%", lambda rendering, probe: probe["trained"]["miou"]),
    "probe mIoU, untrained": ("%", lambda rendering, probe: probe["untrained"]["miou"]),
}
"""Name to unit and number."""
UNTRAINED: dict[str, tuple[str, Figure]] = {
    "label at the pixel of occluded returns": ("%", _semantics("projected_label", "occluded")),
    "label at the pixel of returns in an image": ("%", _semantics("projected_label", "in_image")),
    "median depth error of the nearest visible point": (
        "m",
        lambda rendering, probe: rendering["nearest_visible"]["depth_median_m"],
    ),
    "mean depth error of the nearest visible point": (
        "m",
        lambda rendering, probe: rendering["nearest_visible"]["depth_mean_m"],
    ),
}
"""What needs no training, measured beside each run."""


def run_variant(root: Path, run: Path, variant: str, seed: int, options: Sequence[str]) -> dict[str, Any]:
    """Pre-train and measure one run, or what is left of it; returns its two evaluations and the time of its steps."""
    if not (run / "encoder.pth").is_file():
        if (run / "config.yaml").is_file():
            _pred("pretrain", "--resume", str(run))
        else:
            new = [f"--data.root={root}", f"--train.seed={seed}", f"--run={run}"]
            _pred("pretrain", "--config=world_pillars", PERFECT_LABELS, *options, *VARIANTS[variant], *new)
    rendering, probe = run / "evaluation_rendering.json", run / "evaluation_probe.json"
    if not rendering.is_file():
        measured = ["--data.split=val", DEPTH_MAPS, "--all-returns", f"--frames={EVALUATED_FRAMES}"]
        _pred("evaluate", "rendering", str(run), *measured)
    if not probe.is_file():
        _pred("evaluate", "probe", str(run))
    return {
        "training_s": training_s(run),
        "rendering": json.loads(rendering.read_text()),
        "probe": json.loads(probe.read_text()),
    }


def training_s(run: Path) -> float:
    """Steps times the mean duration of those that were logged, seconds: a run that was resumed has no single clock."""
    with open(run / "timing.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return int(rows[-1]["step"]) * statistics.mean(float(row["duration_s"]) for row in rows)


def summarise(
    runs: Mapping[str, Sequence[dict[str, Any]]], figures: Mapping[str, tuple[str, Figure]]
) -> dict[str, dict[str, Any]]:
    """Mean, standard deviation and values over the seeds: figure, then variant."""
    table: dict[str, dict[str, Any]] = {}
    for name, (unit, figure) in figures.items():
        table[name] = {"unit": unit}
        for variant, results in runs.items():
            values = [figure(result["rendering"], result["probe"]) for result in results]
            measured = [value for value in values if value is not None]
            table[name][variant] = {
                "mean": statistics.mean(measured) if measured else None,
                "deviation": statistics.stdev(measured) if len(measured) > 1 else None,
                "values": values,
            }
    return table


def markdown(table: Mapping[str, Mapping[str, Any]]) -> str:
    """The table's means and standard deviations."""
    variants = [name for name in next(iter(table.values())) if name != "unit"]
    lines = ["| | " + " | ".join(variants) + " |", "| --- |" + " --- |" * len(variants)]
    for name, row in table.items():
        lines.append(f"| {name} | " + " | ".join(_cell(row[variant], row["unit"]) for variant in variants) + " |")
    return "\n".join(lines)


def _cell(figure: Mapping[str, Any], unit: str) -> str:
    if figure["mean"] is None:
        return "–"
    scale, digits = (100, 1) if unit == "%" else (1, 3)
    spread = "" if figure["deviation"] is None else f" ± {scale * figure['deviation']:.{digits}f}"
    return f"{scale * figure['mean']:.{digits}f}{spread} {unit}"


def _pred(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pred", *arguments], check=True)


def main(arguments: Sequence[str]) -> int:
    """Runs what is missing, prints the tables and writes ``<out>/world_study.json``."""
    parser = ArgumentParser(
        "python -m benchmarks.world_study", description=(__doc__ or "").partition("\n")[0], allow_abbrev=False
    )
    parser.add_argument("root", type=Path, help="world made with --exact-labels")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    options, pretrain_options = parser.parse_known_args(arguments)
    wanted = {
        "root": str(options.root.resolve()),
        "world": json.loads((options.root / "world.json").read_text()),
        "pretrain_options": pretrain_options,
        "variants": VARIANTS,
        "evaluated_frames": EVALUATED_FRAMES,
    }
    with one_writer(options.out):
        claim_settings(options.out / "settings.json", wanted)
        return _study(options, pretrain_options, arguments)


def _study(options: Namespace, pretrain_options: Sequence[str], arguments: Sequence[str]) -> int:
    runs: dict[str, list[dict[str, Any]]] = {variant: [] for variant in options.variants}
    for seed in options.seeds:
        for variant in options.variants:
            name = variant.replace(", ", "-").replace(" ", "-")
            runs[variant].append(
                run_variant(options.root, options.out / f"{name}-seed{seed}", variant, seed, pretrain_options)
            )
    tables = {"trained": summarise(runs, FIGURES), "untrained": summarise(runs, UNTRAINED)}
    record = {
        "seeds": options.seeds,
        "arguments": list(arguments),
        "machine": machine_record(),
        "tables": tables,
        "runs": runs,
    }
    write_json(options.out / "world_study.json", record)
    print("\n\n".join(markdown(table) for table in tables.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
