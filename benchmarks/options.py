# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of ``python -m benchmarks``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.bench_ops import CASES
from benchmarks.bench_step import STEP
from benchmarks.case import KINDS
from benchmarks.cases import SIZES
from benchmarks.compare import RecordError, load_record
from benchmarks.measure import CPU, ROUNDS

OPS = (*CASES, STEP)
QUICK = 5

EPILOG = """
contenders
  ours      pred.ops on the compiled kernels, map in channels-last memory
  eager     good plain PyTorch; where several ways are timed, ratios are against the fastest
  compiled  torch.compile of an eager way; "refused" says why there is none
  peers     other libraries, where installed: spconv, mmcv, nerfacc, torch-scatter
  reference (rendering_step, --replay) PyTorch references of pred.ops

phases
  forward, backward (its graph is built outside the time), forward+backward, second order (forward, derivative in the
  grid with create_graph, backward through both), and second backward (the last part of it alone)

ms is the median of all calls, IQR the distance of the quartiles; contenders take turns, and "rounds" is the range of
the ratio over the turns. On a GPU a call lies between two events of its stream, and a cache's worth of memory is
written before each. GB/s counts the least traffic an op could have (formula in the JSON), "of ceiling" its share of the
copy bandwidth measured in the same run with as many threads. Inputs that fit into the last-level cache can pass
100 %. "peak MB" is what one call adds to the process's memory at most, scratch included. Everything runs with malloc's
thresholds raised (the program restarts itself with MALLOC_MMAP_THRESHOLD_ and MALLOC_TRIM_THRESHOLD_ set), so that page
faults of large fresh outputs do not count; the ratio with the default allocator, measured in a shorter run, stands
beside.

examples
  python -m benchmarks --ops sample_bev --threads 1,2 --compare benchmarks/results/epyc-2core.json
  python -m benchmarks --ops sample_bev --sizes tiny --contenders ours --trace trace.json
  python -m benchmarks --device cuda --ops rendering_step --min-time 2
  python -m benchmarks --capture ops.pt --capture-from nuscenes_tiny.yaml
  python -m benchmarks --replay ops.pt
"""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options; exits with a message where they are wrong. `earlier` is the record to compare with, or None."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks",
        description="Times the ops and the rendering step; prints tables, writes JSON, Markdown and a picture.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # `__main__` looks for --default-allocator before this parser does
    )
    what = parser.add_argument_group("what is run")
    what.add_argument(
        "--ops", type=_list_of(OPS), nargs="+", default=[list(OPS)], help=f"some of {', '.join(OPS)}; or with commas"
    )
    what.add_argument("--device", type=_device, default=CPU, help="cpu (the default) or cuda, the current GPU")
    what.add_argument(
        "--sizes",
        choices=tuple(SIZES),
        default=None,
        help="real LiDAR sizes (the default on the CPU), with the rays of a paper's training step (the default on a "
        "GPU), or tiny ones",
    )
    what.add_argument(
        "--threads",
        type=_thread_counts,
        default=None,
        help="such as 1,2; default: 1 and all cores, on a GPU all; the rendering step is run with the most only",
    )
    what.add_argument("--contenders", type=_list_of(KINDS), default=list(KINDS), help=f"some of {','.join(KINDS)}")
    what.add_argument(
        "--min-time", type=float, default=0.6, metavar="S", help="seconds per contender and phase (default 0.6)"
    )
    what.add_argument("--quick", action="store_true", help="a fifth of the time, three rounds, one allocator")
    what.add_argument(
        "--default-allocator", action="store_true", help="leave malloc's thresholds as they are, in this run only"
    )
    what.add_argument(
        "--replay",
        type=Path,
        default=None,
        metavar="FILE",
        help="time ours and the references on the inputs in FILE, from --capture, in place of the cases",
    )

    results = parser.add_argument_group("what comes out")
    results.add_argument(
        "--out",
        type=Path,
        default=None,
        metavar="JSON",
        help="the record, with a .md and a .png beside it; default: benchmarks/results/<UTC time>.json",
    )
    results.add_argument("--quiet", action="store_true", help="print no tables; write the JSON only")
    results.add_argument(
        "--compare", type=Path, default=None, metavar="JSON", help="an earlier record: print and keep what changed"
    )
    results.add_argument(
        "--fail-below",
        type=float,
        default=None,
        metavar="R",
        help="with --compare: exit with 1 where the factor against eager fell below R times the earlier one, by more "
        "than the rounds differ",
    )

    instead = parser.add_argument_group("in place of timing").add_mutually_exclusive_group()
    instead.add_argument(
        "--trace",
        type=Path,
        default=None,
        metavar="FILE",
        help="write a Chrome trace: a call per contender and phase",
    )
    instead.add_argument(
        "--capture", type=Path, default=None, metavar="FILE", help="write the inputs that the ops get in training steps"
    )
    parser.add_argument(
        "--capture-from",
        default="runs/demo/config.yaml",
        metavar="CONFIG",
        help="with --capture: a configuration of pred pretrain, by name or as a YAML file, of which two steps are run; "
        "or step, the rendering step at --sizes (default: runs/demo/config.yaml, the run of make demo)",
    )

    options = parser.parse_args(arguments)
    if not options.min_time > 0:
        parser.error(f"--min-time must be above 0, got {options.min_time}")
    if options.fail_below is not None and options.compare is None:
        parser.error("--fail-below needs --compare")
    if options.out is not None and options.out.suffix in (".md", ".png"):
        parser.error(f"--out must name the JSON record, got {options.out}")
    try:
        options.earlier = None if options.compare is None else load_record(options.compare)
    except RecordError as error:
        parser.error(f"--compare {error}")
    options.ops = [op for names in options.ops for op in names]
    options.out = options.out or Path(time.strftime("benchmarks/results/%Y%m%dT%H%M%SZ.json", time.gmtime()))
    on_gpu = options.device.type == "cuda"
    options.sizes = options.sizes or ("paper" if on_gpu else "real")
    options.threads = options.threads or sorted({torch.get_num_threads(), *(() if on_gpu else (1,))})
    if on_gpu and len(options.threads) > 1:
        parser.error(f"--threads must be one number with --device cuda, got {options.threads}")
    options.rounds = 3 if options.quick else ROUNDS
    if options.quick:
        options.min_time /= QUICK
    return options


def _list_of(choices: Sequence[str]) -> Any:
    def parse(text: str) -> list[str]:
        names = text.split(",")
        for name in names:
            if name not in choices:
                raise argparse.ArgumentTypeError(f"must name some of {', '.join(choices)}, got {name!r}")
        return names

    return parse


def _device(text: str) -> torch.device:
    if text not in ("cpu", "cuda"):
        raise argparse.ArgumentTypeError(f"must be cpu or cuda, got {text!r}")
    if text == "cuda" and not torch.cuda.is_available():
        raise argparse.ArgumentTypeError("must be cpu, as torch sees no GPU, got 'cuda'")
    return torch.device(text)


def _thread_counts(text: str) -> list[int]:
    try:
        counts = sorted({int(part) for part in text.split(",")})
    except ValueError:
        counts = [0]
    if counts[0] < 1:
        raise argparse.ArgumentTypeError(f"must be positive numbers such as 1,2, got {text!r}")
    return counts
