# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Row by row through JSON tables that may be larger than memory (nuScenes: 1.2 GB in one file)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pred.data.frame import FrameError, unreadable
from pred.progress import Progress

PROGRESS_BYTES = 50_000_000
"""Files of at most so many bytes together are read without a progress display."""

CHUNK_CHARACTERS = 1 << 22
"""Read at once; no row may be longer."""

Row = dict[str, Any]
Report = Callable[[FrameError], None]
T = TypeVar("T")

_SPACE = re.compile(r"[ \t\n\r]*")


def raise_problem(problem: FrameError) -> None:
    """A `Report` that stops at the first problem."""
    raise problem


@contextmanager
def reading_progress(description: str, paths: Iterable[Path]) -> Iterator[Callable[[int], None]]:
    """Shows how much of some files is read, if they are large; gives a function that is told the size of each piece."""
    num_bytes = sum(path.stat().st_size for path in paths if path.is_file())
    total = max(1, num_bytes // 1_000_000)
    with Progress(f"{description}, MB", total, enabled=num_bytes > PROGRESS_BYTES) as progress:
        done = 0

        def advance(size: int) -> None:
            nonlocal done
            done += size
            progress.update(min(done, num_bytes) // 1_000_000)

        yield advance


def read_table(
    path: Path,
    read_row: Callable[[Row], T | None],
    report: Report = raise_problem,
    advance: Callable[[int], None] | None = None,
) -> list[T]:
    """Rows of a JSON list, each turned by ``read_row``; rows for which that gives None are left out.

    Args:
        path: the file.
        read_row: may raise KeyError, TypeError, ValueError or OverflowError, which becomes a problem of that row.
        report: gets each problem as a `FrameError`. If it returns, that row is left out, and reading goes on as far as
            the file allows.
        advance: told the number of characters after each chunk that is read.
    """
    kept: list[T] = []
    rows = iterate_rows(path, advance)
    num_rows = 0
    while True:
        try:
            row = next(rows, None)
        except FrameError as problem:
            report(problem)
            break
        if row is None:
            break
        num_rows += 1
        try:
            result = read_row(row)
        except KeyError as error:
            report(FrameError(path, f"row {num_rows} must have, and refer to, known keys, got no {error}"))
        except (TypeError, ValueError, OverflowError) as error:
            report(FrameError(path, f"row {num_rows} must be well-formed, got {error}"))
        else:
            if result is not None:
                kept.append(result)
    return kept


def read_json(path: Path, what: str = "table") -> Any:
    """Content of a small JSON file; ``what`` names it in error texts.

    Raises:
        FrameError: it is missing or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise unreadable(path, error, what) from None
    except (ValueError, RecursionError) as error:
        raise _no_json(path, error, what) from None


def iterate_rows(path: Path, advance: Callable[[int], None] | None = None) -> Iterator[Row]:
    """Objects of a JSON list, with one chunk of the file in memory at a time.

    Raises:
        FrameError: the file is missing, no valid JSON, or no list of objects.
    """
    try:
        with open(path, encoding="utf-8") as file:
            yield from _rows(path, file.read, advance)
    except OSError as error:
        raise unreadable(path, error, "table") from None
    except UnicodeDecodeError as error:
        raise _no_json(path, error) from None


def _rows(path: Path, read: Callable[[int], str], advance: Callable[[int], None] | None) -> Iterator[Row]:
    text, position, dropped = "", 0, 0
    decode = json.JSONDecoder().raw_decode

    def refill() -> bool:
        """Drops what is behind ``position`` and appends the next chunk; False at the end of the file."""
        nonlocal text, position, dropped
        chunk = read(CHUNK_CHARACTERS)
        text, dropped, position = text[position:] + chunk, dropped + position, 0
        if advance is not None:
            advance(len(chunk))
        return bool(chunk)

    def peek() -> str:
        """The next character that is no space, at ``position``; empty at the end of the file."""
        nonlocal position
        while True:
            position = _SPACE.match(text, position).end()  # type: ignore[union-attr]
            if position < len(text):
                return text[position]
            if not refill():
                return ""

    def broken(what: str, at: int) -> FrameError:
        return _no_json(path, f"{what} at character {at}")

    if peek() != "[":
        try:
            value, _ = decode(text + read(-1), position)
        except json.JSONDecodeError as error:
            raise broken(error.msg, dropped + error.pos) from None
        except (ValueError, RecursionError) as error:  # a number of thousands of digits, deep nesting
            raise broken(_reason(error), dropped + position) from None
        raise FrameError(path, f"table must be a list of rows, got {type(value).__name__}")
    position += 1
    ended = peek() == "]"
    position += ended
    while not ended:
        peek()
        while True:
            try:
                row, end = decode(text, position)
            except json.JSONDecodeError as error:
                at = dropped + error.pos
                # Perhaps the row goes on behind the chunk.
                if len(text) - position > CHUNK_CHARACTERS or not refill():
                    raise broken(error.msg, at) from None
            except (ValueError, RecursionError) as error:  # a number of thousands of digits, deep nesting
                raise broken(_reason(error), dropped + position) from None
            else:
                break
        if not isinstance(row, dict):
            raise FrameError(path, f"table must be a list of rows, got a list with {type(row).__name__} in it")
        position = end
        yield row
        separator = peek()
        if separator not in (",", "]"):
            raise broken("Expecting ',' or ']'" if separator else "end of file", dropped + position)
        ended = separator == "]"
        position += 1
    if peek():
        raise broken("Extra data", dropped + position)


def _reason(error: ValueError | RecursionError) -> str:
    return "values nested too deeply" if isinstance(error, RecursionError) else str(error)


def _no_json(path: Path, error: object, what: str = "table") -> FrameError:
    return FrameError(path, f"{what} must be valid JSON, got {error}")
