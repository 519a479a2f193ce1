# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred evaluate probe RUN`: what a linear classifier can read from the frozen encoder.

For every cell of the bird's-eye-view (BEV) map, a linear classifier tells from the encoder's features the class that
most of the keyframe's returns in the cell have. It is fitted on the frames of one split and measured on another; the
encoder sees whole scans, as in fine-tuning. Beside the trained encoder stands the untrained one of the same seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from rich.table import Table
from torch import Tensor

from pred.data.batch import PointRange, build_source
from pred.data.frame import Frame, FrameError, FrameSource, inside_range, outside_ego_box
from pred.data.lidarseg import MERGED_NAMES, NUM_MERGED, merged_classes
from pred.data.rays import draw_class_balanced
from pred.evaluate import Confusion, SpreadFrames, load_frames, percent, tokens_of, trained_tokens
from pred.models.pretrainer import Pretrainer
from pred.pretrain import (
    RECALIBRATION_BATCHES,
    PretrainConfig,
    build_model,
    load_model,
    pick_device,
    recalibrate_batch_norm,
)
from pred.progress import Progress
from pred.random import numpy_generator
from pred.run_folder import RunFolder, environment, write_json

WEIGHT_DECAY = 1e-4
"""Weight of half the squared norm of the classifier's weights beside the mean cross-entropy."""
GRADIENT_TOLERANCE = 1e-5
"""The fit ends where no derivative is larger."""
MAX_ITERATIONS = 1000


