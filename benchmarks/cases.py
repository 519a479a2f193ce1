# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs with real LiDAR sizes, and a tiny variant of each.

All are float32, made from a seed, and shaped like what the ops meet in training: points of a spinning LiDAR in firing
order, BEV samples along rays, signed distances that cross one surface per ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

POINT_RANGE_M = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
NEAR_M, FAR_M = 1.0, 60.0
INV_S_PER_M = 2.7
SENSOR_HEIGHT_M = 1.84


@dataclass(frozen=True)
class Sizes:
    """Sizes of every case."""

    bev_channels: int
    bev_cells: int
    """Rows and columns of the BEV map."""
    bev_rays: int
    bev_samples_per_ray: int
    rays: int
    coarse_samples: int
    fine_samples: int
    classes: int
    points: int
    voxel_m: float
    """Edge of the cubic voxels of `voxelize`."""
    voxel_points: int
    """Points per voxel of `voxelize_hard`."""
    max_voxels: int
    search_points: int
    """Points of `farthest_point_sample`, `knn` and `ball_query`."""
    samples: int
    """Samples of the first; the queries of the others."""
    neighbors: int
    boxes: int
    """Boxes on either side of `box_iou_bev` and `box_iou_3d`."""
    candidates: int
    """Boxes before `nms_bev`."""
    frame_boxes: int
    """Boxes of `points_in_boxes`, whose points are `points`."""
    pillar_m: float
    """Edge of the pillars whose points `segment_reduce` joins."""
    features: int
    sparse_sites: int
    """Voxels of the sparse convolutions, of 0.1 x 0.1 x 0.2 m."""
    sparse_channels: int
    """Of a backbone's first stage."""
    step_rays: int
    """Semantic rays of the rendering step, and as many depth rays."""
    step_hidden: int
    dsvt_pillars: tuple[int, ...]
    """Pillars of a frame, in a grid of `dsvt_cells` rows and columns of `dsvt_m` metres."""
    dsvt_cells: int
    dsvt_m: float


REAL = Sizes(
    bev_channels=128,
    bev_cells=180,
    bev_rays=256,
    bev_samples_per_ray=256,
    rays=4096,
    coarse_samples=96,
    fine_samples=128,
    classes=19,
    points=250_000,
    voxel_m=0.1,
    voxel_points=10,
    max_voxels=160_000,
    search_points=32_768,
    samples=2048,
    neighbors=16,
    boxes=500,
    candidates=4096,
    frame_boxes=50,
    pillar_m=0.2,
    features=64,
    sparse_sites=20_000,
    sparse_channels=16,
    step_rays=512,
    step_hidden=256,
    dsvt_pillars=(4000, 20_000),
    dsvt_cells=360,
    dsvt_m=0.3,
)
TINY = Sizes(
    bev_channels=8,
    bev_cells=12,
    bev_rays=4,
    bev_samples_per_ray=16,
    rays=5,
    coarse_samples=6,
    fine_samples=8,
    classes=19,
    points=500,
    voxel_m=0.4,
    voxel_points=3,
    max_voxels=100,
    search_points=300,
    samples=12,
    neighbors=4,
    boxes=12,
    candidates=60,
    frame_boxes=5,
    pillar_m=3.2,
    features=4,
    sparse_sites=300,
    sparse_channels=4,
    step_rays=3,
    step_hidden=16,
    dsvt_pillars=(40, 200),
    dsvt_cells=36,
    dsvt_m=3.0,
)
PAPER = replace(REAL, bev_rays=3072, bev_samples_per_ray=224, rays=6144, step_rays=3072, search_points=131_072)
"""As many rays as a training step of the paper has; for GPUs."""
SIZES = {"tiny": TINY, "real": REAL, "paper": PAPER}


class RaySamples(NamedTuple):
    """Inputs of `sdf_to_alpha` and `composite_rays`."""

    sdf: Tensor  # [R, S], metres
    inv_s: Tensor  # [], per metre
    t: Tensor  # [R, S], metres, ascending
    values: Tensor  # [R, S, K], class probabilities


class PackedRaySamples(NamedTuple):
    """Inputs of packed `composite_rays`: `RaySamples` of rays of different lengths, end to end."""

    sdf: Tensor  # [P]
    inv_s: Tensor  # []
    t: Tensor  # [P]
    ray_offsets: Tensor  # [R + 1]
    values: Tensor  # [P, K]


class CoarseRays(NamedTuple):
    """Inputs of `resample_rays`."""

    t: Tensor  # [R, S], metres, ascending
    weights: Tensor  # [R, S], the last one is 0


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def bev_map(channels: int, cells: int, seed: int = 0) -> Tensor:  # [1, C, H, W]
    """A random BEV map in channels-last memory."""
    rows = torch.randn(1, cells, cells, channels, generator=_generator(seed))
    return rows.permute(0, 3, 1, 2)


