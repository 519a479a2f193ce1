# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""build_rulebook, sparse_conv and sparse_max_pool. What holds for every op is in test_contract.py."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from pred.ops import build_rulebook, reference, sparse_conv, sparse_max_pool
from pred.ops.build_rulebook import Rulebook, output_shape
from tests.conftest import KERNEL_ERROR, LAUNCHED, require_value_checks

Triple = tuple[int, int, int]

KERNELS: list[dict[str, Any]] = [
    {"kernel_size": 3, "submanifold": True},
    {"kernel_size": (3, 1, 5), "dilation": (1, 1, 2), "submanifold": True},
    {"kernel_size": 3, "stride": 2, "padding": 1},
    {"kernel_size": 3, "stride": 2, "padding": (0, 1, 1)},
    {"kernel_size": (3, 1, 1), "stride": (2, 1, 1)},
    {"kernel_size": 2, "stride": 2},
    {"kernel_size": (4, 2, 3), "stride": (1, 3, 2), "padding": (2, 0, 1), "dilation": (1, 2, 2)},
    {"kernel_size": 1},
    {"kernel_size": 3, "padding": 2},
]


def sites(count: int, batch_size: int, shape: Triple, seed: int = 0) -> Tensor:
    """Distinct sites in any order."""
    generator = torch.Generator().manual_seed(seed)
    z, y, x = shape
    number = torch.randperm(batch_size * z * y * x, generator=generator)[:count]
    return torch.stack([number // (z * y * x), number // (y * x) % z, number // x % y, number % x], dim=1)


def dense(features: Tensor, indices: Tensor, batch_size: int, shape: Triple) -> Tensor:
    grid = features.new_zeros(batch_size, *shape, features.shape[1])
    return grid.index_put(tuple(indices.long().unbind(1)), features).permute(0, 4, 1, 2, 3)


def dense_arguments(kernel: dict[str, Any]) -> dict[str, Any]:
    """Those of conv3d for the same window."""
    size = _triple(kernel["kernel_size"])
    dilation = _triple(kernel.get("dilation", 1))
    if kernel.get("submanifold"):
        return {"padding": [d * (k // 2) for d, k in zip(dilation, size, strict=True)], "dilation": dilation}
    return {"stride": kernel.get("stride", 1), "padding": kernel.get("padding", 0), "dilation": dilation}


def _triple(value: int | Sequence[int]) -> Triple:
    z, y, x = (value, value, value) if isinstance(value, int) else value
    return z, y, x


def at(grid: Tensor, indices: Tensor) -> Tensor:
    """Rows of [B, C, D, H, W] at sites."""
    b, z, y, x = indices.long().unbind(1)
    return grid[b, :, z, y, x]


def test_hand_computed(backend: str) -> None:
    """A line of five cells, sites at x = 0, 1 and 3; a window of three, as convolution and with stride two."""
    indices = torch.tensor([[0, 0, 0, 3], [0, 0, 0, 0], [0, 0, 0, 1]])
    features = torch.tensor([[10.0], [1.0], [2.0]])
    weight = torch.tensor([[[100.0], [10.0], [1.0]]])  # taps x - 1, x, x + 1
    same = build_rulebook(indices, 1, (1, 1, 5), (1, 1, 3), submanifold=True)
    assert same.out_indices.tolist() == indices.tolist()
    assert same.out_to_in.tolist() == [[-1, 0, -1], [-1, 1, 2], [1, 2, -1]]
    assert same.in_to_out.tolist() == [[-1, 0, -1], [2, 1, -1], [-1, 2, 1]]
    out = sparse_conv(features, weight, same.out_to_in, same.in_to_out, torch.tensor([0.5]))
    assert out.tolist() == [[100.5], [12.5], [120.5]]
    assert sparse_max_pool(-features, same.out_to_in, same.in_to_out).tolist() == [[-10.0], [-1.0], [-1.0]]

    half = build_rulebook(
        indices, 1, (1, 1, 5), (1, 1, 3), (1, 1, 2), (0, 0, 1)
    )  # outputs 0, 1, 2 read -1..1, 1..3, 3..5
    assert half.out_indices.tolist() == [[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 2]]
    assert half.out_to_in.tolist() == [[-1, 1, 2], [2, -1, 0], [0, -1, -1]]
    assert half.in_to_out.tolist() == [[2, -1, 1], [-1, 0, -1], [1, -1, 0]]
    out = sparse_conv(features, weight, half.out_to_in, half.in_to_out)
    assert out.tolist() == [[12.0], [210.0], [1000.0]]
    back = sparse_conv(out, weight, half.in_to_out, half.out_to_in)
    assert back.tolist() == [[1000.0 * 100 + 210.0], [120.0], [210.0 * 100 + 12.0]]


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("count", [0, 1, 60, 300])
def test_equals_dense_convolution(backend: str, kernel: dict[str, Any], count: int) -> None:
    """Values and gradients in float64; the active outputs are those that read an active input."""
    batch_size, shape = 2, (7, 8, 9)
    indices = sites(count, batch_size, shape)
    rulebook = build_rulebook(indices, batch_size, shape, **kernel)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(count, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    size = _triple(kernel["kernel_size"])
    weight = torch.randn(6, *size, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(6, generator=generator, dtype=torch.float64, requires_grad=True)

    window = dense_arguments(kernel)
    ones = dense(torch.ones(count, 1, dtype=torch.float64), indices, batch_size, shape)
    reached = F.conv3d(ones, torch.ones(1, 1, *size, dtype=torch.float64), **window)
    arguments = (_triple(window.get(name, 1)) for name in ("stride", "padding", "dilation"))
    assert tuple(reached.shape[2:]) == output_shape(shape, size, *arguments)
    active = indices if kernel.get("submanifold") else (reached[:, 0] > 0.5).nonzero()
    assert torch.equal(rulebook.out_indices, active)
    assert torch.equal((rulebook.out_to_in >= 0).sum(dim=1).double(), at(reached, active)[:, 0])

    expected = at(
        F.conv3d(dense(features, indices, batch_size, shape), weight.permute(0, 4, 1, 2, 3), bias, **window), active
    )
    out = sparse_conv(features, weight, rulebook.out_to_in, rulebook.in_to_out, bias)
    assert out.shape == expected.shape
    cotangent = torch.randn(out.shape, generator=generator, dtype=torch.float64)
    leaves = (features, weight, bias)
    actual = (out, *torch.autograd.grad(out, leaves, cotangent))
    for value, wanted in zip(actual, (expected, *torch.autograd.grad(expected, leaves, cotangent)), strict=True):
        assert (value - wanted).abs().max() <= 1e-12 * wanted.abs().max().clamp_min(1) if value.numel() else True


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_exchanged_tables_are_the_transposed_convolution(backend: str, kernel: dict[str, Any]) -> None:
    batch_size, shape = 2, (6, 5, 7)
    indices = sites(70, batch_size, shape)
    rulebook = build_rulebook(indices, batch_size, shape, **kernel)
    window, size = dense_arguments(kernel), _triple(kernel["kernel_size"])
    generator = torch.Generator().manual_seed(2)
    features = torch.randn(rulebook.out_indices.shape[0], 4, generator=generator, dtype=torch.float64)
    weight = torch.randn(3, *size, 4, generator=generator, dtype=torch.float64)
    # The derivative of a convolution in its input is the transposed one.
    grid = torch.zeros(batch_size, 3, *shape, dtype=torch.float64, requires_grad=True)
    result = F.conv3d(grid, weight.permute(4, 0, 1, 2, 3), **window)
    (expected,) = torch.autograd.grad(
        result, grid, dense(features, rulebook.out_indices, batch_size, _triple(result.shape[2:]))
    )
    actual = sparse_conv(features, weight, rulebook.in_to_out, rulebook.out_to_in)
    torch.testing.assert_close(actual, at(expected, indices), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_max_pool_equals_dense_pooling(backend: str, kernel: dict[str, Any]) -> None:
    """By gathering every window of the dense grid, with -inf where no site is active."""
    batch_size, shape = 2, (6, 5, 7)
    indices = sites(90, batch_size, shape)
    rulebook = build_rulebook(indices, batch_size, shape, **kernel)
    generator = torch.Generator().manual_seed(3)
    features = torch.randn(90, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    size = _triple(kernel["kernel_size"])
    grid = dense(features - 100, indices, batch_size, shape)  # active sites are not 0
    taps = math.prod(size)
    one_hot = torch.eye(taps, dtype=torch.float64).view(taps, 1, *size)
    window = dense_arguments(kernel)
    each = [at(F.conv3d(grid[:, c : c + 1], one_hot, **window), rulebook.out_indices) for c in range(3)]
    values = torch.stack(each, dim=2)  # [M', K, C]
    expected = torch.where(values == 0, -torch.inf, values + 100).amax(dim=1)
    out = sparse_max_pool(features, rulebook.out_to_in, rulebook.in_to_out)
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-12)
    cotangent = torch.randn(out.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(
        torch.autograd.grad(out, features, cotangent)[0],
        torch.autograd.grad(expected, features, cotangent)[0],
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize("kernel", [KERNELS[0], KERNELS[2], KERNELS[6]], ids=str)
def test_gradcheck(native: None, kernel: dict[str, Any]) -> None:
    indices = sites(14, 2, (4, 5, 6))
    rulebook = build_rulebook(indices, 2, (4, 5, 6), **kernel)
    tables = rulebook.out_to_in, rulebook.in_to_out
    features = torch.randn(14, 2, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(3, tables[0].shape[1], 2, dtype=torch.float64, requires_grad=True)
    bias = torch.randn(3, dtype=torch.float64, requires_grad=True)

    def convolve(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return sparse_conv(features, weight, *tables, bias)

    assert torch.autograd.gradcheck(convolve, (features, weight, bias))
    assert torch.autograd.gradgradcheck(convolve, (features, weight, bias))
    assert torch.autograd.gradcheck(lambda x: sparse_max_pool(x, *tables), (features,))
    assert torch.autograd.gradgradcheck(lambda x: sparse_max_pool(x, *tables), (features,))


def test_a_thousand_problems_have_the_same_bits_with_two_threads(native: None) -> None:
    """Rulebook, values and all gradients. Sizes pass the tiles' and the blocks' edges."""
    generator = torch.Generator().manual_seed(4)

    def draw(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    for problem in range(1000):
        shape = (draw(3, 12), draw(8, 40), draw(8, 40))
        batch_size = draw(1, 3)
        count = min(draw(0, 3000) if problem % 10 else draw(4000, 9000), batch_size * math.prod(shape))
        indices = sites(count, batch_size, shape, problem)
        kernel = KERNELS[problem % len(KERNELS)]
        if problem % len(KERNELS) == 6:  # its window needs more cells
            kernel = KERNELS[2]
        channels, outputs = draw(1, 20), draw(1, 20)
        taps = math.prod(_triple(kernel["kernel_size"]))
        features = torch.randn(count, channels, generator=generator)
        weight = torch.randn(outputs, taps, channels, generator=generator)
        bias = torch.randn(outputs, generator=generator)
        found: list[list[Tensor]] = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            rulebook = build_rulebook(indices, batch_size, shape, **kernel)
            leaves = [x.clone().requires_grad_() for x in (features, weight, bias)]
            out = sparse_conv(leaves[0], leaves[1], rulebook.out_to_in, rulebook.in_to_out, leaves[2])
            pooled = sparse_max_pool(leaves[0], rulebook.out_to_in, rulebook.in_to_out)
            loss_grads = torch.autograd.grad([out, pooled], leaves, [out.detach().cos(), pooled.detach().sin()])
            found.append([*rulebook, out.detach(), pooled.detach(), *loss_grads])
        for one, two in zip(*found, strict=True):
            assert torch.equal(one, two), f"problem {problem}: {count} sites, {kernel}"


@pytest.mark.parametrize("exchanged", [False, True], ids=["", "transposed"])
@pytest.mark.parametrize("kernel", [KERNELS[0], KERNELS[2]], ids=str)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_half_precision_is_rounded_once(
    native: None, dtype: torch.dtype, kernel: dict[str, Any], exchanged: bool
) -> None:
    """Sums of exact products are exact in float32: whole numbers below 2^24, here below 256, which halves hold too."""
    indices = sites(500, 1, (5, 12, 12))
    rulebook = build_rulebook(indices, 1, (5, 12, 12), **kernel)
    tables = (rulebook.in_to_out, rulebook.out_to_in) if exchanged else (rulebook.out_to_in, rulebook.in_to_out)
    generator = torch.Generator().manual_seed(5)
    features = torch.randint(-2, 3, (len(tables[1]), 33), generator=generator)
    weight = torch.randint(-1, 2, (18, 27, 33), generator=generator)
    bias = torch.randint(-3, 4, (18,), generator=generator)
    leaves = [x.to(dtype).requires_grad_() for x in (features, weight, bias)]
    wide = [x.double().requires_grad_() for x in (features, weight, bias)]
    out = sparse_conv(leaves[0], leaves[1], *tables, leaves[2])
    exact = reference.sparse_conv(wide[0], wide[1], *tables, wide[2])
    assert out.dtype == dtype and torch.equal(out, exact.to(dtype))
    cotangent = torch.randint(-1, 2, out.shape, generator=generator)
    actual = torch.autograd.grad(out, leaves, cotangent.to(dtype))
    for value, wanted in zip(actual, torch.autograd.grad(exact, wide, cotangent.double()), strict=True):
        assert value.dtype == dtype and torch.equal(value, wanted.to(dtype))
    pooled = sparse_max_pool(leaves[0], *tables)
    assert pooled.dtype == dtype and torch.equal(pooled, reference.sparse_max_pool(wide[0], *tables).to(dtype))


@pytest.mark.parametrize("taps", [1, 3])
def test_gradients_of_many_rows_are_precise(native: None, taps: int) -> None:
    """Equal contributions, which a running float32 sum of 2^19 rows gets wrong in the third digit."""
    rows = 2**19
    table = torch.arange(rows, dtype=torch.int32)[:, None].expand(-1, taps).contiguous()
    leaves = [torch.ones(rows, 1), torch.ones(2, taps, 1, requires_grad=True), torch.ones(2, requires_grad=True)]
    out = sparse_conv(leaves[0], leaves[1], table, table, leaves[2])
    exact = rows * float(torch.tensor(0.1))
    for grad in torch.autograd.grad(out, leaves[1:], torch.full_like(out, 0.1)):
        torch.testing.assert_close(grad.double(), torch.full_like(grad, exact).double(), rtol=1e-5, atol=0)


def test_columns_of_a_grid_of_powers_of_two(native: None) -> None:
    """Numbers of such sites are multiples of 2^40. With a hash of their low bits all begin in one slot, and a table of
    so many takes minutes; it should take a tenth of a second.
    """
    shape, count = (2**18, 2**20, 2**20), 200_000
    indices = torch.zeros(count, 4, dtype=torch.int64)
    indices[:, 1] = torch.arange(count)
    begin = time.process_time()
    rulebook = build_rulebook(indices, 1, shape, (3, 1, 1), submanifold=True)
    assert time.process_time() - begin < 10
    rows = torch.arange(count, dtype=torch.int32)
    assert torch.equal(rulebook.out_to_in[:, 1], rows) and torch.equal(rulebook.out_to_in[1:, 0], rows[:-1])


def test_a_nan_stays_in_the_outputs_that_read_it(backend: str) -> None:
    indices = sites(200, 1, (4, 12, 12))
    rulebook = build_rulebook(indices, 1, (4, 12, 12), 3, submanifold=True)
    features = torch.randn(200, 4)
    features[17, 2] = torch.nan
    reads = (rulebook.out_to_in == 17).any(dim=1)
    assert 1 < int(reads.sum()) < 30
    out = sparse_conv(features, torch.randn(6, 27, 4), rulebook.out_to_in, rulebook.in_to_out)
    assert torch.equal(out.isnan(), reads[:, None].expand(-1, 6))
    pooled = sparse_max_pool(features, rulebook.out_to_in, rulebook.in_to_out)
    assert torch.equal(pooled.isnan()[:, 2], reads)
    assert not pooled[:, [0, 1, 3]].isnan().any()


def test_int32_indices_and_large_grids(backend: str) -> None:
    """A grid whose sites have numbers beyond 2^40."""
    shape = (2**14, 2**14, 2**14)
    indices = torch.tensor([[1, 2**14 - 1, 2**14 - 1, 2**14 - 1], [0, 0, 0, 0], [1, 2**14 - 1, 2**14 - 1, 2**14 - 2]])
    rulebook = build_rulebook(indices.int(), 2, shape, 3, submanifold=True)
    assert rulebook.out_indices.dtype == torch.int32 and rulebook.out_to_in.dtype == torch.int32
    pairs = (rulebook.out_to_in >= 0).nonzero().tolist()
    assert pairs == [[0, 12], [0, 13], [1, 13], [2, 13], [2, 14]]
    half = build_rulebook(indices, 2, shape, 2, 2)
    assert half.out_indices.tolist() == [[0, 0, 0, 0], [1, 2**13 - 1, 2**13 - 1, 2**13 - 1]]


@pytest.mark.parametrize(
    "change,error,text",
    [
        ({"indices": torch.zeros(3, 3, dtype=torch.int64)}, ValueError, r"indices must have shape \[M, 4\]"),
        ({"indices": torch.zeros(3, 4)}, TypeError, "indices must be int32 or int64"),
        ({"spatial_shape": (4, 5)}, ValueError, "spatial_shape must hold 3 numbers"),
        ({"spatial_shape": (4, 0, 6)}, ValueError, "spatial_shape must be at least 1, got 0"),
        ({"spatial_shape": (2**30, 2**30, 2**30)}, ValueError, r"at most 2\^62 sites"),
        ({"kernel_size": 2, "submanifold": True}, ValueError, "kernel_size must be odd"),
        ({"kernel_size": (7, 1, 1)}, ValueError, "spatial_shape must hold the kernel"),
        ({"kernel_size": 17, "padding": 9}, ValueError, "at most 4096 taps"),
        ({"stride": 0}, ValueError, "stride must be at least 1, got 0"),
        ({"padding": -1}, ValueError, "padding must be at least 0, got -1"),
        ({"dilation": (1, 1, 0)}, ValueError, "dilation must be at least 1, got 0"),
        ({"batch_size": -1}, ValueError, "batch_size must be at least 0, got -1"),
    ],
)
def test_wrong_rulebook_arguments(backend: str, change: dict[str, Any], error: type, text: str) -> None:
    arguments: dict[str, Any] = {
        "indices": sites(5, 2, (4, 5, 6)),
        "batch_size": 2,
        "spatial_shape": (4, 5, 6),
    } | change
    with pytest.raises(error, match=f"^build_rulebook: .*{text}"):
        build_rulebook(**arguments)


@pytest.mark.parametrize(
    "indices,text",
    [
        ([[0, 0, 0, 0], [2, 0, 0, 0]], "indices must lie inside .* in row 1"),
        ([[0, 0, 0, 0], [0, 4, 0, 0]], r"indices must lie inside .*got \[0, 4, 0, 0\] in row 1"),
        ([[0, -1, 0, 0]], r"indices must lie inside .*got \[0, -1, 0, 0\] in row 0"),
        ([[0, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 1]], "indices must be distinct, got one site in rows 0 and 2"),
    ],
)
def test_wrong_sites(backend: str, indices: list[list[int]], text: str) -> None:
    require_value_checks(backend)
    with pytest.raises(ValueError, match=f"^build_rulebook: {text}"):
        build_rulebook(torch.tensor(indices), 2, (4, 5, 6), 3)


def rulebook_of(count: int) -> Rulebook:
    return build_rulebook(sites(count, 1, (4, 5, 6)), 1, (4, 5, 6), 3, 2, 1)


@pytest.mark.parametrize(
    "change,error,text",
    [
        ({"weight": torch.zeros(3, 26, 2)}, ValueError, r"weight must have shape \[O, 27, 2\]"),
        ({"weight": torch.zeros(3, 3, 3, 3, 4)}, ValueError, r"weight must have shape \[O, kz, ky, kx, 2\]"),
        ({"weight": torch.zeros(3, 27, 2, dtype=torch.float64)}, TypeError, "weight must have the dtype of features"),
        ({"bias": torch.zeros(4)}, ValueError, r"bias must have shape \[3\]"),
        ({"in_to_out": torch.full((8, 27), -1, dtype=torch.int32)}, ValueError, r"in_to_out must have shape \[9, 27\]"),
        ({"in_to_out": torch.full((9, 27), 99, dtype=torch.int32)}, ValueError, r"in_to_out must lie in \[-1, "),
        ({"in_to_out": torch.full((9, 27), -2, dtype=torch.int32)}, ValueError, "got -2 in row 0"),
        ({"in_to_out": torch.full((9, 27), -1)}, TypeError, "in_to_out must be int32"),
    ],
)
def test_wrong_convolution_arguments(backend: str, change: dict[str, Any], error: type, text: str) -> None:
    rulebook = rulebook_of(9)
    arguments = {
        "features": torch.zeros(9, 2),
        "weight": torch.zeros(3, 27, 2),
        "out_to_in": rulebook.out_to_in,
        "in_to_out": rulebook.in_to_out,
    }
    with pytest.raises(error, match=f"^sparse_conv: .*{text}"):
        sparse_conv(**(arguments | change))


def test_direct_calls_are_checked(native: None) -> None:
    """Of the bindings, for which no Python has looked at the arguments."""
    call, line = torch.ops.pred, torch.zeros(2, 4, dtype=torch.int64)
    line[1, 3] = 1
    sizes = ([1, 1, 5], [1, 1, 3], [1, 1, 1], [0, 0, 1], [1, 1, 1])
    table = torch.tensor([[-1, 0, 1], [0, 1, -1]], dtype=torch.int32)
    features, weight = torch.zeros(2, 4), torch.zeros(3, 3, 4)
    with pytest.raises(KERNEL_ERROR, match="build_rulebook: indices must have dtype Long, got Int"):
        call.build_rulebook(line.int(), 1, *sizes, True)
    with pytest.raises(KERNEL_ERROR, match=r"padding must be .* got 2 and 1 for a kernel_size of 3"):
        call.build_rulebook(line, 1, *sizes[:3], [0, 0, 2], [1, 1, 1], True)
    with pytest.raises(KERNEL_ERROR, match=r"spatial_shape must give at most 2\^62 sites .* got \[1073741824, "):
        call.build_rulebook(line, 1, [2**30] * 3, *sizes[1:], True)
    with pytest.raises(KERNEL_ERROR, match=r"sparse_conv: weight must have shape \[O, K, 4\], got \[3, 3, 5\]"):
        call.sparse_conv(features, torch.zeros(3, 3, 5), None, table, table, False)
    with pytest.raises(KERNEL_ERROR, match=r"sparse_conv: bias must have shape \[3\], got \[4\]"):
        call.sparse_conv(features, weight, torch.zeros(4), table, table, False)
    with pytest.raises(KERNEL_ERROR, match=r"sparse_conv_backward: grad must have shape \[2, 3\], got \[2, 4\]"):
        call.sparse_conv_backward(features, features, weight, table, table, True, True, False)
    with pytest.raises(KERNEL_ERROR, match="sparse_max_pool: in_to_out must have dtype Int, got Long"):
        call.sparse_max_pool(features, table, table.long())
    with pytest.raises(KERNEL_ERROR, match=r"sparse_max_pool_backward: winner must have shape \[2, 4\], got \[3, 4\]"):
        call.sparse_max_pool_backward(features, torch.zeros(3, 4, dtype=torch.int32), table)
    require_value_checks("native")
    with pytest.raises(KERNEL_ERROR, match=r"indices must lie inside batch_size 1 .* got \[0, 0, 0, 5\] in row 0"):
        call.build_rulebook(line + torch.tensor([0, 0, 0, 5]), 1, *sizes, True)
    with pytest.raises(KERNEL_ERROR, match="indices must be distinct, got one site in rows 0 and 1"):
        call.build_rulebook(0 * line, 1, *sizes, True)
    with pytest.raises(KERNEL_ERROR, match=r"sparse_conv: out_to_in must lie in \[-1, 2\), got 2 in row 0"):
        call.sparse_conv(features, weight, None, table + (table == 1), table, False)


@pytest.mark.skipif(not LAUNCHED, reason="sites are checked")
@pytest.mark.parametrize("submanifold", [False, True])
def test_unchecked_sites_outside_feed_nothing(native: None, submanifold: bool) -> None:
    far = torch.tensor([[0, 0, 0, 9], [-1, 0, 0, 0], [1, 0, 0, 0], [0, 2**62, 0, 1], [0, 0, -(2**62), 1]])
    near, sizes = sites(7, 1, (4, 5, 6)), ([4, 5, 6], [3, 3, 3], [1, 1, 1], [1, 1, 1], [1, 1, 1])
    call = torch.ops.pred.build_rulebook
    expected = call(near, 1, *sizes, submanifold)
    found = call(torch.cat([near, far]), 1, *sizes, submanifold)
    assert torch.equal(found[2][:7], expected[2]) and (found[2][7:] == -1).all()
    assert torch.equal(found[1][: len(expected[1])], expected[1]) and (found[1][len(expected[1]) :] == -1).all()
    call(near[:1].expand(5, 4).contiguous(), 1, *sizes, submanifold)  # one site many times


@pytest.mark.skipif(not LAUNCHED, reason="the tables are checked")
def test_unchecked_numbers_count_as_none(native: None) -> None:
    table = torch.tensor([[-1, 0, 1], [0, 1, -1]], dtype=torch.int32)
    wrong = torch.tensor([[2, 0, 1], [0, 1, -(2**31)]], dtype=torch.int32)
    generator = torch.Generator().manual_seed(0)
    features, weight = torch.randn(2, 4, generator=generator), torch.randn(3, 3, 4, generator=generator)
    grad, call = torch.randn(2, 3, generator=generator), torch.ops.pred
    assert torch.equal(
        call.sparse_conv(features, weight, None, wrong, table, False),
        call.sparse_conv(features, weight, None, table, table, False),
    )
    for actual, expected in zip(
        call.sparse_conv_backward(grad, features, weight, wrong, wrong, True, True, False),
        call.sparse_conv_backward(grad, features, weight, table, table, True, True, False),
        strict=True,
    ):
        assert torch.equal(actual, expected)
    pooled, winner = call.sparse_max_pool(features, table, table)
    assert torch.equal(call.sparse_max_pool(features, wrong, wrong)[0], pooled)
    assert torch.equal(
        call.sparse_max_pool_backward(features, winner, wrong), call.sparse_max_pool_backward(features, winner, table)
    )


@pytest.mark.parametrize(
    "make,text",
    [
        (lambda f, t: sparse_max_pool(f[0], t, t), r"sparse_max_pool: features must have shape \[M, C\], got \[4\]"),
        (lambda f, t: sparse_max_pool(f, t, t[:, :2]), r"in_to_out must have shape \[2, 3\] as features and out_to_in"),
        (lambda f, t: sparse_max_pool(f, t + 1, t), r"out_to_in must lie in \[-1, 2\), got 2 in row 0"),
    ],
)
def test_wrong_tables_of_a_pool(backend: str, make: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make(torch.zeros(2, 4), torch.tensor([[-1, 0, 1], [0, 1, -1]], dtype=torch.int32))


def test_a_dilation_beyond_the_grid(backend: str) -> None:
    with pytest.raises(ValueError, match=r"build_rulebook: dilation must keep half the kernel within 2\^30 cells, got"):
        build_rulebook(torch.zeros(1, 4, dtype=torch.int64), 1, (4, 4, 4), 5, dilation=2**30, submanifold=True)
