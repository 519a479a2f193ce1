# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What the two composites share: their result, their arguments, and the plain PyTorch form of their sums."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pred.ops._check import (
    FLOATING,
    as_geometry,
    check_choice,
    check_dtype,
    check_features,
    check_flags,
    check_like,
    check_number,
    check_offsets,
    check_shape,
    check_tensors,
    widen,
)


class Composite(NamedTuple):
    """What :func:`pred.ops.composite_rays` and :func:`pred.ops.composite_alpha` return."""

    weights: Tensor  # [R, S], or [P] for packed rays
    depth: Tensor | None  # [R]; None without `t`
    opacity: Tensor  # [R]
    values: Tensor | None  # [R, C]; None without `values`


def check_options(op: str, depth_at: str, normalize_depth: bool, normalize_eps: float) -> None:
    """What both composites are told about the depth."""
    check_choice(op, "depth_at", depth_at, ("start", "mid"))
    check_flags(op, normalize_depth=normalize_depth)
    check_number(op, "normalize_eps", normalize_eps)


def composite_arguments(
    op: str,
    name: str,
    source: Tensor,
    t: Tensor | None,
    values: Tensor | None,
    ray_offsets: Tensor | None,
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Checked ``source`` (called ``name``), ``t`` and ``values``, with shapes and dtypes as the kernels take them."""
    packed = ray_offsets is not None
    optional = {"t": t, "values": values, "ray_offsets": ray_offsets}
    check_tensors(op, **{name: source}, **{key: value for key, value in optional.items() if value is not None})
    dims = 1 if packed else 2
    source = as_geometry(source, dims)
    check_shape(op, name, source, ("P",) if packed else ("R", "S"))
    check_dtype(op, name, source, FLOATING)
    if ray_offsets is not None:
        check_offsets(op, "ray_offsets", ray_offsets, "RP", name, source)
    if t is not None:
        t = as_geometry(t, dims)
        check_shape(op, "t", t, source.shape, f" as {name}")  # without its sizes: a compiled graph would depend on them
        check_like(op, "t", t, name, source)
    if values is not None:
        values = widen(values)
        check_shape(op, "values", values, (*source.shape, "C"))
        check_features(op, "values", values, name, source)
    return source, t, values


class Layout(NamedTuple):
    """Places of samples in a table of one row per ray, as long as the longest ray, for the references."""

    sample: Tensor | None  # [R, L] which sample; behind a ray's end its last one. None: places are samples
    valid: Tensor  # [R, L] not behind the end
    last: Tensor  # [R, L] a ray's last sample

    def spread(self, samples: Tensor) -> Tensor:
        """From ``[P]`` or ``[P, C]`` to places; behind a ray's end its last sample."""
        return samples if self.sample is None else samples[self.sample]

    def spread_or_zero(self, samples: Tensor) -> Tensor:
        """The same with zeros behind a ray's end."""
        if self.sample is None:
            return samples
        placed = samples[self.sample]
        valid = self.valid.view(self.valid.shape + (1,) * (samples.dim() - 1))
        return torch.where(valid, placed, torch.zeros_like(placed))

    def gather(self, places: Tensor) -> Tensor:
        """From places back to samples."""
        return places if self.sample is None else places[self.valid]


def layout(source: Tensor, ray_offsets: Tensor | None) -> Layout:
    """That of samples shaped like ``source``."""
    if ray_offsets is None:
        valid = torch.ones_like(source, dtype=torch.bool)
        last = torch.zeros_like(valid)
        last[:, -1:] = True
        return Layout(None, valid, last)
    counts = ray_offsets.diff()
    longest = int(counts.max()) if counts.shape[0] > 0 else 0
    place = torch.arange(longest, device=source.device)
    end = (counts - 1).clamp_min(0)[:, None]
    sample = (ray_offsets[:-1, None] + torch.minimum(place, end)).clamp_max(source.shape[0] - 1)
    return Layout(sample, place < counts[:, None], place == counts[:, None] - 1)


def composite_reference(
    weights: Tensor,  # [R, L]
    t: Tensor | None,  # [P] or [R, S]
    values: Tensor | None,  # [P, C] or [R, S, C]
    places: Layout,
    depth_at: str,
    normalize_depth: bool,
    normalize_eps: float,
) -> Composite:
    """The sums over weights, which must be 0 behind a ray's end."""
    depth, rendered, opacity = None, None, weights.sum(dim=1)
    if t is not None:
        position = places.spread_or_zero(t)
        if depth_at == "mid":
            following = torch.cat([position[:, 1:], position[:, -1:]], dim=1)
            position = torch.where(places.last, position, (position + following) / 2)
        depth = (weights * position).sum(dim=1)
        if normalize_depth:
            depth = depth / (opacity + normalize_eps)
    if values is not None:
        table = places.spread_or_zero(values)
        with torch.autocast(weights.device.type, enabled=False):  # as the native op: a product in float32
            rendered = torch.einsum("rs,rsc->rc", weights, table.to(weights.dtype)).to(values.dtype)
    return Composite(places.gather(weights), depth, opacity, rendered)
