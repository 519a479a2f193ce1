# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Ray candidates and draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pred.data.frame import Camera, Frame, FrameError
from pred.data.image_depth import DepthMap
from pred.data.labels import PseudoLabel
from pred.data.masking import is_held_out
from pred.data.rays import (
    DepthView,
    FrameCandidates,
    SemanticView,
    depths_agree,
    draw_class_balanced,
    draw_uniform,
    frame_candidates,
    point_use,
    ray_candidates,
)
from pred.random import numpy_generator

POINT_RANGE = (-20.0, -20.0, -3.0, 20.0, 20.0, 3.0)
EGO_BOX = (-1.0, -2.0, 1.0, 3.0)
# The camera sits 1 m ahead of the LiDAR, looks along +y, and its axes are turned accordingly.
T_CAMERA_FROM_LIDAR = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, -1.0], [0, 0, 0, 1.0]])
INTRINSICS = np.array([[50.0, 0, 50.0], [0, 50.0, 25.0], [0, 0, 1.0]])

VIEWS: tuple[SemanticView, ...] = ("camera", "lidar")


def make_frame(
    xyz: NDArray[np.floating] | list[list[float]], classes: NDArray[np.uint8] | None = None, token: str = "t"
) -> Frame:
    points = np.zeros((len(xyz), 5), dtype=np.float32)
    points[:, :3] = xyz
    labels = None if classes is None else PseudoLabel(classes, 100, 50)
    camera = Camera("CAM", INTRINSICS, T_CAMERA_FROM_LIDAR, 100, 50, labels=labels)
    return Frame(token, points, np.arange(len(points)), np.ones(len(points), dtype=np.bool_), [camera])


def random_xyz(num_points: int = 4000) -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform([-25, -25, -4], [25, 25, 4], (num_points, 3))


def test_depth_candidates_hand_computed() -> None:
    xyz = [[3.0, 4.0, 0.0], [0.0, 2.5, 1.0], [0.0, 30.0, 0.0], [1.2, 0.0, -0.5], [0.0, 0.0, 0.5]]
    found = frame_candidates(make_frame(xyz), POINT_RANGE, (-0.1, -0.1, 0.1, 0.1), 0.0)
    # The third lies outside the range box; the last is in the ego box.
    np.testing.assert_allclose(found.depth.depth_m, [5.0, 7.25**0.5, 1.3], rtol=1e-6)
    np.testing.assert_allclose(found.depth.directions[0], [0.6, 0.8, 0.0], rtol=1e-6)
    assert not found.depth.origins.any() and (found.depth.depth_factor == 1).all()
    assert len(found.points) == 3
    assert found.semantic == []
    assert all(column.dtype == np.float32 for column in found.depth)


def test_returns_within_one_metre_are_input_but_no_target() -> None:
    found = frame_candidates(make_frame([[0.6, 0.6, 0.0], [0.8, 0.8, 0.0]]), POINT_RANGE, (0, 0, 0, 0), 0.0)
    np.testing.assert_allclose(found.depth.depth_m, [1.28**0.5])
    assert len(found.points) == 2


@pytest.mark.parametrize("view", ["lidar", "image"])
def test_targets_are_farther_than_near_m(view: DepthView) -> None:
    frame = make_frame([[0.0, 3.5, 0.0], [0.0, 4.5, 0.0]], np.zeros((25, 50), dtype=np.uint8))
    # The camera sits 1 m ahead of the LiDAR.
    for near_m, num_lidar, num_camera in ((2.0, 2, 2), (3.0, 2, 1), (4.0, 1, 0)):
        found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, depth_view=view, near_m=near_m)
        assert len(found.depth.depth_m) == (num_lidar if view == "lidar" else num_camera)
        assert len(found.semantic[0].class_id) == num_camera and len(found.points) == 2


