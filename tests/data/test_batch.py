# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Training batches: contents, repeatability across workers and restarts, broken and empty frames."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

from pred.data import batch as batch_module
from pred.data.batch import (
    Batch,
    DataConfig,
    DepthRays,
    Rays,
    SemanticRays,
    TrainingBatches,
    build_source,
    count_classes,
    evaluation_batch,
    make_loader,
)
from pred.data.frame import (
    Camera,
    Frame,
    FrameError,
    inside_range,
    invert_rigid,
    outside_ego_box,
    transform_points,
)
from pred.data.labels import PseudoLabel
from pred.data.masking import is_held_out
from pred.data.nuscenes import NuScenesFrames
from pred.data.rays import NEAR_M, frame_candidates
from pred.models.renderer import RendererConfig
from tests.data.tiny_tree import NUM_LANDMARKS, Tree, write_tree
from tests.tiny_run import tiny_world

POINT_RANGE = (-25.0, -25.0, -5.0, 25.0, 25.0, 3.0)


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return write_tree(tmp_path)


def tree_config(tree: Tree, **changes: Any) -> DataConfig:
    settings = {"batch_size": 2, "mask_ratio": 0.8, "semantic_rays_per_camera": 20, "depth_rays": 50, "workers": 0}
    return DataConfig(root=str(tree.root), **{**settings, **changes})


def tensors(holder: Batch | Rays) -> dict[str, torch.Tensor]:
    found = {}
    for item in dataclasses.fields(holder):
        value = getattr(holder, item.name)
        if isinstance(value, torch.Tensor):
            found[item.name] = value
        elif isinstance(value, Rays):
            found.update({f"{item.name}.{name}": tensor for name, tensor in tensors(value).items()})
    return found


def assert_equal(one: Batch, other: Batch) -> None:
    assert (one.step, one.tokens, one.skipped) == (other.step, other.tokens, other.skipped)
    assert tensors(one).keys() == tensors(other).keys()
    for name, tensor in tensors(one).items():
        assert torch.equal(tensor, tensors(other)[name]), name


def assert_finite_and_unit(rays: Rays) -> None:
    for name, tensor in tensors(rays).items():
        assert torch.isfinite(tensor).all(), name
        assert tensor.dtype == (torch.bool if name == "valid" else torch.float32), name
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(rays.valid.shape))
    assert ((rays.jitter >= 0) & (rays.jitter < 1)).all()


class MemoryFrames:
    """Frames made on the fly."""

    def __init__(self, make: list[Callable[[], Frame]]) -> None:
        self.make = make

    def __len__(self) -> int:
        return len(self.make)

    def token(self, index: int) -> str:
        return f"token-{index}"

    def load(self, index: int) -> Frame:
        return self.make[index]()


def memory_frame(
    token: str = "token-0",
    xyz: np.ndarray | None = None,
    classes: np.ndarray | None = None,
    num_cameras: int = 2,
) -> Frame:
    xyz = np.random.default_rng(0).uniform(-20, 20, (600, 3)) * [1, 1, 0.1] if xyz is None else xyz
    points = np.zeros((len(xyz), 5), dtype=np.float32)
    points[:, :3] = xyz
    # One camera looks along +y, the other along -y.
    ahead = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    behind = ahead * [[-1.0], [1.0], [-1.0], [1.0]]
    intrinsics = np.array([[50.0, 0, 50.0], [0, 50.0, 25.0], [0, 0, 1.0]])
    cameras = [
        Camera(
            f"CAM-{number}",
            intrinsics,
            T_camera_from_lidar,
            100,
            50,
            labels=None if classes is None else PseudoLabel(classes, 100, 50),
        )
        for number, T_camera_from_lidar in enumerate([ahead, behind][:num_cameras])
    ]
    return Frame(token, points, np.arange(len(points)), np.ones(len(points), dtype=np.bool_), cameras)


SMALL = DataConfig(batch_size=1, mask_ratio=0.5, semantic_rays_per_camera=8, depth_rays=16, workers=0)


def small_batches(source: MemoryFrames, steps: int = 3, **changes: Any) -> TrainingBatches:
    return TrainingBatches(dataclasses.replace(SMALL, **changes), POINT_RANGE, 0, steps, source=source)


# Contents


