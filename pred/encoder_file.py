# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Files of encoder weights: the one way they are written, and the one way they are read.

FILE       a checkpoint as the framework reads it: ``{"model_state": …}`` (OpenPCDet, DSVT) or ``{"state_dict": …}``
           (mmdetection3d), plus ``"pred"``: what a user of the weights must know, as plain values. All three
           frameworks pass over keys that they do not know.
FILE.json  the same facts, the SHA-256 of FILE, and the name, shape and type of every tensor.

RUN/encoder.pth, written at the end of a training, is such a file in OpenPCDet's layout.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import reprlib
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from pred.checkpoint import TEMPORARY_SUFFIX, CheckpointError, load_tensors, save_tensors, write_text
from pred.checkpoint_layouts import (
    ENCODER_MODULES,
    FRAMEWORKS,
    WRAPPERS,
    Framework,
    KernelOrder,
    LayoutError,
    LayoutOptions,
    export_state,
    framework_of,
    import_state,
    is_stride1_deblock,
    kind_of,
    shapes_of,
)
from pred.config import plain
from pred.run_folder import environment

if TYPE_CHECKING:
    from pred.models.encoders import EncoderConfig
    from pred.pretrain import PretrainConfig

CHANNEL_UNITS = {
    "x": "metres, LiDAR frame of the data set",
    "y": "metres, LiDAR frame of the data set",
    "z": "metres, LiDAR frame of the data set",
    "intensity": "as stored in the data set, not scaled",
    "age": "seconds behind the keyframe, 0 for the keyframe's own points",
}

FACTS = "pred"
"""Key of a file under which the facts stand."""

HEADS = (
    "global_step", "dense_head", "point_head", "roi_head", "pfe", "bbox_head", "rpn_head", "pts_bbox_head",
    "pts_fusion_layer", "img_backbone", "img_neck", "img_bbox_head", "img_rpn_head",
)  # fmt: skip
"""Parts of detectors that are no part of a LiDAR encoder; they are left out where one is read."""


@dataclass
class WeightsFile:
    """The weights in a checkpoint of any framework.

    Attributes:
        path: the file.
        state: names and tensors, as in the file.
        facts: what this package wrote beside them; empty for files of others.
    """

    path: Path
    state: dict[str, Tensor]
    facts: dict[str, Any]


def has_conv_for_no_stride(encoder: nn.Module) -> bool:
    """Whether the 2D backbone has a Conv2d where its resolution stays (`BEVBackboneConfig.conv_for_no_stride`)."""
    return any(
        isinstance(layer, nn.Conv2d) and is_stride1_deblock(f"{name}.weight", tuple(layer.weight.shape))
        for name, layer in encoder.named_modules()
    )


def sidecar(path: Path) -> Path:
    """Where the facts of a file stand."""
    return path.with_name(f"{path.name}.json")


