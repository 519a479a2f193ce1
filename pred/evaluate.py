# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred evaluate rendering RUN`: depth and semantics of returns that training never touched.

A fixed share of the keyframe returns is neither input nor target of any training step (`pred.data.masking`). The
network sees the 5 % of a fixed mask and renders the rays towards the held-out returns: from the LiDAR for depth, from
the cameras for semantics. Beside it stand the untrained network of the same seed, and "range of the visible point that
is nearest in angle", which needs no learning.

Where the data set knows the exact classes of its returns, the semantics rendered along the ray from the LiDAR are
compared with them; beside them stands the label of the pixel that the return projects to.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from rich.table import Table
from torch import Tensor

from pred.data.batch import Batch, DataConfig, build_source, evaluation_batch, evaluation_rows
from pred.data.frame import CLASS_NAMES, NUM_CLASSES, Frame, FrameError, FrameSource
from pred.data.lidarseg import MERGED_NAMES, NO_CLASS, NUM_MERGED, merged_classes
from pred.data.rays import DepthTolerance, depths_agree
from pred.models.pretrainer import Pretrainer
from pred.pretrain import PretrainConfig, build_model, load_model, pick_device
from pred.progress import Progress
from pred.run_folder import RunFolder, environment, write_json

RAYS_PER_PRODUCT = 4096
"""Rows of the ray-to-point cosine matrix that are held at once."""

OCCLUSION_TOLERANCE: DepthTolerance = (0.5, 0.02)
"""(metres, share of the image's depth): a pixel that is nearer than its return by more shows another surface."""


class Returns(NamedTuple):
    """Returns of one frame whose class is known, and what their pixels show.

    A return that several cameras see counts for the first of them.

    Attributes:
        merged: [R] int64 index of `MERGED_NAMES`; -1: no class, left out everywhere.
        in_image: [R] bool, in the picture of a camera with a pseudo label.
        projected: [R] int64 merged class of the label at its pixel; -1: none of these classes, or no label.
        occluded: [R] bool, its pixel shows a nearer surface; None without depth maps.
    """

    merged: NDArray[np.int64]
    in_image: NDArray[np.bool_]
    projected: NDArray[np.int64]
    occluded: NDArray[np.bool_] | None

    def groups(self) -> dict[str, NDArray[np.bool_]]:
        """The sets of returns that are measured: name to [R] mask."""
        masks = {"all": np.ones(len(self.merged), dtype=bool), "in_image": self.in_image}
        return masks if self.occluded is None else {**masks, "occluded": self.occluded}


class Confusion:
    """Counts [10, 11] of true merged class by predicted one; the last column is "none of these"."""

    def __init__(self) -> None:
        self.counts = np.zeros((NUM_MERGED, NUM_MERGED + 1), dtype=np.int64)

    def add(self, true: NDArray[np.int64], predicted: NDArray[np.int64]) -> None:
        """Count pairs of merged classes [N]; -1 as prediction is none, as true class it is left out."""
        known = true >= 0
        column = np.where(predicted < 0, NUM_MERGED, predicted)
        pairs = (true * (NUM_MERGED + 1) + column)[known]
        self.counts += np.bincount(pairs, minlength=self.counts.size).reshape(self.counts.shape)

    def count_by_class(self) -> dict[str, int]:
        """Number of true members of each class that occurs."""
        return {MERGED_NAMES[k]: int(count) for k, count in enumerate(self.counts.sum(axis=1)) if count}

    def summary(self) -> dict[str, Any]:
        """Accuracy, and means over the classes that occur of recall and of intersection over union; None of nothing."""
        truths, hits = self.counts.sum(axis=1), self.counts.diagonal()
        unions = truths + self.counts.sum(axis=0)[:NUM_MERGED] - hits
        present = np.flatnonzero(truths)
        accuracies = {MERGED_NAMES[k]: float(hits[k] / truths[k]) for k in present}
        ious = {MERGED_NAMES[k]: float(hits[k] / unions[k]) for k in present}
        return {
            "accuracy": float(hits.sum() / truths.sum()) if len(present) else None,
            "mean_class_accuracy": float(np.mean(list(accuracies.values()))) if len(present) else None,
            "miou": float(np.mean(list(ious.values()))) if len(present) else None,
            "accuracy_by_class": accuracies,
            "iou_by_class": ious,
        }


