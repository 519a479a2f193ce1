# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""pred.nn: modules over the sparse ops, and spconv 2.x as a second oracle where it is installed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.data.nuscenes import NuScenesFrames
from pred.nn import (
    SparseConv3d,
    SparseInverseConv3d,
    SparseMaxPool3d,
    SparseSequential,
    SparseTensor,
    SubMConv3d,
)
from pred.ops import segment_reduce, voxelize
from tests.ops.test_sparse_conv import Triple, dense, sites

SHAPE: Triple = (17, 20, 22)


def tensor(count: int = 200, channels: int = 4, seed: int = 0, dtype: torch.dtype = torch.float32) -> SparseTensor:
    generator = torch.Generator().manual_seed(seed)
    return SparseTensor(
        torch.randn(count, channels, generator=generator, dtype=dtype), sites(count, 2, SHAPE, seed), SHAPE, 2
    )


def chain(*modules: nn.Module) -> SparseTensor:
    """What the modules make of `tensor()`."""
    out = SparseSequential(*modules)(tensor())
    assert isinstance(out, SparseTensor)
    return out


def network(sparse: Any, channels: int = 4, bias: bool = True) -> nn.Module:
    """The kinds of layers of the detectors' backbones and of a U-Net, from `pred.nn` or from spconv."""
    return sparse.SparseSequential(
        sparse.SubMConv3d(channels, 8, 3, padding=1, bias=bias, indice_key="s1"),
        sparse.SubMConv3d(8, 8, 3, padding=1, bias=bias, indice_key="s1"),
        sparse.SparseConv3d(8, 12, 3, stride=2, padding=1, bias=bias, indice_key="d2"),
        sparse.SparseConv3d(12, 12, 3, stride=2, padding=(0, 1, 1), bias=bias, indice_key="d3"),
        sparse.SparseInverseConv3d(12, 8, 3, indice_key="d3", bias=bias),
        nn.ReLU(),  # spconv's native pooling starts from 0: it agrees where nothing is negative
        sparse.SparseMaxPool3d(2, 2, indice_key="p"),
        sparse.SparseConv3d(8, 16, (3, 1, 1), stride=(2, 1, 1), padding=0, bias=bias),
    )


def test_dense_places_features_and_differentiates(backend: str) -> None:
    x = tensor(50, dtype=torch.float64)
    features = x.features.clone().requires_grad_()
    grid = x.replace_feature(features).dense()
    assert grid.shape == (2, 4, *SHAPE) and grid.is_contiguous()
    assert torch.equal(grid, dense(features, x.indices, 2, SHAPE))
    assert torch.equal(x.replace_feature(features).dense(channels_first=False), grid.permute(0, 2, 3, 4, 1))
    cotangent = torch.randn(grid.shape, dtype=torch.float64)
    (grad,) = torch.autograd.grad(grid, features, cotangent)
    b, z, y, x_ = x.indices.unbind(1)
    assert torch.equal(grad, cotangent[b, :, z, y, x_])