def encoder_facts(
    config: PretrainConfig,
    encoder: nn.Module,
    step: int,
    batch_norm: Mapping[str, Any],
    trained_with: Mapping[str, Any] | None = None,
    imported: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """What a user of an encoder's weights must know, as plain values.

    Args:
        config: of the run.
        encoder: its encoder.
        step: steps it was trained for.
        batch_norm: where its running statistics come from.
        trained_with: versions of the training; None: those of this process.
        imported: where the weights come from if this package did not train them (`load_encoder`). What that file does
            not say of its training is None.

    Raises:
        CheckpointError: facts of the imported file are malformed.
    """
    data = config.data
    training: dict[str, Any] = {
        "dataset": data.dataset,
        "split": data.split,
        "sweeps": data.sweeps,
        "mask_ratio": data.mask_ratio,
        "mask_strategy": data.mask_strategy,
        "step": step,
        "seed": config.train.seed,
        "trained_with": dict(environment()["versions"] if trained_with is None else trained_with),
    }
    if imported is not None:
        said = _checked_facts(imported["file"], imported["facts"])
        training = {name: said.get(name) for name in training}
        training["imported"] = dict(imported)
    return {
        "encoder": type(encoder).__name__,
        "encoder_kind": config.encoder.kind,
        "encoder_config": _used_config(config.encoder),
        **_input_facts(config, encoder),
        **training,
        "batch_norm": dict(batch_norm),
        "written_with": environment()["versions"],
        "caveats": [*_caveats(config, batch_norm, training["mask_ratio"])],
    }


def _input_facts(config: PretrainConfig, encoder: nn.Module) -> dict[str, Any]:
    return {
        "point_range_m": [float(value) for value in config.point_range],
        "voxel_size_m": [float(size) for size in encoder.voxel_size],  # type: ignore[union-attr]
        "point_channels": {name: CHANNEL_UNITS[name.split("_")[0]] for name in config.data.point_channels},
        "time_unit": "s",
    }


def _used_config(encoder: EncoderConfig) -> dict[str, Any]:
    """Without the parts of other kinds of encoders."""
    parts = {"pillars": ["pillars"], "voxels": ["voxels"], "dsvt": ["pillars", "dsvt"]}[encoder.kind]
    if encoder.bev == "after_2d":
        parts.append("backbone_2d")
    return {name: value for name, value in plain(encoder).items() if name in ("kind", "bev", *parts)}


def _caveats(config: PretrainConfig, batch_norm: Mapping[str, Any], mask_ratio: float | None) -> list[str]:
    encoder = config.encoder
    caveats = [
        "x, y, z are in the LiDAR frame of the data set, and intensity has its scale: a pipeline with others feeds the "
        "encoder other numbers",
        "no shape tells the voxel size, the range in x and y, the number of sweeps or the unit of time",
    ]
    if encoder.kind != "voxels":
        points = encoder.pillars.max_points
        caveats.append(
            "pillars are dynamic: every point inside the range counts, that in z too (OpenPCDet: MASK_Z: True); a hard "
            "pillar network takes the maximum over empty slots too"
            if points is None
            else f"pillars are hard: the first {points} points count, and empty slots take part in the maximum"
        )
    if encoder.kind == "dsvt":
        caveats.append(
            "OpenPCDet's and DSVT's adam_onecycle never updates in_proj_weight and in_proj_bias of attention"
        )
    if batch_norm.get("masked"):
        share = "most" if mask_ratio is None else f"{mask_ratio:.0%}"
        caveats.append(
            f"the running statistics of batch normalisation are those of scans of which {share} of the points are "
            "hidden; `pred export` takes them from whole scans"
        )
    return caveats


def write_encoder(
    path: Path,
    encoder: nn.Module,
    facts: Mapping[str, Any],
    to: Framework = "openpcdet",
    options: LayoutOptions | None = None,
    parts: Collection[str] = ENCODER_MODULES,
) -> dict[str, Any]:
    """Write an encoder's weights for a framework, and the sidecar; either is replaced at once or not at all.

    Args:
        path: the file.
        encoder: whose weights are written.
        facts: see `encoder_facts`.
        to: framework.
        options: of its configuration.
        parts: modules that are written.

    Returns:
        The sidecar's content.

    Raises:
        LayoutError: the framework has no place for a tensor, or a weight is not finite; unknown or empty parts.
        CheckpointError: the folder does not exist, or FILE or FILE.json is something else.
    """
    require_place(path)
    state, conv_here = encoder.state_dict(), has_conv_for_no_stride(encoder)
    chosen = choose_parts(state, parts)
    exported = export_state(chosen, to, options, conv_here)
    resolved = (options or LayoutOptions()).resolved(shapes_of(chosen), to, conv_here)
    layout: dict[str, Any] = {
        "framework": to,
        "key": WRAPPERS[to],
        "sparse_kernels": "(z, y, x, in, out)",
        "parts": sorted({name.split(".")[0] for name in chosen}),
        "left_out": sorted({name.split(".")[0] for name in state} - {*parts}),
        "modules": dict(Counter(name.split(".")[0] for name in exported)),
        "num_tensors": len(exported),
        "num_tensors_here": len(chosen),
        "options": asdict(resolved),
        "use_conv_for_no_stride": resolved.stride1_conv,
    }
    if to == "mmdet3d" and kind_of(state) == "pillars":
        layout["pillar_network"] = _mmdet3d_pillars(shapes_of(chosen), resolved)
    content = {**facts, "layout": layout}
    new = path.with_name(f".{path.name}.new{TEMPORARY_SUFFIX}")
    try:
        save_tensors(new, {WRAPPERS[to]: exported, FACTS: content})
        sha256 = _sha256(new)
        sidecar(path).unlink(missing_ok=True)  # never the old facts beside the new file
        os.replace(new, path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    described = {
        **content,
        "sha256": sha256,
        "tensors": {
            name: {"shape": list(tensor.shape), "dtype": str(tensor.dtype).removeprefix("torch.")}
            for name, tensor in exported.items()
        },
    }
    write_text(sidecar(path), json.dumps(described, indent=2) + "\n")
    return described


def require_place(path: Path) -> None:
    """
    Raises:
        CheckpointError: a file of weights and its sidecar cannot be written, or would replace something else.
    """
    if not path.name or path.is_dir():
        raise CheckpointError(f"{path}: must be a file to write, got a folder")
    if not path.parent.is_dir():
        raise CheckpointError(f"{path}: folder must exist, got none")
    if sidecar(path).exists() and _described_sha256(path) is None:
        raise CheckpointError(f"{sidecar(path)}: must be absent or of `pred export`, got another file")


def choose_parts(state: Mapping[str, Any], parts: Collection[str]) -> dict[str, Any]:
    """Of an encoder's names those in some of its modules. Modules without tensors may be asked for.

    Raises:
        LayoutError: no encoder has such a module, or nothing remains.
    """
    unknown = sorted({*parts} - {*ENCODER_MODULES})
    if unknown:
        raise LayoutError(f"parts must be of {', '.join(ENCODER_MODULES)}, got {', '.join(unknown)}")
    chosen = {name: value for name, value in state.items() if name.split(".")[0] in parts}
    if not chosen:
        modules = sorted({name.split(".")[0] for name in state})
        raise LayoutError(
            f"parts must name modules with weights, {', '.join(modules)}, got {', '.join(parts) or 'none'}"
        )
    return chosen


def _mmdet3d_pillars(shapes: Mapping[str, tuple[int, ...]], options: LayoutOptions) -> dict[str, Any]:
    """What the configuration of mmdetection3d's pillar network must say for these weights, and no shape tells."""
    widths = [shape[0] for name, shape in shapes.items() if re.fullmatch(r"vfe\.pfn_layers\.\d+\.linear\.weight", name)]
    if options.dynamic_pillars:  # layers but the last are not halved there
        return {"type": "DynamicPillarFeatureNet", "feat_channels": widths, "legacy": False}
    # As OpenPCDet, all layers but the last have half as many channels as are said.
    return {
        "type": "PillarFeatureNet",
        "feat_channels": [2 * width for width in widths[:-1]] + widths[-1:],
        "legacy": False,
    }


def read_weights(path: Path) -> WeightsFile:
    """The weights in a checkpoint: under ``model_state``, under ``state_dict``, or a flat dictionary.

    Raises:
        CheckpointError: the file cannot be read, holds no weights or malformed facts, or is not the one that its
            sidecar describes.
    """
    content = load_tensors(path)
    if sidecar(path).is_file():
        _require_sidecar(path)
    for key in ("model_state", "state_dict"):
        if isinstance(content.get(key), dict):
            state, facts = content[key], content.get(FACTS, {})
            break
    else:
        if not content or not all(isinstance(value, Tensor) for value in content.values()):
            hint = ""
            if isinstance(content.get("model"), dict) and "config" in content:
                hint = (
                    ": this is a checkpoint of a run, of which `pred export RUN --checkpoint FILE` writes the encoder"
                )
            raise CheckpointError(
                f"{path}: must hold weights under model_state or state_dict, or be a dictionary of tensors, got the "
                f"keys {', '.join(map(str, content)) or 'none'}{hint}"
            )
        state, facts = content, {}
    if not state:
        raise CheckpointError(f"{path}: must hold weights, got none")
    for name, value in state.items():
        if not isinstance(name, str):
            raise CheckpointError(f"{path}: names of weights must be text, got {name!r}")
        if not isinstance(value, Tensor):
            raise CheckpointError(f"{path}: weights must be tensors, got {type(value).__name__} as {name}")
        if value.layout != torch.strided or value.is_meta or value.is_quantized:
            kind = "quantized" if value.is_quantized else "meta" if value.is_meta else str(value.layout)
            raise CheckpointError(f"{path}: weights must be dense tensors with values, got a {kind} one as {name}")
    return WeightsFile(path, dict(state), _checked_facts(path, facts))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_whole(value: Any) -> bool:
    return type(value) is int  # bool is a kind of int


def _are_numbers(value: Any, count: int) -> bool:
    if not isinstance(value, list) or len(value) != count:
        return False
    return all(type(number) in (int, float) and abs(number) < float("inf") for number in value)


def _is_dictionary(value: Any) -> bool:
    return isinstance(value, dict)


_FACT_RULES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "layout": ("a dictionary", _is_dictionary),
    "layout.framework": (f"{', '.join(FRAMEWORKS[:-1])} or {FRAMEWORKS[-1]}", lambda value: value in FRAMEWORKS),
    "voxel_size_m": ("a list of 3 numbers", lambda value: _are_numbers(value, 3)),
    "point_range_m": ("a list of 6 numbers", lambda value: _are_numbers(value, 6)),
    "point_channels": (
        "a dictionary of names to units",
        lambda value: isinstance(value, dict) and all(map(_is_text, value.values())),
    ),
    "time_unit": ("text", _is_text),
    "batch_norm": ("a dictionary", _is_dictionary),
}
"""What the facts that are read must be, if they are there."""

_TRAINING_RULES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "dataset": ("text", _is_text),
    "split": ("text", _is_text),
    "sweeps": ("a whole number", _is_whole),
    "mask_ratio": ("a number from 0 to 1", lambda value: type(value) in (int, float) and 0 <= value <= 1),
    "mask_strategy": ("text", _is_text),
    "step": ("a whole number", _is_whole),
    "seed": ("a whole number", _is_whole),
    "trained_with": ("a dictionary", _is_dictionary),
}
"""The same of those that may be None: nobody knows."""


