# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What composite_rays and composite_alpha share: packed rays, half storage, empty input, threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from pred import ops
from pred.ops import Composite, reference
from tests.conftest import require_value_checks
from tests.tolerances import FORWARD, GRADIENT, assert_close

OPS = ("composite_rays", "composite_alpha")
OUTPUTS = ("weights", "depth", "opacity", "values")
INPUTS = ("source", "t", "values")
LENGTHS = [0, 1, 5, 16, 17, 0, 33, 1, 224, 64, 2, 300, 15, 128, 129, 4, 65, 0]
OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "composite_rays": {"default": {}, "mid": {"depth_at": "mid", "last": "opaque"}},
    "composite_alpha": {
        "default": {},
        "mid": {"depth_at": "mid", "transmittance_eps": 1e-3},
    },
}
BOTH = [(op, name) for op in OPS for name in OPTIONS[op]]
HALF = [torch.bfloat16, torch.float16]


def function(op: str, module: Any = ops) -> Callable[..., Composite]:
    """The op as a function of source (distances or opacities), t and values."""
    found: Callable[..., Composite] = getattr(module, op)
    if op == "composite_alpha":
        return found
    return lambda sdf, *inputs, **options: found(sdf, 2.7, *inputs, **options)


def offsets_of(lengths: list[int]) -> Tensor:
    return torch.tensor([0, *lengths]).cumsum(dim=0)


