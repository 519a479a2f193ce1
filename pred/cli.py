# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The `pred` command: one sub-command per job. Each reads its arguments and hands over; the work is elsewhere.

Imports that cost time stay inside the sub-commands, so that help and errors come at once.
"""

from __future__ import annotations

import ctypes
import difflib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Names of mallopt() parameters, from glibc's malloc.h."""
KEPT_BYTES = 1 << 30


def pretrain(arguments: list[str]) -> None:
    from pred.config import build, config_parser
    from pred.pretrain import PretrainConfig
    from pred.pretrain import pretrain as run_pretraining
    from pred.run_folder import RunFolder

    parser = config_parser("pred pretrain", "Pre-train a LiDAR encoder by rendering.", PretrainConfig)
    parser.add_argument("--resume", type=Path | None, default=None, help="run folder to continue, from its config.yaml")
    parsed = parser.parse_args(arguments)
    if parsed.resume is not None:
        folder = RunFolder(Path(parsed.resume))
        folder.require()
        if parsed.run is not None and Path(parsed.run).resolve() != folder.path.resolve():
            raise ValueError(f"run must not be given with --resume, which continues in {folder.path}, got {parsed.run}")
        parsed = parser.parse_args([f"--config={folder.config}", *arguments, f"--run={folder.path}"])
    run_pretraining(build(parser, PretrainConfig, parsed), resume=parsed.resume is not None)


