# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Point features and backbones against plain re-statements of the published layer order, in float64.

The sparse backbones are re-stated with dense `conv3d` on a small grid, where everything is set to zero outside the
active sites after each layer; the hard point features with loops over points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.models.encoders import BEVBackboneConfig, Encoder, EncoderConfig, PillarConfig, VoxelConfig
from pred.models.encoders.bev import BaseBEVBackbone, BaseBEVResBackbone
from pred.models.encoders.norm import BatchNorm1d, BatchNorm2d
from pred.models.encoders.pillars import PillarVFE, PointPillarScatter
from pred.models.encoders.voxels import DynamicMeanVFE, HeightCompression, MeanVFE, VoxelBackBone8x, VoxelResBackBone8x

RANGE = (0.0, -4.0, -1.0, 8.0, 4.0, 3.0)
ROUNDING = 1e-10
"""Of float64 through some twenty layers, over the largest value."""


def randomise(module: nn.Module) -> nn.Module:
    """Weights and statistics that hide no part of a formula."""
    generator = torch.Generator().manual_seed(7)
    for name, value in module.state_dict().items():
        if name.endswith("running_var") or (value.dim() == 1 and name.endswith("weight")):
            value.copy_(0.5 + torch.rand(value.shape, generator=generator, dtype=value.dtype))
        elif value.dim() == 1:
            value.copy_(0.3 * torch.randn(value.shape, generator=generator, dtype=value.dtype))
    return module


