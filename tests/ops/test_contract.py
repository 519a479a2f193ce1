# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What holds for every op, on the calls of examples.py."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
import torch._dynamo.utils
from torch import Tensor

from pred.ops import reference
from tests.conftest import SANITIZED
from tests.ops.examples import (
    EXAMPLES,
    HALF,
    PUBLIC,
    Arguments,
    Example,
    Source,
    evaluate,
    grads,
    order_of,
    outputs,
    recorded_calls,
    registered_ops,
)
from tests.tolerances import FORWARD, GRADIENT, assert_close

DTYPES = [torch.float32, torch.float64]

every_example = pytest.mark.parametrize("example", EXAMPLES, ids=str)


def widened(arguments: Arguments) -> Arguments:
    """In float64."""
    return {
        name: value.double() if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in arguments.items()
    }


def assert_like_reference(example: Example, arguments: Arguments) -> None:
    """Native values and derivatives are those of the reference in float64, in the arguments' dtype."""
    leaves, order = example.leaves(arguments), order_of(example)
    actual = evaluate(example.native, arguments, leaves, order)
    expected = evaluate(example.reference, widened(arguments), leaves, order)
    assert list(actual) == list(expected)
    dtype = next(value.dtype for value in arguments.values() if isinstance(value, Tensor))
    for name, value in actual.items():
        if not value.is_floating_point():
            assert torch.equal(value, expected[name]), name
            continue
        assert value.dtype == dtype, name
        tolerance = (GRADIENT if name.startswith(("grad_", "second_")) else FORWARD)[dtype]
        factor = example.tolerance if dtype == torch.float32 else 1
        assert_close(value.double(), expected[name], tolerance * factor, name)


def assert_same_bits(actual: dict[str, Tensor], expected: dict[str, Tensor], what: str = "") -> None:
    assert list(actual) == list(expected)
    for name, value in actual.items():
        assert value.dtype == expected[name].dtype, f"{name} {what}"
        assert torch.equal(value, expected[name]), f"{name} {what}"


def test_every_public_op_has_an_example() -> None:
    assert sorted({example.op for example in EXAMPLES}) == sorted(PUBLIC)
    assert sorted(reference.__all__) == sorted(PUBLIC)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@every_example
def test_native_equals_reference_at_every_level(level: str, example: Example, dtype: torch.dtype) -> None:
    for count in (1, 37, 260):
        assert_like_reference(example, example.example(count, dtype, seed=count))


@pytest.mark.parametrize(
    "example,dtype",
    [(x, torch.float32) for x in EXAMPLES] + [(x, torch.bfloat16) for x in EXAMPLES if x.features],
    ids=str,
)
def test_bitwise_equal_for_any_thread_count_and_from_run_to_run(
    level: str, example: Example, dtype: torch.dtype
) -> None:
    arguments = example.example(example.many, dtype)
    order = order_of(example) if dtype not in HALF else min(order_of(example), 1)
    found = []
    for threads in (1, 2, 7, 7):
        torch.set_num_threads(threads)
        found.append(evaluate(example.native, arguments, example.leaves(arguments), order))
    for threads, other in zip((2, 7, 7), found[1:], strict=True):
        assert_same_bits(other, found[0], f"with {threads} threads")


class VariedSource(Source):
    """All sizes change with the count: samples per ray, channels, cells, and sizes that are plain numbers."""

    def size(self, default: int, low: int, high: int) -> int:
        return min(default + self.count % 5, high)

    def tensors(self, default: int, low: int, high: int) -> int:
        return default  # a graph has a fixed number of inputs


REFERENCE_GRAPHS = {example.op: example for example in reversed(EXAMPLES) if example.reference_compiles}
"""One example per op: that plain PyTorch compiles is not in question everywhere."""


@pytest.mark.parametrize(
    "backend,example",
    [("native", x) for x in EXAMPLES] + [("reference", x) for x in REFERENCE_GRAPHS.values() if not SANITIZED],
    indirect=["backend"],
    ids=str,
)
def test_one_graph_and_two_compilations(backend: str, example: Example) -> None:
    """The first for the sizes that came first, the second for all others from 2 on."""
    # torch's derivative of cumprod, in the reference of composite_alpha, has a graph per number of samples.
    sizes = VariedSource if backend == "native" else Source
    assert compilations(example, (50, 37, 21, 8, 64), sizes) <= 2


