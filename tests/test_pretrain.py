# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import pickle
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import docstring_parser
import pytest
import torch
from torch import Tensor

from pred.checkpoint import CheckpointError, list_checkpoints, load_tensors
from pred.data.batch import DataConfig, TrainingBatches, build_source
from pred.data.frame import FrameError
from pred.losses import LossConfig
from pred.models.encoders import BEVBackboneConfig, DSVTConfig, EncoderConfig, PillarConfig, VoxelConfig
from pred.models.encoders.dsvt import DSVT
from pred.models.field import FieldConfig
from pred.models.pretrainer import Pretrainer
from pred.models.renderer import RendererConfig
from pred.pretrain import (
    NonFiniteLossError,
    PretrainConfig,
    TrainConfig,
    build_model,
    build_optimizer,
    load_model,
    one_cycle,
    pretrain,
    recalibrate_batch_norm,
    set_schedule,
)
from pred.run_folder import CsvLog, RunFolder, RunFolderError
from tests.data.tiny_tree import write_tree
from tests.tiny_run import tiny_config, write_config


@pytest.fixture(autouse=True)
def restore_torch_settings() -> Iterator[None]:
    """A run switches to deterministic algorithms; other tests should not notice."""
    memory: Any = torch.utils.deterministic
    before = torch.are_deterministic_algorithms_enabled(), memory.fill_uninitialized_memory
    yield
    torch.use_deterministic_algorithms(before[0])
    memory.fill_uninitialized_memory = before[1]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pretrain(tiny_config(tmp_path_factory.mktemp("runs") / "finished"))


def read_log(run: Path, name: str = "log.csv") -> list[dict[str, str]]:
    with open(run / name, newline="") as file:
        return list(csv.DictReader(file))


def weights(run: Path) -> dict[str, Tensor]:
    model: dict[str, Tensor] = load_tensors(list_checkpoints(run / "checkpoints")[-1])["model"]
    return model


def assert_same_run(left: Path, right: Path, note: str = "") -> None:
    """Equal weights, optimiser state and log, bit for bit; a failure shows ``note``."""
    states = [load_tensors(list_checkpoints(run / "checkpoints")[-1]) for run in (left, right)]
    assert states[0]["step"] == states[1]["step"], note
    assert states[0]["model"].keys() == states[1]["model"].keys(), note
    for name, tensor in states[0]["model"].items():
        assert torch.equal(tensor, states[1]["model"][name]), (name, note)
    for index, moments in states[0]["optimizer"]["state"].items():
        for name, tensor in moments.items():
            assert torch.equal(tensor, states[1]["optimizer"]["state"][index][name]), (index, name, note)
    assert (left / "log.csv").read_bytes() == (right / "log.csv").read_bytes(), note


# The run folder


def test_run_folder_holds_what_a_reader_needs(finished: Path) -> None:
    assert {path.name for path in finished.iterdir()} == {
        "config.yaml", "run.json", "log.csv", "timing.csv", "tensorboard", "checkpoints", "encoder.pth",
        "encoder.pth.json",
    }  # fmt: skip
    info = json.loads((finished / "run.json").read_text())
    assert info["frames"] == 2 and info["steps"] == 12 and info["seed"] == 0
    assert info["versions"]["torch"] and info["threads"] == torch.get_num_threads()
    # Only the last three.
    assert [path.name for path in list_checkpoints(finished / "checkpoints")] == [
        "step_00000006.pt", "step_00000009.pt", "step_00000012.pt",
    ]  # fmt: skip
    assert any(path.name.startswith("events.out.tfevents") for path in (finished / "tensorboard").iterdir())


def test_log_has_every_step_and_every_term(finished: Path) -> None:
    rows = read_log(finished)
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    for row in rows:
        loss = float(row["semantic"]) + float(row["depth"]) + 0.1 * float(row["eikonal"])
        assert float(row["loss"]) == pytest.approx(loss, rel=1e-5)
        assert 0 <= float(row["zero_opacity_share"]) <= 1 and row["skipped_frames"] == "0"
    assert [row["step"] for row in read_log(finished, "timing.csv")] == [row["step"] for row in rows]


