# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""What is being done and about how much time is left."""

from __future__ import annotations

import math
import sys
import time


class Progress:
    """What is being done and about how much time is left, on standard error."""

    PLAIN_LINE_INTERVAL_S = 5.0

    def __init__(self, total: int) -> None:
        self._total = total
        self.done = 0
        self._start_time = time.monotonic()
        self._shown_time = -math.inf
        self._overwrite = sys.stderr.isatty()

    def show(self, what: str) -> None:
        """What happens next."""
        now = time.monotonic()
        if not self._overwrite and now - self._shown_time < self.PLAIN_LINE_INTERVAL_S:
            return
        self._shown_time = now
        left = "-:--"
        if self.done:
            seconds = round((now - self._start_time) * (self._total - self.done) / self.done)
            left = f"{seconds // 60}:{seconds % 60:02}"
        line = f"[{self.done}/{self._total}, about {left} left] {what}"
        sys.stderr.write(f"\r\x1b[K{line[:120]}" if self._overwrite else line + "\n")
        sys.stderr.flush()

    def advance(self, units: int = 1) -> None:
        """So much more is done."""
        self.done += units
        if self.done >= self._total and self._overwrite:
            sys.stderr.write("\r\x1b[K")
