# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`benchmarks.world_study`: which runs it starts, and how it adds them up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import world_study
from pred.run_folder import RunFolderError


def fake_rendering(accuracy: float) -> dict[str, Any]:
    semantics = {"accuracy": accuracy, "mean_class_accuracy": accuracy / 2}
    returns = {"occluded": semantics, "in_image": semantics}
    depth = {"depth_median_m": 0.5, "depth_mean_m": 1.0}
    return {
        "trained": {"returns": returns, **depth},
        "projected_label": {"returns": returns},
        "nearest_visible": depth,
    }


def test_runs_and_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    commands: list[list[str]] = []

    def pred(*arguments: str) -> None:
        commands.append(list(arguments))
        if arguments[0] == "pretrain":
            run = Path(arguments[-1].removeprefix("--run="))  # or after --resume
            run.mkdir(exist_ok=True)
            (run / "config.yaml").touch()
            (run / "timing.csv").write_text("step,duration_s,rays_per_s\n1,0.5,9\n10,0.1,9\n")
            (run / "encoder.pth").touch()
        else:
            run = Path(arguments[2])
            seed = int(run.name[-1])
            found = fake_rendering(0.5 + 0.1 * seed) if arguments[1] == "rendering" else {}
            found |= {"trained": {"miou": None}, "untrained": {"miou": 0.25}} if arguments[1] == "probe" else {}
            (run / f"evaluation_{arguments[1]}.json").write_text(json.dumps(found))

    monkeypatch.setattr(world_study, "_pred", pred)
    world = tmp_path / "world"
    world.mkdir()
    (world / "world.json").write_text('{"seed": 3}')
    tmp_path /= "study"
    arguments = [str(world), "--out", str(tmp_path), "--seeds", "0", "1", "--variants", "rendering", "projection"]
    assert world_study.main([*arguments, "--train.steps=7"]) == 0
    assert [command[0] for command in commands] == ["pretrain", "evaluate", "evaluate"] * 4
    assert "--train.steps=7" in commands[0] and "--loss.semantic_at=return" not in commands[0]
    assert "--loss.semantic_at=return" in commands[3] and "--train.seed=0" in commands[3]
    assert "--train.seed=1" in commands[6]

    record = json.loads((tmp_path / "world_study.json").read_text())
    assert record["runs"]["rendering"][0]["training_s"] == pytest.approx(10 * 0.3)
    row = record["tables"]["trained"]["class of occluded returns"]
    assert row["projection"]["values"] == [0.5, 0.6]
    assert row["projection"]["mean"] == pytest.approx(0.55)
    assert row["projection"]["deviation"] == pytest.approx(0.1 / 2**0.5)
    printed = capsys.readouterr().out
    assert "| | rendering | projection |" in printed
    assert "| class of occluded returns | 55.0 ± 7.1 % | 55.0 ± 7.1 % |" in printed
    assert "| median depth error | 0.500 ± 0.000 m |" in printed
    assert "| probe mIoU | – | – |" in printed

    commands.clear()
    (tmp_path / "rendering-seed0" / "encoder.pth").unlink()  # as after a kill
    assert world_study.main([*arguments, "--train.steps=7"]) == 0
    assert commands == [["pretrain", "--resume", str(tmp_path / "rendering-seed0")]]
    with pytest.raises(RunFolderError, match="pretrain_options must be"):
        world_study.main([*arguments, "--train.steps=8"])
    (world / "world.json").write_text('{"seed": 4}')
    with pytest.raises(RunFolderError, match=r"world must be \{'seed': 3\} as in settings\.json, got \{'seed': 4\}"):
        world_study.main([*arguments, "--train.steps=7"])
