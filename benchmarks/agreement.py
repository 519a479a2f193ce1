# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Does a training run on the compiled kernels go where one on the references goes?

``python -m benchmarks.agreement --config nuscenes_tiny --data.root ROOT`` runs the first steps of pre-training with the
references, with the references from initial weights that differ by 1e-7 of themselves, with the compiled kernels, and
with the decoder's products in bfloat16; it compares the mean of every loss term over the last steps. Two runs whose
arithmetic differs by rounding part as any two neighbouring runs do: the spread of the perturbed ones tells how far.

Every run has the same data, rays and schedule. A row of the table agrees where it lies within the larger of its bound
and twice that spread.
"""

from __future__ import annotations

import csv
import json
import os
import sys
import tempfile
from collections.abc import Sequence
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
PERTURBATION, PERTURBED_RUNS = 1e-7, 3
BOUNDS = {"fp32": 0.02, "bf16": 0.05}
TERMS = ("loss", "semantic", "depth", "eikonal")


def run_steps(
    config: PretrainConfig,
    backend: str,
    precision: Literal["fp32", "bf16"] = "fp32",
    perturbation_seed: int | None = None,
) -> dict[str, list[float]]:
    """Loss terms of every step.

    Args:
        config: of the run; its folder, length and log are set here.
        backend: of `PRED_BACKEND`.
        precision: of the decoder.
        perturbation_seed: where given, every initial weight is multiplied by 1 + 1e-7 times a normal number.
    """
    build_model = job.build_model

    def perturbed_model(config: PretrainConfig) -> Any:
        model = build_model(config)
        if perturbation_seed is not None:
            generator = torch.Generator().manual_seed(perturbation_seed)
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


def compare(config: PretrainConfig, last: int = LAST) -> dict[str, Any]:
    """All runs, and a row per term of the means over the last steps."""
    runs = {"reference": run_steps(config, "reference")}
    for seed in range(PERTURBED_RUNS):
        runs[f"perturbed {seed}"] = run_steps(config, "reference", perturbation_seed=seed)
    runs["fp32"] = run_steps(config, "native")
    runs["bf16"] = run_steps(config, "native", "bf16")

    means = {name: {term: sum(run[term][-last:]) / last for term in TERMS} for name, run in runs.items()}
    table = []
    for term in TERMS:
        reference = means["reference"][term]
        spread = max(abs(means[f"perturbed {seed}"][term] / reference - 1) for seed in range(PERTURBED_RUNS))
        row: dict[str, Any] = {"term": term, "reference": reference, "spread": spread}
        for precision, bound in BOUNDS.items():
            difference = means[precision][term] / reference - 1
            row[precision] = {"difference": difference, "bound": max(bound, 2 * spread)}
            row[precision]["agrees"] = abs(difference) <= row[precision]["bound"]
        table.append(row)
    return {"steps": len(runs["reference"]["loss"]), "last": last, "means": means, "table": table}


def main(arguments: Sequence[str]) -> int:
    """Prints the table and writes it, with every run's means, as JSON; 1 where a row does not agree."""
    parser = config_parser("python -m benchmarks.agreement", __doc__ or "", PretrainConfig)
    parser.add_argument("--out", type=str, default="", help="JSON file to write")
    parsed = parser.parse_args([*arguments, f"--train.steps={STEPS}"])
    out = parsed.pop("out")
    found = compare(build(parser, PretrainConfig, parsed))
    print(f"mean of the last {found['last']} of {found['steps']} steps, against the references\n")
    print(f"{'term':10} {'reference':>10} {'spread':>8} {'fp32':>8} {'bound':>7} {'bf16':>8} {'bound':>7}")
    for row in found["table"]:
        cells = [f"{row[kind]['difference']:+8.2%} {row[kind]['bound']:7.2%}" for kind in BOUNDS]
        print(f"{row['term']:10} {row['reference']:10.4f} {row['spread']:8.2%} {' '.join(cells)}")
    if out:
        Path(out).write_text(json.dumps(found | {"machine": machine_record(), "arguments": list(arguments)}, indent=1))
    return 0 if all(row[kind]["agrees"] for row in found["table"] for kind in BOUNDS) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