def evaluate(arguments: list[str]) -> None:
    from argparse import ArgumentParser, RawDescriptionHelpFormatter

    lines = [f"  {name:<10} {command.summary}" for name, command in EVALUATIONS.items()]
    parser = ArgumentParser(
        "pred evaluate",
        usage="pred evaluate WHAT [options]    (pred evaluate WHAT --help for its options)",
        description="\n".join(["Measure a run, or a file of predictions. WHAT is one of", *lines]),
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", metavar="WHAT", choices=EVALUATIONS)
    EVALUATIONS[parser.parse_args(arguments[:1]).what].function(arguments[1:])


def evaluate_rendering(arguments: list[str]) -> None:
    from pred.evaluate import evaluate_rendering as run_evaluation

    def add_options(parser: Any) -> None:
        parser.add_argument(
            "--frames", type=int | None, default=None, help="so many frames, evenly spread; all by default"
        )
        parser.add_argument(
            "--all-returns", action="store_true", help="every return that is not seen: for frames not trained on"
        )

    options, config = _options_of_run(
        "pred evaluate rendering",
        "Compare a run with held-out returns, with a simple baseline and with an untrained network.",
        arguments,
        add_options,
    )
    run_evaluation(
        config,
        Path(options.folder),
        checkpoint=options.checkpoint,
        max_frames=options.frames,
        all_returns=options.all_returns,
    )


def evaluate_probe(arguments: list[str]) -> None:
    from pred.evaluate_probe import evaluate_probe as run_evaluation

    def add_options(parser: Any) -> None:
        parser.add_argument("--train-split", default="train", help="frames that the probe is fitted on")
        parser.add_argument("--val-split", default="val", help="frames that it is measured on")
        parser.add_argument("--cells-per-frame", type=int, default=512, help="cells drawn per fitted frame")
        parser.add_argument(
            "--frames",
            type=int | None,
            default=None,
            help="so many frames of each split, evenly spread; all by default",
        )

    options, config = _options_of_run(
        "pred evaluate probe",
        "Fit a linear classifier of BEV cells on the frozen encoder, and on an untrained one.",
        arguments,
        add_options,
    )
    run_evaluation(
        config,
        Path(options.folder),
        checkpoint=options.checkpoint,
        train_split=options.train_split,
        val_split=options.val_split,
        cells_per_frame=options.cells_per_frame,
        max_frames=options.frames,
    )


def evaluate_once(arguments: list[str]) -> None:
    from argparse import ArgumentParser

    parser = ArgumentParser(
        "pred evaluate once",
        description="Average precision of 3D boxes by the rules of the ONCE benchmark.",
    )
    parser.add_argument(
        "predictions", type=Path, help="JSON list with an entry {frame_id, name, score, boxes_3d} per frame"
    )
    parser.add_argument(
        "--truth", type=Path, required=True, help="root of a ONCE tree, or JSON list of {frame_id, name, boxes_3d}"
    )
    parser.add_argument("--split", help="list in ImageSets/ of the tree, such as val; all sequences by default")
    parser.add_argument(
        "--by", choices=("superclass", "class"), default="superclass", help="superclass: Car, Bus and Truck are Vehicle"
    )
    parser.add_argument(
        "--iou",
        choices=("official", "true"),
        default="official",
        help="official: as the devkit computes it, which turns boxes the wrong way; true: of the boxes as they are",
    )
    parser.add_argument("--output", type=Path, help="file to write; PREDICTIONS with _ap.json at its end by default")
    options = parser.parse_args(arguments)
    from pred.evaluate_once import evaluate_once as run_evaluation

    run_evaluation(**vars(options))


def view(arguments: list[str]) -> None:
    from pred.view import view as make_pictures

    def add_options(parser: Any) -> None:
        parser.add_argument("--frame", type=int, default=0, help="index of the frame in the data set")
        parser.add_argument("--columns", type=int, default=200, help="rays per image row (200: 1/8 of 1600 pixels)")

    options, config = _options_of_run(
        "pred view", "Pictures of what a run renders: one per camera, one from above.", arguments, add_options
    )
    make_pictures(
        config, Path(options.folder), checkpoint=options.checkpoint, frame_index=options.frame, columns=options.columns
    )


def export(arguments: list[str]) -> None:
    if any(argument.split("=")[0] == "--check" for argument in arguments):
        export_check(arguments)
        return
    from pred.checkpoint_layouts import ENCODER_MODULES, FRAMEWORKS
    from pred.export import RECALIBRATION_SCANS
    from pred.export import export as run_export

    def add_options(parser: Any) -> None:
        parser.add_argument("--to", choices=FRAMEWORKS, required=True, help="framework that is to load the file")
        parser.add_argument("--out", type=Path, required=True, help="file to write; OUT.json beside it holds the facts")
        parser.add_argument(
            "--recalibrate-scans",
            type=int,
            help=f"whole scans that batch normalisation gets its statistics from (default: {RECALIBRATION_SCANS})",
        )
        parser.add_argument(
            "--no-recalibrate", action="store_true", help="keep the statistics of the training, which saw masked scans"
        )
        parser.add_argument(
            "--parts", default=",".join(ENCODER_MODULES), help="modules to write, with commas; all by default"
        )
        parser.add_argument(
            "--against",
            metavar="NAMES",
            type=Path,
            help="write nothing unless this model would take every tensor; NAMES as with --check",
        )
        _add_layout_options(parser)

    options, config = _options_of_run(
        "pred export",
        "Write the encoder of a run as OpenPCDet, DSVT or mmdetection3d loads it. "
        "pred export --check FILE --against NAMES tells whether a model would take every weight.",
        arguments,
        add_options,
    )
    if options.no_recalibrate and options.recalibrate_scans is not None:
        raise ValueError("export: --recalibrate-scans must be left out with --no-recalibrate")
    scans = RECALIBRATION_SCANS if options.recalibrate_scans is None else options.recalibrate_scans
    run_export(
        config,
        Path(options.folder),
        options.to,
        options.out,
        checkpoint=options.checkpoint,
        recalibrate_scans=None if options.no_recalibrate else scans,
        parts=options.parts.split(","),
        options=_layout_options(options),
        against=options.against,
    )


def export_check(arguments: list[str]) -> None:
    from argparse import ArgumentParser

    parser = ArgumentParser(
        "pred export", description="Compare the weights in a file with a model's tensors; exit status 1 if one differs."
    )
    parser.add_argument("--check", metavar="FILE", type=Path, required=True, help="checkpoint of any framework")
    parser.add_argument(
        "--against",
        metavar="NAMES",
        type=Path,
        required=True,
        help="lines `name (shape) dtype` of the model's state dict, or a checkpoint that the framework wrote",
    )
    parser.add_argument(
        "--only", help="modules to compare, with commas, such as vfe,backbone_3d; those of an encoder by default"
    )
    options = parser.parse_args(arguments)
    from pred.export_check import check_file

    check_file(options.check, options.against, options.only.split(",") if options.only else None)


def import_weights(arguments: list[str]) -> None:
    from pred.config import build, config_parser
    from pred.pretrain import PretrainConfig

    parser = config_parser(
        "pred import",
        "Make a run folder of the encoder in a checkpoint of OpenPCDet, DSVT, mmdetection3d or this package.",
        PretrainConfig,
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="checkpoint")
    parser.add_argument("--out", type=Path, required=True, help="run folder to make")
    parser.add_argument(
        "--kernel-order",
        choices=("krsc", "dhwio"),
        default=None,
        help="sparse kernels are (out, z, y, x, in) or (z, y, x, in, out), where their shapes do not tell",
    )
    _add_layout_options(parser)
    parsed = parser.parse_args(arguments)
    from pred.export import import_encoder

    config = build(parser, PretrainConfig, parsed)
    import_encoder(config, parsed.file, parsed.out, _layout_options(parsed), parsed.kernel_order)


def world(arguments: list[str]) -> None:
    from pred.config import ConfigParser
    from pred.data.world.nuscenes_writer import MINI_VERSION, WORLD_VERSION, WorldSettings
    from pred.world import make_world

    parser = ConfigParser(
        prog="pred world", description="Make a data set of procedural towns in the official nuScenes or ONCE layout."
    )
    parser.add_argument("what", choices=["make"], help="make: write a world, or continue one that was interrupted")
    parser.add_argument("out", metavar="OUT", help="new folder, or one in which the same command was interrupted")
    parser.add_argument("--scenes", type=int, required=True, help="number of drives, each through a town of its own")
    parser.add_argument("--seed", type=int, default=0, help="draws towns, drives and noise")
    parser.add_argument("--keyframes", type=int, default=40, help="keyframes per scene, 2 a second")
    parser.add_argument("--image-scale", type=float, default=0.25, help="size of the images against the official one")
    parser.add_argument("--layout", choices=["nuscenes", "once"], default="nuscenes", help="official layout of OUT")
    parser.add_argument(
        "--as",
        dest="version",
        choices=[WORLD_VERSION, MINI_VERSION],
        default=WORLD_VERSION,
        help=f"version; {MINI_VERSION} (10 scenes) bears the names of the official scenes and splits",
    )
    parser.add_argument("--sweep-images", action="store_true", help="pictures at the times between keyframes too")
    parser.add_argument("--exact-labels", action="store_true", help="exact class maps as pseudo labels, and depth maps")
    parser.add_argument("--workers", type=int | None, default=None, help="processes; one per core by default")
    options = parser.parse_args(arguments)
    settings = WorldSettings(
        scenes=options.scenes,
        seed=options.seed,
        keyframes=options.keyframes,
        image_scale=options.image_scale,
        layout=options.layout,
        version=options.version,
        sweep_images=options.sweep_images,
        exact_labels=options.exact_labels,
    )
    make_world(Path(options.out), settings, workers=options.workers)


def label(arguments: list[str]) -> None:
    from pred.config import build, config_parser

    if arguments[:1] == ["train"]:
        from pred.label_train import LabelTrainConfig, train_segmenter

        parser = config_parser(
            "pred label train",
            "Train a segmentation network (DeepLabV3 + MobileNetV2) on class maps.",
            LabelTrainConfig,
        )
        train_segmenter(build(parser, LabelTrainConfig, parser.parse_args(arguments[1:])))
        return
    from pred.label import LabelConfig
    from pred.label import label as run_labelling

    parser = config_parser(
        "pred label",
        "Pseudo labels of a segmentation network, at the pixels of LiDAR returns. `pred label train` trains one.",
        LabelConfig,
    )
    run_labelling(build(parser, LabelConfig, parser.parse_args(arguments)))


def data(arguments: list[str]) -> None:
    from argparse import ArgumentParser

    parser = ArgumentParser("pred data", description="Go through a data set and tell what is missing or broken.")
    parser.add_argument("what", choices=["check"], help="check: every table and file; exit status 1 if one is broken")
    parser.add_argument("root", metavar="ROOT", type=Path, help="folder in the nuScenes or ONCE layout, or of drives")
    parser.add_argument("--version", default=None, help="table folder (nuScenes); the only v1.0-* by default")
    parser.add_argument("--labels", default="auto", help="folder of pseudo labels under ROOT, auto, or none")
    parser.add_argument("--fast", action="store_true", help="read headers and sizes only")
    options = parser.parse_args(arguments)
    from pred.data_check import DataCheckError, check_data, count_problems

    report = check_data(options.root, options.version, options.labels, options.fast)
    if report.num_problems:
        raise DataCheckError(f"{options.root} must be intact, got {count_problems(report.num_problems)}")


def doctor(arguments: list[str]) -> None:
    from argparse import ArgumentParser

    ArgumentParser(
        "pred doctor", description="Show versions, backend, CPU and GPU, and why something is missing."
    ).parse_args(arguments)
    from pred.doctor import print_report

    print_report()


class Command(NamedTuple):
    function: Callable[[list[str]], None]
    summary: str


EVALUATIONS = {
    "rendering": Command(evaluate_rendering, "RUN: depth and semantics of held-out returns"),
    "probe": Command(evaluate_probe, "RUN: classes of BEV cells by a linear probe on the frozen encoder"),
    "once": Command(evaluate_once, "PREDICTIONS: average precision of 3D boxes by the rules of the ONCE benchmark"),
}

COMMANDS = {
    "pretrain": Command(pretrain, "pre-train a LiDAR encoder; --resume RUN continues"),
    "evaluate": Command(
        evaluate, "evaluate rendering RUN, probe RUN: errors, a linear probe; once FILE: AP of 3D boxes"
    ),
    "view": Command(view, "view RUN: pictures of what the run renders"),
    "export": Command(export, "export RUN: encoder weights for OpenPCDet, DSVT, mmdetection3d; --check FILE compares"),
    "import": Command(import_weights, "import FILE: a run folder of another framework's encoder weights"),
    "world": Command(world, "make OUT: a data set of procedural towns in the nuScenes or ONCE layout"),
    "label": Command(label, "pseudo labels of images by a segmentation network; label train makes one"),
    "data": Command(data, "data check ROOT: what is missing or broken in a data set"),
    "doctor": Command(doctor, "versions, backend, machine, and what is missing"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command; returns the exit status (0 done, 1 failed, 2 wrong usage)."""
    _tune_process()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    name = arguments.pop(0) if arguments else "--help"
    if name in ("-h", "--help"):
        print(_usage())
        return 0
    if name == "--version":
        from pred import __version__

        print(f"pred {__version__}")
        return 0
    if name not in COMMANDS:
        nearest = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean {nearest[0]}?" if nearest else ""
        print(f"pred: error: unknown command {name!r}{hint}\n\n{_usage()}", file=sys.stderr)
        return 2
    try:
        COMMANDS[name].function(arguments)
    except KeyboardInterrupt:
        return 130
    # Text for people: these errors say what is wrong with an argument or a file.
    except (ValueError, OSError, RuntimeError) as error:
        if os.environ.get("PRED_TRACEBACK"):
            raise
        print(f"pred {name}: error: {error}\n(PRED_TRACEBACK=1 shows the traceback)", file=sys.stderr)
        return 1
    return 0


def _tune_process() -> None:
    """Settings of the C libraries below torch, which the environment may overrule."""
    # Read by torch's OpenMP library when torch is imported. Its threads wait for each other in a busy loop, by default
    # so long that a step takes many times as long where another program wants a core.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    # By default glibc returns the memory of every large tensor to the system, and the next one costs page faults again.
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    for variable, parameter in (
        ("MALLOC_MMAP_THRESHOLD_", M_MMAP_THRESHOLD),
        ("MALLOC_TRIM_THRESHOLD_", M_TRIM_THRESHOLD),
    ):
        if mallopt is not None and variable not in os.environ:
            mallopt(parameter, KEPT_BYTES)


def _options_of_run(
    prog: str, description: str, arguments: list[str], add_options: Callable[[Any], None]
) -> tuple[Any, Any]:
    """Options and configuration of a command that works on a run folder: RUN/config.yaml, then the command line."""
    from pred.config import build, config_parser
    from pred.pretrain import PretrainConfig
    from pred.run_folder import RunFolder

    parser = config_parser(prog, f"{description} Keys such as --data.root override the run's own.", PretrainConfig)
    add_options(parser)
    parser.add_argument("folder", metavar="RUN", help="run folder")
    parser.add_argument("--checkpoint", type=Path | None, default=None, help="file to use; the run's latest by default")
    folder = RunFolder(Path(parser.parse_args(arguments).folder))
    folder.require()
    parsed = parser.parse_args([f"--config={folder.config}", *arguments])
    return parsed, build(parser, PretrainConfig, parsed)


def _add_layout_options(parser: Any) -> None:
    parser.add_argument(
        "--mmdet3d-prefix",
        choices=("pts_", "none"),
        default=None,
        help="mmdetection3d: before the modules' names; none for DSVT and for detectors of type VoxelNet",
    )
    parser.add_argument(
        "--stride1-deblock",
        choices=("conv", "deconv"),
        default=None,
        help="conv where the framework's 2D backbone or neck has use_conv_for_no_stride; by default as in the encoder "
        "here (mmdetection3d: conv, deconv for DSVT)",
    )
    parser.add_argument(
        "--dynamic-pillars", action="store_true", help="mmdetection3d: the names of DynamicPillarFeatureNet"
    )


def _layout_options(options: Any) -> Any:
    from pred.checkpoint_layouts import LayoutOptions

    if (options.mmdet3d_prefix, options.stride1_deblock, options.dynamic_pillars) == (None, None, False):
        return None
    return LayoutOptions(
        prefix={None: None, "none": "", "pts_": "pts_"}[options.mmdet3d_prefix],
        stride1_conv={None: None, "conv": True, "deconv": False}[options.stride1_deblock],
        dynamic_pillars=options.dynamic_pillars,
    )


def _usage() -> str:
    lines = [f"  {name:<10} {command.summary}" for name, command in COMMANDS.items()]
    return "usage: pred COMMAND [options]    (pred COMMAND --help for its options)\n\n" + "\n".join(lines)
