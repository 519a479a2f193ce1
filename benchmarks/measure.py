# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""How things are measured: interleaved timing, the machine's ceilings, and what is written down about it."""

from __future__ import annotations

import functools
import os
import platform
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.benchmark import Timer

import pred
from pred._native import native_status

ROUNDS = 5
CPU = torch.device("cpu")
COPY_BYTES = {"cpu": 256 << 20, "cuda": 1 << 30}
MATRIX_SIZE = {"cpu": 256, "cuda": 8192}
OWN_ROWS, OWN_SIZE = {"cpu": 3840, "cuda": 1 << 19}, 256
SLOW_CALL_S = 0.3
GPU_CACHE_BYTES = 256 << 20
"""Written before each timed call on a GPU, so that inputs come from its memory: more than any GPU's cache holds."""
GPU_HEAD_START_CYCLES = 2_000_000
"""For which a GPU does nothing before each timed call (a millisecond), while the host launches its kernels."""
GPU_CALLS = 200
"""At most, in one turn."""
RESULTS = "benchmarks/results"  # files of earlier runs do not make the sources differ from their commit


@dataclass(frozen=True)
class Timing:
    """Seconds per call, over all calls of all rounds."""

    median_s: float
    q25_s: float
    q75_s: float
    samples: int
    round_medians_s: list[float]
    """One per round; the contenders' rounds alternate, so that equal positions saw the same disturbances."""
    page_faults_per_call: float | None = None
    """Of the CPU, where that is what is timed."""
    busy_cores: float | None = None
    """Processor time over wall time: near 1 for a peer that runs in one thread whatever torch is set to."""

    def record(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


@dataclass(frozen=True)
class Run:
    """One contender's work in a phase."""

    call: Callable[..., list[Tensor]]
    """What is timed; returns all results."""
    before: Callable[[], Any] | None = None
    """Runs ahead of each call, outside its time; `call` takes what it returns."""

    def __call__(self) -> list[Tensor]:
        """All of it."""
        return self.ready()()

    def ready(self) -> Callable[[], list[Tensor]]:
        """The timed part, for one call."""
        prepared = () if self.before is None else (self.before(),)
        return lambda: self.call(*prepared)


def time_interleaved(
    contenders: Mapping[str, Callable[[], object]],
    threads: int,
    min_time_s: float,
    rounds: int = ROUNDS,
    device: torch.device = CPU,
) -> dict[str, Timing]:
    """Times callables in turn, round after round.

    Args:
        contenders: what to call, by name; each was called before. Of a `Run` only its `call` is timed.
        threads: torch's threads during the measurement.
        min_time_s: time spent on each contender, over all rounds. A slow one takes one call per round, and sits out the
            rounds after the third if it is far beyond its time.
        rounds: how often each contender has its turn.
        device: whose time counts. On a GPU it is that between two events of the current stream, before and after the
            call; the host's work counts where it takes longer than a millisecond and the GPU waits for it.
    """
    blocks: dict[str, list[_Block]] = {name: [] for name in contenders}
    spent_s = dict.fromkeys(contenders, 0.0)
    for turn in range(rounds):
        for name, run in contenders.items():
            if turn < 3 or spent_s[name] < 3 * min_time_s:
                start_time = time.perf_counter()
                if device.type == "cpu":
                    block = _time_block(run, threads, min_time_s / rounds)
                else:
                    block = _time_gpu_block(run, min_time_s / rounds, device)
                blocks[name].append(block)
                spent_s[name] += time.perf_counter() - start_time
    return {name: _join(blocks[name]) for name in contenders}


@dataclass(frozen=True)
class _Block:
    """One contender's turn."""

    call_s: list[float]
    page_faults_per_call: float | None = None
    busy_cores: float | None = None


def _time_block(run: Callable[[], object], threads: int, min_time_s: float) -> _Block:
    torch.set_num_threads(threads)
    if isinstance(run, Run) and run.before is not None:
        return _time_prepared_block(run.before, run.call, min_time_s)
    call = run.call if isinstance(run, Run) else run
    calls = 0

    def counted() -> None:
        nonlocal calls
        calls += 1
        call()

    faults = _page_faults()
    processor_time, start_time = time.process_time(), time.perf_counter()
    counted()
    call_s = [time.perf_counter() - start_time]
    if call_s[0] < SLOW_CALL_S:  # otherwise that was the measurement: warm caches mean little to so long a call
        timer = Timer("run()", globals={"run": counted}, num_threads=threads)
        call_s = timer.blocked_autorange(min_run_time=min_time_s).times
    busy_cores = (time.process_time() - processor_time) / (time.perf_counter() - start_time)
    return _Block(call_s, (_page_faults() - faults) / calls, busy_cores)


def _time_prepared_block(before: Callable[[], Any], call: Callable[..., object], min_time_s: float) -> _Block:
    """Call by call, as `before` must not count; the clock's own 0.1 us does."""
    call_s: list[float] = []
    faults, processor_s, total_s = 0, 0.0, 0.0
    while total_s < min_time_s:
        prepared = before()
        faults -= _page_faults()
        processor_time, start_time = time.process_time(), time.perf_counter()
        call(prepared)
        call_s.append(time.perf_counter() - start_time)
        processor_s += time.process_time() - processor_time
        faults += _page_faults()
        total_s += call_s[-1]
        if call_s[-1] >= SLOW_CALL_S:
            break
    return _Block(call_s, faults / len(call_s), processor_s / total_s)


def _time_gpu_block(run: Callable[[], object], min_time_s: float, device: torch.device) -> _Block:
    """Calls follow each other without waiting; their times are read at the end."""
    before, call = (run.before, run.call) if isinstance(run, Run) else (None, run)
    cache = torch.empty(GPU_CACHE_BYTES, dtype=torch.uint8, device=device)

    def timed_call() -> tuple[torch.cuda.Event, torch.cuda.Event]:
        prepared = () if before is None else (before(),)
        cache.zero_()
        torch.cuda._sleep(GPU_HEAD_START_CYCLES)
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        call(*prepared)
        end.record()
        return start, end

    def seconds(events: Sequence[tuple[torch.cuda.Event, torch.cuda.Event]]) -> list[float]:
        torch.cuda.synchronize(device)
        return [1e-3 * start.elapsed_time(end) for start, end in events]

    (first_s,) = seconds([timed_call()])
    if first_s >= SLOW_CALL_S:
        return _Block([first_s])
    calls = min(GPU_CALLS, max(1, round(min_time_s / max(first_s, 1e-6))))
    return _Block(seconds([timed_call() for _ in range(calls)]))


def _join(blocks: list[_Block]) -> Timing:
    call_s = [value for block in blocks for value in block.call_s]
    median_s, q25_s, q75_s = _quartiles(call_s)
    return Timing(
        median_s,
        q25_s,
        q75_s,
        len(call_s),
        [statistics.median(block.call_s) for block in blocks],
        _median_of([block.page_faults_per_call for block in blocks]),
        _median_of([block.busy_cores for block in blocks]),
    )


def _median_of(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _page_faults() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


def _quartiles(values: list[float]) -> tuple[float, float, float]:
    """Median, lower and upper quartile."""
    if len(values) == 1:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return middle, low, high


@dataclass(frozen=True)
class Ceilings:
    """What the machine can do with a number of threads, or its GPU, measured in this run."""

    threads: int
    copy_bytes_per_s: float
    matrix_flop_per_s: float
    bfloat16_flop_per_s: float
    copy_bytes: int = 0
    matrix_size: int = 0
    own_rows: int = 0
    """Of what was measured."""

    def better(self, other: Ceilings) -> Ceilings:
        """The higher of two measurements with the same number of threads."""
        return replace(
            self,
            copy_bytes_per_s=max(self.copy_bytes_per_s, other.copy_bytes_per_s),
            matrix_flop_per_s=max(self.matrix_flop_per_s, other.matrix_flop_per_s),
            bfloat16_flop_per_s=max(self.bfloat16_flop_per_s, other.bfloat16_flop_per_s),
        )

    def record(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {
            "copy": f"torch copy_ of {self.copy_bytes} bytes, counted once as read and once as written; best block",
            "matrix": f"products of matrices, on the CPU in its cache, best block of the faster of two: float32, or "
            f"bfloat16 summed in float32, of {self.matrix_size} x {self.matrix_size} by torch.mm, of {self.own_rows} x "
            f"{OWN_SIZE} with {OWN_SIZE} x {OWN_SIZE} by project_bev, its packing and copies included",
        }


def measure_ceilings(threads: int, min_time_s: float, device: torch.device = CPU, tiny: bool = False) -> Ceilings:
    """Copy bandwidth of large blocks and rate of matrix products.

    The best of several blocks counts: disturbances only make a ceiling look low, and shares of it too good. torch's
    products do not reach what every machine can do: pred's own stand beside them, and the faster one counts.

    Args:
        threads, min_time_s, device: see `time_interleaved`.
        tiny: the run only shows that everything works.
    """
    copy_bytes, own_rows = COPY_BYTES[device.type], OWN_ROWS[device.type]
    matrix_size = MATRIX_SIZE[device.type]
    if tiny:
        copy_bytes, own_rows, matrix_size = 1 << 20, OWN_ROWS["cpu"], MATRIX_SIZE["cpu"]
    source = torch.ones(copy_bytes // 4, device=device)
    target = torch.zeros_like(source)
    calls: dict[str, Callable[[], object]] = {"copy": lambda: target.copy_(source)}
    flop: dict[str, int] = {}
    for dtype in (torch.float32, torch.bfloat16):
        left = torch.randn(matrix_size, matrix_size, dtype=dtype, device=device)
        right, product = torch.randn_like(left), torch.empty_like(left)
        calls[f"{dtype} torch"] = functools.partial(torch.mm, left, right, out=product)
        flop[f"{dtype} torch"] = 2 * matrix_size**3
        if missing_kernel("project_bev", device) is None:
            rows = torch.randn(1, own_rows, 1, OWN_SIZE, dtype=dtype, device=device).permute(0, 3, 1, 2)
            weight = torch.randn(OWN_SIZE, OWN_SIZE, device=device)
            calls[f"{dtype} own"] = functools.partial(torch.ops.pred.project_bev, rows, weight, False)
            flop[f"{dtype} own"] = 2 * own_rows * OWN_SIZE**2
    with torch.no_grad():
        for call in calls.values():
            call()
        timings = time_interleaved(calls, threads, min_time_s, device=device)
    best_s = {name: min(timing.round_medians_s) for name, timing in timings.items()}
    float32, bfloat16 = (
        max(flop[name] / best_s[name] for name in flop if name.startswith(str(dtype)))
        for dtype in (torch.float32, torch.bfloat16)
    )
    return Ceilings(threads, 2 * source.nbytes / best_s["copy"], float32, bfloat16, copy_bytes, matrix_size, own_rows)


def missing_kernel(op: str, device: torch.device = CPU) -> str | None:
    """Why an op has no compiled kernel for a device; None where it has one."""
    status = native_status()
    reason: str | None = status["reason"] or (None if device.type == "cpu" else status["cuda_reason"])
    if reason is None:
        key = device.type.upper()
        if not hasattr(torch.ops.pred, op) or not torch._C._dispatch_has_kernel_for_dispatch_key(f"pred::{op}", key):
            return f"the compiled library has no {op} for {key}"
    return reason


def machine_record(device: torch.device = CPU) -> dict[str, Any]:
    """Hardware, versions, commit and settings that figures depend on."""
    status = native_status()
    return {
        "machine": {
            "cpu": _cpu_model(),
            "cores": os.cpu_count(),
            "caches": _caches(),
            "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
            "system": platform.platform(),
            "transparent_huge_pages": _read("/sys/kernel/mm/transparent_hugepage/enabled"),
            "load_average": os.getloadavg(),
            "gpu": None if device.type == "cpu" else _gpu_record(device),
        },
        "versions": {"pred": pred.__version__, "torch": torch.__version__, "python": platform.python_version()},
        "native": {name: status[name] for name in ("available", "reason", "build", "cpu_capability")},
        "torch_cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "float32_matmul_precision": torch.get_float32_matmul_precision(),
        "git": _git_record(),
        "environment": {
            name: value
            for name, value in sorted(os.environ.items())
            if name.startswith(("PRED_", "MALLOC_", "OMP_", "GOMP_", "MKL_", "KMP_", "ATEN_", "TORCHINDUCTOR_", "LD_P"))
            and not name.endswith("_DIR")  # changes no time
        },
    }


def _gpu_record(device: torch.device) -> dict[str, Any]:
    properties = torch.cuda.get_device_properties(device)
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader", f"--id={device.index or 0}"]
    try:
        driver = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        driver = None
    return {
        "name": properties.name,
        "capability": f"{properties.major}.{properties.minor}",
        "multiprocessors": properties.multi_processor_count,
        "memory_bytes": properties.total_memory,
        "cuda": torch.version.cuda,
        "driver": driver,
    }


def _read(path: str) -> str | None:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return None


def _cpu_model() -> str:
    for line in (_read("/proc/cpuinfo") or "").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _caches() -> dict[str, str]:
    """Sizes of the first core's caches."""
    sizes = {}
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind, size = (_read(str(folder / name)) for name in ("level", "type", "size"))
        if kind != "Instruction" and level and size:
            sizes[f"L{level}"] = size
    return sizes


def _git_record() -> dict[str, Any]:
    """Commit of the sources and whether they differ from it; None where there is no repository."""
    git = ["git", "--no-optional-locks", "-C", str(Path(__file__).resolve().parent)]
    try:
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        command = [*git, "status", "--porcelain", "--", ":/", f":(top,exclude){RESULTS}"]
        status = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(status)}
