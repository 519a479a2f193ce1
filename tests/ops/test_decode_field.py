# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""decode_field: values, the distance's gradient, and derivatives of all three outputs together."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pred.models.field import FieldConfig, FieldDecoder
from pred.ops import decode_field, reference
from pred.ops.decode_field import DecodedField, project_bev
from tests.conftest import KERNEL_ERROR
from tests.tolerances import assert_close

RANGE = (-8.0, -4.0, -1.0, 8.0, 4.0, 3.0)
LOW, HIGH = torch.tensor(RANGE, dtype=torch.float64).view(2, 3)
FP32, BF16 = 1e-5, 2e-2


class Case(NamedTuple):
    """Arguments of one call."""

    bev: Tensor
    points: Tensor
    weights: list[Tensor]
    biases: list[Tensor]
    settings: dict[str, Any]

    def call(self, function: Any = decode_field, **options: Any) -> DecodedField:
        result: DecodedField = function(
            self.bev, self.points, self.weights, self.biases, RANGE, **(self.settings | options)
        )
        return result

    def to(self, dtype: torch.dtype) -> Case:
        """The same numbers, rounded, as new leaves."""
        bev, points = (tensor.detach().to(dtype).requires_grad_() for tensor in (self.bev, self.points))
        weights = [weight.detach().to(dtype).requires_grad_() for weight in self.weights]
        biases = [bias.detach().to(dtype).requires_grad_() for bias in self.biases]
        return Case(bev, points, weights, biases, self.settings)

    @property
    def leaves(self) -> list[Tensor]:
        return [self.bev, self.points, *self.weights, *self.biases]


