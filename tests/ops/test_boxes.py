# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Rotated boxes: cases worked out by hand; shapely, spconv and the definition of greedy suppression as oracles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import memory
from benchmarks.cases import lidar_points
from pred.data.boxes import corners_bev
from pred.ops import box_iou_3d, box_iou_bev, nms_bev, points_in_boxes, points_in_boxes_mask, reference
from tests.conftest import KERNEL_ERROR, SANITIZED, require_value_checks
from tests.tolerances import FORWARD

F64 = torch.float64
DTYPES = [torch.float32, F64]
NAN, INF = math.nan, math.inf


def box(
    x: float = 0,
    y: float = 0,
    z: float = 0,
    l: float = 4,  # noqa: E741
    w: float = 2,
    h: float = 1,
    yaw: float = 0,
) -> list[float]:
    return [x, y, z, l, w, h, yaw]


def boxes_of(*rows: list[float], dtype: torch.dtype = F64) -> Tensor:
    return torch.tensor(rows, dtype=dtype).reshape(-1, 7)


def random_boxes(count: int, spread: float = 3, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 7, generator=generator, dtype=F64)
    low = uniform.new_tensor([-spread, -spread, -spread / 2, 0.2, 0.2, 0.2, -7])
    return low + uniform * (uniform.new_tensor([spread, spread, spread / 2, 6, 6, 6, 7]) - low)


def awkward_boxes(count: int) -> tuple[Tensor, Tensor]:
    """Pairs, row by row. Of the first 4/5, a fifth each: equal; turned by a quarter, a half, or a hair; moved by their
    length, so that they share a side up to rounding; needles and slabs."""
    a, b = random_boxes(count, seed=1), random_boxes(count, seed=2)
    part = count // 5
    b[:part] = a[:part]
    turned = slice(part, 2 * part)
    b[turned] = a[turned]
    b[turned, 6] += torch.tensor([math.pi / 2, math.pi, 1e-9, -1e-13], dtype=F64).repeat(part)[:part]
    moved = slice(2 * part, 3 * part)
    b[moved] = a[moved]
    b[moved, :2] += a[moved, 3:4] * torch.stack([a[moved, 6].cos(), a[moved, 6].sin()], dim=1)
    thin = slice(3 * part, 4 * part)
    a[thin, 3] *= 30
    b[thin, 4] *= 0.01
    return a, b