def ray_grid(sizes: Sizes, seed: int = 0) -> Tensor:  # [1, N, 2]
    """BEV samples along rays that leave the sensor in the middle of the map, as rendering takes them."""
    generator = _generator(seed)
    azimuth_rad = 2 * math.pi * torch.rand(sizes.bev_rays, 1, generator=generator)
    jitter = torch.rand(sizes.bev_rays, 1, generator=generator)
    start = NEAR_M / POINT_RANGE_M[3]
    radius = start + (1 - start) * (torch.arange(sizes.bev_samples_per_ray) + jitter) / sizes.bev_samples_per_ray
    grid = torch.stack([radius * azimuth_rad.cos(), radius * azimuth_rad.sin()], dim=-1).reshape(1, -1, 2)
    return off_lattice(grid, sizes.bev_cells)


def scattered_grid(sizes: Sizes, seed: int = 0) -> Tensor:  # [1, N, 2]
    """As many samples, uniform over the map and in no order."""
    samples = sizes.bev_rays * sizes.bev_samples_per_ray
    grid = 2 * torch.rand(1, samples, 2, generator=_generator(seed)) - 1
    return off_lattice(grid, sizes.bev_cells)


def off_lattice(grid: Tensor, cells: int) -> Tensor:
    """Moves samples 1 % of a cell away from the lines through cell centres.

    There the derivative in the position jumps, and a rounding error would decide between two right answers.
    """
    cell = ((grid.double() + 1) * cells - 1) / 2
    cell = cell.floor() + 0.01 + 0.98 * (cell - cell.floor())
    return ((2 * cell + 1) / cells - 1).to(grid.dtype)


def _surface_m(num_rays: int, generator: torch.Generator) -> Tensor:  # [R, 1]
    """Range of the surface that each ray meets."""
    return 4 + 46 * torch.rand(num_rays, 1, generator=generator) ** 2


def _sdf_m(t: Tensor, surface_m: Tensor, generator: torch.Generator) -> Tensor:
    """Distance to a slanted plane, with ripples that make it rise now and then, limited as a network's output is."""
    slant = 0.2 + 0.8 * torch.rand(surface_m.shape, generator=generator)
    ripple_m = 0.02 * torch.randn(t.shape, generator=generator)
    return ((surface_m - t) * slant).clamp(-4, 4) + ripple_m


def ray_samples(sizes: Sizes, seed: int = 0) -> RaySamples:
    """Coarse and fine samples of rays that cross one surface each."""
    generator = _generator(seed)
    surface_m = _surface_m(sizes.rays, generator)
    coarse = NEAR_M + (FAR_M - NEAR_M) * torch.rand(sizes.rays, sizes.coarse_samples, generator=generator)
    fine = surface_m + 0.5 * torch.randn(sizes.rays, sizes.fine_samples, generator=generator)
    t = torch.cat([coarse, fine], dim=1).sort(dim=1).values
    sdf = _sdf_m(t, surface_m, generator)
    logits = torch.randn(*t.shape, sizes.classes, generator=generator)
    return RaySamples(sdf, torch.tensor(INV_S_PER_M), t, logits.softmax(dim=-1))


