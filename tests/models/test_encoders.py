# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What holds for encoders of every family: published names, geometry, awkward frames, precision, errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pred.config import build, config_parser
from pred.data.batch import DataConfig
from pred.models.encoders import BEVBackboneConfig, DSVTConfig, Encoder, EncoderConfig, PillarConfig, VoxelConfig
from pred.pretrain import PretrainConfig, build_model

RANGE = (-8.0, -6.4, -3.0, 8.0, 6.4, 1.8)
BEV = BEVBackboneConfig(
    layer_nums=[1, 1], layer_strides=[1, 2], num_filters=[8, 12], upsample_strides=[1, 2], num_upsample_filters=[4, 6]
)
PILLARS = PillarConfig(pillar_size=(0.8, 0.4), vfe_filters=[8, 16])
VOXELS = VoxelConfig(voxel_size=(0.2, 0.1, 0.2), max_points=None)
DSVT = DSVTConfig(d_model=16, num_heads=2, ffn_channels=16, num_blocks=2, set_size=6, window=(5, 4))
FAMILIES = {
    "pillars": EncoderConfig(pillars=PILLARS, backbone_2d=BEV),
    "hard pillars": EncoderConfig(pillars=replace(PILLARS, max_points=4), backbone_2d=BEV),
    "voxels": EncoderConfig("voxels", voxels=VOXELS, backbone_2d=BEV),
    "hard voxels": EncoderConfig("voxels", voxels=replace(VOXELS, backbone="plain", max_points=3), backbone_2d=BEV),
    "dsvt": EncoderConfig("dsvt", pillars=PILLARS, dsvt=DSVT, backbone_2d=replace(BEV, kind="residual")),
}
MAP_SIZES = {
    "pillars": (32, 20),
    "hard pillars": (32, 20),
    "voxels": (16, 10),
    "hard voxels": (16, 10),
    "dsvt": (32, 20),
}