def place(boxes: Tensor, yaw: float, x: float, y: float) -> Tensor:
    """Turned around the origin, then moved."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    placed = boxes.clone()
    placed[:, 0] = cos * boxes[:, 0] - sin * boxes[:, 1] + x
    placed[:, 1] = sin * boxes[:, 0] + cos * boxes[:, 1] + y
    placed[:, 6] += yaw
    return placed


def shared_area(a: Tensor, b: Tensor) -> Tensor:
    """By shapely, pair by pair."""
    shapely = pytest.importorskip("shapely")
    polygons = [shapely.polygons(corners_bev(boxes.double().numpy())) for boxes in (a, b)]
    return torch.from_numpy(np.asarray(shapely.area(shapely.intersection(*polygons)))).double()


def shapely_iou(a: Tensor, b: Tensor, with_height: bool = False) -> Tensor:
    a, b = a.double(), b.double()
    shared, sizes = shared_area(a, b), slice(3, 5)
    if with_height:
        top = torch.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
        bottom = torch.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
        shared, sizes = shared * (top - bottom).clamp_min(0), slice(3, 6)
    return shared / (a[:, sizes].prod(dim=1) + b[:, sizes].prod(dim=1) - shared)


OCTAGON = 2 * (math.sqrt(2) - 1)  # two squares of side 1, one turned by 45 degrees
BY_HAND = [
    (box(), box(), 8.0),  # equal
    (box(), box(l=1, w=1), 1.0),  # inside
    (box(), box(l=1, w=1, x=1.5, y=0.5), 1.0),  # inside, in a corner
    (box(), box(l=9, w=9, yaw=0.3), 8.0),  # around
    (box(), box(x=1), 6.0),
    (box(), box(x=-1, y=1), 3.0),
    (box(), box(x=4), 0.0),  # share a side
    (box(), box(x=4, y=2), 0.0),  # share a corner
    (box(), box(x=2.5, w=0.5, l=1), 0.0),  # share a part of a side
    (box(), box(x=9), 0.0),
    (box(), box(yaw=math.pi), 8.0),
    (box(), box(yaw=math.pi / 2), 4.0),
    (box(l=1, w=1), box(l=1, w=1, yaw=math.pi / 4), OCTAGON),
    (box(l=3, w=3), box(l=3, w=3, yaw=math.pi / 4), 9 * OCTAGON),
    (box(), box(l=2 * math.sqrt(2), w=2 * math.sqrt(2), yaw=math.pi / 4), 6.0),  # a square on its corner less two tips
    (box(l=2, w=2), box(x=2, l=2 * math.sqrt(2), w=2 * math.sqrt(2), yaw=math.pi / 4), 1.0),  # a corner inside
    (box(l=2, w=2), box(x=1.5, l=1, w=1, yaw=math.pi / 4), (math.sqrt(0.5) - 0.5) ** 2),  # its tip only
    (box(), box(l=0), 0.0),
    (box(l=0, w=0), box(l=0, w=0), 0.0),
]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("one", "other", "shared"), BY_HAND)
def test_iou_by_hand(backend: str, one: list[float], other: list[float], shared: float, dtype: torch.dtype) -> None:
    a, b = boxes_of(one, dtype=dtype), boxes_of(other, dtype=dtype)
    union = one[3] * one[4] + other[3] * other[4] - shared
    expected = shared / union if union > 0 else 0.0
    for first, second in ((a, b), (b, a)):
        for aligned in (False, True):
            iou = box_iou_bev(first, second, aligned)
            assert iou.dtype == dtype and iou.shape == ((1,) if aligned else (1, 1))
            assert iou.item() == pytest.approx(expected, abs=4 * torch.finfo(dtype).eps)
            assert shared > 0 or iou.item() == 0
    if dtype == F64:
        for yaw, x, y in ((0.7, 0, 0), (2.9, 75.0, -60.0), (-9.0, 1e4, 1e4)):
            iou = box_iou_bev(place(a, yaw, x, y), place(b, yaw, x, y))
            assert iou.item() == pytest.approx(expected, abs=1e-11 if x > 100 else 1e-13)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (box(), 1.0),
        (box(x=1), 6 / 10),
        (box(z=0.5), 1 / 3),
        (box(z=-0.5), 1 / 3),
        (box(z=1), 0.0),  # on top
        (box(z=3), 0.0),
        (box(h=0.5), 0.5),
        (box(z=0.25, h=0.5), 0.5),
        (box(h=3, l=8), 1 / 6),
        (box(yaw=math.pi / 2, z=0.5), 2 / 14),
        (box(h=0), 0.0),
    ],
)
def test_iou_3d_by_hand(backend: str, other: list[float], expected: float) -> None:
    a, b = boxes_of(box()), boxes_of(other)
    for first, second in ((a, b), (b, a)):
        assert box_iou_3d(first, second).item() == pytest.approx(expected, abs=1e-15)
        assert box_iou_3d(first, second, aligned=True).item() == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("with_height", [False, True])
def test_iou_is_that_of_shapely(backend: str, with_height: bool, dtype: torch.dtype) -> None:
    a, b = (boxes.to(dtype) for boxes in awkward_boxes(2000))
    if with_height:
        b[:, 2] = a[:, 2] + (b[:, 2] - a[:, 2]) / 3
    iou = (box_iou_3d if with_height else box_iou_bev)(a, b, aligned=True)
    expected = shapely_iou(a, b, with_height)
    assert (expected > 0.02).double().mean() > 0.3 and iou.max() <= 1
    # shapely's own roundings, around the origin of coordinates and not around a box, are 1e-9 where sides coincide.
    tolerance = torch.full((2000,), 1e-9, dtype=F64)
    tolerance[1200:] = 1e-12
    assert ((iou.double() - expected).abs() <= tolerance.clamp_min(FORWARD[dtype])).all()


def test_all_pairs_are_the_aligned_ones(backend: str) -> None:
    a, b = random_boxes(37), random_boxes(21, seed=5)
    for op in (box_iou_bev, box_iou_3d):
        pairs = op(a.repeat_interleave(21, 0), b.repeat(37, 1), aligned=True)
        assert torch.equal(op(a, b), pairs.view(37, 21))
        torch.testing.assert_close(op(b, a), op(a, b).t(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_box_with_itself_has_iou_1(backend: str, dtype: torch.dtype) -> None:
    """Whatever its place, its size and its yaw."""
    boxes = random_boxes(3000, spread=100).to(dtype)
    boxes[::2, 3:6] *= 10 ** torch.linspace(-6, 6, 1500, dtype=F64).to(dtype)[:, None]
    boxes[::3, 3] *= 1000
    boxes[1::3, :2] *= 1e5
    few = 8 * torch.finfo(dtype).eps
    turned = torch.cat([boxes[:, :6], boxes[:, 6:] + math.pi], dim=1)
    for op in (box_iou_bev, box_iou_3d):
        iou = op(boxes, boxes, aligned=True)
        assert (1 - iou).abs().max() <= few and iou.max() <= 1
        if dtype == F64:  # a half turn, rounded, turns the ends of a box of 1000 widths by as many roundings
            assert (1 - op(boxes, turned, aligned=True)).max() <= 1e-10


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_far_from_the_origin_nothing_is_lost(backend: str, dtype: torch.dtype) -> None:
    """Places that the dtype holds exactly: the bits are those at the origin."""
    a, b = (random_boxes(200, seed=seed) for seed in (7, 8))
    for boxes in (a, b):
        boxes[:, :3] = (boxes[:, :3] * 4).round() / 4
    a, b = a.to(dtype), b.to(dtype)
    far = torch.tensor([2.0**20, -(2.0**19), 2.0**18, 0, 0, 0, 0], dtype=dtype)
    for op in (box_iou_bev, box_iou_3d):
        assert torch.equal(op(a + far, b + far), op(a, b))
    points = ((random_boxes(500)[:, :3] * 4).round() / 4).to(dtype)
    assert torch.equal(points_in_boxes(points + far[:3], a + far), points_in_boxes(points, a))


def test_sizes_at_the_ends_of_the_range(backend: str) -> None:
    """float32: squares and cubes of any size are computed. float64: an area beyond the range is 0, not NaN."""
    for size in (1e-38, 1e-20, 1e18, 1e38):
        boxes = boxes_of(box(l=2, w=2, h=2), box(x=1, l=2, w=2, h=2), dtype=torch.float32)
        boxes[:, :6] *= size
        torch.testing.assert_close(box_iou_bev(boxes, boxes)[0, 1], torch.tensor(1 / 3))
        torch.testing.assert_close(box_iou_3d(boxes, boxes)[0, 1], torch.tensor(1 / 3))
    huge = boxes_of(box(l=1e200, w=1e200, h=1e200), box(x=1e308, l=1e308, w=1, h=1), box(x=-1e308, l=1e308, w=1, h=1))
    for op in (box_iou_bev, box_iou_3d):
        iou = op(huge, torch.cat([huge, random_boxes(9)]))
        assert iou.isfinite().all() and (iou[:, 3:] < 1e-90).all() and iou[0, 0] == 0
    # A strip of 1e30 m across boxes of a few metres.
    strip = boxes_of(box(l=1e30, w=2, h=1, yaw=0.5))
    square = boxes_of(box(l=6, w=6, h=1, yaw=0.5))
    assert box_iou_bev(strip, square).item() * 2e30 == pytest.approx(12)


ALL_WRONG = [
    *([NAN if i == at else value for i, value in enumerate(box())] for at in range(7)),
    *([sign * INF if i == at else value for i, value in enumerate(box())] for at in range(7) for sign in (1, -1)),
    box(l=-4),
    box(w=-2),
    box(h=-1),
]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_what_is_no_box_shares_nothing(backend: str, dtype: torch.dtype) -> None:
    wrong, right = boxes_of(*ALL_WRONG, dtype=dtype), boxes_of(*[box()] * len(ALL_WRONG), dtype=dtype)
    for op in (box_iou_bev, box_iou_3d):
        for aligned in (False, True):
            for a, b in ((wrong, right), (right, wrong), (wrong, wrong)):
                iou = op(a, b, aligned)
                assert (iou == 0).all()
    mixed = torch.cat([wrong, right[:2]])
    points = torch.tensor([[0.0, 0.0, 0.0], [NAN, 0, 0], [0, INF, 0], [0, 0, -INF]], dtype=dtype)
    assert points_in_boxes(points, mixed).tolist() == [len(wrong), -1, -1, -1]
    mask = points_in_boxes_mask(points, mixed)
    assert mask.sum() == 2 and mask[-2:, 0].all()
    scores = torch.linspace(1, 0, len(mixed), dtype=dtype)
    assert nms_bev(mixed, scores, 0.5).tolist() == [len(wrong)]
    assert nms_bev(mixed, scores, 1.0, pre_max=2).tolist() == [len(wrong), len(wrong) + 1]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_native_is_the_reference_on_awkward_boxes(level: str, dtype: torch.dtype) -> None:
    a, b = (boxes.to(dtype) for boxes in awkward_boxes(80))
    for name, op in (("box_iou_bev", box_iou_bev), ("box_iou_3d", box_iou_3d)):
        for aligned in (False, True):
            iou, expected = op(a, b, aligned), getattr(reference, name)(a.double(), b.double(), aligned)
            assert (iou.double() - expected).abs().max() <= FORWARD[dtype]
            # Whether boxes with a common side overlap is up to the roundings of sines.
            overlap = torch.maximum(iou.double(), expected) > 1e-14
            assert torch.equal(iou[overlap] > 0, expected[overlap] > 0) or dtype == torch.float32


class SpconvBoxes:
    """spconv's operations on boxes (Boost polygons)."""

    def __init__(self) -> None:
        from cumm import tensorview
        from spconv.core_cc.csrc.utils.boxops import BoxOps

        if not BoxOps.has_boost():
            pytest.skip("spconv was built without Boost: its operations on boxes do nothing")
        self.ops, self.wrap = BoxOps, tensorview.from_numpy

    def iou(self, a: Tensor, b: Tensor) -> NDArray[np.float32]:  # [N, M]
        # Its tensors do not keep the arrays' memory: each has a name here.
        corners_a, corners_b = self.corners(a), self.corners(b)
        found = np.zeros((len(a), len(b)), dtype=np.float32)
        near = np.ones_like(found)
        self.ops.rbbox_iou(self.wrap(corners_a), self.wrap(corners_b), self.wrap(near), self.wrap(found), 0.0, False)
        return found

    def suppress(self, boxes: Tensor, scores: Tensor, threshold: float) -> list[int]:
        corners, order = self.corners(boxes), scores.argsort(descending=True).int().numpy()
        near = np.ones((len(boxes), len(boxes)), dtype=np.float32)
        found = self.ops.rotate_non_max_suppression_cpu(
            self.wrap(corners), self.wrap(order), self.wrap(near), threshold
        )
        return list(found)[len(boxes) :]  # its list begins with as many zeros as there are boxes

    @staticmethod
    def corners(boxes: Tensor) -> NDArray[np.float32]:
        """Clockwise: in the other order Boost's areas are 0."""
        return np.ascontiguousarray(corners_bev(boxes.numpy())[:, ::-1].astype(np.float32))