def packed_case(
    op: str, lengths: list[int], channels: int = 4, dtype: torch.dtype = torch.float64
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Source, t and values of rays end to end, and their offsets."""
    total = sum(lengths)
    generator = torch.Generator().manual_seed(100 * total + channels)
    t = torch.cat([torch.rand(n, generator=generator, dtype=torch.float64).cumsum(dim=0) + 1 for n in lengths])
    if op == "composite_rays":
        source = 3 - 0.5 * t + 0.4 * torch.randn(total, generator=generator, dtype=torch.float64)
    else:
        source = torch.rand(total, generator=generator, dtype=torch.float64) ** 5
        source = torch.where(torch.rand(total, generator=generator) > 0.98, 1.0, source)
    values = torch.randn(total, channels, generator=generator, dtype=torch.float64)
    return (source.to(dtype), t.to(dtype), values.to(dtype)), offsets_of(lengths)


def results(call: Callable[..., Composite], inputs: tuple[Tensor, ...], **options: Any) -> dict[str, Tensor]:
    """Outputs, and derivatives of their sum with fixed cotangents, which depend on the place within the ray only."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    out = call(*leaves, **options)
    assert out.depth is not None
    found = dict(zip(OUTPUTS, out, strict=True))
    place = out.weights.new_zeros(out.weights.shape)
    if "ray_offsets" in options:
        begin = torch.repeat_interleave(options["ray_offsets"][:-1], options["ray_offsets"].diff())
        place = (torch.arange(place.shape[0]) - begin).to(place.dtype)
    else:
        place = place + torch.arange(place.shape[-1])
    total = (out.weights * torch.cos(place)).sum() - 0.3 * out.depth.sum() + 0.7 * out.opacity.sum()
    if out.values is not None:
        channel = torch.arange(out.values.shape[-1], dtype=out.values.dtype)
        total = total + (out.values * torch.sin(channel + 1)).sum()
    grads = torch.autograd.grad(total, leaves)
    found |= {f"grad_{name}": grad for name, grad in zip(INPUTS, grads, strict=False)}
    return {name: value.detach() for name, value in found.items() if value is not None}


def ray_by_ray(op: str, inputs: tuple[Tensor, ...], offsets: Tensor, **options: Any) -> dict[str, Tensor]:
    """The dense reference on each ray alone, in float64."""
    parts = []
    for begin, end in zip(offsets.tolist(), offsets.tolist()[1:], strict=False):
        ray = tuple(tensor[begin:end][None].double() for tensor in inputs)
        parts.append(results(function(op, reference), ray, **options))
    per_sample = {"weights", "grad_source", "grad_t", "grad_values"}
    return {
        name: torch.cat([part[name][0] if name in per_sample else part[name] for part in parts]) for name in parts[0]
    }


# --- Packed rays ---------------------------------------------------------------------------------
@pytest.mark.parametrize("op", OPS)
def test_packed_hand_computed(backend: str, op: str) -> None:
    """Three rays: opacities (1/2, 1/4), none, (1/2, 1/2, ...), for either op."""
    offsets = torch.tensor([0, 3, 3, 5])
    t = torch.tensor([1.0, 2.0, 3.0, 10.0, 20.0], dtype=torch.float64)
    values = torch.tensor([[1.0], [2.0], [3.0], [4.0], [5.0]], dtype=torch.float64)
    alpha = torch.tensor([0.5, 0.25, 0.0, 0.5, 0.0], dtype=torch.float64)
    if op == "composite_alpha":
        out = ops.composite_alpha(alpha, t, values, ray_offsets=offsets)
    else:  # Phi = 0.8, 0.4, 0.3 and 0.8, 0.4: alpha_i = 1 - Phi_{i+1} / Phi_i
        sdf = torch.logit(torch.tensor([0.8, 0.4, 0.3, 0.8, 0.4], dtype=torch.float64))
        out = ops.composite_rays(sdf, 1.0, t, values, ray_offsets=offsets)
    assert out.depth is not None and out.values is not None
    assert out.weights.tolist() == pytest.approx([0.5, 0.125, 0.0, 0.5, 0.0])
    assert out.opacity.tolist() == pytest.approx([0.625, 0.0, 0.5])
    assert out.depth.tolist() == pytest.approx([0.75, 0.0, 5.0])
    assert out.values[:, 0].tolist() == pytest.approx([0.75, 0.0, 2.0])
    if op == "composite_rays":
        opaque = ops.composite_rays(sdf, 1.0, t, ray_offsets=offsets, last="opaque")
        assert opaque.weights.tolist() == pytest.approx([0.5, 0.125, 0.375, 0.5, 0.5])
        assert opaque.opacity.tolist() == pytest.approx([1.0, 0.0, 1.0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [None, 1, 4, 19])
@pytest.mark.parametrize(("op", "name"), BOTH)
def test_packed_equals_ray_by_ray(backend: str, op: str, name: str, channels: int | None, dtype: torch.dtype) -> None:
    inputs: tuple[Tensor, ...]
    inputs, offsets = packed_case(op, LENGTHS, channels or 0, dtype)
    if channels is None:
        inputs = inputs[:2]
    options = OPTIONS[op][name]
    actual = results(function(op), inputs, ray_offsets=offsets, **options)
    expected = ray_by_ray(op, inputs, offsets, **options)
    assert actual["weights"].shape == (sum(LENGTHS),) and actual["depth"].shape == (len(LENGTHS),)
    for key, value in actual.items():
        assert value.dtype == dtype
        tolerance = (GRADIENT if key.startswith("grad") else FORWARD)[dtype]
        assert_close(value.double(), expected[key], tolerance, key)


@pytest.mark.parametrize("op", OPS)
def test_packed_depth_can_be_normalized(backend: str, op: str) -> None:
    """In float64: the derivative of a quotient of small sums cancels."""
    inputs, offsets = packed_case(op, LENGTHS)
    actual = results(function(op), inputs, ray_offsets=offsets, normalize_depth=True)
    for name, expected in ray_by_ray(op, inputs, offsets, normalize_depth=True).items():
        assert_close(actual[name], expected, GRADIENT[torch.float64], name)


@pytest.mark.parametrize("op", OPS)
def test_packed_equals_dense_bitwise(native: None, op: str) -> None:
    inputs, offsets = packed_case(op, [37] * 11, dtype=torch.float32)
    packed = results(function(op), inputs, ray_offsets=offsets)
    dense = results(function(op), tuple(tensor.unflatten(0, (11, 37)) for tensor in inputs))
    for name, value in packed.items():
        assert torch.equal(value, dense[name].reshape(value.shape)), name


@pytest.mark.parametrize("op", OPS)
@pytest.mark.parametrize("lengths", [[], [0], [0, 0, 0], [1], [0, 1, 0]], ids=str)
@pytest.mark.parametrize("channels", [0, 3])
def test_packed_rays_without_samples(backend: str, op: str, lengths: list[int], channels: int) -> None:
    total = sum(lengths)
    leaves = [torch.ones(total), torch.full((total,), 2.0), torch.ones(total, channels)]
    found = results(function(op), tuple(leaves), ray_offsets=offsets_of(lengths))
    empty = [ray for ray, length in enumerate(lengths) if length == 0]
    assert found["weights"].shape == (total,)
    assert found["depth"].shape == found["opacity"].shape == (len(lengths),)
    assert found["values"].shape == (len(lengths), channels)
    for name in ("depth", "opacity", "values"):
        assert not found[name][empty].any(), name
    for name, leaf in zip(INPUTS, leaves, strict=True):
        assert found[f"grad_{name}"].shape == leaf.shape and found[f"grad_{name}"].isfinite().all()


@pytest.mark.parametrize("op", OPS)
@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0)])
@pytest.mark.parametrize("channels", [0, 2])
def test_empty(backend: str, op: str, shape: tuple[int, int], channels: int) -> None:
    leaves = (torch.ones(shape), torch.ones(shape), torch.ones(*shape, channels))
    found = results(function(op), leaves)
    assert found["depth"].shape == (shape[0],) and found["values"].shape == (shape[0], channels)
    assert not found["depth"].any() and not found["opacity"].any() and not found["values"].any()
    for name, leaf in zip(INPUTS, leaves, strict=True):
        assert found[f"grad_{name}"].shape == leaf.shape