def test_shapes(tree: Tree) -> None:
    batch = TrainingBatches(tree_config(tree), POINT_RANGE, seed=0, total_steps=3)[1]
    assert batch.step == 1 and sorted(batch.tokens) == sorted(tree.tokens) and batch.skipped == []
    assert batch.points.shape[1] == 5 and batch.points.dtype == torch.float32
    assert batch.point_offsets.dtype == torch.int64
    assert batch.point_offsets.shape == (3,)
    assert batch.point_offsets[0] == 0 and batch.point_offsets[2] == len(batch.points)
    assert isinstance(batch.depth, DepthRays) and isinstance(batch.semantic, SemanticRays)
    assert batch.depth.origins.shape == batch.depth.directions.shape == (2, 50, 3)
    assert batch.depth.valid.shape == batch.depth.depth_m.shape == batch.depth.depth_factor.shape == (2, 50)
    assert batch.semantic.origins.shape == (2, 40, 3)
    assert batch.semantic.target.shape == (2, 40, 19)
    assert batch.depth.valid.all() and batch.semantic.valid.all()
    assert_finite_and_unit(batch.depth)
    assert_finite_and_unit(batch.semantic)


def test_visible_points_are_a_share_of_the_candidates(tree: Tree) -> None:
    batches = TrainingBatches(tree_config(tree), POINT_RANGE, seed=0, total_steps=1)
    batch = batches[0]
    for b, token in enumerate(batch.tokens):
        frame = batches.source.load(tree.tokens.index(token))
        inside = (np.abs(frame.points[:, :2]) < 25).all(axis=1) & (frame.points[:, 2] < 3) & (frame.points[:, 2] > -5)
        held = is_held_out(frame.point_index, token, 0.1) & frame.is_keyframe
        for earlier, rows in frame.earlier_keyframes.items():
            held[rows] = is_held_out(frame.point_index[rows], earlier, 0.1)
        candidates = {point.tobytes() for point in frame.points[inside & ~held]}
        visible = batch.points[batch.point_offsets[b] : batch.point_offsets[b + 1]].numpy()
        assert len(visible) == round(0.2 * len(candidates))
        assert {point.tobytes() for point in visible} <= candidates
        assert len(np.unique(visible[:, 4])) == (2 if token == tree.tokens[0] else 4)


def test_whole_patches_and_groups_are_hidden(tree: Tree) -> None:
    by_strategy = {}
    for strategy in ("point", "patch", "group"):
        config = tree_config(tree, mask_strategy=strategy, mask_patch_m=5.0, mask_groups=40, batch_size=1)
        batches = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=2)
        by_strategy[strategy] = [batches[step] for step in range(2)]
    for step, batch in enumerate(by_strategy["patch"]):
        candidates = batches._candidates(tree.tokens.index(batch.tokens[0])).points
        patches = np.floor((candidates[:, :2] + 25.0) / 5.0) @ [1, 100]
        shown = {point.tobytes() for point in batch.points.numpy()}
        visible = np.array([point.tobytes() in shown for point in candidates])
        assert len(np.unique(patches[visible])) == round(0.2 * len(np.unique(patches)))
        assert not np.isin(patches[~visible], patches[visible]).any() and 0 < visible.sum() < len(visible)
        others = [by_strategy[strategy][step] for strategy in ("point", "group")]
        assert len({other.points.numpy().tobytes() for other in (batch, *others)}) == 3
        # The strategy changes nothing but the input.
        for other in others:
            assert torch.equal(other.depth.directions, batch.depth.directions)
            assert torch.equal(other.depth.jitter, batch.depth.jitter)


def test_held_out_returns_are_no_input_of_the_next_keyframe(tree: Tree) -> None:
    frames = NuScenesFrames(tree.root)
    first, second = frames.load(0), frames.load(1)
    held = first.is_keyframe & is_held_out(first.point_index, first.token, 0.1)
    seen_again = transform_points(
        invert_rigid(second.T_world_from_lidar) @ first.T_world_from_lidar, first.points[:, :3]
    )
    age_s = np.full(len(first.points), 0.1)  # two sweeps later
    candidates = frame_candidates(second, POINT_RANGE, (0, 0, 0, 0), 0.1).points
    found = candidates[:, [0, 1, 2, 4]]

    def distance_to_input(chosen: np.ndarray) -> np.ndarray:
        wanted = np.column_stack([seen_again, age_s])[chosen & inside_range(seen_again, POINT_RANGE)]
        assert len(wanted) > 10
        distance: np.ndarray = np.abs(wanted[:, None] - found[None]).max(axis=2).min(axis=1)
        return distance

    assert distance_to_input(held).min() > 1e-2
    # The keyframe's other returns are there.
    assert distance_to_input(first.is_keyframe & ~held).max() < 1e-4


