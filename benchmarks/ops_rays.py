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
        return tuple(tensor for tensor in ops.composite_rays(*inputs) if tensor is not None)

    def plain(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor for tensor in reference.composite_rays(*inputs) if tensor is not None)

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
    ]


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
    weights = F.pad(weights, (0, 1))
    sums = weights, (weights * t).sum(dim=1), weights.sum(dim=1)
    return sums if values is None else (*sums, torch.bmm(weights[:, None], values)[:, 0])


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
    mass = weights[:, :-1]
    total = mass.sum(dim=1, keepdim=True)
    mass = torch.where(total > 0, mass, t[:, 1:] - t[:, :-1])
    cdf = F.pad(mass.cumsum(dim=1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    u = ((torch.arange(added, dtype=t.dtype) + 0.5) / added).expand(t.shape[0], -1).contiguous()
    after = torch.searchsorted(cdf, u, right=True).clamp_max(t.shape[1] - 1)
    before = after - 1
    low, high = cdf.gather(1, before), cdf.gather(1, after)
    start, end = t.gather(1, before), t.gather(1, after)
    samples = torch.lerp(start, end, (u - low) / (high - low))
    return torch.cat([t, samples], dim=1).sort(dim=1).values


CASES: dict[str, Callable[[Sizes], list[Case]]] = {
    "sdf_to_alpha": _sdf_to_alpha_cases,
    "composite_rays": _composite_rays_cases,
    "resample_rays": _resample_rays_cases,
}