@pytest.fixture(scope="module")
def spconv() -> SpconvBoxes:
    pytest.importorskip("spconv", reason="spconv is not installed")
    return SpconvBoxes()


def test_iou_is_that_of_spconv(backend: str, spconv: SpconvBoxes) -> None:
    a, b = random_boxes(90), random_boxes(70, seed=1)
    found = spconv.iou(a, b)
    assert (found > 0).mean() > 0.3
    np.testing.assert_allclose(box_iou_bev(a, b).numpy(), found, atol=2e-6)  # its corners are float32


def test_suppression_is_that_of_spconv(backend: str, spconv: SpconvBoxes) -> None:
    boxes, scores = random_boxes(300, spread=15), torch.rand(300, generator=torch.Generator().manual_seed(0), dtype=F64)
    for threshold in (0.01, 0.2, 0.5):
        kept = nms_bev(boxes, scores, threshold).tolist()
        assert kept == spconv.suppress(boxes, scores, threshold)
        assert 20 < len(kept) < 300


# Suppression


def test_suppression_by_hand(backend: str) -> None:
    # IoU of a 4 m box moved by d along itself: (4 - d) / (4 + d); 1 m: 0.6, 2 m: 1/3.
    boxes = boxes_of(box(x=2), box(x=0), box(x=1), box(x=20, yaw=0.3), box(x=3))
    scores = torch.tensor([0.5, 0.9, 0.7, 0.1, 0.6], dtype=F64)
    assert nms_bev(boxes, scores, 0.5).tolist() == [1, 4, 3]  # 2 by 1; 0 by 4
    assert nms_bev(boxes, scores, 0.3).tolist() == [1, 4, 3]
    assert nms_bev(boxes, scores, 0.61).tolist() == [1, 2, 4, 0, 3]
    # A suppressed box suppresses nothing: 2 m and 1 m are gone, 3 m has (4 - 3) / (4 + 3) = 1/7 with the first.
    assert nms_bev(boxes, scores, 0.15).tolist() == [1, 4, 3]
    assert nms_bev(boxes, scores, 0.14).tolist() == [1, 3]
    assert nms_bev(boxes, scores, 0.5, pre_max=2).tolist() == [1]
    assert nms_bev(boxes, scores, 0.5, post_max=2).tolist() == [1, 4]
    assert nms_bev(boxes, scores, 0.5, pre_max=0).tolist() == nms_bev(boxes, scores, 0.5, post_max=0).tolist() == []


