# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pred import cli
from pred.data.batch import DataConfig
from pred.data.frame import CLASS_NAMES, Frame, FrameError
from pred.data.lidarseg import MERGED_NAMES, NUM_MERGED
from pred.data.nuscenes import NuScenesFrames
from pred.evaluate_probe import Cells, draw_cells, evaluate_probe, features_at, fit_probe, labelled_cells
from pred.pretrain import PretrainConfig, pretrain
from tests.data.tiny_tree import Tree, write_lidarseg, write_tree
from tests.tiny_run import tiny_config

POINT_RANGE = (0.0, -2.0, -1.0, 4.0, 2.0, 1.0)


def frame_of(rows: list[tuple[float, float, str | None]]) -> Frame:
    points = np.zeros((len(rows), 5), dtype=np.float32)
    points[:, :2] = [row[:2] for row in rows]
    ids = [255 if name is None else CLASS_NAMES.index(name) for _, _, name in rows]
    return Frame("token", points, np.arange(len(rows)), np.ones(len(rows), dtype=bool), semantics=np.array(ids))


def names_of(cells: Cells) -> dict[tuple[int, int], str]:
    keys = zip(cells.row.tolist(), cells.column.tolist(), strict=True)
    return {key: MERGED_NAMES[merged] for key, merged in zip(keys, cells.merged.tolist(), strict=True)}


def test_cells_have_the_class_of_most_of_their_returns() -> None:
    frame = frame_of(
        [
            # Row 0 is y in [-2, -1), column 1 is x in [1, 2).
            (1.1, -1.9, "road"), (1.5, -1.5, "road"), (1.9, -1.1, "car"),
            # Wall and pole are one class, and outnumber a car.
            (0.5, 0.5, "wall"), (0.6, 0.6, "pole"), (0.4, 0.4, "car"),
            # A tie: the smaller object wins. What has no class does not vote.
            (3.5, 1.5, "person"), (3.6, 1.5, "road"), (3.5, 1.6, None), (3.4, 1.6, "sky"),
            # Nothing known; outside of the range; the own car.
            (2.5, -0.5, None), (4.0, 0.0, "car"), (2.05, 0.05, "car"),
        ]
    )  # fmt: skip
    cells = labelled_cells(frame, POINT_RANGE, (2.0, 0.0, 2.1, 0.1), (4, 4))
    assert names_of(cells) == {(0, 1): "road", (2, 0): "manmade", (3, 3): "person"}
    frame.is_keyframe[:2] = False  # returns of earlier sweeps do not vote
    assert names_of(labelled_cells(frame, POINT_RANGE, (0, 0, 0, 0), (4, 4)))[0, 1] == "car"


def test_ties_are_won_by_the_smallest_object() -> None:
    """Whatever the order of the points."""
    for first, second, winner in (("car", "truck", "car"), ("bicycle", "car", "cycle"), ("rider", "person", "person")):
        for pair in ((first, second), (second, first)):
            cells = labelled_cells(
                frame_of([(0.5, 0.5, pair[0]), (0.6, 0.6, pair[1])]), POINT_RANGE, (0, 0, 0, 0), (1, 1)
            )
            assert names_of(cells) == {(0, 0): winner}


def test_features_are_those_of_the_cell() -> None:
    bev = torch.arange(24.0).reshape(2, 3, 4)
    cells = Cells(np.array([0, 2]), np.array([3, 1]), np.array([0, 0]))
    assert features_at(bev, cells).tolist() == [[3.0, 15.0], [9.0, 21.0]]


def test_drawn_cells_are_balanced() -> None:
    merged = np.array([0] * 9000 + [7] * 100)
    cells = Cells(np.arange(9100), np.arange(9100), merged)
    drawn = draw_cells(cells, 100, np.random.default_rng(0))
    assert len(set(drawn.row.tolist())) == 100 and (drawn.row == drawn.column).all()
    assert (merged[drawn.row] == drawn.merged).all()
    assert 25 < np.count_nonzero(drawn.merged == 7) < 55  # 50 with replacement; 41 = 100 (1 - exp(-0.53)) without
    assert draw_cells(cells, 9100, np.random.default_rng(0)) is cells


def test_probe_finds_a_linear_rule_and_no_other() -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(1200, 6, generator=generator) * torch.tensor([1.0, 100.0, 0.01, 1.0, 1.0, 0.0]) + 5
    rule = torch.randn(NUM_MERGED, 3, generator=generator)
    classes = ((features[:, :3] - 5) / torch.tensor([1.0, 100.0, 0.01]) @ rule.T).argmax(dim=1)
    probe = fit_probe(features[:800], classes[:800])
    assert probe.converged and probe.iterations > 5
    assert (probe.predict(features[800:]) == classes[800:]).float().mean() > 0.9
    # Of noise it learns what is most frequent, and no more.
    classes = torch.where(torch.rand(800, generator=generator) < 0.8, 2, 5)
    probe = fit_probe(features[:800], classes)
    assert (probe.predict(features[800:]) == 2).all()
    again = fit_probe(features[:800], classes)
    assert torch.equal(probe.weight, again.weight) and torch.equal(probe.bias, again.bias)


