# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of long work: a live bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as RichProgress

PLAIN_LINE_INTERVAL_S = 10.0


class Progress:
    """Counts units of work and shows how many are done, a text, and the time left.

    Args:
        description: what is being done.
        total: units in all.
        done: units done before this process started; they do not count for the rate.
        console: where to show it; standard output by default.
        enabled: False shows nothing (processes other than the first).
    """

    def __init__(
        self, description: str, total: int, done: int = 0, console: Console | None = None, enabled: bool = True
    ) -> None:
        self.console = console or Console()
        self._description = description
        self._total = total
        self._done = self._first = done
        self._enabled = enabled
        self._start_time = time.monotonic()
        self._shown_time = self._start_time
        self._bar: RichProgress | None = None
        if enabled and self.console.is_terminal:
            self._bar = RichProgress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                MofNCompleteColumn(),
                TextColumn("{task.fields[left]} left"),
                TextColumn("{task.fields[text]}"),
                console=self.console,
                transient=False,
            )
            self._task = self._bar.add_task(description, total=total, completed=done, text="", left="-:--")

    def update(self, done: int, text: str = "") -> None:
        """Set the number of finished units and the text beside it."""
        self._done = done
        now = time.monotonic()
        rate = (done - self._first) / max(now - self._start_time, 1e-9)
        left = format_duration((self._total - done) / rate) if rate > 0 else "-:--"
        if self._bar is not None:
            self._bar.update(self._task, completed=done, text=text, left=left)
        elif self._enabled and (now - self._shown_time >= PLAIN_LINE_INTERVAL_S or done == self._total):
            self._shown_time = now
            self.message(f"{self._description} {done}/{self._total}  {left} left  {text}".rstrip())

    def advance(self, text: str = "") -> None:
        """One more unit is done."""
        self.update(self._done + 1, text)

    def message(self, text: str) -> None:
        """Show a line that stays."""
        if self._enabled:
            self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def format_duration(duration_s: float) -> str:
    """``3:07`` (minutes) or ``2:03:07`` (hours)."""
    seconds = round(duration_s)
    hours, minutes, seconds = seconds // 3600, seconds // 60 % 60, seconds % 60
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