@dataclass
class Scores:
    """Sums over frames of one network's renderings.

    Attributes:
        depth_errors_m: one array of absolute errors per frame.
        opacity_sum: of the depth rays.
        predictions: [19, 20] camera rays by pseudo label and rendered class; column 19 counts rays that see nothing.
        returns: true and rendered class of returns, along the ray from the LiDAR, for each set of `Returns.groups`.
    """

    depth_errors_m: list[NDArray[np.float32]] = field(default_factory=list)
    opacity_sum: float = 0.0
    predictions: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((NUM_CLASSES, NUM_CLASSES + 1), dtype=np.int64)
    )
    returns: dict[str, Confusion] = field(default_factory=lambda: defaultdict(Confusion))

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
            "returns": {group: confusion.summary() for group, confusion in self.returns.items()},
        }


def evaluate_rendering(
    config: PretrainConfig,
    run: Path,
    checkpoint: Path | None = None,
    max_frames: int | None = None,
    all_returns: bool = False,
) -> dict[str, Any]:
    """Measure a run on held-out returns, print a table and write RUN/evaluation_rendering.json.

    Args:
        config: the run's configuration; its data set is evaluated.
        run: run folder.
        checkpoint: file to use; the run's latest by default.
        max_frames: evaluate only so many frames, evenly spread.
        all_returns: aim at every keyframe return that the encoder does not see, held out or not: for frames that
            training never used.

    Returns:
        What the file holds: plain values, errors in metres.

    Raises:
        RunFolderError, CheckpointError, FrameError, ValueError: something is missing or damaged; the text names it.
    """
    if max_frames is not None and max_frames < 1:
        raise ValueError(f"evaluate: frames must be at least 1, got {max_frames}")
    folder = RunFolder(run)
    folder.require()
    source = SpreadFrames(build_source(config.data, point_classes=True), max_frames)
    # Nobody knows which frames imported weights have seen.
    trained_on = None if folder.is_imported() else len(tokens_of(source) & trained_tokens(folder, config.data))
    if all_returns and trained_on:
        raise ValueError(
            "evaluate: all_returns must go with frames that the run was not trained on, got "
            f"{trained_on} of {len(source)} that it was; name others, such as --data.split val"
        )
    device = pick_device(config.train)
    trained, checkpoint = load_model(config, folder, checkpoint)
    networks = {"trained": trained.to(device), "untrained": build_model(config).eval().to(device)}
    scores = {name: Scores() for name in networks}
    baseline_errors_m: list[NDArray[np.float32]] = []
    projected: dict[str, Confusion] = defaultdict(Confusion)
    skipped: dict[str, str] = {}

    with Progress("evaluated frame", len(source)) as progress:
        for frame in load_frames(source, config.data.on_error == "skip", skipped):
            seed, near_m = config.train.seed, config.renderer.near_m
            rows = evaluation_rows(frame, config.data, config.point_range, seed, near_m, all_returns)
            batch = evaluation_batch(frame, config.data, config.point_range, seed, near_m, rows).to(device)
            returns = returns_of(frame, rows.returns)
            for name, network in networks.items():
                add_scores(scores[name], network, batch, returns)
            if returns is not None:
                for group, mask in returns.groups().items():
                    if group != "all":  # a return in no picture has no pixel
                        projected[group].add(returns.merged[mask], returns.projected[mask])
            rays = batch.depth
            nearest_m = range_of_nearest_visible(batch.points[:, :3], rays.directions[0])
            baseline_errors_m.append(_kept((nearest_m - rays.depth_m[0]).abs(), rays.valid[0]))
            progress.advance()

    baseline = error_summary(_joined(baseline_errors_m))
    result: dict[str, Any] = {
        "checkpoint": str(checkpoint),
        "root": config.data.root,
        "split": config.data.split,
        "frames_trained_on": trained_on,
        "frames": len(source) - len(skipped),
        "skipped": skipped,
        "all_returns": all_returns,
        "depth_rays": len(_joined(baseline_errors_m)),
        "semantic_rays": int(scores["trained"].predictions.sum()),
        "semantic_rays_by_class": {
            CLASS_NAMES[k]: int(count) for k, count in enumerate(scores["trained"].predictions.sum(axis=1)) if count
        },
        "returns_by_class": {
            group: confusion.count_by_class() for group, confusion in scores["trained"].returns.items()
        },
        **{name: score.summary() for name, score in scores.items()},
        "nearest_visible": baseline,
        "projected_label": {"returns": {group: confusion.summary() for group, confusion in projected.items()}},
        "environment": environment(),
    }
    for name in networks:
        result[name]["depth_mean_over_nearest_visible"] = _ratio(result[name]["depth_mean_m"], baseline["depth_mean_m"])
    write_json(folder.path / "evaluation_rendering.json", result)
    progress.console.print(results_table(result))
    if result["returns_by_class"]:
        progress.console.print(returns_table(result))
    progress.message(f"written: {folder.path / 'evaluation_rendering.json'}")
    return result


