# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Our encoders in the layouts of other frameworks, on the state dicts of the frameworks' own models."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.plain_dsvt import PlainDSVT
from pred.checkpoint_layouts import (
    FRAMEWORKS,
    LayoutError,
    LayoutOptions,
    export_state,
    import_state,
    layout,
    shapes_of,
)
from pred.export_check import specs_of
from pred.models.encoders import BEVBackboneConfig, DSVTConfig, Encoder, EncoderConfig, PillarConfig
from pred.models.encoders.dsvt import DSVT
from pred.models.encoders.voxels import HeightCompression, VoxelBackBone8x, VoxelResBackBone8x
from tests.framework_layouts import (
    MODELS,
    Mmdet3dBevBackbone,
    Mmdet3dSparseEncoder,
    OpenPCDetBevBackbone,
    OpenPCDetVoxelBackbone,
    encoder_specs,
    random_state,
)

BIASED = ("pcdet_nus_cp_vox01", "pcdet_nus_second", "pcdet_once_cp")
SECOND_2D: dict[str, Any] = {
    "widths": [128, 256],
    "strides": [1, 2],
    "layers": [5, 5],
    "ups": [1, 2],
    "outs": [256, 256],
}
BACKBONES_2D: dict[str, dict[str, Any]] = {
    "pcdet_nus_second": {"before": 256, **SECOND_2D},
    "pcdet_nus_dynpp": {
        "before": 64, "widths": [64, 128, 256], "strides": [2, 2, 2], "layers": [3, 5, 5], "ups": [0.5, 1, 2],
        "outs": [128, 128, 128],
    },
    "pcdet_once_pp": {
        "before": 64, "widths": [64, 128, 256], "strides": [2, 2, 2], "layers": [3, 5, 5], "ups": [1, 2, 4],
        "outs": [128, 128, 128],
    },
    "dsvt_nus": {
        "before": 128, "widths": [128, 128, 256], "strides": [1, 2, 2], "layers": [1, 2, 2], "ups": [0.5, 1, 2],
        "outs": [128, 128, 128], "residual": True,
    },
    "dsvt_waymo": {
        "before": 192, "widths": [128, 128, 256], "strides": [1, 2, 2], "layers": [1, 2, 2], "ups": [1, 2, 4],
        "outs": [128, 128, 128], "residual": True,
    },
}  # fmt: skip


def encoder_state(model: str) -> dict[str, Tensor]:
    return random_state(encoder_specs(model))


def part(state: dict[str, Tensor], module: str) -> dict[str, Tensor]:
    return {name.removeprefix(f"{module}."): value for name, value in state.items() if name.startswith(f"{module}.")}


def some_sites(point_channels: int) -> tuple[Tensor, Tensor]:
    """A small grid of 41 cells in z with a tenth of them active."""
    generator = torch.Generator().manual_seed(1)
    active = (torch.rand(1, 1, 41, 12, 12, generator=generator) < 0.1).double()
    return torch.randn(1, point_channels, 41, 12, 12, generator=generator, dtype=torch.float64) * active, active


def load_as_openpcdet(model: nn.Module, state: dict[str, Tensor]) -> None:
    """What detector3d_template.py does: kernels whose shape differs are turned, what still differs is left out."""
    own, taken = model.state_dict(), {}
    for name, value in state.items():
        if name in own and own[name].shape != value.shape and value.dim() == 5:
            swapped = value.transpose(-1, -2)
            value = swapped if swapped.shape == own[name].shape else value.permute(4, 0, 1, 2, 3)
        if name in own and own[name].shape == value.shape:
            taken[name] = value
    assert taken.keys() == own.keys()
    model.load_state_dict(taken)


# Frameworks rebuilt