def _checked_facts(path: Path | str, facts: Any) -> dict[str, Any]:
    """The facts of a file, which anybody may have written. Those that are not read must be plain values, as they are
    handed on into run.json."""
    if not isinstance(facts, dict):
        raise CheckpointError(f"{path}: {FACTS} must be a dictionary, got {reprlib.repr(facts)}")
    for name, value in facts.items():
        if not isinstance(name, str):
            raise CheckpointError(f"{path}: names of {FACTS} must be text, got {name!r}")
        try:
            _require_plain(path, name, value)
        except RecursionError:
            raise CheckpointError(f"{path}: {name} must hold plain values, got one within itself") from None
    layout = facts.get("layout")
    values = facts | ({"layout.framework": layout.get("framework")} if isinstance(layout, dict) else {})
    for name, (rule, holds) in (_FACT_RULES | _TRAINING_RULES).items():
        unsaid = name not in values or name in _TRAINING_RULES and values[name] is None
        if not unsaid and not holds(values[name]):
            raise CheckpointError(f"{path}: {name} must be {rule}, got {reprlib.repr(values[name])}")
    return facts


def _require_plain(path: Path | str, name: str, value: Any) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise CheckpointError(f"{path}: names in {name} must be text, got {key!r}")
            _require_plain(path, f"{name}.{key}", item)
    elif isinstance(value, list | tuple):
        for item in value:
            _require_plain(path, name, item)
    elif value is not None and type(value) not in (bool, int, float, str):
        raise CheckpointError(f"{path}: {name} must be a plain value, got {type(value).__name__}")


