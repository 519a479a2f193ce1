# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred pretrain`: from a drive log to encoder weights. The training loop is `pretrain`, read it from top to bottom."""

# No `from __future__ import annotations`: jsonargparse reads the field types of the configurations.

import dataclasses
import hashlib
import math
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers import TensorBoardLogger
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm
from torch.optim import AdamW, Optimizer

from pred import __version__
from pred.checkpoint import (
    CheckpointError,
    LatestCheckpoint,
    list_checkpoints,
    load_latest,
    load_tensors,
    save_checkpoint,
)
from pred.config import flatten, plain, to_yaml
from pred.data.batch import Batch, DataConfig, PointRange, TrainingBatches, build_source, make_loader
from pred.data.frame import NUM_CLASSES, FrameSource
from pred.encoder_file import encoder_facts, load_encoder, write_encoder
from pred.losses import LossConfig
from pred.models.encoders import EncoderConfig
from pred.models.field import FieldConfig
from pred.models.pretrainer import Pretrainer, PretrainOutput
from pred.models.renderer import RendererConfig
from pred.progress import Progress
from pred.random import seed_of
from pred.run_folder import CsvLog, RunFolder

FREE_KEYS = {
    "run", "init_encoder", "data.root", "data.info", "data.workers", "train.accelerator", "train.log_every",
    "train.checkpoint_every", "train.keep_checkpoints",
}  # fmt: skip
"""Keys that a resumed run may change: they leave its bits alone, or lie with the user (accelerator). Files may move;
that they still name the same frames is checked by `frames_digest`. A checkpoint needs no initial weights any more."""

DIGEST_FRAMES = 1000
"""Enough to tell any two splits apart, and quick for a million frames."""

RECALIBRATION_BATCHES = 16
"""Batches whose average makes the final batch normalisation statistics; 4 and 64 were found to do as well."""

ATTENTION_IN_PROJ = ("in_proj_weight", "in_proj_bias")
"""Parameters of attention that project to queries, keys and values, as `torch.nn.MultiheadAttention` names them."""


