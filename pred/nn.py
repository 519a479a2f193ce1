# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Sparse 3D convolution as modules, with the semantics, shapes and parameter names of spconv 2.x.

Weights are KRSC, ``[out, kz, ky, kx, in]``, so that state dicts move over as they are. What differs from spconv:
strided layers put their output sites in ascending (b, z, y, x) order, int64 indices are taken, every layer runs on the
CPU with any number of threads to the same bits, and a key that is used for another kernel is an error.

M active sites, B frames, C channels; sites are (b, z, y, x). Layers take and give features in float32, float64,
bfloat16 or float16 (of the dtype of the weights; under autocast in its dtype, float64 excepted), also of no site and of
no frame, and are differentiable any number of times in features, weight and bias. They raise what `build_rulebook`,
`sparse_conv` and `sparse_max_pool` raise, and
    ValueError: sizes when they are made; other in_channels; an indice_key of another kernel, grid or other sites.
    TypeError: the input is no `SparseTensor`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pred.ops import build_rulebook, sparse_conv, sparse_max_pool
from pred.ops._check import check_count, check_dtype, check_shape, check_tensors
from pred.ops.build_rulebook import Rulebook, Triple, centred_padding, check_grid, check_sites, output_shape, triple

__all__ = [
    "SparseConv3d",
    "SparseInverseConv3d",
    "SparseMaxPool3d",
    "SparseModule",
    "SparseSequential",
    "SparseTensor",
    "SubMConv3d",
]


class _Sites(NamedTuple):
    """Sites as they were when a rulebook was made of them."""

    indices: Tensor  # [M, 4]
    version: int | None
    """Of the tensor, which counts changes in place. Tensors of inference mode have none."""

    def equal(self, indices: Tensor) -> bool:
        """Whether these are the same, in the same order. The device is waited for only if it is another tensor."""
        if self.version != _version(self.indices):
            return False
        if self.indices is indices or torch.compiler.is_compiling():
            return self.indices.shape == indices.shape
        return torch.equal(self.indices, indices.to(self.indices))


def _version(tensor: Tensor) -> int | None:
    return None if torch.compiler.is_compiling() or tensor.is_inference() else tensor._version


@dataclass(frozen=True, eq=False)
class _KeptRulebook:
    """A rulebook with what it belongs to."""

    rulebook: Rulebook
    in_sites: _Sites
    out_sites: _Sites
    in_shape: Triple
    out_shape: Triple
    kernel: tuple[Triple, Triple, Triple, Triple, bool]
    """Size, stride, padding, dilation, submanifold."""


@dataclass(eq=False)
class SparseTensor:
    """Features at the active sites of a batch of 3D grids.

    Args:
        features: ``[M, C]`` float32, float64, bfloat16 or float16.
        indices: ``[M, 4]`` int32 or int64, (b, z, y, x), distinct, in any order; on the device of the features.
        spatial_shape: cells (z, y, x).
        batch_size: B.
        rulebooks: by indice_key; shared by the tensors that come from one another, and filled by the layers.

    Raises:
        ValueError: shapes, sizes or devices that do not fit. Sites outside the grid and repeated ones are found by the
            first layer, or by `dense` (looked at for CPU tensors).
        TypeError: no tensors, no whole numbers, or dtype of the indices.
    """

    features: Tensor
    indices: Tensor
    spatial_shape: Sequence[int]
    batch_size: int
    rulebooks: dict[str, _KeptRulebook] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        name = "SparseTensor"
        check_tensors(name, features=self.features, indices=self.indices)
        check_shape(name, "indices", self.indices, ("M", 4))
        check_dtype(name, "indices", self.indices, (torch.int32, torch.int64))
        check_shape(name, "features", self.features, (self.indices.shape[0], "C"), " with M of indices")
        if self.features.device != self.indices.device:
            raise ValueError(
                f"{name}: indices must be on the device of features ({self.features.device}), got {self.indices.device}"
            )
        check_count(name, "batch_size", self.batch_size)
        self.spatial_shape = triple(name, "spatial_shape", self.spatial_shape, 1)

    def replace_feature(self, features: Tensor) -> SparseTensor:
        """The same sites with other features ``[M, C']``."""
        return replace(self, features=features)

    def dense(self, channels_first: bool = True) -> Tensor:
        """``[B, C, z, y, x]``, or ``[B, z, y, x, C]``: all cells, with zeros where no site is active. Differentiable.

        Raises:
            ValueError: more than 2^62 cells; sites outside the grid or given twice (looked at for CPU tensors).
        """
        z, y, x = self.spatial_shape
        size, channels = (self.batch_size, z, y, x), self.features.shape[1]
        check_grid("SparseTensor.dense", self.batch_size, (z, y, x))
        site = self.indices.long()
        check_sites("SparseTensor.dense", site, self.batch_size, (z, y, x))
        number = site[:, 0]
        for axis, cells in enumerate(self.spatial_shape):
            number = number * cells + site[:, axis + 1]
        grid = self.features.new_zeros(math.prod(size), channels).index_copy(0, number, self.features)
        grid = grid.view(*size, channels)
        return grid.permute(0, 4, 1, 2, 3).contiguous() if channels_first else grid


