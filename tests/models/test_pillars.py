# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Pillar encoder: OpenPCDet's names, hand-computed features, awkward inputs."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pred.models.encoders import PillarEncoder, PillarEncoderConfig

RANGE = (0.0, -4.0, -1.0, 8.0, 4.0, 3.0)
SMALL = PillarEncoderConfig(
    pillar_size=(1.0, 0.5),
    vfe_filters=[8, 8],
    layer_nums=[1, 1],
    layer_strides=[2, 2],
    num_filters=[8, 16],
    upsample_strides=[1, 2],
    num_upsample_filters=[4, 6],
)
BUFFERS = ("weight", "bias", "running_mean", "running_var")


def small_encoder() -> PillarEncoder:
    torch.manual_seed(0)
    return PillarEncoder(SMALL, RANGE)


def random_points(num_points: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(RANGE).view(2, 3)
    xyz = low + (high - low) * torch.rand(num_points, 3, generator=generator)
    return torch.cat([xyz, torch.rand(num_points, 2, generator=generator)], dim=1)


def test_state_dict_of_the_default_is_openpcdets() -> None:
    """Names and shapes of DynamicPillarVFE and BaseBEVBackbone in cbgs_dyn_pp_centerpoint."""
    expected: dict[str, tuple[int, ...]] = {}

    def expect(weight: str, norm: str, *shape: int, width: int) -> None:
        expected[f"{weight}.weight"] = shape
        expected.update({f"{norm}.{name}": (width,) for name in BUFFERS})
        expected[f"{norm}.num_batches_tracked"] = ()

    for layer, (width, before) in enumerate([(32, 11), (64, 64)]):
        name = f"vfe.pfn_layers.{layer}"
        expect(f"{name}.linear", f"{name}.norm", width, before, width=width)
    for block, (before, width, repeats) in enumerate([(64, 64, 3), (64, 128, 5), (128, 256, 5)]):
        for convolution in range(1 + repeats):
            index = 1 + 3 * convolution
            name = f"backbone_2d.blocks.{block}"
            channels = before if convolution == 0 else width
            expect(f"{name}.{index}", f"{name}.{index + 1}", width, channels, 3, 3, width=width)
    # The first is a convolution [out, in], the others are transposed ones [in, out].
    for block, shape in enumerate([(128, 64, 2, 2), (128, 128, 1, 1), (256, 128, 2, 2)]):
        name = f"backbone_2d.deblocks.{block}"
        expect(f"{name}.0", f"{name}.1", *shape, width=128)

    encoder = PillarEncoder(PillarEncoderConfig(), (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0))
    shapes = {name: tuple(value.shape) for name, value in encoder.state_dict().items()}
    assert shapes == expected
    assert list(shapes) == list(expected)
    assert encoder.out_channels == 384
    norms = [module for module in encoder.modules() if hasattr(module, "running_mean")]
    assert {(norm.eps, norm.momentum) for norm in norms} == {(1e-3, 0.01)}


def identity_features(filters: list[int]) -> PillarEncoder:
    """Encoder whose first point-wise layer passes the first inputs through."""
    config = PillarEncoderConfig((1.0, 0.5), filters, [0], [1], [2], [1], [2])
    encoder = PillarEncoder(config, RANGE).eval()
    weight = encoder.get_parameter("vfe.pfn_layers.0.linear.weight")
    with torch.no_grad():
        weight.copy_(torch.eye(*weight.shape))
    return encoder


def test_pillar_features_by_hand() -> None:
    encoder = identity_features([11])
    points = torch.tensor(
        [
            [2.25, -3.75, 0.5, 10.0, 0.0],
            [5.00, 3.75, 2.0, 7.0, 0.1],
            [2.75, -3.875, 1.5, 30.0, 0.2],  # shares the first one's pillar
        ]
    )
    features, coords = encoder.vfe(points, torch.tensor([0, 3]))
    # Pillar (row 0, column 2): centre (2.5, -3.75, 1), mean (2.5, -3.8125, 1).
    # Rows: x y z i dt | minus mean | minus centre; then ReLU and the maximum of the two points.
    first = [2.75, 0, 1.5, 30, 0.2] + [0.25, 0.0625, 0.5] + [0.25, 0, 0.5]
    # Pillar (row 15, column 5): centre (5.5, 3.75, 1), alone, so its mean is itself.
    second = [5, 3.75, 2, 7, 0.1] + [0, 0, 0] + [0, 0, 1]
    assert coords.tolist() == [[0, 0, 0, 2], [0, 0, 15, 5]]
    expected = torch.tensor([first, second]) / math.sqrt(1 + 1e-3)  # untrained batch norm
    torch.testing.assert_close(features, expected)


def test_a_layer_before_the_last_appends_the_pillar_maximum() -> None:
    encoder = identity_features([10, 10])
    points = torch.tensor([[2.25, -3.75, 0.5, 10.0, 0.0], [2.75, -3.875, 1.5, 3.0, 0.2]])
    pillar = torch.zeros(2, dtype=torch.int64)
    raw = torch.cat([points, torch.zeros(2, 6)], dim=1)
    out = encoder.vfe.pfn_layers[0](raw, pillar, 1)
    relu = points.clamp_min(0) / math.sqrt(1 + 1e-3)
    maximum = relu.amax(0, keepdim=True).expand(2, -1)
    torch.testing.assert_close(out, torch.cat([relu, maximum], dim=1))


def test_rows_are_y_and_columns_are_x() -> None:
    """A lone point changes the map exactly where its cell is; frames do not mix."""
    config = PillarEncoderConfig((1.0, 1.0), [8], [0], [1], [4], [1], [4])
    torch.manual_seed(0)
    encoder = PillarEncoder(config, (-4.0, -2.0, -1.0, 4.0, 2.0, 1.0)).eval()
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


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"num_filters": [8]}, "num_filters must have one entry per block"),
        ({"vfe_filters": []}, "vfe_filters must name at least one layer"),
        ({"vfe_filters": [7, 8]}, "vfe_filters must be even"),
        ({"pillar_size": (0.0, 1.0)}, "pillar_size must be positive"),
        ({"pillar_size": (math.nan, 1.0)}, "pillar_size must be positive"),
        ({"layer_nums": []}, "layer_nums must name at least one block"),
        ({"layer_nums": [1, -1]}, r"layer_nums must be at least 0 everywhere, got \[1, -1\]"),
        ({"vfe_filters": [8, 0]}, r"vfe_filters must be at least 1 everywhere, got \[8, 0\]"),
        ({"layer_strides": [0, 2]}, "layer_strides must be at least 1 everywhere"),
        ({"num_filters": [8, 0]}, "num_filters must be at least 1 everywhere"),
        ({"num_upsample_filters": [-4, 6]}, "num_upsample_filters must be at least 1 everywhere"),
        ({"upsample_strides": [0.0, 2]}, "upsample_strides must be positive and finite"),
        ({"upsample_strides": [1, math.nan]}, "upsample_strides must be positive and finite"),
        ({"upsample_strides": [1, math.inf]}, "upsample_strides must be positive and finite"),
    ],
)
def test_bad_configuration(changes: dict[str, object], message: str) -> None:
    sizes = {**vars(SMALL), **changes}
    with pytest.raises(ValueError, match=f"PillarEncoderConfig: {message}"):
        PillarEncoderConfig(**sizes)


def test_range_must_be_whole_pillars() -> None:
    with pytest.raises(ValueError, match="whole number of pillars in x, got 0.0 to 8.3"):
        PillarEncoder(SMALL, (0.0, -4.0, -1.0, 8.3, 4.0, 3.0))


def test_blocks_must_end_at_one_size() -> None:
    config = PillarEncoderConfig(**{**vars(SMALL), "upsample_strides": [1, 1]})
    with pytest.raises(ValueError, match=r"to one size, got \[\(8, 4\), \(4, 2\)\]"):
        PillarEncoder(config, RANGE)


@pytest.mark.parametrize("layer_strides, upsample_strides", [([8, 1], [1, 1]), ([4, 2], [1, 2]), ([4, 1], [0.5, 0.5])])
def test_blocks_must_have_more_than_one_cell(layer_strides: list[int], upsample_strides: list[float]) -> None:
    """Batch normalisation cannot train on one."""
    sizes = {**vars(SMALL), "pillar_size": (1.0, 1.0)}
    config = PillarEncoderConfig(**{**sizes, "layer_strides": layer_strides, "upsample_strides": upsample_strides})
    with pytest.raises(ValueError, match="every block of a 8 x 8 grid more than one cell"):
        PillarEncoder(config, RANGE)