@dataclass
class TrainConfig:
    """Length, optimiser, precision, logging. The paper gives AdamW, one-cycle, 3e-4 and 45 epochs; the rest is the
    recipe of the detectors whose encoders are trained here."""

    epochs: float = 45.0
    """Passes over the data set; ignored where `steps` is given."""
    steps: int | None = None
    """Optimiser steps; None: epochs x frames / (batch size x processes)."""
    lr: float = 3e-4
    """Largest learning rate of the one-cycle schedule."""
    weight_decay: float = 0.01
    """Decoupled weight decay of every parameter."""
    warmup_fraction: float = 0.4
    """Share of the steps in which the learning rate rises."""
    initial_lr_divisor: float = 10.0
    """The schedule starts at lr / this."""
    final_lr_divisor: float = 1e4
    """The schedule ends at its start / this."""
    momentum_range: tuple[float, float] = (0.85, 0.95)
    """AdamW's beta1: the second value at the ends of the schedule, the first where the learning rate peaks."""
    beta2: float = 0.99
    """AdamW's beta2."""
    attention_in_proj: Literal["train", "freeze"] = "train"
    """freeze: query, key and value projections of attention stay at their initial values, as OpenPCDet's and DSVT's
    adam_onecycle leaves them (docs/optimiser.md)."""
    grad_clip: float = 35.0
    """Largest norm of the gradient of all parameters together."""
    seed: int = 0
    """Of the initial weights and of all sampling."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """bf16-mixed: the encoder's backbones in bfloat16, all else in float32."""
    deterministic: bool = True
    """Use only algorithms that repeat bit for bit (needed for an exact resume on CUDA)."""
    accelerator: str = "auto"
    """Lightning Fabric: auto, cpu, cuda. One device per process; torchrun starts several."""
    log_every: int = 10
    """Steps between rows of log.csv, timing.csv and TensorBoard."""
    checkpoint_every: int = 250
    """Steps between checkpoints; one more is written at the end."""
    keep_checkpoints: int = 3
    """Checkpoints kept."""

    def __post_init__(self) -> None:
        for name in ("log_every", "checkpoint_every", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise ValueError(f"train.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("lr", "epochs", "grad_clip"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"train.{name} must be positive, got {getattr(self, name)}")
        for name in ("initial_lr_divisor", "final_lr_divisor"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"train.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("warmup_fraction", "beta2"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"train.{name} must be between 0 and 1, got {getattr(self, name)}")
        if not 0 <= self.momentum_range[0] <= self.momentum_range[1] < 1:
            raise ValueError(f"train.momentum_range must be ascending and in [0, 1), got {self.momentum_range}")
        if not self.weight_decay >= 0:
            raise ValueError(f"train.weight_decay must be at least 0, got {self.weight_decay}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"train.steps must be at least 1, got {self.steps}")


@dataclass
class PretrainConfig:
    """Everything that decides a pre-training run."""

    run: str | None = None
    """Run folder, which must be new; None: runs/pretrain-<date>-<time>."""
    point_range: PointRange = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
    """Range box (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame."""
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    """What is read, what is hidden from the encoder, and how many rays are drawn."""
    encoder: EncoderConfig = dataclasses.field(default_factory=EncoderConfig)
    """Family and sizes of the encoder."""
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    """Sizes of the decoder from BEV features to signed distance and semantics."""
    renderer: RendererConfig = dataclasses.field(default_factory=RendererConfig)
    """Sampling and compositing along a ray."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    """Weights of the loss terms."""
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    """Length, optimiser, precision, logging."""
    init_encoder: str | None = None
    """Checkpoint whose encoder the training starts from: RUN/encoder.pth, or a file of OpenPCDet, DSVT or
    mmdetection3d. Every tensor must fit. None: random weights."""

    def __post_init__(self) -> None:
        lower, upper = self.point_range[:3], self.point_range[3:]
        if not all(low < high for low, high in zip(lower, upper, strict=True)):
            raise ValueError(
                f"point_range must be (x_min, y_min, z_min, x_max, y_max, z_max) in metres, got {self.point_range}"
            )
        if self.field.num_classes != NUM_CLASSES:
            raise ValueError(f"field.num_classes must be the labels' {NUM_CLASSES}, got {self.field.num_classes}")
        if self.train.attention_in_proj == "freeze" and self.encoder.kind != "dsvt":
            raise ValueError("train.attention_in_proj must be train for an encoder without attention, got freeze")


class NonFiniteLossError(RuntimeError):
    """A loss term or the gradient became NaN or infinite. The weights were not touched by that step."""


def pretrain(config: PretrainConfig, resume: bool = False) -> Path:
    """Train an encoder and leave it in the run folder; returns that folder.

    Args:
        config: the run; see the field documentation.
        resume: continue the run in ``config.run`` from its latest checkpoint, to the same bits as without a break
            (same machine, torch, threads and backend).

    Raises:
        RunFolderError: the run folder is in use, or there is nothing to resume.
        CheckpointError: every checkpoint is damaged, or the configuration is not that of the checkpoint.
        NonFiniteLossError: naming step, frames and term.
        FrameError: a data file is broken, and ``data.on_error`` is "raise".
        SystemExit: after Ctrl-C or SIGTERM, once a checkpoint is written.
    """
    train = config.train
    fabric = launch_fabric(train)
    folder = RunFolder(Path(config.run or f"runs/pretrain-{time.strftime('%Y%m%d-%H%M%S')}"))
    # Before anything is written: a data set that cannot be read should not leave a run folder behind.
    source = build_source(config.data)
    total_steps = train.steps or math.ceil(train.epochs * len(source) / (config.data.batch_size * fabric.world_size))
    batches = TrainingBatches(
        config.data,
        config.point_range,
        train.seed,
        total_steps,
        fabric.global_rank,
        fabric.world_size,
        source,
        config.renderer.near_m,
    )
    model = build_model(config)
    initial = None
    if config.init_encoder is not None and not (resume and list_checkpoints(folder.checkpoints)):
        initial = load_encoder(model.encoder, Path(config.init_encoder), config=config)
    digest = frames_digest(source)

    latest = None
    if fabric.is_global_zero:
        if resume:
            folder.require()
        else:
            folder.start(to_yaml(config))
    if resume:
        latest = latest_checkpoint(folder, config, total_steps, digest)
    first_step, skipped_frames = 0, 0
    if latest is not None:
        model.load_state_dict(latest.state["model"])
        first_step, skipped_frames = latest.state["step"], latest.state["skipped_frames"]
    if fabric.is_global_zero:
        facts = {
            "seed": train.seed,
            "frames": len(source),
            "steps": total_steps,
            "parameters": sum(parameter.numel() for parameter in model.parameters()),
            **({"init_encoder": initial} if initial is not None else {}),
        }
        folder.record_start(facts, first_step if resume else None)

    model, optimizer = fabric.setup(model, build_optimizer(model, train))
    if latest is not None:
        optimizer.load_state_dict(latest.state["optimizer"])

    def save(step: int) -> None:
        if fabric.is_global_zero:
            logs.sync()
            state = {
                "model": model.state_dict(),
                "optimizer": optimizer.state_dict(),
                "skipped_frames": skipped_frames,
                "total_steps": total_steps,
                "frames_digest": digest,
                "config": plain(config),
                "versions": {"pred": __version__, "torch": str(torch.__version__)},
            }
            save_checkpoint(folder.checkpoints, step, state, train.keep_checkpoints)
        fabric.barrier()

    # Not Fabric's own precision: that rounds the batch too, and bfloat16 cannot hold coordinates.
    autocast = torch.autocast(fabric.device.type, torch.bfloat16, enabled=train.precision == "bf16-mixed")
    model.train()
    step = saved_step = first_step
    loader = make_loader(batches, first_step, config.data.workers)
    with (
        Logs(fabric, folder, first_step) as logs,
        Progress("step", total_steps, first_step, enabled=fabric.is_global_zero) as progress,
        StopRequest(fabric) as stop,
    ):
        announce(progress, folder, latest, resume, len(source), fabric.world_size)
        start_time = time.monotonic()
        for batch in stop.until(loader):
            batch = batch.to(fabric.device, non_blocking=True)
            with autocast:
                output: PretrainOutput = model(batch)
            require_finite({**output.terms, "total": output.loss}, batch)

            optimizer.zero_grad()
            fabric.backward(output.loss)
            gradient_norm = fabric.clip_gradients(model, optimizer, max_norm=train.grad_clip, error_if_nonfinite=False)
            assert gradient_norm is not None
            require_finite({"gradient norm": gradient_norm}, batch)
            learning_rate = set_schedule(optimizer, train, step / total_steps)
            optimizer.step()
            step += 1

            for token, reason in batch.skipped:
                skipped_frames += 1
                progress.message(f"skipped frame {token}: {reason}")
            duration_s, start_time = time.monotonic() - start_time, time.monotonic()
            rays_per_s = int(output.num_rays) * fabric.world_size / duration_s
            progress.update(step, describe(output, rays_per_s))
            if step == 1 or step % train.log_every == 0 or step == total_steps:
                row = log_row(output) | {"gradient_norm": gradient_norm.item(), "learning_rate": learning_rate}
                logs.write(
                    {"step": step, **row, "skipped_frames": skipped_frames},
                    {"step": step, "duration_s": duration_s, "rays_per_s": rays_per_s},
                )
            if step % train.checkpoint_every == 0 and step < total_steps:
                save(step)
                saved_step = step
        if stop.signal is not None and step < total_steps:
            if saved_step < step:
                save(step)
            progress.message(
                f"stopped by {stop.signal.name} after step {step}; continue with: pred pretrain --resume {folder.path}"
            )
            raise SystemExit(128 + stop.signal)

        if saved_step < total_steps:
            last = make_loader(batches, max(0, total_steps - RECALIBRATION_BATCHES), config.data.workers)
            with autocast:
                seen = (batch.to(fabric.device) for batch in last)
                recalibrate_batch_norm(model.module, ((batch.points, batch.point_offsets) for batch in seen))
            save(total_steps)
        if fabric.is_global_zero:
            batch_norm = {"source": "training batches", "masked": True, "batches": RECALIBRATION_BATCHES}
            encoder = model.module.encoder
            write_encoder(folder.encoder, encoder, encoder_facts(config, encoder, step, batch_norm))
        progress.message(
            f"weights: {folder.encoder}; for a detector: pred export {folder.path} --to FRAMEWORK --out FILE"
        )
    return folder.path


def launch_fabric(train: TrainConfig) -> Fabric:
    """Devices and processes, started and set to repeatable algorithms."""
    if train.deterministic:
        # cuBLAS reads it when it starts.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        # Filling fresh memory with NaN costs time; that nothing reads it is for the tests to show.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    # Set by torchrun.
    world_size, per_machine = (int(os.environ.get(name, "1")) for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
    fabric = Fabric(
        accelerator=train.accelerator,
        devices=per_machine,
        num_nodes=world_size // per_machine,
        # Without labels, or in a batch without labelled pixels, the semantic head gets no gradient.
        strategy="ddp_find_unused_parameters_true" if world_size > 1 else "auto",
    )
    fabric.launch()
    return fabric


def build_model(config: PretrainConfig) -> Pretrainer:
    """The network with its initial weights, a function of the configuration and its seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_of(config.train.seed, "initial weights"))
        return Pretrainer(
            config.encoder,
            config.field,
            config.renderer,
            config.loss,
            config.point_range,
            len(config.data.point_channels),
        )


def build_optimizer(model: torch.nn.Module, train: TrainConfig) -> AdamW:
    """AdamW over all parameters, or over all but the frozen: ``attention_in_proj="freeze"`` takes the gradient from the
    parameters in `ATTENTION_IN_PROJ`, so they are neither moved nor decayed, nor part of the clipped norm.
    """
    if train.attention_in_proj == "freeze":
        for name, parameter in model.named_parameters():
            if name.split(".")[-1] in ATTENTION_IN_PROJ:
                parameter.requires_grad_(False)
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    betas = (train.momentum_range[1], train.beta2)
    return AdamW(parameters, lr=train.lr, betas=betas, weight_decay=train.weight_decay, fused=True)


def load_model(config: PretrainConfig, folder: RunFolder, checkpoint: Path | None = None) -> tuple[Pretrainer, Path]:
    """A run's network in evaluation mode, from a checkpoint (by default its latest), and the file it came from.

    Raises:
        CheckpointError: there is none, it is damaged, or it holds a network of other sizes.
    """
    if checkpoint is None:
        latest = load_latest(folder.checkpoints)
        if latest is None:
            raise CheckpointError(f"{folder.checkpoints}: must hold a checkpoint, got none: the run wrote none yet")
        checkpoint, state = latest.path, latest.state
    else:
        state = load_tensors(checkpoint)
    if "model" not in state:
        raise CheckpointError(f"{checkpoint}: must be a checkpoint of a run, got the keys {', '.join(map(str, state))}")
    model = build_model(config)
    try:
        model.load_state_dict(state["model"])
    except (KeyError, RuntimeError) as error:
        raise CheckpointError(f"{checkpoint}: must fit the run's configuration, got {error}") from None
    return model.eval(), checkpoint


def pick_device(train: TrainConfig) -> torch.device:
    """Where a command on one device runs: CUDA where there is one, unless the configuration says cpu."""
    return torch.device("cuda" if train.accelerator != "cpu" and torch.cuda.is_available() else "cpu")


def one_cycle(share_done: float, train: TrainConfig) -> tuple[float, float]:
    """Learning rate and beta1 of the one-cycle policy with cosine flanks (Smith, 2018).

    A function of the share of the steps that are done, in [0, 1], so a resumed run has nothing to restore.
    """
    start_lr = train.lr / train.initial_lr_divisor
    low, high = train.momentum_range
    if share_done < train.warmup_fraction:
        flank = share_done / train.warmup_fraction
        return _cosine(start_lr, train.lr, flank), _cosine(high, low, flank)
    flank = (share_done - train.warmup_fraction) / (1 - train.warmup_fraction)
    return _cosine(train.lr, start_lr / train.final_lr_divisor, flank), _cosine(low, high, flank)


def set_schedule(optimizer: Optimizer, train: TrainConfig, share_done: float) -> float:
    """Give the optimiser its learning rate and beta1 for the next step; returns the learning rate."""
    learning_rate, beta1 = one_cycle(share_done, train)
    for group in optimizer.param_groups:
        group["lr"] = learning_rate
        group["betas"] = (beta1, train.beta2)
    return learning_rate


def frames_digest(source: FrameSource) -> str:
    """Hash of the number of frames and of the tokens of at most `DIGEST_FRAMES`, evenly spread."""
    digest = hashlib.blake2b(str(len(source)).encode(), digest_size=16)
    for index in range(0, len(source), -(-len(source) // DIGEST_FRAMES)):
        digest.update(b"\n" + source.token(index).encode())
    return digest.hexdigest()


def latest_checkpoint(
    folder: RunFolder, config: PretrainConfig, total_steps: int, digest: str
) -> LatestCheckpoint | None:
    """The checkpoint to continue from, or None if the run was stopped before its first.

    Raises:
        CheckpointError: every checkpoint is damaged, or it belongs to another configuration, length or other frames.
    """
    latest = load_latest(folder.checkpoints)
    if folder.is_imported() or (latest is not None and "imported" in latest.state):  # whatever of them is left
        raise CheckpointError(
            f"{folder.path}: must be of a training, got imported weights; start one from them with --init_encoder "
            f"{folder.encoder}"
        )
    if latest is None:
        return None
    now, then = flatten(plain(config)), flatten(latest.state["config"])
    changed = sorted(key for key in now.keys() | then.keys() if now.get(key) != then.get(key) and key not in FREE_KEYS)
    if changed:
        differences = ", ".join(f"{key} = {now.get(key)!r} (was {then.get(key)!r})" for key in changed)
        raise CheckpointError(f"{latest.path}: configuration must be that of the checkpoint, got {differences}")
    if latest.state["total_steps"] != total_steps:
        raise CheckpointError(
            f"{latest.path}: run must have the checkpoint's {latest.state['total_steps']} steps, got {total_steps}: "
            "the number of frames or of processes has changed"
        )
    if latest.state["frames_digest"] != digest:
        raise CheckpointError(f"{latest.path}: frames must be those of the checkpoint, in its order, got others")
    return latest


@torch.no_grad()
def recalibrate_batch_norm(model: Pretrainer, batches: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Replace the running statistics of the encoder's batch normalisation by those of the final weights.

    The running averages (momentum 0.01, as in OpenPCDet) trail the weights by hundreds of steps, which costs a short
    run a tenth of its depth accuracy. A function of weights and batches: doing it again changes nothing.

    Args:
        model: network.
        batches: points [N, D] and point_offsets [B + 1] of what the encoder is to see.
    """
    layers = [layer for layer in model.encoder.modules() if isinstance(layer, _BatchNorm)]
    momenta = [layer.momentum for layer in layers]
    training = model.training
    model.train()
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None  # a plain average over the batches
    for points, point_offsets in batches:
        model.encode(points, point_offsets)
    for layer, momentum in zip(layers, momenta, strict=True):
        layer.momentum = momentum
    model.train(training)


def require_finite(values: dict[str, Tensor], batch: Batch) -> None:
    """
    Raises:
        NonFiniteLossError: a value is NaN or infinite; names it, the step and the frames.
    """
    finite = torch.isfinite(torch.stack([value.detach() for value in values.values()]))
    if bool(finite.all()):  # one synchronisation with the device, whatever the number of values
        return
    bad = [f"{name} = {value.item()}" for name, value in values.items() if not torch.isfinite(value)]
    raise NonFiniteLossError(
        f"pretrain: loss must be finite, got {', '.join(bad)} in step {batch.step + 1}, "
        f"frames {', '.join(batch.tokens)}; the weights are still those of step {batch.step}"
    )


class Logs:
    """log.csv, timing.csv and TensorBoard; rows of steps after ``first_step`` are cut."""

    def __init__(self, fabric: Fabric, folder: RunFolder, first_step: int) -> None:
        self._files = ExitStack()
        self._enabled = fabric.is_global_zero
        if self._enabled:
            self._log = self._files.enter_context(CsvLog(folder.path / "log.csv", first_step))
            self._timing = self._files.enter_context(CsvLog(folder.path / "timing.csv", first_step))
            self._board = TensorBoardLogger(
                folder.path, name="tensorboard", version="", purge_step=first_step + 1 if first_step else None
            )
            self._files.callback(self._board.finalize, "success")

    def write(self, row: dict[str, float], timing: dict[str, float]) -> None:
        """Add a row to each; both hold ``step``."""
        if self._enabled:
            self._log.write(row)
            self._timing.write(timing)
            step = int(row["step"])
            self._board.log_metrics({name: value for name, value in (row | timing).items() if name != "step"}, step)

    def sync(self) -> None:
        """Make the rows durable."""
        if self._enabled:
            self._log.sync()

    def __enter__(self) -> "Logs":
        return self

    def __exit__(self, *error: object) -> None:
        self._files.close()


class StopRequest:
    """Turns Ctrl-C and SIGTERM into the end of an iteration; a second Ctrl-C stops at once.

    Attributes:
        signal: the signal that ended the iteration, or None.
    """

    def __init__(self, fabric: Fabric) -> None:
        self.signal: signal.Signals | None = None
        self._fabric = fabric
        self._previous: dict[signal.Signals, Any] = {}

    def until(self, loader: Iterable[Batch]) -> Iterator[Batch]:
        """The loader's batches, until a signal came to any of the processes that train together."""
        batches = iter(loader)
        while not self._agreed():
            try:
                batch = next(batches)
            except StopIteration:
                return
            except RuntimeError:
                # Ctrl-C goes to the whole process group: the loader's workers may die of it first.
                if self.signal is None:
                    raise
                return
            yield batch

    def _agreed(self) -> bool:
        number = 0 if self.signal is None else int(self.signal)
        if self._fabric.world_size > 1:
            received = self._fabric.all_reduce(torch.tensor(number, device=self._fabric.device), reduce_op="max")
            assert isinstance(received, Tensor)
            number = int(received)
            self.signal = signal.Signals(number) if number else None
        return number != 0

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        signal.signal(number, self._previous[self.signal])

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
            for kind in (signal.SIGINT, signal.SIGTERM):
                self._previous[kind] = signal.signal(kind, self._receive)
        return self

    def __exit__(self, *error: object) -> None:
        for kind, handler in self._previous.items():
            signal.signal(kind, handler)


def announce(
    progress: Progress,
    folder: RunFolder,
    latest: LatestCheckpoint | None,
    resume: bool,
    num_frames: int,
    world_size: int,
) -> None:
    """Say what runs where."""
    progress.message(f"run folder: {folder.path}   frames: {num_frames}   processes: {world_size}")
    if latest is not None:
        for damaged in latest.damaged:
            progress.message(f"damaged checkpoint is not used: {damaged}")
        progress.message(f"resumed from {latest.path}")
    elif resume:
        progress.message("there is no checkpoint yet: starting from the first step")


def log_row(output: PretrainOutput) -> dict[str, float]:
    """What the log holds of a step's output, by column."""
    return {
        "loss": output.loss.item(),
        **{name: term.item() for name, term in output.terms.items()},
        "depth_mae_m": output.depth_mae_m.item(),
        "zero_opacity_share": output.zero_opacity_share.item(),
        "inv_s": output.inv_s.item(),
    }


def describe(output: PretrainOutput, rays_per_s: float) -> str:
    """Loss terms and rate for the progress display."""
    terms = "  ".join(f"{name} {term.item():.3f}" for name, term in output.terms.items())
    return f"loss {output.loss.item():.3f}  {terms}  {rays_per_s / 1000:.1f}k rays/s"


def _cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) * (1 + math.cos(math.pi * share)) / 2
