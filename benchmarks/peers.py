# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Other libraries that do an op's work on the CPU, for `Case.peers`.

Each function gives name -> factory; the factory imports its library, so that a missing one only leaves a row out. Peers
use the threads they use: "cores busy" in the tables shows how many (spconv's and mmcv's voxels: one).

* spconv 2.x ``PointToVoxel`` and mmcv's ``Voxelization`` (full build, with compiled ops): `voxelize_hard`
* torch-scatter ``scatter``: `segment_reduce`
* nerfacc ``render_weight_from_alpha`` and ``accumulate_along_rays`` on dense rays: compositing. Its
  ``importance_sampling`` runs on CUDA only.
* spconv's layers: a backbone of `sparse_conv`. Its CPU build adds up wrongly with two threads: it takes part with one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.case import Function, Variant

Peers = Mapping[str, Callable[[], Variant]]


def segment_reduce(num_segments: int, reduce: str) -> Peers:
    """For inputs ``(features, index)`` in which no index is -1."""

    def torch_scatter() -> Variant:
        from torch_scatter import scatter

        return Variant(lambda features, index: (scatter(features, index, 0, None, num_segments, reduce),))

    return {"torch-scatter": torch_scatter}


def composite(alpha: Callable[[Tensor, Tensor], Tensor] | None = None) -> Peers:
    """For inputs ``(sdf, inv_s, t[, values])`` or ``(alpha, t[, values])``; results weights, depth, opacity, values.

    Args:
        alpha: opacities ``[R, S]``, from which nerfacc starts, of ``sdf`` and ``inv_s`` in plain PyTorch; None where
            the inputs hold them.
    """

    def nerfacc() -> Variant:
        from nerfacc import accumulate_along_rays, render_weight_from_alpha

        def render(*inputs: Tensor) -> tuple[Tensor, ...]:
            opacities, (t, *values) = (inputs[0], inputs[1:]) if alpha is None else (alpha(*inputs[:2]), inputs[2:])
            weights, _ = render_weight_from_alpha(opacities)
            depth = accumulate_along_rays(weights, t[..., None])[:, 0]
            opacity = accumulate_along_rays(weights)[:, 0]
            return weights, depth, opacity, *(accumulate_along_rays(weights, value) for value in values)

        return Variant(render)

    return {"nerfacc": nerfacc}


def voxelize_hard(
    channels: int, voxel_size: Sequence[float], point_range: Sequence[float], max_points: int, max_voxels: int
) -> Peers:
    """For inputs ``(points, batch_offsets)`` of one frame, and the results voxels, coords and counts."""
    size, bounds = list(voxel_size), list(point_range)

    def spconv() -> Variant:
        from spconv.pytorch.utils import PointToVoxel

        make_voxels = PointToVoxel(size, bounds, channels, max_voxels, max_points)
        return Variant(_of_one_frame(make_voxels), as_ours=_with_frame)

    def mmcv() -> Variant:
        from mmcv.ops import Voxelization

        make_voxels = Voxelization(size, bounds, max_points, max_voxels)
        return Variant(_of_one_frame(make_voxels.eval()), as_ours=_with_frame)

    return {"spconv": spconv, "mmcv": mmcv}


def _of_one_frame(make_voxels: Callable[[Tensor], Sequence[Tensor]]) -> Function:
    def run(points: Tensor, batch_offsets: Tensor) -> tuple[Tensor, ...]:
        if len(batch_offsets) != 2:
            raise ValueError(f"a peer takes one frame at a time, got {len(batch_offsets) - 1}")
        return tuple(make_voxels(points))

    return run


def _with_frame(results: list[Tensor]) -> list[Tensor]:
    """Voxels, (z, y, x) and counts with the frame's number before each coordinate, as int64."""
    voxels, coords, counts = results
    return [voxels, torch.nn.functional.pad(coords.long(), (1, 0)), counts.long()]


def sparse_backbone(
    make: Callable[[Any], nn.Module], names: Sequence[str], sites: Tensor, shape: Sequence[int]
) -> Peers:
    """For inputs ``(features, *parameters)`` of one frame; the result is the output sites' features, ascending.

    Args:
        make: the network, from a module that holds the layers.
        names: of its parameters.
        sites, shape: (b, z, y, x) of the features, and cells (z, y, x).
    """

    def spconv() -> Variant:
        import spconv.pytorch as library

        library.ops.get_current_stream = lambda: 0  # its backward pass asks for CUDA's and does not use it
        net, indices = make(library), sites.int()

        def run(features: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
            if torch.get_num_threads() != 1:
                raise RuntimeError("spconv's CPU build is right with one thread only")
            x = library.SparseConvTensor(features, indices, list(shape), 1)
            out = torch.func.functional_call(net, dict(zip(names, parameters, strict=True)), (x,))
            z, y, x = out.indices[:, 1:].long().unbind(1)
            order = ((z * out.spatial_shape[1] + y) * out.spatial_shape[2] + x).argsort()
            return (out.features[order],)

        return Variant(run)

    return {"spconv": spconv}
