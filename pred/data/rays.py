# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ray candidates of a frame, and how training rays are drawn from them.

Two populations that are never mixed: depth rays towards LiDAR returns, and semantic rays from
cameras through the pixels that LiDAR returns project to (PRED section 3.2). Both use the keyframe's
own returns inside the range box and outside the ego box. The held-out returns among them are for
evaluation only; the encoder never sees those either, not even in a later frame's sweeps.

For the paper's ablation "Neural Rendering" the same labels may be projected directly instead: rays
from the LiDAR to the returns, each with the label of the pixel that its return projects to, whatever
stands before it there, or only where the depth of the image agrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import NUM_CLASSES, Camera, Frame, inside_range, outside_ego_box
from pred.data.masking import is_held_out

NEAR_M = 1.0
"""Default distance, metres, from which rays are rendered: nearer returns are no targets."""

DepthView = Literal["lidar", "image"]
SemanticView = Literal["camera", "lidar"]

DepthTolerance = tuple[float, float]
"""(absolute, relative): depths agree that differ by at most absolute + relative x image depth, metres."""


class DepthCandidates(NamedTuple):
    """N depth rays in the LiDAR frame.

    Attributes:
        origins: [N, 3] float32, metres.
        directions: [N, 3] float32, unit length.
        depth_m: [N] float32, range in the LiDAR view, z-depth in the image view.
        depth_factor: [N] float32, depth per metre along the ray.
    """

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    depth_factor: NDArray[np.float32]


class SemanticCandidates(NamedTuple):
    """N labelled pixels of one camera as rays in the LiDAR frame.

    Attributes:
        origins: [N, 3] float32, the camera centre (in the LiDAR view the LiDAR), metres.
        directions: [N, 3] float32, unit length, through the LiDAR return.
        range_m: [N] float32, distance from the origin to the return.
        target: [N, 19] float32 class probabilities.
        confidence: [N] float32, the largest probability.
        class_id: [N] int64 in 0..18.
    """

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    range_m: NDArray[np.float32]
    target: NDArray[np.float32]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]


@dataclass
class FrameCandidates:
    """What a frame offers to training; free of randomness.

    Attributes:
        token: frame token.
        points: [N, 5] float32 points the encoder may see (masking comes later).
        depth: candidates for depth rays.
        semantic: candidates for semantic rays, one entry per camera with a pseudo label.
    """

    token: str
    points: NDArray[np.float32]
    depth: DepthCandidates
    semantic: list[SemanticCandidates]

    def class_counts(self) -> NDArray[np.int64]:
        """[19] number of semantic candidates of each class."""
        return np.bincount(join_cameras(self.semantic).class_id, minlength=NUM_CLASSES)


class PointUse(NamedTuple):
    """What each point of a frame may serve for.

    Attributes:
        input: [N] bool, the encoder may see it.
        targets: [N] bool, a return of the keyframe that training may aim at.
        held_out: [N] bool, a return of the keyframe that only evaluation may aim at.
    """

    input: NDArray[np.bool_]
    targets: NDArray[np.bool_]
    held_out: NDArray[np.bool_]


def point_use(
    frame: Frame, point_range: tuple[float, ...], ego_box: tuple[float, ...], holdout_fraction: float
) -> PointUse:
    """Split a frame's points; arguments as in `frame_candidates`."""
    held = frame.is_keyframe & is_held_out(frame.point_index, frame.token, holdout_fraction)
    hidden = held.copy()
    for token, rows in frame.earlier_keyframes.items():
        hidden[rows] = is_held_out(frame.point_index[rows], token, holdout_fraction)
    # Sweep points may lie where the own car is now: it has moved since.
    own_car = frame.is_keyframe & ~outside_ego_box(frame.points, ego_box)
    inside = inside_range(frame.points, point_range) & ~own_car
    returns = inside & frame.is_keyframe
    return PointUse(input=inside & ~hidden, targets=returns & ~held, held_out=returns & held)


def frame_candidates(
    frame: Frame,
    point_range: tuple[float, ...],
    ego_box: tuple[float, ...],
    holdout_fraction: float,
    depth_view: DepthView = "lidar",
    near_m: float = NEAR_M,
    semantic_view: SemanticView = "camera",
    depth_filter: DepthTolerance | None = None,
) -> FrameCandidates:
    """Split a frame into what the encoder may see and what training rays may aim at.

    Args:
        frame: the frame.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame.
        ego_box: (x_min, y_min, x_max, y_max), metres, LiDAR frame; applies to keyframe returns.
        holdout_fraction: share of the keyframe returns kept for evaluation.
        depth_view: where depth rays start.
        near_m: rays are rendered from this distance on, so nearer returns are no targets, metres.
        semantic_view: where semantic rays start. A return that several cameras see gives one ray for each of them in
            which it has a label.
        depth_filter: with a tolerance, a return has a label only where its z-depth agrees with the depth map of the
            image; where that has no depth, nothing agrees.

    Raises:
        FrameError: a pseudo label or a depth map cannot be used.
    """
    use = point_use(frame, point_range, ego_box, holdout_fraction)
    returns = frame.points[use.targets, :3].astype(np.float64)
    depth, semantic = ray_candidates(returns, frame.cameras, near_m, depth_view, semantic_view, depth_filter)
    return FrameCandidates(frame.token, frame.points[use.input], depth, semantic)


