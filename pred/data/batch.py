# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Training batches as a function of the step: visible points, depth rays and semantic rays."""

# No `from __future__ import annotations`: jsonargparse reads the field types of DataConfig.

import ctypes
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from rich.progress import track
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from pred.data.frame import EGO_BOX, NUM_CLASSES, ONCE_EGO_BOX, EgoBox, Frame, FrameError, FrameSource
from pred.data.masking import MaskStrategy, bev_patches, farthest_point_groups, visible_parts, visible_points
from pred.data.rays import (
    NEAR_M,
    DepthCandidates,
    DepthTolerance,
    DepthView,
    FrameCandidates,
    SemanticCandidates,
    SemanticView,
    draw_class_balanced,
    draw_uniform,
    frame_candidates,
    join_cameras,
    point_use,
    ray_candidates,
)
from pred.random import numpy_generator

PointRange = tuple[float, float, float, float, float, float]
"""(x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame."""

CACHED_FRAMES = 32
"""Data sets of at most so many frames are kept in memory: 3 to 8 MB per frame and worker."""

WORKER_START = "fork" if sys.platform == "linux" else None
"""Forked workers share the tables of a data set."""

PR_SET_PDEATHSIG = 1
"""From linux/prctl.h: the signal that a process gets when its parent ends."""

UPWARDS = (0.0, 0.0, 1.0)

T = TypeVar("T")
TensorHolder = TypeVar("TensorHolder", bound="Rays | Batch")


@dataclass
class DataConfig:
    """What is read, what is hidden from the encoder, and how many rays are drawn."""

    dataset: Literal["nuscenes", "once", "folder"] = "nuscenes"
    """What is under `root`: the official nuScenes layout, that of ONCE, or a folder of own drives."""
    root: str | None = None
    """Folder of the data set."""
    version: str | None = None
    """Table folder under `root` (nuscenes only); None: the only folder named like v1.0-*."""
    split: str | None = None
    """Name in splits.json (nuscenes: the version's), an official nuScenes split, or a list in ImageSets/ (once); None:
    every sample."""
    info: str | None = None
    """Info file of OpenPCDet or mmdetection3d (nuscenes only): its samples, in its order, instead of a split."""
    sweeps: int = 10
    """LiDAR sweeps per frame, the keyframe's own included; fewer where a recording starts (nuscenes, folder)."""
    labels: str | None = "auto"
    """Folder under `root` with <CAMERA>/<image stem>.png|.npy|.npz (ONCE: <sequence>/<camera>/<frame id>.*); auto: the
    only folder under pseudo/; none (or no such folder): LiDAR-only."""
    image_depth: str | None = None
    """Folder under `root` with depth maps of the images, <CAMERA>/<image stem>.png (nuscenes) or <drive>/<camera>/
    <stem>.png (folder): 16-bit PNG, metres = value / 256, 0 = no depth. None or none: no depth."""
    undistort: bool = True
    """Undo the lens distortion of the calibration; False: the images have none any more (once only)."""
    batch_size: int = 4
    """Frames per batch and process."""
    mask_ratio: float = 0.95
    """Share of the points inside the range (patches, groups) that the encoder does not see, in [0, 1)."""
    mask_strategy: MaskStrategy = "point"
    """What is hidden: points, whole patches of a BEV grid, or groups of points around far-apart centres."""
    mask_patch_m: float = 0.8
    """Edge of a patch, metres; 0.8 is a cell of the default encoder's BEV map (patch only)."""
    mask_groups: int = 2048
    """Groups of a frame (group only)."""
    holdout_fraction: float = 0.1
    """Share of the keyframe returns that training never uses, neither as input nor as target."""
    ego_box: EgoBox | None = None
    """Returns of the own car: (x_min, y_min, x_max, y_max), metres, LiDAR frame. None: nuScenes's, (-1, -2, 1, 3), or
    the same in ONCE's axes, (-1, -3, 1, 2)."""
    semantic_rays_per_camera: int = 512
    """Semantic rays drawn for every camera image."""
    depth_rays: int = 3072
    """Depth rays drawn for every frame."""
    depth_view: DepthView = "lidar"
    """Depth rays start at the LiDAR (target: range) or at the cameras (target: z-depth)."""
    semantic_view: SemanticView = "camera"
    """Semantic rays start at the cameras, or (direct projection, an ablation) at the LiDAR: to a return, with the label
    of the pixel that it projects to."""
    depth_filter: DepthTolerance | None = None
    """[absolute m, relative]: only returns whose depth differs by at most absolute + relative x depth from that of
    `image_depth` have a label. None: no filter."""
    class_counts: Literal["batch", "dataset"] = "batch"
    """Where class frequencies for balanced sampling are counted; dataset reads every frame once."""
    on_error: Literal["raise", "skip"] = "raise"
    """Broken frame: stop with an error naming the file, or take the next frame and count it."""
    workers: int = 2
    """Loader processes; 0 loads in the training process."""

    def __post_init__(self) -> None:
        if self.root == "":
            raise ValueError("data.root must name a folder, got an empty string")
        if self.dataset != "nuscenes" and self.info is not None:
            raise ValueError(f"data.info must be left out for data.dataset {self.dataset}, got {self.info!r}")
        if self.dataset == "once" and self.image_depth not in (None, "none"):
            raise ValueError(f"data.image_depth must be none for data.dataset {self.dataset}, got {self.image_depth!r}")
        if not (math.isfinite(self.mask_patch_m) and self.mask_patch_m > 0):
            raise ValueError(f"data.mask_patch_m must be positive, got {self.mask_patch_m}")
        for name in ("sweeps", "batch_size", "semantic_rays_per_camera", "depth_rays", "mask_groups"):
            if getattr(self, name) < 1:
                raise ValueError(f"data.{name} must be at least 1, got {getattr(self, name)}")
        if self.workers < 0:
            raise ValueError(f"data.workers must be at least 0, got {self.workers}")
        if self.depth_filter is not None:
            if self.image_depth in (None, "none"):
                raise ValueError("data.depth_filter must be given with data.image_depth, got no image depth")
            if not all(math.isfinite(limit) and limit >= 0 for limit in self.depth_filter):
                raise ValueError(f"data.depth_filter must be (absolute m, relative), got {self.depth_filter}")
        for name in ("mask_ratio", "holdout_fraction"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"data.{name} must be in [0, 1), got {getattr(self, name)}")
        x_min, y_min, x_max, y_max = self.own_car
        if not (x_min <= x_max and y_min <= y_max and all(map(math.isfinite, self.own_car))):
            raise ValueError(f"data.ego_box must be finite (x_min, y_min, x_max, y_max), got {self.ego_box}")

    @property
    def own_car(self) -> EgoBox:
        """`ego_box`, or the default for the axes of `dataset`."""
        if self.ego_box is not None:
            return self.ego_box
        return ONCE_EGO_BOX if self.dataset == "once" else EGO_BOX

    @property
    def point_channels(self) -> tuple[str, ...]:
        """Channels of a point that the encoder gets, as the detectors of the data set: the age, in seconds behind the
        keyframe, is left out for ONCE, whose frames are single scans."""
        channels = ("x_m", "y_m", "z_m", "intensity", "age_s")
        return channels[:4] if self.dataset == "once" else channels


