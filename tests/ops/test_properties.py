# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled ops against their references on sizes, memory layouts and special values that nobody chose.

PRED_TEST_EXAMPLES is the number of random calls per test; more than the default are drawn anew each time.
"""

from __future__ import annotations

import math
import os
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, assume, given, note, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.ops.examples import EXAMPLES, HALF, Arguments, Example, Source, evaluate, order_of
from tests.tolerances import FORWARD, GRADIENT, assert_close

DEFAULT_CALLS = 25
CALLS = int(os.environ.get("PRED_TEST_EXAMPLES", DEFAULT_CALLS))
SETTINGS = settings(
    max_examples=CALLS,
    derandomize=CALLS == DEFAULT_CALLS,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)
BY_OP = {name: [example for example in EXAMPLES if example.op == name] for name in {x.op for x in EXAMPLES}}

every_op = pytest.mark.parametrize("op", sorted(BY_OP))


class DrawnSource(Source):
    """Sizes drawn by hypothesis."""

    def __init__(self, draw: Any, seed: int, count: int) -> None:
        super().__init__(seed, count)
        self._draw = draw

    def size(self, default: int, low: int, high: int) -> int:
        return int(self._draw(st.integers(low, high)))


@st.composite
def calls(draw: Any, op: str, largest: int = 70) -> tuple[Example, Arguments, torch.dtype]:
    """A variant of the op, with any sizes, and with memory layouts of its tensors chosen at random."""
    example = draw(st.sampled_from(BY_OP[op]))
    dtypes = [torch.float64, torch.float32, *(HALF if example.features else ())]
    dtype = draw(st.sampled_from(dtypes))
    source = DrawnSource(draw, draw(st.integers(0, 2**31 - 1)), draw(st.integers(0, largest)))
    arguments = example.arguments(source, dtype)
    for name, value in arguments.items():
        if isinstance(value, Tensor):
            arguments[name] = draw(st.sampled_from([contiguous, transposed, padded, shifted, reversed_rows]))(value)
    note(f"{example} {dtype} " + ", ".join(f"{k} {tuple(getattr(v, 'shape', ()))}" for k, v in arguments.items()))
    return example, arguments, dtype


def contiguous(tensor: Tensor) -> Tensor:
    return tensor


def transposed(tensor: Tensor) -> Tensor:
    dims = tuple(reversed(range(tensor.dim())))
    return tensor.permute(dims).contiguous().permute(dims)


def padded(tensor: Tensor) -> Tensor:
    """Rows with a gap between them."""
    if not tensor.dim():
        return tensor
    return torch.cat([tensor, torch.zeros_like(tensor)], dim=-1)[..., : tensor.shape[-1]]


def shifted(tensor: Tensor) -> Tensor:
    """Contiguous, behind an unaligned address."""
    memory = tensor.new_empty(tensor.numel() + 3)[3:]
    return memory.copy_(tensor.reshape(-1)).view(tensor.shape)


def reversed_rows(tensor: Tensor) -> Tensor:
    """Memory order of the first two dimensions swapped."""
    return tensor.transpose(0, 1).contiguous().transpose(0, 1) if tensor.dim() > 1 else tensor


def widened(arguments: Arguments) -> Arguments:
    return {
        name: value.double() if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in arguments.items()
    }


def compare(example: Example, actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert list(actual) == list(expected)
    for name, value in actual.items():
        if not value.is_floating_point():
            assert torch.equal(value, expected[name]), name
            continue
        if value.dim() == 0 and value.dtype == torch.float32:
            continue  # one sum over all rays, which may cancel to any relative error; float64 shows that it is right
        table = GRADIENT if name.startswith(("grad_", "second_")) else FORWARD
        if value.dtype in HALF:  # rounded once, and a value between two may fall to either side
            tolerance = torch.finfo(value.dtype).eps
        else:
            # Random sizes make sums of few terms that cancel, whose rounding is large beside the result.
            tolerance = table[value.dtype] * (4 * example.tolerance if value.dtype == torch.float32 else 4)
        assert_close(value.double(), expected[name], tolerance, name)


@every_op
def test_any_sizes_and_layouts(native: None, op: str) -> None:
    @SETTINGS
    @given(calls(op))
    def check(call: tuple[Example, Arguments, torch.dtype]) -> None:
        example, arguments, dtype = call
        order = order_of(example) if dtype not in HALF else min(order_of(example), 1)
        leaves = example.leaves(arguments)
        actual = evaluate(example.native, arguments, leaves, order)
        compare(example, actual, evaluate(example.reference, widened(arguments), leaves, order))
        for name in leaves:
            assert actual[f"grad_{name}"].dtype == arguments[name].dtype

    check()


LINEAR = {"alpha", "edges", "t", "values", "bev", "volume", "features", "points"}
"""Arguments whose size the results have: where 1e30 cancels against -1e30, a rounding of 1e30 is left."""


@pytest.mark.parametrize("op", sorted(BY_OP.keys() - {"build_rulebook"}))  # which takes whole numbers alone
def test_special_values(native: None, op: str) -> None:
    """NaN, infinities, zeros and tiny numbers anywhere in the features or the geometry: the same NaNs, the same values.
    Derivatives do not fail, and nothing outside of an item's own memory is read or written."""

    @SETTINGS
    @given(calls(op, largest=9), st.data())
    def check(call: tuple[Example, Arguments, torch.dtype], data: st.DataObject) -> None:
        example, arguments, dtype = call
        assume(dtype not in HALF)
        names = [k for k, v in arguments.items() if isinstance(v, Tensor) and v.is_floating_point() and v.numel()]
        assume(names)
        name = data.draw(st.sampled_from([k for k in names if k != "inv_s"] or names))
        assume(name != "inv_s")  # is checked by value
        before = evaluate(example.reference, arguments, [], 0)
        changed = arguments[name].clone(memory_format=torch.contiguous_format)
        flat = changed.view(-1)
        for _ in range(data.draw(st.integers(1, 3))):
            place = data.draw(st.integers(0, flat.numel() - 1))
            flat[place] = data.draw(st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-30, -1e30, 1e30]))
        arguments[name] = changed
        note(f"{name} = {changed}")
        actual = evaluate(example.native, arguments, [], 0)
        expected = evaluate(example.reference, arguments, [], 0)
        for key, value in actual.items():
            assert torch.equal(value.isnan(), expected[key].isnan()), f"{key}: {value} against {expected[key]}"
        if name != "weights" or arguments.get("mode", "exact") == "exact" or not (changed < 0).any():
            # Else, in the published modes, the cdf falls somewhere and has no inverse.
            factor = 4 * FORWARD[dtype] * (example.tolerance if dtype == torch.float32 else 1)
            compare_special(actual, expected, before, float(largest(changed)) if name in LINEAR else 0.0, factor)
        evaluate(example.native, arguments, example.leaves(arguments), order_of(example))

    check()


