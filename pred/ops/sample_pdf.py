# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Inverse-CDF sampling along rays."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pred import _native
from pred.ops._check import (
    FLOATING,
    as_geometry,
    check_choice,
    check_count,
    check_dtype,
    check_like,
    check_number,
    check_shape,
    check_tensors,
)

MODES = ("exact", "neus", "nerfstudio")


def sample_pdf(
    edges: Tensor,  # [R, S]
    weights: Tensor,  # [R, S - 1] or [R, S]
    num_samples: int | None = None,
    u: Tensor | None = None,  # [R, n] or [n]
    mode: str = "exact",
    *,
    histogram_padding: float = 0.01,
    eps: float = 1e-5,
    min_width: float = 0.0,
) -> Tensor:  # [R, n]
    """Samples a piecewise constant distribution along each ray.

    Section i, from ``edges_i`` to ``edges_{i+1}``, has a probability proportional to its weight, and constant density.
    With ``cdf_0 = 0`` and ``cdf_{i+1} = cdf_i + p_i``, sample k is where the distribution reaches ``u_k``:
    ``edges_i + (u_k - cdf_i) / (cdf_{i+1} - cdf_i) (edges_{i+1} - edges_i)`` in the section with
    ``cdf_i <= u_k < cdf_{i+1}``. The modes differ in the probabilities and in what happens in narrow sections:

    - ``"exact"``: ``p = w / sum(w)``. Negative weights count as 0; a ray whose weights sum to 0, or to NaN or infinity,
      is sampled uniformly in ``edges``. The last cdf is 1 exactly, ``u`` is clipped to [0, 1): every sample lies in a
      section that has weight.
    - ``"neus"``: NeuS's ``sample_pdf``: ``p = (w + eps) / sum(w + eps)``; a section narrower than ``eps`` in the cdf
      counts as 1 wide, which puts its samples at its start. Nothing is clipped.
    - ``"nerfstudio"``: its ``PDFSampler``: ``w + histogram_padding``, then ``relu(eps - sum)`` spread evenly over them,
      the cdf limited to 1, the fraction within a section to [0, 1], and 0 where it is 0 / 0. UniPAD and PonderV2 have
      an older form: ``histogram_padding=0, min_width=1e-5``.

    Args:
        edges: ``[R, S]`` or ``[R, S, 1]`` ascending ranges in metres, S at least 2; equal neighbours are allowed.
            float32 or float64; half precision is widened to float32.
        weights: ``[R, S - 1]``, or ``[R, S]`` as the compositing ops give them, whose last one is ignored; same dtype.
        num_samples: number of samples, at ``u_k = (k + 1/2) / num_samples``, the middles of even strata. nerfstudio
            draws edges, one more than the samples between them: ``PDFSampler(N)`` is ``num_samples=N + 1``.
        u: positions in [0, 1) in any order, same dtype, instead of ``num_samples`` (or beside it, of that size).
        mode: see above.
        histogram_padding: mode nerfstudio: added to each weight.
        eps: mode neus: added to each weight, and the least width of a section; mode nerfstudio: the least sum of the
            weights.
        min_width: mode nerfstudio: sections narrower than this in the cdf count as 1 wide; 0: none does.

    Returns:
        ``[R, n]``, in the order of ``u``. Not differentiable: it carries no gradient. NaN stays in its ray; a NaN ``u``
        in its sample. In mode nerfstudio a ray with a NaN weight is sampled at its end, as published.

    Raises:
        ValueError: shape, device, range, an unknown mode, or neither ``num_samples`` nor ``u``. TypeError: dtype.

    Deterministic for any thread count.
    """
    _native.refuse_transforms("sample_pdf")
    rule = (mode, histogram_padding, eps, min_width)
    edges, weights, u = pdf_arguments("sample_pdf", "edges", edges, weights, num_samples, u, *rule)
    if not _native.use_native("sample_pdf", edges):
        return samples_reference(edges, weights, u, *rule)
    out: Tensor = torch.ops.pred.sample_pdf(edges, weights, u, *rule)
    return out


def sample_pdf_reference(
    edges: Tensor,  # [R, S]
    weights: Tensor,  # [R, S - 1] or [R, S]
    num_samples: int | None = None,
    u: Tensor | None = None,  # [R, n] or [n]
    mode: str = "exact",
    *,
    histogram_padding: float = 0.01,
    eps: float = 1e-5,
    min_width: float = 0.0,
) -> Tensor:  # [R, n]
    """Plain PyTorch form of :func:`sample_pdf`: cumulative sum, search, interpolation."""
    rule = (mode, histogram_padding, eps, min_width)
    edges, weights, u = pdf_arguments("sample_pdf", "edges", edges, weights, num_samples, u, *rule)
    return samples_reference(edges, weights, u, *rule)


