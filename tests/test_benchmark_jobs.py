# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks that are commands of their own: `benchmarks.agreement` and `benchmarks.rays`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import agreement, rays
from pred import _native
from tests.tiny_run import tiny_config

pytestmark = pytest.mark.skipif(not _native.available(), reason="compares with the compiled kernels")


def test_agreement_of_short_runs(tmp_path: Path) -> None:
    found = agreement.compare(tiny_config(tmp_path / "unused", steps=6), last=3, runs=2)
    assert not (tmp_path / "unused").exists()
    assert [row["term"] for row in found["table"]] == ["loss", "semantic", "depth", "eikonal"]
    for row in found["table"]:
        first, second = found["means"]["reference"][row["term"]]
        assert abs(second / first - 1) < 1e-3  # the second one is perturbed, by rounding
        assert first != second or row["term"] == "semantic"  # whose first digits may stay in so few steps
        assert row["fp32"]["agrees"] and row["bf16"]["agrees"], row
        assert abs(row["fp32"]["difference"]) < abs(row["bf16"]["difference"]) < 0.05
    # A contender that goes elsewhere does not pass.
    wrong = agreement.tabulate({"reference": {"loss": [1.0, 1.01]}, "fp32": {"loss": [1.05]}, "bf16": {"loss": [0.9]}})
    assert wrong[0]["spread"] == pytest.approx(0.01)
    assert [wrong[0][name]["agrees"] for name in ("fp32", "bf16")] == [False, False]


def test_time_per_ray(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "rays.json"
    rays.main(["--sizes", "tiny", "--rounds", "1", "--threads", "1", "--out", str(out)])
    record = json.loads(out.read_text())
    assert set(record["contenders"]) == set(record["growth"]) == set(rays.NAMES)
    for points in record["contenders"].values():
        assert [point["rays"] for point in points] == [4, 8]
        assert all(point["median_s"] > 0 for point in points)
    assert out.with_suffix(".png").stat().st_size > 1000
