# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred label train`: a DeepLabV3-style MobileNetV2 from images and class maps. The loop is `_train`.

OUT/settings.json       the settings; an OUT with others is refused
OUT/checkpoints/        for a run that continues; gone once the network is there
OUT/model.safetensors, config.json, preprocessor_config.json: for `pred label --model OUT` and transformers
OUT/evaluation.json     IoU of each class on unseen scenes
"""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configuration.

import math
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image, ImageEnhance
from rich.console import Console
from rich.table import Table
from torch import Tensor

from pred.checkpoint import atomic_write, load_latest, save_checkpoint
from pred.config import plain
from pred.data.batch import DataConfig, build_source
from pred.data.frame import CLASS_NAMES, NUM_CLASSES, Camera, FrameError, FrameSource
from pred.progress import Progress, format_duration
from pred.random import numpy_generator, seed_of
from pred.run_folder import claim_settings, one_writer, write_json
from pred.segmenter import Segmenter, load_segmenter, require_transformers

IGNORED = 255
COUNTED_IMAGES = 300
"""Label maps from which the class frequencies are estimated."""
WARMUP = 0.1
"""Share of the training in which the learning rate rises."""
BATCH_NORM_MOMENTUM = 0.02
"""The architecture's own, 0.997, would make the last batch the statistics."""
WEIGHTS_FILE = "model.safetensors"


