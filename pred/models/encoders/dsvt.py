# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""DSVT-P: attention among the pillars of small sets (Wang et al., "DSVT: Dynamic Sparse Voxel Transformer with Rotated
Sets", CVPR 2023).

Parameter names and numerics are those of DSVT's and OpenPCDet's one-stage pillar configurations; the state dict is
theirs below ``backbone_3d.``. Two things are done otherwise, with equal results:

*Sets.* Published as slots: in a window of n pillars, sorted by position, slot j of set i takes pillar
``floor((i S + j) n / (k S))``, with ``k = ceil(n / S)`` sets of S slots; a slot that repeats its predecessor is masked
as a key. As ``(k - 1) S < n <= k S``, no pillar falls into two sets, and the sets are the runs of sorted pillars that
start at ``floor(i n / k)``: attention within these runs, of at most S pillars each, is the same thing without the
repeats. (Where repeats are written back, DSVT keeps any one of them: they have equal values. Here there is one.)

*Position embedding.* It depends on nothing but the cell within the window, so it is computed once per cell, and batch
normalisation weighs each cell by its pillars.

A quirk of the published code is kept, because released weights were trained with it: layer i of each block embeds the
positions in the windows of shift i, whatever windows the block attends in (DSVT issue 50).

M pillars, C feature channels, H heads, S largest set, B frames.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LENGTH_STEP = 16
"""Sets whose lengths round up to the same multiple of this attend together."""