class Cells(NamedTuple):
    """Cells of a BEV map [H, W] whose class is known.

    Attributes:
        row, column: [n] int64 (row = y, column = x).
        merged: [n] int64 index of `MERGED_NAMES`.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    merged: NDArray[np.int64]


@dataclass
class Probe:
    """A linear classifier of standardised features.

    Attributes:
        mean, std: [C] of the features that it was fitted on; features that never changed have std 1.
        weight: [K, C].
        bias: [K].
        iterations: steps that the fit took.
        converged: it ended at the tolerance.
    """

    mean: Tensor
    std: Tensor
    weight: Tensor
    bias: Tensor
    iterations: int
    converged: bool

    def predict(
        self,
        features: Tensor,  # [n, C]
    ) -> Tensor:  # [n] int64
        """The most probable class of each row."""
        return F.linear((features - self.mean) / self.std, self.weight, self.bias).argmax(dim=1)


def evaluate_probe(
    config: PretrainConfig,
    run: Path,
    checkpoint: Path | None = None,
    train_split: str = "train",
    val_split: str = "val",
    cells_per_frame: int = 512,
    max_frames: int | None = None,
) -> dict[str, Any]:
    """Fit and measure the probe of a run, print a table and write RUN/evaluation_probe.json.

    Memory: the features of ``cells_per_frame`` cells of each frame of ``train_split``, at most 24 bytes for each number
    (two networks in float32, and copies of one at a time).

    Args:
        config: the run's configuration; its data set must know the classes of points.
        run: run folder.
        checkpoint: file to use; the run's latest by default.
        train_split, val_split: the probe is fitted on the first and measured on the second.
        cells_per_frame: cells drawn from each frame of ``train_split``, balanced by class; of ``val_split`` all count.
        max_frames: use only so many frames of each split, spread evenly.

    Returns:
        What the file holds, plain values.

    Raises:
        RunFolderError, CheckpointError, FrameError, ValueError: something is missing or damaged; the text names it.
    """
    for name, number in (("cells-per-frame", cells_per_frame), ("frames", max_frames)):
        if number is not None and number < 1:
            raise ValueError(f"evaluate probe: {name} must be at least 1, got {number}")
    if config.data.dataset != "nuscenes" or config.data.info is not None:
        got = f"{config.data.dataset} with data.info {config.data.info}"
        raise ValueError(f"evaluate probe: data.dataset must be nuscenes, with splits, got {got}")
    folder = RunFolder(run)
    folder.require()
    every = {split: _split_source(config, split) for split in (train_split, val_split)}
    val_tokens = tokens_of(every[val_split])
    if shared := len(tokens_of(every[train_split]) & val_tokens):
        raise ValueError(
            f"evaluate probe: train-split and val-split must have no frame in common, got {shared} in both "
            f"{train_split} and {val_split}"
        )
    sources = {split: _ClassedFrames(source, max_frames) for split, source in every.items()}
    device = pick_device(config.train)
    trained, checkpoint = load_model(config, folder, checkpoint)
    networks = {"trained": trained.to(device), "untrained": build_model(config).eval().to(device)}
    skipped: dict[str, str] = {}

    def frames(split: str, label: str) -> Iterator[Frame]:
        source = sources[split]
        with Progress(label, len(source)) as progress:
            for frame in load_frames(source, config.data.on_error == "skip", skipped):
                yield frame
                progress.advance()

    some = SpreadFrames(sources[train_split], RECALIBRATION_BATCHES)
    for network in networks.values():
        usable = load_frames(some, config.data.on_error == "skip", skipped)
        recalibrate_batch_norm(network, (whole_scan(frame, config, device) for frame in usable))
    features: dict[str, list[Tensor]] = {name: [] for name in networks}
    classes: list[NDArray[np.int64]] = []
    for frame in frames(train_split, f"{train_split} frame"):
        points, offsets = whole_scan(frame, config, device)
        cells: Cells | None = None
        for name, network in networks.items():
            bev = encode(network, points, offsets)
            if cells is None:
                cells = draw_cells(
                    labelled_cells(frame, config.point_range, config.data.own_car, bev.shape[1:]),
                    cells_per_frame,
                    numpy_generator(config.train.seed, frame.token, "probe cells"),
                )
                classes.append(cells.merged)
            features[name].append(features_at(bev, cells))
    if not any(map(len, classes)):
        because = next((f"; {reason}" for reason in skipped.values()), "")
        raise ValueError(f"evaluate probe: split {train_split} must have cells of known class, got none{because}")
    merged = torch.from_numpy(np.concatenate(classes)).to(device)
    probes = {name: fit_probe(torch.cat(parts), merged) for name, parts in features.items()}
    features.clear()

    num_val_frames = 0
    confusions = {name: Confusion() for name in networks}
    for frame in frames(val_split, f"{val_split} frame"):
        points, offsets = whole_scan(frame, config, device)
        for name, network in networks.items():
            bev = encode(network, points, offsets)
            cells = labelled_cells(frame, config.point_range, config.data.own_car, bev.shape[1:])
            predicted = probes[name].predict(features_at(bev, cells))
            confusions[name].add(cells.merged, predicted.cpu().numpy())
        num_val_frames += 1

    train_counts = np.bincount(merged.cpu().numpy(), minlength=NUM_MERGED)
    result: dict[str, Any] = {
        "checkpoint": str(checkpoint),
        "root": config.data.root,
        "train_split": train_split,
        "val_split": val_split,
        # Nobody knows which frames imported weights have seen.
        "val_frames_encoder_trained_on": None
        if folder.is_imported()
        else len(val_tokens & trained_tokens(folder, config.data)),
        "cells_per_frame": cells_per_frame,
        "train_frames": len(classes),
        "val_frames": num_val_frames,
        "skipped": skipped,
        "train_cells_by_class": {MERGED_NAMES[k]: int(count) for k, count in enumerate(train_counts) if count},
        "val_cells_by_class": confusions["trained"].count_by_class(),
        **{
            name: {
                **confusion.summary(),
                "iterations": probes[name].iterations,
                "converged": probes[name].converged,
            }
            for name, confusion in confusions.items()
        },
        "environment": environment(),
    }
    write_json(folder.path / "evaluation_probe.json", result)
    with Progress("", 1, enabled=False) as progress:
        progress.console.print(probe_table(result))
        progress.message(f"written: {folder.path / 'evaluation_probe.json'}")
    return result


class _ClassedFrames(SpreadFrames):
    """Frames that must have classes of their points."""

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        if frame.semantics is None:
            raise FrameError(frame.source, "frame must have classes of its points (lidarseg.json), got none")
        return frame


def _split_source(config: PretrainConfig, split: str) -> FrameSource:
    """Frames of a split with point classes and without labels of images."""
    data = replace(config.data, split=split, labels="none", image_depth=None, depth_filter=None)
    return build_source(data, point_classes=True)


def whole_scan(frame: Frame, config: PretrainConfig, device: torch.device) -> tuple[Tensor, Tensor]:
    """Points [N, 5] of a frame without the own car's returns, nothing hidden, and their offsets [2]."""
    seen = frame.points[~frame.is_keyframe | outside_ego_box(frame.points, config.data.own_car)]
    return torch.from_numpy(seen).to(device), torch.tensor([0, len(seen)], device=device)


@torch.no_grad()
def encode(network: Pretrainer, points: Tensor, offsets: Tensor) -> Tensor:
    """BEV map [C, H, W] of one frame."""
    return network.encode(points, offsets)[0]