@dataclass
class LabelTrainConfig:
    """What a segmenter is trained on, its sizes and its training. The defaults are for 20 minutes on two cores and
    images of 400 x 225 pixels."""

    out: str = "runs/segmenter"
    """New folder, or one in which the same command was interrupted."""
    data: DataConfig = field(default_factory=DataConfig)
    """Where images and class maps are: dataset, root, version, labels."""
    train_split: str = "train"
    """Split of the scenes to train on."""
    val_split: str = "val"
    """Split of the scenes to measure on."""
    init: str | None = None
    """Checkpoint folder to start from (such as an earlier OUT); None: random weights."""
    width: float = 0.5
    """Width multiplier of the network."""
    output_stride: int = 16
    """Input pixels per output cell: 8 or 16."""
    scale: float = 1.6
    """Images are resized by this factor for the network."""
    crop: tuple[int, int] = (400, 224)
    """Width and height of training crops, pixels after resizing."""
    zoom: tuple[float, float] = (0.8, 1.25)
    """Training crops are enlarged by a random factor of this range."""
    class_balance: float = 0.5
    """Class weights of the loss are frequency to the power of minus this; 0: plain cross-entropy."""
    minutes: float = 20.0
    """Length of the training; ignored where `steps` is given."""
    steps: int | None = None
    """Optimiser steps; None: as many as fit into `minutes`."""
    batch_size: int = 8
    """Crops per step."""
    lr: float = 3e-3
    """Largest learning rate; it rises linearly, then falls as half a cosine."""
    weight_decay: float = 0.01
    """Decoupled weight decay."""
    seed: int = 0
    """Of the initial weights and of all sampling."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        for name in ("width", "scale", "minutes", "lr"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("class_balance", "weight_decay"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if self.output_stride not in (8, 16):
            raise ValueError(f"output_stride must be 8 or 16, got {self.output_stride}")
        if min(self.crop) < 32:
            raise ValueError(f"crop must be at least 32 x 32 pixels, got {self.crop}")
        if not 0 < self.zoom[0] <= self.zoom[1]:
            raise ValueError(f"zoom must be positive and ascending, got {self.zoom}")
        if self.batch_size < 2:
            raise ValueError(f"batch_size must be at least 2, for the batch normalisation, got {self.batch_size}")
        if self.checkpoint_every < 1 or (self.steps is not None and self.steps < 1):
            raise ValueError(
                f"steps and checkpoint_every must be at least 1, got {self.steps}, {self.checkpoint_every}"
            )


class Example(NamedTuple):
    """A batch of crops: images [B, 3, h, w] float32 as the network takes them, classes [B, h, w] int64 or 255."""

    pixel_values: Tensor
    classes: Tensor


def train_segmenter(config: LabelTrainConfig) -> Path:
    """Train, measure and leave the network in ``config.out``; returns that folder.

    A run with ``steps`` that is killed and started again ends in the same bits; one with ``minutes`` keeps its clock.

    Raises:
        FrameError: data or a checkpoint cannot be used.
        RunFolderError: the folder holds other settings, or another process writes to it.
        ValueError: a loss is not finite.
        RuntimeError: transformers is not installed.
    """
    require_transformers()
    out = Path(config.out)
    train_frames = LabelledImages(config, config.train_split)
    val_frames = LabelledImages(config, config.val_split)
    with one_writer(out):
        claim_settings(out / "settings.json", plain(config))
        if (out / WEIGHTS_FILE).is_file() and (out / "evaluation.json").is_file():
            shutil.rmtree(out / "checkpoints", ignore_errors=True)
            print(f"{out}: the network is complete; nothing to do")
        else:
            _train(config, out, train_frames, val_frames)
    return out


def _train(config: LabelTrainConfig, out: Path, train_frames: "LabelledImages", val_frames: "LabelledImages") -> None:
    """The loop."""
    segmenter = build_segmenter(config, train_frames.image_size)
    model = segmenter.model
    # Its output is not used for segmentation, and it costs time.
    spare, model.mobilenet_v2.conv_1x1 = model.mobilenet_v2.conv_1x1, torch.nn.Identity()
    model.to(memory_format=torch.channels_last).requires_grad_(True).train()
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.momentum = BATCH_NORM_MOMENTUM
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.lr, weight_decay=config.weight_decay)
    weights = class_weights(train_frames.class_frequency(), config.class_balance)

    checkpoints = out / "checkpoints"
    latest = load_latest(checkpoints)
    step, elapsed_s = 0, 0.0
    if latest is not None:
        model.load_state_dict(latest.state["model"])
        optimizer.load_state_dict(latest.state["optimizer"])
        step, elapsed_s = latest.state["step"], latest.state["elapsed_s"]

    def share_done() -> float:
        return elapsed_s / (60 * config.minutes) if config.steps is None else step / config.steps

    resumed = f" from step {step}" if step else ""
    print(
        f"{out}: {len(train_frames)} frames{resumed}, network input {segmenter.size}, {torch.get_num_threads()} threads"
    )
    total = config.steps or round(60 * config.minutes)
    start_time = time.monotonic()
    with Progress("step" if config.steps else "second", total, step if config.steps else int(elapsed_s)) as progress:
        for batch in batches(train_frames, config, segmenter, step):
            if share_done() >= 1:
                break
            set_learning_rate(optimizer, config.lr, share_done())
            torch.manual_seed(seed_of(config.seed, step, "dropout"))
            logits = model(pixel_values=batch.pixel_values.contiguous(memory_format=torch.channels_last)).logits
            logits = F.interpolate(logits, size=batch.classes.shape[-2:], mode="bilinear", align_corners=False)
            loss = F.cross_entropy(logits, batch.classes, weights, ignore_index=IGNORED)
            if bool((batch.classes == IGNORED).all()):  # the mean over nothing
                loss = 0 * logits.sum()
            if not math.isfinite(loss.item()):
                raise ValueError(f"label train: loss must be finite, got {loss.item()} in step {step}; lower lr")
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
            optimizer.step()
            step += 1
            now = time.monotonic()
            elapsed_s, start_time = elapsed_s + now - start_time, now
            progress.update(
                min(step if config.steps else int(elapsed_s), total), f"step {step}  loss {loss.item():.3f}"
            )
            if step % config.checkpoint_every == 0:
                state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "elapsed_s": elapsed_s}
                save_checkpoint(checkpoints, step, state, keep_last=2)
    model.mobilenet_v2.conv_1x1 = spare
    model.eval().requires_grad_(False)

    export(segmenter, out)
    measured = evaluate(load_segmenter(str(out)), val_frames)
    facts = {"steps": step, "training_s": round(elapsed_s, 1), "threads": torch.get_num_threads()}
    write_json(out / "evaluation.json", {**measured, **facts})
    shutil.rmtree(checkpoints, ignore_errors=True)
    print_table(
        measured, f"{config.val_split}: {measured['images']} images, {step} steps in {format_duration(elapsed_s)}"
    )


def export(segmenter: Segmenter, out: Path) -> None:
    """Files for `from_pretrained`. Each appears as a whole, the weights last."""
    staging = out / ".export"
    shutil.rmtree(staging, ignore_errors=True)
    segmenter.model.save_pretrained(staging)
    segmenter.processor.save_pretrained(staging)
    for path in sorted(staging.iterdir(), key=lambda path: path.name == WEIGHTS_FILE):
        with atomic_write(out / path.name) as file:
            file.write(path.read_bytes())
    shutil.rmtree(staging)


def build_segmenter(config: LabelTrainConfig, image_size: tuple[int, int]) -> Segmenter:
    """A network with random weights, or those of ``config.init``, and the preprocessing of images of this size."""
    transformers = require_transformers()
    size = (round(config.scale * image_size[0]), round(config.scale * image_size[1]))
    if config.init is not None:
        segmenter = load_segmenter(config.init, size)
        if not isinstance(segmenter.model, transformers.MobileNetV2ForSemanticSegmentation):
            kind = type(segmenter.model).__name__
            raise FrameError(config.init, f"init must be a MobileNetV2ForSemanticSegmentation, got {kind}")
        if segmenter.channels != list(range(NUM_CLASSES)):
            raise FrameError(
                config.init, "init must have its classes in the order of Cityscapes' train ids, got another"
            )
        model = segmenter.model
    else:
        architecture = transformers.MobileNetV2Config(
            depth_multiplier=config.width,
            output_stride=config.output_stride,
            finegrained_output=False,
            tf_padding=False,
            classifier_dropout_prob=0.1,
            id2label=dict(enumerate(CLASS_NAMES)),
            label2id={name: index for index, name in enumerate(CLASS_NAMES)},
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_of(config.seed, "initial weights"))
            model = transformers.MobileNetV2ForSemanticSegmentation(architecture)
    from transformers.models.mobilenet_v2.image_processing_pil_mobilenet_v2 import MobileNetV2ImageProcessorPil

    processor = MobileNetV2ImageProcessorPil(size={"height": size[1], "width": size[0]}, do_center_crop=False)
    return Segmenter(model, processor, list(range(NUM_CLASSES)), size)


class LabelledImages:
    """Images and class maps of a split."""

    def __init__(self, config: LabelTrainConfig, split: str) -> None:
        data = replace(config.data, split=split, sweeps=1, info=None)
        self.source: FrameSource = build_source(data)
        self.where = f"{data.root}, split {split}"
        self._seed = config.seed
        first = self.cameras(0)[0]
        self.image_size = first.width, first.height

    def __len__(self) -> int:
        return len(self.source)

    def cameras(self, index: int) -> list[Camera]:
        """Cameras of a frame that have a class map.

        Raises:
            FrameError: there is none.
        """
        found = [camera for camera in self.source.load(index).cameras if camera.labels is not None]
        if not found:
            raise FrameError(
                self.where, f"frames must have labels (data.labels), got none for {self.source.token(index)}"
            )
        return found

    def draw(self, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """A random image [height, width, 3] and its class map [h, w], 255 where there is no class."""
        cameras = self.cameras(int(rng.integers(len(self))))
        camera = cameras[int(rng.integers(len(cameras)))]
        assert camera.labels is not None
        return camera.load_image(), camera.labels.class_map()

    def class_frequency(self) -> NDArray[np.float64]:
        """[19] share of each class among the labelled cells of some images."""
        rng = numpy_generator(self._seed, "class frequency")
        counts = np.zeros(NUM_CLASSES)
        for _ in range(min(COUNTED_IMAGES, 6 * len(self))):
            counts += np.bincount(self.draw(rng)[1].ravel(), minlength=256)[:NUM_CLASSES]
        if not counts.any():
            raise FrameError(self.where, "class maps must hold classes, got only ignored cells")
        return counts / counts.sum()


def class_weights(frequency: NDArray[np.float64], balance: float) -> Tensor:
    """[19] frequency ** -balance, with a mean of 1 over the cells; classes that were not seen count as the rarest."""
    weight = np.maximum(frequency, frequency[frequency > 0].min()) ** -balance
    return torch.from_numpy(weight / (weight * frequency).sum()).float()


def batches(
    images: LabelledImages, config: LabelTrainConfig, segmenter: Segmenter, first_step: int
) -> Iterator[Example]:
    """Batches of ``first_step`` and later, each a function of the step; the next one is read meanwhile."""
    with ThreadPoolExecutor(1) as reader:
        step = first_step
        upcoming = reader.submit(make_batch, images, config, segmenter, step)
        while True:
            batch = upcoming.result()
            step += 1
            upcoming = reader.submit(make_batch, images, config, segmenter, step)
            yield batch


def make_batch(images: LabelledImages, config: LabelTrainConfig, segmenter: Segmenter, step: int) -> Example:
    """The crops of a step."""
    assert segmenter.size is not None
    mean, std = (np.float32(getattr(segmenter.processor, name)) for name in ("image_mean", "image_std"))
    pictures, maps = [], []
    for place in range(config.batch_size):
        rng = numpy_generator(config.seed, step, place, "crop")
        picture, class_map = random_crop(*images.draw(rng), config, rng)
        scaled = np.asarray(picture, dtype=np.float32) * np.float32(segmenter.processor.rescale_factor)
        pictures.append(((scaled - mean) / std).transpose(2, 0, 1))
        maps.append(class_map)
    return Example(torch.from_numpy(np.stack(pictures)), torch.from_numpy(np.stack(maps).astype(np.int64)))


def random_crop(
    image: NDArray[np.uint8], class_map: NDArray[np.uint8], config: LabelTrainConfig, rng: np.random.Generator
) -> tuple[Image.Image, NDArray[np.uint8]]:
    """A crop of ``config.crop``, flipped by chance and with other colours.

    Half of the crops lie around a cell of a class that is drawn from those in the image: rare ones are small.
    """
    height, width = image.shape[:2]
    enlarged = config.scale * float(rng.uniform(*config.zoom))
    box_width, box_height = min(width, config.crop[0] / enlarged), min(height, config.crop[1] / enlarged)
    centre = rng.uniform(size=2) * (width, height)
    present = np.unique(class_map)
    present = present[present < NUM_CLASSES]
    if len(present) and rng.random() < 0.5:
        rows, columns = np.nonzero(class_map == rng.choice(present))
        cell = rng.integers(len(rows))
        centre = (np.array((columns[cell], rows[cell])) + 0.5) * (width, height) / class_map.shape[::-1]
        centre += rng.uniform(-0.25, 0.25, size=2) * (box_width, box_height)
    left = float(np.clip(centre[0] - box_width / 2, 0, width - box_width))
    top = float(np.clip(centre[1] - box_height / 2, 0, height - box_height))
    box = np.array((left, top, left + box_width, top + box_height))
    map_box = box * np.tile(np.array(class_map.shape[::-1]) / (width, height), 2)

    picture = Image.fromarray(image).resize(config.crop, Image.Resampling.BILINEAR, box=_inside(box, (width, height)))
    classes = Image.fromarray(class_map).resize(
        config.crop, Image.Resampling.NEAREST, box=_inside(map_box, class_map.shape[::-1])
    )
    if rng.random() < 0.5:
        picture, classes = (side.transpose(Image.Transpose.FLIP_LEFT_RIGHT) for side in (picture, classes))
    for change in (ImageEnhance.Brightness, ImageEnhance.Contrast, ImageEnhance.Color):
        picture = change(picture).enhance(float(rng.uniform(0.7, 1.4)))
    return picture, np.asarray(classes)


def _inside(box: NDArray[np.float64], size: tuple[int, ...]) -> tuple[float, float, float, float]:
    """The box without what rounding put outside of the image."""
    left, top, right, bottom = box.tolist()
    return max(left, 0.0), max(top, 0.0), min(right, float(size[0])), min(bottom, float(size[1]))


def set_learning_rate(optimizer: torch.optim.Optimizer, lr: float, share: float) -> None:
    """Rises linearly, then falls as half a cosine."""
    factor = share / WARMUP if share < WARMUP else 0.5 * (1 + math.cos(math.pi * (share - WARMUP) / (1 - WARMUP)))
    for group in optimizer.param_groups:
        group["lr"] = lr * max(factor, 1e-3)


def evaluate(segmenter: Segmenter, images: LabelledImages) -> dict[str, Any]:
    """IoU of each class on all images of a split, and its mean over the classes that occur there."""
    confusion = np.zeros((NUM_CLASSES, NUM_CLASSES), dtype=np.int64)
    num_images = 0
    with Progress("measured frames", len(images)) as progress:
        for index in range(len(images)):
            for camera in images.cameras(index):
                assert camera.labels is not None
                truth = camera.labels.class_map()
                logits = segmenter.logits([camera.load_image()])
                found = F.interpolate(logits, size=truth.shape, mode="bilinear", align_corners=False)[0].argmax(0)
                known = truth < NUM_CLASSES
                pairs = truth[known].astype(np.int64) * NUM_CLASSES + found.cpu().numpy()[known]
                confusion += np.bincount(pairs, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)
                num_images += 1
            progress.advance()
    hit, true = confusion.diagonal(), confusion.sum(axis=1)
    union = true + confusion.sum(axis=0) - hit
    iou = {
        name: float(hit[index] / union[index]) if true[index] else None  # a class that does not occur has none
        for index, name in enumerate(CLASS_NAMES)
    }
    counted = [value for value in iou.values() if value is not None]
    return {
        "miou": float(np.mean(counted)) if counted else None,
        "classes": len(counted),
        "iou": iou,
        "share_of_cells": {name: float(true[index] / max(true.sum(), 1)) for index, name in enumerate(CLASS_NAMES)},
        "pixel_accuracy": float(hit.sum() / max(true.sum(), 1)),
        "images": num_images,
    }


def print_table(measured: dict[str, Any], title: str) -> None:
    table = Table(title=title)
    for column in ("class", "share of cells", "IoU"):
        table.add_column(column, justify="left" if column == "class" else "right")
    for name, iou in measured["iou"].items():
        table.add_row(name, f"{measured['share_of_cells'][name]:.3%}", "-" if iou is None else f"{iou:.3f}")
    table.add_row(f"mean of {measured['classes']}", "", f"{measured['miou'] or 0.0:.3f}")
    Console().print(table)
