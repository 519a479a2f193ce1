# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Volume rendering of a signed distance field: where to sample each ray, and what the samples add up to.

Following NeuS, coarse stratified samples find the surface and fine ones are drawn from their
weights; following PRED, the opacity of a sample comes from the signed distances of the sample and
its successor, without a normal. t is the range along a ray of unit direction, in metres.

B frames, R rays per frame, S samples per ray, K classes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from pred.data.rays import NEAR_M
from pred.models.field import FieldDecoder
from pred.ops import composite_rays, resample_rays

MIN_INV_S = 1e-6
MAX_INV_S = 1e6


@dataclass
class RendererConfig:
    """Sampling and compositing along a ray."""

    coarse_samples: int = 96
    """Stratified samples over the ray's way through the range box."""
    fine_samples: int = 128
    """Samples drawn from the coarse samples' weights and merged with them."""
    near_m: float = NEAR_M
    """Rays start so far from their origin, metres."""
    initial_inv_s: float = 2.7
    """Sharpness s of the sigmoid at the start of training, per metre."""
    resample_inv_s: float | None = None
    """Sharpness at which the fine samples are drawn, per metre; None: the current learned one."""
    depth_at: Literal["start", "mid"] = "start"
    """Depth of a sample's weight: the sample itself (paper) or the middle of its interval."""
    normalize_depth: bool = False
    """Divide the rendered depth by the ray's opacity (not in the paper)."""
    samples_per_part: int | None = None
    """Training renders about so many samples at a time: bounds the memory, changes nothing else. None: 16384 on the
    CPU, 262144 on a GPU, which fewer would not keep busy."""

    def __post_init__(self) -> None:
        if self.coarse_samples < 2:
            raise ValueError(f"RendererConfig: coarse_samples must be at least 2, got {self.coarse_samples}")
        if self.fine_samples < 0:
            raise ValueError(f"RendererConfig: fine_samples must not be negative, got {self.fine_samples}")
        if self.samples_per_part is not None and self.samples_per_part < 1:
            raise ValueError(f"RendererConfig: samples_per_part must be at least 1, got {self.samples_per_part}")
        if not self.near_m >= 0:
            raise ValueError(f"RendererConfig: near_m must not be negative, got {self.near_m}")
        for name in ("initial_inv_s", "resample_inv_s"):
            value = getattr(self, name)
            if value is not None and not MIN_INV_S <= value <= MAX_INV_S:
                raise ValueError(f"RendererConfig: {name} must be in [{MIN_INV_S}, {MAX_INV_S}], got {value}")


class Sharpness(nn.Module):
    """Learned sharpness s = exp(10 v) of the sigmoid, per metre, clipped to [1e-6, 1e6] (as NeuS)."""

    def __init__(self, initial_inv_s: float) -> None:
        super().__init__()
        self.v = nn.Parameter(torch.tensor(math.log(initial_inv_s) / 10))

    def forward(self) -> Tensor:  # []
        # Clipped before exp(): the other order has the derivative 0 * inf for a huge v.
        return (10 * self.v).clamp(math.log(MIN_INV_S), math.log(MAX_INV_S)).exp()


class RaySamples(NamedTuple):
    """Samples of rays, ascending in t, all finite."""

    points_m: Tensor
    """`[B, R, S, 3]`, metres."""
    t_m: Tensor
    """`[B, R, S]`, metres along the ray."""
    hit: Tensor
    """`[B, R]` bool: the ray counts. The others' samples are placeholders inside the range box."""


class RenderedRays(NamedTuple):
    """What rays see. Rays that do not count (`hit` False) hold finite numbers without meaning."""

    depth_m: Tensor
    """`[B, R]`: sum of weight times t, metres of range; not normalised unless configured."""
    opacity: Tensor
    """`[B, R]` in [0, 1]: sum of the weights."""
    semantics: Tensor | None
    """`[B, R, K]`: composited class probabilities, summing to the opacity."""
    gradient: Tensor | None
    """`[B, R, S, 3]`: d sdf / d point at the samples."""
    hit: Tensor
    """`[B, R]` bool."""


