# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What the benchmark tool makes of its measurements: phases, memory, peers, earlier records, pictures."""

from __future__ import annotations

import json
import sys
import time
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks import memory, peers
from benchmarks.bench_ops import CASES, expected_results, make_cases, run_phase
from benchmarks.case import BACKWARD, BACKWARD_ALONE, FORWARD, SECOND, SECOND_ALONE, Case, Variant
from benchmarks.cases import TINY
from benchmarks.compare import RecordError, against_earlier, changes, earlier_text, load_record
from benchmarks.measure import CPU, Run, time_interleaved
from benchmarks.phases import phases_of, prepare
from benchmarks.picture import PictureError, draw
from benchmarks.report import NOT_INSTALLED, Row, Table, missing_peers

ROOT = Path(__file__).resolve().parent.parent


def rows_of(case: Case, kinds: list[str], phase: int = 0) -> list[Row]:
    chosen = phases_of(case)[phase]
    return run_phase(case, chosen, expected_results(case, chosen), 1, kinds, 0.001, 3, lambda what: None)


def test_phases_that_follow() -> None:
    (case, *_) = make_cases("sample_bev", TINY)
    phases = {phase.name: phase for phase in phases_of(case)}
    assert list(phases) == [FORWARD, BACKWARD_ALONE, BACKWARD, SECOND, SECOND_ALONE]
    assert phases[BACKWARD_ALONE].traffic_bytes == phases[BACKWARD].traffic_bytes - phases[FORWARD].traffic_bytes > 0
    assert phases[BACKWARD_ALONE].traffic == "4 (3 CHW + 6N + 2 NC) - 4 (CHW + 2N + NC)"
    (forward_only,) = make_cases("resample_rays", TINY)
    assert [phase.name for phase in phases_of(forward_only)] == [FORWARD]


def test_parts_of_a_phase_give_the_same_results() -> None:
    (case, *_) = make_cases("sample_bev", TINY)
    found = {phase.name: prepare(case, phase, Variant(case.reference))() for phase in phases_of(case)}
    forward, backward, both = found[FORWARD], found[BACKWARD_ALONE], found[BACKWARD]
    assert all(torch.equal(have, want) for have, want in zip([*forward, *backward], both, strict=True))
    second, last = found[SECOND], found[SECOND_ALONE]
    assert len(last) == 3 and all(torch.equal(have, want) for have, want in zip(last, second[2:], strict=True))


def test_what_runs_before_a_call_is_not_timed() -> None:
    order: list[str] = []

    def before() -> int:
        order.append("before")
        time.sleep(0.02)
        return 7

    def call(prepared: int) -> list[Tensor]:
        order.append(f"call {prepared}")
        return []

    timing = time_interleaved({"a": Run(call, before)}, 1, min_time_s=1e-6, rounds=3)["a"]
    assert order == ["before", "call 7"] * 3 and timing.samples == 3
    assert timing.median_s < 0.01


