# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the ops along rays: opacity, compositing, resampling."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import cases, peers
from benchmarks.case import BACKWARD, FORWARD, Case, Phase, Variant
from benchmarks.cases import Sizes
from benchmarks.report import Target
from pred import ops
from pred.ops import reference


def _sdf_to_alpha_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, _, _ = cases.ray_samples(sizes)
    rays, samples = sdf.shape
    return [
        Case(
            op="sdf_to_alpha",
            name=f"sdf_to_alpha {rays}x{samples}",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s),
            ours=lambda sdf, inv_s: (ops.sdf_to_alpha(sdf, inv_s),),
            reference=lambda sdf, inv_s: (reference.sdf_to_alpha(sdf, inv_s),),
            eager={"closed form": Variant(lambda sdf, inv_s: (F.pad(_eager_alpha(sdf, inv_s), (0, 1)),))},
            compiled=("closed form",),
            derivative_in=(0,),
            phases=(
                Phase(FORWARD, "4 (2 RS)", 2 * sdf.nbytes),
                Phase(BACKWARD, "4 (5 RS)", 5 * sdf.nbytes),
            ),
        )
    ]


def _composite_rays_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, t, values = cases.ray_samples(sizes)
    rays, samples = sdf.shape
    plane, block = sdf.nbytes, values.nbytes
    variants = {"cumprod": Variant(_eager_composite_cumprod), "cumsum": Variant(_eager_composite_cumsum)}

    def ours(*inputs: Tensor) -> tuple[Tensor, ...]:
        return _present(ops.composite_rays(*inputs))

    def plain(*inputs: Tensor) -> tuple[Tensor, ...]:
        return _present(reference.composite_rays(*inputs))

    return [
        Case(
            op="composite_rays",
            name=f"composite_rays {rays}x{samples}, depth only",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            peers=peers.composite(_padded_alpha),
            derivative_in=(0,),
            derivative_of=(1,),
            phases=(
                Phase(FORWARD, "4 (3 RS)", 3 * plane),
                Phase(BACKWARD, "4 (6 RS)", 6 * plane, (Target("eager", 10),)),
            ),
        ),
        Case(
            op="composite_rays",
            name=f"composite_rays {rays}x{samples}, depth and {sizes.classes} classes",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t, values),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            peers=peers.composite(_padded_alpha),
            derivative_in=(0, 3),
            derivative_of=(1, 3),
            phases=(
                Phase(FORWARD, "4 (3 RS + RSC)", 3 * plane + block),
                Phase(
                    BACKWARD,
                    "4 (6 RS + 3 RSC)",
                    6 * plane + 3 * block,
                    (Target("eager", 3), Target("compiled", 2), Target("copy bandwidth", 0.7)),
                ),
            ),
        ),
        Case(
            op="composite_rays",
            name=f"composite_rays {rays}x{samples}, depth and {sizes.classes} classes in bfloat16",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t, values.bfloat16()),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            derivative_in=(0, 3),
            derivative_of=(1, 3),
            tolerance=2**-7,  # neighbouring bfloat16 numbers
            phases=(
                Phase(FORWARD, "4 (3 RS) + 2 RSC", 3 * plane + block // 2),
                Phase(BACKWARD, "4 (6 RS) + 2 (3 RSC)", 6 * plane + 3 * block // 2),
            ),
        ),
        *_packed_composite_rays_cases(sizes),
    ]


def _packed_composite_rays_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, t, ray_offsets, values = cases.packed_ray_samples(sizes)
    rays, line, block = ray_offsets.shape[0] - 1, sdf.nbytes, values.nbytes
    variants = {"padded": Variant(_eager_composite_padded), "log space": Variant(_eager_composite_log_space)}

    def ours(sdf: Tensor, inv_s: Tensor, t: Tensor, ray_offsets: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        return _present(ops.composite_rays(sdf, inv_s, t, *values, ray_offsets=ray_offsets))

    def plain(sdf: Tensor, inv_s: Tensor, t: Tensor, ray_offsets: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        return _present(reference.composite_rays(sdf, inv_s, t, *values, ray_offsets=ray_offsets))

    name = f"composite_rays packed, {rays} rays of {sdf.shape[0]} samples"
    return [
        Case(
            op="composite_rays",
            name=f"{name}, depth only",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t, ray_offsets),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=(),  # the longest ray is not known to a compiler
            derivative_in=(0,),
            derivative_of=(1,),
            phases=(Phase(FORWARD, "4 (3 P)", 3 * line), Phase(BACKWARD, "4 (6 P)", 6 * line)),
        ),
        Case(
            op="composite_rays",
            name=f"{name}, depth and {sizes.classes} classes",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, t, ray_offsets, values),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=(),
            derivative_in=(0, 4),
            derivative_of=(1, 3),
            phases=(
                Phase(FORWARD, "4 (3 P + PC)", 3 * line + block),
                Phase(BACKWARD, "4 (6 P + 3 PC)", 6 * line + 3 * block),
            ),
        ),
    ]