@torch.no_grad()
def samples_reference(
    edges: Tensor, weights: Tensor, u: Tensor, mode: str, histogram_padding: float, eps: float, min_width: float
) -> Tensor:
    """Samples of checked arguments, in the order of ``u``."""
    weights = weights[:, : edges.shape[1] - 1]
    u = u.expand(edges.shape[0], -1).contiguous()
    if mode == "exact":
        return _exact(edges, weights, u)
    if mode == "neus":
        mass, min_width = weights + eps, eps
    else:
        mass = weights + histogram_padding
        mass = mass + torch.relu(eps - mass.sum(dim=1, keepdim=True)) / weights.shape[1]
    cdf = (mass / mass.sum(dim=1, keepdim=True)).cumsum(dim=1)
    cdf = torch.nn.functional.pad(cdf if mode == "neus" else cdf.clamp(max=1), (1, 0))
    after = torch.searchsorted(cdf, u, right=True)
    before, after = (after - 1).clamp(min=0), after.clamp(max=cdf.shape[1] - 1)
    low = cdf.gather(1, before)
    width = cdf.gather(1, after) - low
    fraction = (u - low) / torch.where(width < min_width, 1.0, width)
    if mode == "nerfstudio":
        fraction = (fraction if min_width > 0 else fraction.nan_to_num(0.0)).clamp(0, 1)
    start = edges.gather(1, before)
    return start + fraction * (edges.gather(1, after) - start)


def _exact(edges: Tensor, weights: Tensor, u: Tensor) -> Tensor:
    last = edges.shape[1] - 2  # last section
    length = edges[:, 1:] - edges[:, :-1]
    mass = weights.clamp(min=0)
    total = mass.sum(dim=1, keepdim=True)
    usable = (total >= torch.finfo(edges.dtype).tiny) & (total < torch.inf)
    mass = torch.where(usable, mass, length.clamp(min=0))
    cumulative = torch.nn.functional.pad(mass.cumsum(dim=1), (1, 0))
    total = cumulative[:, -1:]
    cdf = torch.where(total > 0, cumulative / total, cumulative)  # ends with 1; 0 where all edges are equal
    u = u.clamp(0, 1 - torch.finfo(edges.dtype).eps / 2)
    section = (torch.searchsorted(cdf, u, right=True) - 1).clamp(0, last)
    low, high = cdf.gather(1, section), cdf.gather(1, section + 1)
    fraction = (u - low) / torch.where(high > low, high - low, 1)
    fraction = torch.where(total.isfinite(), fraction, torch.nan)  # edges are not finite
    return edges.gather(1, section) + fraction * length.gather(1, section)


def pdf_arguments(
    op: str,
    name: str,
    edges: Tensor,
    weights: Tensor,
    num_samples: int | None,
    u: Tensor | None,
    mode: str,
    histogram_padding: float,
    eps: float,
    min_width: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Checked ``edges`` (called ``name``), ``weights`` and ``u``, detached."""
    check_tensors(op, **{name: edges, "weights": weights}, **({} if u is None else {"u": u}))
    check_choice(op, "mode", mode, MODES)
    for option, value in (("histogram_padding", histogram_padding), ("eps", eps), ("min_width", min_width)):
        check_number(op, option, value)
        if not 0 <= value < math.inf:
            raise ValueError(f"{op}: {option} must be finite and not negative, got {value}")
    edges, weights = as_geometry(edges.detach(), 2), as_geometry(weights.detach(), 2)
    check_shape(op, name, edges, ("R", "S"))
    check_dtype(op, name, edges, FLOATING)
    rays, samples = edges.shape
    if samples < 2:
        raise ValueError(f"{op}: {name} must have at least 2 samples per ray, got {samples}")
    if weights.shape != (rays, samples) and weights.shape != (rays, samples - 1):
        raise ValueError(
            f"{op}: weights must have shape [{rays}, {samples}] or [{rays}, {samples - 1}], got {list(weights.shape)}"
        )
    check_like(op, "weights", weights, name, edges)
    if num_samples is not None:
        check_count(op, "num_samples", num_samples)
    if u is not None:
        u = as_geometry(u.detach())
        size = u.shape[-1] if num_samples is None and u.dim() > 0 else num_samples
        if u.shape != (rays, size) and u.shape != (size,):
            raise ValueError(f"{op}: u must have shape [{rays}, {size}] or [{size}], got {list(u.shape)}")
        check_like(op, "u", u, name, edges)
        return edges, weights, u
    if num_samples is None:
        raise ValueError(f"{op}: num_samples must be given where u is not, got None")
    u = (torch.arange(num_samples, dtype=edges.dtype, device=edges.device) + 0.5) / max(num_samples, 1)
    return edges, weights, u


def _fake(
    edges: Tensor, weights: Tensor, u: Tensor, mode: str, histogram_padding: float, eps: float, min_width: float
) -> Tensor:
    return edges.new_empty(edges.shape[0], u.shape[-1])


_native.register("sample_pdf", fake=_fake, differentiable=False)
