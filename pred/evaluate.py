# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred evaluate rendering RUN`: depth and semantics of returns that training never touched.

A fixed share of the keyframe returns is neither input nor target of any training step (`pred.data.masking`). The
network sees the 5 % of a fixed mask and renders the rays towards the held-out returns: from the LiDAR for depth, from
the cameras for semantics. Beside it stand the untrained network of the same seed, and "range of the visible point that
is nearest in angle", which needs no learning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table
from torch import Tensor

from pred.data.batch import Batch, build_source, evaluation_batch
from pred.data.frame import CLASS_NAMES, NUM_CLASSES, Frame, FrameError, FrameSource
from pred.models.pretrainer import Pretrainer
from pred.pretrain import PretrainConfig, build_model, load_model, pick_device
from pred.progress import Progress
from pred.run_folder import RunFolder, environment, write_json

RAYS_PER_PRODUCT = 4096
"""Rows of the ray-to-point cosine matrix that are held at once."""


@dataclass
class Scores:
    """Sums over frames of one network's renderings.

    Attributes:
        depth_errors_m: one array of absolute errors per frame.
        opacity_sum: of the depth rays.
        predictions: [19, 20] camera rays by pseudo label and rendered class; column 19 counts rays that see nothing.
    """

    depth_errors_m: list[NDArray[np.float32]] = field(default_factory=list)
    opacity_sum: float = 0.0
    predictions: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((NUM_CLASSES, NUM_CLASSES + 1), dtype=np.int64)
    )

    def summary(self) -> dict[str, Any]:
        """Plain values; None where there was nothing to measure."""
        errors = _joined(self.depth_errors_m)
        rays_by_class = self.predictions.sum(axis=1)
        correct = self.predictions.diagonal()
        present = np.flatnonzero(rays_by_class)
        return {
            **error_summary(errors),
            "opacity_mean": self.opacity_sum / len(errors) if len(errors) else None,
            "semantic_accuracy": float(correct.sum() / rays_by_class.sum()) if len(present) else None,
            "semantic_accuracy_by_class": {CLASS_NAMES[k]: float(correct[k] / rays_by_class[k]) for k in present},
        }


def evaluate_rendering(
    config: PretrainConfig, run: Path, checkpoint: Path | None = None, max_frames: int | None = None
) -> dict[str, Any]:
    """Measure a run on held-out returns, print a table and write RUN/evaluation_rendering.json.

    Args:
        config: the run's configuration; its data set is evaluated.
        run: run folder.
        checkpoint: file to use; the run's latest by default.
        max_frames: evaluate only the first ones.

    Returns:
        What the file holds: plain values, errors in metres.

    Raises:
        RunFolderError, CheckpointError, FrameError, ValueError: something is missing or damaged; the text names it.
    """
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"evaluate: frames must be at least 1, got {max_frames}")
    folder = RunFolder(run)
    folder.require()
    source = build_source(config.data)
    device = pick_device(config.train)
    trained, checkpoint = load_model(config, folder, checkpoint)
    networks = {"trained": trained.to(device), "untrained": build_model(config).eval().to(device)}
    scores = {name: Scores() for name in networks}
    baseline_errors_m: list[NDArray[np.float32]] = []
    skipped: dict[str, str] = {}

    num_frames = min(len(source), max_frames or len(source))
    with Progress("evaluated frame", num_frames) as progress:
        for frame in load_frames(source, num_frames, config.data.on_error == "skip", skipped):
            batch = evaluation_batch(
                frame, config.data, config.point_range, config.train.seed, config.renderer.near_m
            ).to(device)
            for name, network in networks.items():
                add_scores(scores[name], network, batch)
            rays = batch.depth
            nearest_m = range_of_nearest_visible(batch.points[:, :3], rays.directions[0])
            baseline_errors_m.append(_kept((nearest_m - rays.depth_m[0]).abs(), rays.valid[0]))
            progress.advance()

    baseline = error_summary(_joined(baseline_errors_m))
    result: dict[str, Any] = {
        "checkpoint": str(checkpoint),
        "frames": num_frames - len(skipped),
        "skipped": skipped,
        "depth_rays": len(_joined(baseline_errors_m)),
        "semantic_rays": int(scores["trained"].predictions.sum()),
        "semantic_rays_by_class": {
            CLASS_NAMES[k]: int(count) for k, count in enumerate(scores["trained"].predictions.sum(axis=1)) if count
        },
        **{name: score.summary() for name, score in scores.items()},
        "nearest_visible": baseline,
        "environment": environment(),
    }
    for name in networks:
        result[name]["depth_mean_over_nearest_visible"] = _ratio(result[name]["depth_mean_m"], baseline["depth_mean_m"])
    write_json(folder.path / "evaluation_rendering.json", result)
    progress.console.print(results_table(result))
    progress.message(f"written: {folder.path / 'evaluation_rendering.json'}")
    return result