def test_modules_equal_dense_layers(backend: str) -> None:
    """A submanifold and a strided layer with batch normalisation, against conv3d on the dense grid."""
    torch.manual_seed(0)
    net = SparseSequential(
        SubMConv3d(4, 8, 3, indice_key="s"),
        nn.BatchNorm1d(8),
        nn.ReLU(),
        SparseConv3d(8, 6, 3, stride=2, padding=1),
    ).double()
    x = tensor(dtype=torch.float64)
    out = net(x)
    assert isinstance(net[0], SubMConv3d) and isinstance(net[3], SparseConv3d)
    first, second = net[0], net[3]
    b, z, y, x_ = x.indices.unbind(1)
    grid = F.conv3d(x.dense(), first.weight.permute(0, 4, 1, 2, 3), first.bias, padding=1)
    rows = torch.relu(F.batch_norm(grid[b, :, z, y, x_], None, None, training=True))
    expected = F.conv3d(dense(rows, x.indices, 2, SHAPE), second.weight.permute(0, 4, 1, 2, 3), second.bias, 2, 1)
    assert out.spatial_shape == tuple(expected.shape[2:]) == (9, 10, 11)
    b, z, y, x_ = out.indices.unbind(1)
    torch.testing.assert_close(out.features, expected[b, :, z, y, x_], rtol=0, atol=1e-12)
    assert sorted(net.state_dict()) == sorted(
        ["0.weight", "0.bias", "3.weight", "3.bias"]
        + [f"1.{name}" for name in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")]
    )


def test_rulebooks_are_made_once_per_key(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import pred.nn

    made = []
    original = pred.nn.build_rulebook

    def build_rulebook(*arguments: Any, **named: Any) -> Any:
        made.append(arguments)
        return original(*arguments, **named)

    monkeypatch.setattr(pred.nn, "build_rulebook", build_rulebook)
    x = tensor()
    net = network(pred.nn)
    net(x)
    assert len(made) == 5  # s1 once, d2, d3, p, and the last layer's own
    net(x)
    assert len(made) == 6  # only that without a key is made again


@pytest.mark.parametrize("mode", ["train", "eval"])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_any_number_of_sites(backend: str, mode: str, count: int) -> None:
    torch.manual_seed(0)
    net = SparseSequential(SubMConv3d(4, 8, 3), SparseConv3d(8, 6, 3, 2, 1), SparseMaxPool3d(3, 2, 1))
    net.train(mode == "train")
    x = tensor(count)
    features = x.features.clone().requires_grad_()
    out = net(x.replace_feature(features))
    assert out.features.isfinite().all() and out.features.shape[1] == 6
    out.features.sum().backward()
    assert features.grad is not None and features.grad.shape == (count, 4)
    assert out.dense().shape == (2, 6, 5, 5, 6)


def test_autocast_computes_in_its_dtype(native: None) -> None:
    torch.manual_seed(0)
    layer = SubMConv3d(4, 8, 3)
    x = tensor()
    exact = layer(x).features
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(x).features
    assert out.dtype == torch.bfloat16
    assert 0 < float((out.float() - exact).abs().max()) < 0.03 * float(exact.abs().max())
    out.float().square().sum().backward()
    assert layer.weight.grad is not None and layer.weight.grad.dtype == torch.float32
    assert layer.bias is not None and layer.bias.grad is not None and layer.bias.grad.dtype == torch.float32


@pytest.mark.parametrize(
    "make,text",
    [
        (lambda: SubMConv3d(4, 8, 2), "SubMConv3d: kernel_size must be odd"),
        (lambda: SubMConv3d(4, 8, 3, stride=2), "SubMConv3d: stride must be 1"),
        (lambda: SparseConv3d(4, 8, 3, groups=2), "SparseConv3d: groups must be 1, got 2"),
        (lambda: SparseConv3d(4, 8, (3, 3)), r"SparseConv3d: kernel_size must hold 3 numbers \(z, y, x\), got 2"),
        (lambda: SparseConv3d(4, 8, 3, padding=-1), "SparseConv3d: padding must be at least 0, got -1"),
        (lambda: SubMConv3d(-3, 8, 3), "SubMConv3d: in_channels must be at least 0, got -3"),
        (lambda: SubMConv3d(4, 8, 5, dilation=2**30), "SubMConv3d: dilation must keep half the kernel"),
        (lambda: SparseTensor(torch.zeros(0, 4), torch.zeros(0, 4).long(), SHAPE, -1), "batch_size must be at least 0"),
        (lambda: SparseTensor(torch.zeros(0, 4), torch.zeros(0, 4).long(), (0, 5, 6), 1), "spatial_shape must be at"),
        (
            lambda: SparseTensor(torch.zeros(0, 4, device="meta"), torch.zeros(0, 4).long(), SHAPE, 1),
            r"indices must be on the device of features \(meta\), got cpu",
        ),
        (lambda: at_sites([0, 0, 0, 7]).dense(), r"dense: indices must lie inside .* got \[0, 0, 0, 7\] in row 0"),
        (
            lambda: at_sites([0, 0, 0, 1], [0, 0, 0, 1]).dense(),
            "indices must be distinct, got one site in rows 0 and 1",
        ),
        (
            lambda: SparseTensor(torch.zeros(0, 1), torch.zeros(0, 4).long(), (2**30,) * 3, 1).dense(),
            r"dense: spatial_shape must give at most 2\^62 sites",
        ),
        (lambda: chain(nn.Flatten(0)), "features must have shape"),
        (lambda: SparseTensor(torch.zeros(3, 4), torch.zeros(2, 4).long(), SHAPE, 1), "features must have shape"),
        (lambda: SparseTensor(torch.zeros(3, 4), torch.zeros(3, 3).long(), SHAPE, 1), "indices must have shape"),
        (lambda: SparseTensor(torch.zeros(3, 4), torch.zeros(3, 4).long(), (1, 2), 1), "spatial_shape must hold 3"),
        (lambda: SubMConv3d(3, 8, 3)(tensor()), r"features must have in_channels=3 columns, got \[200, 4\]"),
        (
            lambda: chain(SubMConv3d(4, 4, 3, indice_key="k"), SubMConv3d(4, 4, 5, indice_key="k")),
            "SubMConv3d: indice_key 'k' must mean one kernel_size",
        ),
        (
            lambda: chain(SparseConv3d(4, 4, 3, 2, 1), SparseInverseConv3d(4, 4, 3, "k")),
            "SparseInverseConv3d: indice_key must be that of a layer before, got 'k'",
        ),
        (
            lambda: chain(SparseConv3d(4, 4, 3, 2, 1, indice_key="k"), SparseInverseConv3d(4, 4, 2, "k")),
            "SparseInverseConv3d: indice_key 'k' must mean one kernel_size",
        ),
        (
            lambda: chain(
                SparseConv3d(4, 4, 3, 2, 1, indice_key="k"),
                SparseConv3d(4, 4, 3, 2, 1),
                SparseInverseConv3d(4, 4, 3, "k"),
            ),
            "input must have the sites that indice_key 'k' leads to",
        ),
    ],
)
def test_wrong_use_is_named(make: Callable[[], Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make()


def at_sites(*rows: list[int]) -> SparseTensor:
    """Ones at these sites of a small grid."""
    return SparseTensor(torch.ones(len(rows), 1), torch.tensor(rows), (4, 5, 6), 1)


@pytest.mark.parametrize(
    "make,text",
    [
        (lambda: chain(nn.GRU(4, 4)), r"SparseSequential: module 0 \(GRU\) must return features \[M, C\], got tuple"),
        (lambda: SparseSequential(nn.ReLU())(torch.zeros(3, 4)), "SparseSequential: input must be a SparseTensor"),
        (lambda: nn.Sequential(nn.Linear(4, 4), SubMConv3d(4, 4, 3))(tensor().features), "SubMConv3d: input must be a"),
        (lambda: SparseInverseConv3d(4, 4, 3, "k")(torch.zeros(3, 4)), "SparseInverseConv3d: input must be a"),
        (lambda: SparseTensor([[1.0]], torch.zeros(1, 4).long(), SHAPE, 1), "features must be a tensor, got list"),  # type: ignore[arg-type]
        (lambda: SparseTensor(torch.zeros(1, 1), torch.zeros(1, 4).long(), SHAPE, 1.5), "batch_size must be an int"),  # type: ignore[arg-type]
        (lambda: SparseTensor(torch.zeros(1, 1), torch.zeros(1, 4).long(), (4.7, 5, 6), 1), "must be an integer, got"),  # type: ignore[arg-type]
        (lambda: SparseConv3d(4, 8, 3.0), "SparseConv3d: kernel_size must be an integer, got float"),  # type: ignore[arg-type]
    ],
)
def test_wrong_types_are_named(make: Callable[[], Any], text: str) -> None:
    with pytest.raises(TypeError, match=text):
        make()


def test_numpy_sizes() -> None:
    layer = SparseConv3d(4, 8, np.array([3, 1, 1]), np.int64(2))  # type: ignore[arg-type]
    assert layer.kernel_size == (3, 1, 1) and layer.stride == (2, 2, 2)
    assert all(type(size) is int for size in layer.kernel_size + layer.stride)


def test_one_module_twice() -> None:
    relu = nn.ReLU()
    layer = SubMConv3d(4, 4, 3)
    x = tensor()
    out = SparseSequential(layer, relu, layer, relu)(x)
    assert torch.equal(out.features, relu(layer(x.replace_feature(relu(layer(x).features))).features))


def test_sites_changed_in_place_are_not_those_of_the_key() -> None:
    x = at_sites([0, 0, 0, 0], [0, 0, 0, 1])
    layer = SubMConv3d(1, 1, 3, indice_key="k")
    layer(x)
    same = SparseTensor(x.features, x.indices.clone().int(), x.spatial_shape, 1, x.rulebooks)
    layer(same)  # other memory, the same sites
    x.indices[1, 3] = 5
    for changed in (x, same):  # what the rulebook was made of is gone
        with pytest.raises(ValueError, match="SubMConv3d: indice_key 'k' must be of the same sites, got others"):
            layer(changed)
    with torch.inference_mode():  # whose tensors count no changes
        inner = at_sites([0, 0, 0, 0], [0, 0, 0, 1])
        assert torch.equal(layer(layer(inner)).indices, inner.indices)


def test_autocast_leaves_float64_alone() -> None:
    layer, x = SubMConv3d(4, 8, 3).double(), tensor(dtype=torch.float64)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(x).features
    assert out.dtype == torch.float64 and torch.equal(out, layer(x).features)


def keyframe(root: Path) -> SparseTensor:
    """Mean points of the real keyframe's voxels."""
    source = NuScenesFrames(root, sweeps=1, labels="none")
    points = torch.as_tensor(source.load(0).points)
    bounds = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)
    voxels = voxelize(points, torch.tensor([0, points.shape[0]]), (0.1, 0.1, 0.2), bounds)
    means = segment_reduce(points.float(), voxels.point_to_voxel, voxels.coords.shape[0], "mean")
    return SparseTensor(means[:, :4], voxels.coords, (41, 1024, 1024), 1)


class TestAgainstSpconv:
    """spconv's CPU build needs one thread, a stream that it does not use, and training mode where there is a bias."""

    @pytest.fixture(autouse=True)
    def _prepare(self, native: None, monkeypatch: pytest.MonkeyPatch) -> None:
        self.spconv: Any = pytest.importorskip("spconv.pytorch", reason="spconv is not installed")
        monkeypatch.setattr("spconv.pytorch.ops.get_current_stream", lambda: 0)
        torch.set_num_threads(1)

    def compare(self, x: SparseTensor, make: Callable[[Any], nn.Module]) -> None:
        import pred.nn

        torch.manual_seed(0)
        ours, theirs = make(pred.nn), make(self.spconv)
        theirs.load_state_dict(ours.state_dict())  # names, shapes and layout are spconv's
        mine, other = x.features.clone().requires_grad_(), x.features.clone().requires_grad_()
        out = ours(x.replace_feature(mine))
        wanted = theirs(self.spconv.SparseConvTensor(other, x.indices.int(), list(x.spatial_shape), x.batch_size))
        assert list(wanted.spatial_shape) == list(out.spatial_shape)
        number = _number(out)
        order, their_order = number.argsort(), _number(wanted).argsort()
        assert torch.equal(number[order], _number(wanted)[their_order])
        scale = wanted.features.abs().max()
        assert (out.features[order] - wanted.features[their_order]).abs().max() <= 1e-5 * scale
        cotangent = torch.randn(out.features.shape)
        restored = torch.empty_like(cotangent)
        restored[their_order] = cotangent[order]
        out.features.backward(cotangent)
        wanted.features.backward(restored)
        pairs = [(mine.grad, other.grad)] + [
            (a.grad, b.grad) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True)
        ]
        for actual, expected in pairs:
            assert actual is not None and expected is not None
            assert (actual - expected).abs().max() <= 2e-5 * expected.abs().max()

    @pytest.mark.parametrize("bias", [True, False])
    @pytest.mark.parametrize("seed", range(3))
    def test_random_clouds(self, seed: int, bias: bool) -> None:
        self.compare(tensor(1500, seed=seed), lambda sparse: network(sparse, bias=bias))

    @pytest.mark.parametrize("layer", ["SubMConv3d", "SparseConv3d", "SparseMaxPool3d"])
    def test_single_layers(self, layer: str) -> None:
        def make(sparse: Any) -> nn.Module:
            channels = () if layer == "SparseMaxPool3d" else (4, 7)
            window = getattr(sparse, layer)(*channels, 3, stride=1, padding=1)
            made: nn.Module = sparse.SparseSequential(nn.ReLU(), window)
            return made

        self.compare(tensor(1500), make)

    def test_real_keyframe(self, nuscenes_tiny: Path) -> None:
        self.compare(keyframe(nuscenes_tiny), network)


def _number(x: Any) -> Tensor:
    z, y, x_ = x.spatial_shape
    b, *site = x.indices.long().unbind(1)
    return ((b * z + site[0]) * y + site[1]) * x_ + site[2]