def test_ties_and_special_scores(backend: str) -> None:
    boxes = boxes_of(*(box(x=10.0 * i) for i in range(8)))
    scores = torch.tensor([0.0, 1.0, INF, -0.0, 1.0, -INF, NAN, 0.0], dtype=F64)
    assert nms_bev(boxes, scores, 0.5).tolist() == [2, 1, 4, 0, 3, 7, 5]
    assert nms_bev(boxes, scores, 0.5, pre_max=4).tolist() == [2, 1, 4, 0]
    same = boxes_of(*[box()] * 5)
    assert nms_bev(same, torch.full((5,), 0.3, dtype=F64), 0.99).tolist() == [0]
    assert nms_bev(same, torch.full((5,), 0.3, dtype=F64), 1.0).tolist() == [0, 1, 2, 3, 4]  # 1 is not above 1


def test_threshold_zero_keeps_boxes_that_touch(backend: str) -> None:
    boxes = boxes_of(*(box(x=4.0 * i, y=2.0 * j) for i in range(20) for j in range(20)))
    scores = torch.linspace(0, 1, 400, dtype=F64)
    assert nms_bev(boxes, scores, 0.0).tolist() == list(range(399, -1, -1))
    boxes[37, 3] += 1e-6
    assert len(nms_bev(boxes, scores, 0.0)) < 400


