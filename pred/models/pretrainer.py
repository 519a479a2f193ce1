# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""PRED pre-training (paper, section 3): encoder, field and renderer under the rendering losses.

Two kinds of rays stay apart: depth rays teach the signed distance (with the Eikonal term), semantic
rays take it as given and teach the class scores.

B frames, R rays per frame, N points, D point channels, C map channels, K classes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pred.data.batch import Batch, DepthRays, Rays, SemanticRays
from pred.losses import LossConfig, depth_loss, eikonal_loss, mean_over_valid, semantic_loss
from pred.models.encoders import Encoder, EncoderConfig
from pred.models.field import FieldConfig, FieldDecoder
from pred.models.renderer import RenderedRays, Renderer, RendererConfig, Sharpness

ZERO_OPACITY = 1e-3
"""Rays less opaque than this count as lost: their signed distance learns nothing from depth."""


FIGURES = ("semantic", "depth", "eikonal", "depth_mae_m", "zero_opacity_share", "num_rays")
"""What is summed up over the parts of a batch."""

RaysT = TypeVar("RaysT", bound=Rays)


class PretrainOutput(NamedTuple):
    """Loss of one batch, and figures to log (0-dim tensors without gradient)."""

    loss: Tensor
    """Weighted sum of the terms."""
    terms: dict[str, Tensor]
    """Unweighted `semantic`, `depth` and `eikonal`; `semantic` is 0 without semantic rays."""
    depth_mae_m: Tensor
    """Mean absolute depth error of the valid depth rays, metres."""
    zero_opacity_share: Tensor
    """Share of the valid depth rays that see nothing (opacity below 1e-3)."""
    inv_s: Tensor
    """Learned sharpness, per metre."""
    num_rays: Tensor
    """Valid rays of both kinds, int64."""


class RenderedView(NamedTuple):
    """Rendering of arbitrary rays; zeros where a ray misses the range box."""

    depth_m: Tensor
    """`[B, R]`, metres of range."""
    opacity: Tensor
    """`[B, R]` in [0, 1]."""
    semantics: Tensor
    """`[B, R, K]` class probabilities, summing to the opacity."""


