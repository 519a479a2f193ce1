# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""PRED pre-training (paper, section 3): encoder, field and renderer under the rendering losses.

Two kinds of rays stay apart: depth rays teach the signed distance (with the Eikonal term), semantic
rays take it as given and teach the class scores.

B frames, R rays per frame, N points, D point channels, C map channels, K classes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from pred.data.batch import Batch, DepthRays, Rays, SemanticRays
from pred.losses import LossConfig, depth_loss, eikonal_loss, mean_over_valid, semantic_loss
from pred.models.encoders.pillars import PillarEncoder, PillarEncoderConfig
from pred.models.field import FieldConfig, FieldDecoder
from pred.models.renderer import RenderedRays, Renderer, RendererConfig, Sharpness

ZERO_OPACITY = 1e-3
"""Rays less opaque than this count as lost: their signed distance learns nothing from depth."""


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
        point_channels: D, raw channels per point.
    """

    def __init__(
        self,
        encoder: PillarEncoderConfig,
        field: FieldConfig,
        renderer: RendererConfig,
        loss: LossConfig,
        point_range: tuple[float, float, float, float, float, float],
        point_channels: int = 5,
    ) -> None:
        super().__init__()
        self.encoder = PillarEncoder(encoder, point_range, point_channels)
        self.field = FieldDecoder(self.encoder.out_channels, field, point_range)
        self.sharpness = Sharpness(renderer.initial_inv_s)
        self.renderer = Renderer(renderer, point_range)
        self.loss_config = loss

    @property
    def inv_s(self) -> Tensor:
        """Learned sharpness, 0-dim, per metre."""
        return self.sharpness()

    def forward(self, batch: Batch) -> PretrainOutput:
        """Loss of a batch. The encoder obeys autocast; field and rendering keep full precision."""
        bev = self.encode(batch.points, batch.point_offsets)
        with torch.autocast(bev.device.type, enabled=False):
            return self._losses(self.field.project(bev), batch.depth, batch.semantic)

    def _losses(
        self,
        projected: Tensor,  # [B, hidden, H, W]
        depth_rays: DepthRays,
        semantic_rays: SemanticRays | None,
    ) -> PretrainOutput:
        config, inv_s = self.loss_config, self.inv_s
        rendered = self._render_rays(projected, inv_s, depth_rays, with_gradient=True)
        assert rendered.gradient is not None
        hit, target_m = rendered.hit, depth_rays.depth_m
        # Rays that do not count may hold NaN factors.
        depth_m = rendered.depth_m * torch.where(hit, depth_rays.depth_factor, 1.0)
        depth = depth_loss(depth_m, target_m, hit, config.depth_unit_m)
        eikonal = eikonal_loss(rendered.gradient, hit)
        loss = config.depth_weight * depth + config.eikonal_weight * eikonal
        num_rays = hit.sum()

        semantic = torch.zeros_like(loss)
        if semantic_rays is not None:
            seen = self._render_rays(
                projected, inv_s, semantic_rays, semantics=True, detach_sdf=True
            )
            assert seen.semantics is not None
            semantic = semantic_loss(
                seen.semantics, semantic_rays.target, semantic_rays.confidence, seen.hit
            )
            loss = loss + config.semantic_weight * semantic
            num_rays = num_rays + seen.hit.sum()

        terms = {"semantic": semantic, "depth": depth, "eikonal": eikonal}
        lost = (rendered.opacity.detach() < ZERO_OPACITY).to(loss.dtype)
        return PretrainOutput(
            loss=loss,
            terms={name: term.detach() for name, term in terms.items()},
            depth_mae_m=mean_over_valid((depth_m.detach() - target_m).abs(), hit),
            zero_opacity_share=mean_over_valid(lost, hit),
            inv_s=inv_s.detach(),
            num_rays=num_rays,
        )

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
