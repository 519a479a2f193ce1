# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Every family of encoders pre-trains with 95 % of the points hidden, on kernels and references alike."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pred.encoder_file import load_encoder
from pred.models.encoders import BEVBackboneConfig, DSVTConfig, EncoderConfig, PillarConfig, VoxelConfig
from pred.pretrain import build_model, load_model, pretrain
from pred.run_folder import RunFolder
from tests.tiny_run import tiny_config

PILLARS = PillarConfig(pillar_size=(0.8, 0.8), vfe_filters=[8, 16])
VOXELS = VoxelConfig(voxel_size=(0.4, 0.4, 0.25))
DSVT = DSVTConfig(d_model=16, num_heads=2, ffn_channels=32, num_blocks=2, set_size=16, window=(8, 8))
BEV = BEVBackboneConfig(
    layer_nums=[1], layer_strides=[1], num_filters=[16], upsample_strides=[1], num_upsample_filters=[16]
)
FAMILIES = {
    "hard pillars": EncoderConfig(pillars=replace(PILLARS, max_points=8, max_pillars=(400, 400)), backbone_2d=BEV),
    "voxels": EncoderConfig("voxels", voxels=VOXELS, backbone_2d=replace(BEV, upsample_strides=[2])),
    "plain voxels before 2D": EncoderConfig(
        "voxels", bev="before_2d", voxels=replace(VOXELS, backbone="plain", max_points=None)
    ),
    "dsvt": EncoderConfig("dsvt", pillars=PILLARS, dsvt=DSVT, backbone_2d=replace(BEV, kind="residual")),
    "dsvt before 2D": EncoderConfig("dsvt", bev="before_2d", pillars=PILLARS, dsvt=DSVT),
}


def train(run: Path, encoder: EncoderConfig, **train: Any) -> list[float]:
    """Losses of all steps."""
    config = tiny_config(run, checkpoint_every=1000, **train)
    pretrain(replace(config, data=replace(config.data, mask_ratio=0.95), encoder=encoder))
    with open(run / "log.csv") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


@pytest.mark.parametrize("family", FAMILIES)
def test_training_lowers_the_loss_and_the_run_is_complete(family: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    losses = train(run, FAMILIES[family], steps=40, lr=1e-2)
    assert len(losses) == 40 and sum(losses[-10:]) < 0.8 * sum(losses[:10])
    config = replace(tiny_config(run), encoder=FAMILIES[family])
    network, _ = load_model(config, RunFolder(run))
    other = build_model(config).encoder
    load_encoder(other, run / "encoder.pth")
    read = other.state_dict()
    for name, value in network.encoder.state_dict().items():
        assert torch.equal(value, read[name]) and value.isfinite().all(), name


@pytest.mark.parametrize("family", FAMILIES)
def test_first_steps_are_equal_on_kernels_and_references(
    family: str, tmp_path: Path, native: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses = {}
    for backend in ("native", "reference"):
        monkeypatch.setenv("PRED_BACKEND", backend)
        losses[backend] = train(tmp_path / backend, FAMILIES[family], steps=3)
    # From the second step on, weights differ by what Adam makes of the rounding of near-zero gradients.
    assert losses["native"] == pytest.approx(losses["reference"], rel=1e-4)


def test_bf16_mixed(tmp_path: Path) -> None:
    """The backbones in bfloat16 train as in float32, to its two digits."""
    for family in ("voxels", "dsvt"):
        full = train(tmp_path / f"{family} 32", FAMILIES[family], steps=3)
        mixed = train(tmp_path / f"{family} 16", FAMILIES[family], steps=3, precision="bf16-mixed")
        assert mixed == pytest.approx(full, rel=0.02) and mixed != full