def greedy(iou: Tensor, scores: Tensor, threshold: float) -> list[int]:
    """The definition, on all pairs."""
    kept: list[int] = []
    for row in sorted(range(len(scores)), key=lambda row: (-float(scores[row]), row)):
        if all(iou[row, other] <= threshold for other in kept):
            kept.append(row)
    return kept


@pytest.mark.parametrize("count", [1, 7, 8, 9, 60, 255, 257])
def test_suppression_is_its_definition(backend: str, count: int) -> None:
    """Sizes around a vector and a block; shapely's areas."""
    boxes = random_boxes(count, spread=max(4.0, count**0.5))
    scores = torch.randint(0, 50, (count,), generator=torch.Generator().manual_seed(count)).double()
    if backend == "reference" and count > 100:
        pytest.skip("the reference has no blocks")
    iou = shapely_iou(boxes.repeat_interleave(count, 0), boxes.repeat(count, 1)).view(count, count)
    for threshold in (0.1, 0.45):
        expected = greedy(iou, scores, threshold)
        assert nms_bev(boxes, scores, threshold).tolist() == expected
        assert nms_bev(boxes, scores, threshold, post_max=5).tolist() == expected[:5]
        assert nms_bev(boxes.float(), scores.float(), threshold, None, 300).tolist() == expected[:300]