def tokens_of(source: FrameSource) -> set[str]:
    """Identities of all frames of a source."""
    return {source.token(index) for index in range(len(source))}


def trained_tokens(folder: RunFolder, data: DataConfig) -> set[str]:
    """Identities of the frames that a run's own configuration names, as far as they may be frames of ``data``.

    Where the run's root is gone, its split is looked for under that of ``data``: the data set may have been moved.
    """
    own = DataConfig(**yaml.safe_load(folder.config.read_text())["data"])
    own = replace(own, labels="none", sweeps=1, image_depth=None, depth_filter=None)
    assert data.root is not None
    if own.root is None or own.dataset != data.dataset:  # imported weights may know no data set
        return set()
    if not Path(own.root).is_dir():
        try:
            return tokens_of(build_source(replace(own, root=data.root, version=data.version)))
        except (FrameError, ValueError):  # another data set, without such a split
            return set()
    # Frames of nuScenes have names of their own; those of other layouts repeat from one root to the next.
    if own.dataset != "nuscenes" and Path(own.root).resolve() != Path(data.root).resolve():
        return set()
    return tokens_of(build_source(own))


class SpreadFrames:
    """At most ``num_frames`` frames of a source, evenly spread; all of them if that is None."""

    def __init__(self, source: FrameSource, num_frames: int | None) -> None:
        self._source = source
        chosen = min(len(source), num_frames or len(source))
        self._rows = [position * len(source) // chosen for position in range(chosen)]

    def __len__(self) -> int:
        return len(self._rows)

    def token(self, index: int) -> str:
        return self._source.token(self._rows[index])

    def load(self, index: int) -> Frame:
        return self._source.load(self._rows[index])


def load_frames(source: FrameSource, skip_broken: bool, skipped: dict[str, str]) -> Iterator[Frame]:
    """Frames of a source; broken ones raise, or are left out and noted in ``skipped``."""
    for index in range(len(source)):
        try:
            yield source.load(index)
        except FrameError as error:
            if not skip_broken:
                raise
            skipped[source.token(index)] = str(error)


def returns_of(frame: Frame, rows: NDArray[np.int64]) -> Returns | None:
    """What is known about the returns ``frame.points[rows]``; None where the frame knows no exact classes.

    Raises:
        FrameError: a pseudo label or a depth map cannot be used.
    """
    if frame.semantics is None:
        return None
    cameras = [camera for camera in frame.cameras if camera.labels is not None]
    in_image = np.zeros(len(rows), dtype=bool)
    class_id = np.full(len(rows), NO_CLASS, dtype=np.int64)
    occluded = np.zeros(len(rows), dtype=bool)
    for camera in cameras:
        assert camera.labels is not None
        uv, z_depth_m = camera.project(frame.points[rows, :3])
        new = np.flatnonzero(camera.in_image(uv, z_depth_m) & ~in_image)
        in_image[new] = True
        labels = camera.labels.lookup(uv[new]).class_id
        class_id[new] = np.where(labels < 0, NO_CLASS, labels)
        if camera.depth is not None:
            occluded[new] = shows_nearer_surface(z_depth_m[new], camera.depth_at(uv[new]))
    has_depth = len(cameras) > 0 and all(camera.depth is not None for camera in cameras)
    return Returns(
        merged=merged_classes(frame.semantics[rows]),
        in_image=in_image,
        projected=merged_classes(class_id),
        occluded=occluded if has_depth else None,
    )


def shows_nearer_surface(
    z_depth_m: NDArray[np.float64],  # [N]
    image_depth_m: NDArray[np.float64],  # [N], NaN: none
) -> NDArray[np.bool_]:
    """[N] mask of returns whose pixel shows a surface before them, by more than `OCCLUSION_TOLERANCE`."""
    return (z_depth_m > image_depth_m) & ~depths_agree(z_depth_m, image_depth_m, OCCLUSION_TOLERANCE)


@torch.no_grad()
def add_scores(scores: Scores, network: Pretrainer, batch: Batch, returns: Returns | None = None) -> None:
    """Render a batch of one frame and add its errors and hits.

    Args:
        returns: those that the batch's depth rays aim at, in their order.
    """
    bev = network.encode(batch.points, batch.point_offsets)
    rays = batch.depth
    view = network.render(bev, rays.origins, rays.directions)
    scores.depth_errors_m.append(_kept((view.depth_m - rays.depth_m)[0].abs(), rays.valid[0]))
    scores.opacity_sum += float(view.opacity[rays.valid].sum())
    if returns is not None:
        class_id = torch.where(view.opacity > 0, view.semantics.argmax(-1), NO_CLASS)[rays.valid]
        merged = merged_classes(class_id.cpu().numpy())
        for group, mask in returns.groups().items():
            scores.returns[group].add(returns.merged[mask], merged[mask])
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
    table.add_column(_kind_of_returns(result))
    for column in ("trained", "untrained", "nearest visible"):
        table.add_column(column, justify="right")
    columns = [result[name] for name in ("trained", "untrained", "nearest_visible")]
    for label, key, unit in (
        ("median absolute depth error", "depth_median_m", " m"),
        ("mean absolute depth error", "depth_mean_m", " m"),
        ("... / nearest visible", "depth_mean_over_nearest_visible", ""),
        ("mean opacity", "opacity_mean", ""),
    ):
        table.add_row(label, *(_number(column.get(key), unit) for column in columns))
    table.add_row("semantic accuracy", *(percent(column.get("semantic_accuracy")) for column in columns))
    table.add_section()
    for name, count in result["semantic_rays_by_class"].items():
        shares = (column.get("semantic_accuracy_by_class", {}).get(name) for column in columns)
        table.add_row(f"  {name} ({count})", *map(percent, shares))
    return table


def returns_table(result: dict[str, Any]) -> Table:
    """Semantics along the ray from the LiDAR against the true class: trained, untrained, label of the pixel."""
    table = Table(title="class along the ray from the LiDAR, against the true one")
    table.add_column(_kind_of_returns(result))
    for column in ("trained", "untrained", "projected label"):
        table.add_column(column, justify="right")
    for group, counts in result["returns_by_class"].items():
        figures = [result[name]["returns"].get(group, {}) for name in ("trained", "untrained", "projected_label")]
        table.add_section()
        for label, key in (("accuracy", "accuracy"), ("mean over classes", "mean_class_accuracy"), ("mIoU", "miou")):
            name = f"{group.replace('_', ' ')} ({sum(counts.values())}): {label}" if key == "accuracy" else f"  {label}"
            table.add_row(name, *(percent(figure.get(key)) for figure in figures))
    return table


def _kind_of_returns(result: dict[str, Any]) -> str:
    return "unseen returns" if result["all_returns"] else "held-out returns"


def _kept(values: Tensor, valid: Tensor) -> NDArray[np.float32]:
    kept: NDArray[np.float32] = values[valid].float().cpu().numpy()
    return kept


def _joined(arrays: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate([np.zeros(0, np.float32), *arrays])


def _ratio(value: float | None, base: float | None) -> float | None:
    return value / base if value is not None and base else None


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3f}{unit}"


def percent(share: float | None) -> str:
    """For a table; a dash for nothing."""
    return "-" if share is None else f"{100 * share:.1f} %"
