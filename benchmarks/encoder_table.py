# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Every family of encoders through `pred pretrain`: does it learn, how long does a step take, how much memory?

``python -m benchmarks.encoder_table ROOT --out FOLDER`` pre-trains each family for 100 steps on a data set in the
nuScenes layout (all of its frames, 95 % of the points hidden), once on the compiled kernels and once on the references,
each in a fresh process. It prints a table in Markdown, and writes FOLDER/encoder_table.md and, with every loss,
FOLDER/encoder_table.json. Sizes are those of the world_* configurations, made for two cores: what lies within 25.6 m of
the car, small 2D backbones and field. ``--published`` takes the published detectors' sizes instead (use few
``--steps``). Further options go to `pred pretrain`. What is finished in FOLDER is not done again.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import statistics
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import machine_record
from pred.config import build, config_parser
from pred.pretrain import PretrainConfig, build_model
from pred.run_folder import claim_settings, one_writer, write_json

SMALL = {
    "pillars": ["--config=world_pillars"],
    "hard pillars": ["--config=world_pillars", "--encoder.pillars.max_points=20"],
    "voxels, plain": ["--config=world_voxels", "--encoder.voxels.backbone=plain"],
    "voxels, residual": ["--config=world_voxels"],
    "voxels, residual, before 2D": ["--config=world_voxels", "--encoder.bev=before_2d"],
    "dsvt": ["--config=world_dsvt"],
    "dsvt, before 2D": ["--config=world_dsvt", "--encoder.bev=before_2d"],
}
PUBLISHED = {
    "pillars": ["--config=nuscenes_pillars"],
    "hard pillars": ["--config=nuscenes_hard_pillars"],
    "voxels, plain": ["--config=nuscenes_voxels", "--encoder.voxels.backbone=plain"],
    "voxels, residual": ["--config=nuscenes_voxels"],
    "dsvt": ["--config=nuscenes_dsvt"],
}
"""Options of `pred pretrain` by family."""
SAME = ["--data.split=null", "--data.batch_size=1", "--data.workers=0", "--data.mask_ratio=0.95"]
"""For all: every frame, one a step, loaded in the process whose memory is measured."""
BACKENDS = ("native", "reference")
WINDOW = 20
"""First and last steps whose losses are averaged."""
COMPARED = 2
"""First steps whose losses are compared between the backends: of the initial weights, and after an update. Later ones
part, as of any two runs that differ by rounding (`benchmarks.agreement`): tenfold with each step, to some 1e-3.
"""


def train(options: Sequence[str], run: Path, backend: str) -> dict[str, Any]:
    """Figures of one run in a process of its own."""
    figures = run / "figures.json"
    if figures.is_file():
        done: dict[str, Any] = json.loads(figures.read_text())
        return done
    shutil.rmtree(run, ignore_errors=True)  # of one that was stopped: its memory was not measured
    command = [sys.executable, "-m", "pred", "pretrain", *options, f"--run={run}", "--train.log_every=1"]
    process = subprocess.Popen(command, env=os.environ | {"PRED_BACKEND": backend})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise subprocess.CalledProcessError(process.returncode, command)
    found = {
        "losses": column(run / "log.csv", "loss"),
        "step_s": column(run / "timing.csv", "duration_s"),
        "peak_bytes": 1024 * usage.ru_maxrss,
    }
    write_json(figures, found)
    return found


def column(path: Path, name: str) -> list[float]:
    """A column of a CSV file."""
    with open(path, newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file)]


def encoder_parameters(options: Sequence[str]) -> int:
    """Parameters of the encoder that the options describe."""
    parser = config_parser("encoder_table", "", PretrainConfig)
    config = build(parser, PretrainConfig, parser.parse_args(list(options)))
    return sum(parameter.numel() for parameter in build_model(config).encoder.parameters())