def test_image_view_depth_is_z_depth() -> None:
    xyz = random_xyz()
    found = frame_candidates(make_frame(xyz), POINT_RANGE, EGO_BOX, 0.0, depth_view="image").depth
    assert 100 < len(found.depth_m) < len(xyz)
    np.testing.assert_allclose(found.origins, np.broadcast_to([0.0, 1.0, 0.0], found.origins.shape), atol=1e-7)
    # t * depth_factor = depth at the return, whose y is 1 m more than its z-depth.
    t = found.depth_m / found.depth_factor
    aimed_at = found.origins + t[:, None] * found.directions
    np.testing.assert_allclose(aimed_at[:, 1], found.depth_m + 1.0, rtol=1e-5)
    distance = np.linalg.norm(aimed_at[:, None] - xyz[None], axis=2).min(axis=1)
    assert distance.max() < 1e-4


def test_held_out_returns_are_in_nothing_but_the_held_out_set() -> None:
    frame = make_frame(random_xyz(), np.full((25, 50), 8, dtype=np.uint8))
    held = is_held_out(frame.point_index, "t", 0.1)
    training = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.1)
    use = point_use(frame, POINT_RANGE, EGO_BOX, 0.1)
    rays = ray_candidates(frame.points[use.held_out, :3].astype(np.float64), frame.cameras)
    evaluation = FrameCandidates("t", frame.points[use.input], *rays)
    everything = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0)

    def returns(candidates_points: NDArray[np.float32]) -> set[bytes]:
        return {point.tobytes() for point in candidates_points}

    held_points = returns(frame.points[held])
    assert not returns(training.points) & held_points
    assert np.array_equal(training.points, evaluation.points)
    assert len(training.points) < len(everything.points)
    for population in ("depth", "semantic"):
        found = [getattr(c, population) for c in (training, evaluation, everything)]
        found = [rays[0] if population == "semantic" else rays for rays in found]
        keys = [returns(rays.directions) for rays in found]
        assert keys[0] and keys[1]
        assert not keys[0] & keys[1]
        assert keys[0] | keys[1] == keys[2]
    assert 0.08 < len(evaluation.depth.depth_m) / len(everything.depth.depth_m) < 0.12


def test_sweep_points_are_input_only() -> None:
    frame = make_frame(random_xyz(1000), np.zeros((25, 50), dtype=np.uint8))
    frame.is_keyframe[500:] = False
    found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.5)
    alone = make_frame(frame.points[:500, :3], np.zeros((25, 50), dtype=np.uint8))
    expected = frame_candidates(alone, POINT_RANGE, EGO_BOX, 0.5)
    assert np.array_equal(found.depth.directions, expected.depth.directions)
    assert np.array_equal(found.semantic[0].directions, expected.semantic[0].directions)
    # The own car's place now may hold points seen earlier.
    inside = (np.abs(frame.points[500:, :3]) < [20, 20, 3]).all(axis=1)
    assert len(found.points) == len(expected.points) + inside.sum()
    # Sweeps in between hold nothing out; one that was a keyframe hides what its own token holds out.
    frame.earlier_keyframes = {"earlier": slice(700, 900)}
    shown = inside.copy()
    shown[200:400] &= ~is_held_out(frame.point_index[700:900], "earlier", 0.5)
    found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.5)
    assert np.array_equal(found.points, np.concatenate([expected.points, frame.points[500:][shown]]))


def test_semantic_rays_pass_through_their_returns() -> None:
    classes = np.random.default_rng(1).choice([0, 8, 13, 19, 255], (25, 50)).astype(np.uint8)
    frame = make_frame(random_xyz(), classes)
    found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0).semantic[0]
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1.0, rtol=1e-6)
    # Follow each ray into the image: the label there is the target.
    uv, _ = frame.cameras[0].project(found.origins + 10.0 * found.directions)
    seen = classes[(uv[:, 1] / 2).astype(int), (uv[:, 0] / 2).astype(int)]
    on_an_edge = (np.abs(uv / 2 - np.round(uv / 2)) < 1e-4).any(axis=1)
    assert (seen == found.class_id)[~on_an_edge].all()
    assert set(found.class_id) == {0, 8, 13}
    assert np.array_equal(found.target.argmax(axis=1), found.class_id)
    assert (found.confidence == 1).all()