def _composite_alpha_cases(sizes: Sizes) -> list[Case]:
    sdf, inv_s, t, values = cases.ray_samples(sizes)
    alpha = F.pad(_eager_alpha(sdf, inv_s), (0, 1))
    rays, samples = alpha.shape
    plane, block = alpha.nbytes, values.nbytes
    variants = {
        "cumprod": Variant(_eager_composite_alpha_cumprod),
        "exclusive cumprod": Variant(_eager_composite_alpha_exclusive),
    }

    def ours(*inputs: Tensor) -> tuple[Tensor, ...]:
        return _present(ops.composite_alpha(*inputs))

    def plain(*inputs: Tensor) -> tuple[Tensor, ...]:
        return _present(reference.composite_alpha(*inputs))

    return [
        Case(
            op="composite_alpha",
            name=f"composite_alpha {rays}x{samples}, depth only",
            unit="rays",
            items=rays,
            inputs=(alpha, t),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            peers=peers.composite(),
            derivative_in=(0,),
            derivative_of=(1,),
            phases=(Phase(FORWARD, "4 (3 RS)", 3 * plane), Phase(BACKWARD, "4 (6 RS)", 6 * plane)),
        ),
        Case(
            op="composite_alpha",
            name=f"composite_alpha {rays}x{samples}, depth and {sizes.classes} classes",
            unit="rays",
            items=rays,
            inputs=(alpha, t, values),
            ours=ours,
            reference=plain,
            eager=variants,
            compiled=tuple(variants),
            peers=peers.composite(),
            derivative_in=(0, 2),
            derivative_of=(1, 3),
            phases=(
                Phase(FORWARD, "4 (3 RS + RSC)", 3 * plane + block),
                Phase(BACKWARD, "4 (6 RS + 3 RSC)", 6 * plane + 3 * block),
            ),
        ),
    ]


def _present(composite: ops.Composite) -> tuple[Tensor, ...]:
    return tuple(tensor for tensor in composite if tensor is not None)


def _eager_alpha(sdf: Tensor, inv_s: Tensor) -> Tensor:  # [R, S - 1]
    here, after = sdf[:, :-1], sdf[:, 1:]
    return torch.sigmoid(-inv_s * after) * -torch.expm1(-inv_s * F.relu(here - after))


def _padded_alpha(sdf: Tensor, inv_s: Tensor) -> Tensor:  # [R, S]
    return F.pad(_eager_alpha(sdf, inv_s), (0, 1))