def load_frames(source: FrameSource, num_frames: int, skip_broken: bool, skipped: dict[str, str]) -> Iterator[Frame]:
    """The first frames of a source; broken ones raise, or are left out and noted in ``skipped``."""
    for index in range(num_frames):
        try:
            yield source.load(index)
        except FrameError as error:
            if not skip_broken:
                raise
            skipped[source.token(index)] = str(error)


@torch.no_grad()
def add_scores(scores: Scores, network: Pretrainer, batch: Batch) -> None:
    """Render a batch of one frame and add its errors and hits."""
    bev = network.encode(batch.points, batch.point_offsets)
    rays = batch.depth
    view = network.render(bev, rays.origins, rays.directions)
    scores.depth_errors_m.append(_kept((view.depth_m - rays.depth_m)[0].abs(), rays.valid[0]))
    scores.opacity_sum += float(view.opacity[rays.valid].sum())
    if batch.semantic is not None:
        pixels = batch.semantic
        view = network.render(bev, pixels.origins, pixels.directions)
        rendered = torch.where(view.opacity > 0, view.semantics.argmax(-1), NUM_CLASSES)
        expected = pixels.target.argmax(-1)
        pairs = (expected * (NUM_CLASSES + 1) + rendered)[pixels.valid]
        counts = torch.bincount(pairs, minlength=NUM_CLASSES * (NUM_CLASSES + 1))
        scores.predictions += counts.cpu().numpy().reshape(NUM_CLASSES, NUM_CLASSES + 1)


def range_of_nearest_visible(
    points: Tensor,  # [N, 3] metres, LiDAR frame
    directions: Tensor,  # [R, 3] unit
) -> Tensor:  # [R] metres
    """Range of the point whose direction from the LiDAR is nearest to each ray's; NaN without points."""
    if len(points) == 0:
        return points.new_full((len(directions),), torch.nan)
    # float64: the cosine of a small angle is close to 1.
    range_m = points.double().norm(dim=1)
    point_directions = points.double() / range_m.clamp_min(1e-9)[:, None]
    nearest = [(part.double() @ point_directions.T).argmax(dim=1) for part in directions.split(RAYS_PER_PRODUCT)]
    return range_m[torch.cat(nearest)].to(points.dtype) if len(directions) else points.new_empty(0)


def error_summary(errors_m: NDArray[np.float32]) -> dict[str, float | None]:
    """Median and mean of absolute depth errors; None without any."""
    if len(errors_m) == 0:
        return {"depth_median_m": None, "depth_mean_m": None}
    return {"depth_median_m": float(np.median(errors_m)), "depth_mean_m": float(errors_m.mean(dtype=np.float64))}


def results_table(result: dict[str, Any]) -> Table:
    """The figures side by side: trained, untrained, nearest visible point."""
    table = Table(
        title=f"{result['frames']} frame(s), {result['depth_rays']} depth rays, {result['semantic_rays']} camera rays"
    )
    for column in ("held-out returns", "trained", "untrained", "nearest visible"):
        table.add_column(column, justify="left" if column.startswith("held") else "right")
    columns = [result[name] for name in ("trained", "untrained", "nearest_visible")]
    for label, key, unit in (
        ("median absolute depth error", "depth_median_m", " m"),
        ("mean absolute depth error", "depth_mean_m", " m"),
        ("... / nearest visible", "depth_mean_over_nearest_visible", ""),
        ("mean opacity", "opacity_mean", ""),
    ):
        table.add_row(label, *(_number(column.get(key), unit) for column in columns))
    table.add_row("semantic accuracy", *(_percent(column.get("semantic_accuracy")) for column in columns))
    table.add_section()
    for name, count in result["semantic_rays_by_class"].items():
        shares = (column.get("semantic_accuracy_by_class", {}).get(name) for column in columns)
        table.add_row(f"  {name} ({count})", *map(_percent, shares))
    return table


def _kept(values: Tensor, valid: Tensor) -> NDArray[np.float32]:
    kept: NDArray[np.float32] = values[valid].float().cpu().numpy()
    return kept


def _joined(arrays: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate([np.zeros(0, np.float32), *arrays])


def _ratio(value: float | None, base: float | None) -> float | None:
    return value / base if value is not None and base else None


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3f}{unit}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
