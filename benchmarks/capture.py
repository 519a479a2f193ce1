# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The inputs that the ops get in training steps, in a file, and benchmark cases of them.

While `recording`, every place in `pred` that holds a public op (``pred.ops`` and what imported from it) holds a wrapper
instead; the library itself knows nothing of it. Of calls with equal shapes and arguments the first is kept, copied as
the op got it. A hook on its outputs notes which of them a gradient reaches.

The file is made by ``torch.save`` and loads with ``weights_only=True``: ``{"schema", "source", "versions", "calls"}``;
each call has ``op``, ``arguments`` (by name, ``name[0]`` ... where they stand in a list; tensors and plain values),
``differentiable`` (names of the tensors that require a gradient), ``used`` (positions of the outputs that get one) and
``times`` (calls alike).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

import pred
from benchmarks.bench_ops import CASES
from benchmarks.bench_step import contender
from benchmarks.case import BACKWARD, FORWARD, Case, Phase, gather, spread
from benchmarks.cases import TINY, Sizes
from pred import ops
from pred.ops import reference

SCHEMA = 1
STEPS = 2


class CaptureError(ValueError):
    """A capture cannot be made or read."""


@dataclasses.dataclass
class Call:
    """One call of a public op, and how often it came."""

    op: str
    arguments: dict[str, Any]
    differentiable: list[str]
    used: list[int] = dataclasses.field(default_factory=list)
    times: int = 1


def capture_steps(path: Path, source: str, sizes: Sizes) -> str:
    """Runs training steps, writes what the ops got, and returns a summary.

    Args:
        path: file to write.
        source: ``step`` (the rendering step), or a configuration of ``pred pretrain``, by name or as a file.
        sizes: of the rendering step.

    Raises:
        CaptureError: the configuration cannot be run.
    """
    run = contender("ours", sizes) if source == "step" else _pretrain_steps(source)
    with recording() as calls:
        try:
            run()
        except (ValueError, OSError) as error:
            raise CaptureError(f"--capture-from {source}: {error}") from error
    save(path, source, calls)
    lines = [f"{call.times:4}x {call_name(call)}" for call in calls]
    return "\n".join([*lines, f"written: {path}, {path.stat().st_size / 1e6:.1f} MB"])


def _pretrain_steps(config_name: str) -> Callable[[], object]:
    """A short run of ``pred pretrain``, everything that it needs imported: see `recording`."""
    from pred.config import build, config_parser
    from pred.pretrain import PretrainConfig, pretrain

    parser = config_parser("pred pretrain", "", PretrainConfig)
    fixed = ["--data.workers=0", "--train.accelerator=cpu", f"--train.steps={STEPS}"]

    def run() -> None:
        with tempfile.TemporaryDirectory() as folder:
            parsed = parser.parse_args([f"--config={config_name}", f"--run={folder}/run", *fixed])
            pretrain(build(parser, PretrainConfig, parsed))

    return run


@contextlib.contextmanager
def recording() -> Iterator[list[Call]]:
    """Within, calls of public ops are noted; the list that it gives is filled at the end.

    What is imported from `pred` only within would keep its wrappers for good.
    """
    calls: dict[str, Call] = {}
    holders: list[tuple[ModuleType, str, Callable[..., Any]]] = []
    public = {name: getattr(ops, name) for name in ops.__all__ if name.islower()}
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] == "pred"]
    try:
        for module in modules:
            if module.__name__.startswith("pred.ops."):
                continue  # what an op does inside is its own affair
            for name, value in list(vars(module).items()):
                if any(value is function for function in public.values()):
                    holders.append((module, name, value))
                    setattr(module, name, _noting(value, calls))
        found: list[Call] = []
        yield found
        found += calls.values()
    finally:
        for module, name, value in holders:
            setattr(module, name, value)


def _noting(function: Callable[..., Any], calls: dict[str, Call]) -> Callable[..., Any]:
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = spread(signature.bind(*args, **kwargs).arguments)
        key = f"{function.__name__} {[(name, _fact(value)) for name, value in bound.items()]}"
        if key in calls:
            calls[key].times += 1
            return function(*args, **kwargs)
        tensors = {name: value for name, value in bound.items() if isinstance(value, Tensor)}
        noted = calls[key] = Call(
            function.__name__,
            {name: value.detach().clone() if name in tensors else _plain(value) for name, value in bound.items()},
            [name for name, tensor in tensors.items() if tensor.requires_grad],
        )
        result = function(*args, **kwargs)
        for position, out in enumerate(tensors_of(result)):
            if out.requires_grad:
                out.register_hook(lambda grad, position=position: _note_use(noted, position))
        return result

    return call


def _note_use(call: Call, position: int) -> None:
    if position not in call.used:
        call.used = sorted([*call.used, position])


def _fact(value: Any) -> Any:
    """What calls are told apart by."""
    if isinstance(value, Tensor):
        return list(value.shape), value.stride(), value.dtype, value.requires_grad
    return value


