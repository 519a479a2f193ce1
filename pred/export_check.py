# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred export --check FILE --against NAMES`: would a model of a framework take all weights of a file?

OpenPCDet keeps what has a name and shape of its own and drops the rest; mmdetection3d's ``load_from`` warns and goes
on. Either way a training may start from scratch without an error. This comparison needs no framework: NAMES is a list
of the model's names, shapes and types, or a checkpoint that the framework wrote.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from pred.checkpoint import CheckpointError
from pred.checkpoint_layouts import (
    ENCODER_MODULES,
    KRSC_TO_DHWIO,
    MMDET3D_MODULES,
    Shape,
    cause_of_extra,
    cause_of_missing,
    cause_of_shape,
    framework_of,
    is_sparse_kernel,
    shared_cause,
)
from pred.encoder_file import HEADS, read_weights

MODULES = (*ENCODER_MODULES, *MMDET3D_MODULES, *(f"pts_{module}" for module in MMDET3D_MODULES))
"""Modules that may be parts of an encoder, in any of the frameworks."""

_LINE = re.compile(r"(\S+)\s+\(([\d\s,]*)\)\s+(?:torch\.)?(\w+)")


class Spec(NamedTuple):
    """Shape and type of a tensor."""

    shape: Shape
    dtype: str

    def __str__(self) -> str:
        return f"({', '.join(map(str, self.shape))}) {self.dtype}"


class Problem(NamedTuple):
    """One tensor that would not be loaded."""

    kind: str
    """missing, left over, shape, type or kernel."""
    name: str
    text: str
    """What was found and wanted, and the probable cause."""


@dataclass
class Comparison:
    """Weights of a file against a model.

    Attributes:
        matched, wanted: tensors by module; all is well where these are equal and there is no problem.
        turned: sparse kernels (z, y, x, in, out) that the framework turns on loading.
        problems: tensors that do not fit.
        not_compared: tensors of the model in modules that were not asked for, by module.
        ignored: tensors of the file in modules that were not asked for, by module.
        cause: one cause that many problems share.
    """

    matched: Counter[str] = field(default_factory=Counter)
    wanted: Counter[str] = field(default_factory=Counter)
    turned: int = 0
    problems: list[Problem] = field(default_factory=list)
    not_compared: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    cause: str | None = None

    @property
    def complete(self) -> bool:
        return not self.problems and self.matched == self.wanted and self.wanted.total() > 0


def check_file(file: Path, against: Path, only: Collection[str] | None = None) -> Comparison:
    """Compare the weights of a checkpoint with the tensors of a model, and print what fits and what does not.

    Args:
        file: checkpoint (``model_state``, ``state_dict`` or flat).
        against: text file of lines ``name (shape) dtype`` (``#`` begins a comment), or a checkpoint.
        only: modules to compare, such as ``backbone_3d``; by default those of an encoder, not a detector's heads.

    Raises:
        CheckpointError: a file cannot be read, or the weights do not fit.
    """
    comparison = compare(specs_of(read_weights(file).state), read_specs(against), only)
    print(report(comparison))
    _require_complete(comparison, file, against)
    return comparison


def require_match(found: Mapping[str, Spec], against: Path) -> None:
    """Tensors that are about to be written must be those of a model's encoder.

    Raises:
        CheckpointError: they are not; the text says what differs.
    """
    comparison = compare(found, read_specs(against))
    if not comparison.complete:
        print(report(comparison))
    _require_complete(comparison, "export", against)


def _require_complete(comparison: Comparison, what: object, against: Path) -> None:
    if comparison.complete:
        return
    matched, total = comparison.matched.total(), comparison.wanted.total()
    left_over = sum(problem.kind == "left over" for problem in comparison.problems)
    raise CheckpointError(
        f"{what}: must hold the {total} tensors of {against} and no others, got {matched} of them and {left_over} "
        "others"
    )


def compare(found: Mapping[str, Spec], wanted: Mapping[str, Spec], only: Collection[str] | None = None) -> Comparison:
    """Which tensors of a model a file would fill.

    Args:
        found: of the file.
        wanted: of the model.
        only: modules to compare; None: those of an encoder.

    Raises:
        ValueError: a module of ``only`` is in neither.
    """
    modules = {_module(name) for name in (*found, *wanted)}
    if only is not None and (unknown := sorted({*only} - modules - {*MODULES})):
        raise ValueError(
            f"export: --only must name modules of FILE or NAMES, {', '.join(sorted(modules))}; got {', '.join(unknown)}"
        )
    chosen = {*only} if only is not None else {*MODULES}
    comparison = Comparison(
        not_compared=Counter(_module(name) for name in wanted if _module(name) not in chosen),
    )
    model = {name: spec for name, spec in wanted.items() if _module(name) in chosen}
    # Whatever else is in the file could be the encoder under wrong names, unless the model has such a module too.
    other = ({_module(name) for name in wanted} | {*MODULES} | {*HEADS}) - chosen
    comparison.ignored = Counter(_module(name) for name in found if _module(name) in other)
    weights = {name: spec for name, spec in found.items() if _module(name) not in other}
    comparison.wanted = Counter(_module(name) for name in model)
    found_shapes = {name: spec.shape for name, spec in weights.items()}
    wanted_shapes = {name: spec.shape for name, spec in model.items()}
    comparison.cause = shared_cause(found_shapes, wanted_shapes)
    turns_by_shape = framework_of(wanted) != "mmdetection3d"
    for name, spec in model.items():
        if name not in weights:
            comparison.problems.append(Problem("missing", name, f"{spec}{cause_of_missing(name, weights)}"))
            continue
        got = weights[name]
        if got.dtype != spec.dtype:
            text = f"must be {spec}, got {got}: weights of another type are rounded on loading"
            comparison.problems.append(Problem("type", name, text))
        elif is_sparse_kernel(name, spec.shape) and not turns_by_shape:
            problem = _mmdet3d_kernel(name, got.shape, spec.shape)
            if problem is None:
                comparison.matched[_module(name)] += 1
            else:
                comparison.problems.append(Problem("kernel", name, problem))
        elif got.shape == spec.shape:
            comparison.matched[_module(name)] += 1
        elif is_sparse_kernel(name, spec.shape) and got.shape == _dhwio(spec.shape):
            comparison.matched[_module(name)] += 1
            comparison.turned += 1
        else:
            text = f"must be {spec}, got {got}{cause_of_shape(name, got.shape, spec.shape)}"
            comparison.problems.append(Problem("shape", name, text))
    for name, spec in weights.items():
        if name not in model:
            comparison.problems.append(Problem("left over", name, f"{spec}{cause_of_extra(name, model)}"))
    return comparison


