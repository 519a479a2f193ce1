# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`benchmarks.encoder_table`: a run of two steps, and how runs are summed up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import encoder_table
from pred.run_folder import RunFolderError
from tests.tiny_run import tiny_world


def test_two_steps_of_a_family(tmp_path: Path, native: None, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(tiny_world()), f"--out={tmp_path / 'out'}", "--families", "dsvt", "--steps=2"]
    arguments += ["--train.accelerator=cpu", "--data.depth_rays=32"]
    assert encoder_table.main(arguments) == 0
    table = capsys.readouterr().out.splitlines()[-4:]
    assert table[2].startswith("| dsvt | ") and table[2].split(" | ")[2] == "native"
    assert table[3].split(" | ")[2] == "reference"
    record = json.loads((tmp_path / "out" / "encoder_table.json").read_text())
    row = record["table"]["dsvt"]
    assert 0 <= row["largest_relative_difference"] < 1e-4
    assert row["encoder_parameters"] > 100_000 and row["native"]["peak_mb"] > 100 and row["native"]["step_ms"] > 1
    assert len(record["runs"]["dsvt"]["native"]["losses"]) == 2

    # What is finished is not done again, and other settings are refused.
    before = (tmp_path / "out" / "dsvt-native" / "figures.json").stat().st_mtime_ns
    assert encoder_table.main(arguments) == 0
    assert (tmp_path / "out" / "dsvt-native" / "figures.json").stat().st_mtime_ns == before
    with pytest.raises(RunFolderError, match="steps must be 2"):
        encoder_table.main([argument.replace("--steps=2", "--steps=3") for argument in arguments])


def test_summary_by_hand() -> None:
    runs = {
        "native": {"losses": [4.0, 2.0, 2.0, 1.0], "step_s": [9.0, 0.1, 0.3, 0.2], "peak_bytes": 5_000_000},
        "reference": {"losses": [4.0, 2.5, 2.0, 0.5], "step_s": [9.0, 0.4, 0.4, 0.4], "peak_bytes": 6_000_000},
    }
    row = encoder_table.summarise(1500, runs)
    assert row["native"] == {"first_loss": 3.0, "last_loss": 1.5, "fall": 0.5, "step_ms": 200.0, "peak_mb": 5.0}
    assert row["largest_relative_difference"] == pytest.approx(0.2)  # of the second step
    assert row["last_relative_difference"] == pytest.approx(0.2)  # 1.5 over 1.25
    text = encoder_table.markdown({"pillars": row}, 4).splitlines()
    assert text[2] == "| pillars | 0.002 M | native | 3.000 | 1.500 | 50.0% | 200 | 5 | 2.0e-01 | +20.00% |"


def test_families_are_of_the_chosen_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        encoder_table.main([str(tmp_path), f"--out={tmp_path}", "--published", "--families", "dsvt, before 2D"])
    assert "got dsvt, before 2D" in capsys.readouterr().err