def test_packed_sharpness_has_its_gradient(backend: str) -> None:
    (sdf, t, _), offsets = packed_case("composite_rays", LENGTHS)
    inv_s = torch.tensor(2.7, dtype=torch.float64, requires_grad=True)
    out = ops.composite_rays(sdf, inv_s, t, ray_offsets=offsets)
    assert out.depth is not None
    (actual,) = torch.autograd.grad(out.depth.sum(), inv_s)
    total = torch.zeros((), dtype=torch.float64)
    for begin, end in zip(offsets.tolist(), offsets.tolist()[1:], strict=False):
        part = reference.composite_rays(sdf[None, begin:end], inv_s, t[None, begin:end]).depth
        assert part is not None
        total = total + part.sum()
    (expected,) = torch.autograd.grad(total, inv_s)
    assert_close(actual, expected, GRADIENT[torch.float64])


@pytest.mark.parametrize("op", OPS)
def test_packed_nan_stays_in_its_ray(backend: str, op: str) -> None:
    """The last sample of a ray touches neither its padding nor the next ray, in values and in gradients."""
    lengths = [16, 17, 0, 5, 40]
    inputs, offsets = packed_case(op, lengths, 3, torch.float32)
    clean = results(function(op), inputs, ray_offsets=offsets)
    for number in range(3):
        for place in (16, 30, 32):  # first, middle and last of ray 1
            dirty = tuple(tensor.clone() for tensor in inputs)
            dirty[number][place] = torch.nan
            found = results(function(op), dirty, ray_offsets=offsets)
            for name, value in found.items():
                others = [0, 2, 3, 4] if value.shape[0] == 5 else [*range(16), *range(33, 78)]
                assert torch.equal(value[others], clean[name][others]), (name, number, place)
            assert any(value.isnan().any() for value in found.values())


@pytest.mark.parametrize("op", OPS)
def test_packed_gradcheck(backend: str, op: str) -> None:
    inputs, offsets = packed_case(op, [3, 0, 1, 4], 2)
    leaves = tuple(tensor.requires_grad_() for tensor in inputs)
    call = function(op)
    assert torch.autograd.gradcheck(lambda *x: tuple(call(*x, ray_offsets=offsets, depth_at="mid")), leaves)


@pytest.mark.parametrize("op", OPS)
def test_packed_layouts_agree(backend: str, op: str) -> None:
    (source, t, values), offsets = packed_case(op, LENGTHS)
    expected = function(op)(source, t, values, ray_offsets=offsets)
    strided = values.T.contiguous().T
    every_other = torch.stack([offsets, offsets], dim=1).flatten()[::2]
    actual = function(op)(source[:, None], t[:, None], strided, ray_offsets=every_other)
    for one, other in zip(actual, expected, strict=True):
        assert one is not None and other is not None and torch.equal(one, other)