def test_near_returns_are_no_targets(tree: Tree) -> None:
    config = tree_config(tree, class_counts="dataset")
    near_m = 15.0
    batches = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=1, near_m=near_m)
    evaluation = evaluation_batch(batches.source.load(1), config, POINT_RANGE, seed=0, near_m=near_m)
    for batch in (batches[0], evaluation):
        assert batch.depth.valid.all() and batch.depth.depth_m.min() > near_m
    assert batches._class_counts is not None
    everything = count_classes(batches.source, config, POINT_RANGE, show_progress=False)
    assert 0 < batches._class_counts.sum() < everything.sum()
    assert NEAR_M == RendererConfig().near_m


def test_rays_of_a_step_aim_at_returns_that_are_not_held_out(tree: Tree) -> None:
    batches = TrainingBatches(tree_config(tree, batch_size=1), POINT_RANGE, seed=0, total_steps=2)
    for step in range(2):
        batch = batches[step]
        frame = batches.source.load(tree.tokens.index(batch.tokens[0]))
        held = is_held_out(frame.point_index, frame.token, 0.1) & frame.is_keyframe
        aimed_at = batch.depth.depth_m[0, :, None] * batch.depth.directions[0]
        distance = np.linalg.norm(aimed_at.numpy()[:, None] - frame.points[None, :, :3], axis=2)
        distance[:, ~frame.is_keyframe] = np.inf
        assert distance.min(axis=1).max() < 1e-4
        assert not held[distance.argmin(axis=1)].any()


def test_image_view(tree: Tree) -> None:
    batch = TrainingBatches(tree_config(tree, depth_view="image"), POINT_RANGE, seed=0, total_steps=1)[0]
    assert batch.depth.valid.all()
    assert (batch.depth.depth_factor < 1).any() and (batch.depth.depth_factor > 0.5).all()
    assert len(np.unique(batch.depth.origins[0].numpy(), axis=0)) == 2
    assert_finite_and_unit(batch.depth)


def test_lidar_only(tree: Tree) -> None:
    batch = TrainingBatches(tree_config(tree, labels="none"), POINT_RANGE, seed=0, total_steps=1)[0]
    assert batch.semantic is None
    assert batch.depth.valid.all()


def test_soft_labels_keep_their_probabilities(tree: Tree) -> None:
    batch = TrainingBatches(tree_config(tree), POINT_RANGE, seed=0, total_steps=1)[0]
    assert batch.semantic is not None
    # CAM_BACK comes first and has probabilities, CAM_FRONT hard labels.
    soft, hard = batch.semantic.target[:, :20], batch.semantic.target[:, 20:]
    assert (batch.semantic.confidence[:, 20:] == 1).all() and ((hard == 0) | (hard == 1)).all()
    assert (batch.semantic.confidence[:, :20] < 1).any()
    torch.testing.assert_close(soft.amax(-1), batch.semantic.confidence[:, :20])
    torch.testing.assert_close(soft.sum(-1), torch.ones(2, 20), atol=1e-2, rtol=0)


def test_classes_are_balanced_over_the_batch() -> None:
    # The frame's labels: column-wise, 90 % class 0 and 10 % class 13.
    classes = np.zeros((25, 50), dtype=np.uint8)
    classes[:, 23:28] = 13
    source = MemoryFrames([lambda: memory_frame(classes=classes)])
    batches = small_batches(source, semantic_rays_per_camera=2000)
    semantic = batches[0].semantic
    assert semantic is not None
    share = semantic.target[..., 13].mean(dim=1)
    assert abs(share.item() - 0.5) < 0.1
    assert batches._candidates(0).class_counts()[13] < 0.3 * batches._candidates(0).class_counts()[0]