def labelled_cells(
    frame: Frame, point_range: PointRange, ego_box: tuple[float, ...], map_size: tuple[int, ...]
) -> Cells:
    """Cells of a map [H, W] of the range that hold returns of the keyframe with a class: the class of most of them.

    Where classes tie, the later of `MERGED_NAMES`, which has the smaller objects, wins.
    """
    assert frame.semantics is not None
    num_rows, num_columns = map_size
    used = frame.is_keyframe & outside_ego_box(frame.points, ego_box) & inside_range(frame.points, point_range)
    merged = merged_classes(frame.semantics[used])
    x_min, y_min, _, x_max, y_max, _ = point_range
    xy = frame.points[used, :2].astype(np.float64)
    column = ((xy[:, 0] - x_min) / (x_max - x_min) * num_columns).astype(np.int64).clip(0, num_columns - 1)
    row = ((xy[:, 1] - y_min) / (y_max - y_min) * num_rows).astype(np.int64).clip(0, num_rows - 1)
    known = merged >= 0
    pairs = ((row * num_columns + column) * NUM_MERGED + merged)[known]
    counts = np.bincount(pairs, minlength=num_rows * num_columns * NUM_MERGED).reshape(-1, NUM_MERGED)
    cell = np.flatnonzero(counts.any(axis=1))
    last_of_most = NUM_MERGED - 1 - counts[cell, ::-1].argmax(axis=1)
    return Cells(cell // num_columns, cell % num_columns, last_of_most)


def draw_cells(cells: Cells, num_cells: int, rng: np.random.Generator) -> Cells:
    """So many cells without replacement, each weighted by 1 / count of its class; all of them if there are no more."""
    if len(cells.merged) <= num_cells:
        return cells
    chosen = draw_class_balanced(cells.merged, np.bincount(cells.merged, minlength=NUM_MERGED), num_cells, rng)
    return Cells._make(column[chosen] for column in cells)


def features_at(
    bev: Tensor,  # [C, H, W]
    cells: Cells,
) -> Tensor:  # [n, C]
    """Features of cells."""
    return bev[:, torch.from_numpy(cells.row).to(bev.device), torch.from_numpy(cells.column).to(bev.device)].T


def fit_probe(
    features: Tensor,  # [n, C]
    classes: Tensor,  # [n] int64 below NUM_MERGED
) -> Probe:
    """Multinomial logistic regression with weight decay, by L-BFGS over all rows at once.

    The problem is convex and starts from zero: the result depends on the rows alone.
    """
    std, mean = torch.std_mean(features, dim=0, correction=0)
    std = torch.where(std > 0, std, 1.0)
    # In float32 the line search stalls before the tolerance.
    rows = ((features - mean) / std).double()
    weight = torch.zeros(NUM_MERGED, rows.shape[1], dtype=rows.dtype, device=rows.device, requires_grad=True)
    bias = torch.zeros(NUM_MERGED, dtype=rows.dtype, device=rows.device, requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [weight, bias],
        max_iter=MAX_ITERATIONS,
        tolerance_grad=GRADIENT_TOLERANCE,
        tolerance_change=0.0,
        line_search_fn="strong_wolfe",
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        total = F.cross_entropy(F.linear(rows, weight, bias), classes) + 0.5 * WEIGHT_DECAY * weight.square().sum()
        total.backward()
        return total

    optimizer.step(loss)
    loss()
    assert weight.grad is not None and bias.grad is not None
    steepest = max(float(weight.grad.abs().max()), float(bias.grad.abs().max()))
    return Probe(
        mean=mean,
        std=std,
        weight=weight.detach().to(features.dtype),
        bias=bias.detach().to(features.dtype),
        iterations=int(optimizer.state[weight]["n_iter"]),
        converged=steepest <= GRADIENT_TOLERANCE,
    )


def probe_table(result: dict[str, Any]) -> Table:
    """IoU of each class and the means, trained beside untrained."""
    table = Table(
        title=f"linear probe: {result['train_frames']} {result['train_split']} frame(s), "
        f"{result['val_frames']} {result['val_split']} frame(s)"
    )
    for column in ("BEV cells", "trained", "untrained"):
        table.add_column(column, justify="left" if column == "BEV cells" else "right")
    columns = [result["trained"], result["untrained"]]
    for label, key in (("mIoU", "miou"), ("accuracy", "accuracy"), ("mean over classes", "mean_class_accuracy")):
        table.add_row(label, *(percent(column[key]) for column in columns))
    table.add_section()
    for name, count in result["val_cells_by_class"].items():
        table.add_row(f"  IoU {name} ({count})", *(percent(column["iou_by_class"][name]) for column in columns))
    return table
