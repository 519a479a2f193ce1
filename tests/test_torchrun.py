# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The pre-training job in several processes, started as the README says."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import torch

from pred.checkpoint import load_tensors
from tests.tiny_run import tiny_config, write_config


def test_two_processes_train_one_model(tmp_path: Path) -> None:
    run = tmp_path / "run"
    config = write_config(tmp_path / "config.yaml", tiny_config(run, steps=3))
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", "-m", "pred", "--"]
    done = subprocess.run(
        [*launcher, "pretrain", "--config", str(config), "--run", str(run)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (done.stdout + done.stderr).count("processes: 2") == 1
    with (run / "log.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["1", "2", "3"]
    state = load_tensors(run / "encoder.pth")["model_state"]
    assert all(value.isfinite().all() for value in state.values())
    assert torch.is_tensor(state["backbone_2d.blocks.0.1.weight"])