class Pretrainer(nn.Module):
    """Everything that is trained, from points to the loss.

    Args:
        encoder, field, renderer, loss: configurations of the parts.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame.
        point_channels: D, raw channels per point that the encoder uses.
    """

    def __init__(
        self,
        encoder: EncoderConfig,
        field: FieldConfig,
        renderer: RendererConfig,
        loss: LossConfig,
        point_range: tuple[float, float, float, float, float, float],
        point_channels: int = 5,
    ) -> None:
        super().__init__()
        self.encoder = Encoder(encoder, point_range, point_channels)
        self.field = FieldDecoder(self.encoder.out_channels, field, point_range)
        self.sharpness = Sharpness(renderer.initial_inv_s)
        self.renderer = Renderer(renderer, point_range)
        self.loss_config = loss

    @property
    def inv_s(self) -> Tensor:
        """Learned sharpness, 0-dim, per metre."""
        return self.sharpness()

    def forward(self, batch: Batch) -> PretrainOutput:
        """Loss of a batch. The encoder obeys autocast; field and rendering keep full precision.

        The rays are rendered in parts of `samples_per_part` samples, and each part's derivatives
        are taken before the next part is rendered: memory does not grow with the number of rays,
        and activations stay in the cache. The result differs by rounding alone.
        """
        bev = self.encode(batch.points, batch.point_offsets)
        with torch.autocast(bev.device.type, enabled=False):
            inv_s, frames = self.inv_s, self.field.project(bev).split(1)
            totals = {name: torch.zeros_like(inv_s.detach()) for name in FIGURES}

            def parts(inv_s: Tensor, *frames: Tensor) -> Iterator[Tensor]:
                yield from self._depth_parts(frames, inv_s, batch.depth, totals)
                if batch.semantic is not None:
                    yield from self._semantic_parts(frames, inv_s, batch.semantic, totals)

            loss = sum_of_parts(parts, [inv_s, *frames], list(self.field.parameters()))
        return PretrainOutput(
            loss=loss,
            terms={name: totals[name] for name in ("semantic", "depth", "eikonal")},
            depth_mae_m=totals["depth_mae_m"],
            zero_opacity_share=totals["zero_opacity_share"],
            inv_s=inv_s.detach(),
            num_rays=totals["num_rays"].long(),
        )

    def _depth_parts(
        self,
        frames: Sequence[Tensor],  # B projected maps [1, hidden, H, W]
        inv_s: Tensor,
        depth_rays: DepthRays,
        totals: dict[str, Tensor],
    ) -> Iterator[Tensor]:
        """Weighted loss of each part of the depth rays; adds its figures to `totals`."""
        config = self.loss_config
        for frame, rays, share in self._parts(depth_rays, totals):
            rendered = self._render_rays(frames[frame], inv_s, rays, with_gradient=True)
            assert rendered.gradient is not None
            hit = rendered.hit
            # Rays that do not count may hold NaN factors.
            depth_m = rendered.depth_m * torch.where(hit, rays.depth_factor, 1.0)
            depth = share * depth_loss(depth_m, rays.depth_m, hit, config.depth_unit_m)
            eikonal = share * eikonal_loss(rendered.gradient, hit)
            error_m = (depth_m - rays.depth_m).abs()
            lost = (rendered.opacity < ZERO_OPACITY).to(depth.dtype)
            totals["depth"] += depth.detach()
            totals["eikonal"] += eikonal.detach()
            totals["depth_mae_m"] += share * mean_over_valid(error_m.detach(), hit)
            totals["zero_opacity_share"] += share * mean_over_valid(lost, hit)
            yield config.depth_weight * depth + config.eikonal_weight * eikonal

    def _semantic_parts(
        self,
        frames: Sequence[Tensor],  # B projected maps [1, hidden, H, W]
        inv_s: Tensor,
        semantic_rays: SemanticRays,
        totals: dict[str, Tensor],
    ) -> Iterator[Tensor]:
        """Weighted loss of each part of the semantic rays; adds its figures to `totals`."""
        for frame, rays, share in self._parts(semantic_rays, totals):
            if self.loss_config.semantic_at == "ray":
                rendered = self._render_rays(frames[frame], inv_s, rays, semantics=True, detach_sdf=True)
                semantics, hit = rendered.semantics, rendered.hit
            else:
                semantics, hit = self._decode_returns(frames[frame], rays)
            assert semantics is not None
            semantic = share * semantic_loss(semantics, rays.target, rays.confidence, hit)
            totals["semantic"] += semantic.detach()
            yield self.loss_config.semantic_weight * semantic

    def _decode_returns(self, projected: Tensor, rays: SemanticRays) -> tuple[Tensor, Tensor]:
        """Class probabilities `[1, r, K]` at the rays' returns, and which count `[1, r]`."""
        hit = self.renderer.hits(rays.origins, rays.directions, rays.valid)
        # Rays that do not count may hold NaN, which would reach the weights' gradients.
        returns = torch.where(hit[..., None], rays.origins + rays.directions * rays.range_m[..., None], 0.0)
        logits = self.field.decode(projected, returns).semantics
        assert logits is not None
        return logits.softmax(-1), hit

    def _parts(self, rays: RaysT, totals: dict[str, Tensor]) -> Iterator[tuple[int, RaysT, Tensor]]:
        """Splits rays: (frame, rays `[1, r]`, share of the valid rays of the whole batch)."""
        hit = self.renderer.hits(rays.origins, rays.directions, rays.valid)
        count = hit.sum()
        totals["num_rays"] += count
        num_frames, num_rays = hit.shape
        step = self.renderer.rays_per_part(hit.device)
        for frame in range(num_frames):
            for start in range(0, num_rays, step):
                part = (slice(frame, frame + 1), slice(start, start + step))
                share = hit[part].sum() / count.clamp_min(1)
                yield frame, replace(rays, **{k: v[part] for k, v in vars(rays).items()}), share

    def encode(
        self,
        points: Tensor,  # [N, D]
        point_offsets: Tensor,  # [B + 1] int64
    ) -> Tensor:  # [B, C, H, W]
        """BEV map in the field's precision."""
        return self.encoder(points, point_offsets).to(self.sharpness.v.dtype)

    @torch.no_grad()
    def render(
        self,
        bev: Tensor,  # [B, C, H, W]
        origins: Tensor,  # [B, R, 3]
        directions: Tensor,  # [B, R, 3]
        chunk: int = 1024,
    ) -> RenderedView:
        """Renders depth and semantics for evaluation and pictures, `chunk` rays per frame at a time.

        Args:
            bev: map from `encode`.
            origins: metres, LiDAR frame.
            directions: unit length.
            chunk: bounds the memory; results do not depend on it.
        """
        views = []
        with torch.autocast(bev.device.type, enabled=False):
            projected, inv_s = self.field.project(bev), self.inv_s
            for start in range(0, max(origins.shape[1], 1), chunk):
                part = origins[:, start : start + chunk]
                every = torch.ones(part.shape[:2], dtype=torch.bool, device=part.device)
                rays = Rays(part, directions[:, start : start + chunk], every, part.new_full(every.shape, 0.5))
                seen = self._render_rays(projected, inv_s, rays, semantics=True)
                assert seen.semantics is not None
                views.append(
                    RenderedView(
                        torch.where(seen.hit, seen.depth_m, 0.0),
                        torch.where(seen.hit, seen.opacity, 0.0),
                        torch.where(seen.hit[..., None], seen.semantics, 0.0),
                    )
                )
        return RenderedView(*(torch.cat(parts, dim=1) for parts in zip(*views, strict=True)))

    def _render_rays(
        self,
        projected: Tensor,
        inv_s: Tensor,
        rays: Rays,
        *,
        semantics: bool = False,
        with_gradient: bool = False,
        detach_sdf: bool = False,
    ) -> RenderedRays:
        samples = self.renderer.sample(
            self.field, projected, inv_s, rays.origins, rays.directions, rays.valid, rays.jitter
        )
        return self.renderer.render(
            self.field,
            projected,
            inv_s,
            samples,
            semantics=semantics,
            with_gradient=with_gradient,
            detach_sdf=detach_sdf,
        )