@pytest.mark.parametrize("model", BIASED + ("pcdet_nus_tf", "pcdet_once_second", "pcdet_once_pvrcnn"))
def test_voxel_backbones_compute_the_same_in_openpcdet_and_mmdetection3d(model: str) -> None:
    state = encoder_state(model)
    channels = state["backbone_3d.conv_input.0.weight"].shape[-1]
    residual = "backbone_3d.conv1.0.conv1.weight" in state
    reference = OpenPCDetVoxelBackbone(channels, residual, bias=model in BIASED)
    reference.load_state_dict(part(state, "backbone_3d"))
    openpcdet = OpenPCDetVoxelBackbone(channels, residual, bias=model in BIASED)
    load_as_openpcdet(openpcdet, part(export_state(state, "openpcdet"), "backbone_3d"))
    mmdet3d = Mmdet3dSparseEncoder(channels, residual)
    mmdet3d.load_state_dict(part(export_state(state, "mmdet3d"), "pts_middle_encoder"))
    sites = some_sites(channels)
    with torch.no_grad():
        expected, *others = (network.double().eval()(sites) for network in (reference, openpcdet, mmdet3d))
    assert expected.shape == (1, 256, 2, 2) and (expected > 0).double().mean() > 0.02
    assert torch.equal(others[0], expected)
    # running_mean - bias is rounded to float32.
    torch.testing.assert_close(others[1], expected, rtol=1e-5, atol=1e-6)
    if model not in BIASED:
        assert torch.equal(others[1], expected)


