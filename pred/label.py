# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred label`: class probabilities of a segmentation network at the pixels that LiDAR returns project to.

ROOT/pseudo/OUT/settings.json       network and preprocessing; an OUT made with others is refused
ROOT/pseudo/OUT/<CAMERA>/<image stem>.npz (ONCE, own data: <recording>/<CAMERA>/<stem>.npz): see docs/labels.md
ROOT/pseudo/OUT/previews/           pictures of some frames
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pred import __version__
from pred.checkpoint import atomic_write, remove_leftovers
from pred.data import soft_labels
from pred.data.batch import DataConfig, build_source
from pred.data.frame import CLASS_NAMES, NUM_CLASSES, Camera, Frame, FrameError, FrameSource
from pred.data.labels import LabelLookup, PseudoLabel, label_cells
from pred.progress import Progress
from pred.run_folder import claim_settings, one_writer
from pred.segmenter import Segmenter, load_segmenter, probabilities_at

PREVIEW_WIDTH = 480
PREVIEWS = "previews"


@dataclass
class LabelConfig:
    """What is labelled, and with which network."""

    model: str = ""
    """Hugging Face hub id or local folder of a segmentation network with the 19 classes of Cityscapes."""
    out: str | None = None
    """Name of the folder under <root>/pseudo/; None: after the model."""
    data: DataConfig = field(default_factory=DataConfig)
    """What is labelled: dataset, root, version, split."""
    batch: int = 6
    """Images that go through the network at once, at most those of one frame."""
    size: tuple[int, int] | None = None
    """Width and height to which images are resized for the network; None: as its preprocessor is configured."""
    previews: int = 3
    """Frames of which a picture is made."""

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError("model must be a hub id or a folder, got none")
        if self.data.root is None:
            raise ValueError("data.root must name the folder of the data set, got None")
        if self.out is not None and (self.out in ("", ".", "..") or Path(self.out).name != self.out):
            raise ValueError(f"out must be a plain name, got {self.out!r}")
        if self.batch < 1:
            raise ValueError(f"batch must be at least 1, got {self.batch}")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"size must be positive, got {self.size}")
        if self.previews < 0:
            raise ValueError(f"previews must be at least 0, got {self.previews}")

    @property
    def folder(self) -> Path:
        """Where labels go."""
        name = self.out or re.sub(
            r"[^\w.-]+", "-", Path(self.model).resolve().name if Path(self.model).exists() else self.model
        )
        return Path(str(self.data.root)) / "pseudo" / name


@dataclass
class Statistics:
    """What the labels of a run say.

    Attributes:
        frames, images, kept: how many; kept are images whose file was there.
        num_bytes: size of all files.
        class_counts: [19] LiDAR pixels of each class.
        confidence: sum of the confidence over these pixels.
    """

    frames: int = 0
    images: int = 0
    kept: int = 0
    num_bytes: int = 0
    class_counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(NUM_CLASSES, dtype=np.int64))
    confidence: float = 0.0

    def add(self, labels: LabelLookup, num_bytes: int) -> None:
        """Count the labels at an image's LiDAR pixels."""
        self.images += 1
        self.num_bytes += num_bytes
        self.class_counts += np.bincount(labels.class_id[labels.class_id >= 0], minlength=NUM_CLASSES)
        self.confidence += float(labels.confidence.sum())

    def lines(self) -> Iterator[str]:
        """The statistics as text."""
        pixels = max(1, int(self.class_counts.sum()))
        kilobytes = self.num_bytes / max(1, self.frames) / 1e3
        yield (
            f"{self.frames:,} frames, {self.images:,} images ({self.kept:,} labelled before), {pixels:,} LiDAR pixels, "
            f"mean confidence {self.confidence / pixels:.3f}, {kilobytes:.1f} kB per frame"
        )
        for index in np.argsort(-self.class_counts, kind="stable"):
            if self.class_counts[index]:
                yield f"  {CLASS_NAMES[index]:<14} {self.class_counts[index] / pixels:8.3%}"