def largest(value: Tensor) -> Tensor:
    """Of the finite magnitudes; 0 where there is none."""
    finite = value[value.isfinite()].abs()
    return finite.max() if finite.numel() else value.new_zeros(())


def compare_special(
    actual: dict[str, Tensor], expected: dict[str, Tensor], before: dict[str, Tensor], size: float, tolerance: float
) -> None:
    """Where a special value does not reach, and results are as ``before``, by the scale of those; the others by their
    own, or ``size``, so that 1e30 in one item hides nothing in the rest."""
    reached = {
        key: value != before[key] if value.shape == before[key].shape else torch.ones_like(value, dtype=torch.bool)
        for key, value in expected.items()
    }
    size = max(size, *(float(largest(value[reached[key]].double())) for key, value in expected.items()))
    for key, value in expected.items():
        text = f"{key}: {actual[key]} against {value}"
        infinite, finite = value.isinf(), value.isfinite()
        assert torch.equal(actual[key][infinite], value[infinite]), text
        if not value.is_floating_point():
            assert torch.equal(actual[key], value), text
            continue
        scale = largest(before[key])
        allowed = tolerance * torch.where(reached[key], scale.clamp(min=size), scale)
        assert ((actual[key] - value).abs() <= allowed)[finite].all(), text


@every_op
def test_threads_do_not_matter(native: None, op: str) -> None:
    @settings(SETTINGS, max_examples=max(CALLS // 4, 5))
    @given(calls(op, largest=3000), st.integers(2, 9))
    def check(call: tuple[Example, Arguments, torch.dtype], threads: int) -> None:
        example, arguments, dtype = call
        order = order_of(example) if dtype not in HALF else min(order_of(example), 1)
        found = []
        for count in (1, threads):
            torch.set_num_threads(count)
            found.append(evaluate(example.native, arguments, example.leaves(arguments), order))
        assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())

    check()
