# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""malloc's thresholds, which decide what large fresh outputs cost."""

from __future__ import annotations

import os
import sys

_MARK = "PRED_BENCHMARK_ALLOCATOR"
_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
_LIMIT_BYTES = 4 << 30


def enter_allocator(allocator: str) -> None:
    """Makes this process run under an allocator setting, by starting the interpreter anew where it does not yet.

    glibc serves blocks of more than 32 MB from fresh pages, and gives freed memory at the heap's end back to the
    system. A large output then costs page faults, which say nothing about a kernel. ``raised`` lifts both thresholds
    out of the way; ``default`` leaves the C library as it is. They are read at process start only.
    """
    if current_allocator() == allocator:
        return
    os.environ[_MARK] = allocator
    # torch.compile's idle compile workers would share the cores with what is timed.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    for variable in _VARIABLES:
        if allocator == "raised":
            os.environ[variable] = str(_LIMIT_BYTES)
        else:
            os.environ.pop(variable, None)
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def current_allocator() -> str | None:
    """What `enter_allocator` set up for this process or one that started it; None: nothing yet."""
    return os.environ.get(_MARK)
