# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Dynamic pillars: hand-computed features, awkward inputs."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pred.models.encoders import BEVBackboneConfig, Encoder, EncoderConfig, PillarConfig
from pred.models.encoders.pillars import DynamicPillarVFE

RANGE = (0.0, -4.0, -1.0, 8.0, 4.0, 3.0)
SMALL = EncoderConfig(
    pillars=PillarConfig(pillar_size=(1.0, 0.5), vfe_filters=[8, 8]),
    backbone_2d=BEVBackboneConfig(
        layer_nums=[1, 1],
        layer_strides=[2, 2],
        num_filters=[8, 16],
        upsample_strides=[1, 2],
        num_upsample_filters=[4, 6],
    ),
)


def small_encoder() -> Encoder:
    torch.manual_seed(0)
    return Encoder(SMALL, RANGE)


def random_points(num_points: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(RANGE).view(2, 3)
    xyz = low + (high - low) * torch.rand(num_points, 3, generator=generator)
    return torch.cat([xyz, torch.rand(num_points, 2, generator=generator)], dim=1)


def identity_features(filters: list[int]) -> DynamicPillarVFE:
    """Features whose first point-wise layer passes the first inputs through."""
    vfe = DynamicPillarVFE(PillarConfig((1.0, 0.5), filters), 5, (1.0, 0.5, 4.0), RANGE).eval()
    weight = vfe.get_parameter("pfn_layers.0.linear.weight")
    with torch.no_grad():
        weight.copy_(torch.eye(*weight.shape))
    return vfe


def test_pillar_features_by_hand() -> None:
    vfe = identity_features([11])
    points = torch.tensor(
        [
            [2.25, -3.75, 0.5, 10.0, 0.0],
            [5.00, 3.75, 2.0, 7.0, 0.1],
            [2.75, -3.875, 1.5, 30.0, 0.2],  # shares the first one's pillar
        ]
    )
    features, coords = vfe(points, torch.tensor([0, 3]))
    # Pillar (row 0, column 2): centre (2.5, -3.75, 1), mean (2.5, -3.8125, 1).
    # Rows: x y z i dt | minus mean | minus centre; then ReLU and the maximum of the two points.
    first = [2.75, 0, 1.5, 30, 0.2] + [0.25, 0.0625, 0.5] + [0.25, 0, 0.5]
    # Pillar (row 15, column 5): centre (5.5, 3.75, 1), alone, so its mean is itself.
    second = [5, 3.75, 2, 7, 0.1] + [0, 0, 0] + [0, 0, 1]
    assert coords.tolist() == [[0, 0, 0, 2], [0, 0, 15, 5]]
    expected = torch.tensor([first, second]) / math.sqrt(1 + 1e-3)  # untrained batch norm
    torch.testing.assert_close(features, expected)


def test_a_layer_before_the_last_appends_the_pillar_maximum() -> None:
    vfe = identity_features([10, 5])
    with torch.no_grad():  # the second layer: the appended maximum less the point's own value
        vfe.get_parameter("pfn_layers.1.linear.weight").copy_(torch.cat([-torch.eye(5), torch.eye(5)], dim=1))
    points = torch.tensor([[2.25, -3.75, 0.5, 10.0, 0.0], [2.75, -3.875, 1.5, 3.0, 0.2]])
    features, _ = vfe(points, torch.tensor([0, 2]))
    relu = points.clamp_min(0)
    # Each untrained batch norm divides by sqrt(1 + eps).
    torch.testing.assert_close(features, (relu.amax(0) - relu.amin(0))[None] / (1 + 1e-3))


def test_rows_are_y_and_columns_are_x() -> None:
    """A lone point changes the map exactly where its cell is; frames do not mix."""
    config = EncoderConfig(
        pillars=PillarConfig((1.0, 1.0), [8]), backbone_2d=BEVBackboneConfig("plain", [0], [1], [4], [1], [4])
    )
    torch.manual_seed(0)
    encoder = Encoder(config, (-4.0, -2.0, -1.0, 4.0, 2.0, 1.0)).eval()
    points = torch.tensor([[1.5, -1.5, 0.0, 1.0, 0.0]])  # column 5, row 0
    bev = encoder(points, torch.tensor([0, 0, 1]))
    empty = encoder(points[:0], torch.tensor([0, 0, 0]))
    changed = (bev - empty).abs().amax(1) > 0
    assert bev.shape == (2, 4, 4, 8)
    assert not changed[0].any()
    rows, columns = changed[1].nonzero(as_tuple=True)
    # One 3x3 convolution: the cell and its neighbours, cut off by the lower edge.
    assert rows.min() == 0 and rows.max() <= 1 and columns.min() >= 4 and columns.max() <= 6
    assert changed[1, 0, 5]


def test_frames_are_independent(backend: str) -> None:
    encoder = small_encoder().eval()
    a, b = random_points(200, 1), random_points(100, 2)
    together = encoder(torch.cat([a, b]), torch.tensor([0, 200, 200, 300]))
    assert together.shape == (3, 10, 8, 4)
    for frame, points in enumerate([a, a[:0], b]):
        alone = encoder(points, torch.tensor([0, len(points)]))
        torch.testing.assert_close(together[frame], alone[0], rtol=1e-5, atol=1e-5)


def test_point_order_does_not_matter() -> None:
    encoder = small_encoder().eval()
    points = random_points(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    offsets = torch.tensor([0, 300])
    torch.testing.assert_close(encoder(points, offsets), encoder(points[order], offsets))


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize(
    "points, offsets",
    [
        (torch.zeros(0, 5), [0, 0]),
        (random_points(3) + 100, [0, 3]),
        (torch.full((4, 5), math.nan), [0, 4]),
        (random_points(1), [0, 1]),
        (random_points(1), [0, 0, 1]),
        (random_points(50), [0, 50, 50]),
        (torch.cat([random_points(2), torch.full((1, 5), math.inf)]), [0, 3]),
    ],
    ids=["no points", "out of range", "NaN", "one point", "one point, empty frame", "empty frame", "Inf"],
)
def test_awkward_points(points: Tensor, offsets: list[int], training: bool, backend: str) -> None:
    encoder = small_encoder().train(training)
    bev = encoder(points, torch.tensor(offsets))
    assert bev.shape == (len(offsets) - 1, 10, 8, 4)
    assert bev.isfinite().all()
    bev.square().sum().backward()
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
    for name, value in encoder.state_dict().items():
        assert value.isfinite().all(), name


def test_fewer_than_two_points_leave_the_running_statistics_alone() -> None:
    encoder = small_encoder().train()
    before = {name: value.clone() for name, value in encoder.vfe.state_dict().items()}
    encoder(random_points(1), torch.tensor([0, 1]))
    encoder(random_points(0), torch.tensor([0, 0]))
    assert all(torch.equal(value, before[name]) for name, value in encoder.vfe.state_dict().items())
    encoder(random_points(2), torch.tensor([0, 2]))
    assert encoder.get_buffer("vfe.pfn_layers.0.norm.num_batches_tracked") == 1


def test_out_of_range_points_change_nothing() -> None:
    encoder = small_encoder().train()
    inside = random_points(100)
    outside = random_points(20) + torch.tensor([0, 0, 50.0, 0, 0])
    torch.testing.assert_close(
        encoder(torch.cat([outside, inside]), torch.tensor([0, 120])),
        encoder(inside, torch.tensor([0, 100])),
    )


def test_native_equals_reference(monkeypatch: pytest.MonkeyPatch, native: None) -> None:
    results = []
    for backend in ("native", "reference"):
        monkeypatch.setenv("PRED_BACKEND", backend)
        encoder = small_encoder().train()
        bev = encoder(random_points(500), torch.tensor([0, 300, 500]))
        bev.square().mean().backward()
        results.append([bev, *(parameter.grad for parameter in encoder.parameters())])
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-6)


def test_bf16_autocast_keeps_coordinates_exact() -> None:
    encoder = small_encoder().eval()
    points, offsets = random_points(300), torch.tensor([0, 300])
    with torch.autocast("cpu", torch.bfloat16):
        features, _ = encoder.vfe(points, offsets)
        bev = encoder(points, offsets)
    assert features.dtype == torch.float32
    assert bev.dtype == torch.bfloat16
    expected = encoder(points, offsets)
    assert (bev.float() - expected).norm() < 0.02 * expected.norm()