def sum_of_parts(
    parts: Callable[..., Iterable[Tensor]], inputs: Sequence[Tensor], parameters: Sequence[Tensor]
) -> Tensor:
    """`sum(parts(*inputs))` whose derivatives are taken part by part, as the parts come.

    Value and gradient are those of the plain sum. But the graph of one part is freed before the next
    is made, so memory does not grow with the number of parts.

    Args:
        parts: makes the parts, 0-dim tensors, lazily.
        inputs: tensors that the parts are made from.
        parameters: leaves with a derivative that `parts` uses besides.
    """
    differentiable = any(tensor.requires_grad for tensor in (*inputs, *parameters))
    if not (differentiable and torch.is_grad_enabled()):
        with torch.no_grad():
            return torch.stack(list(parts(*inputs))).sum()
    total: Tensor = _SumOfParts.apply(parts, len(inputs), *inputs, *parameters)
    return total


class _SumOfParts(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parts: Callable[..., Iterable[Tensor]], num_inputs: int, *tensors: Tensor) -> Tensor:
        # Cut off from what lies before them, where each part's backward pass would go otherwise.
        inputs = [x.detach().requires_grad_(x.requires_grad) for x in tensors[:num_inputs]]
        leaves = [x for x in (*inputs, *tensors[num_inputs:]) if x.requires_grad]
        # A half-precision map gets hundreds of small gradients, which its own dtype would swallow.
        sums = [torch.zeros_like(leaf, dtype=torch.promote_types(leaf.dtype, torch.float32)) for leaf in leaves]
        total = inputs[0].new_zeros(())
        with torch.enable_grad():
            for part in parts(*inputs):
                gradients = torch.autograd.grad(part, leaves, allow_unused=True)
                for sum_, gradient in zip(sums, gradients, strict=True):
                    if gradient is not None:
                        sum_ += gradient
                total += part.detach()
        ctx.save_for_backward(*sums)
        ctx.dtypes = [tensor.dtype for tensor in tensors]
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_total: Tensor) -> tuple[Tensor | None, ...]:
        sums = iter(ctx.saved_tensors)
        needed = ctx.needs_input_grad[2:]
        found = (grad_total * next(sums) if need else None for need in needed)
        return (
            None,
            None,
            *(
                None if gradient is None else gradient.to(dtype)
                for gradient, dtype in zip(found, ctx.dtypes, strict=True)
            ),
        )
