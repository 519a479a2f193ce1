# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""JSON tables that are read row by row: the same rows as json.loads, wherever a chunk ends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pred.data import tables
from pred.data.frame import FrameError
from pred.data.tables import iterate_rows, read_table

ROWS = [
    {"token": "a", "text": 'brackets ] } , " and ümläute ☃', "numbers": [1, -2.5e-3, []], "inner": {"x": {}}},
    {"token": "b"},
    {},
    {"token": "c", "long": "x" * 40, "none": None, "flag": True},
]


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "rows.json"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("chunk", [130, 131, 137, 200, 1 << 22])
@pytest.mark.parametrize(
    "text",
    [
        json.dumps(ROWS),
        json.dumps(ROWS, indent=2),
        json.dumps(ROWS, ensure_ascii=False, separators=(",", ":")),
        " [ ] \n",
    ],
)
def test_rows_are_those_of_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, chunk: int) -> None:
    monkeypatch.setattr(tables, "CHUNK_CHARACTERS", chunk)
    path = write(tmp_path, text)
    advanced: list[int] = []
    assert list(iterate_rows(path, advanced.append)) == json.loads(text)
    assert sum(advanced) == len(text)


@pytest.mark.parametrize("chunk", [1, 2, 3, 5, 7])
def test_tiny_chunks_between_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    # Each row fits into a chunk, the space around does not.
    monkeypatch.setattr(tables, "CHUNK_CHARACTERS", chunk)
    path = write(tmp_path, "     [" + "  {}   ,   " * 9 + " {}  ]    \n\n")
    assert list(iterate_rows(path)) == [{}] * 10


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"must be valid JSON, got Expecting value at character 0"),
        ("{}", r"must be a list of rows, got dict"),
        ('"text"', r"must be a list of rows, got str"),
        ("17", r"must be a list of rows, got int"),
        ("[", r"must be valid JSON, got Expecting value at character 1"),
        ("[{}", r"must be valid JSON, got end of file at character 3"),
        ("[{},", r"must be valid JSON, got Expecting value at character 4"),
        ("[{},]", r"must be valid JSON, got Expecting value at character 4"),
        ("[{} {}]", r"must be valid JSON, got Expecting ',' or '\]' at character 4"),
        ('[{"a": 1}, {"a" 2}]', r"must be valid JSON, got Expecting ':' delimiter at character 16"),
        ("[{}] x", r"must be valid JSON, got Extra data at character 5"),
        ("[{}, 3]", r"must be a list of rows, got a list with int in it"),
    ],
)
@pytest.mark.parametrize("chunk", [8, 1 << 22])
def test_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str, chunk: int) -> None:
    monkeypatch.setattr(tables, "CHUNK_CHARACTERS", chunk)
    with pytest.raises(FrameError, match=rf"rows\.json: table {message}"):
        list(iterate_rows(write(tmp_path, text)))


def test_hostile_nesting(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"must be valid JSON, got values nested too deeply at character 1"):
        list(iterate_rows(write(tmp_path, "[" * 100_000)))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('[{"a": ' + "1" * 5000 + "}]", "Exceeds the limit"),
        ('{"a": ' + "1" * 5000 + "}", "Exceeds the limit"),
        ('{"a":' * 100_000, "values nested too deeply"),
    ],
)
def test_what_the_decoder_refuses_in_its_own_words(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(FrameError, match=rf"rows\.json: table must be valid JSON, got {reason}"):
        list(iterate_rows(write(tmp_path, text)))


def test_a_damaged_row_does_not_bring_the_whole_file_into_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "CHUNK_CHARACTERS", 16)
    path = write(tmp_path, '[{"a": "' + "x" * 1000)
    advanced: list[int] = []
    with pytest.raises(FrameError, match="Unterminated string"):
        list(iterate_rows(path, advanced.append))
    assert sum(advanced) <= 48


def test_problems_of_rows_are_reported_and_reading_goes_on(tmp_path: Path) -> None:
    path = write(tmp_path, '[{"n": 1}, {"m": 2}, {"n": "x"}, {"n": 0}, {"n": 4}, {"n": 5')
    problems: list[str] = []

    def read_row(row: dict[str, Any]) -> int | None:
        return int(row["n"]) or None

    assert read_table(path, read_row, lambda problem: problems.append(problem.what)) == [1, 4]
    assert problems == [
        "row 2 must have, and refer to, known keys, got no 'n'",
        "row 3 must be well-formed, got invalid literal for int() with base 10: 'x'",
        "table must be valid JSON, got Expecting ',' delimiter at character 60",
    ]
    with pytest.raises(FrameError, match="row 2 must have"):
        read_table(path, read_row)


def test_files_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"gone\.json: table must exist, got no such file"):
        list(iterate_rows(tmp_path / "gone.json"))
    with pytest.raises(FrameError, match="table must be readable, got .*directory"):
        list(iterate_rows(tmp_path))
    path = tmp_path / "rows.json"
    path.write_bytes(b'[{"a": "\xff"}]')
    with pytest.raises(FrameError, match=r"table must be valid JSON, got 'utf-8' codec can't decode"):
        list(iterate_rows(path))