@dataclass
class DSVTConfig:
    """Sizes of DSVT-P; the defaults are its nuScenes configuration (pillars of 0.3 m, `vfe_filters` [128, 128])."""

    d_model: int = 128
    """Feature channels of a pillar, those that the pillar features must have."""
    num_heads: int = 8
    """Attention heads."""
    ffn_channels: int = 256
    """Hidden channels of the feed-forward layers."""
    num_blocks: int = 4
    """Blocks of two layers each: the first attends in sets along x, row after row, the second along y."""
    set_size: int = 90
    """Largest number of pillars that attend to one another."""
    window: tuple[int, int] = (30, 30)
    """Pillars in x and y of a window; sets do not cross windows."""
    hybrid_factor: tuple[int, int] = (1, 1)
    """Factors of the window in x and y in every second block, whose windows are also shifted by half of `window`."""

    def __post_init__(self) -> None:
        for name in ("d_model", "num_heads", "ffn_channels", "num_blocks", "set_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"DSVTConfig: {name} must be at least 1, got {getattr(self, name)}")
        for name in ("window", "hybrid_factor"):
            value = getattr(self, name)
            if len(value) != 2 or min(value) < 1:
                raise ValueError(f"DSVTConfig: {name} must be two integers (x, y) of at least 1, got {value}")
        if self.d_model % self.num_heads:
            raise ValueError(
                f"DSVTConfig: d_model must be a multiple of num_heads = {self.num_heads}, got {self.d_model}"
            )

    @property
    def windows(self) -> tuple[tuple[tuple[int, int], tuple[int, int]], ...]:
        """Window and shift (each x, y) of the even and of the odd blocks."""
        (x, y), (factor_x, factor_y) = self.window, self.hybrid_factor
        return ((x, y), (0, 0)), ((x * factor_x, y * factor_y), (x // 2, y // 2))


class SetPartition(NamedTuple):
    """Pillars in sets, for one placement of the windows."""

    order: Tensor
    """`[2, M]` int64: pillars sorted by window, then in it by (y, x) in row 0 and by (x, y) in row 1."""
    offsets: Tensor
    """`[sets + 1]` int64: set i is ``order[:, offsets[i]:offsets[i + 1]]``, in either order."""
    cell: Tensor
    """`[M]` int64: each pillar's cell in its window, ``y * window_x + x``."""


def set_partition(
    coords: Tensor,  # [M, 4] int64
    grid_size: tuple[int, int],
    window: tuple[int, int],
    shift: tuple[int, int],
    set_size: int,
) -> SetPartition:
    """Divides the pillars of each window into sets of at most `set_size` (DSVT, Eq. 3 to 5).

    Pillar (y, x) lies in window ``((y + shift_y) // window_y, (x + shift_x) // window_x)`` of its frame. A window of n
    pillars has ``k = ceil(n / set_size)`` sets; set i begins at its sorted pillar ``floor(i n / k)``. Sets differ by at
    most one pillar and none is empty. Not differentiable; deterministic; all in integers.

    Args:
        coords: (b, z, y, x) of each pillar, in any order, no two alike.
        grid_size: rows and columns (ny, nx) of the pillar grid.
        window: pillars in x and y of a window.
        shift: pillars in x and y by which the pillars are moved against the windows.
        set_size: largest set.
    """
    num_rows, num_columns = grid_size
    (size_x, size_y), (shift_x, shift_y) = window, shift
    frame, y, x = coords[:, 0], coords[:, 2] + shift_y, coords[:, 3] + shift_x
    windows_y = (num_rows - 1 + shift_y) // size_y + 1
    windows_x = (num_columns - 1 + shift_x) // size_x + 1
    of_window = (frame * windows_x + x // size_x) * windows_y + y // size_y
    in_x, in_y = x % size_x, y % size_y
    cell = in_y * size_x + in_x
    cells = size_x * size_y
    order = torch.stack(
        [
            torch.argsort(of_window * cells + cell, stable=True),
            torch.argsort(of_window * cells + in_x * size_y + in_y, stable=True),
        ]
    )

    _, num_pillars = torch.unique_consecutive(of_window[order[0]], return_counts=True)  # of each window
    num_sets = (num_pillars + set_size - 1) // set_size
    start = num_pillars.cumsum(0) - num_pillars
    first_set = num_sets.cumsum(0) - num_sets
    per_set = torch.repeat_interleave(torch.stack([num_pillars, num_sets, start, first_set]), num_sets, dim=1)
    num_pillars, num_sets, start, first_set = per_set
    set_in_window = torch.arange(per_set.shape[1], device=coords.device) - first_set
    begin = start + set_in_window * num_pillars // num_sets
    return SetPartition(order, F.pad(begin, (0, 1), value=coords.shape[0]), cell)


class DSVT(nn.Module):
    """Pillar features after `num_blocks` blocks of set attention.

    Args:
        config: sizes.
        grid_size: rows and columns (ny, nx) of the pillar grid.
    """

    def __init__(self, config: DSVTConfig, grid_size: tuple[int, int]) -> None:
        super().__init__()
        self.config = config
        self.grid_size = grid_size
        self.input_layer = nn.Module()
        # Level 0 is DSVT's stage, of which DSVT-P has one.
        self.input_layer.posembed_layers = nn.ModuleList(
            [
                nn.ModuleList(
                    nn.ModuleList(PositionEmbedding(window, config.d_model) for window, _ in config.windows)
                    for _ in range(config.num_blocks)
                )
            ]
        )
        self.stage_0 = nn.ModuleList(Block(config) for _ in range(config.num_blocks))
        self.residual_norm_stage_0 = nn.ModuleList(nn.LayerNorm(config.d_model) for _ in range(config.num_blocks))
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(
        self,
        features: Tensor,  # [M, C]
        coords: Tensor,  # [M, 4] int64
        num_frames: int,
    ) -> Tensor:  # [M, C]
        """Differentiable in features and parameters. Frames may be of any number of pillars, none included.

        In training, position embeddings are normalised over the pillars of the batch; a batch of fewer than two has
        no variance and uses the running statistics.

        Args:
            features: of each pillar.
            coords: (b, z, y, x) of each pillar, no two alike: b below `num_frames`, y and x in the grid (not checked).
            num_frames: B.

        Raises:
            ValueError: features or coords have another shape.
            TypeError: coords are not int64.
        """
        if features.dim() != 2 or features.shape[1] != self.config.d_model:
            raise ValueError(
                f"DSVT: features must have shape [M, C] with C={self.config.d_model}, got {list(features.shape)}"
            )
        if coords.shape != (features.shape[0], 4):
            raise ValueError(
                f"DSVT: coords must have shape [M, 4] with M={features.shape[0]}, got {list(coords.shape)}"
            )
        if coords.dtype != torch.int64:
            raise TypeError(f"DSVT: coords must be int64, got {coords.dtype}")
        if features.shape[0] == 0:
            return features
        partitions = [
            set_partition(coords, self.grid_size, window, shift, self.config.set_size)
            for window, shift in self.config.windows
        ]
        sets = [pad_sets(partition) for partition in partitions]
        cells = [partition.cell for partition in partitions]
        embeddings = self.input_layer.posembed_layers[0]  # type: ignore[index]
        for index, (block, norm) in enumerate(zip(self.stage_0, self.residual_norm_stage_0, strict=True)):
            positions = [embed(cell) for embed, cell in zip(embeddings[index], cells, strict=True)]
            features = norm(block(features, positions, sets[index % 2]) + features)
        return features


class PaddedSets(NamedTuple):
    """The sets of one order in tables of like length, for attention over all sets of a table at once.

    A table's length is that of its sets rounded up to a multiple of `LENGTH_STEP`; shorter sets repeat their first
    pillar, masked as a key. T slots in all tables together.
    """

    pillar: Tensor
    """`[T]` int64: the pillar in each slot, table after table, set after set."""
    slot: Tensor
    """`[M]` int64: the slot of each pillar."""
    valid: Tensor
    """`[T]` bool: false in the slots that repeat."""
    tables: list[tuple[int, int]]
    """Sets and length of each table."""

    def attend(self, query_key: Tensor, value: Tensor, num_heads: int) -> Tensor:
        """Scaled dot-product attention in every set: query and key `[M, 2 C]` and value `[M, C]` to `[M, C]`."""
        sizes = [sets * length for sets, length in self.tables]
        split = [
            _Rearrange.apply(projected, self.pillar, self.slot, None).split(sizes) for projected in (query_key, value)
        ]
        attended = []
        for of_query_key, of_value, valid, shape in zip(*split, self.valid.split(sizes), self.tables, strict=True):
            # each [sets, H, length, C / H]
            query, key = of_query_key.view(*shape, 2, num_heads, -1).permute(2, 0, 3, 1, 4)
            values = of_value.view(*shape, num_heads, -1).transpose(1, 2)
            result = F.scaled_dot_product_attention(query, key, values, valid.view(shape)[:, None, None])
            attended.append(result.transpose(1, 2).flatten(2).flatten(0, 1))
        return _Rearrange.apply(torch.cat(attended), self.slot, self.pillar, self.valid)


def pad_sets(partition: SetPartition) -> tuple[PaddedSets, PaddedSets]:
    """The tables of a partition's two orders, which have sets of the same lengths."""
    offsets = partition.offsets
    steps = (offsets.diff() + LENGTH_STEP - 1) // LENGTH_STEP
    by_length = torch.argsort(steps, stable=True)
    of_length = torch.bincount(steps).tolist()
    tables = [(sets, step * LENGTH_STEP) for step, sets in enumerate(of_length) if sets]
    start, length = offsets[:-1][by_length], offsets.diff()[by_length]
    padded = steps[by_length] * LENGTH_STEP
    set_of_slot = torch.repeat_interleave(torch.arange(len(padded), device=offsets.device), padded)
    position = torch.arange(len(set_of_slot), device=offsets.device) - (padded.cumsum(0) - padded)[set_of_slot]
    valid = position < length[set_of_slot]
    place = start[set_of_slot] + position * valid
    slot_of_place = torch.empty_like(partition.cell)
    slot_of_place[place[valid]] = valid.nonzero()[:, 0]
    found = []
    for order in partition.order:
        slot = torch.empty_like(order)
        slot[order] = slot_of_place
        found.append(PaddedSets(order[place], slot, valid, tables))
    return found[0], found[1]


class _Rearrange(torch.autograd.Function):
    """``values[index]``, whose gradient is ``grad[inverse]``, and zero in rows that are not `taken`.

    Right where each row of values reaches the gradient through one of the rows that show it: the repeats in padded sets
    have no effect. Both ways are gathers, which is fast and repeatable.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor, inverse: Tensor, taken: Tensor | None) -> Tensor:
        ctx.save_for_backward(inverse, taken)
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        inverse, taken = ctx.saved_tensors
        grad = grad.index_select(0, inverse)
        return (grad if taken is None else grad.masked_fill(~taken[:, None], 0)), None, None, None


class Block(nn.Module):
    """Two layers, over the sets of the two orders."""

    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        self.encoder_list = nn.ModuleList(Layer(config) for _ in range(2))

    def forward(self, features: Tensor, positions: list[Tensor], sets: tuple[PaddedSets, PaddedSets]) -> Tensor:
        for layer, position, of_layer in zip(self.encoder_list, positions, sets, strict=True):
            features = layer(features, position, of_layer)
        return features


class Layer(nn.Module):
    """Set attention within one more residual connection."""

    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        self.win_attn = AttentionLayer(config)
        self.norm = nn.LayerNorm(config.d_model)

    def forward(self, features: Tensor, position: Tensor, sets: PaddedSets) -> Tensor:
        return self.norm(self.win_attn(features, position, sets) + features)


class AttentionLayer(nn.Module):
    """A transformer layer with the normalisation after each of its two residual connections."""

    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        self.self_attn = SelfAttention(config.d_model, config.num_heads)
        self.linear1 = nn.Linear(config.d_model, config.ffn_channels)
        self.linear2 = nn.Linear(config.ffn_channels, config.d_model)
        self.norm1 = nn.LayerNorm(config.d_model)
        self.norm2 = nn.LayerNorm(config.d_model)

    def forward(self, features: Tensor, position: Tensor, sets: PaddedSets) -> Tensor:
        features = self.norm1(features + self.self_attn(features, position, sets))
        return self.norm2(features + self.linear2(F.gelu(self.linear1(features))))


class SelfAttention(nn.Module):
    """Multi-head attention of each pillar to those of its set; parameters as in `nn.MultiheadAttention`.

    Queries and keys come from features plus position embedding, values from the features alone.
    """

    def __init__(self, channels: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * channels, channels))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * channels))
        self.out_proj = nn.Linear(channels, channels)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, features: Tensor, position: Tensor, sets: PaddedSets) -> Tensor:
        channels = features.shape[1]
        weight, bias = self.in_proj_weight, self.in_proj_bias
        query_key = F.linear(features + position, weight[: 2 * channels], bias[: 2 * channels])
        value = F.linear(features, weight[2 * channels :], bias[2 * channels :])
        return self.out_proj(sets.attend(query_key, value, self.num_heads))


class PositionEmbedding(nn.Module):
    """Linear, batch norm, ReLU, Linear of the position (x, y) in a window, in pillars from its middle."""

    def __init__(self, window: tuple[int, int], channels: int) -> None:
        super().__init__()
        self.window = window
        self.position_embedding_head = nn.Sequential(
            nn.Linear(2, channels), nn.BatchNorm1d(channels), nn.ReLU(), nn.Linear(channels, channels)
        )

    def forward(self, cell: Tensor) -> Tensor:  # [M] int64 to [M, C]
        """Embedding of each pillar, from its cell in the window."""
        size_x, size_y = self.window
        first, norm, last = (self.position_embedding_head[index] for index in (0, 1, 3))
        assert isinstance(first, nn.Linear)
        if not isinstance(norm, nn.BatchNorm1d):
            raise TypeError(
                f"DSVT: position_embedding_head.1 must be nn.BatchNorm1d, got {type(norm).__name__}: cells are weighed "
                "by their pillars here, which SyncBatchNorm does not do"
            )
        with torch.autocast(cell.device.type, enabled=False):
            cells = torch.arange(size_x * size_y, device=cell.device)
            position = torch.stack([cells % size_x - size_x / 2, cells // size_x - size_y / 2], dim=1)
            count = torch.bincount(cell, minlength=size_x * size_y)
            hidden = first(position.to(first.weight.dtype))
            table = last(F.relu(_batch_norm(norm, hidden, count, cell.shape[0])))
        return F.embedding(cell, table)


def _batch_norm(norm: nn.BatchNorm1d, values: Tensor, count: Tensor, total: int) -> Tensor:
    """Batch normalisation of `values` `[K, C]` of which row k stands for ``count[k]`` rows of a batch of `total`.

    A batch of fewer than two rows has no variance: it is normalised by the running statistics and leaves them alone.
    """
    mean, variance = norm.running_mean, norm.running_var
    assert mean is not None and variance is not None and norm.num_batches_tracked is not None
    if norm.training and total >= 2:
        weight = count.to(values.dtype) / total
        batch_mean = weight @ values
        batch_variance = weight @ (values - batch_mean).square()
        with torch.no_grad():
            norm.num_batches_tracked += 1
            # A momentum of None asks for the average of all batches.
            momentum = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
            mean.lerp_(batch_mean, momentum)
            variance.lerp_(batch_variance * (total / (total - 1)), momentum)
        mean, variance = batch_mean, batch_variance
    return (values - mean) * (norm.weight * torch.rsqrt(variance + norm.eps)) + norm.bias
