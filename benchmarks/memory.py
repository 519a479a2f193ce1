# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Peak memory that one call adds to the process, scratch outside torch's tensors included; on a GPU, what torch's
allocator hands out there (pred's kernels have their scratch from it, too).

Linux starts a process's peak of resident memory (``VmHWM``) anew when 5 is written to ``/proc/self/clear_refs``. Memory
that malloc keeps after a free would hide what the next call takes, so free pages are first given back to the
system (``malloc_trim``, all arenas). Known sizes come out to within 0.02 MB, under raised malloc thresholds too.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

import torch


def added_peak_bytes(run: Callable[[], object], device: torch.device | None = None) -> int | None:
    """Highest resident memory (on a GPU, allocated memory) during a call beyond that before; None where the system
    cannot tell.

    What the call returns counts, its inputs do not. Blocks that a library keeps from its first call on (compiled
    graphs, oneDNN's scratch) do not count either if the function was called before.
    """
    if device is not None and device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        allocated = torch.cuda.memory_allocated(device)
        result = run()
        peak = torch.cuda.max_memory_allocated(device)
        del result
        return peak - allocated
    before = reset_peak()
    result = run()
    if before is None:
        return None
    peak = status_bytes("VmHWM")
    del result
    return max(0, peak - before)


def reset_peak() -> int | None:
    """Resident memory now, from where the peak (``VmHWM``) starts anew; None where the system cannot tell."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        return status_bytes("VmRSS")
    except (OSError, AttributeError, TypeError):  # no such file, not allowed; another C library; no dlopen(NULL)
        return None


def status_bytes(name: str, path: str = "/proc/self/status") -> int:
    for line in Path(path).read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"{path} holds no {name}")