@pytest.mark.parametrize("stride1_conv", [True, False])
@pytest.mark.parametrize("model", BACKBONES_2D)
def test_2d_backbones_compute_the_same_in_openpcdet_and_mmdetection3d(model: str, stride1_conv: bool) -> None:
    state, sizes = encoder_state(model), BACKBONES_2D[model]
    prefix = "" if model.startswith("dsvt") else "pts_"
    exported = export_state(state, "mmdet3d", LayoutOptions(stride1_conv=stride1_conv))
    openpcdet = OpenPCDetBevBackbone(**sizes)
    load_as_openpcdet(openpcdet, part(export_state(state, "openpcdet"), "backbone_2d"))
    mmdet3d = Mmdet3dBevBackbone(prefix, **sizes, stride1_conv=stride1_conv)
    modules = (f"{prefix}backbone.", f"{prefix}neck.")
    mmdet3d.load_state_dict({name: value for name, value in exported.items() if name.startswith(modules)})
    x = torch.randn(1, sizes["before"], 16, 16, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        expected, actual = openpcdet.eval()(x), mmdet3d.eval()(x)
    assert expected.abs().max() > 0.1
    # Conv2d and ConvTranspose2d of stride 1 sum in their own order.
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


def test_a_deblock_that_is_not_transposed_computes_something_else() -> None:
    """128 channels in and out: no shape tells, so that a wrong option would go unnoticed."""
    state, sizes = encoder_state("pcdet_nus_dynpp"), BACKBONES_2D["pcdet_nus_dynpp"]
    right, wrong = (export_state(state, "mmdet3d", LayoutOptions(stride1_conv=conv)) for conv in (True, False))
    assert shapes_of(right) == shapes_of(wrong)
    x = torch.randn(1, 64, 8, 8, generator=torch.Generator().manual_seed(2))
    outputs = []
    for exported in (right, wrong):
        network = Mmdet3dBevBackbone("pts_", **sizes)
        network.load_state_dict({name: value for name, value in exported.items() if "voxel_encoder" not in name})
        with torch.no_grad():
            outputs.append(network.eval()(x))
    assert not torch.allclose(outputs[0], outputs[1], atol=1e-2)


@pytest.mark.parametrize("dynamic", [False, True])
def test_pillar_networks_have_the_names_of_mmdetection3d(dynamic: bool) -> None:
    state = encoder_state("pcdet_nus_dynpp")
    exported = export_state(state, "mmdet3d", LayoutOptions(dynamic_pillars=dynamic))
    layers = nn.ModuleList()
    for before, after in ((11, 32), (64, 64)):
        linear, norm = nn.Linear(before, after, bias=False), nn.BatchNorm1d(after, eps=1e-3)
        named = {"linear": linear, "norm": norm}
        layers.append(nn.Sequential(linear, norm, nn.ReLU()) if dynamic else nn.ModuleDict(named))
    network = nn.Module()
    network.pfn_layers = layers
    network.load_state_dict(part(exported, "pts_voxel_encoder"))
    for place, name in enumerate(("linear", "norm")):
        for layer in range(2):
            weight = network.state_dict()[f"pfn_layers.{layer}.{place if dynamic else name}.weight"]
            assert torch.equal(weight, state[f"vfe.pfn_layers.{layer}.{name}.weight"])


# Frameworks rebuilt, from points to the map


class PlainPillars(nn.Module):
    """DynamicPillarVFE (names ``linear``, ``norm``) or DynamicPillarFeatureNet (``0``, ``1``), pillar by pillar."""

    def __init__(self, names: tuple[str, str], widths: list[tuple[int, int]]) -> None:
        super().__init__()
        layers = (
            {names[0]: nn.Linear(*width, bias=False), names[1]: nn.BatchNorm1d(width[1], eps=1e-3)} for width in widths
        )
        self.pfn_layers = nn.ModuleList(nn.ModuleDict(layer) for layer in layers)

    def forward(self, points: Tensor, size: tuple[float, ...], low: tuple[float, ...], grid: tuple[int, int]) -> Tensor:
        """Map [1, C, ny, nx] of one frame's points [N, D], all inside the range."""
        cells = ((points[:, :3] - torch.tensor(low)) / torch.tensor(size)).floor()
        centres = (cells + 0.5) * torch.tensor(size) + torch.tensor(low)
        canvas = None
        for cell in torch.unique(cells, dim=0):
            inside = (cells == cell).all(dim=1)
            own = points[inside]
            features = torch.cat([own, own[:, :3] - own[:, :3].mean(0), own[:, :3] - centres[inside]], dim=1)
            for number, layer in enumerate(self.pfn_layers, start=1):
                assert isinstance(layer, nn.ModuleDict)
                linear, norm = layer.values()
                features = F.relu(norm(linear(features)))
                largest = features.max(dim=0).values
                if number < len(self.pfn_layers):
                    features = torch.cat([features, largest.expand_as(features)], dim=1)
            if canvas is None:
                canvas = features.new_zeros(1, len(largest), *grid)
            canvas[0, :, int(cell[1]), int(cell[0])] = largest
        assert canvas is not None
        return canvas


@pytest.mark.parametrize("conv_here", [False, True])
@pytest.mark.parametrize("to", ["openpcdet", "dsvt", "mmdet3d", "mmdet3d dynamic"])
def test_pillar_encoder_computes_the_same_in_each_framework(to: str, conv_here: bool, backend: str) -> None:
    config = EncoderConfig(
        pillars=PillarConfig(pillar_size=(0.8, 0.8), vfe_filters=[16, 24]),
        backbone_2d=BEVBackboneConfig(
            layer_nums=[1, 2], layer_strides=[2, 2], num_filters=[16, 32], upsample_strides=[1, 2],
            num_upsample_filters=[24, 16], conv_for_no_stride=conv_here,
        ),
    )  # fmt: skip
    point_range = (-6.4, -9.6, -3.0, 6.4, 9.6, 3.0)
    torch.manual_seed(0)
    encoder = Encoder(config, point_range).eval()
    specs = specs_of(encoder.state_dict())
    encoder.load_state_dict(random_state(specs))
    low, high = torch.tensor(point_range[:3]), torch.tensor(point_range[3:])
    points = torch.rand(300, 5) * torch.cat([high - low, torch.tensor([255.0, 0.5])]) + F.pad(low, (0, 2))
    framework: Any = to.split()[0]
    dynamic = to.endswith("dynamic")
    options = LayoutOptions(dynamic_pillars=dynamic, stride1_conv=True if framework == "mmdet3d" else False)
    exported = export_state(encoder.state_dict(), framework, options, conv_here)
    prefix = "pts_voxel_encoder." if framework == "mmdet3d" else "vfe."
    pillars = PlainPillars(("0", "1") if dynamic else ("linear", "norm"), [(11, 8), (16, 24)])
    pillars.load_state_dict({name.removeprefix(prefix): x for name, x in exported.items() if name.startswith(prefix)})
    sizes: dict[str, Any] = {
        "before": 24, "widths": [16, 32], "strides": [2, 2], "layers": [1, 2], "ups": [1, 2], "outs": [24, 16],
    }  # fmt: skip
    if framework == "mmdet3d":
        backbone: nn.Module = Mmdet3dBevBackbone("pts_", **sizes)
        rest = {name: value for name, value in exported.items() if not name.startswith(prefix)}
    else:
        backbone = OpenPCDetBevBackbone(**sizes)
        rest = {name.removeprefix("backbone_2d."): x for name, x in exported.items() if not name.startswith(prefix)}
    backbone.load_state_dict(rest)
    with torch.no_grad():
        expected = encoder(points, torch.tensor([0, len(points)]))
        canvas = pillars.eval()(points, encoder.voxel_size, point_range[:3], (24, 16))
        actual = backbone.eval()(canvas)
    assert expected.shape == (1, 40, 12, 8) and expected.std() > 0.1
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("variant", ["plain", "residual", "residual with biases"])
def test_voxel_backbones_compute_the_same_in_each_framework(variant: str, native: None) -> None:
    biases = variant.endswith("biases")
    backbone: nn.Module
    if variant == "plain":
        backbone = VoxelBackBone8x(4, (40, 12, 12))
    else:
        backbone = VoxelResBackBone8x(4, (40, 12, 12), biases)
    backbone.load_state_dict(random_state(specs_of(backbone.state_dict())))
    state = {f"backbone_3d.{name}": value for name, value in backbone.state_dict().items()}
    openpcdet = OpenPCDetVoxelBackbone(4, variant != "plain", biases)
    load_as_openpcdet(openpcdet, part(export_state(state, "openpcdet"), "backbone_3d"))
    mmdet3d = Mmdet3dSparseEncoder(4, variant != "plain")
    mmdet3d.load_state_dict(part(export_state(state, "mmdet3d"), "pts_middle_encoder"))
    features, active = some_sites(4)
    coords = active[:, 0].nonzero()
    values = features.permute(0, 2, 3, 4, 1)[active[:, 0] > 0].float()
    with torch.no_grad():
        actual = HeightCompression()(backbone.eval()(values, coords, 1))
        for network in (openpcdet, mmdet3d):
            expected = network.double().eval()((features, active))
            assert expected.shape == (1, 256, 2, 2) and expected.std() > 0.05
            torch.testing.assert_close(actual.double(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("to", FRAMEWORKS)
def test_dsvt_computes_the_same_in_each_framework(to: Any) -> None:
    """Against DSVT as published, under the names of the framework."""
    config = DSVTConfig(d_model=16, num_heads=2, ffn_channels=24, num_blocks=2, set_size=7, window=(4, 4))
    backbone = DSVT(config, (12, 16))
    backbone.load_state_dict(random_state(specs_of(backbone.state_dict())))
    state = {f"backbone_3d.{name}": value for name, value in backbone.state_dict().items()}
    published = PlainDSVT(config, (12, 16))
    published.load_state_dict(part(export_state(state, to), "middle_encoder" if to == "mmdet3d" else "backbone_3d"))
    cells = torch.randperm(12 * 16, generator=torch.Generator().manual_seed(0))[:90].sort().values
    coords = torch.stack([torch.zeros_like(cells), torch.zeros_like(cells), cells // 16, cells % 16], dim=1)
    features = torch.randn(90, 16, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        expected, actual = (network.eval()(features, coords, 1) for network in (published, backbone))
    assert expected.std() > 0.1
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


# Tables


def test_names_and_shapes_of_mmdetection3d_by_hand() -> None:
    """One of each way in which a tensor changes."""
    layers = "pts_middle_encoder.encoder_layers.encoder_layer"
    expected = {
        "backbone_3d.conv_input.0.weight": ("pts_middle_encoder.conv_input.0.weight", (3, 3, 3, 5, 16)),
        "backbone_3d.conv1.0.conv1.weight": (f"{layers}1.0.conv1.weight", (3, 3, 3, 16, 16)),
        "backbone_3d.conv1.1.bn2.bias": (f"{layers}1.1.bn2.bias", (16,)),
        "backbone_3d.conv2.0.0.weight": (f"{layers}1.2.0.weight", (3, 3, 3, 16, 32)),
        "backbone_3d.conv2.0.1.running_var": (f"{layers}1.2.1.running_var", (32,)),
        "backbone_3d.conv2.1.conv2.weight": (f"{layers}2.0.conv2.weight", (3, 3, 3, 32, 32)),
        "backbone_3d.conv3.0.0.weight": (f"{layers}2.2.0.weight", (3, 3, 3, 32, 64)),
        "backbone_3d.conv4.0.0.weight": (f"{layers}3.2.0.weight", (3, 3, 3, 64, 128)),
        "backbone_3d.conv4.2.bn1.weight": (f"{layers}4.1.bn1.weight", (128,)),
        "backbone_3d.conv_out.0.weight": ("pts_middle_encoder.conv_out.0.weight", (3, 1, 1, 128, 128)),
        "backbone_2d.blocks.0.1.weight": ("pts_backbone.blocks.0.0.weight", (128, 256, 3, 3)),
        "backbone_2d.blocks.1.17.num_batches_tracked": ("pts_backbone.blocks.1.16.num_batches_tracked", ()),
        "backbone_2d.deblocks.0.0.weight": ("pts_neck.deblocks.0.0.weight", (256, 128, 1, 1)),
        "backbone_2d.deblocks.1.0.weight": ("pts_neck.deblocks.1.0.weight", (256, 256, 2, 2)),
    }
    state = encoder_state("pcdet_nus_cp_vox01")
    exported = export_state(state, "mmdet3d")
    entries = {entry.ours: entry for entry in layout(shapes_of(state), "mmdet3d")}
    for ours, (theirs, shape) in expected.items():
        assert (entries[ours].theirs, tuple(exported[theirs].shape)) == (theirs, shape)
    kernel = state["backbone_3d.conv3.0.0.weight"]
    turned = exported["pts_middle_encoder.encoder_layers.encoder_layer2.2.0.weight"]
    assert turned[0, 1, 2, 3, 4] == kernel[4, 0, 1, 2, 3]
    assert len(exported) == len(state) - 16
    folded = exported["pts_middle_encoder.encoder_layers.encoder_layer1.0.bn1.running_mean"]
    mean, bias = state["backbone_3d.conv1.0.bn1.running_mean"], state["backbone_3d.conv1.0.conv1.bias"]
    assert torch.equal(folded, mean - bias) and bias.abs().max() > 0


@pytest.mark.parametrize("to", FRAMEWORKS)
@pytest.mark.parametrize("model", MODELS)
def test_a_round_trip_gives_every_bit_back(model: str, to: Any) -> None:
    state = encoder_state(model)
    conv_here = model == "pcdet_nus_tf"
    exported = export_state(state, to, conv_here=conv_here)
    assert all(type(name) is str and value.is_contiguous() for name, value in exported.items())
    if to == "mmdet3d" and model in BIASED:
        with pytest.raises(LayoutError, match=r"residual convolutions must have no bias.*conv1\.0\.conv1\.bias"):
            import_state(exported, shapes_of(state), to)
        return
    options = LayoutOptions(stride1_conv=conv_here if to != "mmdet3d" else "dsvt" not in model)
    back = import_state(exported, shapes_of(state), to, options, conv_here=conv_here)
    assert back.keys() == state.keys()
    for name, value in state.items():
        assert torch.equal(back[name], value) and back[name].dtype == value.dtype, name


@pytest.mark.parametrize("model", MODELS)
def test_state_dicts_of_the_framework_itself_are_imported(model: str) -> None:
    """OpenPCDet saves (out, z, y, x, in) with spconv 2."""
    state = encoder_state(model)
    back = import_state(dict(state), shapes_of(state), "openpcdet")
    assert all(torch.equal(back[name], value) for name, value in state.items())


# Strictness


def changed(state: dict[str, Tensor], how: str) -> dict[str, Tensor]:
    state = dict(state)
    name = "backbone_3d.conv2.1.conv1.weight"
    if how == "add":
        state["backbone_3d.conv2.1.conv3.weight"] = torch.zeros(4)
    elif how == "remove":
        del state[name]
    elif how == "rename":
        state["backbone_3d.conv2.1.convolution.weight"] = state.pop(name)
    elif how == "resize":
        state[name] = torch.zeros(32, 3, 3, 3, 31)
    elif how == "nan":
        state[name] = torch.full_like(state[name], float("nan"))
    elif how == "type":
        state[name] = state[name].double()
    return state


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("add", r"left over backbone_3d\.conv2\.1\.conv3\.weight \(4\)"),
        ("remove", r"missing   backbone_3d\.conv2\.1\.conv1\.weight \(3, 3, 3, 32, 32\)"),
        ("rename", r"(?s)missing   backbone_3d\.conv2\.1\.conv1.*left over backbone_3d\.conv2\.1\.convolution"),
        ("resize", r"shape     backbone_3d\.conv2\.1\.conv1\.weight must be .*32, 32\), got \(32, 3, 3, 3, 31\)"),
        ("nan", r"conv2\.1\.conv1\.weight: weights must be finite, got 27648 of 27648"),
        ("type", r"conv2\.1\.conv1\.weight: must be float32, got float64"),
    ],
)
def test_import_refuses_what_is_not_the_encoder(how: str, message: str) -> None:
    state = encoder_state("pcdet_nus_tf")
    with pytest.raises(LayoutError, match=message):
        import_state(changed(export_state(state, "openpcdet"), how), shapes_of(state), "openpcdet")


@pytest.mark.parametrize("to", FRAMEWORKS)
def test_export_refuses_what_has_no_place(to: Any) -> None:
    state = encoder_state("pcdet_nus_tf")
    with pytest.raises(LayoutError, match=r"every tensor must have a place in the framework, got none for field\.w"):
        export_state(state | {"field.w": torch.zeros(1)}, to)
    with pytest.raises(LayoutError, match="weights must be finite"):
        export_state(changed(state, "nan"), to)
    with pytest.raises(LayoutError, match="must be float32, got float64"):
        export_state(changed(state, "type"), to)


def test_kernels_that_openpcdet_would_turn_wrongly_are_refused() -> None:
    """Three channels out of a kernel with edges of 3: (3, 3, 3, 16, 3) becomes (3, 3, 3, 3, 16), not its transpose."""
    state = {"backbone_3d.conv_out.0.weight": torch.randn(3, 3, 3, 3, 16)}
    with pytest.raises(LayoutError, match=r"more output channels than their edge is long.*conv_out"):
        export_state(state, "openpcdet")
    assert export_state(state, "mmdet3d")["pts_middle_encoder.conv_out.0.weight"].shape == (3, 3, 3, 16, 3)


def test_the_order_of_kernels_is_told_by_shape_or_asked_for() -> None:
    cube = {"backbone_3d.conv_out.0.weight": torch.randn(3, 3, 3, 3, 3)}
    named = {"pts_middle_encoder.conv_out.0.weight": cube["backbone_3d.conv_out.0.weight"]}
    options = LayoutOptions(prefix="pts_", stride1_conv=False)
    with pytest.raises(LayoutError, match=r"got none that does; say it with --kernel-order"):
        import_state(named, shapes_of(cube), "mmdet3d", options)
    kept = import_state(named, shapes_of(cube), "mmdet3d", options, "krsc")
    turned = import_state(named, shapes_of(cube), "mmdet3d", options, "dhwio")
    (kernel,) = cube.values()
    assert torch.equal(kept["backbone_3d.conv_out.0.weight"], kernel)
    assert torch.equal(turned["backbone_3d.conv_out.0.weight"], kernel.permute(4, 0, 1, 2, 3))
    # Another kernel of the file tells it.
    other = cube | {"backbone_3d.conv_input.0.weight": torch.randn(16, 3, 3, 3, 5)}
    exported = {f"pts_middle_{name.replace('backbone_3d', 'encoder')}": value for name, value in other.items()}
    assert torch.equal(import_state(exported, shapes_of(other), "mmdet3d", options)[next(iter(cube))], kernel)
    # A file has one order.
    mixed = encoder_state("pcdet_nus_tf")
    turned_one = mixed | {
        "backbone_3d.conv_out.0.weight": mixed["backbone_3d.conv_out.0.weight"].permute(1, 2, 3, 4, 0)
    }
    with pytest.raises(LayoutError, match="must have one order"):
        import_state(turned_one, shapes_of(mixed), "openpcdet")


def test_deblocks_of_mmdetection3d_are_told_by_shape_or_asked_for() -> None:
    square = encoder_state("pcdet_nus_dynpp")
    with pytest.raises(LayoutError, match=r"as many channels in as out; say it with --stride1-deblock"):
        import_state(export_state(square, "mmdet3d"), shapes_of(square), "mmdet3d")
    oblong = encoder_state("pcdet_once_pp")
    for conv in (True, False):
        exported = export_state(oblong, "mmdet3d", LayoutOptions(stride1_conv=conv, dynamic_pillars=conv))
        back = import_state(exported, shapes_of(oblong), "mmdet3d")
        assert all(torch.equal(back[name], value) for name, value in oblong.items())


def test_deblocks_are_turned_where_the_configurations_differ() -> None:
    """TransFusion's 2D backbone has a Conv2d at stride 1, SECOND's a ConvTranspose2d."""
    name = "backbone_2d.deblocks.0.0.weight"
    state = encoder_state("pcdet_nus_tf")
    kernel = state[name]
    assert kernel.shape == (256, 128, 1, 1)
    for to, stride1_conv, expected in (
        ("openpcdet", None, kernel),
        ("openpcdet", True, kernel),
        ("openpcdet", False, kernel.transpose(0, 1)),
        ("mmdet3d", None, kernel),
        ("mmdet3d", False, kernel.transpose(0, 1)),
    ):
        framework: Any = to
        options = LayoutOptions(stride1_conv=stride1_conv)
        exported = export_state(state, framework, options, conv_here=True)
        theirs = name if to == "openpcdet" else "pts_neck.deblocks.0.0.weight"
        assert torch.equal(exported[theirs], expected)
        # From mmdetection3d the shapes tell.
        back = import_state(
            exported, shapes_of(state), framework, options if to == "openpcdet" else None, conv_here=True
        )
        assert torch.equal(back[name], kernel)
    with pytest.raises(LayoutError, match=r"ConvTranspose2d \[in, out, k, k\] in place of a Conv2d"):
        turned = export_state(state, "openpcdet", LayoutOptions(stride1_conv=False), conv_here=True)
        import_state(turned, shapes_of(state), "openpcdet", conv_here=True)


def test_options_of_another_framework_are_refused() -> None:
    state = encoder_state("dsvt_nus")
    for options in (LayoutOptions(prefix="pts_"), LayoutOptions(dynamic_pillars=True)):
        with pytest.raises(LayoutError, match="prefix and dynamic_pillars must be left out"):
            export_state(state, "dsvt", options)
    with pytest.raises(LayoutError, match="must be left out for DSVT"):
        export_state(state, "mmdet3d", LayoutOptions(dynamic_pillars=True))


def test_half_precision_is_widened() -> None:
    state = encoder_state("pcdet_once_second")
    half = {name: value.half() if value.is_floating_point() else value for name, value in state.items()}
    back = import_state(half, shapes_of(state), "openpcdet")
    assert all(torch.equal(back[name], half[name].to(state[name].dtype)) for name in state)
