# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What is timed in a phase of a case.

``forward``           outputs from inputs, without autograd
``backward``          gradients from the incoming ones; the forward pass runs before each call, outside the time
``forward+backward``  both, as a training step does them
``second order``      forward pass, derivative in the grid as a differentiable result (``create_graph``), and the
                      backward pass through both, as an Eikonal term needs
``second backward``   the last of these three alone; the first two run before each call, outside the time

Cases declare the first, third and fourth; the others follow. A graph is built anew for each call rather than kept:
kept graphs hold memory that training frees, and some compiled backward passes overwrite theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.case import BACKWARD, BACKWARD_ALONE, FORWARD, SECOND, SECOND_ALONE, Case, Phase, Variant
from benchmarks.measure import Run


def phases_of(case: Case) -> tuple[Phase, ...]:
    """The declared phases and those that follow from them; the backward pass has its share of the bytes."""
    declared = {phase.name: phase for phase in case.phases}
    phases: list[Phase] = []
    for phase in case.phases:
        if phase.name == BACKWARD and FORWARD in declared:
            forward = declared[FORWARD]
            traffic, work = (
                f"{total} - {part}" if part else ""
                for total, part in ((phase.traffic, forward.traffic), (phase.work, forward.work))
            )
            left = phase.traffic_bytes - forward.traffic_bytes
            flop = phase.flop - forward.flop
            phases.append(Phase(BACKWARD_ALONE, traffic, left, work=work, flop=flop, flop_dtype=phase.flop_dtype))
        phases.append(phase)
        if phase.name == SECOND:
            phases.append(Phase(SECOND_ALONE, "", 0))  # its share of the bytes is not declared
    return tuple(phases)


def prepare(case: Case, phase: Phase, variant: Variant) -> Run:
    """One call of a phase, on the variant's own leaves and incoming gradients."""
    function = variant.function
    inputs = [
        tensor.detach().requires_grad_(position in case.derivative_in and phase.name != FORWARD)
        for position, tensor in enumerate(case.inputs if variant.inputs is None else variant.inputs)
    ]
    if phase.name == FORWARD:

        def forward() -> list[Tensor]:
            with torch.no_grad():
                return list(function(*inputs))

        return Run(forward)

    leaves = [inputs[position] for position in case.derivative_in]
    probe = function(*inputs)
    grads = [_incoming(probe[position], seed) for seed, position in enumerate(case.derivative_of)]

    def outputs() -> tuple[Tensor, ...]:
        return function(*inputs)

    def backward(outputs: tuple[Tensor, ...]) -> list[Tensor]:
        used = [outputs[position] for position in case.derivative_of]
        return list(torch.autograd.grad(used, leaves, grads))

    def both() -> list[Tensor]:
        found = outputs()
        return [*(out.detach() for out in found), *backward(found)]

    if phase.name in (BACKWARD, BACKWARD_ALONE):
        return Run(both) if phase.name == BACKWARD else Run(backward, before=outputs)

    # The gathers only: output 0, map and grid
    grid = inputs[1]
    cotangent = _incoming(probe[0], len(grads)).requires_grad_()
    grad_grad = _incoming(grid, len(grads) + 1)

    def value_and_slope() -> tuple[Tensor, Tensor]:
        (out,) = function(*inputs)
        (slope,) = torch.autograd.grad(out, grid, cotangent, create_graph=True)
        return out, slope

    def second_backward(value_and_slope: tuple[Tensor, Tensor]) -> list[Tensor]:
        return list(torch.autograd.grad(value_and_slope, [*leaves, cotangent], [grads[0], grad_grad]))

    def second() -> list[Tensor]:
        found = value_and_slope()
        return [*(tensor.detach() for tensor in found), *second_backward(found)]

    return Run(second) if phase.name == SECOND else Run(second_backward, before=value_and_slope)


def prepare_compiled(case: Case, phase: Phase, variant: Variant) -> Run:
    """As `prepare`; what is differentiated twice can only be compiled as a whole.

    Raises:
        NotImplementedError: in ``second backward``, for that reason.
    """
    if phase.name == SECOND:
        return Run(compiled(prepare(case, phase, variant).call))
    if phase.name == SECOND_ALONE:
        raise NotImplementedError("a compiled second order is one graph, its parts have no time of their own")
    return prepare(case, phase, Variant(compiled(variant.function), variant.inputs))


def compiled(function: Callable[..., Any]) -> Any:
    """``torch.compile`` for fixed shapes; from torch 2.13 on, `function` may call ``autograd.grad``."""
    if hasattr(torch._dynamo.config, "trace_autograd_ops"):
        torch._dynamo.config.trace_autograd_ops = True
    return torch.compile(function, dynamic=False)


def _incoming(like: Tensor, seed: int) -> Tensor:
    """The same random gradient for every contender, in the memory layout of its own output."""
    values = torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=like.dtype)
    return torch.empty_like(like).copy_(values)