class Renderer:
    """Renders a `FieldDecoder` along rays.

    Args:
        config: sampling and compositing.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max), metres; rays are sampled
            from `near_m` to their exit from it.
    """

    def __init__(
        self,
        config: RendererConfig,
        point_range: tuple[float, float, float, float, float, float],
    ) -> None:
        self.config = config
        self.point_range = point_range

    def rays_per_part(self, device: torch.device) -> int:
        """Rays that have about `samples_per_part` samples."""
        samples_per_ray = self.config.coarse_samples + self.config.fine_samples
        samples = self.config.samples_per_part or (16384 if device.type == "cpu" else 262144)
        return max(1, samples // samples_per_ray)

    def hits(
        self,
        origins: Tensor,  # [B, R, 3]
        directions: Tensor,  # [B, R, 3]
        valid: Tensor,  # [B, R] bool
    ) -> Tensor:  # [B, R] bool
        """Rays that count: valid, finite, and with a part of the range box beyond `near_m`."""
        return valid & ray_box_interval(origins, directions, self.point_range, self.config.near_m)[2]

    @torch.no_grad()
    def sample(
        self,
        field: FieldDecoder,
        projected: Tensor,  # [B, hidden, H, W]
        inv_s: Tensor,  # []
        origins: Tensor,  # [B, R, 3]
        directions: Tensor,  # [B, R, 3]
        valid: Tensor,  # [B, R] bool
        jitter: Tensor,  # [B, R]
    ) -> RaySamples:
        """Coarse-to-fine sample positions; constants for every derivative.

        Args:
            field: decoder, read at the coarse samples.
            projected: `field.project(bev)`.
            inv_s: sharpness per metre.
            origins, directions: rays in metres, unit directions, the field's frame.
            valid: rays to look at.
            jitter: shift of a ray's coarse samples within their strata, in [0, 1).
        """
        t_near, t_far, crosses = ray_box_interval(origins, directions, self.point_range, self.config.near_m)
        hit = valid & crosses
        # A ray that does not count is replaced by a harmless one, so that no NaN enters the field.
        low, high = _box(self.point_range, origins)
        ahead = torch.zeros_like(directions)
        ahead[..., 0] = 1
        origins = torch.where(hit[..., None], origins, (low + high) / 2)
        directions = torch.where(hit[..., None], directions, ahead)
        jitter = torch.where(hit, jitter, 0.5)

        t = stratified_samples(t_near, t_far, jitter, self.config.coarse_samples)
        if self.config.fine_samples > 0:
            points = _points_on_rays(origins, directions, t)
            sdf = field.decode(projected, points.flatten(1, 2), semantics=False).sdf
            sharpness = self.config.resample_inv_s or inv_s
            t_rays = t.flatten(0, 1)
            weights = composite_rays(sdf.view_as(t_rays), sharpness, t_rays).weights
            t = resample_rays(t_rays, weights, self.config.fine_samples).unflatten(0, t.shape[:2])
        return RaySamples(_points_on_rays(origins, directions, t), t, hit)

    def render(
        self,
        field: FieldDecoder,
        projected: Tensor,  # [B, hidden, H, W]
        inv_s: Tensor,  # []
        samples: RaySamples,
        *,
        semantics: bool = False,
        with_gradient: bool = False,
        detach_sdf: bool = False,
    ) -> RenderedRays:
        """Composites the field along the samples (PRED Eq. 4 and 6).

        Args:
            field: decoder.
            projected: `field.project(bev)`.
            inv_s: sharpness per metre.
            samples: from `sample`.
            semantics: also render class probabilities, by a softmax per sample.
            with_gradient: also return d sdf / d point at the samples.
            detach_sdf: weights are constants; only the class probabilities carry derivatives.
        """
        num_frames, num_rays, num_samples = samples.t_m.shape
        decoded = field.decode(projected, samples.points_m.flatten(1, 2), with_gradient, semantics)
        sdf = decoded.sdf.view(num_frames * num_rays, num_samples)
        values = None
        if decoded.semantics is not None:
            values = decoded.semantics.softmax(-1).view(*sdf.shape, decoded.semantics.shape[-1])
        composite = composite_rays(
            sdf,
            inv_s,
            samples.t_m.flatten(0, 1),
            values,
            depth_at=self.config.depth_at,
            normalize_depth=self.config.normalize_depth,
            detach_sdf=detach_sdf,
        )
        assert composite.depth is not None  # it is with `t`
        rays = (num_frames, num_rays)
        gradient = decoded.gradient
        return RenderedRays(
            depth_m=composite.depth.view(rays),
            opacity=composite.opacity.view(rays),
            semantics=None if composite.values is None else composite.values.unflatten(0, rays),
            gradient=None if gradient is None else gradient.view(*rays, num_samples, 3),
            hit=samples.hit,
        )


def ray_box_interval(
    origins: Tensor,  # [..., 3]
    directions: Tensor,  # [..., 3]
    point_range: tuple[float, float, float, float, float, float],
    near_m: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Part of each ray inside the range box and not nearer than `near_m`: slab test in IEEE arithmetic.

    A direction component of 0 gives infinite slab distances of the right sign, without an epsilon.

    Returns:
        t_near, t_far `[...]` in units of the directions' length (metres for unit directions) and
        valid `[...]` bool. A ray that misses the box, ends before `near_m` or is not finite has
        valid False and the finite interval [near_m, near_m + 1].
    """
    low, high = _box(point_range, origins)
    to_low = (low - origins) / directions
    to_high = (high - origins) / directions
    # 0 / 0, a ray within a face's plane, is NaN and makes the ray miss, like any other NaN.
    t_near = torch.minimum(to_low, to_high).amax(-1).clamp_min(near_m)
    t_far = torch.maximum(to_low, to_high).amin(-1)
    valid = (t_far > t_near) & t_far.isfinite()
    near = torch.full_like(t_near, near_m)
    return torch.where(valid, t_near, near), torch.where(valid, t_far, near + 1), valid


def stratified_samples(
    t_near: Tensor,  # [...]
    t_far: Tensor,  # [...]
    jitter: Tensor,  # [...]
    num_samples: int,
) -> Tensor:  # [..., S]
    """One sample in each of S equal strata of [t_near, t_far], all shifted alike (as NeuS).

    `jitter` in [0, 1) places the samples within their strata; 0.5 is the middle.
    """
    stratum = torch.arange(num_samples, dtype=t_near.dtype, device=t_near.device)
    share = (stratum + jitter[..., None]) / num_samples
    return t_near[..., None] + (t_far - t_near)[..., None] * share


def _box(point_range: Sequence[float], like: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest corner `[3]`, made where `like` is: a copy from the host would not go into a CUDA graph."""
    corners = torch.stack([like.new_full((), bound) for bound in point_range])
    return corners[:3], corners[3:]


def _points_on_rays(
    origins: Tensor,  # [B, R, 3]
    directions: Tensor,  # [B, R, 3]
    t: Tensor,  # [B, R, S]
) -> Tensor:  # [B, R, S, 3]
    return origins[..., None, :] + directions[..., None, :] * t[..., None]