def test_constant_features_give_the_class_frequencies() -> None:
    """The closed form of a classifier that sees nothing: its probabilities are the frequencies."""
    classes = torch.tensor([0] * 6 + [3] * 3 + [9])
    probe = fit_probe(torch.full((10, 2), 3.0), classes)
    probabilities = probe.bias.softmax(dim=0)[[0, 3, 9]]
    assert probabilities.tolist() == pytest.approx([0.6, 0.3, 0.1], abs=1e-3)
    assert not probe.weight.any()


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Tree:
    tree = write_tree(tmp_path_factory.mktemp("data"), scenes=("scene-a", "scene-b"))
    write_lidarseg(tree)
    return tree


@pytest.fixture(scope="module")
def config(tree: Tree, tmp_path_factory: pytest.TempPathFactory) -> PretrainConfig:
    config = tiny_config(tmp_path_factory.mktemp("runs") / "run", steps=3)
    config.data.root, config.data.split = str(tree.root), "first"
    pretrain(config)
    return config


def run_of(config: PretrainConfig) -> Path:
    assert config.run is not None
    return Path(config.run)


def test_probe_of_a_run(config: PretrainConfig, capfd: pytest.CaptureFixture[str]) -> None:
    options = ["--train-split", "first", "--val-split", "second", "--cells-per-frame", "20"]
    assert cli.main(["evaluate", "probe", str(run_of(config)), *options]) == 0
    output = capfd.readouterr().out
    assert "linear probe" in output and "mIoU" in output and "IoU road (" in output
    result = json.loads((run_of(config) / "evaluation_probe.json").read_text())
    assert (result["train_frames"], result["val_frames"], result["skipped"]) == (2, 2, {})
    assert result["val_frames_encoder_trained_on"] == 0
    assert sum(result["train_cells_by_class"].values()) == 40
    for name in ("trained", "untrained"):
        figures = result[name]
        assert figures["converged"]
        assert figures["miou"] == pytest.approx(np.mean(list(figures["iou_by_class"].values())))
        assert set(figures["iou_by_class"]) == set(result["val_cells_by_class"])
    again = evaluate_probe(config, run_of(config), train_split="first", val_split="second", cells_per_frame=20)
    assert again == result
    some = evaluate_probe(
        config, run_of(config), train_split="first", val_split="second", cells_per_frame=20, max_frames=1
    )
    assert (some["train_frames"], some["val_frames"]) == (1, 1)


def test_wrong_arguments_of_the_probe(config: PretrainConfig, tree: Tree, tmp_path: Path) -> None:
    run = run_of(config)
    with pytest.raises(ValueError, match="cells-per-frame must be at least 1, got 0"):
        evaluate_probe(config, run, cells_per_frame=0)
    with pytest.raises(ValueError, match="must have no frame in common, got 2 in both first and first"):
        evaluate_probe(config, run, train_split="first", val_split="first")
    with pytest.raises(ValueError, match=r"data\.split must select samples of .*, got none: train"):
        evaluate_probe(config, run)
    with pytest.raises(ValueError, match=r"data\.dataset must be nuscenes, with splits, got folder"):
        evaluate_probe(replace(config, data=DataConfig(dataset="folder", root=str(tmp_path))), run)
    table = tree.tables / "lidarseg.json"
    moved = table.rename(tmp_path / "lidarseg.json")
    try:
        with pytest.raises(FrameError, match=r"frame must have classes of its points \(lidarseg\.json\), got none"):
            evaluate_probe(config, run, train_split="first", val_split="second")
        skipping = replace(config, data=replace(config.data, on_error="skip"))
        with pytest.raises(ValueError, match=r"split first must have cells of known class, got none; .*lidarseg\.json"):
            evaluate_probe(skipping, run, train_split="first", val_split="second")
    finally:
        moved.rename(table)


def test_no_usable_frame_to_measure_gives_no_figures(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    load = NuScenesFrames.load

    def load_the_first_scene(self: NuScenesFrames, index: int) -> Frame:
        if "scene-b" in self.token(index):
            raise FrameError("sweep.bin", "must hold points, got 3 bytes")
        return load(self, index)

    monkeypatch.setattr(NuScenesFrames, "load", load_the_first_scene)
    monkeypatch.setattr(config.data, "on_error", "skip")
    result = evaluate_probe(config, run_of(config), train_split="first", val_split="second", cells_per_frame=20)
    assert (result["train_frames"], result["val_frames"], len(result["skipped"])) == (2, 0, 2)
    assert result["val_cells_by_class"] == {} and result["trained"]["miou"] is result["untrained"]["accuracy"] is None
