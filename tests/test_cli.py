# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from pred import cli, config, doctor
from pred.config import CONFIG_FOLDER, ConfigError, build, config_names, config_parser, find_config, flatten, plain
from pred.pretrain import PretrainConfig
from tests.tiny_run import tiny_config, write_config


def parse(*arguments: str) -> PretrainConfig:
    parser = config_parser("pred pretrain", "", PretrainConfig)
    parsed: PretrainConfig = build(parser, PretrainConfig, parser.parse_args(list(arguments)))
    return parsed


def usage_error(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        cli.main(["pretrain", *arguments])
    assert stopped.value.code == 2
    return capfd.readouterr().err


# The command


def test_help_names_every_command_and_is_the_default(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    bare = capfd.readouterr().out
    assert cli.main(["--help"]) == 0
    assert capfd.readouterr().out == bare
    for name in ("pretrain", "evaluate", "view", "doctor"):
        assert f"\n  {name} " in bare


def test_version_and_unknown_command(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capfd.readouterr().out.startswith("pred 0.")
    assert cli.main(["pretain"]) == 2
    assert "unknown command 'pretain'; did you mean pretrain?" in capfd.readouterr().err


def test_help_imports_nothing_heavy() -> None:
    code = "import sys, pred.cli; pred.cli.main(['--help']); print({'torch', 'numpy', 'rich'} & set(sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "set()"


def test_threads_do_not_spin_for_long_unless_asked_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    cli.main(["--version"])
    assert os.environ["GOMP_SPINCOUNT"] == "10000"
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    cli.main(["--version"])
    assert os.environ["GOMP_SPINCOUNT"] == "7"


PAGE_FAULTS = """
import resource, sys
import numpy
from pred import cli
if "tuned" in sys.argv:
    cli.main(["--version"])
numpy.ones(40 << 20, "u1")
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    numpy.ones(40 << 20, "u1")
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif("glibc" not in platform.libc_ver()[0], reason="glibc's malloc is what is tuned")
def test_large_blocks_are_kept_by_the_process() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    environment["NUMPY_MADVISE_HUGEPAGE"] = "0"

    def faults(*arguments: str) -> int:
        command = [sys.executable, "-c", PAGE_FAULTS, *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return int(done.stdout.splitlines()[-1])

    assert faults("tuned") < faults() / 10


@pytest.mark.parametrize("name", ["pretrain", "evaluate", "view", "doctor"])
def test_each_command_has_help(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main([name, "--help"])
    assert stopped.value.code == 0
    output = capfd.readouterr().out
    assert f"pred {name}" in output
    if name == "pretrain":  # options say what they mean, with their unit
        assert "Extent of a pillar in x and y, metres." in output and "--resume" in output


def test_python_m_pred_is_the_command() -> None:
    output = subprocess.run([sys.executable, "-m", "pred", "--version"], capture_output=True, text=True, check=True)
    assert output.stdout.startswith("pred ")


# Configurations


def test_files_and_command_line_override_in_order(tmp_path: Path) -> None:
    first = tmp_path / "first.yaml"
    first.write_text("train:\n  lr: 0.1\n  seed: 7\ndata:\n  batch_size: 3\n")
    second = tmp_path / "second.yaml"
    second.write_text("train:\n  lr: 0.2\n")
    got = parse(f"--config={first}", f"--config={second}", "--data.batch_size", "5")
    assert (got.train.lr, got.train.seed, got.data.batch_size) == (0.2, 7, 5)
    assert got.train.grad_clip == 35.0  # a default


def test_values_have_the_types_of_their_fields() -> None:
    got = parse(
        "--encoder.pillars.pillar_size",
        "[0.4, 0.4]",
        "--encoder.backbone_2d.layer_nums",
        "[1, 2, 3]",
        "--train.lr",
        "1e-3",
        "--data.root",
        "x",
    )
    assert got.encoder.pillars.pillar_size == (0.4, 0.4) and got.encoder.backbone_2d.layer_nums == [1, 2, 3]
    assert got.train.lr == 1e-3 and got.data.root == "x" and got.train.steps is None


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["--data.rot", "x"], "did you mean --data.root?"),
        (["--zzz", "1"], None),
        (["--lr", "1"], "did you mean --train.lr?"),
        (["--encoder.pillars.pilar_size=[1,1]"], "did you mean --encoder.pillars.pillar_size?"),
    ],
)
def test_unknown_option_names_the_nearest(
    capfd: pytest.CaptureFixture[str], arguments: list[str], hint: str | None
) -> None:
    error = usage_error(capfd, *arguments)
    assert f"pred pretrain: error: unrecognized arguments: {arguments[0].partition('=')[0]}" in error
    assert (hint in error) if hint else ("did you mean" not in error)
    assert len(error.splitlines()) == 2  # not a page of usage


@pytest.mark.parametrize(
    ("content", "key", "hint"),
    [
        ("data: {roots: x}", "roots", "did you mean data.root?"),
        ("encoder: {pillars: {pilar_size: [1, 1]}}", "pilar_size", "did you mean encoder.pillars.pillar_size?"),
        ("trains: {lr: 1}", "trains", "did you mean train"),
        ("zzz: 1", "zzz", None),
    ],
)
def test_unknown_key_in_a_file_names_the_nearest(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, content: str, key: str, hint: str | None
) -> None:
    (tmp_path / "a.yaml").write_text(content)
    error = usage_error(capfd, "--config", str(tmp_path / "a.yaml"))
    assert key in error and ((hint in error) if hint else ("did you mean" not in error))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data.batch_size", "many"], "data.batch_size"),
        (["--data.dataset", "kitti"], "data.dataset"),
        (["--data.depth_view", "camera"], "data.depth_view"),
        (["--train.precision", "16"], "train.precision"),
        (["--point_range", "[1, 2]"], "point_range"),
    ],
)
def test_wrong_value_names_its_key(capfd: pytest.CaptureFixture[str], arguments: list[str], message: str) -> None:
    assert message in usage_error(capfd, *arguments)


def test_rule_between_fields_is_an_error_in_one_line(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["pretrain", "--data.mask_ratio", "1.5", "--run", str(tmp_path / "run")]) == 1
    error = capfd.readouterr().err
    assert "pred pretrain: error: data.mask_ratio must be in [0, 1), got 1.5" in error and "Traceback" not in error
    assert not (tmp_path / "run").exists()


def test_none_is_a_word_where_text_is_wanted() -> None:
    assert parse("--data.labels=none").data.labels == "none"


def test_traceback_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRED_TRACEBACK", "1")
    with pytest.raises(ConfigError):
        cli.main(["pretrain", "--data.mask_ratio", "1.5"])


def test_print_config_can_be_read_back(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def printed(*arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            cli.main(["pretrain", *arguments, "--print_config"])
        assert stopped.value.code == 0
        return capfd.readouterr().out

    first = printed("--config", "world_pillars", "--train.lr", "0.25")
    (tmp_path / "printed.yaml").write_text(first)
    assert "lr: 0.25" in first
    assert printed("--config", str(tmp_path / "printed.yaml")) == first


def test_written_config_can_be_read_back(tmp_path: Path) -> None:
    wanted = parse("--config=nuscenes_tiny", "--data.root=somewhere")
    (tmp_path / "config.yaml").write_text(config.to_yaml(wanted))
    assert parse(f"--config={tmp_path / 'config.yaml'}") == wanted


# The configurations of the package


def test_bare_names_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config("nuscenes_tiny") == str(CONFIG_FOLDER / "nuscenes_tiny.yaml")
    (tmp_path / "nuscenes_tiny").write_text("train: {seed: 5}")
    assert find_config("nuscenes_tiny") == "nuscenes_tiny"  # a file at hand comes first


def test_unknown_name_lists_the_known_ones(capfd: pytest.CaptureFixture[str]) -> None:
    error = usage_error(capfd, "--config", "nuscenes_tinny")
    assert "got 'nuscenes_tinny'; did you mean nuscenes_tiny?" in error and "nuscenes_pillars, nuscenes_tiny, " in error
    assert "got 'missing/file.yaml'" in usage_error(capfd, "--config", "missing/file.yaml")


@pytest.mark.parametrize("name", config_names())
def test_config_files_hold_differences_only(name: str) -> None:
    defaults = flatten(plain(PretrainConfig()))
    held = flatten(yaml.safe_load((CONFIG_FOLDER / f"{name}.yaml").read_text()) or {})
    assert parse(f"--config={name}")
    for key, value in held.items():
        if key != "data.dataset":  # spelled out, because the file is named after it
            assert defaults[key] != value, f"{key} is the default already"


SIZES = {
    "data.batch_size", "data.semantic_rays_per_camera", "data.depth_rays", "encoder.pillars.pillar_size",
    "encoder.pillars.vfe_filters", "encoder.backbone_2d.layer_nums", "encoder.backbone_2d.layer_strides",
    "encoder.backbone_2d.num_filters", "encoder.backbone_2d.upsample_strides",
    "encoder.backbone_2d.num_upsample_filters", "field.hidden",
    "renderer.coarse_samples", "renderer.fine_samples", "train.steps",
}  # fmt: skip


def test_nuscenes_tiny_differs_from_nuscenes_pillars_in_sizes_and_frames_only() -> None:
    tiny, full = (flatten(plain(parse(f"--config={name}"))) for name in ("nuscenes_tiny", "nuscenes_pillars"))
    assert {key for key in full if tiny[key] != full[key]} <= SIZES | {"data.split"}
    assert full["data.split"] == "train" and tiny["data.split"] is None


def test_nuscenes_pillars_has_the_papers_values() -> None:
    paper = parse("--config=nuscenes_pillars")
    assert paper.data.dataset == "nuscenes" and paper.data.mask_ratio == 0.95 and paper.data.sweeps == 10
    assert (paper.field.layers, paper.field.hidden) == (4, 256)
    assert (paper.renderer.coarse_samples, paper.renderer.fine_samples) == (96, 128)
    assert paper.loss.eikonal_weight == 0.1
    assert paper.train.lr == 3e-4 and paper.train.epochs == 45 and paper.train.steps is None
    assert paper.data.semantic_rays_per_camera == 512 and paper.data.depth_rays == 3072


# Commands on a run folder


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "rendering", "nowhere"], "nowhere: run folder must exist, got no such folder"),
        (["view", "nowhere"], "nowhere: run folder must exist, got no such folder"),
        (["pretrain", "--resume", "nowhere"], "nowhere: run folder must exist, got no such folder"),
        (
            ["pretrain", "--resume", "started", "--run", "other"],
            "run must not be given with --resume, which continues in started, got other",
        ),
        (["view", "empty"], "empty: run folder must hold config.yaml, got none"),
        (["view", "started"], "started/checkpoints: must hold a checkpoint, got none"),
        (["view", "started", "--checkpoint", "none.pt"], "none.pt: must exist, got no such file"),
        (["view", "started", "--frame", "2"], "frame must be in [0, 2), got 2"),
        (["view", "started", "--columns", "1"], "columns must be at least 2, got 1"),
        (["evaluate", "rendering", "started", "--frames", "0"], "frames must be at least 1, got 0"),
        (["evaluate", "probe", "started", "--frames", "0"], "evaluate probe: frames must be at least 1, got 0"),
        (["evaluate", "rendering", "started", "--data.split", "val"], "v1.0-world, got none: val"),
        (["evaluate", "rendering", "started", "--data.root", "null"], "data.root must name the folder"),
        (["evaluate", "rendering", "started", "--data.root", "no_data"], "no_data"),
    ],
)
def test_missing_things_are_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "started").mkdir()
    write_config(tmp_path / "started" / "config.yaml", tiny_config(tmp_path / "started"))
    assert cli.main(arguments) == 1
    error = capfd.readouterr().err
    assert message in error and error.startswith(f"pred {arguments[0]}: error: ")
    assert [path.name for path in (tmp_path / "started").iterdir()] == ["config.yaml"]


def test_resume_takes_the_runs_configuration_and_later_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    write_config(moved / "config.yaml", tiny_config(tmp_path / "original", seed=5))
    calls: list[Any] = []
    monkeypatch.setattr("pred.pretrain.pretrain", lambda *args, **kwargs: calls.append((args, kwargs)))
    assert cli.main(["pretrain", "--resume", str(moved), "--data.workers", "1"]) == 0
    ((got,), options) = calls[0]
    assert options == {"resume": True}
    assert got.run == str(moved) and got.train.seed == 5 and got.data.workers == 1 and got.field.hidden == 16


# Doctor


def test_doctor_prints_what_a_bug_report_needs(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    output = capfd.readouterr().out
    for word in (
        "torch ",
        "numpy ",
        "python ",
        "backend ",
        "torch threads",
        "cuda ",
        "pred._host",
        "build ",
        "nuscenes ",
    ):
        assert word in output, word


@pytest.mark.parametrize(
    ("requested", "available", "expected"),
    [
        ("auto", True, "native for CPU tensors"),
        ("auto", False, "reference (plain PyTorch), because the library is missing"),
        ("native", False, "none: PRED_BACKEND=native, but the library is missing"),
        ("reference", True, "reference, as PRED_BACKEND asks"),
        ("fast", True, "none: PRED_BACKEND must be auto, native or reference, got 'fast'"),
    ],
)
def test_doctor_says_which_backend_and_why(
    monkeypatch: pytest.MonkeyPatch, requested: str, available: bool, expected: str
) -> None:
    monkeypatch.setenv("PRED_BACKEND", requested)
    status = {
        "available": available,
        "reason": None if available else "no compiler was found",
        "path": "/x/libpred_cpu.so",
        "build": {"native": available},
        "cpu_capability": "avx2" if available else None,
    }
    monkeypatch.setattr(doctor, "native_status", lambda: status)
    lines = dict(dict(doctor.report())["kernels"])
    assert lines["backend"] == expected
    assert ("remedy" in lines) == (not available)
    assert ("no compiler was found" in lines["library"]) == (not available)


def test_doctor_says_why_the_host_module_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    # A file that exists but does not load must not look present.
    monkeypatch.setattr(doctor, "HOST_ERROR", "_host.so: undefined symbol: f")
    host = dict(dict(doctor.report())["kernels"])["pred._host"]
    assert host == "not used, loader workers take NumPy instead: _host.so: undefined symbol: f"
    monkeypatch.setattr(doctor, "HOST_ERROR", None)
    assert dict(dict(doctor.report())["kernels"])["pred._host"] == "loaded"


def test_doctor_names_the_pip_command_of_a_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "EXTRAS", {"no_such_module": ("nuscenes", "reading")})
    assert dict(dict(doctor.report())["extras"])["nuscenes"].startswith("missing; pip install 'pred-lidar[nuscenes]'")


def test_doctor_succeeds_without_the_library() -> None:
    environment = {**os.environ, "PRED_BACKEND": "reference"}
    done = subprocess.run([sys.executable, "-m", "pred", "doctor"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "reference, as PRED_BACKEND asks" in done.stdout