def test_training_lowers_the_loss(tmp_path: Path) -> None:
    run = pretrain(tiny_config(tmp_path / "run", steps=100, lr=1e-2, checkpoint_every=100))
    loss = [float(row["loss"]) for row in read_log(run)]
    assert sum(loss[-10:]) < 0.8 * sum(loss[:10])


def test_encoder_file_is_plain_and_has_openpcdet_names(finished: Path) -> None:
    content = torch.load(finished / "encoder.pth", weights_only=True)
    trained = weights(finished)
    expected = {name.removeprefix("encoder."): value for name, value in trained.items() if name.startswith("encoder.")}
    assert content["model_state"].keys() == expected.keys()
    assert {name.split(".")[0] for name in expected} == {"vfe", "backbone_2d"}
    for name, value in content["model_state"].items():
        assert torch.equal(value, expected[name]), name
    assert content["pred"]["point_range_m"][0] == -25.6 and content["pred"]["voxel_size_m"] == [0.8, 0.8, 6.0]


def test_a_folder_that_holds_a_run_is_refused(finished: Path) -> None:
    with pytest.raises(RunFolderError, match=r"already holds config\.yaml.*--resume"):
        pretrain(tiny_config(finished))


def test_a_data_set_that_cannot_be_read_leaves_no_folder(tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run")
    config.data.root = None
    with pytest.raises(ValueError, match=r"data\.root must name the folder"):
        pretrain(config)
    assert not (tmp_path / "run").exists()


def test_steps_follow_from_epochs(tmp_path: Path) -> None:
    run = pretrain(tiny_config(tmp_path / "run", steps=None, epochs=1.5))  # of two frames, one per step
    assert len(read_log(run)) == 3


# Repeating and resuming


def test_same_configuration_gives_the_same_bits(finished: Path, tmp_path: Path) -> None:
    assert_same_run(finished, pretrain(tiny_config(tmp_path / "again")))
    other = pretrain(tiny_config(tmp_path / "other seed", seed=1))
    assert not torch.equal(weights(finished)["field.layers.0.weight"], weights(other)["field.layers.0.weight"])


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "pred", "pretrain", *map(str, arguments)]


def steps_logged(run: Path) -> int:
    try:
        return (run / "log.csv").read_text().count("\n") - 1
    except FileNotFoundError:
        return 0