def _plain(value: Any) -> Any:
    """Numbers, text, None and sequences of them, which is all that the ops take beside tensors."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


def tensors_of(result: Any) -> tuple[Tensor, ...]:
    """An op's results without those that are None."""
    return tuple(item for item in (result if isinstance(result, tuple) else (result,)) if isinstance(item, Tensor))


def save(path: Path, source: str, calls: Sequence[Call]) -> None:
    """Writes a capture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(
        {
            "schema": SCHEMA,
            "source": source,
            "versions": {"pred": pred.__version__, "torch": str(torch.__version__)},
            "calls": [dataclasses.asdict(call) for call in calls],
        },
        path,
    )


def load(path: Path) -> list[Call]:
    """Reads a capture.

    Raises:
        CaptureError: the file is missing, no capture, or of another schema.
    """
    try:
        content = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise CaptureError(f"{path}: must be a file of --capture, got no such file") from None
    except Exception as error:  # torch.load raises whatever it meets
        text = (str(error).splitlines() or [""])[0]
        raise CaptureError(f"{path}: must be a file of --capture, got one that torch.load refuses: {text}") from None
    if not isinstance(content, dict) or "calls" not in content:
        raise CaptureError(f"{path}: must be a file of --capture, got other content")
    if content.get("schema") != SCHEMA:
        raise CaptureError(f"{path}: must have schema {SCHEMA}, got {content.get('schema')}: another version wrote it")
    return [Call(**call) for call in content["calls"]]


def captured_cases(path: Path, chosen: Sequence[str]) -> list[Case]:
    """A case for each call in a capture of one of the ops in ``chosen``.

    Raises:
        CaptureError: see `load`; or an op that is not in this version.
    """
    calls = [call for call in load(path) if call.op in chosen or call.op not in CASES]
    for call in calls:
        if not hasattr(reference, call.op):
            raise CaptureError(f"{path}: must hold calls of pred.ops, got one of {call.op}, which is not there")
    cases = [_case(call) for call in calls]
    names = [case.name for case in cases]
    return [
        dataclasses.replace(case, name=f"{case.name} #{1 + names[:number].count(case.name)}")
        if names.count(case.name) > 1
        else case
        for number, case in enumerate(cases)
    ]


def _case(call: Call) -> Case:
    """Ours against the reference; results must agree as closely as in the op's own cases."""
    names = [name for name, value in call.arguments.items() if isinstance(value, Tensor)]
    inputs = tuple(call.arguments[name] for name in names)

    def caller(function: Callable[..., Any]) -> Callable[..., tuple[Tensor, ...]]:
        return lambda *tensors: tensors_of(function(**gather(call.arguments | dict(zip(names, tensors, strict=True)))))

    plain = caller(getattr(reference, call.op))
    leaves, used, outputs = _derivative(plain, inputs, [names.index(name) for name in call.differentiable], call.used)
    read, written = sum(tensor.nbytes for tensor in inputs), sum(tensor.nbytes for tensor in outputs)
    phases = [Phase(FORWARD, "inputs + outputs", read + written)]
    if leaves:
        grads = sum(outputs[position].nbytes for position in used) + sum(inputs[position].nbytes for position in leaves)
        phases.append(Phase(BACKWARD, "2 inputs + outputs + gradients of both", 2 * read + written + grads))
    own = CASES[call.op](TINY)
    return Case(
        op=call.op,
        name=call_name(call),
        unit="calls",
        items=1,
        inputs=inputs,
        ours=caller(getattr(ops, call.op)),
        reference=plain,
        eager={},
        compiled=(),
        phases=tuple(phases),
        derivative_in=tuple(leaves),
        derivative_of=tuple(used),
        tolerance=max(case.tolerance for case in own),
        outliers=max(case.outliers for case in own),
    )


def _derivative(
    plain: Callable[..., tuple[Tensor, ...]], inputs: Sequence[Tensor], candidates: Sequence[int], used: Sequence[int]
) -> tuple[list[int], list[int], tuple[Tensor, ...]]:
    """Inputs that get a gradient, outputs that pass one on, and all outputs.

    An input may require a gradient and get none, such as the signed distances under ``detach_sdf``.
    """
    inputs = [tensor.detach().requires_grad_(position in candidates) for position, tensor in enumerate(inputs)]
    outputs = plain(*inputs)
    used = [position for position in used if outputs[position].requires_grad]
    if not used or not candidates:
        return [], [], outputs
    leaves = [inputs[position] for position in candidates]
    sums = [outputs[position].sum() for position in used]
    grads = torch.autograd.grad(sums, leaves, allow_unused=True)
    reached = [position for position, grad in zip(candidates, grads, strict=True) if grad is not None]
    return reached, used, outputs


def call_name(call: Call) -> str:
    """Op, shapes and arguments."""
    return f"{call.op}({', '.join(f'{name} {_short(value)}' for name, value in call.arguments.items())})"


def _short(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    return "[...]" if isinstance(value, list) and len(value) > 3 else str(value)
