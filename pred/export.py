# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred export` and `pred import`: encoder weights to other frameworks and back.

Export takes the encoder of a run's checkpoint, gives its batch normalisation the statistics of whole scans, and writes
it with the names and layouts of a framework. Import makes a run folder of another framework's weights, which every
command that reads a run can use. `pred.checkpoint_layouts` holds the tables, `pred.encoder_file` the files.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from pred import __version__
from pred.checkpoint import TEMPORARY_SUFFIX, load_tensors, save_checkpoint
from pred.checkpoint_layouts import (
    ENCODER_MODULES,
    Framework,
    KernelOrder,
    LayoutOptions,
    export_state,
    is_stride1_deblock,
    layout,
    shapes_of,
)
from pred.config import plain, to_yaml
from pred.data.batch import build_source
from pred.data.frame import FrameError
from pred.encoder_file import (
    choose_parts,
    encoder_facts,
    has_conv_for_no_stride,
    load_encoder,
    require_place,
    sidecar,
    write_encoder,
)
from pred.evaluate import SpreadFrames, load_frames
from pred.evaluate_probe import whole_scan
from pred.export_check import require_match, specs_of
from pred.models.pretrainer import Pretrainer
from pred.pretrain import PretrainConfig, build_model, load_model, pick_device, recalibrate_batch_norm
from pred.progress import Progress
from pred.run_folder import RunFolder, RunFolderError

RECALIBRATION_SCANS = 64


def export(
    config: PretrainConfig,
    run: Path,
    to: Framework,
    out: Path,
    checkpoint: Path | None = None,
    recalibrate_scans: int | None = RECALIBRATION_SCANS,
    parts: Collection[str] = ENCODER_MODULES,
    options: LayoutOptions | None = None,
    against: Path | None = None,
) -> dict[str, Any]:
    """Write the encoder of a run as a framework loads it, and FILE.json beside it.

    Args:
        config: the run's configuration.
        run: run folder.
        to: framework.
        out: the file.
        checkpoint: file to use; the run's latest by default.
        recalibrate_scans: whole scans, spread evenly over the data set, whose average makes the statistics of batch
            normalisation; None keeps those of the checkpoint.
        parts: modules that are written.
        options: of the framework's configuration.
        against: names, shapes and types of a model (`pred.export_check.read_specs`), whose encoder must take all.

    Returns:
        What FILE.json holds.

    Raises:
        RunFolderError, CheckpointError, FrameError, ValueError: something is missing, damaged, or has no place in the
            framework; the text names it.
    """
    if recalibrate_scans is not None and recalibrate_scans < 1:
        raise ValueError(f"export: recalibrate-scans must be at least 1, got {recalibrate_scans}")
    folder = RunFolder(run)
    folder.require()
    # What cannot be written is refused before the long work.
    require_place(out)
    for parent in out.resolve().parents:
        if parent == folder.path.resolve() or RunFolder(parent).info.is_file():
            raise ValueError(f"export: out must not lie in a run folder, whose files belong to the run, got {out}")
    for name, path in {"the checkpoint": checkpoint, "against": against}.items():
        if path is not None and path.resolve() in (out.resolve(), sidecar(out).resolve()):
            raise ValueError(f"export: out must not replace {name}, got {out} and {path}")
    model, checkpoint = load_model(config, folder, checkpoint)
    conv_here = has_conv_for_no_stride(model.encoder)
    shapes = choose_parts(shapes_of(model.encoder.state_dict()), parts)
    entries = layout(shapes, to, options, conv_here)
    if against is not None:
        require_match(
            specs_of(export_state(choose_parts(model.encoder.state_dict(), parts), to, options, conv_here)), against
        )
    state = load_tensors(checkpoint)
    batch_norm: dict[str, Any] = state.get("batch_norm", {"source": "checkpoint", "masked": True})
    if recalibrate_scans is not None:
        batch_norm = recalibrate_on_whole_scans(model, config, recalibrate_scans)
    facts = encoder_facts(
        config, model.encoder, state["step"], batch_norm, state.get("versions", {}), state.get("imported")
    )
    facts["checkpoint"] = checkpoint.name
    content = write_encoder(out, model.encoder, facts, to, options, parts)
    layout_facts = content["layout"]
    print(f"wrote {out} and {sidecar(out).name}: {layout_facts['num_tensors']} tensors for {to}")
    for module, count in layout_facts["modules"].items():
        print(f"  {module:<20} {count}")
    folded = layout_facts["num_tensors_here"] - layout_facts["num_tensors"]
    if folded:
        print(f"  {folded} biases folded into running means")
    for module in layout_facts["left_out"]:
        print(f"  {module:<20} left out")
    if any(is_stride1_deblock(entry.ours, entry.shape) for entry in entries):
        kind = "Conv2d" if layout_facts["use_conv_for_no_stride"] else "ConvTranspose2d"
        print(f"  deblocks of stride 1 are for {kind}; --stride1-deblock says it if the model has the other")
    return content