def test_time_on_a_gpu_is_that_between_two_events(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a stand-in for the GPU whose clock only calls move: 2 ms each, after 50 ms that do not count."""
    clock_ms, order = 0.0, []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            order.append("event")
            self.at_ms = clock_ms

        def elapsed_time(self, end: Event) -> float:
            assert order[-1] == "synchronize"
            return end.at_ms - self.at_ms

    def before() -> int:
        nonlocal clock_ms
        clock_ms += 50
        order.append("before")
        return 7

    def call(prepared: int) -> list[Tensor]:
        nonlocal clock_ms
        clock_ms += 2
        order.append(f"call {prepared}")
        return []

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "_sleep", lambda cycles: None)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: order.append("synchronize"))
    timing = time_interleaved({"a": Run(call, before)}, 1, 0.06, rounds=3, device=torch.device("meta"))["a"]
    one = ["before", "event", "call 7", "event"]
    assert order == (one + ["synchronize"] + 10 * one + ["synchronize"]) * 3  # one to see how many fit into 20 ms
    assert timing.median_s == pytest.approx(2e-3) and timing.samples == 30
    assert timing.page_faults_per_call is None and timing.busy_cores is None


def held(function: Any) -> list[Tensor]:
    """Tensors that a function has beside its arguments."""
    found: list[Tensor] = []
    for cell in getattr(function, "__closure__", None) or ():
        value = cell.cell_contents
        found += [value] if isinstance(value, Tensor) else held(value) if callable(value) else []
    return found


@pytest.mark.parametrize("op", CASES)
def test_cases_can_be_moved(op: str) -> None:
    """All that a case works on goes to the device with it, and its functions make their own tensors there."""
    found = make_cases(op, TINY)
    for case in found:
        functions = [case.ours, case.reference, *(variant.function for variant in case.eager.values())]
        assert not any(held(function) for function in functions), case.name
        for name, variant in {"reference": Variant(case.reference), **case.eager}.items():
            inputs = case.inputs if variant.inputs is None else variant.inputs
            with torch.device("meta"):  # what is made without a word about the device lands here, and does not fit
                results = variant.function(*inputs)
            assert all(result.device == CPU for result in results), f"{case.name}, {name}"
    for case in found:
        moved = case.to(torch.device("meta"))
        tensors = [*moved.inputs, *(tensor for variant in moved.eager.values() for tensor in variant.inputs or ())]
        tensors += [tensor for module in moved.modules for tensor in (*module.parameters(), *module.buffers())]
        assert moved.device.type == "meta" and all(tensor.is_meta for tensor in tensors), case.name


def test_a_peer_of_the_cpu_refuses_a_gpu() -> None:
    pytest.importorskip("shapely")
    (case,) = make_cases("points_in_boxes", TINY)
    with pytest.raises(NotImplementedError, match="works on the CPU only"):
        case.peers["shapely"](torch.device("cuda"))


def test_memory_is_the_peak_of_one_call() -> None:
    def one() -> Tensor:
        return torch.ones(5_000_000)

    def two_at_once() -> Tensor:
        first = torch.ones(5_000_000)
        return first + 1

    if memory.added_peak_bytes(one) is None:
        pytest.skip("this system does not tell the peak of resident memory")
    for function, expected in ((one, 20e6), (two_at_once, 40e6), (lambda: None, 0)):
        for _ in range(2):  # what malloc kept of the first call must not hide the second
            assert memory.added_peak_bytes(function) == pytest.approx(expected, abs=1e6)


def fake_torch_scatter(factor: float) -> types.ModuleType:
    """As the real one for sums, times `factor`."""

    def scatter(src: Tensor, index: Tensor, dim: int, out: None, dim_size: int, reduce: str) -> Tensor:
        assert dim == 0 and out is None and reduce == "sum"
        return factor * src.new_zeros(dim_size, src.shape[1]).index_add(0, index, src)

    module = types.ModuleType("torch_scatter")
    vars(module)["scatter"] = scatter
    return module


def sum_case() -> Case:
    return next(case for case in make_cases("segment_reduce", TINY) if " sum " in case.name)


@pytest.mark.parametrize("phase", [0, 1, 2])
def test_a_peer_takes_part(phase: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_scatter", fake_torch_scatter(1.0))
    (row,) = rows_of(sum_case(), ["peers"], phase)
    assert (row.contender, row.kind, row.status) == ("torch-scatter", "peer", "ok")
    assert row.timing is not None and row.timing.busy_cores is not None and row.timing.busy_cores > 0


def test_a_wrong_peer_gets_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_scatter", fake_torch_scatter(1.1))
    (row,) = rows_of(sum_case(), ["peers"])
    assert row.status.startswith("wrong: result 0 differs by 0.1") and row.timing is None


def test_a_missing_peer_is_only_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_scatter", None)  # import raises ImportError
    rows = rows_of(sum_case(), ["eager", "peers"])
    assert [row.status for row in rows] == ["ok", "ok", NOT_INSTALLED]
    assert missing_peers(rows) == ["torch-scatter"]


def test_results_of_a_peer_are_brought_into_our_form() -> None:
    (case,) = make_cases("resample_rays", TINY)
    doubled = Variant(lambda t, weights: (2 * case.reference(t, weights)[0],), as_ours=lambda results: [results[0] / 2])
    (row,) = rows_of(replace(case, peers={"doubled": lambda device: doubled}), ["peers"])
    assert row.status == "ok"


def test_peers_of_compositing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in with nerfacc's signatures."""
    module: Any = types.ModuleType("nerfacc")

    def render_weight_from_alpha(alphas: Tensor) -> tuple[Tensor, Tensor]:
        clear = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas[:, :-1]).cumprod(dim=1)], dim=1)
        return alphas * clear, clear

    def accumulate_along_rays(weights: Tensor, values: Tensor | None = None) -> Tensor:
        source = weights[..., None] if values is None else weights[..., None] * values
        return source.sum(dim=1)

    module.render_weight_from_alpha, module.accumulate_along_rays = render_weight_from_alpha, accumulate_along_rays
    monkeypatch.setitem(sys.modules, "nerfacc", module)
    found = [case for op in ("composite_rays", "composite_alpha") for case in make_cases(op, TINY) if case.peers]
    assert {case.op for case in found} == {"composite_rays", "composite_alpha"}
    for case in found:
        (row,) = rows_of(case, ["peers"], phase=2)
        assert (row.contender, row.status) == ("nerfacc", "ok")


