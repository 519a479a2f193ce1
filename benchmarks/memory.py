# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Peak memory that one call adds to the process, scratch outside torch's tensors included.

Linux starts a process's peak of resident memory (``VmHWM``) anew when 5 is written to ``/proc/self/clear_refs``. Memory
that malloc keeps after a free would hide what the next call takes, so free pages are first given back to the
system (``malloc_trim``, all arenas). Known sizes come out to within 0.02 MB, under raised malloc thresholds too.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path


def added_peak_bytes(run: Callable[[], object]) -> int | None:
    """Highest resident memory during a call beyond what was resident before; None where the system cannot tell.

    What the call returns counts, its inputs do not. Blocks that a library keeps from its first call on (compiled
    graphs, oneDNN's scratch) do not count either if the function was called before.
    """
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
