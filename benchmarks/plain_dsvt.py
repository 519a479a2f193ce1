# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""DSVT-P as published, in plain PyTorch: what `pred.models.encoders.dsvt` is checked and timed against.

Every set has S slots, filled up with repeats; `nn.MultiheadAttention` projects and attends over all slots with the
repeats masked as keys, and the first slot of each pillar is read back; every pillar has its own row in the position
embedding. (OpenPCDet reads one slot, as here. A version of DSVT's own repository assigns all slots by index, one over
the other: the same values, but autograd gives each of r repeats the whole gradient, r times the derivative in all.)
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.models.encoders.dsvt import DSVTConfig


def published_slots(
    coords: Tensor,  # [M, 4]
    grid_size: tuple[int, int],
    window: tuple[int, int],
    shift: tuple[int, int],
    set_size: int,
    along: int,
) -> Tensor:  # [sets, S]
    """The pillar in each slot: slot j of set i has the window's sorted pillar ``floor((i S + j) n / (k S))``.

    Args:
        coords: (b, z, y, x).
        grid_size: (ny, nx).
        window: pillars in x and y.
        shift: pillars in x and y.
        set_size: S.
        along: 0 sorts a window's pillars by (y, x), 1 by (x, y).
    """
    frame, y, x = coords[:, 0], coords[:, 2] + shift[1], coords[:, 3] + shift[0]
    shape = [grid_size[1] // window[0] + 2, grid_size[0] // window[1] + 2]
    key = (frame * shape[0] + x // window[0]) * shape[1] + y // window[1]
    _, of_window, num_pillars = torch.unique(key, return_inverse=True, return_counts=True)
    place = y % window[1] * window[0] + x % window[0] if along == 0 else x % window[0] * window[1] + y % window[1]
    sorted_pillars = torch.argsort(of_window * (window[0] * window[1]) + place)
    num_sets = -(-num_pillars // set_size)
    window_of_set = torch.repeat_interleave(torch.arange(len(num_sets), device=coords.device), num_sets)
    set_in_window = (
        torch.arange(len(window_of_set), device=coords.device) - (num_sets.cumsum(0) - num_sets)[window_of_set]
    )
    slot = set_in_window[:, None] * set_size + torch.arange(set_size, device=coords.device)
    taken = slot * num_pillars[window_of_set, None] // (num_sets[window_of_set, None] * set_size)
    return sorted_pillars[(num_pillars.cumsum(0) - num_pillars)[window_of_set, None] + taken]


class PlainDSVT(nn.Module):
    """Takes the state dict of `pred.models.encoders.dsvt.DSVT`."""

    def __init__(self, config: DSVTConfig, grid_size: tuple[int, int]) -> None:
        super().__init__()
        self.config, self.grid_size = config, grid_size
        blocks = range(config.num_blocks)
        self.input_layer = nn.Module()
        self.input_layer.posembed_layers = nn.ModuleList(
            [nn.ModuleList(nn.ModuleList(_PlainEmbedding(config) for _ in range(2)) for _ in blocks)]
        )
        self.stage_0 = nn.ModuleList(_PlainBlock(config) for _ in blocks)
        self.residual_norm_stage_0 = nn.ModuleList(nn.LayerNorm(config.d_model) for _ in blocks)

    def forward(self, features: Tensor, coords: Tensor, num_frames: int) -> Tensor:
        """As `DSVT.forward`."""
        slots, positions = [], []
        for window, shift in self.config.windows:
            slots.append(
                [
                    published_slots(coords, self.grid_size, window, shift, self.config.set_size, along)
                    for along in (0, 1)
                ]
            )
            in_window = (coords[:, [3, 2]] + coords.new_tensor(shift)) % coords.new_tensor(window)
            positions.append(in_window.to(features.dtype) - features.new_tensor(window) / 2)
        for index, (block, norm) in enumerate(zip(self.stage_0, self.residual_norm_stage_0, strict=True)):
            before = features
            for number in (0, 1):
                # The quirk: positions of shift `number`, sets of shift `index % 2`
                embed = self.get_submodule(f"input_layer.posembed_layers.0.{index}.{number}")
                layer = block.get_submodule(f"encoder_list.{number}")
                features = layer(features, embed(positions[number]), slots[index % 2][number])
            features = norm(features + before)
        return features


class _PlainEmbedding(nn.Module):
    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        width = config.d_model
        self.position_embedding_head = nn.Sequential(
            nn.Linear(2, width), nn.BatchNorm1d(width), nn.ReLU(), nn.Linear(width, width)
        )

    def forward(self, position: Tensor) -> Tensor:
        return self.position_embedding_head(position)


class _PlainBlock(nn.Module):
    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        self.encoder_list = nn.ModuleList(_PlainLayer(config) for _ in range(2))


class _PlainLayer(nn.Module):
    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        self.win_attn = _PlainAttention(config)
        self.norm = nn.LayerNorm(config.d_model)

    def forward(self, features: Tensor, position: Tensor, slots: Tensor) -> Tensor:
        return self.norm(self.win_attn(features, position, slots) + features)


class _PlainAttention(nn.Module):
    def __init__(self, config: DSVTConfig) -> None:
        super().__init__()
        width = config.d_model
        self.self_attn = nn.MultiheadAttention(width, config.num_heads, batch_first=True)
        self.linear1 = nn.Linear(width, config.ffn_channels)
        self.linear2 = nn.Linear(config.ffn_channels, width)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, features: Tensor, position: Tensor, slots: Tensor) -> Tensor:
        repeats = torch.zeros_like(slots, dtype=torch.bool)
        repeats[:, 1:] = slots[:, 1:] == slots[:, :-1]
        value = features[slots]
        query = value + position[slots]
        attended = self.self_attn(query, query, value, repeats)[0].flatten(0, 1)
        first = torch.empty(len(features), dtype=torch.int64, device=features.device)
        first[slots[~repeats]] = (~repeats).flatten().nonzero()[:, 0]
        features = self.norm1(features + attended[first])
        return self.norm2(features + self.linear2(F.gelu(self.linear1(features))))
