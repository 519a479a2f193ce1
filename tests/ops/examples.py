# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Example calls of every public op: what test_contract.py, test_properties.py and fuzz_ops.py run on.

A new op is one builder and one entry (or a few) in EXAMPLES.
"""

from __future__ import annotations

import functools
import inspect
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.case import gather
from pred import ops
from pred.ops import reference

HALF = (torch.bfloat16, torch.float16)
NO_OP = {"build_info", "parallel_probe"}
"""Registered in the library, but not for users."""
PUBLIC = [name for name in ops.__all__ if inspect.isfunction(getattr(ops, name))]

Arguments = dict[str, Any]


class Source:
    """Where a builder takes its numbers from.

    ``count`` is the number of rays, samples or points. Sizes keep their default here; test_properties.py draws them.
    """

    def __init__(self, seed: int, count: int) -> None:
        self.count = count
        self._generator = torch.Generator().manual_seed(seed)

    def size(self, default: int, low: int, high: int) -> int:
        """Any other size, in [low, high]."""
        return default

    def tensors(self, default: int, low: int, high: int) -> int:
        """How many tensors a list argument has."""
        return self.size(default, low, high)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self._generator, dtype=torch.float64)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self._generator, dtype=torch.float64) * (high - low) + low

    def integers(self, low: int, high: int, *shape: int) -> Tensor:
        """In [low, high); all ``low`` where that is empty."""
        return torch.randint(low, max(high, low + 1), shape, generator=self._generator)

    def offsets(self, total: int, parts: int) -> Tensor:
        """``[parts + 1]`` int64 ascending from 0 to ``total``; some parts are empty. No parts hold nothing."""
        if parts == 0:
            return torch.zeros(1, dtype=torch.int64)
        inner = self.integers(0, total + 1, parts - 1).sort().values
        return torch.cat([torch.tensor([0]), inner, torch.tensor([total])])

    def dyadic(self, low: float, high: float, *shape: int, parts: int = 1024) -> Tensor:
        """Multiples of 1 / parts: products with small whole numbers are exact in float32 too, so that a position falls
        into the same cell, on the same side of a kink, in every dtype."""
        return self.integers(round(parts * low), round(parts * high) + 1, *shape).double() / parts


class Wide(Source):
    """Rows of 40 or 64 where there may be so many: accesses of 16 bytes, and more than one turn of a warp."""

    def size(self, default: int, low: int, high: int) -> int:
        return 64 if high >= 64 else 40 if high >= 40 else default


@dataclass(frozen=True)
class Example:
    """One way to call one op."""

    op: str
    build: Callable[[Source], Arguments]
    """Arguments by name; floating-point tensors in float64."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments; they replace those of ``build``."""
    differentiable: tuple[str, ...] = ()
    """Arguments with a derivative."""
    features: tuple[str, ...] = ()
    """Arguments that may be stored in half precision; the others are float32 then."""
    order: int | None = 1
    """Derivatives that the documentation promises; None: any number."""
    tolerance: float = 1.0
    """Factor on tolerances.py for float32, with its cause beside the entry."""
    many: int = 4000
    """A count that several threads share."""
    reference_compiles: bool = True
    """Whether torch.compile makes one graph of the reference."""

    def __str__(self) -> str:
        kind = self.build.__name__.strip("_")
        named = [] if kind == self.op.removesuffix("_with_grad") else [kind]
        return "-".join([self.op, *named, *(f"{name}={value}" for name, value in self.options.items())])

    def arguments(self, source: Source, dtype: torch.dtype) -> Arguments:
        """Arguments with geometry in ``dtype`` (float32 at least) and features in ``dtype``."""
        geometry = torch.float32 if dtype in HALF else dtype
        built = self.build(source) | dict(self.options)
        return {
            name: value.to(dtype if name in self.features else geometry)
            if isinstance(value, Tensor) and value.is_floating_point()
            else value
            for name, value in built.items()
        }

    def example(self, count: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Arguments:
        """Arguments with the default sizes."""
        return self.arguments(Source(seed, count), dtype)

    def leaves(self, arguments: Arguments) -> list[str]:
        """Names of the arguments to differentiate."""
        return [name for name in self.differentiable if isinstance(arguments.get(name), Tensor)]

    @property
    def native(self) -> Callable[..., Any]:
        """The public function, which runs compiled where PRED_BACKEND says so."""
        return by_element(getattr(ops, self.op))

    @property
    def reference(self) -> Callable[..., Any]:
        return by_element(getattr(reference, self.op))


def by_element(function: Callable[..., Any]) -> Callable[..., Any]:
    """Also takes the elements of an argument that is a list, each by its own name: ``**{"weights[0]": tensor}``."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return function(*arguments, **gather(named))

    return call


def outputs(result: Any) -> dict[str, Tensor]:
    """Result tensors by name."""
    if isinstance(result, Tensor):
        return {"out": result}
    names = getattr(result, "_fields", [f"out{i}" for i in range(len(result))])
    return {name: value for name, value in zip(names, result, strict=True) if value is not None}


def evaluate(
    function: Callable[..., Any], arguments: Arguments, leaves: Sequence[str], order: int = 1
) -> dict[str, Tensor]:
    """Outputs and, up to ``order`` 2, derivatives with fixed cotangents: ``grad_<argument>`` of the outputs, and
    ``second_<argument>`` of the squared gradients, also in the cotangents. Strides of the arguments are kept."""
    held = {name: arguments[name].detach().requires_grad_(order > 0) for name in leaves}
    out = outputs(function(**(arguments | held)))
    found = {name: value.detach() for name, value in out.items()}
    targets = {name: value for name, value in out.items() if value.requires_grad}
    if order == 0 or not targets:
        return found
    cotangents = {name: steps(value).requires_grad_(order > 1) for name, value in targets.items()}
    # Where an output does not depend on an argument, torch says None; here, and in what follows, that is 0.
    first = grads(list(targets.values()), list(held.values()), list(cotangents.values()), create_graph=order > 1)
    found |= {f"grad_{name}": grad.detach() for name, grad in zip(held, first, strict=True)}
    curved = [grad for grad in first if grad.requires_grad]
    if order > 1 and curved:
        inputs = {f"cotangent_{name}": value for name, value in cotangents.items()} | held
        second = grads([grad.square().sum() for grad in curved], list(inputs.values()))
        found |= {f"second_{name}": grad for name, grad in zip(inputs, second, strict=True)}
    return found


def steps(like: Tensor) -> Tensor:
    """-1 to 2 in multiples of 1/64, which every dtype holds, so that all dtypes compute the same thing."""
    return (torch.linspace(-64, 128, like.numel()).round() / 64).reshape(like.shape).to(like)


def grads(
    values: list[Tensor], inputs: list[Tensor], cotangents: list[Tensor] | None = None, create_graph: bool = False
) -> list[Tensor]:
    """torch.autograd.grad with zeros where there is no dependence."""
    found = torch.autograd.grad(values, inputs, cotangents, create_graph=create_graph, allow_unused=True)
    return [torch.zeros_like(x) if grad is None else grad for x, grad in zip(inputs, found, strict=True)]


def order_of(example: Example) -> int:
    """Derivatives to compute; second ones stand for any number."""
    return 2 if example.order is None else example.order


def _sample_bev(source: Source) -> Arguments:
    batch, channels = source.size(2, 0, 3), source.size(5, 0, 70)
    return {
        "bev": source.normal(batch, channels, source.size(7, 1, 20), source.size(6, 1, 20)),
        "grid": source.dyadic(-1.3, 1.3, batch, source.count, 2),
    }


def _sample_volume(source: Source) -> Arguments:
    batch, channels = source.size(2, 0, 3), source.size(5, 0, 70)
    sizes = (source.size(4, 1, 9), source.size(7, 1, 20), source.size(6, 1, 20))
    return {
        "volume": source.normal(batch, channels, *sizes),
        "grid": source.dyadic(-1.3, 1.3, batch, source.count, 3),
    }


def _segment_reduce(source: Source) -> Arguments:
    segments = source.size(50, 1, 90)
    return {
        "features": source.normal(source.count, source.size(19, 0, 70)),
        "index": source.integers(-1, segments, source.count),
        "num_segments": segments,
    }


def _build_rulebook(source: Source) -> Arguments:
    """Half of the cells are active, so that most taps find a site."""
    frames, shape = source.size(2, 1, 4), (3, 8, 2 + source.count // 8)
    z, y, x = shape
    site = source.normal(frames * z * y * x).argsort()[: source.count]
    return {
        "indices": torch.stack([site // (z * y * x), site // (y * x) % z, site // x % y, site % x], dim=1),
        "batch_size": frames,
        "spatial_shape": shape,
    }


def _tables(source: Source, **kernel: Any) -> Arguments:
    rulebook = reference.build_rulebook(**_build_rulebook(source), **kernel)
    return {"out_to_in": rulebook.out_to_in, "in_to_out": rulebook.in_to_out}


def _convolution(source: Source, tables: Arguments) -> Arguments:
    channels, taps = source.size(5, 0, 70), tables["out_to_in"].shape[1]
    outputs = source.size(7, 0, 70)
    return {
        "features": source.normal(source.count, channels),
        "weight": source.normal(outputs, taps, channels) * (taps * max(1, channels)) ** -0.5,
        "bias": source.normal(outputs),
    } | tables


def _sparse_conv(source: Source) -> Arguments:
    return _convolution(source, _tables(source, kernel_size=3, stride=2, padding=1))


def _submanifold_conv(source: Source) -> Arguments:
    return _convolution(source, _tables(source, kernel_size=(1, 3, 3), submanifold=True))


def _sparse_max_pool(source: Source) -> Arguments:
    features = source.dyadic(-2, 2, source.count, source.size(5, 0, 70), parts=4)  # many are equal
    return {"features": features} | _tables(source, kernel_size=2, stride=2, padding=1)


def _clouds(source: Source, frames: int) -> Arguments:
    """Squared distances are exact in float32; many are equal."""
    return {
        "points": source.dyadic(-1, 9, source.count, source.size(4, 3, 6), parts=16),
        "batch_offsets": source.offsets(source.count, frames),
    }


def _voxelize(source: Source) -> Arguments:
    edges = {"voxel_size": (0.5, 0.25, 2.0), "point_range": (0.0, 0.0, 0.0, 8.0, 8.0, 8.0)}
    return _clouds(source, source.size(3, 1, 5)) | edges


def _voxelize_hard(source: Source) -> Arguments:
    limits = {"max_points": source.size(2, 1, 4), "max_voxels": source.size(30, 1, 60)}
    return _voxelize(source) | limits


def _farthest_point_sample(source: Source) -> Arguments:
    return _clouds(source, source.size(3, 1, 5)) | {"num_samples": source.size(9, 0, 30)}


def _queries(source: Source) -> Arguments:
    frames, count = source.size(3, 1, 5), source.count // 4
    cloud = _clouds(source, frames)
    queries = source.dyadic(-1, 9, count, cloud["points"].shape[1], parts=16)
    return cloud | {"queries": queries, "query_offsets": source.offsets(count, frames)}


def _knn(source: Source) -> Arguments:
    return _queries(source) | {"k": source.size(5, 0, 20)}


def _ball_query(source: Source) -> Arguments:
    return _queries(source) | {"radius": 2.5, "max_points": source.size(6, 0, 20)}


def _lattice_boxes(source: Source, count: int) -> Tensor:
    """Few kinds of boxes on a lattice: many are equal, share sides or lie in each other. Centres, sizes and yaws are
    exact in every dtype, and no IoU of two of them is within 1e-5 of 0.3 (tests/ops/test_boxes.py)."""
    sides = 2 + 2 * source.integers(0, 2, count, 3).double()
    centre, yaw = source.integers(-3, 4, count, 3).double(), 0.5 * source.integers(0, 2, count, 1)
    return torch.cat([centre, sides, yaw], dim=1)


def _box_iou(source: Source) -> Arguments:
    """Boxes of any size and yaw, the first of which are near each other."""
    num_a, num_b = source.count, source.size(23, 0, 60)
    boxes_a, boxes_b = (
        torch.cat([source.uniform(-6, 6, n, 3), source.uniform(0.5, 6, n, 3), source.uniform(-7, 7, n, 1)], dim=1)
        for n in (num_a, num_b)
    )
    return {"boxes_a": boxes_a, "boxes_b": boxes_b}


def _box_iou_aligned(source: Source) -> Arguments:
    boxes_a = _lattice_boxes(source, source.count)
    return {"boxes_a": boxes_a, "boxes_b": _lattice_boxes(source, source.count), "aligned": True}


def _nms_bev(source: Source) -> Arguments:
    """Many scores are equal."""
    scores = source.dyadic(0, 1, source.count, parts=16)
    return {"boxes": _lattice_boxes(source, source.count), "scores": scores, "iou_threshold": 0.3}


def _points_in_boxes_mask(source: Source) -> Arguments:
    points = source.dyadic(-6, 6, source.count, source.size(4, 3, 6), parts=16)
    return {"points": points, "boxes": _lattice_boxes(source, source.size(9, 0, 40))}


def _points_in_boxes(source: Source) -> Arguments:
    arguments, frames = _points_in_boxes_mask(source), source.size(3, 1, 5)
    return arguments | {
        "batch_offsets": source.offsets(source.count, frames),
        "box_offsets": source.offsets(len(arguments["boxes"]), frames),
    }


def _decode_field(source: Source) -> Arguments:
    """Elements of ``weights`` and ``biases`` by their own names, see ``by_element``. Points are off the lines through
    cell centres, where the derivative jumps."""
    frames, channels, classes = source.size(2, 0, 3), source.size(5, 1, 40), source.size(4, 0, 20)
    hidden, layers, frequencies = source.size(20, 1, 70), source.tensors(3, 2, 5), source.size(2, 0, 4)
    widths = [channels + 3 + 6 * frequencies, *[hidden] * (layers - 1), 1 + classes]
    arguments: Arguments = {
        "bev": source.normal(frames, channels, 8, 16),
        "points": source.dyadic(-10, 10, frames, source.count, 3, parts=8) + 1 / 16,
        "point_range": (-8.0, -4.0, -2.0, 8.0, 4.0, 2.0),
        "frequencies": frequencies,
        "softplus_beta": 3.0,
        "sdf_scale": 2.0,
    }
    pairs = list(zip(widths, widths[1:], strict=False))
    arguments |= {f"weights[{i}]": source.normal(out, into) * into**-0.5 for i, (into, out) in enumerate(pairs)}
    return arguments | {f"biases[{i}]": source.normal(out) * 0.1 for i, (_, out) in enumerate(pairs)}


def _rays(source: Source) -> Arguments:
    """Rays through soft surfaces, some of which they leave again."""
    rays, samples = source.count, source.size(33, 0, 70)
    t = source.uniform(0, 1, rays, samples).cumsum(dim=1) + 1
    sdf = source.uniform(2, 12, rays, 1) - 0.8 * t + 0.4 * source.normal(rays, samples)
    return {"sdf": sdf, "inv_s": source.uniform(1, 5, 1)[0], "t": t}


def _packed_rays(source: Source) -> Arguments:
    """The same with any number of samples on each."""
    total = source.count * source.size(9, 0, 30) if source.count else 0
    t = source.uniform(1, 12, total).sort().values
    sdf = 5 - 0.8 * t + 0.4 * source.normal(total)
    return {
        "sdf": sdf,
        "inv_s": source.uniform(1, 5, 1)[0],
        "t": t,
        "ray_offsets": source.offsets(total, source.count),
    }


def _pair(source: Source) -> Arguments:
    rays = _rays(source)
    return {"sdf": rays["sdf"], "inv_s": rays["inv_s"]}


def _packed_pair(source: Source) -> Arguments:
    rays = _packed_rays(source)
    del rays["t"]
    return rays


def _section(source: Source) -> Arguments:
    rays = _rays(source)
    shape = rays["sdf"].shape
    return {
        "sdf": rays["sdf"],
        "inv_s": rays["inv_s"],
        "cosine": source.uniform(-1, 0.9, *shape),
        "section_length": source.uniform(0.1, 1, *shape),
    }


def _density(source: Source) -> Arguments:
    shape = source.count, source.size(33, 0, 70)
    return {"sdf": source.uniform(0, 3, *shape), "section_length": source.uniform(0.1, 1, *shape)}


def _with_values(rays: Arguments, source: Source) -> Arguments:
    return rays | {"values": source.normal(*rays["t"].shape, source.size(4, 0, 40))}


def _composite_rays(source: Source) -> Arguments:
    return _with_values(_rays(source), source)


def _packed_composite_rays(source: Source) -> Arguments:
    return _with_values(_packed_rays(source), source)


def _alphas(rays: Arguments, source: Source) -> Arguments:
    """Opacities in [0, 1], some of them exactly 0 or 1."""
    alpha = (source.uniform(-0.2, 1.02, *rays.pop("sdf").shape).clamp(0, 1.01) ** 3).clamp(0, 1)
    del rays["inv_s"]
    return _with_values(rays | {"alpha": alpha}, source)


def _composite_alpha(source: Source) -> Arguments:
    return _alphas(_rays(source), source)


def _packed_composite_alpha(source: Source) -> Arguments:
    return _alphas(_packed_rays(source), source)


def _distribution(source: Source, name: str) -> Arguments:
    samples, new = source.size(24, 2, 70), source.size(17, 0, 70)
    return {
        name: source.uniform(0.1, 1, source.count, samples).cumsum(dim=1) + 1,
        # No section is nearly empty: in one, a rounding of u moves the sample by 1e-7 / weight.
        "weights": source.uniform(0.2, 1, source.count, samples),
        "num_samples": new,
        "u": source.uniform(0, 1, source.count, new),
    }


def _sample_pdf(source: Source) -> Arguments:
    return _distribution(source, "edges")


def _resample_rays(source: Source) -> Arguments:
    return _distribution(source, "t")


def _examples(op: str, build: Callable[[Source], Arguments], *options: Arguments, **fields: Any) -> list[Example]:
    return [Example(op, build, chosen, **fields) for chosen in options or ({},)]


_PADDINGS = [
    {"padding_mode": mode, "align_corners": corners} for mode in ("zeros", "border") for corners in (False, True)
]
# Positions are rounded to float32 before they are scaled to cells: 1e-7 of the map's width.
_BEV: dict[str, Any] = {"differentiable": ("bev", "grid"), "features": ("bev",), "tolerance": 4}
_VOLUME: dict[str, Any] = {"differentiable": ("volume", "grid"), "features": ("volume",), "tolerance": 4}
# Up to 70 opacities are multiplied along a ray.
_RAYS: dict[str, Any] = {
    "differentiable": ("sdf", "alpha", "inv_s", "t", "values"),
    "features": ("values",),
    "tolerance": 3,
}
# A rounding of the cumulative distribution moves a sample by 1e-7 / weight along its section.
_PDF: dict[str, Any] = {"order": 0, "tolerance": 20}
_PDF_MODES: list[Arguments] = [
    {"mode": "exact"},
    {"mode": "neus"},
    {"mode": "nerfstudio"},
    {"mode": "nerfstudio", "histogram_padding": 0.0, "min_width": 1e-5},
]

# Frequencies up to 2^3 multiply the rounding of a position, and five layers that of what they are given.
_FIELD: dict[str, Any] = {
    "differentiable": ("bev", "points", *(f"{kind}[{i}]" for kind in ("weights", "biases") for i in range(4))),
    "tolerance": 5,
}

_SPARSE: dict[str, Any] = {
    "differentiable": ("features", "weight", "bias"),
    "features": ("features", "weight", "bias"),
    "order": None,
    "tolerance": 4,  # a sum of n products carries the rounding of n additions
}

_CLOUDS: dict[str, Any] = {"features": ("points", "queries"), "reference_compiles": False}

_BOXES: dict[str, Any] = {
    "features": ("boxes_a", "boxes_b", "boxes", "points", "scores"),
    "order": 0,
    "reference_compiles": False,
}

EXAMPLES = [
    *_examples("sample_bev", _sample_bev, *_PADDINGS, order=2, **_BEV),
    *_examples("sample_bev_with_grad", _sample_bev, *_PADDINGS, **_BEV),
    *_examples("sample_volume", _sample_volume, *_PADDINGS, order=2, **_VOLUME),
    *_examples("sample_volume_with_grad", _sample_volume, *_PADDINGS, **_VOLUME),
    *_examples("decode_field", _decode_field, {}, {"with_gradient": True}, {"recompute": True}, **_FIELD),
    *_examples(
        "segment_reduce",
        _segment_reduce,
        *({"reduce": reduce} for reduce in ("sum", "mean", "max")),
        differentiable=("features",),
        features=("features",),
        order=None,
        tolerance=4,  # a sum of n rows carries the rounding of n additions
        many=20000,
    ),
    *_examples(
        "build_rulebook",
        _build_rulebook,
        {"submanifold": True},
        {"kernel_size": (3, 2, 4), "stride": (2, 1, 3), "padding": (1, 0, 2), "dilation": (1, 2, 1)},
        order=0,
        many=9000,
        reference_compiles=False,
    ),
    *_examples("sparse_conv", _sparse_conv, {}, {"bias": None}, **_SPARSE),
    *_examples("sparse_conv", _submanifold_conv, **_SPARSE),
    *_examples("sparse_max_pool", _sparse_max_pool, **_SPARSE),
    *_examples("voxelize", _voxelize, order=0, many=70000, **_CLOUDS),
    *_examples("voxelize_hard", _voxelize_hard, differentiable=("points",), order=None, many=70000, **_CLOUDS),
    *_examples("farthest_point_sample", _farthest_point_sample, {}, {"start": 4}, order=0, many=9000, **_CLOUDS),
    *_examples("knn", _knn, order=0, **_CLOUDS),
    *_examples("ball_query", _ball_query, order=0, **_CLOUDS),
    *_examples("box_iou_bev", _box_iou, **_BOXES),
    *_examples("box_iou_bev", _box_iou_aligned, **_BOXES),
    *_examples("box_iou_3d", _box_iou, **_BOXES),
    *_examples("box_iou_3d", _box_iou_aligned, **_BOXES),
    *_examples("nms_bev", _nms_bev, {}, {"pre_max": 30, "post_max": 7}, **_BOXES),
    *_examples("points_in_boxes", _points_in_boxes, {}, many=20000, **_BOXES),
    *_examples("points_in_boxes", _points_in_boxes_mask, {}, many=20000, **_BOXES),
    *_examples("points_in_boxes_mask", _points_in_boxes_mask, many=20000, **_BOXES),
    *_examples("sdf_to_alpha", _pair, {}, {"last": "opaque"}, {"inv_s": 2.7}, differentiable=("sdf", "inv_s")),
    *_examples(
        "sdf_to_alpha",
        _packed_pair,
        {},
        {"last": "opaque"},
        differentiable=("sdf", "inv_s"),
        reference_compiles=False,
    ),
    *_examples(
        "sdf_to_alpha",
        _section,
        {"mode": "section"},
        {"mode": "section", "eps": 1e-5, "cos_anneal": 0.3},
        differentiable=("sdf", "inv_s", "cosine", "section_length"),
    ),
    *_examples("sdf_to_alpha", _density, {"mode": "density", "inv_s": None}, differentiable=("sdf", "section_length")),
    *_examples(
        "composite_rays",
        _composite_rays,
        {},
        {"depth_at": "mid", "last": "opaque", "normalize_depth": True},
        {"values": None},
        {"detach_sdf": True},
        {"detach_sdf": True, "detach_inv_s": False},
        **_RAYS,
    ),
    *_examples(
        "composite_rays",
        _packed_composite_rays,
        {},
        {"depth_at": "mid", "last": "opaque"},
        {"values": None, "detach_sdf": True},
        reference_compiles=False,
        **_RAYS,
    ),
    *_examples(
        "composite_alpha",
        _composite_alpha,
        {},
        {"depth_at": "mid", "transmittance_eps": 1e-7, "normalize_depth": True},
        {"values": None},
        {"t": None},
        {"t": None, "values": None},
        **_RAYS,
    ),
    *_examples(
        "composite_alpha",
        _packed_composite_alpha,
        {},
        {"depth_at": "mid", "transmittance_eps": 1e-7},
        reference_compiles=False,
        **_RAYS,
    ),
    *_examples("sample_pdf", _sample_pdf, *_PDF_MODES, **_PDF),
    *_examples("sample_pdf", _sample_pdf, {"u": None}, {"num_samples": None}, **_PDF),
    *_examples("resample_rays", _resample_rays, *_PDF_MODES, **_PDF),
    *_examples("resample_rays", _resample_rays, {"u": None}, **_PDF),
]


class Recorder(TorchDispatchMode):
    """Keeps the arguments of every ``torch.ops.pred`` call, once per op and kind of arguments."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, dict[Any, tuple[Any, ...]]] = defaultdict(dict)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.namespace == "pred":
            assert not kwargs
            kind = tuple(
                (value.dim(), value.dtype, value.numel() == 0) if isinstance(value, Tensor) else repr(value)
                for value in args
            )
            if kind not in self.calls[func._opname]:
                plain = tuple(value.detach().clone() if isinstance(value, Tensor) else value for value in args)
                self.calls[func._opname][kind] = plain
        return func(*args, **(kwargs or {}))


LOW_PRECISION = _examples(
    "decode_field", _decode_field, *({"precision": "bf16", "with_gradient": keep} for keep in (True, False)), **_FIELD
)
"""Calls that only float32 takes and whose rounding is another: recorded and made at random; their values have tests of
their own."""


def recorded_calls() -> dict[str, list[tuple[Any, ...]]]:
    """Calls of every ``torch.ops.pred`` op that the examples and their derivatives make."""
    recorder = Recorder()
    for example in [*EXAMPLES, *LOW_PRECISION]:
        for count in (0, 5):
            for dtype in (torch.float32, *(HALF[:1] if example.features else ())):
                arguments = example.example(count, dtype)
                with recorder:
                    evaluate(example.native, arguments, example.leaves(arguments), order_of(example))
    return {name: list(calls.values()) for name, calls in recorder.calls.items()}


def registered_ops() -> list[str]:
    """Names in the library ``pred``, as the dispatcher knows them."""
    names = [name.removeprefix("pred::") for name in torch._C._dispatch_get_all_op_names() if name.startswith("pred::")]
    return sorted(set(names) - NO_OP)
