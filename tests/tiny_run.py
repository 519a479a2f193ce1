# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A pre-training run of a second or two on a tiny world, shared by the tests of the jobs."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from pred.data.batch import DataConfig
from pred.data.world.nuscenes_writer import WorldSettings
from pred.models.encoders import BEVBackboneConfig, EncoderConfig, PillarConfig
from pred.models.field import FieldConfig
from pred.models.renderer import RendererConfig
from pred.pretrain import PretrainConfig, TrainConfig
from pred.world import make_world

POINT_RANGE = (-25.6, -25.6, -3.0, 25.6, 25.6, 3.0)
WORLD = WorldSettings(scenes=1, keyframes=2, image_scale=0.04, exact_labels=True)


@cache
def _world_folder() -> tempfile.TemporaryDirectory[str]:
    folder = tempfile.TemporaryDirectory(prefix="pred_tiny_world_")
    make_world(Path(folder.name), WORLD, workers=1)
    return folder


def tiny_world() -> Path:
    """Root of two keyframes of a drive, made once per process and gone with it. Nobody may change it."""
    return Path(_world_folder().name)


def tiny_config(run: Path, **train: Any) -> PretrainConfig:
    return PretrainConfig(
        run=str(run),
        point_range=POINT_RANGE,
        data=DataConfig(
            root=str(tiny_world()),
            sweeps=1,
            batch_size=1,
            mask_ratio=0.8,
            semantic_rays_per_camera=8,
            depth_rays=48,
            workers=0,
        ),
        encoder=EncoderConfig(
            pillars=PillarConfig(pillar_size=(0.8, 0.8), vfe_filters=[8]),
            backbone_2d=BEVBackboneConfig(
                layer_nums=[1], layer_strides=[1], num_filters=[8], upsample_strides=[1], num_upsample_filters=[8]
            ),
        ),
        field=FieldConfig(hidden=16, layers=3),
        renderer=RendererConfig(coarse_samples=8, fine_samples=8),
        train=TrainConfig(**{"steps": 12, "log_every": 1, "checkpoint_every": 3, "accelerator": "cpu", **train}),
    )


def write_config(path: Path, config: PretrainConfig, **top: Any) -> Path:
    from pred.config import plain

    path.write_text(yaml.safe_dump(plain(config) | top))
    return path