FIRST_EXAMPLES = {example.op: example for example in reversed(EXAMPLES)}


@pytest.mark.parametrize("op", sorted(FIRST_EXAMPLES))
def test_sizes_0_and_1_have_graphs_of_their_own(native: None, op: str) -> None:
    """torch.compile takes them for constants: one more compilation each, in whatever order they come."""
    assert compilations(FIRST_EXAMPLES[op], (1, 37, 0, 21, 1, 0, 50), VariedSource) <= 4


def compilations(example: Example, counts: Sequence[int], sizes: type[Source]) -> int:
    """How many graphs calls of these sizes need. Each call's values and gradients are those of the eager op."""
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    leaves = example.leaves(example.example(2))
    order = min(order_of(example), 1)

    def call(**arguments: Any) -> dict[str, Tensor]:
        return outputs(example.native(**arguments))

    compiled = torch.compile(call, fullgraph=True, backend="aot_eager")
    for count in counts:
        arguments = example.arguments(sizes(0, count), torch.float64)
        with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
            actual = evaluate(lambda **kwargs: tuple(compiled(**kwargs).values()), arguments, leaves, order)
        expected = evaluate(lambda **kwargs: tuple(call(**kwargs).values()), arguments, leaves, order)
        for name, value in actual.items():
            if value.is_floating_point():
                assert_close(value, expected[name], 1e-12, f"{name} of {count}")
            else:
                assert torch.equal(value, expected[name]), f"{name} of {count}"
    graphs = int(torch._dynamo.utils.counters["stats"]["unique_graphs"])
    torch._dynamo.reset()
    return graphs


@every_example
def test_vmap_is_refused_by_name(backend: str, example: Example) -> None:
    arguments = example.example(6)
    every = {k: v for k, v in arguments.items() if isinstance(v, Tensor)}
    tensors = {k: v for k, v in every.items() if v.is_floating_point()} or every
    rest = {name: value for name, value in arguments.items() if name not in tensors}
    batched = {name: torch.stack([value, value]) for name, value in tensors.items()}
    with pytest.raises(RuntimeError, match=rf"{example.op}\w*: torch.vmap is not supported"):
        torch.vmap(lambda x: tuple(outputs(example.native(**x, **rest)).values()))(batched)


@every_example
def test_wrong_tensors_are_named(backend: str, example: Example) -> None:
    """Another rank, dtype, layout, device or type: ``op: argument must <rule>, got <fact>``, from both backends and
    from the reference when it is called itself."""
    arguments = example.example(6)
    tensors = {name: value for name, value in arguments.items() if isinstance(value, Tensor)}
    for name, value in tensors.items():
        wrong: dict[str, Any] = {"list": [value.tolist()], "dtype": value.bool(), "layout": value.to_sparse()}
        if value.numel() != 1:  # a number may have any shape
            wrong["rank"] = value[None, None, None]
        if len(tensors) > 1:
            wrong["device"] = value.to("meta")
        names = "|".join(re.escape(name) for name in tensors)
        for what, replacement in wrong.items():
            for function in (example.native, example.reference):
                with pytest.raises((ValueError, TypeError), match=rf"^{example.op}: ({names}) must .*, got ") as raised:
                    function(**{**arguments, name: replacement})
                kind = TypeError if what in ("list", "dtype", "layout") else ValueError
                assert isinstance(raised.value, kind), f"{what} of {name}"


WRONG_PLAIN: dict[type, tuple[Any, ...]] = {
    bool: ("yes", None),
    str: ("no such", 2, np.zeros(2), None),
    int: (2.5, "2", np.zeros((2, 3), dtype=np.int64), None),
    float: ("2", [2.0], np.array("abc"), torch.tensor(2.0), 10**400),
}


@every_example
def test_wrong_plain_arguments_are_named(backend: str, example: Example) -> None:
    """The same for numbers, counts and switches."""
    arguments = example.example(6)
    parameters = inspect.signature(example.native).parameters
    plain = {name: parameter.default for name, parameter in parameters.items()} | arguments
    for name, value in plain.items():
        for replacement in WRONG_PLAIN.get(type(value), ()):
            if replacement is None and parameters[name].default is None:
                continue
            if isinstance(replacement, Tensor) and name == "inv_s":
                continue  # may be one
            for function in (example.native, example.reference):
                with pytest.raises((TypeError, ValueError), match=rf"^{example.op}: {name} must .*, got "):
                    function(**{**arguments, name: replacement})