def make(
    hidden: int = 32,
    layers: int = 4,
    classes: int = 5,
    channels: int = 6,
    frequencies: int = 3,
    beta: float = 10.0,
    frames: int = 2,
    count: int = 110,
    spread: float = 1.2,
    seed: int = 0,
) -> Case:
    """Points up to ``spread`` times the box away from its centre; activations of order one. Numbers fit float32, and
    points are multiples of 1/64 m plus 1/128 m, off the lines through cell centres."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).float().double()

    width = channels + 3 + 6 * frequencies
    octaves = torch.cat([torch.ones(channels + 3), (0.5 ** torch.arange(frequencies)).repeat_interleave(3).repeat(2)])
    sizes = [width] + [hidden] * (layers - 1) + [1 + classes]
    weights = [normal(after, before) * (2 / before) ** 0.5 for before, after in zip(sizes, sizes[1:], strict=False)]
    weights[0] *= octaves
    biases = [0.1 * normal(after) for after in sizes[1:]]
    scaled = torch.rand(frames, count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    points = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * scaled * spread
    points = (points * 64).floor() / 64 + 1 / 128
    bev = normal(frames, channels, 4, 8)
    settings = {"frequencies": frequencies, "softplus_beta": beta, "sdf_scale": 2.5}
    made = Case(bev, points, weights, biases, settings).to(torch.float32)  # exact in float32
    return made.to(torch.float64)


def outputs(field: DecodedField) -> list[Tensor]:
    return [value for value in field if value is not None]


def results(case: Case, function: Any = decode_field, **options: Any) -> dict[str, Tensor]:
    """Outputs, and gradients of a loss that mixes all of them with fixed cotangents."""
    out = case.call(function, **options)
    loss = torch.zeros((), dtype=case.points.dtype)
    found = {}
    generator = torch.Generator().manual_seed(99)
    for name, value in zip(out._fields, out, strict=True):
        if value is None:
            continue
        found[name] = value.detach()
        cotangent = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        loss = loss + (value * cotangent.to(value)).sum()
    names = ["bev", "points", *(f"{kind}[{i}]" for kind in ("weights", "biases") for i in range(len(case.weights)))]
    grads = torch.autograd.grad(loss, case.leaves)
    return found | {f"grad_{name}": grad for name, grad in zip(names, grads, strict=True)}


def bilinear(bev: Tensor, position: Tensor) -> Tensor:
    """Cells, and zeros outside, by their weights: older versions of torch sample once differentiably only."""
    height, width = bev.shape[2:]
    padded = F.pad(bev, (1, 1, 1, 1)).permute(0, 2, 3, 1)
    column, row = ((position[..., axis] + 1) * size / 2 - 0.5 for axis, size in enumerate((width, height)))
    frame = torch.arange(len(bev))[:, None]
    features = torch.zeros(())
    for r in (row.detach().floor(), row.detach().floor() + 1):
        for c in (column.detach().floor(), column.detach().floor() + 1):
            cells = padded[frame, (r + 1).long().clamp(0, height + 1), (c + 1).long().clamp(0, width + 1)]
            features = features + ((1 - (row - r).abs()) * (1 - (column - c).abs()))[..., None] * cells
    return features


def plain(
    bev: Tensor, points: Tensor, weights: list[Tensor], biases: list[Tensor], *_: Any, **settings: Any
) -> DecodedField:
    """By the definition, and the gradient by double backward."""
    if not points.requires_grad:
        points = points.detach().requires_grad_()
    position = (points - (LOW + HIGH) / 2) / ((HIGH - LOW) / 2)
    features = bilinear(bev, position)
    octaves = [2.0**k for k in range(settings["frequencies"])]
    parts = [
        features,
        position,
        *(torch.sin(f * position) for f in octaves),
        *(torch.cos(f * position) for f in octaves),
    ]
    values = torch.cat(parts, dim=-1)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        z = values @ weight.T + bias
        values = torch.logaddexp(settings["softplus_beta"] * z, z.new_zeros(())) / settings["softplus_beta"]
    output = values @ weights[-1].T + biases[-1]
    sdf = output[..., 0] * settings["sdf_scale"]
    gradient = None
    if settings.get("with_gradient"):
        (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=True)
    return DecodedField(sdf, output[..., 1:] if output.shape[-1] > 1 else None, gradient)


def assert_all_close(actual: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """By the norm of each tensor."""
    assert list(actual) == list(expected)
    for name, value in actual.items():
        error = (value.double() - expected[name].double()).norm() / expected[name].double().norm().clamp_min(1e-30)
        assert error <= tolerance, f"{name}: {float(error):.3g} > {tolerance:.3g}"


@pytest.mark.parametrize("with_gradient", [False, True])
def test_equals_the_definition(with_gradient: bool, backend: str) -> None:
    case = make()
    assert_all_close(
        results(case, with_gradient=with_gradient), results(case, plain, with_gradient=with_gradient), 1e-11
    )


SIZES = [
    {"hidden": 16, "layers": 2},
    {"hidden": 48, "layers": 3, "classes": 0},
    {"hidden": 80, "layers": 5, "frequencies": 0},
    {"hidden": 256, "layers": 4, "classes": 19, "frequencies": 6, "channels": 16},
    {"hidden": 512, "layers": 3, "count": 20},
    {"hidden": 7, "layers": 3},  # no multiple of any vector
]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_precisions(sizes: dict[str, int], level: str) -> None:
    case = make(**sizes)
    expected = results(case, reference.decode_field, with_gradient=True)
    assert_all_close(results(case, with_gradient=True), expected, 1e-11)
    single = case.to(torch.float32)
    assert_all_close(results(single, with_gradient=True), expected, FP32)
    # Every hidden layer rounds its inputs, and beta = 10 multiplies what that changes in its slopes.
    deep = sizes["layers"] > 4
    assert_all_close(results(single, with_gradient=True, precision="bf16"), expected, 2.5e-2 if deep else BF16)


def test_precisions_of_an_untrained_decoder(level: str) -> None:
    """Its first layer has large high frequencies, unlike `make`."""
    torch.manual_seed(0)
    decoder = FieldDecoder(64, FieldConfig(), RANGE)
    random = make(frequencies=6, channels=64)
    weights, biases = list(decoder.parameters())[::2], list(decoder.parameters())[1::2]
    single = Case(random.bev.relu(), random.points, [*weights], [*biases], random.settings).to(torch.float32)
    expected = results(single.to(torch.float64), reference.decode_field, with_gradient=True)
    assert_all_close(results(single, with_gradient=True), expected, FP32)
    assert_all_close(results(single, with_gradient=True, precision="bf16"), expected, BF16)


@pytest.mark.parametrize("size", [1, 95, 96, 97, 1000, 5000])
def test_any_number_of_points(size: int, native: None) -> None:
    case = make(hidden=16, count=size, frames=1)
    assert_all_close(
        results(case, with_gradient=True), results(case, reference.decode_field, with_gradient=True), 1e-11
    )


@pytest.mark.parametrize("with_gradient", [False, True])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_recomputing_changes_rounding_only(precision: str, with_gradient: bool, native: None) -> None:
    case = make().to(torch.float32)
    options = {"precision": precision, "with_gradient": with_gradient}
    kept, recomputed = results(case, **options), results(case, **options, recompute=True)
    assert_all_close(kept, recomputed, {"fp32": 1e-6, "bf16": 5e-3}[precision])


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_bitwise_equal_for_any_thread_count(deterministic: None, precision: str, level: str) -> None:
    case = make(count=4000, frames=1).to(torch.float32)
    found = []
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        found.append(results(case, precision=precision, with_gradient=True))
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name]) and torch.equal(value, found[2][name]), name


def test_gradcheck_of_all_outputs_together(native: None, deterministic: None) -> None:
    case = make(hidden=16, layers=3, classes=2, channels=2, frequencies=2, beta=3.0, count=4)

    def call(bev: Tensor, points: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        half = len(layers) // 2
        out = Case(bev, points, list(layers[:half]), list(layers[half:]), case.settings).call(with_gradient=True)
        assert out.semantics is not None and out.gradient is not None
        return out.sdf, out.semantics, out.gradient

    assert torch.autograd.gradcheck(call, case.leaves)


@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize("outputs_used", [("sdf",), ("semantics",), ("gradient",), ("sdf", "gradient")], ids=str)
@pytest.mark.parametrize("wanted", [(0,), (1,), (2, 6), (0, 1, 5, 9)], ids=str)
def test_parts_of_the_derivative(
    wanted: tuple[int, ...], outputs_used: tuple[str, ...], recompute: bool, native: None
) -> None:
    """Any of the leaves, from any of the outputs."""
    case = make()

    def gradients(function: Any, **options: Any) -> dict[str, Tensor]:
        fresh = case.to(torch.float64)
        for leaf in fresh.leaves:
            leaf.requires_grad_(False)
        leaves = [fresh.leaves[position].requires_grad_() for position in wanted]
        out = fresh.call(function, with_gradient=True, **options)
        loss = sum((getattr(out, name) ** 2).sum() for name in outputs_used)
        found = torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True)
        return {str(position): grad for position, grad in zip(wanted, found, strict=True)}

    assert_all_close(gradients(decode_field, recompute=recompute), gradients(reference.decode_field), 1e-11)


def test_autocast_around_the_backward_pass_changes_no_bit(native: None, deterministic: None) -> None:
    case = make().to(torch.float32)
    plain = results(case, with_gradient=True, precision="bf16")
    with torch.autocast("cpu", torch.bfloat16):
        inside = results(case, with_gradient=True, precision="bf16")
    for name, value in plain.items():
        assert torch.equal(value, inside[name]), name


def test_inference_mode(backend: str) -> None:
    case = make()
    with torch.inference_mode():
        found = outputs(case.call(with_gradient=True))
    for value, expected in zip(found, outputs(case.call(with_gradient=True)), strict=True):
        assert_close(value, expected.detach(), 1e-13)


def test_reference_has_any_derivative() -> None:
    case = make(hidden=6, layers=3, classes=1, channels=2, frequencies=1, beta=2.0, count=3)
    settings = case.settings | {"with_gradient": True}

    def call(points: Tensor, weight: Tensor) -> tuple[Tensor, ...]:
        weights = [case.weights[0].detach(), weight, case.weights[2].detach()]
        biases = [bias.detach() for bias in case.biases]
        return tuple(outputs(reference.decode_field(case.bev.detach(), points, weights, biases, RANGE, **settings)))

    assert torch.autograd.gradgradcheck(call, (case.points, case.weights[1]))


def test_projected_map_gives_the_same(backend: str) -> None:
    case = make()
    direct = outputs(case.call(with_gradient=True))
    projected = case._replace(bev=project_bev(case.bev, case.weights[0]))
    for value, expected in zip(outputs(projected.call(with_gradient=True, projected=True)), direct, strict=True):
        assert_close(value, expected, 1e-13)


@pytest.mark.parametrize("precision", ["fp64", "fp32", "bf16"])
@pytest.mark.parametrize("channels, hidden", [(1, 1), (3, 5), (16, 33), (37, 24), (130, 70)])
@pytest.mark.parametrize("cells", [(1, 1), (1, 11), (13, 97)])
def test_products(cells: tuple[int, int], channels: int, hidden: int, precision: str, level: str) -> None:
    """The tiles of every width and height, by a product of matrices and its gradients, which are nothing else."""
    generator = torch.Generator().manual_seed(channels)
    stored = torch.bfloat16 if precision == "bf16" else torch.float64 if precision == "fp64" else torch.float32
    computed = torch.float64 if precision == "fp64" else torch.float32
    bev = torch.randn(2, channels, *cells, generator=generator, dtype=torch.float64).to(stored)
    weight = torch.randn(hidden, channels, generator=generator, dtype=torch.float64).to(stored).to(computed)
    cotangent = torch.randn(2, hidden, *cells, generator=generator, dtype=torch.float64).to(stored)
    tolerance = {"fp64": 1e-14, "fp32": 1e-6, "bf16": 2.0**-8}[
        precision
    ]  # in bf16, operands are exact, results rounded

    def call(bev: Tensor, weight: Tensor, cotangent: Tensor, function: Any) -> dict[str, Tensor]:
        bev, weight = bev.clone().requires_grad_(), weight.clone().requires_grad_()
        out = function(bev, weight)
        grad_bev, grad_weight = torch.autograd.grad(out, (bev, weight), cotangent.to(out))
        return {"out": out.detach(), "grad_bev": grad_bev, "grad_weight": grad_weight}

    def own(bev: Tensor, weight: Tensor) -> Tensor:
        return project_bev(bev, weight, "bf16" if precision == "bf16" else "fp32")

    expected = call(bev.double(), weight.double(), cotangent.double(), lambda b, w: torch.einsum("bchw,oc->bohw", b, w))
    assert_all_close(call(bev, weight, cotangent, own), expected, tolerance)


@pytest.mark.parametrize("scale", [100.0, -100.0])
def test_saturated_softplus(scale: float, level: str) -> None:
    """beta z = +-100 in every unit of the last hidden layer: slopes of 1, and of 4e-44, which float32 calls 0."""
    case = make()
    with torch.no_grad():
        case.weights[-2].zero_()
        case.biases[-2].fill_(scale / case.settings["softplus_beta"])
    expected = results(case, reference.decode_field, with_gradient=True)
    for precision, tolerance in (("fp32", FP32), ("bf16", BF16)):
        actual = results(case.to(torch.float32), with_gradient=True, precision=precision)
        for name, value in actual.items():
            assert value.isfinite().all(), name
            if scale > 0 or float(expected[name].norm()) > 1e-30:
                assert_all_close({name: value}, {name: expected[name]}, tolerance)
        if scale < 0:
            assert float(expected["gradient"].abs().max()) < 1e-40 and (actual["gradient"] == 0).all()


def test_at_cell_edges_the_gradient_is_one_sided(backend: str) -> None:
    case = make(frequencies=0, frames=1, count=1)
    centre = torch.tensor([[[1.0, 1.0, 0.5]]], dtype=torch.float64)  # of cell (x 4, y 2): cells are 2 m wide
    gradients = []
    for offset in (-1e-7, 0.0, 1e-7):
        shifted = case._replace(points=centre + torch.tensor([offset, offset, 0.0]))
        gradients.append(outputs(shifted.call(with_gradient=True))[-1])
    below, at, above = gradients
    assert (below - above).abs().max() > 1e-3
    assert_close(at, above, 1e-5)


def test_outside_the_map_is_zero(backend: str) -> None:
    case = make(frames=1)
    far = case._replace(points=case.points.detach() + torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64))
    found = far._replace(bev=case.bev * 3).call(with_gradient=True)
    for value, expected in zip(outputs(found), outputs(far.call(with_gradient=True)), strict=True):
        assert torch.equal(value, expected)


def test_nan_stays_with_its_point(level: str) -> None:
    case = make().to(torch.float32)
    points = case.points.detach().clone()
    points[0, 50, 1] = math.nan
    out, clean = case._replace(points=points).call(with_gradient=True), case.call(with_gradient=True)
    for value, expected in zip(outputs(out), outputs(clean), strict=True):
        assert value[0, 50].isnan().all()
        mask = torch.ones(points.shape[:2], dtype=torch.bool)
        mask[0, 50] = False
        assert torch.equal(value[mask], expected[mask])


@pytest.mark.parametrize("frames, count", [(1, 0), (0, 5)])
def test_nothing_to_decode(frames: int, count: int, backend: str) -> None:
    case = make()
    empty = case._replace(bev=case.bev[:frames], points=torch.zeros(frames, count, 3, dtype=torch.float64))
    out = empty.call(with_gradient=True)
    assert out.gradient is not None and out.sdf.shape == (frames, count) and out.gradient.shape == (frames, count, 3)
    grads = torch.autograd.grad(out.sdf.sum() + out.gradient.sum(), case.weights)
    assert all((grad == 0).all() for grad in grads)


def test_errors(backend: str) -> None:
    case = make(layers=3)
    bev, points, weights, biases, _ = case

    def call(
        *, bev: Any = bev, points: Any = points, weights: Any = weights, biases: Any = biases, **options: Any
    ) -> Any:
        return case._replace(bev=bev, points=points, weights=weights, biases=biases).call(**options)

    with pytest.raises(ValueError, match=r"decode_field: points must have shape \[2, N, 3\], got \[2, 110, 2\]"):
        call(points=points[..., :2])
    with pytest.raises(ValueError, match=r"decode_field: weights\[0\] must have shape \[hidden, 27\], got \[32, 26\]"):
        call(weights=[weights[0][:, 1:], *weights[1:]])
    with pytest.raises(ValueError, match=r"decode_field: weights\[1\] must have shape \[32, 32\], got \[32, 31\]"):
        call(weights=[weights[0], weights[1][:, 1:], weights[2]])
    with pytest.raises(ValueError, match="decode_field: biases must be as many as weights, 3, got 2"):
        call(biases=biases[1:])
    with pytest.raises(ValueError, match="decode_field: weights must be of 2 to 16 layers, got 1"):
        call(weights=weights[:1], biases=biases[:1])
    with pytest.raises(TypeError, match=r"decode_field: biases\[2\] must have the dtype of points"):
        call(biases=[*biases[:2], biases[2].float()])
    with pytest.raises(
        ValueError, match="decode_field: softplus_beta must be positive, finite and normal in torch.float64"
    ):
        call(softplus_beta=0)
    single = make().to(torch.float32)
    for name in ("softplus_beta", "sdf_scale"):
        with pytest.raises(ValueError, match=f"{name} must be positive, finite and normal in torch.float32, got 1e-40"):
            single.call(**{name: 1e-40})
    with pytest.raises(ValueError, match="point_range must have extents that are finite and normal in torch.float32"):
        decode_field(*single[:4], (0.0,) * 3 + (1e-40,) * 3, **single.settings)
    with pytest.raises(ValueError, match="decode_field: precision must be one of fp32, bf16, got 'fp16'"):
        call(precision="fp16")
    with pytest.raises(TypeError, match="decode_field: precision must be 'fp32' where points is torch.float64"):
        call(precision="bf16")
    with pytest.raises(ValueError, match=r"decode_field: bev must have at least one channel, got \[2, 0, 4, 8\]"):
        case._replace(bev=case.bev[:, :0]).call()
    with pytest.raises(ValueError, match=r"decode_field: weights\[0\] must have 1 to 4096 rows, got 0"):
        case._replace(weights=[case.weights[0][:0], *case.weights[1:]]).call()
    with pytest.raises(TypeError, match="decode_field: biases must be a list of tensors, got NoneType"):
        case._replace(biases=None).call()  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="decode_field: frequencies must be at most 16, got 17"):
        call(frequencies=17)


def test_direct_calls_are_checked(native: None) -> None:
    bev, points, parameters = torch.zeros(1, 16, 2, 2), torch.zeros(1, 5, 3), torch.zeros(16 * 4 + 17)
    settings: tuple[Any, ...] = ([3, 16, 1], list(RANGE), 0, 10.0, 1.0)
    call = functools.partial(torch.ops.pred.decode_field, tf32=False)
    call(bev, points, parameters, *settings, True, True)
    with pytest.raises(KERNEL_ERROR, match="decode_field: parameters must have 81 elements, got 80"):
        call(bev, points, parameters[1:], *settings, True, True)
    with pytest.raises(KERNEL_ERROR, match="decode_field: widths must start with 3 \\+ 6 octaves"):
        call(bev, points, parameters, [9, 16, 1], *settings[1:], True, True)
    with pytest.raises(KERNEL_ERROR, match="decode_field: beta must lie in .*, got 1e-40"):
        call(bev, points, parameters, *settings[:3], 1e-40, 1.0, True, True)
    huge = 1 << 62  # products of sizes would overflow before a rule is broken
    with pytest.raises(
        KERNEL_ERROR, match=f"decode_field: points must have shape \\[1, N, 3\\], got \\[2, {huge}, 0\\]"
    ):
        call(bev, torch.empty(2, huge, 0), parameters, *settings, True, True)
    with pytest.raises(KERNEL_ERROR, match=f"decode_field: projected must have 1 to 4096 channels, got {huge}"):
        call(
            torch.empty_strided((0, huge, 2, 2), (0, 0, 0, 0)),
            points[:0],
            parameters,
            [3, huge, huge, 1],
            *settings[1:],
            True,
            True,
        )
    with pytest.raises(KERNEL_ERROR, match="decode_field: dtype must be float32, float64 or bfloat16, got Half"):
        call(bev.half(), points, parameters, *settings, True, True)
    with pytest.raises(KERNEL_ERROR, match=r"decode_field_backward: grad_sdf must have shape \[1, 5\], got \[1, 4\]"):
        torch.ops.pred.decode_field_backward(
            points[:, 1:, 0], None, None, bev, points, parameters, *[torch.zeros(0, 0, 0)] * 2, *settings,
            True, True, True, True, False,
        )  # fmt: skip
