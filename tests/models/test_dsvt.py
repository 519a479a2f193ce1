# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""DSVT-P: its names, its sets by hand and by loops, and the published formulation's outputs and gradients."""

from __future__ import annotations

import os
from collections import defaultdict
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.plain_dsvt import PlainDSVT, published_slots
from pred.models.encoders.dsvt import DSVT, DSVTConfig, set_partition
from tests.tolerances import assert_close

GRID = (14, 11)  # rows, columns: no whole number of windows
SMALL = DSVTConfig(
    d_model=16, num_heads=4, ffn_channels=24, num_blocks=3, set_size=5, window=(5, 4), hybrid_factor=(2, 1)
)
WAYMO = DSVTConfig(
    d_model=192, num_heads=8, ffn_channels=384, num_blocks=4, set_size=36, window=(12, 12), hybrid_factor=(2, 2)
)


def random_pillars(counts: list[int], grid: tuple[int, int] = GRID, seed: int = 0) -> Tensor:
    """Coordinates of that many pillars in each frame, in no order."""
    generator = torch.Generator().manual_seed(seed)
    frames = []
    for frame, count in enumerate(counts):
        cell = torch.randperm(grid[0] * grid[1], generator=generator)[:count]
        zero = torch.zeros_like(cell)
        frames.append(torch.stack([zero + frame, zero, cell // grid[1], cell % grid[1]], dim=1))
    coords = torch.cat(frames)
    return coords[torch.randperm(len(coords), generator=generator)]


def pair(config: DSVTConfig = SMALL, dtype: torch.dtype = torch.float64) -> tuple[DSVT, PlainDSVT]:
    """Ours and the published formulation, with the same parameters, none of them at a special value."""
    torch.manual_seed(0)
    ours, plain = DSVT(config, GRID), PlainDSVT(config, GRID)
    for parameter in ours.parameters():
        if parameter.dim() == 1:
            torch.nn.init.normal_(parameter, 0.5, 0.3)
    plain.load_state_dict(ours.state_dict())
    return ours.to(dtype), plain.to(dtype)


@pytest.mark.parametrize(
    ("fixture", "config", "grid"),
    [
        ("dsvt_nus", DSVTConfig(), (360, 360)),
        ("dsvt_waymo", WAYMO, (468, 468)),
        ("pcdet_waymo_dsvt", WAYMO, (468, 468)),
    ],
)
def test_state_dict_is_that_of_the_published_models(fixture: str, config: DSVTConfig, grid: tuple[int, int]) -> None:
    folder = os.environ.get("PRED_TEST_FIXTURES")
    if folder is None:
        pytest.skip("PRED_TEST_FIXTURES names no folder with the names and shapes of other frameworks' models")
    prefix = "backbone_3d."
    lines = (Path(folder) / "state_dicts" / f"{fixture}.txt").read_text().splitlines()
    expected = [line.removeprefix(prefix) for line in lines if line.startswith(prefix)]
    state = DSVT(config, grid).state_dict()
    assert [f"{name} {tuple(value.shape)} {str(value.dtype)[6:]}" for name, value in state.items()] == expected


def test_sets_by_hand() -> None:
    """Seven pillars in one window of 4 x 4, sets of three: three sets, from sorted pillars 0, floor(7/3) = 2 and
    floor(14/3) = 4 on; and a pillar alone in the window to the right."""
    x_y = [(3, 0), (0, 1), (2, 1), (1, 0), (0, 3), (3, 3), (2, 2), (4, 0)]
    coords = torch.tensor([[0, 0, y, x] for x, y in x_y])
    sets = set_partition(coords, (4, 8), (4, 4), (0, 0), 3)
    # By (y, x): (1,0) (3,0) | (0,1) (2,1) | (2,2) (0,3) (3,3) | (4,0)
    assert sets.order[0].tolist() == [3, 0, 1, 2, 6, 4, 5, 7]
    # By (x, y): (0,1) (0,3) | (1,0) (2,1) | (2,2) (3,0) (3,3) | (4,0)
    assert sets.order[1].tolist() == [1, 4, 3, 2, 6, 0, 5, 7]
    assert sets.offsets.tolist() == [0, 2, 4, 7, 8]
    assert sets.cell.tolist() == [3, 4, 6, 1, 12, 15, 10, 0]


def test_shifted_windows_by_hand() -> None:
    """Shifted by (2, 1), the windows' borders lie between x = 1 | 2 and y = 2 | 3; frames do not share windows."""
    coords = torch.tensor([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 2, 1], [0, 0, 3, 1], [1, 0, 0, 1]])
    sets = set_partition(coords, (4, 8), (4, 4), (2, 1), 9)
    assert sets.order.tolist() == [[0, 2, 3, 1, 4]] * 2
    assert sets.offsets.tolist() == [0, 2, 3, 4, 5]
    # In the window: (3, 1), (0, 1), (3, 3), (3, 0), (3, 1)
    assert sets.cell.tolist() == [7, 4, 15, 3, 7]


def looped_slots(
    coords: Tensor, window: tuple[int, int], shift: tuple[int, int], set_size: int, along: int
) -> list[list[int]]:
    """The slots of every set as the paper describes them, in plain Python."""
    windows: dict[tuple[int, ...], list[tuple[tuple[int, int], int]]] = defaultdict(list)
    for pillar, (frame, _, y, x) in enumerate(coords.tolist()):
        x, y = x + shift[0], y + shift[1]
        place = (y % window[1], x % window[0])
        windows[frame, x // window[0], y // window[1]].append((place if along == 0 else place[::-1], pillar))
    slots = []
    for key in sorted(windows):
        pillars = [pillar for _, pillar in sorted(windows[key])]
        count, sets = len(pillars), -(-len(pillars) // set_size)
        for i in range(sets):
            slots.append([pillars[(i * set_size + j) * count // (sets * set_size)] for j in range(set_size)])
    return slots


@pytest.mark.parametrize("set_size", [1, 2, 5, 7, 100])
@pytest.mark.parametrize("along", [0, 1])
def test_the_runs_are_the_published_slots_without_repeats(set_size: int, along: int) -> None:
    for seed, counts in enumerate([[90, 0, 30], [1], [154, 154], [0, 3, 0]]):
        coords = random_pillars(counts, seed=seed)
        for window, shift in [((5, 4), (0, 0)), ((5, 4), (2, 2)), ((10, 4), (2, 2)), ((1, 1), (0, 0))]:
            sets = set_partition(coords, GRID, window, shift, set_size)
            slots = looped_slots(coords, window, shift, set_size, along)
            # A repeat of the slot before is masked; the others are keys, of which every set has one at least.
            keys = [[pillar for j, pillar in enumerate(row) if j == 0 or pillar != row[j - 1]] for row in slots]
            runs = [run.tolist() for run in sets.order[along].tensor_split(sets.offsets[1:-1])]
            assert runs == keys
            assert min(map(len, runs)) >= 1
            assert max(map(len, runs)) <= set_size
            assert sorted(sum(runs, [])) == list(range(len(coords)))
            vectorised = published_slots(coords, GRID, window, shift, set_size, along)
            assert vectorised.tolist() == slots


def test_no_pillar_is_in_two_sets_and_no_set_is_empty_for_any_count() -> None:
    """Of the published formula, for every number of pillars up to four sets."""
    for set_size in (1, 2, 3, 36, 90):
        for count in range(1, 4 * set_size + 1):
            sets = -(-count // set_size)
            slot = torch.arange(sets * set_size).view(sets, set_size)
            taken = slot * count // (sets * set_size)
            starts = torch.arange(sets + 1) * count // sets
            assert torch.equal(taken[:, 0], starts[:-1])
            assert torch.equal(taken[:, -1] + 1, starts[1:])
            assert int(starts.diff().min()) >= 1


@pytest.mark.parametrize("counts", [[60, 0, 41], [2], [0, 154]])
@pytest.mark.parametrize("training", [True, False])
def test_equals_the_published_formulation(counts: list[int], training: bool) -> None:
    ours, plain = pair()
    ours.train(training), plain.train(training)
    coords = random_pillars(counts)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(len(coords), SMALL.d_model, generator=generator, dtype=torch.float64)
    weights = torch.randn(len(coords), SMALL.d_model, generator=generator, dtype=torch.float64)
    outputs, gradients = [], []
    for model in (ours, plain):
        leaf = features.clone().requires_grad_()
        out = model(leaf, coords, len(counts))
        outputs.append(out)
        gradients.append(torch.autograd.grad((out * weights).sum(), [leaf, *model.parameters()]))
    assert_close(outputs[0], outputs[1], 1e-12)
    names = ["features", *(name for name, _ in ours.named_parameters())]
    assert names[1:] == [name for name, _ in plain.named_parameters()]
    # The keys' bias moves all scores of a softmax alike: its gradient is 0 but for rounding.
    scale = max(float(gradient.abs().max()) for gradient in gradients[1])
    for name, have, want in zip(names, *gradients, strict=True):
        error = float((have - want).abs().max())
        assert error <= 1e-12 * scale, f"{name}: {error} of {scale}"
    for name, have in ours.named_buffers():
        want = plain.get_buffer(name)
        assert_close(have.double(), want.double(), 1e-12, name)
        if training and name.endswith("running_mean"):
            assert float(want.abs().max()) > 0


def test_equals_the_published_formulation_in_float32_and_bfloat16() -> None:
    ours, plain = pair(dtype=torch.float32)
    coords = random_pillars([100, 80])
    features = torch.randn(180, SMALL.d_model, generator=torch.Generator().manual_seed(1))
    assert_close(ours(features, coords, 2), plain(features, coords, 2), 5e-6)
    with torch.autocast("cpu", torch.bfloat16):
        half = ours(features, coords, 2)
        of_plain = plain(features, coords, 2)
    exact = pair()[1](features.double(), coords, 2)
    # Rounding to 8 bits before every product: no worse than the published formulation's.
    error, of_plain_error = ((have - exact).abs().max().item() for have in (half, of_plain))
    assert error <= 1.5 * of_plain_error
    half.sum().backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in ours.parameters())


def test_the_second_layer_embeds_positions_of_the_shifted_windows() -> None:
    """The quirk, seen by what reaches each embedding: block 0 attends in unshifted windows, block 1 in shifted ones,
    and both embed the first layer's positions unshifted and the second's shifted."""
    ours, _ = pair()
    coords = random_pillars([40])
    seen: dict[tuple[int, int], Tensor] = {}
    for block in range(2):
        for layer in range(2):
            embed = ours.get_submodule(f"input_layer.posembed_layers.0.{block}.{layer}")
            embed.register_forward_hook(
                lambda module, cell, out, key=(block, layer): seen.__setitem__(key, cell[0]),
            )
    ours(torch.randn(40, SMALL.d_model, dtype=torch.float64), coords, 1)
    x, y = coords[:, 3], coords[:, 2]
    for block in range(2):
        assert torch.equal(seen[block, 0], y % 4 * 5 + x % 5)
        assert torch.equal(seen[block, 1], (y + 2) % 4 * 10 + (x + 2) % 10)


def test_frames_do_not_mix_and_the_order_of_pillars_does_not_matter() -> None:
    ours, _ = pair()
    ours.eval()
    coords = random_pillars([50, 0, 37])
    features = torch.randn(87, SMALL.d_model, dtype=torch.float64)
    together = ours(features, coords, 3)
    for frame in (0, 2):
        own = coords[:, 0] == frame
        alone = ours(features[own], coords[own] * torch.tensor([0, 1, 1, 1]), 1)
        assert_close(alone, together[own], 1e-13)
    shuffle = torch.randperm(87)
    assert_close(ours(features[shuffle], coords[shuffle], 3), together[shuffle], 1e-13)


def test_repeats_bit_for_bit_with_deterministic_algorithms(deterministic: None) -> None:
    coords = random_pillars([70, 30])
    features = torch.randn(100, SMALL.d_model, generator=torch.Generator().manual_seed(1))
    runs = []
    for _ in range(2):
        ours, _ = pair(dtype=torch.float32)
        out = ours(features, coords, 2)
        runs.append([out, *torch.autograd.grad(out.square().sum(), list(ours.parameters())), *ours.buffers()])
    assert all(torch.equal(one, other) for one, other in zip(*runs, strict=True))


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_pillars_for_a_variance(count: int) -> None:
    ours, _ = pair()
    before = {name: value.clone() for name, value in ours.named_buffers()}
    features = torch.randn(count, SMALL.d_model, dtype=torch.float64, requires_grad=True)
    out = ours(features, random_pillars([0, count]), 2)
    assert out.shape == (count, SMALL.d_model)
    out.square().sum().backward()
    assert features.grad is not None and features.grad.isfinite().all()
    for name, value in ours.named_buffers():
        assert torch.equal(value, before[name]), name


def test_averaged_statistics_are_those_of_batch_norm() -> None:
    """``momentum = None`` averages over the batches, which is how statistics are made anew after training."""
    ours, plain = pair()
    for model in (ours, plain):
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.reset_running_stats()
                module.momentum = None
        for seed, counts in enumerate([[40], [9, 90], [25]]):
            coords = random_pillars(counts, seed=seed)
            model(torch.zeros(len(coords), SMALL.d_model, dtype=torch.float64), coords, 2)
    for name, value in ours.named_buffers():
        assert_close(value.double(), plain.get_buffer(name).double(), 1e-13, name)


def test_a_nan_stays_in_its_sets() -> None:
    """One block of a model: a broken pillar reaches the sets of its two orders and no others."""
    config = DSVTConfig(16, 4, 24, num_blocks=1, set_size=5, window=(5, 4))
    torch.manual_seed(0)
    ours = DSVT(config, GRID).eval()
    coords = random_pillars([60])
    features = torch.randn(60, 16)
    features[7] = float("nan")
    sets = set_partition(coords, GRID, (5, 4), (0, 0), 5)
    reached = {7}
    for order in sets.order:
        for run in order.tensor_split(sets.offsets[1:-1]):
            if reached & set(run.tolist()):
                reached |= set(run.tolist())
    broken = ours(features, coords, 1).isnan()
    assert set(broken.any(1).nonzero()[:, 0].tolist()) == reached
    assert len(reached) < 30
    assert torch.equal(broken.any(1), broken.all(1))


def test_matrices_start_xavier_uniform() -> None:
    torch.manual_seed(0)
    for name, parameter in DSVT(DSVTConfig(), (360, 360)).named_parameters():
        if parameter.dim() > 1:
            bound = (6 / sum(parameter.shape)) ** 0.5
            assert 0.98 * bound <= float(parameter.detach().abs().max()) <= bound, name
            assert parameter.detach().std().item() == pytest.approx(bound / 3**0.5, rel=0.1), name


def test_errors_name_argument_rule_and_fact() -> None:
    for wrong, message in [
        ({"d_model": 10}, "d_model must be a multiple of num_heads = 8, got 10"),
        ({"num_blocks": 0}, "num_blocks must be at least 1, got 0"),
        ({"window": (0, 3)}, r"window must be two integers \(x, y\) of at least 1, got \(0, 3\)"),
        ({"hybrid_factor": (1,)}, "hybrid_factor must be two integers"),
    ]:
        with pytest.raises(ValueError, match=message):
            DSVTConfig(**wrong)  # type: ignore[arg-type]
    model = DSVT(SMALL, GRID)
    coords = random_pillars([3])
    with pytest.raises(ValueError, match=r"DSVT: features must have shape \[M, C\] with C=16, got \[3, 8\]"):
        model(torch.zeros(3, 8), coords, 1)
    with pytest.raises(ValueError, match=r"DSVT: coords must have shape \[M, 4\] with M=3, got \[3, 3\]"):
        model(torch.zeros(3, 16), coords[:, 1:], 1)
    with pytest.raises(TypeError, match=r"DSVT: coords must be int64, got torch.int32"):
        model(torch.zeros(3, 16), coords.int(), 1)