@every_example
def test_autocast_computes_in_float32(backend: str, example: Example) -> None:
    """Half-precision arguments of a half-precision region are widened: the results are those of float32."""
    exact = example.example(37)
    rounded = {k: v.bfloat16() if isinstance(v, Tensor) and v.is_floating_point() else v for k, v in exact.items()}
    wide = {k: v.float() if isinstance(v, Tensor) and v.is_floating_point() else v for k, v in rounded.items()}
    leaves, order = example.leaves(exact), min(order_of(example), 1)
    expected = evaluate(example.native, wide, leaves, order)

    def call(**arguments: Any) -> Any:
        with torch.autocast("cpu", torch.bfloat16):
            return example.native(**arguments)

    actual = evaluate(call, rounded, leaves, order)
    for name, value in actual.items():
        if name.startswith("grad_"):
            assert value.dtype == rounded[name.removeprefix("grad_")].dtype, name
            assert torch.equal(value, expected[name].to(value.dtype)), name
        else:
            assert value.dtype == expected[name].dtype, name
            assert torch.equal(value, expected[name]), name


@pytest.mark.parametrize("dtype", HALF, ids=str)
@pytest.mark.parametrize("example", [x for x in EXAMPLES if x.features], ids=str)
def test_half_storage(backend: str, example: Example, dtype: torch.dtype) -> None:
    """Features in half precision beside geometry in float32: as in float32, rounded once at the end."""
    arguments = example.example(61, dtype)
    leaves, order = example.leaves(arguments), min(order_of(example), 1)
    actual = evaluate(example.native, arguments, leaves, order)
    expected = evaluate(example.reference, widened(arguments), leaves, order)
    same_dtypes = evaluate(example.reference, arguments, leaves, order)
    for name, value in actual.items():
        assert value.dtype == same_dtypes[name].dtype, name
        leaf = arguments.get(name.removeprefix("grad_"))
        if name.startswith("grad_") and isinstance(leaf, Tensor):
            assert value.dtype == leaf.dtype, name
        if value.dim() == 0:
            continue  # one sum over all rays, which may cancel to any relative error
        if value.is_floating_point():
            rounding = torch.finfo(value.dtype).eps if value.dtype in HALF else GRADIENT[torch.float32]
            assert_close(value.double(), expected[name], rounding, name)
        else:
            assert torch.equal(value, expected[name]), name


def transposed(tensor: Tensor) -> Tensor:
    dims = tuple(reversed(range(tensor.dim())))
    return tensor.permute(dims).contiguous().permute(dims)


def sliced(tensor: Tensor) -> Tensor:
    return tensor.repeat_interleave(2, dim=-1)[..., ::2] if tensor.dim() else tensor


def shifted(tensor: Tensor) -> Tensor:
    """Contiguous, one element behind an aligned address."""
    memory = tensor.new_empty(tensor.numel() + 1)
    memory[1:] = tensor.flatten()
    return memory[1:].view(tensor.shape)


LAYOUTS: list[Callable[[Tensor], Tensor]] = [transposed, sliced, shifted]


@pytest.mark.parametrize("layout", LAYOUTS, ids=[layout.__name__ for layout in LAYOUTS])
@every_example
def test_memory_layout_does_not_matter(native: None, example: Example, layout: Callable[[Tensor], Tensor]) -> None:
    arguments = example.example(150)
    leaves, order = example.leaves(arguments), order_of(example)
    expected = evaluate(example.native, arguments, leaves, order)
    strided = {name: layout(value) if isinstance(value, Tensor) else value for name, value in arguments.items()}
    for name, value in strided.items():
        if isinstance(value, Tensor):
            assert torch.equal(value, arguments[name])
    assert_same_bits(evaluate(example.native, strided, leaves, order), expected)