def test_suppression_of_thousands_of_boxes(native: None) -> None:
    """More than one round of the kernels that are launched takes; what is kept is known beforehand."""
    # In a row 1 m apart, the scores falling: 1 m and 2 m are suppressed, 3 m has an IoU of 1/7.
    rows = torch.arange(9001)
    boxes = boxes_of(box()).repeat(9001, 1)
    boxes[:, 0] = rows.double()
    order = torch.randperm(9001, generator=torch.Generator().manual_seed(0))
    place = order.argsort()
    kept = order[::3]
    assert torch.equal(nms_bev(boxes[place], -place.double(), 0.3), kept)
    assert torch.equal(nms_bev(boxes[place], -place.double(), 0.3, 5000, 1600), kept[:1600])
    assert torch.equal(nms_bev(boxes[place], -place.double(), 0.3, 5000), kept[:1667])
    # Around 1500 places far from each other; of many equal scores the lowest row is the best one.
    boxes[:, 0] = 20.0 * (rows % 1500) + 0.01 * (rows // 1500)
    scores = torch.randint(0, 60, (9001,), generator=torch.Generator().manual_seed(1)).float()
    best: dict[int, int] = {}
    for row in sorted(rows.tolist(), key=lambda row: (-float(scores[row]), row)):
        best.setdefault(row % 1500, row)
    assert nms_bev(boxes.float(), scores, 0.5).tolist() == list(best.values())
    assert nms_bev(boxes.float(), scores, 0.5, post_max=700).tolist() == list(best.values())[:700]


def test_suppression_at_every_level_and_with_any_number_of_threads(level: str) -> None:
    boxes, scores = random_boxes(1200, spread=15), torch.rand(1200, generator=torch.Generator().manual_seed(3)).double()
    expected = reference.nms_bev(boxes, scores, 0.1)
    assert 80 < len(expected) < 500
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        assert torch.equal(nms_bev(boxes, scores, 0.1), expected)


@pytest.mark.skipif(SANITIZED, reason="the sanitizer keeps notes on every page")
def test_suppression_stores_no_pairs(native: None) -> None:
    """30,000 boxes, all kept: a bit per pair would be 110 MB."""
    rows = torch.arange(30000)
    boxes = torch.zeros(30000, 7)
    boxes[:, 0], boxes[:, 1] = 5.0 * (rows % 200), 3.0 * (rows // 200)
    boxes[:, 3:6] = torch.tensor([4.0, 2.0, 1.0])
    scores = torch.linspace(1, 0, 30000)
    nms_bev(boxes[:100], scores[:100], 0.1)
    taken = memory.added_peak_bytes(lambda: nms_bev(boxes, scores, 0.1))
    assert len(nms_bev(boxes, scores, 0.1)) == 30000
    if taken is None:
        pytest.skip("the system does not tell the peak of a process's memory")
    assert 2e6 < taken < 20e6


# Points


def test_points_by_hand(backend: str) -> None:
    boxes = boxes_of(box(), box(x=3), box(z=10, yaw=math.pi / 2), box(x=50, l=0, w=0, h=0))
    points = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [2.0, 1.0, 0.5],  # a corner
            [2.0, 0.0, 0.0],  # on a face of the first, inside of the second
            [2.0000001, 0.0, 0.0],
            [0.0, 1.0000001, 0.0],
            [0.0, 0.0, -0.5000001],
            [5.0, -1.0, -0.5],
            [0.0, 1.9, 10.0],  # the length lies along y
            [1.9, 0.0, 10.0],
            [50.0, 0.0, 0.0],  # a box without size holds its centre
        ],
        dtype=F64,
    )
    assert points_in_boxes(points, boxes).tolist() == [0, 0, 0, 1, -1, -1, 1, 2, -1, 3]
    mask = points_in_boxes_mask(points, boxes)
    assert mask.dtype == torch.bool and mask.shape == (4, 10)
    assert mask.nonzero().tolist() == [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [1, 3], [1, 6], [2, 7], [3, 9]]


def test_points_of_a_batch_meet_the_boxes_of_their_frame(backend: str) -> None:
    points = torch.zeros(6, 5, dtype=F64)
    points[:, 3:] = NAN  # further columns do not matter
    boxes = boxes_of(box(x=9), box(), box(), box(x=1), box())
    frames, box_frames = torch.tensor([0, 2, 2, 3, 6]), torch.tensor([0, 2, 3, 3, 5])
    assert points_in_boxes(points, boxes, frames, box_frames).tolist() == [1, 1, -1, 3, 3, 3]
    assert points_in_boxes(points, boxes).tolist() == [1] * 6


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_points_are_those_of_shapely(backend: str, dtype: torch.dtype) -> None:
    shapely = pytest.importorskip("shapely")
    boxes = random_boxes(40, spread=5).to(dtype)
    points = ((torch.rand(3000, 3, generator=torch.Generator().manual_seed(0), dtype=F64) - 0.5) * 10).to(dtype)
    exact = points.double().numpy()
    inside = np.array(
        [
            shapely.contains_xy(polygon, exact[:, 0], exact[:, 1]) & (abs(exact[:, 2] - row[2]) <= row[5] / 2)
            for polygon, row in zip(
                shapely.polygons(corners_bev(boxes.double().numpy())), boxes.double().numpy(), strict=True
            )
        ]
    )
    assert 0.02 < inside.mean() < 0.3
    assert np.array_equal(points_in_boxes_mask(points, boxes).numpy(), inside)
    assert np.array_equal(points_in_boxes(points, boxes).numpy(), np.where(inside.any(0), inside.argmax(0), -1))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_points_of_a_scan_at_every_level(level: str, dtype: torch.dtype) -> None:
    """Tiles of the scan, most of which a box skips; boxes from a needle to one around everything."""
    points = lidar_points(30001).to(dtype)
    points[77, 0], points[99, 2], points[30000, 1] = NAN, INF, -INF
    boxes = random_boxes(60, spread=25).to(dtype)
    boxes[:, 2] = -1.0
    boxes[::7, 3] *= 10
    boxes[43, 3:6] = 500.0
    boxes[5] = NAN
    assert torch.equal(points_in_boxes_mask(points, boxes), reference.points_in_boxes_mask(points, boxes))
    frames, box_frames = torch.tensor([0, 40, 15000, 30001]), torch.tensor([0, 20, 40, 60])
    expected = reference.points_in_boxes(points, boxes, frames, box_frames)
    assert (expected >= 0).double().mean() > 0.3
    for threads in (1, 2, 7):
        torch.set_num_threads(threads)
        assert torch.equal(points_in_boxes(points, boxes, frames, box_frames), expected)