@pytest.fixture(params=FAMILIES)
def family(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def make(config: EncoderConfig, point_channels: int = 5) -> Encoder:
    torch.manual_seed(0)
    return Encoder(config, RANGE, point_channels)


def random_points(num_points: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(RANGE).view(2, 3)
    xyz = low + (high - low) * torch.rand(num_points, 3, generator=generator)
    return torch.cat([xyz, torch.rand(num_points, 2, generator=generator)], dim=1)


def parse(*arguments: str) -> PretrainConfig:
    parser = config_parser("test", "", PretrainConfig)
    config: PretrainConfig = build(parser, PretrainConfig, parser.parse_args(arguments))
    return config


@pytest.mark.parametrize(
    ("model", "arguments", "out_channels"),
    [
        ("pcdet_nus_dynpp", ["--config=nuscenes_pillars"], 384),
        ("pcdet_nus_pp", ["--config=nuscenes_hard_pillars"], 384),
        ("pcdet_nus_cp_vox01", ["--config=nuscenes_voxels"], 512),
        ("pcdet_nus_second", ["--config=nuscenes_voxels"], 512),
        (
            "pcdet_nus_tf",
            [
                "--config=nuscenes_voxels_0075",
                "--encoder.voxels.conv_bias=false",
                "--encoder.backbone_2d.conv_for_no_stride=true",
            ],
            512,
        ),
        ("dsvt_nus", ["--config=nuscenes_dsvt"], 384),
        ("pcdet_once_pp", ["--config=once_pillars"], 384),
        ("pcdet_once_cp", ["--config=once_voxels"], 512),
        ("pcdet_once_second", ["--config=once_second"], 512),
        ("pcdet_once_pvrcnn", ["--config=once_second", "--data.split=raw_large", "--train.epochs=3"], 512),
        # The guess for ONCE has the sizes of Waymo's, whose points have five channels (the fifth is elongation).
        ("dsvt_waymo", ["--config=once_dsvt", "--data.dataset=nuscenes"], 384),
        ("pcdet_waymo_dsvt", ["--config=once_dsvt", "--data.dataset=nuscenes"], 384),
    ],
)
def test_state_dicts_are_those_of_published_detectors(
    model: str,
    arguments: list[str],
    out_channels: int,
    published_encoder: Callable[[str], dict[str, tuple[tuple[int, ...], str]]],
) -> None:
    encoder = build_model(parse(*arguments)).encoder
    state = {name: (tuple(x.shape), str(x.dtype).removeprefix("torch.")) for name, x in encoder.state_dict().items()}
    expected = published_encoder(model)
    assert state == expected
    assert list(state) == list(expected)
    assert encoder.out_channels == out_channels


@pytest.mark.parametrize(
    ("name", "map_size", "voxel_size"),
    [
        ("nuscenes_pillars", (512, 512), (0.2, 0.2, 8.0)),
        ("nuscenes_voxels", (128, 128), (0.1, 0.1, 0.2)),
        ("nuscenes_voxels_0075", (180, 180), (0.075, 0.075, 0.2)),
        ("nuscenes_dsvt", (360, 360), (0.3, 0.3, 8.0)),
        ("once_pillars", (752, 752), (0.2, 0.2, 8.0)),
        ("once_voxels", (188, 188), (0.1, 0.1, 0.2)),
        ("once_dsvt", (468, 468), (0.32, 0.32, 8.0)),
    ],
)
def test_maps_before_the_2d_backbone(name: str, map_size: tuple[int, int], voxel_size: tuple[float, ...]) -> None:
    encoder = build_model(parse(f"--config={name}", "--encoder.bev=before_2d")).encoder.eval()
    assert encoder.voxel_size == voxel_size
    assert not any(key.startswith("backbone_2d") for key in encoder.state_dict())
    with torch.no_grad():
        bev = encoder(torch.tensor([[1.0, 2.0, 0.0, 0.5, 0.0]]), torch.tensor([0, 1]))
    assert bev.shape == (1, encoder.out_channels, *map_size)


@pytest.mark.parametrize(("dataset", "channels"), [("nuscenes", 5), ("once", 4), ("folder", 5)])
def test_the_data_set_decides_the_channels(dataset: str, channels: int) -> None:
    """And the encoder does as it says."""
    config = parse("--config=world_voxels", f"--data.dataset={dataset}", "--data.split=null")
    assert len(config.data.point_channels) == channels
    assert build_model(config).encoder.get_parameter("backbone_3d.conv_input.0.weight").shape == (16, 3, 3, 3, channels)
    assert DataConfig().point_channels == ("x_m", "y_m", "z_m", "intensity", "age_s")


def test_channels_beyond_its_own_do_not_matter(family: str) -> None:
    encoder = make(FAMILIES[family], 4).eval()
    points, offsets = random_points(80), torch.tensor([0, 80])
    bev = encoder(points, offsets)
    assert torch.equal(bev, encoder(points[:, :4], offsets))
    changed = points.clone()
    changed[:, 3] += 1
    assert not torch.equal(bev, encoder(changed, offsets))
    with pytest.raises(ValueError, match=r"points must have shape \[N, D\] with D of at least 4, got \[80, 3\]"):
        encoder(points[:, :3], offsets)


def test_rows_are_y_and_columns_are_x(family: str) -> None:
    """A lone point changes the map before the 2D backbone around its cell alone, in its own frame alone."""
    encoder = make(replace(FAMILIES[family], bev="before_2d")).eval()
    points = torch.tensor([[4.9, -2.1, 0.0, 1.0, 0.1]])
    bev = encoder(points, torch.tensor([0, 0, 1]))
    num_rows, num_columns = MAP_SIZES[family]
    assert bev.shape == (2, encoder.out_channels, num_rows, num_columns)
    assert not bev[0].any()
    row, column = int((-2.1 + 6.4) / 12.8 * num_rows), int((4.9 + 8) / 16 * num_columns)
    rows, columns = bev[1].any(0).nonzero(as_tuple=True)
    assert rows.numel() > 0
    # Strided convolutions spread a voxel over neighbouring outputs; a pillar stays where it is.
    spread = 1 if "voxels" in family else 0
    assert (rows - row).abs().max() <= spread and (columns - column).abs().max() <= spread


def test_the_2d_backbone_is_all_that_bev_before_2d_leaves_out(family: str) -> None:
    after = make(FAMILIES[family]).eval()
    before = make(replace(FAMILIES[family], bev="before_2d")).eval()
    lost = before.load_state_dict(after.state_dict(), strict=False)
    assert not lost.missing_keys and {key.split(".")[0] for key in lost.unexpected_keys} == {"backbone_2d"}
    points, offsets = random_points(150), torch.tensor([0, 100, 150])
    assert after.backbone_2d is not None
    torch.testing.assert_close(after.backbone_2d(before(points, offsets)), after(points, offsets))


def test_frames_are_independent(family: str, backend: str) -> None:
    encoder = make(FAMILIES[family]).eval()
    a, b = random_points(120, 1), random_points(60, 2)
    together = encoder(torch.cat([a, b]), torch.tensor([0, 120, 120, 180]))
    assert together.shape == (3, 10, *MAP_SIZES[family])
    for frame, points in enumerate([a, a[:0], b]):
        alone = encoder(points, torch.tensor([0, len(points)]))
        torch.testing.assert_close(together[frame], alone[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize(
    ("points", "offsets"),
    [
        (torch.zeros(0, 5), [0]),
        (torch.zeros(0, 5), [0, 0]),
        (random_points(3) + 100, [0, 3]),
        (torch.full((4, 5), math.nan), [0, 4]),
        (random_points(1), [0, 0, 1]),
        (random_points(50), [0, 50, 50]),
    ],
    ids=["no frame", "no points", "out of range", "NaN", "one point", "empty frame"],
)
def test_awkward_points(family: str, points: Tensor, offsets: list[int], training: bool, backend: str) -> None:
    encoder = make(FAMILIES[family]).train(training)
    bev = encoder(points, torch.tensor(offsets))
    assert bev.shape == (len(offsets) - 1, 10, *MAP_SIZES[family])
    assert bev.isfinite().all()
    bev.square().sum().backward()
    for name, parameter in encoder.named_parameters():
        # Attention over no pillars uses no parameter.
        assert parameter.grad is None or parameter.grad.isfinite().all(), name
    for name, value in encoder.state_dict().items():
        assert value.isfinite().all(), name


def test_every_parameter_gets_a_gradient(family: str) -> None:
    encoder = make(FAMILIES[family]).train()
    weight = torch.rand(10, *MAP_SIZES[family], generator=torch.Generator().manual_seed(1))
    (encoder(random_points(150), torch.tensor([0, 80, 150])) * weight).sum().backward()
    for name, parameter in encoder.named_parameters():
        # Batch normalisation takes a convolution's bias away again.
        if not (family == "voxels" and ".conv" in name and name.endswith("bias")):
            assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_native_equals_reference(family: str, native: None, monkeypatch: pytest.MonkeyPatch) -> None:
    results: list[list[Tensor]] = []
    for backend in ("native", "reference"):
        monkeypatch.setenv("PRED_BACKEND", backend)
        encoder = make(FAMILIES[family]).double().train()
        bev = encoder(random_points(200).double(), torch.tensor([0, 120, 200]))
        bev.square().mean().backward()
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in encoder.parameters()]
        results.append([bev, *gradients])
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-8, atol=1e-10)


def test_bf16_autocast_keeps_coordinates_exact(family: str, backend: str) -> None:
    encoder = make(FAMILIES[family]).train()
    points, offsets = random_points(300), torch.tensor([0, 300])
    expected_features, expected_coords = encoder.vfe(points, offsets)
    expected = encoder(points, offsets)
    features: list[Tensor] = []
    encoder.vfe.register_forward_hook(lambda module, arguments, output: features.extend(output))
    with torch.autocast("cpu", torch.bfloat16):
        bev = encoder(points, offsets)
    assert torch.equal(features[0], expected_features) and torch.equal(features[1], expected_coords)
    assert bev.dtype == torch.bfloat16
    # Two digits, some ten layers on end.
    assert (bev.float() - expected).norm() < 0.03 * expected.norm()
    bev.float().square().mean().backward()
    assert all(p.grad is None or (p.grad.dtype == p.dtype and p.grad.isfinite().all()) for p in encoder.parameters())


@pytest.mark.parametrize("family", ["pillars", "voxels", "dsvt"])
def test_point_order_does_not_matter_to_dynamic_features(family: str) -> None:
    encoder = make(FAMILIES[family]).eval()
    points = random_points(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    offsets = torch.tensor([0, 300])
    torch.testing.assert_close(encoder(points, offsets), encoder(points[order], offsets), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("config_class", "changes", "message"),
    [
        (PillarConfig, {"vfe_filters": []}, "vfe_filters must name at least one layer"),
        (PillarConfig, {"vfe_filters": [7, 8]}, "vfe_filters must be even"),
        (PillarConfig, {"vfe_filters": [8, 0]}, r"vfe_filters must be at least 1 everywhere, got \[8, 0\]"),
        (PillarConfig, {"pillar_size": (0.0, 1.0)}, "pillar_size must be 2 positive lengths"),
        (PillarConfig, {"pillar_size": (math.nan, 1.0)}, "pillar_size must be 2 positive lengths"),
        (PillarConfig, {"max_points": 0}, "max_points must be at least 1 or None, got 0"),
        (PillarConfig, {"max_pillars": (5, 0)}, r"max_pillars must be 2 numbers of at least 1, got \(5, 0\)"),
        (VoxelConfig, {"voxel_size": (0.1, 0.1, -0.2)}, r"voxel_size must be 3 positive lengths, got .*-0.2"),
        (VoxelConfig, {"max_points": -1}, "max_points must be at least 1 or None, got -1"),
        (VoxelConfig, {"max_voxels": (0, 5)}, r"max_voxels must be 2 numbers of at least 1, got \(0, 5\)"),
        (BEVBackboneConfig, {"num_filters": [8]}, "num_filters must have one entry per block"),
        (BEVBackboneConfig, {"layer_nums": []}, "layer_nums must name at least one block"),
        (BEVBackboneConfig, {"layer_nums": [3, 5, -1]}, r"layer_nums must be at least 0 everywhere"),
        (BEVBackboneConfig, {"layer_strides": [0, 2, 2]}, "layer_strides must be at least 1 everywhere"),
        (BEVBackboneConfig, {"num_filters": [8, 8, 0]}, "num_filters must be at least 1 everywhere"),
        (BEVBackboneConfig, {"num_upsample_filters": [-4, 6, 6]}, "num_upsample_filters must be at least 1 everywhere"),
        (BEVBackboneConfig, {"upsample_strides": [0.0, 1, 2]}, "upsample_strides must be positive and finite"),
        (BEVBackboneConfig, {"upsample_strides": [1, 2, math.nan]}, "upsample_strides must be positive and finite"),
        (BEVBackboneConfig, {"upsample_strides": [1, 2, math.inf]}, "upsample_strides must be positive and finite"),
        (EncoderConfig, {"kind": "dsvt"}, r"pillars.vfe_filters must end with dsvt.d_model = 128, got \[64, 64\]"),
    ],
)
def test_bad_configuration(config_class: type[Any], changes: dict[str, Any], message: str) -> None:
    config_class()
    with pytest.raises(ValueError, match=f"{config_class.__name__}: {message}"):
        config_class(**changes)


@pytest.mark.parametrize(
    ("config", "point_range", "message"),
    [
        (FAMILIES["pillars"], (-8.0, -6.4, -3.0, 8.3, 6.4, 1.8), "whole number of cells in x, got -8.0 to 8.3 at 0.8"),
        (FAMILIES["voxels"], (-8.0, -6.4, -3.0, 8.0, 6.4, 1.9), "whole number of cells in z, got -3.0 to 1.9 at 0.2"),
        (
            FAMILIES["voxels"],
            (-8.0, -6.4, -3.0, 8.0, 6.4, 1.6),
            "VoxelResBackBone8x: voxel_size must divide the range box into at least 24 layers in z, got 23",
        ),
    ],
)
def test_range_must_suit_the_cells(config: EncoderConfig, point_range: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Encoder(config, point_range)


def test_points_have_at_least_coordinates() -> None:
    with pytest.raises(ValueError, match="point_channels must be at least 3"):
        make(FAMILIES["pillars"], 2)


@pytest.mark.parametrize("kind", ["plain", "residual"])
def test_blocks_must_end_at_one_size(kind: Any) -> None:
    config = replace(FAMILIES["pillars"], backbone_2d=replace(BEV, kind=kind, upsample_strides=[1, 1]))
    with pytest.raises(ValueError, match=r"BaseBEV\w*Backbone: .*to one size, got \[\(32, 20\), \(16, 10\)\]"):
        make(config)


@pytest.mark.parametrize(
    ("layer_strides", "upsample_strides"), [([32, 1], [1, 1]), ([16, 2], [1, 2]), ([16, 1], [0.5, 0.5])]
)
def test_blocks_must_have_more_than_one_cell(layer_strides: list[int], upsample_strides: list[float]) -> None:
    """Batch normalisation cannot train on one."""
    backbone = replace(BEV, layer_strides=layer_strides, upsample_strides=upsample_strides)
    with pytest.raises(ValueError, match="every block of a 32 x 20 grid more than one cell"):
        make(replace(FAMILIES["pillars"], backbone_2d=backbone))


@pytest.mark.parametrize(
    "make,text",
    [
        (lambda: BEVBackboneConfig(upsample_strides=[0.5, 1.4, 2]), "upsample_strides must be whole numbers or 1 over"),
        (lambda: PillarConfig(pillar_size=(1.0,)), "pillar_size must be 2 positive lengths"),  # type: ignore[arg-type]
        (lambda: PillarConfig(pillar_size=(math.inf, 1.0)), "pillar_size must be 2 positive lengths"),
        (lambda: PillarConfig(max_pillars=(5,)), "max_pillars must be 2 numbers"),  # type: ignore[arg-type]
        (lambda: VoxelConfig(voxel_size=(0.1, 0.1)), "voxel_size must be 3 positive lengths"),  # type: ignore[arg-type]
        (lambda: VoxelConfig(max_voxels=(5,)), "max_voxels must be 2 numbers"),  # type: ignore[arg-type]
        (lambda: VoxelConfig(backbone="plain", conv_bias=False), "conv_bias must be left out for the plain backbone"),
        (
            lambda: EncoderConfig("dsvt", pillars=PillarConfig(vfe_filters=[128], max_points=20)),
            "pillars.max_points must be None for dsvt",
        ),
    ],
)
def test_sizes_that_do_not_go_together(make: Callable[[], object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make()


def test_offsets_are_named_as_the_caller_names_them() -> None:
    encoder = Encoder(
        EncoderConfig(pillars=PillarConfig(vfe_filters=[8]), bev="before_2d"), (-3.2, -3.2, -1, 3.2, 3.2, 1)
    )
    points = torch.zeros(4, 5)
    with pytest.raises(ValueError, match=r"Encoder: point_offsets must have shape \[B \+ 1\], got \[\]"):
        encoder(points, torch.tensor(4))
    with pytest.raises(ValueError, match="Encoder: point_offsets must ascend from 0 to N=4"):
        encoder(points, torch.tensor([0, 5]))
    with pytest.raises(TypeError, match="Encoder: point_offsets must be int64"):
        encoder(points, torch.tensor([0, 4], dtype=torch.int32))


def test_sync_batch_norm_is_refused_by_name() -> None:
    config = DSVTConfig(d_model=8, num_heads=2, ffn_channels=8, num_blocks=2, set_size=4, window=(4, 4))
    encoder = Encoder(
        EncoderConfig("dsvt", bev="before_2d", pillars=PillarConfig(vfe_filters=[8]), dsvt=config),
        (-3.2, -3.2, -1, 3.2, 3.2, 1),
    )
    converted = torch.nn.SyncBatchNorm.convert_sync_batchnorm(encoder).eval()
    with pytest.raises(TypeError, match="DSVT: position_embedding_head.1 must be nn.BatchNorm1d, got SyncBatchNorm"):
        converted(torch.rand(20, 5), torch.tensor([0, 20]))