@every_example
def test_expanded_tensors_are_read_and_not_written(native: None, example: Example) -> None:
    """Rows that share memory, in arguments and (gradient of a sum) in cotangents."""
    arguments = example.example(40)
    leaves, order = example.leaves(arguments), order_of(example)
    for name, value in arguments.items():
        if not (isinstance(value, Tensor) and value.is_floating_point() and value.dim() > 1):
            continue
        expanded = value[:1].expand_as(value)
        before = expanded.clone()
        actual = evaluate(example.native, arguments | {name: expanded}, leaves, order)
        assert_same_bits(actual, evaluate(example.native, arguments | {name: before}, leaves, order), name)
        assert torch.equal(expanded, before)
    if leaves:
        held = {name: arguments[name].detach().requires_grad_() for name in leaves}
        out = [x for x in outputs(example.native(**(arguments | held))).values() if x.requires_grad]
        inputs = list(held.values())
        by_sum = grads([value.sum() for value in out], inputs)
        out = [x for x in outputs(example.native(**(arguments | held))).values() if x.requires_grad]
        by_ones = grads(out, inputs, [torch.ones_like(value) for value in out])
        assert all(torch.equal(a, b) for a, b in zip(by_sum, by_ones, strict=True))


@every_example
def test_empty(backend: str, example: Example) -> None:
    arguments = example.example(0)
    leaves, order = example.leaves(arguments), order_of(example)
    actual = evaluate(example.native, arguments, leaves, order)
    assert_same_bits(actual, evaluate(example.reference, arguments, leaves, order))
    assert all(not value.any() or (value == -1).all() for value in actual.values())  # -1: no such row
    like_full = evaluate(example.native, example.example(3), leaves, order)
    for name, value in actual.items():
        assert value.dim() == like_full[name].dim() and value.dtype == like_full[name].dtype, name


@pytest.mark.parametrize("example", [x for x in EXAMPLES if x.order], ids=str)
def test_a_further_derivative_is_refused_by_name(native: None, example: Example) -> None:
    """Not silently left out of a sum."""
    assert example.order is not None
    arguments = example.example(9)
    held = {name: arguments[name].detach().requires_grad_() for name in example.leaves(arguments)}
    values = [x for x in outputs(example.native(**(arguments | held))).values() if x.requires_grad]
    for _ in range(example.order):
        first = grads([value.square().sum() for value in values], list(held.values()), create_graph=True)
        values = [grad for grad in first if grad.requires_grad]
    with pytest.raises(RuntimeError, match=rf"({example.op}\w*|project_bev)_backward: a further derivative"):
        grads([value.square().sum() for value in values], list(held.values()))


@pytest.mark.parametrize("example", [x for x in EXAMPLES if x.order == 0], ids=str)
def test_outputs_without_derivative_carry_none(backend: str, example: Example) -> None:
    arguments = example.example(9)
    held = {
        name: value.requires_grad_() if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in arguments.items()
    }
    assert not any(value.requires_grad for value in outputs(example.native(**held)).values())


@pytest.fixture(scope="module")
def calls() -> dict[str, list[tuple[Any, ...]]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PRED_BACKEND", "native")
        return recorded_calls()


def test_examples_reach_every_registered_op(native: None, calls: dict[str, list[tuple[Any, ...]]]) -> None:
    assert sorted(calls) == registered_ops()


def with_derivative(op: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments, as leaves where the op has a derivative in them."""
    held = tuple(
        value.clone().requires_grad_() if isinstance(value, Tensor) and value.is_floating_point() else value
        for value in arguments
    )
    result = op(*held)
    targets = [value for value in (result if isinstance(result, tuple) else (result,)) if value.requires_grad]
    leaves = [value for value in held if isinstance(value, Tensor) and value.requires_grad]
    if not targets:
        return arguments
    try:
        torch.autograd.grad([value.sum() for value in targets], leaves, allow_unused=True)
    except RuntimeError as error:
        assert "a further derivative is not supported" in str(error)
        return arguments
    return held


@pytest.mark.parametrize("name", registered_ops())
def test_opcheck(native: None, calls: dict[str, list[tuple[Any, ...]]], name: str) -> None:
    op = getattr(torch.ops.pred, name).default
    for arguments in calls[name]:
        torch.library.opcheck(op, with_derivative(op, arguments))


@pytest.mark.parametrize("name", registered_ops())
def test_direct_calls_refuse_vmap(native: None, calls: dict[str, list[tuple[Any, ...]]], name: str) -> None:
    first = calls[name][-1]
    batched = [torch.stack([value, value]) if isinstance(value, Tensor) else value for value in first]
    dims = tuple(0 if isinstance(value, Tensor) else None for value in first)
    with pytest.raises(RuntimeError, match=rf"{name}: torch.vmap is not supported"):
        torch.vmap(getattr(torch.ops.pred, name), in_dims=dims)(*batched)