class Task(NamedTuple):
    """An image to label: its LiDAR pixels ``uv`` [N, 2], its file, and the labels there if it is whole."""

    camera: Camera
    uv: NDArray[np.float64]
    path: Path
    labels: LabelLookup | None
    image: NDArray[np.uint8]


def label(config: LabelConfig) -> Statistics:
    """Label all frames of a data set.

    Whole files that are there are kept: a killed run is continued by the same command and ends in the same bytes (same
    machine, torch and threads).

    Raises:
        FrameError: a file of the data set or the checkpoint cannot be used.
        RunFolderError: the folder holds labels that were made otherwise, or another process writes to it.
        RuntimeError: transformers is not installed.
    """
    segmenter = load_segmenter(config.model, config.size)
    # All returns of the keyframe, whatever the later training leaves out.
    source = build_source(replace(config.data, labels="none", sweeps=1, ego_box=(0.0, 0.0, 0.0, 0.0)))
    folder = config.folder
    with one_writer(folder):
        claim_settings(folder / "settings.json", _settings(config, segmenter))
        return _label(config, segmenter, source)


def _label(config: LabelConfig, segmenter: Segmenter, source: FrameSource) -> Statistics:
    folder = config.folder
    segmenter.model.to("cuda" if torch.cuda.is_available() else "cpu")
    shown = set(np.linspace(0, len(source) - 1, min(config.previews, len(source))).round().astype(int).tolist())

    def read(index: int) -> tuple[Frame, list[Task], Path | None]:
        frame = source.load(index)
        preview = folder / PREVIEWS / f"{frame.token}.png" if index in shown else None
        return frame, list(_tasks(frame, config)), None if preview is None or preview.is_file() else preview

    statistics = Statistics()
    with Progress("frame", len(source)) as progress:
        for frame, tasks, preview in _ahead(read, range(len(source))):
            statistics.frames += 1
            missing = [task for task in tasks if task.labels is None]
            statistics.kept += len(tasks) - len(missing)
            logits: list[Tensor] = []
            if missing or preview is not None:
                logits = [scores for chunk in _chunks(tasks, config.batch) for scores in _run(segmenter, config, chunk)]
            found = []
            for place, task in enumerate(tasks):
                labels = task.labels or _write(task, logits[place])
                statistics.add(labels, task.path.stat().st_size)
                found.append(labels)
            if preview is not None:
                preview.parent.mkdir(parents=True, exist_ok=True)
                remove_leftovers(preview)
                picture = _preview(frame.token, tasks, logits, found)
                with atomic_write(preview) as file:
                    picture.save(file, format="PNG")
            progress.advance(f"{len(missing)} images labelled" if missing else "labelled before")
        progress.message(f"labels: {folder}")
        for line in statistics.lines():
            progress.message(line)
    return statistics


def _settings(config: LabelConfig, segmenter: Segmenter) -> dict[str, Any]:
    """What decides the bytes of a label, besides image, points and machine."""
    digest = hashlib.blake2b(digest_size=16)
    for name, tensor in sorted(segmenter.model.state_dict().items()):
        digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    preprocessing = json.dumps(segmenter.processor.to_dict(), sort_keys=True, default=str)
    return {
        "model": config.model,
        "weights": digest.hexdigest(),
        "preprocessing": hashlib.blake2b(preprocessing.encode(), digest_size=16).hexdigest(),
        "size": config.size,
        "batch": config.batch,
        "undistort": config.data.undistort if config.data.dataset == "once" else None,
        "made_by": f"pred {__version__}",
    }


def _tasks(frame: Frame, config: LabelConfig) -> Iterator[Task]:
    returns = frame.points[frame.is_keyframe, :3].astype(np.float64)
    for camera in frame.cameras:
        if camera.image is None:
            raise FrameError(frame.source, f"images must be there to be labelled, got none of {camera.name}")
        uv, z_depth_m = camera.project(returns)
        uv = uv[camera.in_image(uv, z_depth_m)]
        path = config.folder / label_name(config.data.dataset, frame, camera)
        yield Task(camera, uv, path, _existing(path, camera, uv), camera.load_image())