@pytest.mark.parametrize("op", OPS)
def test_packed_errors(backend: str, op: str) -> None:
    (source, t, values), offsets = packed_case(op, [3, 2])
    call = function(op)
    name = "sdf" if op == "composite_rays" else "alpha"
    for wrong in ([0, 3, 4], [1, 3, 5], [0, 6, 5], [0, -1, 5], [0, 3]):
        with pytest.raises(ValueError, match=rf"{op}: ray_offsets must ascend from 0 to P=5, got \[{wrong[0]}, "):
            call(source, t, values, ray_offsets=torch.tensor(wrong))
    with pytest.raises(ValueError, match=rf"{op}: ray_offsets must ascend from 0 to P=5, got \[0, 0, .*\] ... 4"):
        call(source, t, values, ray_offsets=torch.tensor([0] * 30 + [4]))
    with pytest.raises(ValueError, match=rf"{op}: ray_offsets must have shape \[R \+ 1\], got \[1, 3\]"):
        call(source, t, values, ray_offsets=offsets[None])
    with pytest.raises(ValueError, match=rf"{op}: ray_offsets must have shape \[R \+ 1\] with R >= 0, got \[0\]"):
        call(source, t, values, ray_offsets=offsets[:0])
    with pytest.raises(TypeError, match=f"{op}: ray_offsets must be int64, got int32"):
        call(source, t, values, ray_offsets=offsets.int())
    with pytest.raises(ValueError, match=rf"{op}: {name} must have shape \[P\], got \[5, 2\]"):
        call(values[:, :2], t, values, ray_offsets=offsets)
    with pytest.raises(ValueError, match=rf"{op}: t must have shape \[5\] as {name}, got \[4\]"):
        call(source, t[1:], values, ray_offsets=offsets)
    with pytest.raises(ValueError, match=rf"{op}: values must have shape \[5, C\], got \[4, 4\]"):
        call(source, t, values[1:], ray_offsets=offsets)
    with pytest.raises(ValueError, match=rf"{op}: ray_offsets must be on the device of {name} \(cpu\), got meta"):
        call(source, t, values, ray_offsets=offsets.to("meta"))


def test_packed_offsets_are_checked_by_the_kernel(native: None) -> None:
    """A compiled graph does not look at them; memory is safe nevertheless."""
    require_value_checks("native")
    alpha = torch.ones(5)
    for wrong in ([0, 3, 9], [0, 9, 5], [-3, 5]):
        with pytest.raises((ValueError, RuntimeError), match="ray_offsets must ascend from 0 to P=5"):
            torch.ops.pred.composite_alpha(alpha, None, None, torch.tensor(wrong), 0.0, False)


@pytest.mark.parametrize("op", OPS)
def test_bitwise_equal_for_any_thread_count(native: None, op: str) -> None:
    """Also where one ray has most of the samples."""
    generator = torch.Generator().manual_seed(0)
    lengths = torch.randint(0, 300, (300,), generator=generator).tolist()
    for packed in (lengths, [*lengths[:20], 40_000, *lengths[20:60]]):
        inputs, offsets = packed_case(op, packed, 5, torch.float32)
        found = []
        for threads in (1, 2, 7):
            torch.set_num_threads(threads)
            found.append(results(function(op), inputs, ray_offsets=offsets))
        for other in found[1:]:
            assert all(torch.equal(value, other[name]) for name, value in found[0].items())