def test_peers_of_voxelize_hard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in with spconv's signatures."""

    class PointToVoxel:
        def __init__(self, size: Any, bounds: Any, channels: int, voxels: int, points: int, device: Any) -> None:
            assert (size, bounds, channels, voxels, points) == ([1.0] * 3, [0.0] * 3 + [2.0] * 3, 4, 7, 5)
            assert device == CPU

        def __call__(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return points[None], torch.tensor([[3, 2, 1]], dtype=torch.int32), torch.tensor([2], dtype=torch.int32)

    module: Any = types.ModuleType("spconv.pytorch.utils")
    module.PointToVoxel = PointToVoxel
    for name in ("spconv", "spconv.pytorch"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "spconv.pytorch.utils", module)
    make = peers.voxelize_hard(4, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 2.0, 2.0, 2.0), max_points=5, max_voxels=7)
    variant = make["spconv"](CPU)
    points = torch.rand(2, 4)
    assert variant.as_ours is not None
    voxels, coords, counts = variant.as_ours(list(variant.function(points, torch.tensor([0, 2]))))
    assert torch.equal(voxels, points[None])
    assert coords.tolist() == [[0, 3, 2, 1]] and coords.dtype == counts.dtype == torch.int64
    with pytest.raises(ValueError, match="one frame at a time, got 2"):
        variant.function(points, torch.tensor([0, 1, 2]))


def record(ours_s: float, eager: tuple[float, float, float] | None, **facts: Any) -> dict[str, Any]:
    """Of one case; `eager`: ratio, lowest and highest of the rounds."""
    key = {"op": "op", "case": "case", "phase": FORWARD, "threads": 1}
    rounds = [0.9 * ours_s, ours_s, 1.1 * ours_s]
    speedup = {"eager": dict(zip(("ratio", "lowest_round", "highest_round"), eager, strict=True))} if eager else {}
    return {
        "schema": 1,
        "complete": True,
        "started": "yesterday",
        "machine": {"cpu": "A", "cores": 2},
        "versions": {"torch": "2.13"},
        "sizes": "real",
        "git": {"commit": "abc"},
        "threads": [1],
        "rows": [{**key, "kind": "ours", "timing": {"median_s": ours_s, "round_medians_s": rounds}}],
        "comparisons": [{**key, "speedup": speedup}],
    } | facts


@pytest.mark.parametrize(
    ("now", "then", "verdict"),
    [
        ((4.0, 3.8, 4.1), (2.0, 1.9, 2.1), "faster"),
        ((2.0, 1.9, 2.1), (4.0, 3.8, 4.1), "slower"),
        ((4.0, 1.5, 4.1), (2.0, 1.9, 2.1), "within noise"),
    ],
)
def test_changes_against_eager(now: tuple[float, ...], then: tuple[float, ...], verdict: str) -> None:
    (change,) = changes(record(0.5, now), record(0.4, then))  # type: ignore[arg-type]
    assert change["verdict"] == verdict
    assert change["speedup"] == pytest.approx(0.8)  # a slower day of the machine: it does not count
    assert change["vs_eager_change"] == pytest.approx(now[0] / then[0])


def test_changes_without_eager() -> None:
    (change,) = changes(record(0.42, None), record(0.4, (2.0, 1.9, 2.1)))
    assert change["vs_eager_change"] is None and change["verdict"] == "within noise"  # the rounds spread by 10 %
    (change,) = changes(record(0.6, None), record(0.4, None))
    assert change["verdict"] == "slower"
    assert changes(record(0.6, None), record(0.4, None, rows=[])) == []


def test_text_on_an_earlier_record() -> None:
    now = record(0.5, (4.0, 3.8, 4.1))
    then = record(0.4, (2.0, 1.9, 2.1), machine={"cpu": "B", "cores": 2}, sizes="tiny", complete=False)
    text = earlier_text(against_earlier(now, then, "old.json"))
    assert "against old.json of yesterday, commit abc" in text
    assert "warning: processor differs: A now, B then" in text
    assert "warning: sizes differs: real now, tiny then" in text
    assert "warning: the earlier record is not complete" in text
    assert "1 faster, 0 slower of 1" in text and "2.00x  faster" in text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "got no such file"),
        ("{", "got unreadable JSON"),
        ("[]", "got JSON without a schema"),
        ('{"schema": 99}', "must have schema 1, got 99: another version wrote it"),
        ('{"schema": 1, "rows": []}', "got one without comparisons, machine, versions"),
    ],
)
def test_unreadable_records(content: str | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RecordError, match=message):
        load_record(path)


def test_the_record_in_the_repository_compares_with_itself() -> None:
    path = ROOT / "benchmarks/results/epyc-2core.json"
    found = changes(load_record(path), load_record(path))
    assert len(found) > 30 and {change["verdict"] for change in found} == {"within noise"}


def test_markdown() -> None:
    table = Table(("a", "empty", "b"), [["x|y", "", "1"]], right=(2,))
    assert table.markdown().splitlines() == ["| a | b |", "| --- | ---: |", "| x\\|y | 1 |"]


def test_picture_without_matplotlib(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(PictureError, match=r"pip install 'pred-lidar\[bench\]'"):
        draw(record(0.5, None), tmp_path / "picture.png")


def test_picture_of_the_record_in_the_repository(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "picture.png"
    draw(json.loads((ROOT / "benchmarks/results/epyc-2core.json").read_text()), picture)
    assert picture.stat().st_size > 50_000
    with pytest.raises(PictureError, match="no row has a time and a ceiling"):
        draw(record(0.5, None, rows=[]), picture)
