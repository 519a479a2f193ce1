# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A pre-training run of a second or two on the procedural street, shared by the tests of the jobs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pred.data.batch import DataConfig
from pred.data.world import StreetConfig
from pred.models.encoders.pillars import PillarEncoderConfig
from pred.models.field import FieldConfig
from pred.models.renderer import RendererConfig
from pred.pretrain import PretrainConfig, TrainConfig

POINT_RANGE = (-25.6, -25.6, -3.0, 25.6, 25.6, 3.0)


def tiny_config(run: Path, **train: Any) -> PretrainConfig:
    return PretrainConfig(
        run=str(run),
        point_range=POINT_RANGE,
        data=DataConfig(
            dataset="street",
            batch_size=1,
            mask_ratio=0.8,
            semantic_rays_per_camera=8,
            depth_rays=48,
            workers=0,
            street=StreetConfig(frames=2, frames_per_street=2, image_width=64, image_height=36),
        ),
        encoder=PillarEncoderConfig(
            pillar_size=(0.8, 0.8),
            vfe_filters=[8],
            layer_nums=[1],
            layer_strides=[1],
            num_filters=[8],
            upsample_strides=[1],
            num_upsample_filters=[8],
        ),
        field=FieldConfig(hidden=16, layers=3),
        renderer=RendererConfig(coarse_samples=8, fine_samples=8),
        train=TrainConfig(**{"steps": 12, "log_every": 1, "checkpoint_every": 3, "accelerator": "cpu", **train}),
    )


def write_config(path: Path, config: PretrainConfig, **top: Any) -> Path:
    from pred.config import plain

    path.write_text(yaml.safe_dump(plain(config) | top))
    return path