def label_name(dataset: str, frame: Frame, camera: Camera) -> Path:
    """Where the readers look for the label of an image, below the folder of labels."""
    if dataset == "nuscenes":
        assert isinstance(camera.image, Path)
        return Path(camera.name) / f"{camera.image.stem}.npz"
    recording, _, stem = frame.token.rpartition("_" if dataset == "once" else "/")
    return Path(recording) / camera.name / f"{stem}.npz"


def _existing(path: Path, camera: Camera, uv: NDArray[np.float64]) -> LabelLookup | None:
    if not path.is_file():
        return None
    try:
        labels = PseudoLabel(path, camera.width, camera.height).lookup(uv)
    except FrameError:
        return None  # damaged: made anew
    return labels if (labels.class_id >= 0).all() else None


def _ahead(read: Any, indices: Iterable[int]) -> Iterator[Any]:
    """Results of ``read`` in order; the next one is read while the last is worked on."""
    with ThreadPoolExecutor(1) as reader:
        upcoming = None
        for index in indices:
            previous, upcoming = upcoming, reader.submit(read, index)
            if previous is not None:
                yield previous.result()
        if upcoming is not None:
            yield upcoming.result()


def _chunks(tasks: list[Task], batch: int) -> Iterator[list[Task]]:
    """Neighbours of one image size, at most ``batch``. A batch never depends on what is labelled already: sums in
    another batch may round otherwise."""
    chunk: list[Task] = []
    for task in tasks:
        if chunk and (len(chunk) == batch or chunk[0].image.shape != task.image.shape):
            yield chunk
            chunk = []
        chunk.append(task)
    if chunk:
        yield chunk


def _run(segmenter: Segmenter, config: LabelConfig, chunk: list[Task]) -> list[Tensor]:
    try:
        return list(segmenter.logits([task.image for task in chunk]))
    except ValueError as error:
        raise FrameError(config.model, str(error)) from None


def _write(task: Task, logits: Tensor) -> LabelLookup:
    """Store the probabilities at the LiDAR pixels, and read them back."""
    shape = task.camera.height, task.camera.width
    row, column = label_cells(task.uv, shape, shape)
    cells = np.unique(row * shape[1] + column)
    probabilities = probabilities_at(logits, cells // shape[1], cells % shape[1], shape)
    task.path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(task.path)
    with atomic_write(task.path) as file:
        file.write(soft_labels.to_bytes(shape, cells, probabilities))
    return PseudoLabel(task.path, task.camera.width, task.camera.height).lookup(task.uv)


def _preview(token: str, tasks: list[Task], logits: list[Tensor], found: list[LabelLookup]) -> Image.Image:
    """For each camera the image beside the image mixed with class colours; dots where labels are stored."""
    from pred.view import CLASS_COLOURS, class_colours, class_legend, draw_points, page

    rows, present = [], np.zeros(0, dtype=np.int64)
    for task, scores, labels in zip(tasks, logits, found, strict=True):
        size = PREVIEW_WIDTH, max(1, round(PREVIEW_WIDTH * task.camera.height / task.camera.width))
        image = Image.fromarray(task.image).resize(size)
        dense = F.interpolate(scores[None], size=size[::-1], mode="bilinear", align_corners=False)[0]
        classes = dense.argmax(0).cpu().numpy().astype(np.uint8)
        mixed = Image.blend(image, Image.fromarray(class_colours(classes)), 0.6)
        dots = image.copy()
        draw_points(dots, task.uv * (size[0] / task.camera.width), CLASS_COLOURS[labels.class_id])
        name = task.camera.name
        rows.append([(name, image), ("classes", mixed), (f"{len(task.uv)} stored LiDAR pixels", dots)])
        present = np.union1d(present, classes)
    return page(token, rows, [class_legend(present)], "")
