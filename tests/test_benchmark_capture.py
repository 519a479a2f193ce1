# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Traces, and inputs of the ops taken from training steps."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import capture
from benchmarks.bench_ops import CASES, expected_results, make_cases, run_phase
from benchmarks.capture import CaptureError, capture_steps, captured_cases, load, recording
from benchmarks.case import BACKWARD, BACKWARD_ALONE, FORWARD
from benchmarks.cases import TINY
from benchmarks.phases import phases_of
from benchmarks.trace import range_name, write_trace
from pred import _native, ops
from pred.models import field, renderer
from tests.tiny_run import tiny_config, write_config


@pytest.fixture(autouse=True)
def restore_torch_settings() -> Iterator[None]:
    """A pre-training run switches to deterministic algorithms; other tests should not notice."""
    memory: Any = torch.utils.deterministic
    before = torch.are_deterministic_algorithms_enabled(), memory.fill_uninitialized_memory
    yield
    torch.use_deterministic_algorithms(before[0])
    memory.fill_uninitialized_memory = before[1]


def test_every_case_has_its_range_in_the_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_BACKEND", "native" if _native.available() else "reference")
    cases = [case for op in CASES for case in make_cases(op, TINY)]
    path = tmp_path / "folder" / "trace.json"
    kinds = ["ours", "eager"]
    write_trace(path, cases, TINY, 1, kinds)
    events = [event for event in json.loads(path.read_text())["traceEvents"] if event.get("ph") == "X"]
    names = {event["name"] for event in events}
    for case in cases:
        for phase in phases_of(case):
            if _native.available():
                assert range_name(case, phase, "ours") in names
            assert any(name.startswith(f"pred::{case.name}, {phase.name}, eager ") for name in names)
    assert "pred::step, eager" in names
    if _native.available():
        compiled = {f"pred::{op}" for op in CASES if hasattr(torch.ops.pred, op)}
        assert compiled | {"pred::sample_bev_backward"} <= names
        ranges = sorted(
            (event["ts"], event["ts"] + event["dur"]) for event in events if event.get("cat") == "user_annotation"
        )
        assert all(end <= start for (_, end), (start, _) in zip(ranges, ranges[1:], strict=False))  # one clock, in turn
        assert all(
            any(start <= event["ts"] <= end for start, end in ranges) for event in events if event["name"] in compiled
        )


def test_recording_notes_calls_and_leaves_nothing_behind() -> None:
    places = [(ops, "sample_bev"), (field, "decode_field"), (renderer, "composite_rays"), (renderer, "resample_rays")]
    before = [getattr(module, name) for module, name in places]
    bev, grid = torch.randn(1, 2, 4, 4).requires_grad_(), torch.rand(1, 3, 2)
    with pytest.raises(RuntimeError, match="stop"), recording():
        assert field.decode_field is not before[1]
        raise RuntimeError("stop")
    with recording() as calls:
        first = ops.sample_bev(bev, grid)
        first.sum().backward()
        with torch.no_grad():
            grid.zero_()  # the capture keeps what the op got
        ops.sample_bev(bev, grid)
        ops.sample_bev(bev, grid[:, :2], padding_mode="border")
    assert [getattr(module, name) for module, name in places] == before
    assert [(call.op, call.times, call.differentiable, call.used) for call in calls] == [
        ("sample_bev", 2, ["bev"], [0]),
        ("sample_bev", 1, ["bev"], []),
    ]
    assert calls[0].arguments["grid"].abs().sum() > 0 and calls[1].arguments["padding_mode"] == "border"


def check_replay(path: Path, ops_expected: set[str]) -> None:
    cases = captured_cases(path, list(CASES))
    assert ops_expected <= {case.op for case in cases}
    assert len({case.name for case in cases}) == len(cases)
    kinds = ["ours", "reference"] if _native.available() else ["reference"]
    for case in cases:
        for phase in phases_of(case):
            rows = run_phase(case, phase, expected_results(case, phase), 1, kinds, 0.001, 3, lambda what: None)
            assert [row.status for row in rows] == ["ok"] * len(kinds), (case.name, phase.name)
            assert rows[0].traffic_bytes > 0


def test_capture_of_the_rendering_step(tmp_path: Path) -> None:
    path = tmp_path / "ops.pt"
    summary = capture_steps(path, "step", TINY)
    assert "composite_rays(sdf float32[3, 14], " in summary and f"written: {path}" in summary
    check_replay(path, {"decode_field", "composite_rays", "resample_rays"})
    phases = {case.op: set() for case in captured_cases(path, list(CASES))}  # type: dict[str, set[str]]
    for case in captured_cases(path, list(CASES)):
        phases[case.op] |= {phase.name for phase in phases_of(case)}
    assert phases["decode_field"] == phases["composite_rays"] == {FORWARD, BACKWARD_ALONE, BACKWARD}
    assert phases["resample_rays"] == {FORWARD}
    assert {case.op for case in captured_cases(path, ["resample_rays"])} == {"resample_rays"}


def test_capture_of_pretraining(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture, "STEPS", 1)
    config = write_config(tmp_path / "tiny.yaml", tiny_config(tmp_path / "unused"))
    path = tmp_path / "ops.pt"
    capture_steps(path, str(config), TINY)
    assert not (tmp_path / "unused").exists()
    assert len(load(path)) > 5
    check_replay(path, {"voxelize", "segment_reduce", "decode_field", "composite_rays", "resample_rays"})


def test_capture_of_a_wrong_configuration(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        capture_steps(tmp_path / "ops.pt", "no_such_configuration", TINY)
    assert not (tmp_path / "ops.pt").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "got no such file"),
        (b"text", "got one that torch.load refuses"),
        ({"other": 1}, "got other content"),
        ({"schema": 9, "calls": []}, "must have schema 1, got 9"),
        ({"schema": 1, "calls": [{"op": "gone", "arguments": {}, "differentiable": []}]}, "got one of gone"),
    ],
)
def test_unreadable_captures(content: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "ops.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(CaptureError, match=message):
        captured_cases(path, list(CASES))