# Direct projection: a return 4 m before the camera, one behind it in the same pixel, one in another pixel.
IN_LINE = [[0.0, 5.0, 0.0], [0.0, 9.0, 0.0], [2.0, 5.0, 1.0]]
PIXELS = [[50.0, 25.0], [50.0, 25.0], [75.0, 12.5]]


def projection_frame(tmp_path: Path, depth_m: tuple[float, float] = (4.0, 4.0)) -> Frame:
    classes = np.full((50, 100), 13, dtype=np.uint8)
    classes[12, 75] = 2
    depth = np.zeros((50, 100), dtype=np.uint16)
    depth[25, 50], depth[12, 75] = np.array(depth_m) * 256
    Image.fromarray(depth).save(tmp_path / "depth.png")
    frame = make_frame(IN_LINE, classes)
    np.testing.assert_allclose(frame.cameras[0].project(frame.points[:, :3])[0], PIXELS)
    frame.cameras[0].depth = DepthMap(tmp_path / "depth.png", 100, 50)
    return frame


def test_direct_projection_hand_computed(tmp_path: Path) -> None:
    frame = projection_frame(tmp_path)
    found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, semantic_view="lidar").semantic[0]
    assert not found.origins.any() and found.origins.shape == (3, 3)
    np.testing.assert_allclose(found.directions, IN_LINE / np.linalg.norm(IN_LINE, axis=1)[:, None], rtol=1e-6)
    # The return behind has the label of what the camera sees before it.
    assert found.class_id.tolist() == [13, 13, 2]
    by_camera = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0).semantic[0]
    assert np.array_equal(found.target, by_camera.target) and (by_camera.origins == [0.0, 1.0, 0.0]).all()
    for rays in (found, by_camera):
        np.testing.assert_allclose(rays.origins + rays.directions * rays.range_m[:, None], IN_LINE, rtol=1e-6)
    assert [column.dtype for column in found] == [column.dtype for column in by_camera]


@pytest.mark.parametrize("view", ["camera", "lidar"])
def test_depth_filter_hand_computed(tmp_path: Path, view: SemanticView) -> None:
    def kept(depth_m: tuple[float, float], tolerance: tuple[float, float]) -> list[int]:
        frame = projection_frame(tmp_path, depth_m)
        found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, semantic_view=view, depth_filter=tolerance).semantic[
            0
        ]
        offset = np.array(IN_LINE) - (found.origins[0] if len(found.origins) else 0)
        direction = offset / np.linalg.norm(offset, axis=1)[:, None]
        return [int(np.abs(direction - ray).sum(axis=1).argmin()) for ray in found.directions]

    # Depths of the returns: 4, 8 and 4 m.
    assert kept((4.0, 4.0), (0.0, 0.0)) == [0, 2]
    assert kept((4.5, 3.5), (0.5, 0.0)) == [0, 2]
    assert kept((4.5, 3.5), (0.49, 0.0)) == []
    assert kept((4.0, 5.0), (0.5, 0.1)) == [0, 2]  # 1 m at 5 m
    assert kept((4.0, 3.0), (0.5, 0.1)) == [0]  # but 0.8 m at 3 m
    assert kept((4.0, 0.0), (100.0, 1.0))[-1:] != [2]  # no depth


def test_depth_filter_needs_depth() -> None:
    frame = make_frame(IN_LINE, np.full((50, 100), 13, dtype=np.uint8))
    with pytest.raises(FrameError, match="camera CAM: depth map must be given"):
        frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, depth_filter=(0.5, 0.0))


def test_depths_agree() -> None:
    z_depth_m, image_m = np.full(3, 10.0), np.array([11.5, 8.5, np.nan])
    assert depths_agree(z_depth_m, image_m, (0.35, 0.1)).tolist() == [True, False, False]


def test_a_return_has_a_ray_for_each_camera_that_labels_it() -> None:
    frame = make_frame(IN_LINE, np.full((50, 100), 13, dtype=np.uint8))
    unlabelled = np.full((50, 100), 255, dtype=np.uint8)
    unlabelled[25, 50] = 2
    second = Camera("CAM-2", INTRINSICS, T_CAMERA_FROM_LIDAR, 100, 50, labels=PseudoLabel(unlabelled, 100, 50))
    frame.cameras.append(second)
    found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, semantic_view="lidar").semantic
    assert [camera.class_id.tolist() for camera in found] == [[13, 13, 13], [2, 2]]
    assert np.array_equal(found[0].directions[:2], found[1].directions)