class SparseModule(nn.Module):
    """What `SparseSequential` gives a `SparseTensor` instead of its features."""

    def forward(self, x: SparseTensor) -> SparseTensor:
        raise NotImplementedError


class SparseSequential(nn.Sequential, SparseModule):
    """One after the other: sparse modules take the tensor, all others its features ``[M, C]``.

    Raises:
        TypeError: the input is no `SparseTensor`, or a module returned something else than features.
        ValueError: a module returned another number of rows.
    """

    def forward(self, x: SparseTensor) -> SparseTensor:
        _require_sparse(self, x)
        for name, module in self._modules.items():
            assert module is not None
            if isinstance(module, SparseModule):
                x = module(x)
                continue
            features = module(x.features)
            if not isinstance(features, Tensor):
                raise TypeError(
                    f"SparseSequential: module {name} ({_name(module)}) must return features [M, C], got "
                    f"{type(features).__name__}"
                )
            x = x.replace_feature(features)
        return x


class _Kernel(SparseModule):
    """A window over the grid, and the rulebook that it makes or finds by its key."""

    def __init__(
        self,
        kernel_size: int | Sequence[int],
        stride: int | Sequence[int],
        padding: int | Sequence[int],
        dilation: int | Sequence[int],
        indice_key: str | None,
        submanifold: bool = False,
    ) -> None:
        super().__init__()
        self.kernel_size = triple(_name(self), "kernel_size", kernel_size, 1)
        self.stride = triple(_name(self), "stride", stride, 1)
        self.padding = triple(_name(self), "padding", padding, 0)
        self.dilation = triple(_name(self), "dilation", dilation, 1)
        self.indice_key = indice_key
        self.submanifold = submanifold
        if submanifold:
            if any(size % 2 == 0 for size in self.kernel_size):
                raise ValueError(f"SubMConv3d: kernel_size must be odd, got {self.kernel_size}")
            if self.stride != (1, 1, 1):
                raise ValueError(f"SubMConv3d: stride must be 1, got {self.stride}")
            self.padding = centred_padding(_name(self), self.kernel_size, self.dilation)

    def rulebook(self, x: SparseTensor) -> _KeptRulebook:
        """The tensor's rulebook of this window; made where its key holds none yet."""
        _require_sparse(self, x)
        kernel = (self.kernel_size, self.stride, self.padding, self.dilation, self.submanifold)
        kept = x.rulebooks.get(self.indice_key) if self.indice_key is not None else None
        if kept is not None:
            _require_same(self, "kernel_size, stride, padding, dilation and kind", kernel, kept.kernel)
            _require_same(self, "spatial_shape", x.spatial_shape, kept.in_shape)
            if not kept.in_sites.equal(x.indices):
                raise ValueError(f"{_name(self)}: indice_key {self.indice_key!r} must be of the same sites, got others")
            return kept
        z, y, x_ = x.spatial_shape
        shape = (z, y, x_)
        rulebook = build_rulebook(x.indices, x.batch_size, shape, *kernel[:4], submanifold=self.submanifold)
        kept = _KeptRulebook(
            rulebook,
            _Sites(x.indices, _version(x.indices)),
            _Sites(rulebook.out_indices, _version(rulebook.out_indices)),
            shape,
            output_shape(shape, *kernel[:4]),
            kernel,
        )
        if self.indice_key is not None:
            x.rulebooks[self.indice_key] = kept
        return kept

    def extra_repr(self) -> str:
        return (
            f"kernel_size={self.kernel_size}, stride={self.stride}, padding={self.padding}, dilation={self.dilation}, "
            f"indice_key={self.indice_key!r}"
        )