def load_encoder(
    encoder: nn.Module,
    path: Path,
    options: LayoutOptions | None = None,
    kernel_order: KernelOrder | None = None,
    config: PretrainConfig | None = None,
) -> dict[str, Any]:
    """Give an encoder the weights in a checkpoint of OpenPCDet, DSVT, mmdetection3d or this package, all or none.

    Heads of detectors in the file are left out. What this package wrote says itself how it is to be read, and for which
    input.

    Args:
        encoder: gets the weights.
        path: the checkpoint.
        options: of the framework's configuration, where names and shapes do not tell; see `LayoutOptions`.
        kernel_order: of the sparse kernels, where shapes do not tell.
        config: that the encoder was built from; the input that the file was trained for must be its input.

    Returns:
        Where the weights come from: file, SHA-256, framework, number of tensors, modules left out, and the facts that
        stand in the file.

    Raises:
        CheckpointError: the file cannot be read, its facts are malformed, its encoder is not this one, or it says
            otherwise than the arguments; the text names each difference and its probable cause.
    """
    file = read_weights(path)
    written = file.facts.get("layout")
    framework: Framework = "mmdet3d" if framework_of(file.state) == "mmdetection3d" else "openpcdet"
    if written is not None:
        if kernel_order == "krsc":
            raise CheckpointError(f"{path}: --kernel-order must be dhwio, as the file says, got krsc")
        kernel_order = "dhwio"
        options = _agreed_options(path, options or LayoutOptions(), written.get("options", {}))
    if config is not None:
        _require_same_input(path, file.facts, _input_facts(config, encoder))
    heads = {name for name in file.state if name.split(".")[0] in HEADS}
    state = {name: tensor for name, tensor in file.state.items() if name not in heads}
    try:
        imported = import_state(
            state,
            shapes_of(encoder.state_dict()),
            framework,
            options,
            kernel_order,
            has_conv_for_no_stride(encoder),
        )
    except LayoutError as error:
        raise CheckpointError(f"{path}: {error}") from None
    encoder.load_state_dict(imported)
    return {
        "file": str(path),
        "sha256": _sha256(path),
        "framework": framework,
        "num_tensors": len(imported),
        "left_out": sorted({name.split(".")[0] for name in heads}),
        "facts": file.facts,
    }