def ray_candidates(
    returns: NDArray[np.float64],  # [N, 3] metres, LiDAR frame
    cameras: list[Camera],
    near_m: float = NEAR_M,
    depth_view: DepthView = "lidar",
    semantic_view: SemanticView = "camera",
    depth_filter: DepthTolerance | None = None,
) -> tuple[DepthCandidates, list[SemanticCandidates]]:
    """Depth rays towards returns, and semantic rays of each camera with a pseudo label; as `frame_candidates`."""
    if depth_view == "lidar":
        depth = _lidar_view(returns, near_m)
    else:
        depth = _image_view(returns, cameras, near_m)
    return depth, [
        _semantic(returns, camera, near_m, semantic_view, depth_filter)
        for camera in cameras
        if camera.labels is not None
    ]


def _lidar_view(returns: NDArray[np.float64], near_m: float) -> DepthCandidates:
    directions, range_m = _unit(returns, np.zeros(3))
    far = range_m > near_m
    num_rays = int(np.count_nonzero(far))
    return DepthCandidates(
        origins=np.zeros((num_rays, 3), dtype=np.float32),
        directions=directions[far].astype(np.float32),
        depth_m=range_m[far].astype(np.float32),
        depth_factor=np.ones(num_rays, dtype=np.float32),
    )


def _image_view(returns: NDArray[np.float64], cameras: list[Camera], near_m: float) -> DepthCandidates:
    """A return that two cameras see gives two rays."""
    parts = [np.zeros((0, 8))]
    for camera in cameras:
        centre = camera.T_lidar_from_camera[:3, 3]
        uv, z_depth_m = camera.project(returns)
        directions, distance_m = _unit(returns, centre)
        depth_factor = directions @ camera.T_camera_from_lidar[2, :3]
        origins = np.broadcast_to(centre, directions.shape)
        seen = camera.in_image(uv, z_depth_m) & (distance_m > near_m)
        parts.append(np.column_stack([origins, directions, z_depth_m, depth_factor])[seen])
    rays = np.concatenate(parts).astype(np.float32)
    return DepthCandidates(rays[:, :3], rays[:, 3:6], rays[:, 6], rays[:, 7])


def _semantic(
    returns: NDArray[np.float64],
    camera: Camera,
    near_m: float,
    view: SemanticView,
    depth_filter: DepthTolerance | None,
) -> SemanticCandidates:
    assert camera.labels is not None
    origin = camera.T_lidar_from_camera[:3, 3] if view == "camera" else np.zeros(3)
    uv, z_depth_m = camera.project(returns)
    directions, distance_m = _unit(returns, origin)
    seen = np.flatnonzero(camera.in_image(uv, z_depth_m) & (distance_m > near_m))
    if depth_filter is not None:
        seen = seen[depths_agree(z_depth_m[seen], camera.depth_at(uv[seen]), depth_filter)]
    labels = camera.labels.lookup(uv[seen])
    labelled = labels.class_id >= 0
    num_rays = int(np.count_nonzero(labelled))
    return SemanticCandidates(
        origins=np.broadcast_to(origin.astype(np.float32), (num_rays, 3)),
        directions=directions[seen[labelled]].astype(np.float32),
        range_m=distance_m[seen[labelled]].astype(np.float32),
        target=labels.target[labelled],
        confidence=labels.confidence[labelled],
        class_id=labels.class_id[labelled],
    )


def depths_agree(
    z_depth_m: NDArray[np.float64], image_depth_m: NDArray[np.float64], tolerance: DepthTolerance
) -> NDArray[np.bool_]:
    """[N] mask of depths within (absolute, relative) of the image's; False where that is NaN."""
    absolute_m, relative = tolerance
    return np.abs(z_depth_m - image_depth_m) <= absolute_m + relative * image_depth_m


def _unit(points: NDArray[np.float64], origin: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit directions [N, 3] from an origin to points, and distances [N]."""
    offset = points - origin
    distance = np.linalg.norm(offset, axis=1)
    return offset / np.maximum(distance, 1e-9)[:, None], distance


def join_cameras(cameras: list[SemanticCandidates]) -> SemanticCandidates:
    """Candidates of all cameras in one; of no camera, none."""
    none = SemanticCandidates(
        origins=np.zeros((0, 3), dtype=np.float32),
        directions=np.zeros((0, 3), dtype=np.float32),
        range_m=np.zeros(0, dtype=np.float32),
        target=np.zeros((0, NUM_CLASSES), dtype=np.float32),
        confidence=np.zeros(0, dtype=np.float32),
        class_id=np.zeros(0, dtype=np.int64),
    )
    return SemanticCandidates._make(map(np.concatenate, zip(none, *cameras, strict=True)))


def draw_uniform(num_candidates: int, num_rays: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """[num_rays] candidate indices: without replacement if there are enough, else with.

    ``num_candidates`` must be positive.
    """
    return rng.choice(num_candidates, num_rays, replace=num_candidates < num_rays)


def draw_class_balanced(
    class_id: NDArray[np.int64],
    class_counts: NDArray[np.int64],
    num_rays: int,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """[num_rays] candidate indices, each candidate weighted by 1 / count of its class.

    PRED section 3.2, class-balanced sampling. Without replacement if there are enough candidates,
    else with. ``class_id`` [N] must not be empty; ``class_counts`` is [19].
    """
    weight = 1.0 / np.maximum(class_counts, 1)[class_id]
    if len(class_id) < num_rays:
        return rng.choice(len(class_id), num_rays, p=weight / weight.sum())
    # The smallest of exponential clocks with these rates are a weighted draw without replacement
    # (Efraimidis and Spirakis, 2006).
    clock = rng.exponential(size=len(class_id)) / weight
    return np.sort(np.argpartition(clock, num_rays - 1)[:num_rays])