def report(comparison: Comparison) -> str:
    """The comparison for people: N/M by module, every problem with its probable cause; whole modules in one line."""
    lines = [
        f"{module:<20} {comparison.matched[module]}/{count} matched" for module, count in comparison.wanted.items()
    ]
    if comparison.turned:
        lines.append(
            f"{comparison.turned} sparse kernels are (z, y, x, in, out); OpenPCDet and DSVT turn them on loading"
        )
    for module, count in comparison.not_compared.items():
        lines.append(f"{module:<20} {count} tensors of the model are not compared; they keep their initial values")
    for module, count in comparison.ignored.items():
        lines.append(f"{module:<20} {count} tensors of the file are not compared")
    if not comparison.wanted:
        lines.append("nothing to compare: the model has none of the modules")
    if comparison.cause:
        lines.append(comparison.cause)
    for (kind, module), problems in _by_module(comparison.problems).items():
        left_over = {_module(problem.name) for problem in comparison.problems if problem.kind == "left over"}
        whole = len(problems) == comparison.wanted[module] if kind == "missing" else module not in comparison.wanted
        if whole and kind == "missing" and module in left_over:
            lines.append(
                f"{kind:<9} {module}: all {len(problems)} tensors; the file has others of {module}{_other(problems)}"
            )
        elif whole and kind in ("missing", "left over"):
            side = "the file holds" if kind == "missing" else "the model has"
            lines.append(f"{kind:<9} {module}: all {len(problems)} tensors; {side} nothing of {module}")
        else:
            lines += [f"{kind:<9} {problem.name} {problem.text}" for problem in problems]
    return "\n".join(lines)


def _other(problems: list[Problem]) -> str:
    """Why a module of the model has all its tensors under other names."""
    if any(re.search(r"pfn_layers\.\d+\.[01]\.", problem.name) for problem in problems):
        return ": the model is a DynamicPillarFeatureNet, the file for a PillarFeatureNet (--dynamic-pillars)"
    if any(re.search(r"pfn_layers\.\d+\.(linear|norm)\.", problem.name) for problem in problems):
        return ": the model is a PillarFeatureNet, the file for a DynamicPillarFeatureNet"
    return ""


def _by_module(problems: list[Problem]) -> dict[tuple[str, str], list[Problem]]:
    groups: dict[tuple[str, str], list[Problem]] = {}
    for problem in problems:
        groups.setdefault((problem.kind, _module(problem.name)), []).append(problem)
    return groups


def specs_of(state: Mapping[str, Tensor]) -> dict[str, Spec]:
    """Shapes and types of a state dict."""
    return {name: Spec(tuple(tensor.shape), str(tensor.dtype).removeprefix("torch.")) for name, tensor in state.items()}


def read_specs(path: Path) -> dict[str, Spec]:
    """Names, shapes and types of a model: a text file of lines ``name (shape) dtype``, or a checkpoint.

    Raises:
        CheckpointError: it is neither.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CheckpointError(f"{path}: must exist, got no such file") from None
    except IsADirectoryError:
        raise CheckpointError(f"{path}: must be a list of names or a checkpoint, got a folder") from None
    except UnicodeDecodeError:
        return specs_of(read_weights(path).state)
    specs: dict[str, Spec] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.split("#")[0].strip()
        if not line:
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise CheckpointError(f"{path}: line {number} must be `name (shape) dtype`, got {line[:80]!r}")
        if match[1] in specs:
            raise CheckpointError(f"{path}: line {number} must name another tensor, got {match[1]} again")
        specs[match[1]] = Spec(tuple(int(size) for size in re.findall(r"\d+", match[2])), match[3])
    if not specs:
        raise CheckpointError(f"{path}: must name tensors, got none")
    return specs


def _module(name: str) -> str:
    return name.split(".")[0]


def _dhwio(shape: Shape) -> Shape:
    return tuple(shape[axis] for axis in KRSC_TO_DHWIO)


def _mmdet3d_kernel(name: str, got: Shape, wanted: Shape) -> str | None:
    """mmdetection3d turns every kernel on loading if it uses spconv 2, and none if it uses mmcv's operators, and a file
    has to be (z, y, x, in, out) for both; its own list of shapes is (out, z, y, x, in) in the first case."""
    # Kernels are 3 or 1 cells long, and have more channels than that but where they begin or end.
    is_krsc = wanted[0] > max(wanted[1:4])
    dhwio = _dhwio(wanted) if is_krsc else wanted
    if got == dhwio:
        return None
    cause = cause_of_shape(name, got, dhwio)
    if is_krsc and got == wanted:
        cause = ": (out, z, y, x, in), which mmdetection3d turns once more on loading"
    return f"must be ({', '.join(map(str, dhwio))}), got ({', '.join(map(str, got))}){cause}"
