# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark case is: one op on one input, in phases, and the ways to compute it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.report import Target

FORWARD, BACKWARD, SECOND = "forward", "forward+backward", "second order"
"""Phases that cases declare."""
BACKWARD_ALONE, SECOND_ALONE = "backward", "second backward"
"""Phases that follow from them: the last pass of `BACKWARD` and of `SECOND`, its graph built outside the time."""
KINDS = ("ours", "eager", "compiled", "peers")

Function = Callable[..., tuple[Tensor, ...]]


@dataclass(frozen=True)
class Phase:
    """A part of an op's work, its least traffic and its targets."""

    name: str
    traffic: str
    """Formula of the bytes, in the letters of `pred.ops`."""
    traffic_bytes: int
    targets: tuple[Target, ...] = ()
    work: str = ""
    """Formula of the useful floating-point operations, where they and not the bytes are the limit."""
    flop: int = 0
    flop_dtype: str = "float32"
    """Of the products' operands."""


@dataclass(frozen=True)
class Variant:
    """One way to compute a case."""

    function: Function
    inputs: tuple[Tensor, ...] | None = None
    """Inputs in this variant's best memory format; None: the case's own."""
    as_ours: Callable[[list[Tensor]], list[Tensor]] | None = None
    """Brings its results into the form of ours for the check, outside the time; None: they have it."""


@dataclass(frozen=True)
class Case:
    """One op on one input."""

    op: str
    name: str
    unit: str
    items: int
    """Number of `unit`s in one call."""
    inputs: tuple[Tensor, ...]
    ours: Function
    reference: Function
    eager: dict[str, Variant]
    """Plain PyTorch, by name; the fastest counts."""
    compiled: tuple[str, ...]
    """Which of them are compiled."""
    phases: tuple[Phase, ...]
    derivative_in: tuple[int, ...] = ()
    """Positions of the inputs that take gradients."""
    derivative_of: tuple[int, ...] = (0,)
    """Positions of the outputs that a loss would use."""
    tolerance: float = 1e-5
    """Of every result, relative to its largest magnitude; 0: equal."""
    outliers: float = 0.0
    """Share of elements that may miss the tolerance, with the reason beside it."""
    needs_kernel: bool = True
    """Ours is a kernel of the op's name; without it there is nothing to time."""
    peers: Mapping[str, Callable[[torch.device], Variant]] = field(default_factory=dict)
    """Other libraries, by name. The call imports the library, so that a missing one is an ImportError of its own; it
    raises NotImplementedError where the library cannot work on the device of the inputs."""
    modules: tuple[nn.Module, ...] = ()
    """What the functions hold beside their inputs."""

    @property
    def device(self) -> torch.device:
        """Where the inputs are."""
        return self.inputs[0].device

    def to(self, device: torch.device) -> Case:
        """The case on a device: its inputs, those of its variants, and (in place) its modules."""
        for module in self.modules:
            module.to(device)

        def moved(variant: Variant) -> Variant:
            return variant if variant.inputs is None else replace(variant, inputs=_on(device, variant.inputs))

        eager = {name: moved(variant) for name, variant in self.eager.items()}
        return replace(self, inputs=_on(device, self.inputs), eager=eager)


def _on(device: torch.device, tensors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return tuple(tensor.to(device) for tensor in tensors)


def spread(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Tensors that stand in a list by names of their own: ``weights[0]``, ``weights[1]`` ..."""
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        if isinstance(value, list | tuple) and any(isinstance(item, Tensor) for item in value):
            found |= {f"{name}[{position}]": item for position, item in enumerate(value)}
        else:
            found[name] = value
    return found


def gather(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The lists that `spread` took apart."""
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        if name.endswith("]"):
            found.setdefault(name.partition("[")[0], []).append(value)
        else:
            found[name] = value
    return found