def run_and_kill(arguments: list[str], run: Path, after_step: int, environment: dict[str, str]) -> None:
    """SIGKILL as soon as the log holds ``after_step`` steps."""
    process = subprocess.Popen(arguments, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120
    while steps_logged(run) < after_step:
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            pytest.fail(f"ended before step {after_step}: {process.communicate()[0]}")
        time.sleep(0.002)
    process.kill()
    process.wait()
    assert process.returncode == -signal.SIGKILL


def test_killed_at_random_steps_and_resumed_equals_uninterrupted(tmp_path: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    steps = 60
    config_file = write_config(tmp_path / "tiny.yaml", tiny_config(tmp_path, steps=steps, checkpoint_every=7))
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    subprocess.run(command("--config", config_file, "--run", whole), env=environment, check=True, capture_output=True)

    first, second = sorted(random.Random().sample(range(2, steps - 10), 2))
    killed_at = f"killed at steps {first} and {second}"
    print(killed_at)  # for failures of the commands themselves
    # Loader processes must not matter, so only the broken run has one.
    start = command("--config", config_file, "--run", broken, "--data.workers", "1")
    run_and_kill(start, broken, first, environment)
    run_and_kill(command("--resume", broken), broken, second, environment)
    last = subprocess.run(
        command("--resume", broken), env=environment, check=True, capture_output=True, text=True
    ).stdout
    assert "resumed from" in last or first < 7, f"{killed_at}: {last}"
    assert_same_run(whole, broken, killed_at)
    # The kill may come between the two files, so only the steps must agree.
    timed = [row["step"] for row in read_log(broken, "timing.csv")]
    assert timed == sorted(set(timed), key=int), killed_at
    assert len(json.loads((broken / "run.json").read_text())["resumed"]) == 2, killed_at


def start_long_run(tmp_path: Path) -> subprocess.Popen[str]:
    """A run with two loader processes, in a process group of its own, that has made its first steps."""
    config = tiny_config(tmp_path / "run", steps=100_000, checkpoint_every=100_000)
    config.data.workers = 2
    config_file = write_config(tmp_path / "config.yaml", config)
    run = subprocess.Popen(command("--config", config_file), stdout=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 120
    while steps_logged(tmp_path / "run") < 3:
        assert run.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    return run


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a signal to its loader processes ends a run")
def test_a_signal_to_all_processes_of_a_run_writes_a_checkpoint(tmp_path: Path) -> None:
    """As job schedulers send it."""
    run = start_long_run(tmp_path)
    os.killpg(run.pid, signal.SIGTERM)
    output = run.communicate(timeout=60)[0]
    assert run.returncode == 128 + signal.SIGTERM and "stopped by SIGTERM after step" in output
    assert len(list_checkpoints(tmp_path / "run" / "checkpoints")) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc; elsewhere loader processes may stay")
def test_a_killed_run_takes_its_loader_processes_along(tmp_path: Path) -> None:
    run = start_long_run(tmp_path)
    workers = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    assert len(workers) == 2
    time.sleep(0.5)  # their queues fill up
    run.kill()
    run.communicate()
    deadline = time.monotonic() + 10
    while any(_runs(pid) for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _runs(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_resume_uses_the_previous_checkpoint_if_the_newest_is_damaged(
    finished: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = pretrain(tiny_config(tmp_path / "run"))
    newest = list_checkpoints(run / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    pretrain(tiny_config(run), resume=True)
    output = capfd.readouterr().out.replace("\n", "")
    assert f"damaged checkpoint is not used: {newest}" in output and "step_00000009.pt" in output
    assert_same_run(finished, run)


def test_resume_before_the_first_checkpoint_starts_over(finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    RunFolder(run).start("")
    header = (finished / "log.csv").read_text().splitlines()[0]
    (run / "log.csv").write_text(f"{header}\n1,7.0")  # killed in the first row
    assert_same_run(finished, pretrain(tiny_config(run), resume=True))


def test_resume_of_a_finished_run_changes_nothing(finished: Path) -> None:
    before = {path: path.read_bytes() for path in finished.glob("checkpoints/*")}
    before[finished / "log.csv"] = (finished / "log.csv").read_bytes()
    pretrain(tiny_config(finished), resume=True)
    assert {path: path.read_bytes() for path in before} == before


def test_resume_with_another_configuration_names_the_key(finished: Path) -> None:
    with pytest.raises(CheckpointError, match=r"got train\.lr = 0\.01 \(was 0\.0003\)"):
        pretrain(tiny_config(finished, lr=0.01), resume=True)


def test_resume_with_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run", steps=None, epochs=2)
    pretrain(config)
    config.data.root = str(write_tree(tmp_path / "data", keyframes=3).root)
    with pytest.raises(CheckpointError, match="must have the checkpoint's 4 steps, got 6"):
        pretrain(config, resume=True)


def test_resume_with_other_frames_is_refused(finished: Path, tmp_path: Path) -> None:
    config = tiny_config(finished)
    config.data.root = str(write_tree(tmp_path / "data").root)
    with pytest.raises(
        CheckpointError, match=r"step_.*: frames must be those of the checkpoint, in its order, got others"
    ):
        pretrain(config, resume=True)


def test_root_and_info_file_may_move(tmp_path: Path) -> None:
    def config(root: Path, info: Path, frames: list[int]) -> PretrainConfig:
        info.write_bytes(pickle.dumps([{"token": tree.tokens[frame]} for frame in frames]))
        found = tiny_config(tmp_path / "run")
        found.data.root, found.data.info = str(root), str(info)
        return found

    tree = write_tree(tmp_path / "here")
    run = pretrain(config(tree.root, tmp_path / "a.pkl", [1, 0]))
    moved = tree.root.rename(tmp_path / "there")
    before = (run / "log.csv").read_bytes()
    pretrain(config(moved, tmp_path / "b.pkl", [1, 0]), resume=True)
    assert (run / "log.csv").read_bytes() == before
    with pytest.raises(CheckpointError, match="frames must be those of the checkpoint"):
        pretrain(config(moved, tmp_path / "b.pkl", [0, 1]), resume=True)


def test_resume_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="must exist"):
        pretrain(tiny_config(tmp_path / "nothing"), resume=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFolderError, match=r"must hold config\.yaml"):
        pretrain(tiny_config(tmp_path / "empty"), resume=True)


@pytest.mark.parametrize(("text", "fact"), [('{"seed":', "no valid JSON"), ("[1]", "a JSON object, got list")])
def test_a_damaged_record_is_named(tmp_path: Path, text: str, fact: str) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.start("")
    folder.info.write_text(text)
    with pytest.raises(RunFolderError, match=rf"run\.json: must be the record of the run, .*{fact}"):
        pretrain(tiny_config(folder.path), resume=True)
    assert folder.info.read_text() == text


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_writes_a_checkpoint_and_says_how_to_go_on(
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    kind: signal.Signals,
) -> None:
    run = tmp_path / "run"
    forward = Pretrainer.forward

    def forward_and_signal(self: Pretrainer, batch: Any) -> Any:
        if batch.step == 4:
            os.kill(os.getpid(), kind)
        return forward(self, batch)

    monkeypatch.setattr(Pretrainer, "forward", forward_and_signal)
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as stopped:
        pretrain(tiny_config(run))
    assert stopped.value.code == 128 + kind
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert list_checkpoints(run / "checkpoints")[-1].name == "step_00000005.pt"  # between two regular ones
    assert f"stopped by {kind.name} after step 5; continue with: pred pretrain --resume {run}" in capfd.readouterr().out
    monkeypatch.undo()
    assert_same_run(finished, pretrain(tiny_config(run), resume=True))


# Errors while training


@pytest.mark.parametrize("term", ["semantic", "depth", "eikonal"])
def test_non_finite_loss_stops_the_run_and_names_step_frame_and_term(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, term: str
) -> None:
    forward = Pretrainer.forward

    def broken_forward(self: Pretrainer, batch: Any) -> Any:
        output = forward(self, batch)
        if batch.step == 4:
            output = output._replace(loss=output.loss * math.nan, terms=output.terms | {term: torch.tensor(math.inf)})
        return output

    monkeypatch.setattr(Pretrainer, "forward", broken_forward)
    config = tiny_config(tmp_path / "run")
    source = build_source(config.data)
    tokens = f"({source.token(0)}|{source.token(1)})"
    with pytest.raises(NonFiniteLossError, match=rf"{term} = inf, total = nan in step 5, frames {tokens};"):
        pretrain(config)
    assert all(torch.isfinite(value).all() for value in weights(tmp_path / "run").values() if value.is_floating_point())
    assert len(read_log(tmp_path / "run")) == 4


def test_non_finite_gradient_stops_the_run_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forward = Pretrainer.forward

    def steep_forward(self: Pretrainer, batch: Any) -> Any:
        output = forward(self, batch)
        parameter = next(self.parameters())
        # The square root has an infinite slope at 0, and the value 0.
        return output._replace(loss=output.loss + (0 * parameter).sum().abs().sqrt())

    monkeypatch.setattr(Pretrainer, "forward", steep_forward)
    with pytest.raises(NonFiniteLossError, match=r"gradient norm = (nan|inf) in step 1"):
        pretrain(tiny_config(tmp_path / "run"))


def test_bf16_trains_with_weights_in_float32(tmp_path: Path) -> None:
    run = pretrain(tiny_config(tmp_path / "run", precision="bf16-mixed", steps=3))
    assert {value.dtype for value in weights(run).values() if value.is_floating_point()} == {torch.float32}
    assert all(math.isfinite(float(row["loss"])) for row in read_log(run))


def test_lidar_only_by_configuration(tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run", steps=2)
    config.data.labels = "none"
    rows = read_log(pretrain(config))
    assert [row["semantic"] for row in rows] == ["0.0", "0.0"] and float(rows[0]["depth"]) > 0


def test_returns_nearer_than_near_m_are_no_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nearest_m = []
    forward = Pretrainer.forward

    def watched_forward(self: Pretrainer, batch: Any) -> Any:
        nearest_m.append(float(batch.depth.depth_m[batch.depth.valid].min()))
        return forward(self, batch)

    monkeypatch.setattr(Pretrainer, "forward", watched_forward)
    config = tiny_config(tmp_path / "run", steps=2)
    config.renderer.near_m = 8.0
    pretrain(config)
    assert len(nearest_m) == 2 and min(nearest_m) > 8.0


def test_every_skipped_frame_is_counted(tmp_path: Path) -> None:
    tree = write_tree(tmp_path / "data")
    for image in tree.images[1].values():
        image.write_bytes(b"junk")
    config = tiny_config(tmp_path / "run", steps=2)
    config.data.root, config.data.batch_size = str(tree.root), 4
    with pytest.raises(FrameError, match=f"{tree.images[1]['CAM_BACK']}: image file must be readable"):
        pretrain(config)
    config.run, config.data.on_error = str(tmp_path / "skipping"), "skip"
    # Two of a batch's four slots are the broken frame's.
    assert [row["skipped_frames"] for row in read_log(pretrain(config))] == ["2", "4"]


# Parts


def test_one_cycle_meets_the_policys_corners() -> None:
    train = TrainConfig(lr=1.0, warmup_fraction=0.25, initial_lr_divisor=10, final_lr_divisor=100)
    assert one_cycle(0.0, train) == pytest.approx((0.1, 0.95))
    assert one_cycle(0.125, train) == pytest.approx((0.55, 0.9))  # half way up
    assert one_cycle(0.25, train) == pytest.approx((1.0, 0.85))
    assert one_cycle(1.0, train) == pytest.approx((0.001, 0.95))


def test_one_cycle_agrees_with_torch() -> None:
    train, steps = TrainConfig(), 5000
    parameter = torch.nn.Parameter(torch.zeros(1))
    reference = torch.optim.AdamW([parameter], betas=(0.95, 0.99))
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        reference, train.lr, total_steps=steps + 1, pct_start=0.4, div_factor=10, final_div_factor=1e4
    )
    ours = torch.optim.AdamW([parameter])
    for step in range(steps):
        set_schedule(ours, train, step / steps)
        # torch ends the rise one step early, hence the tolerance.
        assert ours.param_groups[0]["lr"] == pytest.approx(reference.param_groups[0]["lr"], abs=3e-3 * train.lr)
        assert ours.param_groups[0]["betas"] == pytest.approx(reference.param_groups[0]["betas"], abs=1e-3)
        reference.step()
        schedule.step()


@pytest.mark.parametrize("steps", [50, 1000])
def test_one_cycle_is_that_of_adam_onecycle(steps: int) -> None:
    """Of OpenPCDet, in step `step` counted from 0: two cosines that meet in step ``int(PCT_START total)``."""
    train, peak = TrainConfig(), int(0.4 * steps)
    for step in range(steps):
        low, end = 3e-4 / 10, 3e-4 / 10 / 1e4
        if step < peak:
            share = (1 - math.cos(math.pi * step / peak)) / 2
            expected = (low + (3e-4 - low) * share, 0.95 - 0.1 * share)
        else:
            share = (1 - math.cos(math.pi * (step - peak) / (steps - peak))) / 2
            expected = (3e-4 + (end - 3e-4) * share, 0.85 + 0.1 * share)
        assert one_cycle(step / steps, train) == pytest.approx(expected, rel=1e-12)


def test_the_optimiser_updates_as_adam_onecycle() -> None:
    """Adam (Kingma and Ba, algorithm 1, with the step's beta1) after ``p *= 1 - weight_decay lr``, for every one."""
    train, steps = TrainConfig(weight_decay=0.05, lr=0.01), 30
    torch.manual_seed(0)
    model = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4)).double()
    optimizer = build_optimizer(model, train)
    expected = [parameter.detach().clone() for parameter in model.parameters()]
    first, second = ([torch.zeros_like(value) for value in expected] for _ in range(2))
    for step in range(steps):
        learning_rate, beta1 = one_cycle(step / steps, train)
        for index, parameter in enumerate(model.parameters()):
            gradient = torch.randn_like(parameter)
            parameter.grad = gradient.clone()
            expected[index] *= 1 - 0.05 * learning_rate
            first[index] = beta1 * first[index] + (1 - beta1) * gradient
            second[index] = 0.99 * second[index] + 0.01 * gradient**2
            mean, square = first[index] / (1 - beta1 ** (step + 1)), second[index] / (1 - 0.99 ** (step + 1))
            expected[index] -= learning_rate * mean / (square.sqrt() + 1e-8)
        set_schedule(optimizer, train, step / steps)
        optimizer.step()
    for parameter, value in zip(model.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.detach(), value, rtol=1e-12, atol=1e-14)


def attention_steps(model: DSVT, optimizer: torch.optim.Optimizer, train: TrainConfig, steps: int) -> None:
    generator = torch.Generator().manual_seed(7)
    cell = torch.arange(20)
    coords = torch.stack([cell % 2, cell * 0, cell // 5, cell % 5], dim=1)
    for step in range(steps):
        features, target = torch.randn(2, 20, 8, generator=generator)
        optimizer.zero_grad()
        (model(features, coords, 2) - target).square().mean().backward()
        set_schedule(optimizer, train, step / steps)
        optimizer.step()


def small_attention() -> DSVT:
    torch.manual_seed(0)
    return DSVT(DSVTConfig(d_model=8, num_heads=2, ffn_channels=8, num_blocks=1, set_size=4, window=(3, 3)), (5, 5))


@pytest.mark.parametrize("choice", ["train", "freeze"])
def test_attention_in_proj_is_trained_or_frozen(choice: Any) -> None:
    train = TrainConfig(attention_in_proj=choice, lr=0.01, weight_decay=0.1)
    model = small_attention()
    initial = {name: value.detach().clone() for name, value in model.named_parameters()}
    attention_steps(model, build_optimizer(model, train), train, 8)
    moved = {name for name, value in model.named_parameters() if not torch.equal(value.detach(), initial[name])}
    frozen = {name for name in initial if "in_proj" in name}
    assert len(frozen) == 4  # weight and bias of two layers
    assert moved == (initial.keys() if choice == "train" else initial.keys() - frozen)


def test_a_run_with_frozen_projections_resumes_with_them(tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run", steps=6)
    config.train.attention_in_proj = "freeze"
    config.encoder.kind = "dsvt"
    config.encoder.dsvt = DSVTConfig(d_model=8, num_heads=2, ffn_channels=8, num_blocks=2, set_size=6, window=(8, 8))
    initial = build_model(config).state_dict()
    run = pretrain(config)
    whole = weights(run)
    parameters = {name for name, _ in build_model(config).named_parameters()}
    still = {name for name in parameters if torch.equal(whole[name], initial[name])}
    assert still == {name for name in parameters if "in_proj" in name} and len(still) == 8
    list_checkpoints(run / "checkpoints")[-1].unlink()
    pretrain(config, resume=True)
    assert all(torch.equal(value, whole[name]) for name, value in weights(run).items())
    config.train.attention_in_proj = "train"
    with pytest.raises(CheckpointError, match="train.attention_in_proj = 'train' \\(was 'freeze'\\)"):
        pretrain(config, resume=True)


@pytest.mark.parametrize(
    ("config", "frozen"), [(DSVTConfig(), 396_288), (DSVTConfig(d_model=192, ffn_channels=384), 889_344)]
)
def test_frozen_parameters_of_the_published_models(config: DSVTConfig, frozen: int) -> None:
    model = DSVT(config, (360, 360))
    optimizer = build_optimizer(model, TrainConfig(attention_in_proj="freeze"))
    trained = sum(parameter.numel() for group in optimizer.param_groups for parameter in group["params"])
    assert sum(parameter.numel() for parameter in model.parameters()) - trained == frozen


def test_nothing_to_freeze_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="train.attention_in_proj must be train for an encoder without attention"):
        tiny_config(tmp_path / "run", attention_in_proj="freeze")


def test_batch_norm_statistics_are_those_of_the_final_weights(finished: Path) -> None:
    config = tiny_config(finished)
    network, _ = load_model(config, RunFolder(finished))
    batches = TrainingBatches(config.data, config.point_range, config.train.seed, 12)
    # One layer, by hand: the first of the 2D backbone, over all the steps' inputs (fewer than 16).
    inputs: list[Tensor] = []
    block: Any = network.encoder.get_submodule("backbone_2d.blocks.0")
    convolution, norm = block[1], block[2]
    convolution.register_forward_hook(lambda module, arguments, output: inputs.append(output))
    network.train()
    with torch.no_grad():
        for step in range(12):
            network.encode(batches[step].points, batches[step].point_offsets)
    expected = torch.stack([value.mean(dim=(0, 2, 3)) for value in inputs]).mean(dim=0)
    assert torch.allclose(
        torch.as_tensor(weights(finished)["encoder.backbone_2d.blocks.0.2.running_mean"]), expected, atol=1e-6
    )
    # Doing it again changes nothing, and the momentum is back.
    before = {name: value.clone() for name, value in load_model(config, RunFolder(finished))[0].state_dict().items()}
    network, _ = load_model(config, RunFolder(finished))
    recalibrate_batch_norm(network, ((batches[step].points, batches[step].point_offsets) for step in range(12)))
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert not network.training and norm.momentum == 0.01


def test_initial_weights_depend_on_the_seed_alone(tmp_path: Path) -> None:
    config = tiny_config(tmp_path)
    torch.manual_seed(1)
    one = build_model(config).state_dict()
    torch.manual_seed(2)
    expected = torch.rand(1)
    torch.manual_seed(2)
    two = build_model(config).state_dict()
    assert all(torch.equal(value, two[name]) for name, value in one.items())
    assert torch.equal(torch.rand(1), expected)  # and the caller's generator is left alone


def test_checkpoint_of_another_size_is_named(finished: Path) -> None:
    config = tiny_config(finished)
    config.field.hidden = 24
    with pytest.raises(
        CheckpointError, match=r"(?s)step_00000012\.pt: must fit the run's configuration.*size mismatch"
    ):
        load_model(config, RunFolder(finished))


def test_no_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="must hold a checkpoint, got none"):
        load_model(tiny_config(tmp_path), RunFolder(tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lr": 0.0}, r"train\.lr must be positive, got 0"),
        ({"lr": math.nan}, r"train\.lr must be positive, got nan"),
        ({"steps": 0}, r"train\.steps must be at least 1"),
        ({"log_every": 0}, r"train\.log_every must be at least 1"),
        ({"warmup_fraction": 1.0}, r"train\.warmup_fraction must be between 0 and 1"),
        ({"momentum_range": (0.9, 0.8)}, r"train\.momentum_range must be ascending"),
    ],
)
def test_training_options_are_checked(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainConfig(**changes)


def test_point_range_is_checked() -> None:
    with pytest.raises(ValueError, match=r"point_range must be \(x_min"):
        PretrainConfig(point_range=(1.0, 0.0, 0.0, 1.0, 1.0, 1.0))


def test_csv_log_cuts_later_rows_and_half_lines(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with CsvLog(path, 0) as log:
        for step in (1, 5, 10, 15):
            log.write({"step": step, "loss": step / 10})
    with open(path, "a") as file:
        file.write("20,2")
    with CsvLog(path, 10) as log:
        log.write({"step": 15, "loss": 7.5})
        with pytest.raises(ValueError, match=r"row must have the columns \['step', 'loss'\], got \['step'\]"):
            log.write({"step": 20})
    assert path.read_text() == "step,loss\n1,0.1\n5,0.5\n10,1.0\n15,7.5\n"


def test_csv_log_killed_within_the_header(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("step,lo")
    with CsvLog(path, 0) as log:
        log.write({"step": 1, "loss": 0.5})
    assert path.read_text() == "step,loss\n1,0.5\n"


@pytest.mark.parametrize(
    "config_class",
    [
        PretrainConfig, DataConfig, EncoderConfig, PillarConfig, VoxelConfig, DSVTConfig, BEVBackboneConfig,
        FieldConfig, RendererConfig, LossConfig, TrainConfig,
    ],
)  # fmt: skip
def test_config_classes_document_every_field(config_class: type[Any]) -> None:
    """As jsonargparse reads it for --help: from the docstring, or the string below a field."""
    documented = docstring_parser.parse_from_object(config_class).params
    described = {item.arg_name for item in documented if item.description}
    assert described == {item.name for item in dataclasses.fields(config_class)}