# --- Half storage --------------------------------------------------------------------------------
@pytest.mark.parametrize("half", HALF)
@pytest.mark.parametrize("channels", [1, 3, 8, 19, 40])
@pytest.mark.parametrize("op", OPS)
def test_half_values(backend: str, op: str, channels: int, half: torch.dtype) -> None:
    """Read as stored, computed in float32, rounded once."""
    (source, t, values), offsets = packed_case(op, LENGTHS, channels, torch.float32)
    values = values.to(half)
    actual = results(function(op), (source, t, values), ray_offsets=offsets)
    assert actual["values"].dtype == actual["grad_values"].dtype == half
    assert actual["weights"].dtype == actual["grad_source"].dtype == actual["grad_t"].dtype == torch.float32
    # The same in float32 with the cotangent that autograd rounds to half.
    leaves = [tensor.clone().requires_grad_() for tensor in (source, t, values.float())]
    out = function(op)(*leaves, ray_offsets=offsets)
    assert out.depth is not None and out.values is not None
    assert torch.equal(actual["values"], out.values.detach().to(half))
    begin = torch.repeat_interleave(offsets[:-1], offsets.diff())
    place = (torch.arange(source.shape[0]) - begin).float()
    sine = torch.sin(torch.arange(channels, dtype=half) + 1).float().expand(len(LENGTHS), -1)
    total = (out.weights * torch.cos(place)).sum() - 0.3 * out.depth.sum() + 0.7 * out.opacity.sum()
    grads = torch.autograd.grad([total, out.values], leaves, [torch.ones(()), sine])
    assert torch.equal(actual["grad_values"], grads[2].to(half))
    assert torch.equal(actual["grad_source"], grads[0]) and torch.equal(actual["grad_t"], grads[1])


@pytest.mark.parametrize("half", HALF)
@pytest.mark.parametrize("op", OPS)
def test_half_values_on_every_level(level: str, op: str, half: torch.dtype) -> None:
    (source, t, values), _ = packed_case(op, [37] * 6, 19, torch.float32)
    inputs = tuple(x.unflatten(0, (6, 37)) for x in (source, t, values.to(half)))
    actual = results(function(op), inputs)
    expected = results(function(op, reference), inputs)
    for name, value in actual.items():
        assert value.dtype == expected[name].dtype
        unit = {torch.bfloat16: 2**-8, torch.float16: 2**-11}.get(value.dtype, 1e-5)  # a value between two halves
        assert_close(value.float(), expected[name].float(), unit, name)


@pytest.mark.parametrize("half", HALF)
def test_large_half_gradient_equals_that_of_its_parts(native: None, half: torch.dtype) -> None:
    """A gradient of 16 MiB and more is stored past the caches."""
    (alpha, t, values), _ = packed_case("composite_alpha", [225] * 301, 129, torch.float32)
    alpha, values = alpha.view(301, 225), values.view(301, 225, 129).to(half)
    cotangent = torch.randn(301, 129, generator=torch.Generator().manual_seed(0)).to(half)
    grads: list[Tensor] = []
    for rays in (slice(0, 301), slice(0, 150), slice(150, 301)):
        part = values[rays].clone().requires_grad_()
        out = ops.composite_alpha(alpha[rays], values=part).values
        assert out is not None
        grads += torch.autograd.grad(out, part, cotangent[rays])
    assert grads[0].nbytes > 16 << 20
    assert torch.equal(grads[0], torch.cat(grads[1:]))


@pytest.mark.parametrize("half", HALF)
@pytest.mark.parametrize("op", OPS)
def test_half_geometry_is_computed_in_float32(backend: str, op: str, half: torch.dtype) -> None:
    (source, t, values), offsets = packed_case(op, LENGTHS, 3, torch.float32)
    source, t = source.to(half), t.to(half)
    actual = results(function(op), (source, t, values), ray_offsets=offsets)
    expected = results(function(op), (source.float(), t.float(), values), ray_offsets=offsets)
    for name in OUTPUTS:
        assert torch.equal(actual[name], expected[name]), name
    for name in ("grad_source", "grad_t"):
        assert torch.equal(actual[name], expected[name].to(half)), name


@pytest.mark.parametrize("op", OPS)
def test_dtypes_that_do_not_mix(backend: str, op: str) -> None:
    (source, t, values), offsets = packed_case(op, LENGTHS)
    name = "sdf" if op == "composite_rays" else "alpha"
    for wrong in (values.float(), values.half(), values.bfloat16()):
        with pytest.raises(TypeError, match=rf"{op}: values must have the dtype of {name} \(torch.float64\)"):
            function(op)(source, t, wrong, ray_offsets=offsets)
    with pytest.raises(TypeError, match=rf"{op}: values must have the dtype of {name} \(torch.float32\)"):
        function(op)(source.float(), t.float(), values, ray_offsets=offsets)
    with pytest.raises(TypeError, match=f"{op}: {name} must be float32 or float64, got int64"):
        function(op)(source.long(), t, values, ray_offsets=offsets)