def test_more_boxes_than_a_tile(native: None) -> None:
    """In frames that begin and end within blocks of points and tiles of boxes; few points are in none."""
    boxes = random_boxes(300, spread=8)
    points = (torch.rand(700, 3, generator=torch.Generator().manual_seed(0), dtype=F64) - 0.5) * 16
    frames, box_frames = torch.tensor([0, 3, 3, 200, 450, 700]), torch.tensor([0, 130, 131, 131, 231, 300])
    assert torch.equal(points_in_boxes_mask(points, boxes), reference.points_in_boxes_mask(points, boxes))
    for offsets in ((), (frames, box_frames)):
        found = points_in_boxes(points, boxes, *offsets)
        assert torch.equal(found, reference.points_in_boxes(points, boxes, *offsets))
        assert 64 < found.max() < 300 and (found == -1).any()


def test_points_on_faces_of_lattice_boxes_are_inside(level: str) -> None:
    """Numbers that are exact: bounds of tiles cut nothing off."""
    grid = torch.arange(-12, 13, dtype=torch.float32) / 4
    points = torch.cartesian_prod(grid, grid, grid)
    boxes = boxes_of(box(x=0.25, y=-0.5, z=0.5, l=3, w=2, h=2.5), dtype=torch.float32)
    offset = (points.double() - boxes[0, :3]).abs()
    expected = (offset <= boxes[0, 3:6].double() / 2).all(dim=1)
    assert torch.equal(points_in_boxes_mask(points, boxes)[0], expected) and expected.sum() == 13 * 9 * 11


# All


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_half_precision_is_computed_as_float32(backend: str, dtype: torch.dtype) -> None:
    boxes, points = random_boxes(50).to(dtype), random_boxes(200)[:, :3].to(dtype)
    assert box_iou_3d(boxes, boxes).dtype == torch.float32
    assert torch.equal(box_iou_bev(boxes, boxes), box_iou_bev(boxes.float(), boxes.float()))
    scores = boxes[:, 0]
    assert torch.equal(nms_bev(boxes, scores, 0.2), nms_bev(boxes.float(), scores.float(), 0.2))
    assert torch.equal(points_in_boxes(points, boxes), points_in_boxes(points.float(), boxes.float()))


def test_empty(backend: str) -> None:
    none, some = torch.zeros(0, 7), boxes_of(box(), box(), dtype=torch.float32)
    for op in (box_iou_bev, box_iou_3d):
        assert op(none, some).shape == (0, 2) and op(some, none).shape == (2, 0) and op(none, none).shape == (0, 0)
        assert op(none, none, aligned=True).shape == (0,)
    assert nms_bev(none, torch.zeros(0), 0.5).shape == (0,)
    points = torch.zeros(3, 4)
    assert points_in_boxes(points, none).tolist() == [-1] * 3 and points_in_boxes(points[:0], some).shape == (0,)
    assert points_in_boxes_mask(points, none).shape == (0, 3) and points_in_boxes_mask(points[:0], some).shape == (2, 0)
    zero = torch.tensor([0])
    assert points_in_boxes(points[:0], none, zero, zero).shape == (0,)
    assert points_in_boxes(points, none, torch.tensor([0, 0, 3]), torch.tensor([0, 0, 0])).tolist() == [-1] * 3


def test_lattice_boxes_of_the_examples_have_no_iou_near_their_threshold() -> None:
    """So that examples.py asks for one answer in every dtype."""
    kinds = torch.cartesian_prod(*[torch.tensor([2.0, 4.0], dtype=F64)] * 2, torch.tensor([0.0, 0.5], dtype=F64))
    a = torch.zeros(8, 7, dtype=F64)
    a[:, 3:5], a[:, 5], a[:, 6] = kinds[:, :2], 2.0, kinds[:, 2]
    steps = torch.arange(-6, 7, dtype=F64)
    b = a.repeat(169, 1)
    b[:, :2] = torch.cartesian_prod(steps, steps).repeat_interleave(8, 0)
    assert (reference.box_iou_bev(a, b) - 0.3).abs().min() > 1e-5


