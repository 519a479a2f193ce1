# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Other libraries that do an op's work, for `Case.peers`.

Each function gives name -> factory; the factory imports its library, so that a missing one only leaves a row out. Peers
use the threads they use: "cores busy" in the tables shows how many (spconv's and mmcv's voxels: one).

* spconv 2.x ``PointToVoxel`` and mmcv's ``Voxelization`` (full build, with compiled ops): `voxelize_hard`
* torch-scatter ``scatter``: `segment_reduce`
* nerfacc ``render_weight_from_alpha`` and ``accumulate_along_rays`` on dense rays: compositing. Its
  ``importance_sampling`` runs on CUDA only.
* spconv's layers: a backbone of `sparse_conv`. Its CPU build adds up wrongly with two threads: it takes part with one.
* spconv's ``BoxOps`` (Boost polygons) and shapely: `box_iou_bev`, `nms_bev` and `points_in_boxes`. They start from
  corners or polygons, which are made outside the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.case import Function, Variant
from pred.data.boxes import corners_bev

Peers = Mapping[str, Callable[[torch.device], Variant]]


def segment_reduce(num_segments: int, reduce: str) -> Peers:
    """For inputs ``(features, index)`` in which no index is -1."""

    def torch_scatter(device: torch.device) -> Variant:
        from torch_scatter import scatter

        return Variant(lambda features, index: (scatter(features, index, 0, None, num_segments, reduce),))

    return {"torch-scatter": torch_scatter}


def composite(alpha: Callable[[Tensor, Tensor], Tensor] | None = None) -> Peers:
    """For inputs ``(sdf, inv_s, t[, values])`` or ``(alpha, t[, values])``; results weights, depth, opacity, values.

    Args:
        alpha: opacities ``[R, S]``, from which nerfacc starts, of ``sdf`` and ``inv_s`` in plain PyTorch; None where
            the inputs hold them.
    """

    def nerfacc(device: torch.device) -> Variant:
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

    def spconv(device: torch.device) -> Variant:
        from spconv.pytorch.utils import PointToVoxel

        make_voxels = PointToVoxel(size, bounds, channels, max_voxels, max_points, device)
        return Variant(_of_one_frame(make_voxels), as_ours=_with_frame)

    def mmcv(device: torch.device) -> Variant:
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