def summarise(parameters: int, runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """A family's row: figures by backend, and how far their first losses are apart."""
    row: dict[str, Any] = {"encoder_parameters": parameters}
    for backend, found in runs.items():
        losses = found["losses"]
        window = min(WINDOW, len(losses) // 2)
        first, last = (statistics.mean(part) for part in (losses[:window], losses[-window:]))
        row[backend] = {
            "first_loss": first,
            "last_loss": last,
            "fall": 1 - last / first,
            # The first step also starts threads and fills caches.
            "step_ms": 1000 * statistics.median(found["step_s"][1:]),
            "peak_mb": found["peak_bytes"] / 1e6,
        }
    if len(runs) == len(BACKENDS):
        pairs = list(zip(*(runs[backend]["losses"][:COMPARED] for backend in BACKENDS), strict=True))
        row["largest_relative_difference"] = max(abs(ours - other) / abs(other) for ours, other in pairs)
        ours, other = (row[backend]["last_loss"] for backend in BACKENDS)
        row["last_relative_difference"] = ours / other - 1
    return row


def markdown(table: Mapping[str, Mapping[str, Any]], steps: int) -> str:
    """The table, one line per family and backend."""
    window = min(WINDOW, steps // 2)
    lines = [
        f"| encoder | parameters | backend | loss, first {window} | last {window} | fall | ms per step | peak MB | "
        f"losses of {min(COMPARED, steps)} steps differ by | last {window} native over reference |",
        "| --- |" + " --- |" * 9,
    ]
    for family, row in table.items():
        at_first, at_last = "–", "–"
        if "largest_relative_difference" in row:
            at_first = f"{row['largest_relative_difference']:.1e}"
            at_last = f"{row['last_relative_difference']:+.2%}"
        for backend in BACKENDS:
            if backend not in row:
                continue
            figures = row[backend]
            lines.append(
                f"| {family} | {row['encoder_parameters'] / 1e6:.3f} M | {backend} | {figures['first_loss']:.3f} | "
                f"{figures['last_loss']:.3f} | {figures['fall']:.1%} | {figures['step_ms']:.0f} | "
                f"{figures['peak_mb']:.0f} | {at_first} | {at_last} |"
            )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Runs what is missing, prints the table and writes it."""
    parser = ArgumentParser(
        "python -m benchmarks.encoder_table", description=(__doc__ or "").partition("\n")[0], allow_abbrev=False
    )
    parser.add_argument("root", type=Path, help="data set in the nuScenes layout: a made world, or a keyframe")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of the table")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--published", action="store_true", help="sizes of the published detectors")
    parser.add_argument("--families", nargs="+", choices=SMALL, help="all by default")
    parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=list(BACKENDS))
    options, pretrain_options = parser.parse_known_args(arguments)
    if options.steps < 2:
        parser.error(f"--steps must be at least 2, got {options.steps}")
    families = PUBLISHED if options.published else SMALL
    chosen = options.families or list(families)
    missing = sorted(set(chosen) - set(families))
    if missing:
        parser.error(f"--families must be of {', '.join(families)} with --published, got {', '.join(missing)}")
    wanted = {
        "root": str(options.root.resolve()),
        "families": families,
        "steps": options.steps,
        "pretrain_options": [*SAME, *pretrain_options],
    }
    with one_writer(options.out):
        claim_settings(options.out / "settings.json", wanted)
        table, runs = {}, {}
        for family in chosen:
            described = [*families[family], *SAME, *pretrain_options]
            steps = [f"--data.root={options.root}", f"--train.steps={options.steps}"]
            parameters = encoder_parameters(described)
            name = family.replace(", ", "-").replace(" ", "-")
            runs[family] = {
                backend: train([*described, *steps], options.out / f"{name}-{backend}", backend)
                for backend in options.backends
            }
            table[family] = summarise(parameters, runs[family])
        text = markdown(table, options.steps)
        record = wanted | {"arguments": list(arguments), "machine": machine_record(), "table": table, "runs": runs}
        write_json(options.out / "encoder_table.json", record)
        (options.out / "encoder_table.md").write_text(text + "\n")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
