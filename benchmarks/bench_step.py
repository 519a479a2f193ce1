# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The rendering step: from a BEV map to the gradients of the loss, without the encoder.

Per step: depth rays (with the Eikonal term) and as many semantic rays (512 each at real sizes, 3072 at the paper's),
each with a coarse pass, resampling to 96 + 128 samples, decoding, compositing and losses; then the backward pass to the
map and to every parameter. Where the memory of a GPU does not hold the step of ``eager``, all take a quarter of the
rays less, again and again until it does; the name of the case tells. All are compared with ``reference``, or with ours
where that does not fit. Contenders:

``ours``       `pred.models` on the compiled kernels; also with the decoder's ``recompute`` and ``bf16``
``reference``  the same model on the PyTorch references of `pred.ops`
``eager``      plain PyTorch as one would write it first: `F.grid_sample`, and the SDF's gradient by
               `autograd.grad(create_graph=True)`; beside ours in bfloat16 also in `torch.autocast`
``compiled``   `torch.compile` of ``reference``, forward and backward pass in one graph

On a GPU ours, eager and compiled also run with products in TF32 (`torch.set_float32_matmul_precision`).

Useful arithmetic, in multiply-adds (P encoding width, h hidden, L Linear layers, C map channels, K classes): the
trunk takes m = P h + (L - 2) h^2 per sample, the output row(s) h each; the first layer's share of the map takes
C h per cell. A backward pass takes twice its forward pass, and the SDF's gradient is one more pass through the trunk.
Coarse samples: m + h. Depth samples: 3 (m + h) + 3 m. Semantic samples: 3 (m + (1 + K) h). Map: 3 C h per cell.
Softplus, gathers and compositing are not counted, nor is anything computed twice.

``python -m benchmarks.bench_step CONTENDER SIZES THREADS`` prints the memory that one step adds, in bytes: a process of
its own, because the peak of resident memory is a process's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases
from benchmarks.allocator import current_allocator, enter_allocator
from benchmarks.bench_ops import first_line
from benchmarks.cases import SIZES, Sizes
from benchmarks.measure import CPU, missing_kernel, time_interleaved
from benchmarks.memory import added_peak_bytes
from benchmarks.ops_sampling import plain_gather
from benchmarks.phases import compiled
from benchmarks.report import Row, Target
from pred.losses import LossConfig, depth_loss, eikonal_loss, semantic_loss
from pred.models.field import FieldConfig, FieldDecoder
from pred.models.renderer import Renderer, RendererConfig, Sharpness
from pred.ops import DecodedField

STEP = "rendering_step"
TOLERANCES = {"float32": (1e-4, 1e-3), "tf32": (2e-3, 5e-2), "bfloat16": (1e-2, 2.5e-1)}
"""Of the loss, and of a gradient's norm. In bfloat16 the coarse pass puts the fine samples some decimetres elsewhere,
where the features of this map, which are noise, and the high octaves of the encoding are others."""
ROUNDS = 3
CONTENDERS = ("ours", "eager", "compiled")

Run = Callable[[], list[Tensor]]


class PlainField(FieldDecoder):
    """`FieldDecoder` without its rewritings: gather, concatenate, MLP, double backward."""

    def project(self, bev: Tensor) -> Tensor:
        """The map itself."""
        return bev

    def decode(
        self, projected: Tensor, points_m: Tensor, with_gradient: bool = False, semantics: bool = True
    ) -> DecodedField:
        """As `FieldDecoder.decode`, from the map."""
        points_m = points_m.detach().requires_grad_(with_gradient)
        low, high = points_m.new_tensor(self.point_range).view(2, 3)
        position = (points_m - (low + high) / 2) / ((high - low) / 2)
        features = plain_gather(projected, position[..., :2], twice=with_gradient)
        octaves = 2.0 ** torch.arange(self.config.frequencies, device=points_m.device)
        angles = (position[..., None, :] * octaves[:, None]).flatten(-2)
        activation = torch.cat([features, position, angles.sin(), angles.cos()], dim=-1)
        *hidden_layers, output_layer = self.layers
        assert isinstance(output_layer, torch.nn.Linear)
        for layer in hidden_layers:
            activation = F.softplus(layer(activation), self.config.softplus_beta)
        rows = slice(None) if semantics else slice(1)
        with torch.autocast(points_m.device.type, enabled=False):  # distances are kept in float32
            output = F.linear(activation.float(), output_layer.weight[rows], output_layer.bias[rows])
        sdf = output[..., 0] * self.config.sdf_scale_m
        gradient = None
        if with_gradient:
            (gradient,) = torch.autograd.grad(sdf.sum(), points_m, create_graph=True)
        return DecodedField(sdf, output[..., 1:] if semantics else None, gradient)


class Rays:
    """Rays from one origin to measured points."""

    def __init__(self, points_m: Tensor, origin_m: tuple[float, float, float], seed: int) -> None:
        origin = points_m.new_tensor(origin_m)
        offset = points_m - origin
        self.depth_m = offset.norm(dim=-1)[None]  # [1, R]
        self.directions = offset[None] / self.depth_m[..., None]  # [1, R, 3]
        self.origins = origin.expand_as(self.directions)
        self.valid = torch.ones_like(self.depth_m, dtype=torch.bool)
        jitter = torch.rand(self.depth_m.shape, generator=torch.Generator().manual_seed(seed))
        self.jitter = jitter.to(points_m.device)


class Step:
    """One rendering step: map, rays, and the models."""

    def __init__(
        self, sizes: Sizes, field_type: type[FieldDecoder], device: torch.device = CPU, **options: Any
    ) -> None:
        torch.manual_seed(0)
        config = FieldConfig(hidden=sizes.step_hidden, num_classes=sizes.classes, **options)
        self.field = field_type(sizes.bev_channels, config, cases.POINT_RANGE_M).to(device)
        self.renderer = Renderer(
            RendererConfig(coarse_samples=sizes.coarse_samples, fine_samples=sizes.fine_samples), cases.POINT_RANGE_M
        )
        self.sharpness = Sharpness(self.renderer.config.initial_inv_s).to(device)
        self.bev = cases.bev_map(sizes.bev_channels, sizes.bev_cells).to(device).requires_grad_()
        count = sizes.step_rays
        points = cases.lidar_points(max(2 * count, sizes.points // 10))[:, :3]
        points = points[torch.randperm(len(points))[: 2 * count]].to(device)
        self.depth = Rays(points[:count], (0.0, 0.0, 0.0), seed=1)
        self.semantic = Rays(points[count:], (0.0, 1.5, -0.3), seed=2)
        self.target = F.one_hot(torch.randint(sizes.classes, (1, count)), sizes.classes).float().to(device)
        self.confidence = torch.ones(1, count, device=device)
        self.leaves = [self.bev, *self.field.parameters(), *self.sharpness.parameters()]

    def loss(self) -> Tensor:
        """Forward pass."""
        weights = LossConfig()
        projected, inv_s = self.field.project(self.bev), self.sharpness()
        rays = self.depth
        samples = self.renderer.sample(
            self.field, projected, inv_s, rays.origins, rays.directions, rays.valid, rays.jitter
        )
        rendered = self.renderer.render(self.field, projected, inv_s, samples, with_gradient=True)
        assert rendered.gradient is not None
        depth = depth_loss(rendered.depth_m, rays.depth_m, rendered.hit, weights.depth_unit_m)
        eikonal = eikonal_loss(rendered.gradient, rendered.hit)

        rays = self.semantic
        samples = self.renderer.sample(
            self.field, projected, inv_s, rays.origins, rays.directions, rays.valid, rays.jitter
        )
        rendered = self.renderer.render(self.field, projected, inv_s, samples, semantics=True, detach_sdf=True)
        assert rendered.semantics is not None
        semantic = semantic_loss(rendered.semantics, self.target, self.confidence, rendered.hit)
        return weights.semantic_weight * semantic + weights.depth_weight * depth + weights.eikonal_weight * eikonal


VARIANTS: dict[str, dict[str, Any]] = {
    "ours": {},
    "ours, recompute": {"recompute": True},
    "ours, bf16": {"precision": "bf16"},
    "ours, bf16, recompute": {"precision": "bf16", "recompute": True},
}
"""Options of the decoder. Each variant is a case of its own, with the same other contenders."""
TF32 = "tf32"
"""A variant on a GPU: torch's setting, which ours follows."""


def contender(name: str, sizes: Sizes, device: torch.device = CPU) -> Run:
    """One step of a contender; it returns the loss, then the gradients of the map and of every parameter."""
    kind, _, options = name.partition(", ")
    step = Step(sizes, PlainField if kind == "eager" else FieldDecoder, device, **VARIANTS.get(name, {}))
    backend = "native" if kind == "ours" else "reference"

    def loss_and_gradients() -> list[Tensor]:
        with torch.autocast(device.type, torch.bfloat16, enabled=kind == "eager" and options == "bf16"):
            loss = step.loss()
        return [loss.detach(), *torch.autograd.grad(loss, step.leaves)]

    call: Run = compiled(loss_and_gradients) if kind == "compiled" else loss_and_gradients

    def run() -> list[Tensor]:
        os.environ["PRED_BACKEND"] = backend  # read at each call
        torch.set_float32_matmul_precision("high" if options == TF32 else "highest")
        return call()

    return run


def useful_flop(sizes: Sizes) -> int:
    """See the head of this module."""
    config = FieldConfig(hidden=sizes.step_hidden, num_classes=sizes.classes)
    hidden = config.hidden
    trunk = (3 + 6 * config.frequencies) * hidden + (config.layers - 2) * hidden**2
    samples = sizes.coarse_samples + sizes.fine_samples
    per_ray_pair = (
        2 * sizes.coarse_samples * (trunk + hidden)
        + samples * (6 * trunk + 3 * hidden)
        + samples * 3 * (trunk + (1 + config.num_classes) * hidden)
    )
    return 2 * (sizes.step_rays * per_ray_pair + 3 * sizes.bev_cells**2 * sizes.bev_channels * hidden)


def run_step(
    sizes_name: str,
    threads: int,
    kinds: Sequence[str],
    min_time_s: float,
    on_step: Callable[[str], None],
    device: torch.device = CPU,
) -> list[Row]:
    """Checks the contenders against ``reference``, times them, and measures the memory that each adds.

    Args:
        sizes_name: key of `cases.SIZES`.
        threads: torch's threads.
        kinds: which of `CONTENDERS` take part; ``reference`` always does.
        min_time_s: see `time_interleaved`; a step of real size takes one call per round.
        on_step: told what happens next.
        device: where the step runs.
    """
    sizes = SIZES[sizes_name]
    while True:
        try:
            return _run_step(sizes_name, sizes, threads, kinds, min_time_s, on_step, device)
        except torch.OutOfMemoryError:
            if sizes.step_rays < 64:
                raise
            sizes = replace(sizes, step_rays=sizes.step_rays * 3 // 4)
            on_step(f"step: out of the GPU's memory, now with {sizes.step_rays} + {sizes.step_rays} rays")
        torch.cuda.empty_cache()


def _run_step(
    sizes_name: str,
    sizes: Sizes,
    threads: int,
    kinds: Sequence[str],
    min_time_s: float,
    on_step: Callable[[str], None],
    device: torch.device,
) -> list[Row]:
    torch.set_num_threads(threads)
    if "compiled" in kinds:
        torch._dynamo.reset()
    rows: dict[str, Row] = {}
    runs: dict[str, Run] = {}
    expected: list[Tensor] = []
    plain = [kind for kind in CONTENDERS[1:] if kind in kinds]
    names = ["reference", *(VARIANTS if "ours" in kinds else ()), *plain]
    if device.type == "cuda":
        names += [f"{kind}, {TF32}" for kind in CONTENDERS if kind in kinds]
    if {"ours", "eager"} <= set(kinds):
        names.append("eager, bf16")
    for name in names:
        on_step(f"step, {threads} threads: {name}")
        row = rows[name] = _row(name, sizes, threads, device)
        if row.kind == "ours" and (reason := missing_kernel("composite_rays", device)):
            row.status = f"missing: {reason}"
            continue
        try:
            run = contender(name, sizes, device)
            result = run()
        except Exception as error:  # a compiler may refuse in any way; the run goes on
            if row.kind == "eager" and isinstance(error, torch.OutOfMemoryError):
                raise
            row.status = f"refused: {first_line(error)}"
            continue
        expected = expected or result
        row.error, wrong = _compare(result, expected, TOLERANCES[TF32 if name.endswith(TF32) else row.flop_dtype])
        del result
        if wrong:
            row.status = f"wrong: {wrong}"
        else:
            runs[name] = run
    on_step(f"step, {threads} threads: timing")
    for name, timing in time_interleaved(runs, threads, min_time_s, ROUNDS, device).items():
        rows[name].timing = timing
    for name, run in runs.items():
        if device.type == "cuda":
            rows[name].peak_memory_bytes = added_peak_bytes(run, device)
        elif name != "compiled":  # its compiler's memory would count
            on_step(f"step, {threads} threads: memory of {name}")
            _add_memory(rows[name], sizes_name)
    found: list[Row] = []
    for name, ours in rows.items():
        if ours.kind == "ours":
            variant = name.partition(", ")[2]
            others = ["reference", *plain, *(f"{kind}, {variant}" for kind in CONTENDERS[1:])]
            if variant.startswith("bf16"):
                others.append("eager, bf16")
            same = [rows[other] for other in dict.fromkeys(others) if other in rows]
            found += [ours, *(replace(row, case=ours.case, targets=ours.targets) for row in same)]
    return found or list(rows.values())


def _row(name: str, sizes: Sizes, threads: int, device: torch.device) -> Row:
    rays, samples = sizes.step_rays, (sizes.coarse_samples, sizes.fine_samples)
    kind, _, variant = name.partition(", ")
    return Row(
        op=STEP,
        case=f"rendering step {rays} + {rays} rays, {samples[0]} + {samples[1]} samples, hidden {sizes.step_hidden}"
        + (f", {variant}" if variant else ""),
        phase="forward+backward",
        threads=threads,
        contender=name,
        kind=kind,
        unit="rays",
        items=2 * rays,
        work="useful FLOP of the matrix products, see benchmarks/bench_step.py",
        flop=useful_flop(sizes),
        flop_dtype="bfloat16" if "bf16" in name else "float32",
        targets=targets(sizes, variant, device),
    )


def targets(sizes: Sizes, variant: str, device: torch.device) -> tuple[Target, ...]:
    """What the step should reach; of `variant`, see `VARIANTS`, the name without "ours"."""
    if device.type == "cuda" and replace(sizes, step_rays=cases.PAPER.step_rays) == cases.PAPER:
        return Target("eager", 5), Target("compiled", 2), Target("eager's memory", 4)
    if device.type == "cpu" and sizes == cases.REAL and not variant:
        return Target("eager", 4), Target("eager's memory", 4)
    return ()


def _compare(actual: list[Tensor], expected: list[Tensor], tolerances: tuple[float, float]) -> tuple[float, str]:
    """Largest relative error of loss and gradients, and what is wrong (nothing: empty)."""
    loss_error = float((actual[0] - expected[0]).abs() / expected[0].abs())
    norms = [float(grad.norm()) for grad in expected[1:]]
    errors = [
        float((have - want).norm()) / max(norm, 1e-3 * max(norms))
        for have, want, norm in zip(actual[1:], expected[1:], norms, strict=True)
    ]
    wrong = ""
    if not loss_error <= tolerances[0]:
        wrong = f"the loss differs by {loss_error:.2g}"
    elif not all(error <= tolerances[1] for error in errors):
        wrong = f"a gradient differs by {max(errors):.2g} of its norm"
    return max(loss_error, *errors), wrong


def _add_memory(row: Row, sizes_name: str) -> None:
    command = [sys.executable, "-m", "benchmarks.bench_step", row.contender, sizes_name, str(row.threads)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode == 0:
        row.peak_memory_bytes = json.loads(done.stdout)
    else:
        row.status = f"ok; its memory is unknown: the process that measures it ended with {done.returncode}"


if __name__ == "__main__":
    enter_allocator(current_allocator() or "raised")
    torch.set_num_threads(int(sys.argv[3]))
    print(json.dumps(added_peak_bytes(contender(sys.argv[1], SIZES[sys.argv[2]]))))