class _Weighted(_Kernel):
    """A window with weights ``[out, kz, ky, kx, in]`` and a bias."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | Sequence[int],
        stride: int | Sequence[int] = 1,
        padding: int | Sequence[int] = 0,
        dilation: int | Sequence[int] = 1,
        groups: int = 1,
        bias: bool = True,
        indice_key: str | None = None,
        submanifold: bool = False,
    ) -> None:
        super().__init__(kernel_size, stride, padding, dilation, indice_key, submanifold)
        if groups != 1:
            raise ValueError(f"{_name(self)}: groups must be 1, got {groups}")
        check_count(_name(self), "in_channels", in_channels)
        check_count(_name(self), "out_channels", out_channels)
        self.in_channels, self.out_channels = in_channels, out_channels
        self.weight = nn.Parameter(torch.empty(out_channels, *self.kernel_size, in_channels))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Uniform within 1 / sqrt(fan-in) for weights and bias, as of torch's convolutions."""
        bound = 1 / math.sqrt(max(1, self.in_channels * math.prod(self.kernel_size)))
        nn.init.uniform_(self.weight, -bound, bound)
        if self.bias is not None:
            nn.init.uniform_(self.bias, -bound, bound)

    def _convolve(self, features: Tensor, out_to_in: Tensor, in_to_out: Tensor) -> Tensor:
        if features.shape[1] != self.in_channels:
            raise ValueError(
                f"{_name(self)}: features must have in_channels={self.in_channels} columns, got {list(features.shape)}"
            )
        device = features.device.type
        if not torch.is_autocast_enabled(device) or features.dtype == torch.float64:
            return sparse_conv(features, self.weight, out_to_in, in_to_out, self.bias)
        dtype = torch.get_autocast_dtype(device)  # as torch's own convolutions, which leave float64 alone too
        bias = None if self.bias is None else self.bias.to(dtype)
        with torch.autocast(device, enabled=False):
            return sparse_conv(features.to(dtype), self.weight.to(dtype), out_to_in, in_to_out, bias)

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Convolves; the outputs are the active sites of the rulebook."""
        kept = self.rulebook(x)
        features = self._convolve(x.features, kept.rulebook.out_to_in, kept.rulebook.in_to_out)
        if self.submanifold:
            return x.replace_feature(features)
        return SparseTensor(features, kept.rulebook.out_indices, kept.out_shape, x.batch_size, x.rulebooks)

    def extra_repr(self) -> str:
        return f"{self.in_channels}, {self.out_channels}, {super().extra_repr()}, bias={self.bias is not None}"


class SubMConv3d(_Weighted):
    """Submanifold convolution: the outputs are the active inputs (Graham et al., 2018).

    Args:
        in_channels, out_channels: C and O.
        kernel_size, dilation: one number or (z, y, x); sizes are odd.
        stride: 1. padding: not used, as in spconv: the window is centred.
        groups: 1.
        bias: whether there is one.
        indice_key: layers that share it, on the same sites with the same kernel, share one rulebook.

    Raises:
        ValueError: an even kernel_size, a stride, groups; see the head of the module.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | Sequence[int],
        stride: int | Sequence[int] = 1,
        padding: int | Sequence[int] = 0,
        dilation: int | Sequence[int] = 1,
        groups: int = 1,
        bias: bool = True,
        indice_key: str | None = None,
    ) -> None:
        super().__init__(
            in_channels, out_channels, kernel_size, stride, padding, dilation, groups, bias, indice_key, True
        )