@pytest.mark.parametrize("near_m", [4.5, 6.0])
def test_near_m_counts_from_the_origin_of_the_ray(near_m: float) -> None:
    frame = make_frame(IN_LINE, np.full((50, 100), 13, dtype=np.uint8))
    by_view = {
        view: len(
            frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.0, near_m=near_m, semantic_view=view).semantic[0].class_id
        )
        for view in VIEWS
    }
    assert by_view == ({"camera": 2, "lidar": 3} if near_m == 4.5 else {"camera": 1, "lidar": 1})


def test_class_counts() -> None:
    classes = np.full((25, 50), 19, dtype=np.uint8)
    assert frame_candidates(make_frame(random_xyz(), classes), POINT_RANGE, EGO_BOX, 0.0).class_counts().sum() == 0
    classes[:, :25] = 13
    candidates = frame_candidates(make_frame(random_xyz(), classes), POINT_RANGE, EGO_BOX, 0.0)
    counts = candidates.class_counts()
    assert counts.shape == (19,) and counts[13] == counts.sum() == len(candidates.semantic[0].class_id) > 0


def test_nothing_to_aim_at() -> None:
    for xyz in (np.zeros((0, 3)), np.full((4, 3), 500.0)):
        for view in ("lidar", "image"):
            frame = make_frame(xyz, np.zeros((25, 50), dtype=np.uint8))
            found = frame_candidates(frame, POINT_RANGE, EGO_BOX, 0.1, depth_view=view)
            assert found.points.shape == (0, 5)
            assert found.depth.directions.shape == (0, 3) and found.depth.depth_m.shape == (0,)
            assert found.semantic[0].target.shape == (0, 19)
            assert found.class_counts().tolist() == [0] * 19


def test_draw_uniform() -> None:
    drawn = draw_uniform(100, 60, numpy_generator(0))
    assert len(set(drawn.tolist())) == 60 and 0 <= drawn.min() and drawn.max() < 100
    drawn = draw_uniform(3, 60, numpy_generator(0))
    assert set(drawn.tolist()) == {0, 1, 2}


def test_draw_class_balanced_without_replacement() -> None:
    # 900 of class 0, 90 of class 8, 10 of class 11: a balanced draw of 30 holds 10 of each on average,
    # less for the class that runs out.
    class_id = np.repeat([0, 8, 11], [900, 90, 10])
    counts = np.bincount(class_id, minlength=19)
    total = np.zeros(19)
    for step in range(300):
        drawn = draw_class_balanced(class_id, counts, 30, numpy_generator(0, step))
        assert len(set(drawn.tolist())) == 30
        total += np.bincount(class_id[drawn], minlength=19)
    share = total / total.sum()
    assert abs(share[0] - share[8]) < 0.06
    assert 0.15 < share[11] < 1 / 3
    # A single ray shows the weights themselves.
    first = [int(class_id[draw_class_balanced(class_id, counts, 1, numpy_generator(1, i))[0]]) for i in range(900)]
    assert np.abs(np.bincount(first)[[0, 8, 11]] - 300).max() < 5 * 14.2


def test_draw_class_balanced_with_replacement() -> None:
    class_id = np.repeat([0, 8], [95, 5])
    drawn = draw_class_balanced(class_id, np.bincount(class_id, minlength=19), 4000, numpy_generator(0))
    assert drawn.shape == (4000,)
    assert abs((class_id[drawn] == 8).mean() - 0.5) < 5 * 0.008


def test_class_balance_follows_the_given_counts() -> None:
    # Counts of a whole batch or data set, in which class 8 is as common as class 0.
    class_id = np.repeat([0, 8], [95, 5])
    counts = np.full(19, 1000)
    drawn = draw_class_balanced(class_id, counts, 4000, numpy_generator(0))
    assert abs((class_id[drawn] == 8).mean() - 0.05) < 5 * 0.0035