def _eager_composite_cumprod(sdf: Tensor, inv_s: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    alpha = _eager_alpha(sdf, inv_s)
    clear = torch.cumprod(1 - alpha[:, :-1], dim=1)
    return _eager_sums(torch.cat([alpha[:, :1], alpha[:, 1:] * clear], dim=1), t, values)


def _eager_composite_cumsum(sdf: Tensor, inv_s: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    alpha = _eager_alpha(sdf, inv_s)
    clear = torch.exp(torch.cumsum(torch.log1p(-alpha[:, :-1]), dim=1))
    return _eager_sums(torch.cat([alpha[:, :1], alpha[:, 1:] * clear], dim=1), t, values)


def _eager_sums(weights: Tensor, t: Tensor, values: Tensor | None) -> tuple[Tensor, ...]:
    return _eager_all_sums(F.pad(weights, (0, 1)), t, values)


def _eager_all_sums(weights: Tensor, t: Tensor, values: Tensor | None) -> tuple[Tensor, ...]:
    sums = weights, (weights * t).sum(dim=1), weights.sum(dim=1)
    if values is None:
        return sums
    rendered = torch.bmm(weights[:, None], values.to(weights.dtype))[:, 0]
    return *sums, rendered.to(values.dtype)


def _eager_composite_alpha_cumprod(alpha: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    """As NeuS does."""
    clear = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
    return _eager_all_sums(alpha * clear, t, values)


def _eager_composite_alpha_exclusive(alpha: Tensor, t: Tensor, values: Tensor | None = None) -> tuple[Tensor, ...]:
    clear = torch.cumprod(1 - alpha[:, :-1], dim=1)
    return _eager_all_sums(torch.cat([alpha[:, :1], alpha[:, 1:] * clear], dim=1), t, values)


def _eager_composite_padded(
    sdf: Tensor, inv_s: Tensor, t: Tensor, ray_offsets: Tensor, values: Tensor | None = None
) -> tuple[Tensor, ...]:
    """Rows as long as the longest ray; the padding's distance lets everything pass."""
    counts = ray_offsets.diff()
    valid = torch.arange(int(counts.max()), device=sdf.device) < counts[:, None]

    def pad(samples: Tensor, fill: float) -> Tensor:
        return samples.new_full((*valid.shape, *samples.shape[1:]), fill).masked_scatter_(
            valid.view(*valid.shape, *[1] * (samples.dim() - 1)), samples
        )

    table = None if values is None else pad(values, 0.0)
    weights, *sums = _eager_composite_cumprod(pad(sdf, 1e4), inv_s, pad(t, 0.0), table)
    return weights[valid], *sums


def _eager_composite_log_space(
    sdf: Tensor, inv_s: Tensor, t: Tensor, ray_offsets: Tensor, values: Tensor | None = None
) -> tuple[Tensor, ...]:
    """One running sum of log(1 - alpha) over all rays, less what it was at each ray's start; in double, or the first
    rays' sums would cost the last ones their digits."""
    counts = ray_offsets.diff()
    rays = counts.shape[0]
    ray = torch.repeat_interleave(torch.arange(rays, device=sdf.device), counts)
    inside = F.pad((ray[1:] == ray[:-1]).to(sdf.dtype), (0, 1))
    alpha = F.pad(_eager_alpha(sdf[None], inv_s)[0], (0, 1)) * inside
    passed = F.pad(torch.cumsum(torch.log1p(-alpha).double(), dim=0), (1, 0))
    weights = alpha * torch.exp(passed[:-1] - passed[ray_offsets[:-1]][ray]).to(sdf.dtype)
    sums = (sdf.new_zeros(rays).index_add(0, ray, weights * t), sdf.new_zeros(rays).index_add(0, ray, weights))
    if values is None:
        return weights, *sums
    rendered = values.new_zeros(rays, values.shape[1]).index_add(0, ray, weights[:, None] * values)
    return weights, *sums, rendered


def _resample_rays_cases(sizes: Sizes) -> list[Case]:
    t, weights = cases.coarse_rays(sizes)
    rays, samples, added = *t.shape, sizes.fine_samples
    return [
        Case(
            op="resample_rays",
            name=f"resample_rays {rays}x{samples} + {added}",
            unit="rays",
            items=rays,
            inputs=(t, weights),
            ours=lambda t, weights: (ops.resample_rays(t, weights, added),),
            reference=lambda t, weights: (reference.resample_rays(t, weights, added),),
            eager={"searchsorted + sort": Variant(lambda t, weights: (_eager_resample(t, weights, added),))},
            compiled=("searchsorted + sort",),
            # Where the distribution is flat, a sample jumps across the gap if the sum is rounded differently.
            outliers=1e-4,
            phases=(
                Phase(
                    FORWARD,
                    "4 R (3 S + n)",
                    t.nbytes + weights.nbytes + 4 * rays * (samples + added),
                    (Target("eager", 30),),
                ),
            ),
        )
    ]


def _eager_resample(t: Tensor, weights: Tensor, added: int) -> Tensor:
    return torch.cat([t, _eager_samples(t, weights, added)], dim=1).sort(dim=1).values


def _eager_samples(t: Tensor, weights: Tensor, added: int) -> Tensor:
    mass = weights[:, :-1]
    total = mass.sum(dim=1, keepdim=True)
    mass = torch.where(total > 0, mass, t[:, 1:] - t[:, :-1])
    cdf = F.pad(mass.cumsum(dim=1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    u = _middles(t, added)
    after = torch.searchsorted(cdf, u, right=True).clamp_max(t.shape[1] - 1)
    before = after - 1
    low, high = cdf.gather(1, before), cdf.gather(1, after)
    start, end = t.gather(1, before), t.gather(1, after)
    return torch.lerp(start, end, (u - low) / (high - low))


def _middles(t: Tensor, added: int) -> Tensor:  # [R, added]
    """Of so many equal parts of [0, 1], for each ray."""
    middle = (torch.arange(added, dtype=t.dtype, device=t.device) + 0.5) / added
    return middle.expand(t.shape[0], -1).contiguous()


def _section_cases(sizes: Sizes) -> list[Case]:
    """NeuS's opacities: distances at the middles of sections that the rays meet at an angle."""
    sdf, inv_s, t, _ = cases.ray_samples(sizes)
    rays, samples = sdf.shape
    length = F.pad(t.diff(dim=1), (0, 1), value=0.1)
    cosine = 1.6 * torch.rand(sdf.shape, generator=torch.Generator().manual_seed(0)) - 1.3
    plane = sdf.nbytes

    def case(name: str, eps: float, eager: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]) -> Case:
        def call(function: Callable[..., Tensor], *inputs: Tensor) -> tuple[Tensor]:
            sdf, inv_s, cosine, length = inputs
            return (function(sdf, inv_s, "section", cosine=cosine, section_length=length, cos_anneal=0.5, eps=eps),)

        return Case(
            op="sdf_to_alpha",
            name=f"sdf_to_alpha {rays}x{samples}, {name}",
            unit="rays",
            items=rays,
            inputs=(sdf, inv_s, cosine, length),
            ours=lambda *inputs: call(ops.sdf_to_alpha, *inputs),
            reference=lambda *inputs: call(reference.sdf_to_alpha, *inputs),
            eager={name: Variant(lambda *inputs: (eager(*inputs),))},
            compiled=(name,),
            derivative_in=(0, 2),
            phases=(Phase(FORWARD, "4 (4 RS)", 4 * plane), Phase(BACKWARD, "4 (10 RS)", 10 * plane)),
        )

    return [case("section", 0.0, _eager_section), case("section as published", 1e-5, _eager_section_published)]


def _eager_fall(cosine: Tensor, length: Tensor) -> Tensor:
    return (F.relu(0.5 - 0.5 * cosine) * 0.5 + F.relu(-cosine) * 0.5) * length


def _eager_section(sdf: Tensor, inv_s: Tensor, cosine: Tensor, length: Tensor) -> Tensor:
    fall = _eager_fall(cosine, length)
    return torch.sigmoid(-inv_s * (sdf - 0.5 * fall)) * -torch.expm1(-inv_s * fall)


def _eager_section_published(sdf: Tensor, inv_s: Tensor, cosine: Tensor, length: Tensor) -> Tensor:
    half = 0.5 * _eager_fall(cosine, length)
    before, after = torch.sigmoid((sdf + half) * inv_s), torch.sigmoid((sdf - half) * inv_s)
    return ((before - after + 1e-5) / (before + 1e-5)).clip(0, 1)


def _sample_pdf_cases(sizes: Sizes) -> list[Case]:
    t, weights = cases.coarse_rays(sizes)
    rays, edges, added = *t.shape, sizes.fine_samples

    def case(mode: str, eager: Callable[[Tensor, Tensor, int], Tensor]) -> Case:
        return Case(
            op="sample_pdf",
            name=f"sample_pdf {rays}x{edges} -> {added}, {mode}",
            unit="rays",
            items=rays,
            inputs=(t, weights),
            ours=lambda t, weights: (ops.sample_pdf(t, weights, added, mode=mode),),
            reference=lambda t, weights: (reference.sample_pdf(t, weights, added, mode=mode),),
            eager={"searchsorted": Variant(lambda t, weights: (eager(t, weights, added),))},
            compiled=("searchsorted",),
            # Where the distribution is flat, a sample jumps across the gap if the sum is rounded differently.
            outliers=1e-2 if mode == "neus" else 1e-4,
            phases=(Phase(FORWARD, "4 R (2 S + n)", t.nbytes + weights.nbytes + 4 * rays * added),),
        )

    return [case("exact", _eager_samples), case("neus", _eager_samples_neus)]


def _eager_samples_neus(t: Tensor, weights: Tensor, added: int) -> Tensor:
    mass = weights[:, :-1] + 1e-5
    cdf = F.pad((mass / mass.sum(dim=1, keepdim=True)).cumsum(dim=1), (1, 0))
    u = _middles(t, added)
    index = torch.searchsorted(cdf, u, right=True)
    before, after = (index - 1).clamp_min(0), index.clamp_max(t.shape[1] - 1)
    low = cdf.gather(1, before)
    width = cdf.gather(1, after) - low
    start = t.gather(1, before)
    return start + (u - low) / torch.where(width < 1e-5, 1, width) * (t.gather(1, after) - start)


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "sdf_to_alpha": lambda sizes: [*_sdf_to_alpha_cases(sizes), *_section_cases(sizes)],
    "composite_alpha": _composite_alpha_cases,
    "composite_rays": _composite_rays_cases,
    "resample_rays": _resample_rays_cases,
    "sample_pdf": _sample_pdf_cases,
}