def random_points(num_points: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(RANGE, dtype=torch.float64).view(2, 3)
    xyz = low + (high - low) * torch.rand(num_points, 3, generator=generator, dtype=torch.float64)
    return torch.cat([xyz, torch.rand(num_points, 2, generator=generator, dtype=torch.float64)], dim=1)


def assert_equal(actual: Tensor, expected: Tensor) -> None:
    assert actual.shape == expected.shape
    torch.testing.assert_close(actual, expected, rtol=0, atol=ROUNDING * float(expected.detach().abs().max()))


# Point features


def first_points(
    points: Tensor, offsets: list[int], size: tuple[float, float, float], max_points: int, max_cells: int
) -> dict[tuple[int, int, int, int], list[Tensor]]:
    """The first points of the first cells (b, z, y, x) of each frame, in order of appearance."""
    cells: dict[tuple[int, int, int, int], list[Tensor]] = {}
    for frame in range(len(offsets) - 1):
        of_frame = 0
        for point in points[offsets[frame] : offsets[frame + 1]]:
            x, y, z = (math.floor(float(point[axis] - RANGE[axis]) / size[axis]) for axis in range(3))
            key = (frame, z, y, x)
            if key not in cells:
                if of_frame == max_cells:
                    continue
                of_frame += 1
                cells[key] = []
            if len(cells[key]) < max_points:
                cells[key].append(point)
    return cells


def batch_norm(values: Tensor, state: dict[str, Tensor], name: str, training: bool) -> Tensor:
    """Of rows [M, C]; epsilon 1e-3."""
    if training:
        mean, variance = values.mean(0), values.var(0, unbiased=False)
    else:
        mean, variance = state[f"{name}.running_mean"], state[f"{name}.running_var"]
    return (values - mean) / (variance + 1e-3).sqrt() * state[f"{name}.weight"] + state[f"{name}.bias"]


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("filters", [[9], [8, 6]])
def test_hard_pillars_against_loops(filters: list[int], training: bool, backend: str) -> None:
    size = (1.0, 0.5, 4.0)
    config = PillarConfig(size[:2], filters, max_points=3, max_pillars=(50, 40))
    torch.manual_seed(0)
    vfe = randomise(PillarVFE(config, 5, size, RANGE).double()).train(training)
    state = {name: value.clone() for name, value in vfe.state_dict().items()}
    points, offsets = random_points(400), [0, 250, 250, 400]
    features, coords = vfe(points, torch.tensor(offsets))

    cells = first_points(points, offsets, size, 3, 50 if training else 40)
    assert len(cells) == (100 if training else 80)  # the cap is reached
    assert coords.tolist() == [list(cell) for cell in cells]
    rows = []
    for (_, _, y, x), members in cells.items():
        mean = sum(point[:3] for point in members) / len(members)
        centre = torch.tensor([RANGE[0] + x + 0.5, RANGE[1] + 0.5 * y + 0.25, 1.0], dtype=torch.float64)
        for slot in range(3):
            if slot < len(members):
                point = members[slot]
                rows.append(torch.cat([point, point[:3] - mean, point[:3] - centre]))
            else:
                rows.append(torch.zeros(11, dtype=torch.float64))
    values = torch.stack(rows)  # [pillars * 3, 11]
    for layer in range(len(filters)):
        values = values @ state[f"pfn_layers.{layer}.linear.weight"].T
        if training and layer == 0:
            expected_mean = 0.99 * state["pfn_layers.0.norm.running_mean"] + 0.01 * values.mean(0)
            assert_equal(vfe.get_buffer("pfn_layers.0.norm.running_mean"), expected_mean)
        values = batch_norm(values, state, f"pfn_layers.{layer}.norm", training).relu()
        maximum = values.view(-1, 3, values.shape[1]).amax(1)
        values = torch.cat([values, maximum.repeat_interleave(3, 0)], dim=1)
    assert_equal(features, maximum)


def test_empty_slots_take_part_in_the_maximum() -> None:
    """By hand: the point is clamped to 0, the empty slot keeps the bias."""
    vfe = PillarVFE(PillarConfig((1.0, 0.5), [1], max_points=2), 5, (1.0, 0.5, 4.0), RANGE).eval()
    with torch.no_grad():
        vfe.get_parameter("pfn_layers.0.linear.weight").fill_(-1.0)
        vfe.get_parameter("pfn_layers.0.norm.bias").fill_(0.25)
    one = torch.tensor([[2.5, -3.75, 1.0, 9.0, 0.0]])
    assert vfe(one, torch.tensor([0, 1]))[0].tolist() == [[0.25]]
    assert vfe(one.repeat(2, 1), torch.tensor([0, 2]))[0].tolist() == [[0.0]]


@pytest.mark.parametrize("training", [False, True])
def test_hard_means_against_loops(training: bool, backend: str) -> None:
    config = VoxelConfig(voxel_size=(1.0, 1.0, 1.0), max_points=2, max_voxels=(60, 40))
    points, offsets = random_points(400), [0, 250, 400]
    means, coords = MeanVFE(config, RANGE).train(training)(points, torch.tensor(offsets))
    cells = first_points(points, offsets, config.voxel_size, 2, 60 if training else 40)
    assert coords.tolist() == [list(cell) for cell in cells]
    assert_equal(means, torch.stack([torch.stack(members).mean(0) for members in cells.values()]))


def test_dynamic_means_are_of_all_points(backend: str) -> None:
    points, offsets = random_points(400), [0, 250, 400]
    outside = torch.full((1, 5), 99.0, dtype=torch.float64)
    means, coords = DynamicMeanVFE((1.0, 1.0, 1.0), RANGE)(torch.cat([points, outside]), torch.tensor([0, 250, 401]))
    cells = first_points(points, offsets, (1.0, 1.0, 1.0), 1000, 1000)
    assert coords.tolist() == sorted(list(cell) for cell in cells)
    expected = [torch.stack(cells[b, z, y, x]).mean(0) for b, z, y, x in coords.tolist()]
    assert_equal(means, torch.stack(expected))


def test_scatter_by_hand() -> None:
    bev = PointPillarScatter((2, 3))(
        torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([[0, 0, 1, 2], [1, 0, 0, 1]]), 2
    )
    assert bev[0, 0].tolist() == [[0, 0, 0], [0, 0, 1]] and bev[0, 1].tolist() == [[0, 0, 0], [0, 0, 2]]
    assert bev[1, 0].tolist() == [[0, 3, 0], [0, 0, 0]] and bev[1, 1].tolist() == [[0, 4, 0], [0, 0, 0]]


# Sparse backbones


class Dense:
    """A dense grid [B, C, z, y, x] that is zero but at the active sites of a mask [B, 1, z, y, x]."""

    def __init__(self, values: Tensor, mask: Tensor, state: dict[str, Tensor], training: bool) -> None:
        self.values, self.mask, self.state, self.training = values * mask, mask, state, training

    def convolution(
        self, name: str, stride: int | tuple[int, ...] = 1, padding: int | tuple[int, ...] | None = None
    ) -> Dense:
        """Submanifold where no padding is given; else active wherever the window meets an active site."""
        weight = self.state[f"{name}.weight"].permute(0, 4, 1, 2, 3)
        values = F.conv3d(
            self.values, weight, self.state.get(f"{name}.bias"), stride, 1 if padding is None else padding
        )
        mask = self.mask
        if padding is not None:
            window = torch.ones(1, 1, *weight.shape[2:], dtype=mask.dtype)
            mask = (F.conv3d(mask, window, None, stride, padding) > 0).to(mask.dtype)
        return Dense(values, mask, self.state, self.training)

    def norm(self, name: str) -> Dense:
        active = self.mask[:, 0].bool()
        values = torch.zeros_like(self.values)
        rows = batch_norm(self.values.movedim(1, -1)[active], self.state, name, self.training)
        values.movedim(1, -1)[active] = rows
        return Dense(values, self.mask, self.state, self.training)

    def relu(self) -> Dense:
        return Dense(self.values.relu(), self.mask, self.state, self.training)

    def layer(
        self, name: str, stride: int | tuple[int, ...] = 1, padding: int | tuple[int, ...] | None = None
    ) -> Dense:
        return self.convolution(f"{name}.0", stride, padding).norm(f"{name}.1").relu()

    def residual(self, name: str) -> Dense:
        out = self.convolution(f"{name}.conv1").norm(f"{name}.bn1").relu()
        out = out.convolution(f"{name}.conv2").norm(f"{name}.bn2")
        return Dense(out.values + self.values, self.mask, self.state, self.training).relu()


def dense_backbone(x: Dense, kind: str) -> Tensor:
    x = x.layer("conv_input")
    if kind == "plain":
        x = x.layer("conv1.0")
    else:
        x = x.residual("conv1.0").residual("conv1.1")
    for stage, padding in ((2, (1, 1, 1)), (3, (1, 1, 1)), (4, (0, 1, 1))):
        x = x.layer(f"conv{stage}.0", 2, padding)
        for block in (1, 2):
            x = x.layer(f"conv{stage}.{block}") if kind == "plain" else x.residual(f"conv{stage}.{block}")
    return x.layer("conv_out", (2, 1, 1), (0, 0, 0)).values


def random_sites(grid_size: tuple[int, int, int], num_frames: int, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    size = (num_frames, *grid_size)
    flat = torch.randperm(math.prod(size), generator=generator)[:count]
    return torch.stack(torch.unravel_index(flat, size), dim=1)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("kind", ["plain", "residual", "residual without bias"])
def test_sparse_backbones_against_dense_convolutions(kind: str, training: bool, backend: str) -> None:
    grid_size = (26, 10, 13)
    torch.manual_seed(0)
    backbone: VoxelBackBone8x | VoxelResBackBone8x
    if kind == "plain":
        backbone = VoxelBackBone8x(5, grid_size)
    else:
        backbone = VoxelResBackBone8x(5, grid_size, conv_bias=kind == "residual")
    randomise(backbone.double()).train(training)
    reference = copy.deepcopy(backbone)
    coords = random_sites(grid_size, 2, 150)
    features = torch.randn(150, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    bev = HeightCompression()(backbone(features, coords, 2))

    size = (2, grid_size[0] + 1, *grid_size[1:])  # one more layer in z than voxels
    values = torch.zeros(*size, 5, dtype=torch.float64)
    mask = torch.zeros(*size, 1, dtype=torch.float64)
    values[tuple(coords.T)] = features
    mask[tuple(coords.T)] = 1
    state = dict(reference.named_parameters()) | dict(reference.named_buffers())
    dense = dense_backbone(Dense(values.movedim(-1, 1), mask.movedim(-1, 1), state, training), kind.split()[0])
    assert dense.shape == (2, 128, backbone.out_depth, 2, 2) and 0 < dense.count_nonzero() < dense.numel()
    # Channels first, then height: channel c at height z is channel c D + z.
    assert_equal(bev, torch.stack([dense[:, c, z] for c in range(128) for z in range(backbone.out_depth)], dim=1))

    weight = torch.randn(bev.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (bev * weight).sum().backward()
    (dense.flatten(1, 2) * weight).sum().backward()
    for name, parameter in reference.named_parameters():
        gradient = backbone.get_parameter(name).grad
        assert gradient is not None and parameter.grad is not None
        # A bias before batch normalisation has no gradient but rounding.
        scale = float(parameter.grad.abs().max()) + 1e-4
        assert (gradient - parameter.grad).abs().max() <= 1e-8 * scale, name


@pytest.mark.parametrize(("layers", "depth"), [(24, 1), (40, 2), (46, 2), (56, 3), (64, 3)])
def test_height_of_the_map(layers: int, depth: int) -> None:
    """By the rule (size + 2 padding - kernel) // stride + 1 for each strided convolution."""
    size = layers + 1
    for padding in (1, 1, 0):
        size = (size + 2 * padding - 3) // 2 + 1
    assert (size - 3) // 2 + 1 == depth
    backbone = VoxelBackBone8x(4, (layers, 9, 8)).eval()
    out = backbone(torch.ones(1, 4), torch.tensor([[0, layers - 1, 8, 7]]), 1)
    assert backbone.out_depth == depth and out.spatial_shape == (depth, 2, 1)


@pytest.mark.parametrize("training", [False, True])
def test_biases_fold_into_the_running_mean(training: bool) -> None:
    """A residual backbone with biases equals one without, whose running means are less by them."""
    grid_size = (24, 16, 16)
    torch.manual_seed(0)
    with_bias = randomise(VoxelResBackBone8x(4, grid_size).double())
    without = VoxelResBackBone8x(4, grid_size, conv_bias=False).double()
    state = with_bias.state_dict()
    for name in [name for name in state if name.endswith("bias") and ".conv" in name]:
        norm = name.replace(".conv1.bias", ".bn1").replace(".conv2.bias", ".bn2")
        state[f"{norm}.running_mean"] = state[f"{norm}.running_mean"] - state.pop(name)
    without.load_state_dict(state)
    coords = random_sites(grid_size, 1, 80)
    features = torch.randn(80, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    with_bias.train(training)
    without.train(training)
    assert_equal(without(features, coords, 1).features, with_bias(features, coords, 1).features)


# 2D backbones


def map_norm(x: Tensor, state: dict[str, Tensor], name: str, training: bool) -> Tensor:
    rows = batch_norm(x.movedim(1, -1).flatten(0, 2), state, name, training)
    return rows.view(x.shape[0], *x.shape[2:], x.shape[1]).movedim(-1, 1)


def published_plain(x: Tensor, state: dict[str, Tensor], config: BEVBackboneConfig, training: bool) -> Tensor:
    outputs = []
    for block, repeats in enumerate(config.layer_nums):
        name = f"blocks.{block}"
        x = F.conv2d(F.pad(x, (1, 1, 1, 1)), state[f"{name}.1.weight"], stride=config.layer_strides[block])
        x = map_norm(x, state, f"{name}.2", training).relu()
        for layer in range(repeats):
            x = F.conv2d(x, state[f"{name}.{4 + 3 * layer}.weight"], padding=1)
            x = map_norm(x, state, f"{name}.{5 + 3 * layer}", training).relu()
        outputs.append(published_upsampling(x, state, config, block, training))
    return torch.cat(outputs, dim=1)


def published_residual(x: Tensor, state: dict[str, Tensor], config: BEVBackboneConfig, training: bool) -> Tensor:
    outputs = []
    for block, repeats in enumerate(config.layer_nums):
        for layer in range(1 + repeats):
            name, stride = f"blocks.{block}.{layer}", config.layer_strides[block] if layer == 0 else 1
            out = F.conv2d(x, state[f"{name}.conv1.weight"], stride=stride, padding=1)
            out = map_norm(out, state, f"{name}.bn1", training).relu()
            out = map_norm(F.conv2d(out, state[f"{name}.conv2.weight"], padding=1), state, f"{name}.bn2", training)
            if layer == 0:
                x = F.conv2d(x, state[f"{name}.downsample_layer.0.weight"], stride=stride)
                x = map_norm(x, state, f"{name}.downsample_layer.1", training)
            x = (out + x).relu()
        outputs.append(published_upsampling(x, state, config, block, training))
    return torch.cat(outputs, dim=1)


def published_upsampling(
    x: Tensor, state: dict[str, Tensor], config: BEVBackboneConfig, block: int, training: bool
) -> Tensor:
    weight, stride = state[f"deblocks.{block}.0.weight"], config.upsample_strides[block]
    if stride >= 1:
        x = F.conv_transpose2d(x, weight, stride=int(stride))
    else:
        x = F.conv2d(x, weight, stride=round(1 / stride))
    return map_norm(x, state, f"deblocks.{block}.1", training).relu()


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("strides", [([2, 2, 2], [0.5, 1, 2]), ([1, 2, 2], [1, 2, 4]), ([1, 3, 1], [1 / 3, 1, 1])])
@pytest.mark.parametrize("kind", ["plain", "residual"])
def test_2d_backbones_against_published_layers(
    kind: str, strides: tuple[list[int], list[float]], training: bool
) -> None:
    config = BEVBackboneConfig("plain", [1, 0, 2], strides[0], [4, 6, 8], strides[1], [3, 5, 4])
    published: Callable[..., Tensor] = published_plain if kind == "plain" else published_residual
    torch.manual_seed(0)
    backbone = (BaseBEVBackbone if kind == "plain" else BaseBEVResBackbone)(config, 7, (24, 48))
    randomise(backbone.double()).train(training)
    state = {name: value.clone() for name, value in backbone.state_dict().items()}
    x = torch.randn(2, 7, 24, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    actual = backbone(x)
    assert actual.shape[1] == backbone.out_channels == 12
    assert_equal(actual, published(x, state, config, training))


def test_a_convolution_where_the_resolution_stays() -> None:
    config = BEVBackboneConfig(
        layer_nums=[1, 1],
        layer_strides=[1, 2],
        num_filters=[4, 6],
        upsample_strides=[1, 2],
        num_upsample_filters=[3, 5],
    )
    torch.manual_seed(0)
    transposed = BaseBEVBackbone(config, 4, (8, 8)).double().eval()
    plain = BaseBEVBackbone(replace(config, conv_for_no_stride=True), 4, (8, 8)).double().eval()
    state = transposed.state_dict()
    state["deblocks.0.0.weight"] = state["deblocks.0.0.weight"].transpose(0, 1)
    plain.load_state_dict(state)
    x = torch.randn(1, 4, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert_equal(plain(x), transposed(x))


# Batch normalisation


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (0, 3, 4, 4), (1, 3, 1, 1)])
def test_a_batch_without_variance_is_normalised_by_the_running_statistics(shape: tuple[int, ...]) -> None:
    norm = randomise(BatchNorm1d(3) if len(shape) == 2 else BatchNorm2d(3)).train()
    before = {name: value.clone() for name, value in norm.state_dict().items()}
    x = torch.full(shape, 2.0, requires_grad=True)
    out = norm(x)
    expected = (2.0 - before["running_mean"]) / (before["running_var"] + 1e-3).sqrt() * before["weight"] + before[
        "bias"
    ]
    torch.testing.assert_close(out, expected.view(3, *(1,) * (len(shape) - 2)).expand(shape))
    out.sum().backward()
    assert x.grad is not None and x.grad.isfinite().all()
    assert all(torch.equal(value, before[name]) for name, value in norm.state_dict().items())


def test_two_rows_are_normalised_by_themselves() -> None:
    norm = BatchNorm1d(1).train()
    x = torch.tensor([[1.0], [3.0]])
    torch.testing.assert_close(norm(x), torch.tensor([[-1.0], [1.0]]) / math.sqrt(1 + 1e-3))
    assert norm.num_batches_tracked == 1
    torch.testing.assert_close(norm.running_mean, torch.tensor([0.02]))


@pytest.mark.parametrize("kind", ["pillars", "voxels", "dsvt"])
def test_published_constants_of_batch_normalisation(kind: Any) -> None:
    """1e-3 and 0.01 everywhere but in DSVT's position embeddings, which have torch's own."""
    config = EncoderConfig(kind, pillars=PillarConfig(vfe_filters=[64, 128]))
    for name, module in Encoder(config, (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)).named_modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            constants = (1e-5, 0.1) if "posembed" in name else (1e-3, 0.01)
            assert (module.eps, module.momentum) == constants, name