class WorldLabels:
    """Frames of the tiny world, with labels made of its exact ones."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.frames = NuScenesFrames(tiny_world(), sweeps=1)

    def __len__(self) -> int:
        return len(self.frames)

    def token(self, index: int) -> str:
        return self.frames.token(index)

    def load(self, index: int) -> Frame:
        frame = self.frames.load(index)
        for camera in frame.cameras:
            assert camera.labels is not None
            classes = camera.labels.class_map()
            if self.kind == "some":
                classes[::2] = 255
            label_map = probabilities(classes) if self.kind == "soft" else classes
            camera.labels = PseudoLabel(label_map, camera.width, camera.height)
        return frame


def probabilities(classes: np.ndarray) -> np.ndarray:
    """[19, h, w]: 0.6 for the class, 0.4 for the next; 0 where there is none."""
    found = np.zeros((19, *classes.shape), dtype=np.float32)
    for offset, probability in ((0, 0.6), (1, 0.4)):
        np.put_along_axis(found, (classes[None].astype(int) + offset) % 19, probability, axis=0)
    return np.where(classes == 255, 0, found)


@pytest.mark.parametrize("class_counts", ["batch", "dataset"])
@pytest.mark.parametrize("kind", ["hard", "soft", "some"])
def test_drawn_classes_follow_the_inverse_frequency(kind: str, class_counts: Literal["batch", "dataset"]) -> None:
    source = WorldLabels(kind)
    config = DataConfig(batch_size=1, workers=0, semantic_rays_per_camera=1, depth_rays=1, class_counts=class_counts)
    batches = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=1000, source=source)
    frames = [batches._candidates(index) for index in range(2)]
    per_frame = [frame.class_counts() for frame in frames]
    drawn, expected = np.zeros(19), np.zeros(19)
    # With one ray per camera, nothing runs out: the shares are the weights.
    for step in range(1000):
        batch = batches[step]
        index = [source.token(0), source.token(1)].index(batch.tokens[0])
        assert batch.semantic is not None
        drawn += np.bincount(batch.semantic.target[batch.semantic.valid].argmax(-1), minlength=19)
        # The paper's rule: the probability of a pixel is inverse to the number of points of its class.
        counts = per_frame[index] if class_counts == "batch" else per_frame[0] + per_frame[1]
        for camera in frames[index].semantic:
            weight = np.bincount(camera.class_id, minlength=19) / np.maximum(counts, 1)
            expected += weight / weight.sum()
    assert drawn.sum() == pytest.approx(expected.sum())
    assert np.abs(drawn - expected).max() < 5 * np.sqrt(expected.max())
    # Without balance the commonest class would have several times as many rays.
    common = (per_frame[0] + per_frame[1]).argmax()
    assert drawn[common] / drawn.sum() < 0.5 * (per_frame[0] + per_frame[1])[common] / sum(map(sum, per_frame))


def test_dataset_class_counts(tree: Tree) -> None:
    config = tree_config(tree, class_counts="dataset")
    batches = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=1)
    expected = sum(batches._candidates(index).class_counts() for index in range(2))
    counts = count_classes(batches.source, config, POINT_RANGE, show_progress=False)
    assert np.array_equal(counts, expected) and counts.sum() > 100
    assert np.array_equal(batches._class_counts, counts)  # type: ignore[arg-type]
    assert batches[0].step == 0


def test_to_moves_every_tensor(tree: Tree) -> None:
    batch = TrainingBatches(tree_config(tree), POINT_RANGE, seed=0, total_steps=1)[0].to("meta")
    assert all(tensor.is_meta for tensor in tensors(batch).values())
    assert len(tensors(batch)) == 2 + 6 + 7


# Repeatability


@pytest.mark.parametrize("strategy", ["point", "patch", "group"])
def test_workers_and_restarts_give_the_same_bits(tree: Tree, strategy: str) -> None:
    config = tree_config(tree, mask_strategy=strategy, mask_groups=40)
    expected = [TrainingBatches(config, POINT_RANGE, 7, 6)[step] for step in range(6)]
    for workers in (0, 1, 2):
        loader = make_loader(TrainingBatches(config, POINT_RANGE, 7, 6), workers=workers)
        found = list(loader)
        assert len(found) == len(loader) == 6
        assert not any(batch.points.is_shared() for batch in found)  # sent by value
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other)
    resumed = list(make_loader(TrainingBatches(config, POINT_RANGE, 7, 6), start_step=4, workers=1))
    assert [batch.step for batch in resumed] == [4, 5]
    for one, other in zip(resumed, expected[4:], strict=True):
        assert_equal(one, other)


def test_cache_changes_nothing(tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    cached = TrainingBatches(tree_config(tree), POINT_RANGE, 7, 3)
    expected = [cached[step] for step in range(3)]
    assert len(cached._cache) == 2
    monkeypatch.setattr(batch_module, "CACHED_FRAMES", 0)
    uncached = TrainingBatches(tree_config(tree), POINT_RANGE, 7, 3)
    for step in range(3):
        assert_equal(uncached[step], expected[step])
    assert not uncached._cache


def test_steps_and_seeds_differ(tree: Tree) -> None:
    batches = TrainingBatches(tree_config(tree, batch_size=1, labels="none"), POINT_RANGE, 7, 9)
    drawn = {batches[step].points.numpy().tobytes() for step in range(9)}
    other_seed = TrainingBatches(tree_config(tree, batch_size=1, labels="none"), POINT_RANGE, 8, 9)
    drawn |= {other_seed[step].points.numpy().tobytes() for step in range(9)}
    assert len(drawn) == 18


def test_a_frame_twice_in_a_batch_is_masked_differently() -> None:
    source = MemoryFrames([memory_frame])
    batch = small_batches(source, batch_size=2)[0]
    one, other = batch.points.split(batch.point_offsets.diff().tolist())
    assert not torch.equal(one, other)
    assert not torch.equal(batch.depth.directions[0], batch.depth.directions[1])


def test_each_epoch_visits_every_frame_once_in_another_order() -> None:
    source = MemoryFrames([lambda index=index: memory_frame(f"token-{index}") for index in range(6)])  # type: ignore[misc]
    batches = small_batches(source, steps=20, batch_size=3)
    tokens = [token for step in range(20) for token in batches[step].tokens]
    epochs = [tokens[start : start + 6] for start in range(0, 60, 6)]
    assert all(sorted(epoch) == sorted(source.token(index) for index in range(6)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 5


def test_processes_share_out_the_slots() -> None:
    source = MemoryFrames([lambda index=index: memory_frame(f"token-{index}") for index in range(8)])  # type: ignore[misc]
    config = dataclasses.replace(SMALL, batch_size=2)
    alone = TrainingBatches(dataclasses.replace(SMALL, batch_size=4), POINT_RANGE, 0, 4, source=source)
    for step in range(4):
        parts = [
            TrainingBatches(config, POINT_RANGE, 0, 4, rank=rank, world_size=2, source=source)[step]
            for rank in range(2)
        ]
        assert parts[0].tokens + parts[1].tokens == alone[step].tokens
        assert torch.equal(torch.cat([part.points for part in parts]), alone[step].points)


def test_steps_outside_the_run() -> None:
    batches = small_batches(MemoryFrames([memory_frame]))
    assert len(batches) == 3
    for step in (-1, 3):
        with pytest.raises(IndexError, match=r"step must be in \[0, 3\)"):
            batches[step]


# Broken frames


def test_a_program_that_still_holds_batches_ends() -> None:
    """Its loader processes ignore the SIGTERM that multiprocessing sends them before it waits for them."""
    program = (
        "import torch.utils.data, pred.data.batch as b\n"
        "held = iter(b._Loader(torch.utils.data.TensorDataset(torch.zeros(99)), range(99), workers=1))\n"
        "next(held)\n"
        "raise SystemExit(7)\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], timeout=60, check=False)
    assert finished.returncode == 7


def test_broken_frame_stops_the_loader_with_its_text(tree: Tree) -> None:
    path = tree.keyframe_files[0]
    path.write_bytes(path.read_bytes()[:-1])
    for workers in (0, 1):
        with pytest.raises(FrameError) as error:
            list(make_loader(TrainingBatches(tree_config(tree), POINT_RANGE, 0, 2), workers=workers))
        assert str(error.value).startswith(f"{path}: sweep file must hold whole points of 20 bytes")
        assert "\n" not in str(error.value)  # no traceback of a loader process
        with pytest.raises(FrameError, match=rf"^{path}: sweep file must hold whole points of 20 bytes"):
            config = tree_config(tree, class_counts="dataset", workers=workers)
            TrainingBatches(config, POINT_RANGE, 0, 2)


def break_points(tree: Tree) -> Path:
    path = tree.keyframe_files[1]
    points = np.fromfile(path, dtype=np.float32)
    points[3] = np.nan
    points.tofile(path)
    return path


def break_label(tree: Tree) -> Path:
    path = tree.labels[1]["CAM_FRONT"]
    path.write_bytes(path.read_bytes()[:60])
    return path


def break_probabilities(tree: Tree) -> Path:
    path = tree.labels[1]["CAM_BACK"]
    np.save(path, np.full((19, 18, 32), np.nan, dtype=np.float16))
    return path


def remove_image(tree: Tree) -> Path:
    path = tree.images[1]["CAM_BACK"]
    path.unlink()
    return path


def break_image(tree: Tree) -> Path:
    path = tree.images[1]["CAM_BACK"]
    path.write_bytes(b"junk" * 100)
    return path


@pytest.mark.parametrize("damage", [break_points, break_label, break_probabilities, remove_image, break_image])
@pytest.mark.parametrize("workers", [0, 2])
def test_skip_takes_the_next_frame_and_counts(tree: Tree, damage: Callable[[Tree], Path], workers: int) -> None:
    path = damage(tree)
    config = tree_config(tree, on_error="skip", class_counts="dataset")
    batches = list(make_loader(TrainingBatches(config, POINT_RANGE, 0, 3), workers=workers))
    for batch in batches:
        assert batch.tokens == [tree.tokens[0]] * 2
        [(token, text)] = batch.skipped
        assert token == tree.tokens[1] and text.startswith(f"{path}: ")
        assert batch.depth.valid.all()


def test_every_replacement_in_a_batch_counts(tree: Tree) -> None:
    break_points(tree)
    batch = TrainingBatches(tree_config(tree, on_error="skip", batch_size=6), POINT_RANGE, 0, 1)[0]
    assert batch.tokens == [tree.tokens[0]] * 6
    assert [token for token, _ in batch.skipped] == [tree.tokens[1]] * 3


def test_skip_with_no_frame_left(tree: Tree) -> None:
    for path in tree.keyframe_files:
        path.unlink()
    batches = TrainingBatches(tree_config(tree, on_error="skip"), POINT_RANGE, 0, 2)
    with pytest.raises(FrameError, match=r"sweep file must exist.*no frame is left: all 2 are broken"):
        batches[0]


def test_replacement_follows_the_schedule() -> None:
    def broken() -> Frame:
        raise FrameError("some/file", "is broken")

    frames: list[Callable[[], Frame]] = [
        lambda index=index: memory_frame(f"token-{index}")  # type: ignore[misc]
        for index in range(5)
    ]
    whole = small_batches(MemoryFrames(list(frames)), steps=10)
    order = [whole[step].tokens[0] for step in range(10)]
    frames[2] = broken
    damaged = small_batches(MemoryFrames(frames), steps=10, on_error="skip")
    for step in range(10):
        batch = damaged[step]
        if order[step] != "token-2":
            assert_equal(batch, whole[step])
            continue
        epoch = order[step // 5 * 5 :][:5]
        assert batch.tokens == [epoch[(step + 1) % 5]]
        assert batch.skipped == [("token-2", "some/file: is broken")]


# Frames with little or nothing in them


@pytest.mark.parametrize("view", ["lidar", "image"])
@pytest.mark.parametrize("xyz", [np.zeros((0, 3)), np.full((9, 3), 99.0), np.full((9, 3), 0.2)])
def test_frame_without_points_in_range(xyz: np.ndarray, view: str) -> None:
    classes = np.zeros((25, 50), dtype=np.uint8)
    source = MemoryFrames([lambda: memory_frame(xyz=xyz, classes=classes)])
    batch = small_batches(source, batch_size=2, depth_view=view)[0]
    assert batch.points.shape == (0, 5) and batch.point_offsets.tolist() == [0, 0, 0]
    assert batch.semantic is not None
    for rays, num_rays in ((batch.depth, 16), (batch.semantic, 16)):
        assert rays.valid.shape == (2, num_rays) and not rays.valid.any()
        assert_finite_and_unit(rays)
    assert (batch.depth.depth_m == 1).all()


def test_frame_without_labelled_pixels() -> None:
    empty = np.full((25, 50), 255, dtype=np.uint8)
    full = np.zeros((25, 50), dtype=np.uint8)
    both: list[Callable[[], Frame]] = [
        lambda: memory_frame("token-0", classes=empty),
        lambda: memory_frame("token-1", classes=full),
    ]
    batch = small_batches(MemoryFrames(both), batch_size=2)[0]
    assert batch.semantic is not None
    labelled = batch.tokens.index("token-1")
    assert batch.semantic.valid[labelled].all() and not batch.semantic.valid[1 - labelled].any()
    assert (batch.semantic.target[1 - labelled] == 0).all()
    assert batch.depth.valid.all()
    assert_finite_and_unit(batch.semantic)


def test_camera_without_candidates() -> None:
    ahead_only = np.abs(np.random.default_rng(0).uniform(-20, 20, (600, 3))) * [1, 1, 0.1]
    source = MemoryFrames([lambda: memory_frame(xyz=ahead_only, classes=np.zeros((25, 50), dtype=np.uint8))])
    semantic = small_batches(source)[0].semantic
    assert semantic is not None and semantic.valid.sum() == 8 and semantic.valid.shape == (1, 16)


def test_frames_with_different_numbers_of_cameras() -> None:
    classes = np.zeros((25, 50), dtype=np.uint8)
    frames: list[Callable[[], Frame]] = [
        lambda number=number: memory_frame(f"token-{number}", classes=classes, num_cameras=number)  # type: ignore[misc]
        for number in range(3)
    ]
    batch = small_batches(MemoryFrames(frames), batch_size=3)[0]
    assert batch.semantic is not None
    per_token = dict(zip(batch.tokens, batch.semantic.valid.sum(dim=1).tolist(), strict=True))
    assert per_token == {"token-0": 0, "token-1": 8, "token-2": 16}


def test_one_return() -> None:
    xyz = np.array([[0.0, 10.0, 0.0]])
    source = MemoryFrames([lambda: memory_frame(xyz=xyz, classes=np.full((25, 50), 3, dtype=np.uint8))])
    batch = small_batches(source, holdout_fraction=0.0)[0]
    assert batch.points.tolist() == [[0, 10, 0, 0, 0]]
    assert batch.depth.valid.all() and (batch.depth.depth_m == 10).all()
    assert batch.semantic is not None and batch.semantic.valid.sum() == 8


# Evaluation view


def test_evaluation_batch_uses_every_held_out_return_once(tree: Tree) -> None:
    config = tree_config(tree, holdout_fraction=0.3, depth_view="image")
    frame = build_source(config).load(1)
    batch = evaluation_batch(frame, config, POINT_RANGE, seed=0)
    held = is_held_out(frame.point_index, frame.token, 0.3) & frame.is_keyframe
    rows = frame.earlier_keyframes[tree.tokens[0]]
    hidden = held.copy()
    hidden[rows] = is_held_out(frame.point_index[rows], tree.tokens[0], 0.3)
    xyz = frame.points[:, :3]
    inside = (np.abs(xyz[:, :2]) < 25).all(axis=1) & (xyz[:, 2] < 3) & (xyz[:, 2] > -5)
    expected = xyz[held & inside]
    assert 60 < len(expected) < 0.4 * NUM_LANDMARKS
    # Always the LiDAR view, in the order of the file.
    aimed_at = batch.depth.depth_m[0, :, None] * batch.depth.directions[0]
    np.testing.assert_allclose(aimed_at, expected, atol=1e-4)
    assert batch.depth.valid.all() and (batch.depth.depth_factor == 1).all()
    visible = {point.tobytes() for point in batch.points.numpy()}
    assert not visible & {point.tobytes() for point in frame.points[hidden]}
    assert len(visible) == round(0.2 * (inside & ~hidden).sum())
    assert batch.semantic is not None and batch.semantic.valid.all()
    num_seen = 0
    for camera in frame.cameras:
        assert camera.labels is not None
        uv, z_depth_m = camera.project(expected)
        labels = camera.labels.lookup(uv[camera.in_image(uv, z_depth_m)])
        num_seen += (labels.class_id >= 0).sum()
    assert batch.semantic.valid.shape == (1, num_seen)
    assert_equal(batch, evaluation_batch(frame, config, POINT_RANGE, seed=0))
    other = evaluation_batch(frame, config, POINT_RANGE, seed=1)
    assert not torch.equal(other.points, batch.points)
    assert torch.equal(other.depth.directions, batch.depth.directions)


def test_evaluation_is_that_of_camera_rays_whatever_a_run_trains_with(tree: Tree) -> None:
    (tree.root / "depth").mkdir()
    frame = build_source(tree_config(tree)).load(1)
    expected = evaluation_batch(frame, tree_config(tree), POINT_RANGE, seed=0)
    projection = tree_config(tree, semantic_view="lidar", image_depth="depth", depth_filter=(0.5, 0.0))
    # The depth maps are not there: nobody asks for them.
    found = evaluation_batch(build_source(projection).load(1), projection, POINT_RANGE, seed=0)
    assert_equal(found, expected)
    # The input is what the encoder was trained to see.
    patches = tree_config(tree, mask_strategy="patch", mask_patch_m=5.0)
    found = evaluation_batch(frame, patches, POINT_RANGE, seed=0)
    assert not torch.equal(found.points, expected.points)
    assert torch.equal(found.depth.directions, expected.depth.directions)


def test_evaluation_batch_with_nothing_held_out() -> None:
    config = dataclasses.replace(SMALL, holdout_fraction=0.0)
    batch = evaluation_batch(memory_frame(), config, POINT_RANGE, seed=0)
    assert batch.semantic is None
    assert batch.depth.valid.tolist() == [[False]]
    labelled = memory_frame(classes=np.zeros((25, 50), dtype=np.uint8))
    semantic = evaluation_batch(labelled, config, POINT_RANGE, seed=0).semantic
    assert semantic is not None and semantic.valid.tolist() == [[False]]


# Configuration and sources


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"batch_size": 0}, r"data\.batch_size must be at least 1, got 0"),
        ({"sweeps": 0}, r"data\.sweeps must be at least 1, got 0"),
        ({"depth_rays": 0}, r"data\.depth_rays must be at least 1"),
        ({"mask_ratio": 1.0}, r"data\.mask_ratio must be in \[0, 1\), got 1\.0"),
        ({"holdout_fraction": -0.1}, r"data\.holdout_fraction must be in \[0, 1\), got -0\.1"),
        ({"mask_groups": 0}, r"data\.mask_groups must be at least 1, got 0"),
        ({"mask_patch_m": 0.0}, r"data\.mask_patch_m must be positive, got 0\.0"),
        ({"mask_patch_m": float("nan")}, r"data\.mask_patch_m must be positive, got nan"),
        ({"depth_filter": (0.5, 0.0)}, r"data\.depth_filter must be given with data\.image_depth, got no image depth"),
        (
            {"depth_filter": (0.5, -0.1), "image_depth": "depth"},
            r"data\.depth_filter must be \(absolute m, relative\), got \(0\.5, -0\.1\)",
        ),
        ({"workers": -1}, r"data\.workers must be at least 0, got -1"),
        ({"ego_box": (1.0, 0.0, -1.0, 0.0)}, r"data\.ego_box must be finite \(x_min"),
        ({"ego_box": (0.0, 0.0, float("inf"), 1.0)}, r"data\.ego_box must be finite \(x_min"),
    ],
)
def test_wrong_settings(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        DataConfig(**changes)


def test_own_car() -> None:
    """nuScenes looks along y, ONCE along -y."""
    points = np.array([[0.9, 2.9], [0.9, -1.9], [-0.9, 2.9], [0.0, -2.5]])
    outside = [False, False, False, True]
    assert outside_ego_box(points, DataConfig().own_car).tolist() == outside
    assert outside_ego_box(points, DataConfig(dataset="folder").own_car).tolist() == outside
    assert outside_ego_box(-points, DataConfig(dataset="once").own_car).tolist() == outside
    assert DataConfig(dataset="once", ego_box=(0, 0, 1, 1)).own_car == (0, 0, 1, 1)


def test_sources() -> None:
    with pytest.raises(ValueError, match=r"data\.root must name the folder of the data set, got None"):
        build_source(DataConfig())
    with pytest.raises(ValueError, match="source must hold at least one frame"):
        small_batches(MemoryFrames([]))


def test_made_world() -> None:
    root = str(tiny_world())
    config = DataConfig(root=root, batch_size=1, workers=0, semantic_rays_per_camera=16, depth_rays=32)
    batch = TrainingBatches(config, POINT_RANGE, seed=0, total_steps=1)[0]
    assert batch.depth.valid.all()
    assert batch.semantic is not None and batch.semantic.valid.all()
    assert batch.semantic.target.shape == (1, 96, 19)
    assert_finite_and_unit(batch.depth)
    assert_finite_and_unit(batch.semantic)
