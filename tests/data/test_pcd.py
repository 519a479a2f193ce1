# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Point clouds in all three forms of .pcd, and damaged ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pred.data.frame import FrameError
from pred.data.pcd import decompress_lzf, read_pcd, read_pcd_header

HEADER = """# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS x y z intensity _ ring normal
SIZE 4 4 4 4 1 2 8
TYPE F F F F U U F
COUNT 1 1 1 1 3 1 2
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA {data}
"""

DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("_4", "u1", 3),
        ("ring", "<u2"),
        ("normal", "<f8", 2),
    ]
)


def cloud(num_points: int = 6) -> NDArray[np.void]:
    points = np.zeros(num_points, dtype=DTYPE)
    rng = np.random.default_rng(0)
    for name in ("x", "y", "z", "normal"):
        points[name] = rng.normal(size=points[name].shape)
    points["ring"] = np.arange(num_points) % 32
    points["intensity"] = 17
    return points


def compress_lzf(data: bytes) -> bytes:
    """The shortest correct compressor: greedy, with copies of 3 to 264 bytes."""
    out, literals, position = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while position < len(data):
        key = data[position : position + 3]
        first = seen.get(key, -1)
        seen[key] = position
        back = position - first
        if first < 0 or len(key) < 3 or back > 8192:
            literals.append(data[position])
            position += 1
            continue
        length = 3
        while length < 264 and position + length < len(data) and data[first + length] == data[position + length]:
            length += 1
        flush()
        high, low = divmod(back - 1, 256)
        out.extend([(length - 2) << 5 | high, low] if length < 9 else [7 << 5 | high, length - 9, low])
        position += length
    flush()
    return bytes(out)


def write(path: Path, points: NDArray[np.void], data: str, width: int | None = None) -> Path:
    width = len(points) if width is None else width
    header = HEADER.format(width=width, height=len(points) // max(1, width), points=len(points), data=data).encode()
    if data == "ascii":
        rows = [" ".join(str(number) for field in row.tolist() for number in np.ravel(field)) for row in points]
        body = "\n".join(rows).encode() + b"\n"
    elif data == "binary":
        body = points.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name in DTYPE.names or ())
        packed = compress_lzf(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes(header + body)
    return path


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize(("num_points", "width"), [(6, 3), (6, None), (0, None), (1000, None)])
def test_round_trip(tmp_path: Path, data: str, num_points: int, width: int | None) -> None:
    path = write(tmp_path / "cloud.pcd", cloud(num_points), data, width)
    points = read_pcd(path)
    assert points.dtype == DTYPE and np.array_equal(points, cloud(num_points))
    header = read_pcd_header(path)
    assert (header.dtype, header.num_points, header.data) == (DTYPE, num_points, data)


def test_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    text = "VERSION 0.7\nFIELDS y x z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\n1 2 3\nnan -4.5 1e2\n"
    path.write_text(text)
    points = read_pcd(path)
    assert points["x"].tolist() == [2, -4.5] and points["z"].tolist() == [3, 100]
    assert np.isnan(points["y"][1])


def test_lzf_by_hand() -> None:
    # "abc", then 6 bytes from 3 back (the copy reads what it writes), then one "d"; 2 bytes of length at 7 << 5.
    assert decompress_lzf(b"\x02abc" + bytes([4 << 5, 2]) + b"\x00d", 10) == b"abcabcabcd"
    assert decompress_lzf(b"\x00a" + bytes([7 << 5, 255, 0]), 265) == b"a" * 265
    for data, num_bytes, message in [
        (b"\x02abc", 4, "3 bytes instead of 4"),
        (b"\x05abc", 6, "ends within a run"),
        (b"\x00a" + bytes([7 << 5]), 10, "ends within a run"),
        (b"\x00a" + bytes([1 << 5, 1]), 4, "a copy from before the start"),
        (b"\x00a" + bytes([7 << 5, 255, 0]) * 1000, 300, "instead of 300"),
    ]:
        with pytest.raises(ValueError, match=message):
            decompress_lzf(data, num_bytes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("FIELDS", "FIELD", "go together, got no 'FIELDS'"),
        ("SIZE 4 4", "SIZE 4", "go together, got"),
        ("SIZE 4", "SIZE 3", r"go together, got no \('F', 3\)"),
        ("TYPE F", "TYPE Q", r"go together, got no \('Q', 4\)"),
        ("COUNT 1", "COUNT -1", "go together"),
        ("COUNT 1", "COUNT 0", "go together"),
        ("FIELDS x y", "FIELDS x x", "go together"),
        ("WIDTH 6", "WIDTH", "go together"),
        ("POINTS 6", "POINTS 7", "POINTS must be WIDTH x HEIGHT"),
        ("WIDTH 6", "WIDTH 999999999999", "POINTS must be WIDTH x HEIGHT"),
        ("DATA binary", "DATA zip", "DATA must be ascii, binary or binary_compressed, got zip"),
        ("DATA binary", "", "must have a header that ends with DATA, got none"),
    ],
)
def test_damaged_headers(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write(tmp_path / "cloud.pcd", cloud(), "binary")
    content = path.read_bytes()
    path.write_bytes(content.replace(old.encode(), new.encode(), 1))
    for read in (read_pcd, read_pcd_header):
        with pytest.raises(FrameError, match=rf"cloud\.pcd: \.pcd file .*{message}"):
            read(path)


def test_truncated(tmp_path: Path) -> None:
    size = 6 * DTYPE.itemsize
    path = write(tmp_path / "cloud.pcd", cloud(), "binary")
    path.write_bytes(path.read_bytes()[:-1])
    for read in (read_pcd, read_pcd_header):
        with pytest.raises(FrameError, match=rf"must hold {size} bytes of points, got {size - 1}: truncated"):
            read(path)
    path = write(path, cloud(), "binary_compressed")
    whole = path.read_bytes()
    for content in (whole[:-1], whole[: whole.index(b"compressed") + 15]):
        path.write_bytes(content)
        for read in (read_pcd, read_pcd_header):
            with pytest.raises(FrameError, match=r"must hold \d+ bytes of points, got \d+: truncated"):
                read(path)
    start = whole.index(b"compressed\n") + 11
    path.write_bytes(whole[: start + 4] + struct.pack("<I", 5) + whole[start + 8 :])
    with pytest.raises(FrameError, match=rf"must hold {size} bytes of points, got 5 after decompression"):
        read_pcd(path)
    path.write_bytes(whole[: start + 8] + b"\xff" * (len(whole) - start - 8))
    with pytest.raises(FrameError, match="must hold intact compressed points, got a copy from before the start"):
        read_pcd(path)
    path = write(path, cloud(), "ascii")
    path.write_bytes(path.read_bytes().rsplit(None, 1)[0])
    with pytest.raises(FrameError, match="must hold 6 points of 10 numbers, got 59 numbers"):
        read_pcd(path)
    path.write_bytes(path.read_bytes() + b" x")
    with pytest.raises(FrameError, match="must hold numbers, got could not convert"):
        read_pcd(path)


def test_missing(tmp_path: Path) -> None:
    for read in (read_pcd, read_pcd_header):
        with pytest.raises(FrameError, match=r"gone\.pcd: scan must exist, got no such file"):
            read(tmp_path / "gone.pcd")
        with pytest.raises(FrameError, match="scan must be readable, got"):
            read(tmp_path)
