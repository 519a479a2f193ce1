# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Does a training run on the compiled kernels go where one on the references goes?

``python -m benchmarks.agreement --config nuscenes_tiny --data.root ROOT`` runs the first steps of pre-training with the
references, with the compiled kernels, and with the decoder's products in bfloat16: each from the same initial weights
and from some that differ by 1e-7 of themselves, with the same data, rays and schedule. Runs whose arithmetic differs by
rounding part as any two neighbouring runs do; how far, the spread of the references' runs tells. Of every loss term the
mean over the last steps of a contender's runs is compared with that of the references.

A cell agrees where it lies within its bound: 2 % or, if that is more, twice the spread for float32, 5 % for bfloat16.
"""

from __future__ import annotations

import csv
import json
import os
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import torch

from benchmarks.measure import machine_record
from pred import pretrain as job
from pred.config import build, config_parser
from pred.pretrain import PretrainConfig

STEPS, LAST = 300, 50
PERTURBATION, RUNS = 1e-7, 4
CONTENDERS: dict[str, tuple[str, Literal["fp32", "bf16"]]] = {
    "reference": ("reference", "fp32"),
    "fp32": ("native", "fp32"),
    "bf16": ("native", "bf16"),
}
"""Backend and the decoder's precision."""
TERMS = ("loss", "semantic", "depth", "eikonal")


def run_steps(
    config: PretrainConfig, backend: str, precision: Literal["fp32", "bf16"], number: int
) -> dict[str, list[float]]:
    """Loss terms of every step.

    Args:
        config: of the run; its folder and log are set here.
        backend: of `PRED_BACKEND`.
        precision: of the decoder.
        number: from 1 on, every initial weight is multiplied by 1 + 1e-7 times a normal number, other ones per number.
    """
    build_model = job.build_model

    def perturbed_model(config: PretrainConfig) -> Any:
        model = build_model(config)
        if number > 0:
            generator = torch.Generator().manual_seed(number)
            with torch.no_grad():
                for parameter in model.parameters():
                    parameter.mul_(1 + PERTURBATION * torch.randn(parameter.shape, generator=generator))
        return model

    with tempfile.TemporaryDirectory() as folder:
        config = replace(
            config,
            run=f"{folder}/run",
            train=replace(config.train, log_every=1, accelerator="cpu"),
            field=replace(config.field, precision=precision),
        )
        with mock.patch.object(job, "build_model", perturbed_model), mock.patch.dict(os.environ, PRED_BACKEND=backend):
            job.pretrain(config)
        with open(f"{folder}/run/log.csv", newline="") as file:
            rows = list(csv.DictReader(file))
    return {term: [float(row[term]) for row in rows] for term in TERMS}


def compare(config: PretrainConfig, last: int = LAST, runs: int = RUNS) -> dict[str, Any]:
    """The means of every run over the last steps, and a row per term."""
    means: dict[str, dict[str, list[float]]] = {name: {term: [] for term in TERMS} for name in CONTENDERS}
    for name, (backend, precision) in CONTENDERS.items():
        for number in range(runs):
            for term, values in run_steps(config, backend, precision, number).items():
                means[name][term].append(statistics.mean(values[-last:]))
    return {"steps": config.train.steps, "last": last, "runs": runs, "means": means, "table": tabulate(means)}


def tabulate(means: Mapping[str, Mapping[str, Sequence[float]]]) -> list[dict[str, Any]]:
    """A row per term."""
    table = []
    for term in means["reference"]:
        first, reference = means["reference"][term][0], statistics.mean(means["reference"][term])
        spread = max(abs(value / first - 1) for value in means["reference"][term])
        row: dict[str, Any] = {"term": term, "reference": reference, "spread": spread}
        for name, bound in (("fp32", max(0.02, 2 * spread)), ("bf16", 0.05)):
            difference = statistics.mean(means[name][term]) / reference - 1
            row[name] = {"difference": difference, "bound": bound, "agrees": abs(difference) <= bound}
        table.append(row)
    return table


def main(arguments: Sequence[str]) -> int:
    """Prints the table and writes it, with every run's means, as JSON; 1 where a row does not agree."""
    parser = config_parser("python -m benchmarks.agreement", __doc__ or "", PretrainConfig)
    parser.add_argument("--out", type=str, default="", help="JSON file to write")
    parser.add_argument("--steps", type=int, default=STEPS, help="of every run")
    parser.add_argument("--last", type=int, default=LAST, help="steps at a run's end that are compared")
    parser.add_argument("--runs", type=int, default=RUNS, help="of each contender, with neighbouring initial weights")
    parsed = parser.parse_args(list(arguments))
    out, steps, last, runs = (parsed.pop(name) for name in ("out", "steps", "last", "runs"))
    if not 1 <= last <= steps or runs < 2:
        parser.error(f"--last must be 1 to --steps, --runs at least 2, got {last}, {steps} and {runs}")
    config = build(parser, PretrainConfig, parsed)
    found = compare(replace(config, train=replace(config.train, steps=steps)), last, runs)
    print(f"means of the last {found['last']} of {found['steps']} steps, of {found['runs']} runs each\n")
    print(f"{'term':10} {'reference':>10} {'spread':>8} {'fp32':>8} {'bound':>7} {'bf16':>8} {'bound':>7}")
    for row in found["table"]:
        cells = [f"{row[kind]['difference']:+8.2%} {row[kind]['bound']:7.2%}" for kind in ("fp32", "bf16")]
        print(f"{row['term']:10} {row['reference']:10.4f} {row['spread']:8.2%} {' '.join(cells)}")
    if out:
        Path(out).write_text(json.dumps(found | {"machine": machine_record(), "arguments": list(arguments)}, indent=1))
    return 0 if all(row[kind]["agrees"] for row in found["table"] for kind in ("fp32", "bf16")) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