_OPTION_FLAGS = {
    "stride1_conv": "--stride1-deblock",
    "prefix": "--mmdet3d-prefix",
    "dynamic_pillars": "--dynamic-pillars",
}
_OPTION_VALUES = {"stride1_conv": (None, True, False), "prefix": (None, "pts_", ""), "dynamic_pillars": (True, False)}


def _agreed_options(path: Path, asked: LayoutOptions, written: Any) -> LayoutOptions:
    """Those that the file says, where nothing else was asked for."""
    if not isinstance(written, dict):
        raise CheckpointError(f"{path}: layout.options must be a dictionary, got {type(written).__name__}")
    for name, value in written.items():
        allowed = _OPTION_VALUES.get(name, ())
        if not any(type(value) is type(other) and value == other for other in allowed):
            raise CheckpointError(f"{path}: layout.options must be those of `pred export`, got {name} = {value!r}")
    file = LayoutOptions(**written)
    unsaid = LayoutOptions()
    for name, flag in _OPTION_FLAGS.items():
        want, have = getattr(asked, name), getattr(file, name)
        if want not in (getattr(unsaid, name), have) and have is not None:
            raise CheckpointError(f"{path}: {flag} must be left out or say what the file says ({name} = {have!r})")
    return file if file.stride1_conv is not None else replace(file, stride1_conv=asked.stride1_conv)


def _require_same_input(path: Path, facts: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Weights mean something else for other cells, heights or channels, and no shape tells."""
    for name in ("voxel_size_m", "point_channels", "time_unit"):
        there = facts.get(name)
        if there is not None and not _alike(there, here[name]):
            raise CheckpointError(
                f"{path}: {name} must be that of the encoder, {_said(here[name])}, got {_said(there)}"
            )
    there = facts.get("point_range_m")
    z = [here["point_range_m"][axis] for axis in (2, 5)]
    if there is not None and not _alike([there[2], there[5]], z):
        raise CheckpointError(
            f"{path}: point_range_m must be that of the encoder in z, {z}, got {[there[2], there[5]]}"
        )


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b)  # channels in their order
    return bool(a == b)


def _said(value: Any) -> str:
    return ", ".join(value) if isinstance(value, Mapping) else str(value)


def _described_sha256(path: Path) -> Any:
    """What the sidecar says; None where it is not one of this package."""
    try:
        return json.loads(sidecar(path).read_text())["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _require_sidecar(path: Path) -> None:
    expected = _described_sha256(path)
    if expected is not None and expected != _sha256(path):
        raise CheckpointError(f"{path}: must be the file that {sidecar(path).name} describes, got another SHA-256")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