def recalibrate_on_whole_scans(model: Pretrainer, config: PretrainConfig, num_scans: int) -> dict[str, Any]:
    """Give the encoder's batch normalisation the statistics of whole scans, as a detector sees them.

    Returns:
        Where the statistics come from, for the facts.

    Raises:
        FrameError: the data set cannot be read, or none of its frames.
    """
    way_out = (
        "batch normalisation gets its statistics from whole scans: name the data set with --data.root DIR, or keep the "
        "statistics of the checkpoint with --no-recalibrate"
    )
    try:
        source = SpreadFrames(build_source(config.data), num_scans)
    except (FrameError, ValueError) as error:
        raise ValueError(f"{error}\n{way_out}") from None
    device = pick_device(config.train)
    model.to(device)
    skipped: dict[str, str] = {}
    used = 0

    def scans() -> Iterator[tuple[Tensor, Tensor]]:
        nonlocal used
        with Progress("recalibrating on scan", len(source)) as progress:
            for frame in load_frames(source, config.data.on_error == "skip", skipped):
                yield whole_scan(frame, config, device)
                used += 1
                progress.advance()

    recalibrate_batch_norm(model, scans())
    model.cpu()
    if not used:
        raise ValueError(f"export: scans must be readable, got none of {len(source)}\n{way_out}")
    unset = [
        name
        for name, layer in model.encoder.named_modules()
        if isinstance(layer, _BatchNorm) and layer.num_batches_tracked == 0
    ]
    if unset:
        raise ValueError(
            f"export: scans must hold points inside point_range, got none from which {unset[0]} could take statistics\n"
            f"{way_out}"
        )
    return {
        "source": "whole scans",
        "masked": False,
        "scans": used,
        "skipped": len(skipped),
        "split": config.data.split,
    }


def import_encoder(
    config: PretrainConfig,
    file: Path,
    out: Path,
    options: LayoutOptions | None = None,
    kernel_order: KernelOrder | None = None,
) -> dict[str, Any]:
    """Make a run folder of the encoder in a checkpoint of OpenPCDet, DSVT, mmdetection3d or this package.

    The folder holds a checkpoint of step 0 (the rest of the network has its initial weights) and encoder.pth, so that
    `pred evaluate probe`, `pred export` and a training from these weights (``init_encoder``) can use it.

    Args:
        config: names the encoder.
        file: the checkpoint.
        out: run folder, which must be new.
        options: of the framework's configuration, where names and shapes do not tell.
        kernel_order: of the sparse kernels, where shapes do not tell.

    Returns:
        Where the weights come from.

    Raises:
        CheckpointError: the file cannot be read, or its encoder is not this one; the text names each difference.
        RunFolderError: the folder holds something.
    """
    if out.is_dir() and any(out.iterdir()) or out.exists() and not out.is_dir():
        raise RunFolderError(f"{out}: run folder must be new, got one that holds something, or a file")
    config = replace(config, run=str(out))
    model = build_model(config)
    imported = load_encoder(model.encoder, file, options, kernel_order, config)
    batch_norm = imported["facts"].get("batch_norm", {"source": str(file), "masked": False})
    state = {
        "model": model.state_dict(),
        "imported": imported,
        "batch_norm": batch_norm,
        "config": plain(config),
        "versions": {"pred": __version__, "torch": str(torch.__version__)},
    }
    # A folder is there with all of it, or not at all: half of one could be taken for a run before its first checkpoint.
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = RunFolder(out.with_name(f".{out.name}{TEMPORARY_SUFFIX}"))
    shutil.rmtree(folder.path, ignore_errors=True)  # of an import that was killed
    try:
        folder.start(to_yaml(config))
        folder.record_start({"imported": imported}, None)
        save_checkpoint(folder.checkpoints, 0, state, keep_last=1)
        facts = encoder_facts(config, model.encoder, 0, batch_norm, imported=imported)
        write_encoder(folder.encoder, model.encoder, facts)
        os.replace(folder.path, out)
    finally:
        shutil.rmtree(folder.path, ignore_errors=True)
    print(f"imported {imported['num_tensors']} tensors of {imported['framework']} from {file} into {out}")
    if imported["left_out"]:
        print(f"  left out: {', '.join(imported['left_out'])}")
    return imported
