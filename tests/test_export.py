# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred export`, `pred export --check` and `pred import` on a run of a few steps."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
import shutil
import signal
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from pred import cli, encoder_file
from pred.checkpoint import CheckpointError, list_checkpoints, load_tensors, save_tensors
from pred.checkpoint_layouts import FRAMEWORKS, LayoutError, LayoutOptions, export_state, import_state, shapes_of
from pred.config import build, config_names, config_parser
from pred.data.batch import build_source
from pred.data.frame import Frame
from pred.encoder_file import encoder_facts, load_encoder, read_weights, sidecar, write_encoder
from pred.evaluate_probe import whole_scan
from pred.export import export, import_encoder
from pred.export_check import Comparison, Spec, compare, read_specs, specs_of
from pred.models.encoders import BEVBackboneConfig, DSVTConfig, Encoder, EncoderConfig, PillarConfig, VoxelConfig
from pred.models.encoders.pillars import DynamicPillarVFE
from pred.pretrain import PretrainConfig, build_model, pretrain
from pred.run_folder import RunFolderError
from tests.framework_layouts import MODELS, encoder_specs, names_file, random_state
from tests.tiny_run import tiny_config, write_config

SMALL_2D = BEVBackboneConfig(
    layer_nums=[1, 1],
    layer_strides=[1, 2],
    num_filters=[16, 24],
    upsample_strides=[1, 2],
    num_upsample_filters=[16, 16],
)
ENCODERS = {
    "pillars": EncoderConfig(pillars=PillarConfig(vfe_filters=[16]), backbone_2d=SMALL_2D),
    "hard pillars": EncoderConfig(pillars=PillarConfig(vfe_filters=[16, 16], max_points=5), backbone_2d=SMALL_2D),
    "before 2D": EncoderConfig(pillars=PillarConfig(vfe_filters=[16]), bev="before_2d"),
    "plain voxels": EncoderConfig(kind="voxels", voxels=VoxelConfig(backbone="plain"), backbone_2d=SMALL_2D),
    "voxels": EncoderConfig(kind="voxels", voxels=VoxelConfig(conv_bias=False), backbone_2d=SMALL_2D),
    "biased voxels": EncoderConfig(kind="voxels", backbone_2d=SMALL_2D),
    "dsvt": EncoderConfig(
        kind="dsvt",
        pillars=PillarConfig(vfe_filters=[16, 16]),
        dsvt=DSVTConfig(d_model=16, num_heads=2, ffn_channels=24, num_blocks=2),
        backbone_2d=replace(SMALL_2D, kind="residual", conv_for_no_stride=True),
    ),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pretrain(tiny_config(tmp_path_factory.mktemp("export") / "run", steps=3))


def trained_encoder(run: Path) -> dict[str, Tensor]:
    model = load_tensors(list_checkpoints(run / "checkpoints")[-1])["model"]
    return {name.removeprefix("encoder."): value for name, value in model.items() if name.startswith("encoder.")}


def statistics(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value for name, value in state.items() if ".running_" in name}


# Export


def test_weights_are_those_of_the_checkpoint_and_statistics_those_of_whole_scans(run: Path, tmp_path: Path) -> None:
    config, out = tiny_config(run), tmp_path / "encoder.pth"
    content = export(config, run, "openpcdet", out, recalibrate_scans=2)
    exported, trained = torch.load(out, weights_only=True)["model_state"], trained_encoder(run)
    assert exported.keys() == trained.keys() and not hasattr(exported, "_metadata")
    for name, value in exported.items():
        if not (".running_" in name or name.endswith("num_batches_tracked")):
            assert torch.equal(value, trained[name]), name
    # Of the first layer by hand: mean and variance over the points of each scan, then the mean of the two scans.
    model = build_model(config)
    model.encoder.load_state_dict(trained)
    source = build_source(config.data)
    points = [whole_scan(source.load(index), config, torch.device("cpu")) for index in range(2)]
    outputs: list[Tensor] = []
    assert isinstance(model.encoder.vfe, DynamicPillarVFE)
    layer: Any = model.encoder.vfe.pfn_layers[0]
    layer.linear.register_forward_hook(lambda module, inputs, output: outputs.append(output.detach().double()))
    with torch.no_grad():
        for scan, offsets in points:
            model.encode(scan, offsets)
    for name, of_scan in (("running_mean", lambda x: x.mean(0)), ("running_var", lambda x: x.var(0))):
        expected = torch.stack([of_scan(output) for output in outputs]).mean(0)
        actual = exported[f"vfe.pfn_layers.0.norm.{name}"].double()
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
        before = trained[f"vfe.pfn_layers.0.norm.{name}"].double()
        assert not torch.allclose(before, expected, rtol=1e-2, atol=1e-3)
    assert content["batch_norm"] == {
        "source": "whole scans", "masked": False, "scans": 2, "skipped": 0, "split": None,
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["voxels", "dsvt"])
def test_statistics_of_every_layer_are_those_of_the_whole_scan(kind: str, run: Path, tmp_path: Path) -> None:
    """One scan, so that the average over scans is that of the scan."""
    config = replace(tiny_config(run), encoder=ENCODERS[kind])
    config = replace(config, point_range=(-12.8, -12.8, -5.0, 12.8, 12.8, 3.0))
    encoder = build_model(config).encoder
    write_encoder(tmp_path / "initial.pth", encoder, {})
    import_encoder(config, tmp_path / "initial.pth", tmp_path / "run")
    export(config, tmp_path / "run", "openpcdet", tmp_path / "encoder.pth", recalibrate_scans=1)
    exported = encoder.state_dict() | read_weights(tmp_path / "encoder.pth").state
    seen: dict[str, Tensor] = {}
    for name, layer in encoder.named_modules():
        if isinstance(layer, _BatchNorm):
            layer.register_forward_hook(
                lambda module, inputs, output, name=name: seen.update({name: inputs[0].transpose(0, 1).flatten(1)})
            )
    scan, offsets = whole_scan(build_source(config.data).load(0), config, torch.device("cpu"))
    with torch.no_grad():
        encoder.train()(scan, offsets)
    assert len(seen) >= 10
    for name, values in seen.items():
        torch.testing.assert_close(exported[f"{name}.running_mean"], values.mean(1), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(exported[f"{name}.running_var"], values.var(1), rtol=1e-3, atol=1e-6)
    for name, count in exported.items():
        if name.endswith("num_batches_tracked"):
            assert count == 1, name


def test_scans_without_points_give_no_statistics(run: Path, tmp_path: Path) -> None:
    config = tiny_config(run)
    file = tmp_path / "encoder.pth"
    import_encoder(config, run / "encoder.pth", tmp_path / "run")
    config.point_range = (925.6, 925.6, -3.0, 976.8, 976.8, 3.0)
    with pytest.raises(ValueError, match=r"(?s)must hold points inside point_range.*vfe\.pfn_layers.*--no-recalibrate"):
        export(config, tmp_path / "run", "openpcdet", file, recalibrate_scans=1)
    assert not file.exists()


def test_without_recalibration_every_bit_is_the_checkpoint_s(run: Path, tmp_path: Path) -> None:
    config, trained = tiny_config(run), trained_encoder(run)
    config.data.root = None  # is not looked at
    content = export(config, run, "dsvt", tmp_path / "encoder.pth", recalibrate_scans=None)
    exported = read_weights(tmp_path / "encoder.pth").state
    assert exported.keys() == trained.keys()
    assert all(torch.equal(exported[name], value) for name, value in trained.items())
    assert content["batch_norm"]["masked"] is True
    assert any("80% of the points are hidden" in caveat for caveat in content["caveats"])
    # What the training itself leaves is the same, written in the same way.
    own = torch.load(run / "encoder.pth", weights_only=True)
    assert all(torch.equal(own["model_state"][name], value) for name, value in trained.items())
    assert own["pred"]["batch_norm"] == {"source": "training batches", "masked": True, "batches": 16}


def test_the_sidecar_says_what_a_user_must_know(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "weights.pth"
    assert cli.main(["export", str(run), "--to", "mmdet3d", "--out", str(out), "--recalibrate-scans", "1"]) == 0
    facts = json.loads(sidecar(out).read_text())
    assert sidecar(out).name == "weights.pth.json"
    assert facts["sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    assert list(facts["point_channels"]) == ["x_m", "y_m", "z_m", "intensity", "age_s"] and facts["time_unit"] == "s"
    assert "metres" in facts["point_channels"]["x_m"] and "seconds" in facts["point_channels"]["age_s"]
    assert facts["point_range_m"] == [-25.6, -25.6, -3.0, 25.6, 25.6, 3.0] and facts["voxel_size_m"] == [0.8, 0.8, 6.0]
    assert (facts["dataset"], facts["sweeps"], facts["step"], facts["seed"]) == ("nuscenes", 1, 3, 0)
    assert (facts["mask_ratio"], facts["mask_strategy"]) == (0.8, "point")
    assert facts["trained_with"]["torch"] == facts["written_with"]["torch"] == torch.__version__
    assert facts["layout"]["pillar_network"] == {"type": "PillarFeatureNet", "feat_channels": [8], "legacy": False}
    assert facts["encoder_kind"] == "pillars" and set(facts["encoder_config"]) == {
        "kind", "bev", "pillars", "backbone_2d",
    }  # fmt: skip
    assert facts["layout"]["framework"] == "mmdet3d" and facts["layout"]["key"] == "state_dict"
    assert facts["layout"]["options"] == {"prefix": "pts_", "stride1_conv": True, "dynamic_pillars": False}
    state = torch.load(out, weights_only=True)["state_dict"]
    described = {name: (tuple(value["shape"]), value["dtype"]) for name, value in facts["tensors"].items()}
    assert described == {name: tuple(spec) for name, spec in specs_of(state).items()}
    assert {name.split(".")[0] for name in state} == {"pts_voxel_encoder", "pts_backbone", "pts_neck"}
    # The file alone says the same.
    inside = torch.load(out, weights_only=True)["pred"]
    assert inside == {name: value for name, value in facts.items() if name not in ("sha256", "tensors")}


def test_parts_are_left_out_only_on_request(run: Path, tmp_path: Path) -> None:
    config = tiny_config(run)
    content = export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=None, parts=["vfe"])
    assert {name.split(".")[0] for name in content["tensors"]} == {"vfe"}
    assert content["layout"]["left_out"] == ["backbone_2d"]
    # backbone_3d of pillars and vfe of voxels have no tensors, and may be named.
    content = export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=None, parts=["vfe", "backbone_3d"])
    assert set(content["layout"]["modules"]) == {"vfe"}
    for parts, text in (
        (["vfe", "backbone3d"], "parts must be of vfe, backbone_3d, backbone_2d, got backbone3d"),
        (["backbone_3d"], "parts must name modules with weights, backbone_2d, vfe, got backbone_3d"),
    ):
        with pytest.raises(LayoutError, match=text):
            export(config, run, "openpcdet", tmp_path / "b.pth", parts=parts)
    assert not (tmp_path / "b.pth").exists()


def test_where_a_file_may_be_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Said before any scan is read."""
    config = tiny_config(run)
    other = tmp_path / "other"
    (other / "checkpoints").mkdir(parents=True)
    (other / "run.json").write_text("{}")
    (tmp_path / "mine.pth.json").write_text('{"notes": "of the user"}')
    files = list(run.rglob("*"))
    before = {path: path.read_bytes() for path in files if path.is_file()}
    assert {"config.yaml", "run.json", "encoder.pth"} <= {path.name for path in before}
    for out, text in (
        (tmp_path, "must be a file to write, got a folder"),
        (Path("."), "must be a file to write, got a folder"),
        (tmp_path / "none" / "a.pth", "none/a.pth: folder must exist, got none"),
        *((path, "out must not lie in a run folder") for path in files if path.is_file()),
        (run / "new.pth", "out must not lie in a run folder"),
        (other / "checkpoints" / "new.pth", "out must not lie in a run folder"),
        (tmp_path / "mine.pth", r"mine\.pth\.json: must be absent or of `pred export`, got another file"),
    ):
        with pytest.raises((CheckpointError, ValueError), match=text):
            export(config, run, "openpcdet", out)
    elsewhere = tmp_path / "elsewhere.pt"
    shutil.copy(list_checkpoints(run / "checkpoints")[-1], elsewhere)
    with pytest.raises(ValueError, match="out must not replace the checkpoint"):
        export(config, run, "openpcdet", elsewhere, checkpoint=elsewhere)
    names = tmp_path / "names.txt"
    names.write_text("vfe.weight (1) float32\n")
    with pytest.raises(ValueError, match="out must not replace against"):
        export(config, run, "openpcdet", names, against=names)
    assert names.read_text() == "vfe.weight (1) float32\n"
    assert "recalibrating" not in capsys.readouterr().err
    assert (tmp_path / "mine.pth.json").read_text() == '{"notes": "of the user"}'
    assert {path: path.read_bytes() for path in before} == before


def test_a_full_disk_leaves_the_old_file_and_its_facts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, encoder = tmp_path / "encoder.pth", OneLayer(4)
    write_encoder(path, encoder, {"number": 1})
    before = path.read_bytes(), sidecar(path).read_bytes()

    def full(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        write_encoder(path, encoder, {"number": 2})
    assert (path.read_bytes(), sidecar(path).read_bytes()) == before
    assert {file.name for file in tmp_path.iterdir()} == {"encoder.pth", "encoder.pth.json"}


def test_export_against_a_model(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is written that the model would not take."""
    names = tmp_path / "names.txt"
    specs = specs_of(trained_encoder(run))
    names.write_text("".join(f"{name} {spec}\n" for name, spec in specs.items()))
    arguments = ["export", str(run), "--to", "openpcdet", "--no-recalibrate", "--against", str(names), "--out"]
    assert cli.main([*arguments, str(tmp_path / "a.pth")]) == 0
    lines = names.read_text().splitlines()
    names.write_text("\n".join(lines[1:]))
    assert cli.main([*arguments, str(tmp_path / "b.pth")]) == 1
    name = lines[0].split()[0]
    assert f"left over {name}" in capsys.readouterr().out and not (tmp_path / "b.pth").exists()


def test_options_that_cannot_apply(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["export", str(run), "--to", "mmdet3d", "--out", str(tmp_path / "a.pth")]
    assert cli.main([*arguments, "--no-recalibrate", "--recalibrate-scans", "5"]) == 1
    assert "--recalibrate-scans must be left out with --no-recalibrate" in capsys.readouterr().err
    encoder = Encoder(ENCODERS["voxels"], (-6.4, -6.4, -5.0, 6.4, 6.4, 3.0), point_channels=4)
    with pytest.raises(LayoutError, match="dynamic_pillars must be left out for voxels"):
        write_encoder(tmp_path / "a.pth", encoder, {}, "mmdet3d", LayoutOptions(dynamic_pillars=True))
    assert not (tmp_path / "a.pth").exists()
    with pytest.raises(
        CheckpointError, match=r"encoder\.pth: must be a checkpoint of a run, got the keys model_state, pred"
    ):
        export(tiny_config(run), run, "dsvt", tmp_path / "a.pth", run / "encoder.pth")


def test_dynamic_pillars_say_their_channels(run: Path, tmp_path: Path) -> None:
    """mmdetection3d's DynamicPillarFeatureNet does not halve the layers before the last."""
    config = tiny_config(run)
    encoder = build_model(config).encoder
    widths = [layer.linear.out_features for layer in encoder.vfe.pfn_layers]  # type: ignore[union-attr]
    content = write_encoder(tmp_path / "a.pth", encoder, {}, "mmdet3d", LayoutOptions(dynamic_pillars=True))
    assert content["layout"]["pillar_network"] == {
        "type": "DynamicPillarFeatureNet", "feat_channels": widths, "legacy": False,
    }  # fmt: skip


def test_a_data_set_that_is_gone_names_the_options(run: Path, tmp_path: Path) -> None:
    config = tiny_config(run)
    for root in (None, str(tmp_path / "gone")):
        config.data.root = root
        with pytest.raises(ValueError, match=r"(?s)data\.root|gone.*--data\.root DIR.*--no-recalibrate"):
            export(config, run, "openpcdet", tmp_path / "encoder.pth")
    assert not (tmp_path / "encoder.pth").exists()


def test_weights_that_are_not_finite_are_not_exported(run: Path, tmp_path: Path) -> None:
    state = load_tensors(list_checkpoints(run / "checkpoints")[-1])
    state["model"]["encoder.backbone_2d.blocks.0.1.weight"][0, 0, 0, 0] = float("inf")
    save_tensors(tmp_path / "broken.pt", state)
    with pytest.raises(LayoutError, match=r"backbone_2d\.blocks\.0\.1\.weight: weights must be finite, got 1 of 576"):
        export(tiny_config(run), run, "openpcdet", tmp_path / "a.pth", tmp_path / "broken.pt", recalibrate_scans=None)


def test_a_folder_that_does_not_exist_is_named(run: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"none/a\.pth: folder must exist"):
        export(tiny_config(run), run, "openpcdet", tmp_path / "none" / "a.pth", recalibrate_scans=None)


class OneLayer(nn.Module):
    """An encoder of pillar features alone."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.vfe = nn.Module()
        self.vfe.pfn_layers = nn.ModuleList([nn.ModuleDict({"linear": nn.Linear(11, size, bias=False)})])


def _write_for_ever(path: str, size: int) -> None:
    encoder, number = OneLayer(size), 0.0
    while True:
        number += 1
        (weight,) = encoder.parameters()
        weight.data.fill_(number)
        write_encoder(Path(path), encoder, {"number": number})


def test_a_kill_leaves_a_whole_file(tmp_path: Path) -> None:
    """And never the facts of another beside it."""
    path, context = tmp_path / "encoder.pth", multiprocessing.get_context("spawn")
    process = context.Process(target=_write_for_ever, args=(str(path), 100_000))
    process.start()
    try:
        for _ in range(600):
            if path.is_file():
                break
            time.sleep(0.1)
        time.sleep(0.3)
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.join()
    weights = read_weights(path)  # compares with the sidecar where there is one
    assert torch.equal(next(iter(weights.state.values())), torch.full((100_000, 11), weights.facts["number"]))


def test_a_kill_between_file_and_sidecar_leaves_no_old_facts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, encoder = tmp_path / "encoder.pth", OneLayer(4)
    write_encoder(path, encoder, {"number": 1})
    assert sidecar(path).is_file()

    def killed(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(encoder_file, "write_text", killed)
    with pytest.raises(KeyboardInterrupt):
        write_encoder(path, encoder, {"number": 2})
    assert read_weights(path).facts["number"] == 2 and not sidecar(path).exists()


NAMES_OF_CONFIGS = {
    "nuscenes_hard_pillars": "pcdet_nus_pp", "nuscenes_pillars": "pcdet_nus_dynpp",
    "nuscenes_voxels": "pcdet_nus_cp_vox01", "nuscenes_dsvt": "dsvt_nus", "once_second": "pcdet_once_second",
    "once_voxels": "pcdet_once_cp",
}  # fmt: skip
"""Detectors of OpenPCDet and DSVT that have the encoder of a named configuration."""


@pytest.mark.parametrize("name", config_names())
def test_named_configurations_load_in_the_detectors_that_they_are_for(name: str, tmp_path: Path) -> None:
    parser = config_parser("test", "", PretrainConfig)
    config: PretrainConfig = build(parser, PretrainConfig, parser.parse_args([f"--config={name}"]))
    encoder = Encoder(config.encoder, config.point_range, len(config.data.point_channels))
    for to in FRAMEWORKS:
        content = write_encoder(tmp_path / f"{to}.pth", encoder, encoder_facts(config, encoder, 0, {}), to)
        assert len(content["point_channels"]) == encoder.point_channels == (4 if config.data.dataset == "once" else 5)
    assert {*NAMES_OF_CONFIGS} <= {*config_names()}
    if name in NAMES_OF_CONFIGS:
        names = names_file(NAMES_OF_CONFIGS[name])
        for to in ("openpcdet", "dsvt"):
            assert cli.main(["export", "--check", str(tmp_path / f"{to}.pth"), "--against", str(names)]) == 0


# Check


def run_check(
    tmp_path: Path, state: dict[str, Tensor], names: Path, *more: str, key: str | None = "model_state"
) -> int:
    file = tmp_path / "file.pth"
    torch.save({key: state} if key else state, file)
    return cli.main(["export", "--check", str(file), "--against", str(names), *more])


@pytest.mark.parametrize("model", MODELS)
def test_an_export_fills_the_encoder_of_each_model(
    model: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    specs = encoder_specs(model)
    state = random_state(specs)
    assert run_check(tmp_path, export_state(state, "openpcdet"), names_file(model)) == 0
    printed = capfd.readouterr().out
    for module in {name.split(".")[0] for name in specs}:
        count = sum(name.startswith(f"{module}.") for name in specs)
        assert f"{module:<20} {count}/{count} matched" in printed
    kernels = sum(len(spec.shape) == 5 for spec in specs.values())
    assert (f"{kernels} sparse kernels are (z, y, x, in, out)" in printed) == (kernels > 0)
    assert "dense_head" in printed and "keep their initial values" in printed
    # A whole detector as the framework saves it.
    whole = random_state(read_specs(names_file(model)))
    assert run_check(tmp_path, whole, names_file(model)) == 0
    assert "sparse kernels" not in capfd.readouterr().out


MISTAKES: dict[str, tuple[str, str]] = {
    "channels": ("conv_input.0.weight must be", "the file is for points of 4 channels, the model for 5"),
    "module.": (
        "left over module: all 226 tensors; the model has nothing of module",
        "the file's names have a prefix 'module.' too many",
    ),
    "model.": ("left over", "the file's names have a prefix 'model.' too many"),
    "no prefix": ("missing", "the file's names lack the prefix 'backbone_3d.'"),
    "one kernel": ("shape     backbone_3d.conv2.0.0.weight", "(32, 16, 3, 3, 3) float32: layers of other widths"),
    "no biases": ("missing   backbone_3d.conv1.0.conv1.bias", "no bias (USE_BIAS: False), or it was folded"),
    "mmdetection3d": ("missing", "the file has mmdetection3d's names, the model OpenPCDet's"),
    "cells in z": ("backbone_2d.blocks.0.1.weight must be", "follow from the voxel size and the range in z"),
    "transposed": ("backbone_2d.deblocks.0.0.weight must be", "ConvTranspose2d [in, out, k, k] in place of a Conv2d"),
    "no 2D backbone": ("missing   backbone_2d: all 84 tensors", "the file holds nothing of backbone_2d"),
    "half": ("type      backbone_3d.conv_input.0.weight", "got (3, 3, 3, 5, 16) float16"),
    "counters": (
        "missing   backbone_3d.conv_input.1.num_batches_tracked",
        "written by torch before 0.4.1, or stripped",
    ),
    "stride": ("backbone_2d.deblocks.1.0.weight must be", "kernels of other sizes, so another stride"),
}


def with_mistake(state: dict[str, Tensor], mistake: str) -> dict[str, Tensor]:
    exported = export_state(state, "mmdet3d" if mistake == "mmdetection3d" else "openpcdet")
    if mistake == "channels":
        exported["backbone_3d.conv_input.0.weight"] = torch.zeros(3, 3, 3, 4, 16)
    elif mistake in ("module.", "model."):
        exported = {mistake + name: value for name, value in exported.items()}
    elif mistake == "no prefix":
        exported = {name.removeprefix("backbone_3d."): value for name, value in exported.items() if "2d" not in name}
    elif mistake == "one kernel":
        kernel = state["backbone_3d.conv2.0.0.weight"]
        exported["backbone_3d.conv2.0.0.weight"] = kernel.permute(0, 4, 1, 2, 3)
    elif mistake == "no biases":
        exported = {name: value for name, value in exported.items() if not name.endswith(("conv1.bias", "conv2.bias"))}
    elif mistake == "cells in z":
        exported["backbone_2d.blocks.0.1.weight"] = torch.zeros(128, 384, 3, 3)
    elif mistake == "transposed":
        exported["backbone_2d.deblocks.0.0.weight"] = torch.zeros(256, 128, 1, 1)
    elif mistake == "no 2D backbone":
        exported = {name: value for name, value in exported.items() if not name.startswith("backbone_2d")}
    elif mistake == "half":
        exported = {name: value.half() if value.is_floating_point() else value for name, value in exported.items()}
    elif mistake == "counters":
        exported = {name: value for name, value in exported.items() if not name.endswith("num_batches_tracked")}
    elif mistake == "stride":
        exported["backbone_2d.deblocks.1.0.weight"] = torch.zeros(256, 256, 4, 4)
    return exported


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_found_and_explained(mistake: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    state = random_state(encoder_specs("pcdet_nus_cp_vox01"))
    exported = with_mistake(state, mistake)
    assert run_check(tmp_path, exported, names_file("pcdet_nus_cp_vox01")) == 1
    output = capfd.readouterr()
    problem, cause = MISTAKES[mistake]
    assert problem in output.out and cause in output.out
    assert "must hold the 226 tensors of" in output.err
    # The same file is not imported either, for the same cause.
    if mistake != "half":  # which is widened
        shown = {"counters": "num_batches_tracked", "one kernel": r"sparse kernel must be \(out, z, y, x, in\)"}
        with pytest.raises(LayoutError, match=shown.get(mistake, re.escape(cause))):
            import_state(exported, shapes_of(state), "openpcdet")


@pytest.mark.parametrize(
    "change,problem,cause",
    [
        (
            lambda s: s | {"pts_middle_encoder.conv_input.0.weight": torch.zeros(3, 3, 3, 3, 16)},
            "kernel    pts_middle_encoder.conv_input.0.weight must be (3, 3, 3, 4, 16)",
            "the file is for points of 3 channels, the model for 4",
        ),
        (
            lambda s: {name.removeprefix("pts_"): value for name, value in s.items()},
            "missing   pts_middle_encoder: all",
            "the file's names lack the prefix 'pts_'",
        ),
        (
            lambda s: {f"module.{name}": value for name, value in s.items()},
            "left over module: all",
            "the file's names have a prefix 'module.' too many",
        ),
    ],
)
def test_mistakes_in_files_for_mmdetection3d(
    change: Any, problem: str, cause: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    encoder = Encoder(ENCODERS["voxels"], (-6.4, -6.4, -5.0, 6.4, 6.4, 3.0), point_channels=4)
    exported = export_state(random_state(specs_of(encoder.state_dict())), "mmdet3d")
    names = tmp_path / "names.txt"
    names.write_text("".join(f"{name} {spec}\n" for name, spec in specs_of(exported).items()))
    assert run_check(tmp_path, exported, names) == 0
    assert run_check(tmp_path, change(exported), names) == 1
    output = capfd.readouterr().out
    assert problem in output and cause in output
    torch.save({"state_dict": change(exported)}, tmp_path / "wrong.pth")
    options = LayoutOptions(stride1_conv=True, prefix="pts_" if "'pts_'" in cause else None)
    with pytest.raises(CheckpointError, match=f"(?s)wrong.pth: mmdet3d: .*{re.escape(cause)}"):
        load_encoder(encoder, tmp_path / "wrong.pth", options)


def test_names_of_the_other_pillar_network(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    encoder = Encoder(ENCODERS["pillars"], (-6.4, -6.4, -5.0, 6.4, 6.4, 3.0), point_channels=4)
    state = random_state(specs_of(encoder.state_dict()))
    files = [export_state(state, "mmdet3d", LayoutOptions(dynamic_pillars=dynamic)) for dynamic in (False, True)]
    for file, model, text in (
        (files[0], files[1], "the model is a DynamicPillarFeatureNet, the file for a PillarFeatureNet"),
        (files[1], files[0], "the model is a PillarFeatureNet, the file for a DynamicPillarFeatureNet"),
    ):
        names = tmp_path / "names.txt"
        names.write_text("".join(f"{name} {spec}\n" for name, spec in specs_of(model).items()))
        assert run_check(tmp_path, file, names) == 1
        assert f"the file has others of pts_voxel_encoder: {text}" in capfd.readouterr().out
    names.write_text("vfe.a (2) float32\nvfe.a (3) float32\n")
    with pytest.raises(CheckpointError, match=r"names.txt: line 2 must name another tensor, got vfe\.a again"):
        read_specs(names)
    with pytest.raises(CheckpointError, match="must be a list of names or a checkpoint, got a folder"):
        read_specs(tmp_path)


def test_points_of_another_number_of_channels_into_a_pillar_network(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    state = random_state(encoder_specs("pcdet_nus_pp"))
    assert run_check(tmp_path, state, names_file("pcdet_once_pp"), "--only", "vfe") == 1
    assert "the file is for points of 5 channels, the model for 4" in capfd.readouterr().out


def test_only_compares_what_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    state = random_state(encoder_specs("pcdet_nus_second"))
    names = names_file("pcdet_nus_second")
    without_2d = {name: value for name, value in state.items() if name.startswith("backbone_3d")}
    assert run_check(tmp_path, without_2d, names) == 1
    assert run_check(tmp_path, without_2d, names, "--only", "backbone_3d") == 0
    printed = capfd.readouterr().out.splitlines()
    assert "backbone_3d          142/142 matched" in printed
    assert run_check(tmp_path, state, names, "--only", "backbone_3d") == 0
    assert run_check(tmp_path, state, names, "--only", "backbone_3d,dense_head") == 1
    assert run_check(tmp_path, state, names, "--only", "backbone_4d") == 1
    assert "--only must name modules of FILE or NAMES" in capfd.readouterr().err


def test_nothing_to_compare_is_not_a_success(tmp_path: Path) -> None:
    names = tmp_path / "names.txt"
    names.write_text("dense_head.conv.weight (1, 2) float32\n")
    assert run_check(tmp_path, {"dense_head.conv.weight": torch.zeros(1, 2)}, names) == 1
    assert compare({}, {}) == Comparison()


def test_a_checkpoint_may_stand_in_place_of_names(tmp_path: Path) -> None:
    state = random_state(encoder_specs("pcdet_nus_tf"))
    detector = tmp_path / "detector.pth"
    torch.save({"model_state": state | {"dense_head.w": torch.zeros(2)}, "epoch": 3}, detector)
    assert run_check(tmp_path, export_state(state, "openpcdet"), detector) == 0
    assert run_check(tmp_path, state, detector, key=None) == 0  # a flat dictionary
    torch.save({"state_dict": export_state(state, "mmdet3d")}, detector)
    assert run_check(tmp_path, export_state(state, "mmdet3d"), detector, key="state_dict") == 0
    assert run_check(tmp_path, export_state(state, "openpcdet"), detector) == 1


def test_mmdetection3d_turns_kernels_whatever_their_shape(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Names of a model with spconv 2 list (out, z, y, x, in), yet the file has to be (z, y, x, in, out)."""
    exported = export_state(random_state(encoder_specs("pcdet_nus_tf")), "mmdet3d")
    krsc = {name: value.permute(4, 0, 1, 2, 3) if value.dim() == 5 else value for name, value in exported.items()}
    names = tmp_path / "names.txt"
    for listed in (exported, krsc):
        names.write_text("# a model\n" + "".join(f"{name} {spec}\n" for name, spec in specs_of(listed).items()))
        assert run_check(tmp_path, exported, names) == 0
        assert run_check(tmp_path, krsc, names) == 1
    assert "which mmdetection3d turns once more on loading" in capfd.readouterr().out


def test_names_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    names = tmp_path / "names.txt"
    names.write_text("vfe.weight (1, 2) float32 # a comment\nvfe.bias 3\n")
    with pytest.raises(CheckpointError, match=r"names\.txt: line 2 must be `name \(shape\) dtype`, got 'vfe\.bias 3'"):
        read_specs(names)
    names.write_text("# nothing\n")
    with pytest.raises(CheckpointError, match="must name tensors, got none"):
        read_specs(names)
    names.write_text("a.b () int64\na.c (3,) float32\na.d torch.Size([3]) x\n")
    with pytest.raises(CheckpointError, match="line 3"):
        read_specs(names)
    names.write_text("a.b () int64\na.c (3,) float32\n")
    assert read_specs(names) == {"a.b": Spec((), "int64"), "a.c": Spec((3,), "float32")}


# Import


def test_import_undoes_export(run: Path, tmp_path: Path) -> None:
    config, trained = tiny_config(run), trained_encoder(run)
    for to in ("openpcdet", "mmdet3d"):
        export(config, run, to, tmp_path / f"{to}.pth", recalibrate_scans=None)
        import_encoder(config, tmp_path / f"{to}.pth", tmp_path / to)
        state = load_tensors(tmp_path / to / "checkpoints" / "step_00000000.pt")
        imported = {name.removeprefix("encoder."): value for name, value in state["model"].items() if "encoder" in name}
        assert imported.keys() == trained.keys()
        assert all(torch.equal(imported[name], value) for name, value in trained.items())
        assert (tmp_path / to / "config.yaml").is_file() and (tmp_path / to / "encoder.pth.json").is_file()
        # And once more to the other framework.
        export(config, tmp_path / to, "dsvt", tmp_path / "again.pth", recalibrate_scans=None)
        again = read_weights(tmp_path / "again.pth").state
        assert all(torch.equal(again[name], value) for name, value in trained.items())
    with pytest.raises(RunFolderError, match="must be new"):
        import_encoder(config, tmp_path / "openpcdet.pth", tmp_path / "openpcdet")


def test_what_an_import_says_of_the_training(run: Path, tmp_path: Path) -> None:
    """What the file says; of a file of others nobody knows."""
    config = tiny_config(run)
    export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=None)
    torch.save({"model_state": read_weights(tmp_path / "a.pth").state}, tmp_path / "bare.pth")
    here = replace(config, data=replace(config.data, mask_ratio=0.5, sweeps=3), train=replace(config.train, seed=77))
    names = ("dataset", "sweeps", "mask_ratio", "step", "seed")
    for file, wanted in (("a.pth", ["nuscenes", 1, 0.8, 3, 0]), ("bare.pth", [None] * 5)):
        out = tmp_path / f"run of {file}"
        import_encoder(here, tmp_path / file, out)
        export(here, out, "mmdet3d", tmp_path / "again.pth", recalibrate_scans=None)
        for path in (out / "encoder.pth", tmp_path / "again.pth"):
            facts = json.loads(sidecar(path).read_text())
            assert [facts[name] for name in names] == wanted and facts["imported"]["file"] == str(tmp_path / file)


@pytest.mark.parametrize(
    "change,text",
    [
        (
            lambda c: replace(
                c, encoder=replace(c.encoder, pillars=replace(c.encoder.pillars, pillar_size=(0.4, 0.4)))
            ),
            r"voxel_size_m must be that of the encoder, \[0\.4, 0\.4, 6\.0\], got \[0\.8, 0\.8, 6\.0\]",
        ),
        (
            lambda c: replace(c, point_range=(*c.point_range[:2], -4.0, *c.point_range[3:5], 2.0)),
            r"point_range_m must be that of the encoder in z, \[-4\.0, 2\.0\], got \[-3\.0, 3\.0\]",
        ),
    ],
)
def test_weights_of_another_input_are_refused(
    run: Path, tmp_path: Path, change: Callable[[PretrainConfig], PretrainConfig], text: str
) -> None:
    """Names and shapes would fit."""
    config = tiny_config(run)
    export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=None)
    other = change(config)
    with pytest.raises(CheckpointError, match=text):
        import_encoder(other, tmp_path / "a.pth", tmp_path / "out")
    with pytest.raises(CheckpointError, match=text):
        pretrain(replace(other, run=str(tmp_path / "new"), init_encoder=str(tmp_path / "a.pth")))
    assert {path.name for path in tmp_path.iterdir()} == {"a.pth", "a.pth.json"}
    weights = torch.load(tmp_path / "a.pth", weights_only=True)
    weights["pred"]["point_channels"] = dict(reversed(weights["pred"]["point_channels"].items()))
    torch.save(weights, tmp_path / "b.pth")
    with pytest.raises(CheckpointError, match="point_channels must be that of the encoder, x_m, y_m, .* got age_s, "):
        import_encoder(config, tmp_path / "b.pth", tmp_path / "out")


def test_an_import_that_fails_leaves_nothing(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a run folder would pass for a run before its first checkpoint, and be trained from initial weights."""
    config = tiny_config(run)
    export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=None)
    before = {path.name for path in tmp_path.iterdir()}

    def full(*arguments: Any, **named: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("pred.export.save_checkpoint", full)
        with pytest.raises(OSError, match="No space left"):
            import_encoder(config, tmp_path / "a.pth", tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == before
    import_encoder(config, tmp_path / "a.pth", tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} == before | {"out"}


@pytest.mark.parametrize(
    "options,asked,text",
    [
        ({"foo": 1}, {}, "layout.options must be those of `pred export`, got foo = 1"),
        ({"stride1_conv": "x"}, {}, "layout.options must be those of `pred export`, got stride1_conv = 'x'"),
        ({"stride1_conv": 1}, {}, "layout.options must be those of `pred export`, got stride1_conv = 1"),
        ([], {}, "layout.options must be a dictionary, got list"),
        (
            {"stride1_conv": True},
            {"stride1_conv": False},
            "--stride1-deblock must be left out or say what the file says",
        ),
        ({"prefix": "pts_"}, {"prefix": ""}, "--mmdet3d-prefix must be left out or say what the file says"),
    ],
)
def test_what_a_file_says_of_itself(run: Path, tmp_path: Path, options: Any, asked: Any, text: str) -> None:
    export(tiny_config(run), run, "mmdet3d", tmp_path / "a.pth", recalibrate_scans=None)
    weights = torch.load(tmp_path / "a.pth", weights_only=True)
    weights["pred"]["layout"]["options"] = options
    torch.save(weights, tmp_path / "b.pth")
    encoder = build_model(tiny_config(run)).encoder
    with pytest.raises(CheckpointError, match=text):
        load_encoder(encoder, tmp_path / "b.pth", LayoutOptions(**asked))


def circular() -> list[Any]:
    values: list[Any] = []
    values.append(values)
    return values


MALFORMED: list[tuple[Any, Any, str]] = [
    ("layout", "openpcdet", "layout must be a dictionary, got 'openpcdet'"),
    ("layout", None, "layout must be a dictionary, got None"),
    ("layout", {}, "layout.framework must be openpcdet, dsvt or mmdet3d, got None"),
    ("layout", {"framework": ["dsvt"]}, "layout.framework must be openpcdet, dsvt or mmdet3d, got ['dsvt']"),
    ("layout", {"framework": "dsvt", "options": 3}, "layout.options must be a dictionary, got int"),
    ("voxel_size_m", 0.8, "voxel_size_m must be a list of 3 numbers, got 0.8"),
    ("voxel_size_m", [0.8, 0.8, True], "voxel_size_m must be a list of 3 numbers, got [0.8, 0.8, True]"),
    ("point_range_m", "all", "point_range_m must be a list of 6 numbers, got 'all'"),
    ("point_range_m", [-3.0, 3.0], "point_range_m must be a list of 6 numbers, got [-3.0, 3.0]"),
    ("point_range_m", [0, 0, "-3", 1, 1, 3], "point_range_m must be a list of 6 numbers, got [0, 0, '-3', 1, 1, 3]"),
    ("point_range_m", [float("nan")] * 6, "point_range_m must be a list of 6 numbers, got [nan, "),
    ("point_range_m", torch.zeros(6), "point_range_m must be a plain value, got Tensor"),
    ("point_channels", ["x_m"], "point_channels must be a dictionary of names to units, got ['x_m']"),
    ("point_channels", {1: "metres"}, "names in point_channels must be text, got 1"),
    ("point_channels", {"x_m": 1}, "point_channels must be a dictionary of names to units, got {'x_m': 1}"),
    ("time_unit", 1, "time_unit must be text, got 1"),
    ("batch_norm", "masked", "batch_norm must be a dictionary, got 'masked'"),
    ("dataset", 3, "dataset must be text, got 3"),
    ("split", ["train"], "split must be text, got ['train']"),
    ("mask_strategy", 1, "mask_strategy must be text, got 1"),
    ("sweeps", 1.5, "sweeps must be a whole number, got 1.5"),
    ("step", True, "step must be a whole number, got True"),
    ("seed", "0", "seed must be a whole number, got '0'"),
    ("mask_ratio", "0.95", "mask_ratio must be a number from 0 to 1, got '0.95'"),
    ("mask_ratio", 95, "mask_ratio must be a number from 0 to 1, got 95"),
    ("trained_with", [], "trained_with must be a dictionary, got []"),
    ("notes", {"a": torch.Size([3]), "b": torch.zeros(2)}, "notes.b must be a plain value, got Tensor"),
    ("notes", circular(), "notes must hold plain values, got one within itself"),
    ("notes", {(1, 2): 3}, "names in notes must be text, got (1, 2)"),
    (3, 4, "names of pred must be text, got 3"),
]


@pytest.mark.parametrize("name,value,text", MALFORMED)
def test_malformed_facts_are_named(run: Path, tmp_path: Path, name: Any, value: Any, text: str) -> None:
    weights = torch.load(run / "encoder.pth", weights_only=True)
    weights["pred"][name] = value
    path, config = tmp_path / "bad.pth", tiny_config(run)
    torch.save(weights, path)
    with pytest.raises(CheckpointError, match=re.escape(f"{path}: {text}")):
        import_encoder(config, path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    if "options" not in text:
        imported = {"file": str(path), "facts": weights["pred"]}
        with pytest.raises(CheckpointError, match=re.escape(f"{path}: {text}")):
            encoder_facts(config, build_model(config).encoder, 0, {}, imported=imported)


def test_facts_are_a_dictionary_or_absent(run: Path, tmp_path: Path) -> None:
    path, state = tmp_path / "a.pth", trained_encoder(run)
    torch.save({"model_state": state, "pred": ["a"]}, path)
    with pytest.raises(CheckpointError, match=re.escape(f"{path}: pred must be a dictionary, got ['a']")):
        read_weights(path)
    torch.save({"model_state": state}, path)
    assert read_weights(path).facts == {}
    torch.save({"pred": torch.zeros(2)}, path)  # a flat file's tensor of that name says nothing
    assert read_weights(path).facts == {} and read_weights(path).state.keys() == {"pred"}
    # What nobody knows of a training is None.
    torch.save({"model_state": state, "pred": dict.fromkeys(("dataset", "mask_ratio", "step", "trained_with"))}, path)
    assert import_encoder(tiny_config(run), path, tmp_path / "out")["facts"]["step"] is None


def test_an_option_beside_what_the_file_says(run: Path, tmp_path: Path) -> None:
    """Of what both say nothing is lost: the deblocks come back to the bit."""
    options = LayoutOptions(dynamic_pillars=True)
    export(tiny_config(run), run, "mmdet3d", tmp_path / "a.pth", recalibrate_scans=None, options=options)
    encoder = build_model(tiny_config(run)).encoder
    load_encoder(encoder, tmp_path / "a.pth", options)
    assert all(torch.equal(encoder.state_dict()[name], value) for name, value in trained_encoder(run).items())
    with pytest.raises(CheckpointError, match="--kernel-order must be dhwio, as the file says, got krsc"):
        load_encoder(encoder, tmp_path / "a.pth", kernel_order="krsc")


@pytest.mark.parametrize(
    "state,text",
    [
        ({1: torch.zeros(2)}, "names of weights must be text, got 1"),
        ({"vfe.a": torch.zeros(2, device="meta")}, "must be dense tensors with values, got a meta one as vfe.a"),
        ({"vfe.a": torch.eye(2).to_sparse()}, "got a torch.sparse_coo one as vfe.a"),
        ({}, "must hold weights, got none"),
    ],
)
def test_weights_that_are_none(tmp_path: Path, state: Any, text: str) -> None:
    torch.save({"model_state": state}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=text):
        read_weights(tmp_path / "a.pth")


@pytest.mark.parametrize("to", FRAMEWORKS)
@pytest.mark.parametrize("kind", ENCODERS)
def test_a_file_of_each_encoder_comes_back_to_the_bit(kind: str, to: Any, tmp_path: Path) -> None:
    """Without an option: what the export assumed stands in the file."""
    path = tmp_path / "encoder.pth"
    point_range = (-6.4, -6.4, -5.0, 6.4, 6.4, 3.0)
    encoder, other = (Encoder(ENCODERS[kind], point_range, point_channels=4) for _ in range(2))
    encoder.load_state_dict(random_state(specs_of(encoder.state_dict())))
    content = write_encoder(path, encoder, {}, to)
    count = len(encoder.state_dict()) - (16 if kind == "biased voxels" and to == "mmdet3d" else 0)
    assert content["layout"]["num_tensors"] == len(content["tensors"]) == count
    if kind == "biased voxels" and to == "mmdet3d":
        with pytest.raises(CheckpointError, match="residual convolutions must have no bias"):
            load_encoder(other, path)
        return
    load_encoder(other, path)
    for name, value in encoder.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name


def test_a_training_starts_from_imported_weights(run: Path, tmp_path: Path) -> None:
    trained = trained_encoder(run)
    detector = tmp_path / "detector.pth"
    torch.save(
        {"model_state": OrderedDict(trained) | {"dense_head.w": torch.zeros(2), "global_step": torch.tensor([7])}},
        detector,
    )
    config = tiny_config(tmp_path / "new", steps=1, lr=1e-30)
    config.init_encoder = str(detector)
    new = pretrain(config)
    weights = trained_encoder(new)
    for name, value in weights.items():
        if value.is_floating_point() and ".running_" not in name:
            torch.testing.assert_close(value, trained[name], rtol=0, atol=1e-20)
    recorded = json.loads((new / "run.json").read_text())["init_encoder"]
    assert recorded["file"] == str(detector) and recorded["left_out"] == ["dense_head", "global_step"]
    # Once there is a checkpoint the file is not needed.
    detector.unlink()
    assert pretrain(config, resume=True) == new
    # Weights that do not fit leave no folder.
    del trained["vfe.pfn_layers.0.norm.bias"]
    torch.save(trained, detector)
    config.run = str(tmp_path / "none")
    with pytest.raises(CheckpointError, match=r"detector\.pth: openpcdet: tensors must be those.*\n.*norm\.bias \(8\)"):
        pretrain(config)
    assert not (tmp_path / "none").exists()


def test_commands_read_an_imported_run(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = write_config(tmp_path / "config.yaml", tiny_config(run))
    arguments = ["import", str(run / "encoder.pth"), "--config", str(config), "--out", str(tmp_path / "imported")]
    assert cli.main(arguments) == 0
    assert "imported 24 tensors of openpcdet" in capfd.readouterr().out
    assert cli.main(["evaluate", "rendering", str(tmp_path / "imported"), "--frames", "1"]) == 0
    assert json.loads((tmp_path / "imported/evaluation_rendering.json").read_text())["frames_trained_on"] is None
    # A training does not continue it, and says what does; without its checkpoint it would start from nothing.
    for _ in range(2):
        assert cli.main(["pretrain", "--resume", str(tmp_path / "imported")]) == 1
        assert "start one from them with --init_encoder" in capfd.readouterr().err
        shutil.rmtree(tmp_path / "imported/checkpoints")
        (tmp_path / "imported/checkpoints").mkdir()


def refusal(tmp_path: Path, content: Any, message: str) -> None:
    path = tmp_path / "foreign.pth"
    torch.save(content, path)
    with pytest.raises(CheckpointError, match=message):
        load_encoder(build_model(tiny_config(tmp_path / "run")).encoder, path)


class Payload:
    """Pickled as a call that makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_files_that_are_not_weights_are_refused_by_their_cause(run: Path, tmp_path: Path) -> None:
    state = trained_encoder(run)
    scalar = {"model_state": state, "accuracy": np.float64(0.5)}
    refusal(tmp_path, scalar, r"NumPy value \(numpy\._?core\.multiarray\.scalar\), which torch 2\.6.*write the weights")
    made = tmp_path / "made"
    refusal(tmp_path, {"model_state": state, "hook": Payload(made)}, "an object of .*nothing of it was run")
    assert not made.exists()
    refusal(tmp_path, [state], "must hold a dictionary, got list")
    refusal(tmp_path, {"epoch": 3, "it": 5}, r"model_state or state_dict.*got the keys epoch, it")
    refusal(tmp_path, {"model_state": {"vfe.w": 3}}, r"weights must be tensors, got int as vfe\.w")
    refusal(tmp_path, load_tensors(list_checkpoints(run / "checkpoints")[-1]), "pred export RUN --checkpoint FILE")
    wide = state | {"vfe.pfn_layers.0.linear.weight": torch.zeros(8, 10)}
    refusal(tmp_path, wide, r"linear\.weight must be \(8, 11\), got \(8, 10\): the file is for points of 4 channels")
    refusal(tmp_path, {f"module.{name}": value for name, value in state.items()}, r"a prefix 'module\.' too many")
    bare = {name.removeprefix("backbone_2d."): value for name, value in state.items()}
    refusal(tmp_path, bare, r"lack the prefix 'backbone_2d\.'")
    nan = state | {"vfe.pfn_layers.0.norm.weight": torch.full((8,), float("nan"))}
    refusal(tmp_path, nan, r"norm\.weight: weights must be finite, got 8 of 8")


def test_damaged_files_are_refused(run: Path, tmp_path: Path) -> None:
    content = (run / "encoder.pth").read_bytes()
    path = tmp_path / "encoder.pth"
    for damaged, message in (
        (content[: len(content) // 2], "got a truncated one"),
        (b"", "got an empty file"),
        (b"no checkpoint", "must be a readable checkpoint"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=message):
            read_weights(path)
    path.write_bytes(content)
    sidecar(path).write_text((run / "encoder.pth.json").read_text())
    assert read_weights(path).facts["step"] == 3
    sidecar(path).write_text('{"sha256": "0"}')
    with pytest.raises(CheckpointError, match=r"must be the file that encoder\.pth\.json describes"):
        read_weights(path)


def test_files_of_old_torch_are_read(run: Path, tmp_path: Path) -> None:
    """No zip archive, and a state dict with metadata."""
    state = OrderedDict(trained_encoder(run))
    state._metadata = {"": {"version": 1}}  # type: ignore[attr-defined]
    torch.save({"model_state": state}, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    encoder = build_model(tiny_config(tmp_path / "run")).encoder
    assert load_encoder(encoder, tmp_path / "old.pth")["num_tensors"] == len(state)
    assert shapes_of(encoder.state_dict()) == shapes_of(state)
    assert all(torch.equal(value, state[name]) for name, value in encoder.state_dict().items())


# Command line


def test_usage_errors_are_named(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        ([str(run), "--to", "pytorch", "--out", "a.pth"], "pytorch"),
        ([str(run), "--out", "a.pth"], "to"),
        (["--check", "a.pth"], "--against"),
    ):
        with pytest.raises(SystemExit) as stopped:
            cli.main(["export", *arguments])
        assert stopped.value.code == 2 and message in capfd.readouterr().err
    out = str(tmp_path / "a.pth")
    assert cli.main(["export", str(run), "--to", "dsvt", "--out", out, "--recalibrate-scans", "0"]) == 1
    assert "recalibrate-scans must be at least 1, got 0" in capfd.readouterr().err
    assert cli.main(["export", "--check", out, "--against", out]) == 1
    assert "a.pth: must exist, got no such file" in capfd.readouterr().err


def test_broken_scans_are_skipped_or_refused(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pred.data.frame import FrameError

    config = tiny_config(run)
    source = build_source(config.data)
    original = type(source).load

    def load(self: Any, index: int) -> Frame:
        if index == 0:
            raise FrameError(Path("a.bin"), "is broken")
        return original(self, index)

    monkeypatch.setattr(type(source), "load", load)
    with pytest.raises(ValueError, match=r"a\.bin.*is broken"):
        export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=2)
    config.data.on_error = "skip"
    content = export(config, run, "openpcdet", tmp_path / "a.pth", recalibrate_scans=2)
    assert (content["batch_norm"]["scans"], content["batch_norm"]["skipped"]) == (1, 1)
    monkeypatch.setattr(type(source), "load", lambda self, index: load(self, 0))
    with pytest.raises(ValueError, match=r"(?s)scans must be readable, got none of 2.*--no-recalibrate"):
        export(config, run, "openpcdet", tmp_path / "b.pth", recalibrate_scans=2)