class _Parcel:
    """Tensors go between processes by value: a loader's many small ones take milliseconds as shared memory."""

    def __getstate__(self) -> dict[str, Any]:
        return {name: x.numpy() if isinstance(x, Tensor) else x for name, x in vars(self).items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, x in state.items():
            setattr(self, name, torch.from_numpy(x) if isinstance(x, np.ndarray) else x)


@dataclass
class Rays(_Parcel):
    """R rays for each of B frames, in the frames' LiDAR coordinates.

    Attributes:
        origins: [B, R, 3] float32, metres.
        directions: [B, R, 3] float32, unit length.
        valid: [B, R] bool; other rays hold finite placeholders and must not count in any loss.
        jitter: [B, R] float32 in [0, 1), shift of the stratified samples along the ray.
    """

    origins: Tensor
    directions: Tensor
    valid: Tensor
    jitter: Tensor


@dataclass
class DepthRays(Rays):
    """Rays towards LiDAR returns.

    Attributes:
        depth_m: [B, R] float32, the measured depth, to be compared with ``t * depth_factor``.
        depth_factor: [B, R] float32; 1 in the LiDAR view (depth is range), the direction's
            component along the optical axis in the image view (depth is z-depth).
    """

    depth_m: Tensor
    depth_factor: Tensor


@dataclass
class SemanticRays(Rays):
    """Rays from cameras through projected LiDAR returns.

    Attributes:
        range_m: [B, R] float32, distance from the origin to the return.
        target: [B, R, 19] float32 class probabilities of the pseudo label at the pixel.
        confidence: [B, R] float32, the largest of them; 1 for hard labels.
    """

    range_m: Tensor
    target: Tensor
    confidence: Tensor


@dataclass
class Batch(_Parcel):
    """One training step's data.

    Attributes:
        step: training step.
        tokens: B frame tokens.
        points: [N, 5] float32 visible points of all frames: x, y, z, intensity, dt. The encoder takes the channels that
            `DataConfig.point_channels` names.
        point_offsets: [B + 1] int64, frame b owns points[point_offsets[b]:point_offsets[b + 1]].
        depth: depth rays.
        semantic: semantic rays; None without pseudo labels.
        skipped: (token, error text) each time that a broken frame was replaced in this batch.
    """

    step: int
    tokens: list[str]
    points: Tensor
    point_offsets: Tensor
    depth: DepthRays
    semantic: SemanticRays | None
    skipped: list[tuple[str, str]]

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Batch":
        """The batch on another device."""
        return _map_tensors(self, lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> "Batch":
        """The batch in page-locked memory (called by a DataLoader with ``pin_memory=True``)."""
        return _map_tensors(self, lambda tensor: tensor.pin_memory())


class TrainingBatches(Dataset[Batch]):
    """Batch of every training step, as a function of the step alone.

    Frames are visited in a new random order each epoch. Worker count, start step and earlier calls
    change nothing: all randomness comes from `pred.random` with the key (slot, token, purpose),
    where a slot is one frame's place in the whole run, ``step * batch_size * world_size + ...``.

    Args:
        config: what to read and to draw.
        point_range: (x_min, y_min, z_min, x_max, y_max, z_max), metres, LiDAR frame.
        seed: seed of order, masks and rays.
        total_steps: number of steps of the run.
        rank, world_size: this process among those that train together; they share out the slots.
        source: frames; None builds what ``config`` names.
        near_m: rays are rendered from this distance on, metres; nearer returns are no targets.
    """

    def __init__(
        self,
        config: DataConfig,
        point_range: PointRange,
        seed: int,
        total_steps: int,
        rank: int = 0,
        world_size: int = 1,
        source: FrameSource | None = None,
        near_m: float = NEAR_M,
    ) -> None:
        self.config = config
        self.point_range = point_range
        self.seed = seed
        self.total_steps = total_steps
        self.rank = rank
        self.world_size = world_size
        self.near_m = near_m
        self.source = build_source(config) if source is None else source
        if self.num_frames == 0:
            raise ValueError("source must hold at least one frame, got none")
        self._cache: dict[int, FrameCandidates] = {}
        self._class_counts: NDArray[np.int64] | None = None
        if config.class_counts == "dataset":
            self._class_counts = count_classes(self.source, config, point_range, near_m, rank == 0)

    @property
    def num_frames(self) -> int:
        """Frames in the data set."""
        return len(self.source)

    def __len__(self) -> int:
        return self.total_steps

    def __getitem__(self, step: int) -> Batch:
        if not 0 <= step < self.total_steps:
            raise IndexError(f"step must be in [0, {self.total_steps}), got {step}")
        first = (step * self.world_size + self.rank) * self.config.batch_size
        slots = range(first, first + self.config.batch_size)
        skipped: list[tuple[str, str]] = []
        frames = [self._good_frame(slot, skipped) for slot in slots]
        class_counts = self._class_counts
        if class_counts is None:
            class_counts = np.sum([frame.class_counts() for frame in frames], axis=0)
        draws = [
            _draw(frame, class_counts, self.config, self.point_range, self.seed, slot)
            for frame, slot in zip(frames, slots, strict=True)
        ]
        num_cameras = max(len(frame.semantic) for frame in frames)
        return _collate(
            step,
            draws,
            num_depth_rays=self.config.depth_rays,
            num_semantic_rays=self.config.semantic_rays_per_camera * num_cameras,
            skipped=skipped,
        )

    def _good_frame(self, slot: int, skipped: list[tuple[str, str]]) -> FrameCandidates:
        """The frame of a slot, or the next one of the epoch that can be read (``on_error``)."""
        epoch, position = divmod(slot, self.num_frames)
        order = numpy_generator(self.seed, epoch, "frame order").permutation(self.num_frames)
        for ahead in range(self.num_frames):
            index = int(order[(position + ahead) % self.num_frames])
            try:
                return self._candidates(index)
            except FrameError as error:
                if self.config.on_error == "raise":
                    raise
                skipped.append((self.source.token(index), str(error)))
                last_error = error
        raise FrameError(
            last_error.path,
            f"{last_error.what}; no frame is left: all {self.num_frames} are broken",
        )

    def _candidates(self, index: int) -> FrameCandidates:
        if index in self._cache:
            return self._cache[index]
        candidates = _candidates(self.source.load(index), self.config, self.point_range, self.near_m)
        if self.num_frames <= CACHED_FRAMES:
            self._cache[index] = candidates
        return candidates


class _Loader(DataLoader[T]):
    """Items of a data set in order. A `FrameError` of a loader process is raised as it is, without that process's
    traceback, and loader processes end with this one, even if it is killed."""

    def __init__(self, dataset: Dataset[T], order: Sequence[int], workers: int) -> None:
        super().__init__(
            _ErrorsAsItems(dataset),
            batch_size=None,
            sampler=order,
            num_workers=workers,
            multiprocessing_context=WORKER_START if workers else None,
            collate_fn=_unchanged,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_end_with_parent,
        )

    def __iter__(self) -> Iterator[T]:  # type: ignore[override]
        items = super().__iter__()
        workers = getattr(items, "_workers", [])
        # When this process ends, multiprocessing sends its children SIGTERM, which these ignore, and waits for them.
        at_exit = Finalize(None, _kill, args=(workers,), exitpriority=0)
        try:
            for item in items:
                if isinstance(item, FrameError):
                    raise item
                yield item
        finally:
            del items  # an error's traceback would keep it, and its processes with it
            at_exit.cancel()


class _ErrorsAsItems(Dataset[Any]):
    def __init__(self, dataset: Dataset[Any]) -> None:
        self._dataset = dataset

    def __getitem__(self, index: int) -> Any:
        try:
            return self._dataset[index]
        except FrameError as error:
            return error


def _kill(workers: Sequence[BaseProcess]) -> None:
    for worker in workers:
        worker.kill()


def _end_with_parent(worker: int) -> None:
    if sys.platform == "linux":  # elsewhere a worker may outlive a killed parent, waiting to hand over a batch
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # A job scheduler's goes to all processes of a run, which is to finish its step and write a checkpoint.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def make_loader(dataset: TrainingBatches, start_step: int = 0, workers: int = 0) -> DataLoader[Batch]:
    """Batches of ``start_step`` and later in order; ``workers`` processes, 0 loads in this one."""
    return _Loader(dataset, range(start_step, len(dataset)), workers)


def build_source(config: DataConfig, point_classes: bool = False) -> FrameSource:
    """The frames that ``config`` names, for evaluation with the exact classes of points where the data set has any.

    Raises:
        FrameError, ValueError: they cannot be found.
    """
    if config.root is None:
        raise ValueError("data.root must name the folder of the data set, got None")
    # Each import brings what the others do not need.
    if config.dataset == "once":
        from pred.data.once import OnceFrames

        return OnceFrames(
            config.root,
            split=config.split,
            labels=config.labels,
            ego_box=config.own_car,
            undistort=config.undistort,
        )
    if config.dataset == "folder":
        from pred.data.folder import FolderFrames

        return FolderFrames(
            config.root,
            split=config.split,
            sweeps=config.sweeps,
            labels=config.labels,
            ego_box=config.own_car,
            image_depth=config.image_depth,
        )
    from pred.data.nuscenes import NuScenesFrames

    return NuScenesFrames(
        config.root,
        version=config.version,
        split=config.split,
        sweeps=config.sweeps,
        labels=config.labels,
        ego_box=config.own_car,
        info=config.info,
        image_depth=config.image_depth,
        point_classes=point_classes,
    )


def count_classes(
    source: FrameSource,
    config: DataConfig,
    point_range: PointRange,
    near_m: float = NEAR_M,
    show_progress: bool = True,
) -> NDArray[np.int64]:
    """[19] semantic candidates of each class in the whole data set; reads every frame once.

    Raises:
        FrameError: a frame is broken and ``config.on_error`` is "raise".
    """
    loader = _Loader(_ClassCounts(source, config, point_range, near_m), range(len(source)), config.workers)
    counts = np.zeros(NUM_CLASSES, dtype=np.int64)
    for frame_counts in track(loader, "counting classes", len(source), disable=not show_progress):
        counts += frame_counts
    return counts


class EvaluationRows(NamedTuple):
    """What the evaluation of one frame sees and aims at.

    Attributes:
        visible: [N] int64 rows of ``Frame.points`` that the encoder sees.
        returns: [R] int64 rows that rays aim at; none of them is visible.
    """

    visible: NDArray[np.int64]
    returns: NDArray[np.int64]


def evaluation_rows(
    frame: Frame,
    config: DataConfig,
    point_range: PointRange,
    seed: int,
    near_m: float = NEAR_M,
    all_returns: bool = False,
) -> EvaluationRows:
    """A fixed mask of ``seed`` and the frame, of the run's own strategy and ratio: what the encoder was trained to see;
    and the held-out returns farther than ``near_m``.

    Args:
        all_returns: aim at every return of the keyframe that is not visible. On frames of the training that is no test.
    """
    use = point_use(frame, point_range, config.own_car, config.holdout_fraction)
    candidates = np.flatnonzero(use.input)
    rng = numpy_generator(seed, frame.token, "evaluation mask")
    visible = candidates[_visible(frame.points[candidates], config, point_range, rng)]
    aimed_at = use.held_out
    if all_returns:
        aimed_at = use.held_out | use.targets
        aimed_at[visible] = False
    returns = np.flatnonzero(aimed_at)
    far = np.linalg.norm(frame.points[returns, :3].astype(np.float64), axis=1) > near_m
    return EvaluationRows(visible, returns[far])


def evaluation_batch(
    frame: Frame,
    config: DataConfig,
    point_range: PointRange,
    seed: int,
    near_m: float = NEAR_M,
    rows: EvaluationRows | None = None,
) -> Batch:
    """Batch of one frame with what `evaluation_rows` gives, or the given rows: visible points, and a depth ray to each
    return, in order.

    Whatever views and filter the run trains with, depth rays are those of the LiDAR view and semantic rays those of the
    cameras; a return that two cameras see gives two. Jitter is 0.5 (no randomness).

    Raises:
        FrameError: a pseudo label cannot be used.
    """
    if rows is None:
        rows = evaluation_rows(frame, config, point_range, seed, near_m)
    depth, cameras = ray_candidates(frame.points[rows.returns, :3].astype(np.float64), frame.cameras, near_m)
    semantic = join_cameras(cameras)
    draw = _Draw(
        token=frame.token,
        points=frame.points[rows.visible],
        depth=depth,
        depth_jitter=np.full(len(depth.depth_m), 0.5, dtype=np.float32),
        semantic=semantic,
        semantic_jitter=np.full(len(semantic.class_id), 0.5, dtype=np.float32),
    )
    has_labels = len(cameras) > 0
    # At least one ray, so that a frame without held-out returns needs no special case later.
    return _collate(
        step=0,
        draws=[draw],
        num_depth_rays=max(1, len(draw.depth_jitter)),
        num_semantic_rays=max(1, len(draw.semantic_jitter)) if has_labels else 0,
        skipped=[],
    )


class _ClassCounts(Dataset[NDArray[np.int64]]):
    """Class counts of every frame; zeros for a broken frame that is to be skipped."""

    def __init__(self, source: FrameSource, config: DataConfig, point_range: PointRange, near_m: float) -> None:
        self.source = source
        self.config = config
        self.point_range = point_range
        self.near_m = near_m

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> NDArray[np.int64]:
        try:
            frame = self.source.load(index)
            return _candidates(frame, self.config, self.point_range, self.near_m).class_counts()
        except FrameError:
            if self.config.on_error == "raise":
                raise
            return np.zeros(NUM_CLASSES, dtype=np.int64)


class _Draw(NamedTuple):
    """What was drawn of one frame."""

    token: str
    points: NDArray[np.float32]  # [N, 5]
    depth: DepthCandidates
    depth_jitter: NDArray[np.float32]
    semantic: SemanticCandidates
    semantic_jitter: NDArray[np.float32]


def _candidates(frame: Frame, config: DataConfig, point_range: PointRange, near_m: float) -> FrameCandidates:
    return frame_candidates(
        frame,
        point_range,
        config.own_car,
        config.holdout_fraction,
        depth_view=config.depth_view,
        near_m=near_m,
        semantic_view=config.semantic_view,
        depth_filter=config.depth_filter,
    )


def _visible(
    points: NDArray[np.float32], config: DataConfig, point_range: PointRange, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Ascending indices of the points that the encoder sees."""
    if config.mask_strategy == "point":
        return visible_points(len(points), config.mask_ratio, rng)
    if config.mask_strategy == "patch":
        parts = bev_patches(points, point_range, config.mask_patch_m)
    else:
        parts = farthest_point_groups(points, config.mask_groups, rng)
    return visible_parts(parts, config.mask_ratio, rng)


def _draw(
    frame: FrameCandidates,
    class_counts: NDArray[np.int64],
    config: DataConfig,
    point_range: PointRange,
    seed: int,
    slot: int,
) -> _Draw:
    def rng(purpose: str) -> np.random.Generator:
        return numpy_generator(seed, slot, frame.token, purpose)

    visible = _visible(frame.points, config, point_range, rng("mask"))
    depth = frame.depth
    if len(depth.depth_m):
        chosen = draw_uniform(len(depth.depth_m), config.depth_rays, rng("depth rays"))
        depth = DepthCandidates._make(column[chosen] for column in depth)
    semantic_rng = rng("semantic rays")
    cameras = []
    for camera in frame.semantic:
        if len(camera.class_id):
            chosen = draw_class_balanced(camera.class_id, class_counts, config.semantic_rays_per_camera, semantic_rng)
            cameras.append(SemanticCandidates._make(column[chosen] for column in camera))
    semantic = join_cameras(cameras)
    return _Draw(
        token=frame.token,
        points=frame.points[visible],
        depth=depth,
        depth_jitter=rng("depth jitter").random(len(depth.depth_m), dtype=np.float32),
        semantic=semantic,
        semantic_jitter=rng("semantic jitter").random(len(semantic.class_id), dtype=np.float32),
    )


def _collate(
    step: int,
    draws: list[_Draw],
    num_depth_rays: int,
    num_semantic_rays: int,
    skipped: list[tuple[str, str]],
) -> Batch:
    """Stack frames; missing rays become placeholders: straight up, depth 1, not valid."""
    depth = [draw.depth for draw in draws]
    semantic = [draw.semantic for draw in draws]
    counts = [len(draw.points) for draw in draws]
    return Batch(
        step=step,
        tokens=[draw.token for draw in draws],
        points=torch.from_numpy(np.concatenate([draw.points for draw in draws])),
        point_offsets=torch.from_numpy(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)),
        depth=DepthRays(
            origins=_stack([rays.origins for rays in depth], num_depth_rays, 0.0),
            directions=_stack([rays.directions for rays in depth], num_depth_rays, UPWARDS),
            valid=_stack([np.ones(len(rays.depth_m), bool) for rays in depth], num_depth_rays, 0),
            jitter=_stack([draw.depth_jitter for draw in draws], num_depth_rays, 0.0),
            depth_m=_stack([rays.depth_m for rays in depth], num_depth_rays, 1.0),
            depth_factor=_stack([rays.depth_factor for rays in depth], num_depth_rays, 1.0),
        ),
        semantic=None
        if num_semantic_rays == 0
        else SemanticRays(
            origins=_stack([rays.origins for rays in semantic], num_semantic_rays, 0.0),
            directions=_stack([rays.directions for rays in semantic], num_semantic_rays, UPWARDS),
            valid=_stack([np.ones(len(rays.class_id), bool) for rays in semantic], num_semantic_rays, 0),
            jitter=_stack([draw.semantic_jitter for draw in draws], num_semantic_rays, 0.0),
            range_m=_stack([rays.range_m for rays in semantic], num_semantic_rays, 1.0),
            target=_stack([rays.target for rays in semantic], num_semantic_rays, 0.0),
            confidence=_stack([rays.confidence for rays in semantic], num_semantic_rays, 0.0),
        ),
        skipped=skipped,
    )


def _stack(rows: list[NDArray[Any]], num_rays: int, placeholder: ArrayLike) -> Tensor:
    """[B, num_rays, ...] from B arrays of at most num_rays rows."""
    stacked = np.empty((len(rows), num_rays, *rows[0].shape[1:]), dtype=rows[0].dtype)
    stacked[...] = placeholder
    for frame, values in enumerate(rows):
        stacked[frame, : len(values)] = values
    return torch.from_numpy(stacked)


def _unchanged(batch: T) -> T:
    return batch


def _map_tensors(holder: TensorHolder, change: Callable[[Tensor], Tensor]) -> TensorHolder:
    changed: dict[str, Any] = {}
    for item in fields(holder):
        value = getattr(holder, item.name)
        if isinstance(value, Tensor):
            changed[item.name] = change(value)
        elif isinstance(value, Rays):
            changed[item.name] = _map_tensors(value, change)
    return replace(holder, **changed)