def test_errors(backend: str) -> None:
    boxes, points = boxes_of(box(), box()), torch.zeros(3, 3, dtype=F64)
    for name, op in (("box_iou_bev", box_iou_bev), ("box_iou_3d", box_iou_3d)):
        with pytest.raises(ValueError, match=rf"{name}: boxes_b must have shape \[N, 7\], got \[2, 6\]"):
            op(boxes, boxes[:, :6])
        with pytest.raises(
            ValueError, match=rf"{name}: boxes_b must have shape \[2, 7\] as boxes_a if aligned, got \["
        ):
            op(boxes, boxes[:1], aligned=True)
        with pytest.raises(TypeError, match=f"{name}: boxes_b must have the dtype of boxes_a"):
            op(boxes, boxes.float())
    with pytest.raises(ValueError, match=r"nms_bev: scores must have shape \[2\] as boxes, got \[3\]"):
        nms_bev(boxes, torch.zeros(3, dtype=F64), 0.5)
    for wrong in (-0.1, 1.5, NAN):
        with pytest.raises(ValueError, match=rf"nms_bev: iou_threshold must be in \[0, 1\], got {wrong}"):
            nms_bev(boxes, boxes[:, 0], wrong)
    with pytest.raises(ValueError, match="nms_bev: pre_max must be at least 0, got -1"):
        nms_bev(boxes, boxes[:, 0], 0.5, pre_max=-1)
    with pytest.raises(TypeError, match="nms_bev: post_max must be an integer, got float"):
        nms_bev(boxes, boxes[:, 0], 0.5, post_max=2.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"points_in_boxes: points must have shape \[N, C\] with C >= 3, got \[3, 2\]"):
        points_in_boxes(points[:, :2], boxes)
    with pytest.raises(TypeError, match="points_in_boxes_mask: boxes must have the dtype of points"):
        points_in_boxes_mask(points.float(), boxes)
    frame = torch.tensor([0, 3])
    with pytest.raises(ValueError, match="points_in_boxes: box_offsets must be given with batch_offsets, got None"):
        points_in_boxes(points, boxes, frame)
    with pytest.raises(ValueError, match="points_in_boxes: batch_offsets must be given with box_offsets, got None"):
        points_in_boxes(points, boxes, None, frame)
    with pytest.raises(ValueError, match=r"points_in_boxes: box_offsets must ascend from 0 to M=2, got \[0, 3\]"):
        points_in_boxes(points, boxes, frame, frame)
    with pytest.raises(ValueError, match=r"points_in_boxes: box_offsets must have shape \[2\] as batch_offsets, got"):
        points_in_boxes(points, boxes, frame, torch.tensor([0, 1, 2]))


def test_direct_calls_are_checked(native: None) -> None:
    boxes, points, call = boxes_of(box(), box()), torch.zeros(3, 3, dtype=F64), torch.ops.pred
    with pytest.raises(KERNEL_ERROR, match=r"box_iou_bev: boxes_a must have shape \[N, 7\], got \[2, 6\]"):
        call.box_iou_bev(boxes[:, :6], boxes, False)
    with pytest.raises(KERNEL_ERROR, match="box_iou_3d: boxes_b must have as many rows as boxes_a, got 1 and 2"):
        call.box_iou_3d(boxes, boxes[:1], True)
    with pytest.raises(KERNEL_ERROR, match="nms_bev: iou_threshold must be in"):
        call.nms_bev(boxes, boxes[:, 0], NAN, None, None)
    with pytest.raises(KERNEL_ERROR, match="nms_bev: post_max must not be negative, got -2"):
        call.nms_bev(boxes, boxes[:, 0], 0.5, None, -2)
    with pytest.raises(KERNEL_ERROR, match=r"nms_bev: scores must have shape \[2\], got \[3\]"):
        call.nms_bev(boxes, points[:, 0], 0.5, None, None)
    with pytest.raises(KERNEL_ERROR, match="points_in_boxes: box_offsets must come with batch_offsets"):
        call.points_in_boxes(points, boxes, torch.tensor([0, 3]), None)
    with pytest.raises(KERNEL_ERROR, match=r"points_in_boxes_mask: points must have shape \[N, 3\], got \[3, 2\]"):
        call.points_in_boxes_mask(points[:, :2], boxes)


def test_offsets_are_checked(native: None) -> None:
    require_value_checks("native")
    boxes, points = boxes_of(box(), box()), torch.zeros(3, 3, dtype=F64)
    with pytest.raises(KERNEL_ERROR, match="points_in_boxes: box_offsets must ascend from 0 to M=2"):
        torch.ops.pred.points_in_boxes(points, boxes, torch.tensor([0, 3]), torch.tensor([0, 5]))