def sparse_backbone(make: Callable[[Any], nn.Module], names: Sequence[str], shape: Sequence[int]) -> Peers:
    """For inputs ``(features, sites, *parameters)`` of one frame; the result is the output sites' features, ascending.

    Args:
        make: the network, from a module that holds the layers.
        names: of its parameters.
        shape: cells (z, y, x).
    """

    def spconv(device: torch.device) -> Variant:
        import spconv.pytorch as library

        on_cpu = device.type == "cpu"
        if on_cpu:
            library.ops.get_current_stream = lambda: 0  # its backward pass asks for CUDA's and does not use it
        net = make(library).to(device)

        def run(features: Tensor, sites: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
            if on_cpu and torch.get_num_threads() != 1:
                raise RuntimeError("spconv's CPU build is right with one thread only")
            x = library.SparseConvTensor(features, sites.int(), list(shape), 1)
            out = torch.func.functional_call(net, dict(zip(names, parameters, strict=True)), (x,))
            z, y, x = out.indices[:, 1:].long().unbind(1)
            order = ((z * out.spatial_shape[1] + y) * out.spatial_shape[2] + x).argsort()
            return (out.features[order],)

        return Variant(run)

    return {"spconv": spconv}


def box_iou(boxes_a: Tensor, boxes_b: Tensor, with_height: bool) -> Peers:
    """For inputs ``(boxes_a, boxes_b)``, all pairs."""
    sizes_a, sizes_b = (boxes[:, 3 : 6 if with_height else 5].prod(dim=1) for boxes in (boxes_a, boxes_b))

    def over_union(shared: Tensor) -> Tensor:
        if with_height:
            top = torch.minimum((boxes_a[:, 2] + boxes_a[:, 5] / 2)[:, None], boxes_b[:, 2] + boxes_b[:, 5] / 2)
            bottom = torch.maximum((boxes_a[:, 2] - boxes_a[:, 5] / 2)[:, None], boxes_b[:, 2] - boxes_b[:, 5] / 2)
            shared = shared * (top - bottom).clamp_min(0)
        return shared / (sizes_a[:, None] + sizes_b - shared)

    def spconv(device: torch.device) -> Variant:
        wrap, box_ops = _spconv_boxes(device)
        # Its tensors do not keep the arrays' memory.
        corners_a, corners_b = _clockwise(boxes_a), _clockwise(boxes_b)

        def run(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
            near = _standing_overlap(corners_a, corners_b)
            found = np.zeros_like(near)
            box_ops.rbbox_iou(wrap(corners_a), wrap(corners_b), wrap(near), wrap(found), 0.0, with_height)
            out = torch.from_numpy(found)
            return (over_union(out) if with_height else out,)

        return Variant(run)

    def shapely(device: torch.device) -> Variant:
        _cpu_only(device)
        import shapely as library

        polygons_a, polygons_b = (library.polygons(corners_bev(boxes.double().numpy())) for boxes in (boxes_a, boxes_b))

        def run(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
            rows, columns = library.STRtree(polygons_b).query(polygons_a, predicate="intersects")
            shared = torch.zeros(len(a), len(b))
            areas = library.area(library.intersection(polygons_a[rows], polygons_b[columns]))
            shared[torch.from_numpy(rows), torch.from_numpy(columns)] = torch.from_numpy(areas).float()
            return (over_union(shared),)

        return Variant(run)

    return {"spconv": spconv, "shapely": shapely}


def nms_bev(boxes: Tensor, scores: Tensor, iou_threshold: float) -> Peers:
    """For inputs ``(boxes, scores)``."""

    def spconv(device: torch.device) -> Variant:
        wrap, box_ops = _spconv_boxes(device)
        corners = _clockwise(boxes)

        def run(boxes: Tensor, scores: Tensor) -> tuple[Tensor, ...]:
            order = scores.argsort(descending=True).int().numpy()
            near = _standing_overlap(corners, corners)
            kept = box_ops.rotate_non_max_suppression_cpu(wrap(corners), wrap(order), wrap(near), iou_threshold)
            return (torch.tensor(list(kept)[len(boxes) :]),)  # before them are as many zeros as there are boxes

        return Variant(run)

    return {"spconv": spconv}


def points_in_boxes(boxes: Tensor, first: bool) -> Peers:
    """For inputs ``(points, boxes)``; the first box of each point, or the mask as uint8."""

    def shapely(device: torch.device) -> Variant:
        _cpu_only(device)
        import shapely as library

        polygons = library.polygons(corners_bev(boxes.double().numpy()))
        library.prepare(polygons)

        def run(points: Tensor, boxes: Tensor) -> tuple[Tensor, ...]:
            x, y, z = points.numpy().T
            low, high = ((boxes[:, 2] + side * boxes[:, 5] / 2).numpy() for side in (-1, 1))
            inside = np.stack(
                [
                    library.intersects_xy(polygon, x, y) & (z >= low[row]) & (z <= high[row])
                    for row, polygon in enumerate(polygons)
                ]
            )
            if not first:
                return (torch.from_numpy(inside).view(torch.uint8),)
            return (torch.from_numpy(np.where(inside.any(axis=0), inside.argmax(axis=0), -1)),)

        return Variant(run)

    return {"shapely": shapely}


def _spconv_boxes(device: torch.device) -> tuple[Callable[[NDArray[np.generic]], Any], Any]:
    """What makes its tensors, and its operations on boxes."""
    _cpu_only(device)
    from cumm import tensorview
    from spconv.core_cc.csrc.utils.boxops import BoxOps

    return tensorview.from_numpy, BoxOps


def _cpu_only(device: torch.device) -> None:
    if device.type != "cpu":
        raise NotImplementedError("works on the CPU only")


def _clockwise(boxes: Tensor) -> NDArray[np.float32]:  # [N, 4, 2]
    return np.ascontiguousarray(corners_bev(boxes.double().numpy())[:, ::-1].astype(np.float32))


def _standing_overlap(corners_a: NDArray[np.float32], corners_b: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N, M] above 0 where the bounds along x and y overlap: spconv's operations skip the other pairs."""
    low_a, high_a, low_b, high_b = corners_a.min(1), corners_a.max(1), corners_b.min(1), corners_b.max(1)
    overlap = np.minimum(high_a[:, None], high_b) - np.maximum(low_a[:, None], low_b)
    return np.ascontiguousarray(overlap.clip(0).prod(axis=2))