class SparseConv3d(_Weighted):
    """Convolution whose outputs are all sites that read an active input, in ascending (b, z, y, x) order.

    Args:
        in_channels, out_channels: C and O.
        kernel_size, stride, padding, dilation: one number or (z, y, x).
        groups: 1.
        bias: whether there is one.
        indice_key: under which `SparseInverseConv3d` finds the way back.

    Raises:
        ValueError: groups, or a kernel that the padded grid does not hold; see the head of the module.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | Sequence[int],
        stride: int | Sequence[int] = 1,
        padding: int | Sequence[int] = 0,
        dilation: int | Sequence[int] = 1,
        groups: int = 1,
        bias: bool = True,
        indice_key: str | None = None,
    ) -> None:
        super().__init__(
            in_channels, out_channels, kernel_size, stride, padding, dilation, groups, bias, indice_key, False
        )


class SparseInverseConv3d(_Weighted):
    """Transposed convolution back to the sites that a `SparseConv3d` or `SparseMaxPool3d` came from.

    Args:
        in_channels, out_channels: C and O.
        kernel_size: that of the layer whose way it goes back.
        indice_key: that layer's.
        bias: whether there is one.

    Raises:
        ValueError: no layer before had the key, or it had another kernel size or other output sites.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | Sequence[int],
        indice_key: str,
        bias: bool = True,
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size, bias=bias, indice_key=indice_key)

    def extra_repr(self) -> str:
        return (
            f"{self.in_channels}, {self.out_channels}, kernel_size={self.kernel_size}, "
            f"indice_key={self.indice_key!r}, bias={self.bias is not None}"
        )

    def forward(self, x: SparseTensor) -> SparseTensor:
        _require_sparse(self, x)
        assert self.indice_key is not None
        kept = x.rulebooks.get(self.indice_key)
        if kept is None:
            known = ", ".join(map(repr, x.rulebooks)) or "none"
            raise ValueError(
                f"{_name(self)}: indice_key must be that of a layer before, got {self.indice_key!r} ({known})"
            )
        _require_same(self, "kernel_size", self.kernel_size, kept.kernel[0])
        if not kept.out_sites.equal(x.indices):
            raise ValueError(
                f"{_name(self)}: input must have the sites that indice_key {self.indice_key!r} leads to, got others"
            )
        features = self._convolve(x.features, kept.rulebook.in_to_out, kept.rulebook.out_to_in)
        return SparseTensor(features, kept.in_sites.indices, kept.in_shape, x.batch_size, x.rulebooks)


class SparseMaxPool3d(_Kernel):
    """Maximum over the active sites of each window; sites that are not active do not take part.

    Args:
        kernel_size, padding, dilation: one number or (z, y, x).
        stride: the same; None: kernel_size.
        indice_key: as of `SparseConv3d`.
    """

    def __init__(
        self,
        kernel_size: int | Sequence[int],
        stride: int | Sequence[int] | None = None,
        padding: int | Sequence[int] = 0,
        dilation: int | Sequence[int] = 1,
        indice_key: str | None = None,
    ) -> None:
        super().__init__(kernel_size, kernel_size if stride is None else stride, padding, dilation, indice_key)

    def forward(self, x: SparseTensor) -> SparseTensor:
        kept = self.rulebook(x)
        features = sparse_max_pool(x.features, kept.rulebook.out_to_in, kept.rulebook.in_to_out)
        return SparseTensor(features, kept.rulebook.out_indices, kept.out_shape, x.batch_size, x.rulebooks)


def _name(module: nn.Module) -> str:
    return type(module).__name__


def _require_sparse(module: nn.Module, x: object) -> None:
    if not isinstance(x, SparseTensor):
        raise TypeError(
            f"{_name(module)}: input must be a SparseTensor, got {type(x).__name__} (inside nn.Sequential? "
            "SparseSequential passes sparse tensors on)"
        )


def _require_same(module: _Kernel, what: str, now: object, before: object) -> None:
    if now != before:
        raise ValueError(
            f"{_name(module)}: indice_key {module.indice_key!r} must mean one {what}, got {now} after {before}"
        )