def packed_ray_samples(sizes: Sizes, seed: int = 0) -> PackedRaySamples:
    """`ray_samples`, of which each ray keeps between an eighth and all, as where it leaves the range box."""
    sdf, inv_s, t, values = ray_samples(sizes, seed)
    rays, samples = sdf.shape
    counts = torch.randint(samples // 8, samples + 1, (rays,), generator=_generator(seed))
    kept = torch.arange(samples) < counts[:, None]
    offsets = torch.nn.functional.pad(counts.cumsum(dim=0), (1, 0))
    return PackedRaySamples(sdf[kept], inv_s, t[kept], offsets, values[kept])


def coarse_rays(sizes: Sizes, seed: int = 0) -> CoarseRays:
    """Stratified samples and the weights that their signed distances give."""
    generator = _generator(seed)
    count = sizes.coarse_samples
    jitter = torch.rand(sizes.rays, 1, generator=generator)
    t = NEAR_M + (FAR_M - NEAR_M) * (torch.arange(count) + jitter) / count
    sdf = _sdf_m(t, _surface_m(sizes.rays, generator), generator)
    before, after = torch.sigmoid(INV_S_PER_M * sdf[:, :-1]), torch.sigmoid(INV_S_PER_M * sdf[:, 1:])
    alpha = ((before - after) / before).clamp_min(0)
    transmittance = torch.cat([torch.ones_like(t[:, :1]), (1 - alpha).cumprod(dim=1)], dim=1)
    return CoarseRays(t, torch.nn.functional.pad(alpha, (0, 1)) * transmittance)


def lidar_pillars(num_pillars: int, cells: int, cell_m: float, seed: int = 0) -> Tensor:  # [M, 4]: b, z, y, x
    """Pillars of one frame, as dense as a spinning LiDAR sees a plain: with the inverse square of the distance."""
    generator, half_m = _generator(seed), cells * cell_m / 2
    draws = 20 * num_pillars
    range_m = (half_m * math.sqrt(2)) ** torch.rand(draws, generator=generator)
    azimuth_rad = 2 * math.pi * torch.rand(draws, generator=generator)
    x, y = (((range_m * part + half_m) / cell_m).long() for part in (azimuth_rad.cos(), azimuth_rad.sin()))
    inside = (x >= 0) & (x < cells) & (y >= 0) & (y < cells)
    cell = torch.unique((y * cells + x)[inside])
    if len(cell) < num_pillars:
        raise ValueError(
            f"lidar_pillars: num_pillars must be at most {len(cell)} in so small a grid, got {num_pillars}"
        )
    cell = cell[torch.randperm(len(cell), generator=generator)[:num_pillars]].sort().values
    return torch.stack([torch.zeros_like(cell), torch.zeros_like(cell), cell // cells, cell % cells], dim=1)


def lidar_points(num_points: int, seed: int = 0) -> Tensor:  # [N, 5]: x, y, z, intensity, dt
    """Returns of a 32-beam spinning LiDAR in a street, several sweeps in firing order, all inside `POINT_RANGE_M`.

    The street runs along y between two ragged rows of buildings; low obstacles stand at random ranges.
    """
    generator = _generator(seed)
    elevation_rad = torch.deg2rad(torch.linspace(-30.7, 10.7, 32))
    azimuth_rad = 2 * math.pi * torch.arange(1084) / 1084
    sectors = 120
    obstacle_m = 4 + 46 * torch.rand(sectors, generator=generator)
    facade_m = 6 + 34 * torch.rand(sectors, generator=generator) ** 2
    obstacle_height_m = 2.5 * torch.rand(sectors, generator=generator)
    sector = (torch.arange(1084) * sectors) // 1084

    azimuth_rad, sector = azimuth_rad[:, None], sector[:, None]
    cos, slope = elevation_rad.cos(), elevation_rad.tan()
    sweeps: list[Tensor] = []
    while sum(len(sweep) for sweep in sweeps) < num_points:
        turn = azimuth_rad + 0.002 * torch.randn(1, generator=generator)
        ground_m = torch.where(slope < 0, SENSOR_HEIGHT_M / -slope, math.inf)
        building_m = facade_m[sector] / turn.cos().abs().clamp_min(1e-6)
        hit = obstacle_m[sector] * slope < obstacle_height_m[sector] - SENSOR_HEIGHT_M
        horizontal_m = torch.minimum(ground_m, building_m)
        horizontal_m = torch.where(hit, torch.minimum(horizontal_m, obstacle_m[sector]), horizontal_m)
        horizontal_m = horizontal_m + 0.02 * torch.randn(horizontal_m.shape, generator=generator) * cos
        delay_s = torch.full_like(horizontal_m, 0.05 * len(sweeps))
        y_m = horizontal_m * turn.sin() - 10 * delay_s  # the car drives at 10 m/s
        intensity = 255 * torch.rand(horizontal_m.shape, generator=generator)
        points = torch.stack(
            [horizontal_m * turn.cos(), y_m, (horizontal_m * slope).expand_as(y_m), intensity, delay_s], dim=-1
        ).reshape(-1, 5)
        low, high = torch.tensor(POINT_RANGE_M).view(2, 3)
        inside = ((points[:, :3] >= low) & (points[:, :3] < high)).all(dim=1)
        sweeps.append(points[inside & (horizontal_m.reshape(-1) < 70)])
    return torch.cat(sweeps)[:num_points].contiguous()


def road_users(count: int, seed: int = 0) -> Tensor:  # [N, 7]: x, y, z, length, width, height, yaw
    """Boxes of cars, trucks, cyclists and people on the ground around the sensor, at any yaw; more of them near it."""
    generator = _generator(seed)
    sizes_m = torch.tensor([[4.6, 1.9, 1.7], [9.0, 2.8, 3.4], [1.8, 0.7, 1.7], [0.7, 0.7, 1.8]])
    kind = torch.multinomial(torch.tensor([0.55, 0.1, 0.1, 0.25]), count, replacement=True, generator=generator)
    size_m = sizes_m[kind] * (0.85 + 0.3 * torch.rand(count, 3, generator=generator))
    centre_m = 45 * (2 * torch.rand(count, 2, generator=generator) - 1) * torch.rand(count, 1, generator=generator)
    z_m = size_m[:, 2:] / 2 - SENSOR_HEIGHT_M
    yaw_rad = 2 * math.pi * torch.rand(count, 1, generator=generator)
    return torch.cat([centre_m, z_m, size_m, yaw_rad], dim=1)


def detections(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:  # [N, 7] and [N]
    """What a detector proposes: some eight boxes around every road user, with scores."""
    generator = _generator(seed + 1)
    boxes = road_users((count + 7) // 8, seed).repeat(8, 1)[:count]
    spread = torch.tensor([0.4, 0.4, 0.1, 0.2, 0.1, 0.1, 0.1])
    boxes = boxes + spread * torch.randn(count, 7, generator=generator)
    boxes[:, 3:6] = boxes[:, 3:6].clamp_min(0.1)
    return boxes, torch.rand(count, generator=generator)
