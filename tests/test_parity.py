# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""One training step on the compiled kernels against the same step on the references, in float32."""

from __future__ import annotations

from pathlib import Path

import pytest
from torch import Tensor

from pred.config import build, config_parser
from pred.data.batch import TrainingBatches
from pred.pretrain import PretrainConfig, build_model
from tests.tiny_run import tiny_world


def losses_and_gradients(
    config: PretrainConfig, backend: str, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """The first step of a run: same weights, masks, rays and random numbers for either backend."""
    monkeypatch.setenv("PRED_BACKEND", backend)
    model = build_model(config)
    batch = TrainingBatches(config.data, config.point_range, config.train.seed, total_steps=1)[0]
    output = model(batch)
    output.loss.backward()
    losses = {name: float(term) for name, term in output.terms.items()} | {"total": float(output.loss.detach())}
    gradients = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    return losses, gradients


def check(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    parser = config_parser("parity", "", PretrainConfig)
    config = build(parser, PretrainConfig, parser.parse_args(arguments))
    losses, gradients = losses_and_gradients(config, "native", monkeypatch)
    expected_losses, expected_gradients = losses_and_gradients(config, "reference", monkeypatch)
    assert set(losses) == {"semantic", "depth", "eikonal", "total"} and losses["semantic"] > 0
    for name, expected_loss in expected_losses.items():
        assert losses[name] == pytest.approx(expected_loss, rel=1e-4), name
    assert gradients.keys() == expected_gradients.keys() and len(gradients) > 20
    largest = max(float(gradient.norm()) for gradient in expected_gradients.values())
    for name, expected in expected_gradients.items():
        error = float((gradients[name] - expected).norm())
        assert error <= 1e-3 * max(float(expected.norm()), 1e-3 * largest), name


FAMILIES = {
    "hard pillars": ["--config=world_pillars", "--encoder.pillars.max_points=20"],
    "voxels": ["--config=world_voxels"],
    "plain voxels, before 2D": [
        "--config=world_voxels", "--encoder.voxels.backbone=plain", "--encoder.voxels.max_points=null",
        "--encoder.bev=before_2d",
    ],
    "dsvt": ["--config=world_dsvt"],
}  # fmt: skip


@pytest.mark.parametrize("family", ["pillars", *FAMILIES])
def test_step_on_a_made_world(family: str, native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    options = FAMILIES.get(family, ["--config=world_pillars"])
    check([*options, f"--data.root={tiny_world()}", "--data.workers=0"], monkeypatch)


@pytest.mark.parametrize("family", ["pillars", *FAMILIES])
def test_step_on_the_real_keyframe(
    family: str, native: None, nuscenes_tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = FAMILIES.get(family, ["--config=nuscenes_tiny"])
    check([*options, f"--data.root={nuscenes_tiny}", "--data.split=null", "--data.workers=0"], monkeypatch)
