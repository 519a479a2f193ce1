# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reader for the point clouds of the Point Cloud Library: .pcd version 0.7, ascii, binary and binary_compressed.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html; the compression is LibLZF's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import FrameError, unreadable

MAX_HEADER_BYTES = 1 << 16
MAX_POINTS = 1 << 28
"""A header that claims more is taken for damaged."""

_TYPES = {(kind, size): f"<{code}{size}" for kind, code in (("I", "i"), ("U", "u")) for size in (1, 2, 4, 8)} | {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
}


@dataclass
class PcdHeader:
    """Header of a .pcd file.

    Attributes:
        dtype: one point, with a field per name of FIELDS; padding fields (``_``) are numbered.
        num_points: points in the file.
        data: ascii, binary or binary_compressed.
        size: bytes of the header.
    """

    dtype: np.dtype[Any]
    num_points: int
    data: str
    size: int


def read_pcd(path: Path) -> NDArray[Any]:
    """[N] structured array with the file's fields.

    Raises:
        FrameError: the file is missing, truncated or damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise unreadable(path, error, "scan") from None
    header = parse_header(path, content)
    body = content[header.size :]
    if header.data == "ascii":
        return _read_ascii(path, header, body)
    if header.data == "binary":
        return _read_binary(path, header, body)
    return _read_compressed(path, header, body)


def read_pcd_header(path: Path) -> PcdHeader:
    """The header alone, checked against the size of the file.

    Raises:
        FrameError: as `read_pcd`.
    """
    try:
        with open(path, "rb") as file:
            header = parse_header(path, file.read(MAX_HEADER_BYTES))
            file.seek(header.size)
            start = file.read(8)
        size = path.stat().st_size - header.size
    except OSError as error:
        raise unreadable(path, error, "scan") from None
    if header.data == "binary":
        _require_bytes(path, header.num_points * header.dtype.itemsize, size)
    elif header.data == "binary_compressed":
        _compressed_size(path, header, start, size)
    return header


def parse_header(path: Path, content: bytes) -> PcdHeader:
    """The header at the start of ``content``.

    Raises:
        FrameError: it is not that of a .pcd file.
    """
    entries: dict[str, list[str]] = {}
    size = 0
    while "DATA" not in entries:
        end = content.find(b"\n", size, MAX_HEADER_BYTES)
        if end < 0:
            raise _damaged(path, "must have a header that ends with DATA, got none")
        words = content[size:end].decode("ascii", "replace").split()
        size = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    try:
        names, kinds = entries["FIELDS"], entries["TYPE"]
        sizes = [int(word) for word in entries["SIZE"]]
        counts = [int(word) for word in entries.get("COUNT", ["1"] * len(names))]
        width, height = (int(entries[key][0]) for key in ("WIDTH", "HEIGHT"))
        num_points = int(entries["POINTS"][0]) if "POINTS" in entries else width * height
        (data,) = entries["DATA"]
        fields = [
            (name if name != "_" else f"_{number}", _TYPES[kind, item_size], (count,))
            for number, (name, kind, item_size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True))
        ]
        if not fields or min(counts) < 1:
            raise ValueError(f"FIELDS {' '.join(names)}, COUNT {' '.join(map(str, counts))}")
        dtype = np.dtype([field if field[2] != (1,) else field[:2] for field in fields])
    except (KeyError, IndexError, ValueError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise _damaged(path, f"must have FIELDS, SIZE, TYPE, WIDTH, HEIGHT that go together, got {what}") from None
    if data not in ("ascii", "binary", "binary_compressed"):
        raise _damaged(path, f"DATA must be ascii, binary or binary_compressed, got {data}")
    if num_points != width * height or not 0 <= num_points <= MAX_POINTS:
        raise _damaged(
            path, f"POINTS must be WIDTH x HEIGHT, at most {MAX_POINTS}, got {num_points}, {width} x {height}"
        )
    return PcdHeader(dtype, num_points, data, size)


def _read_ascii(path: Path, header: PcdHeader, body: bytes) -> NDArray[Any]:
    words = body.split()
    shape = [int(np.prod(header.dtype[name].shape, dtype=int)) for name in header.dtype.names or ()]
    if len(words) != header.num_points * sum(shape):
        what = f"must hold {header.num_points} points of {sum(shape)} numbers, got {len(words)} numbers"
        raise _damaged(path, what)
    try:
        # Integers beyond 2^53, such as times in nanoseconds, lose digits.
        numbers = np.array(words, dtype=np.float64).reshape(header.num_points, sum(shape))
    except ValueError as error:
        raise _damaged(path, f"must hold numbers, got {error}") from None
    points = np.zeros(header.num_points, dtype=header.dtype)
    column = 0
    for name, count in zip(header.dtype.names or (), shape, strict=True):
        with np.errstate(invalid="ignore"):  # NaN in an integer field is not looked at
            points[name] = numbers[:, column : column + count].reshape(points[name].shape)
        column += count
    return points


def _read_binary(path: Path, header: PcdHeader, body: bytes) -> NDArray[Any]:
    num_bytes = header.num_points * header.dtype.itemsize
    _require_bytes(path, num_bytes, len(body))
    return np.frombuffer(body[:num_bytes], dtype=header.dtype)


def _read_compressed(path: Path, header: PcdHeader, body: bytes) -> NDArray[Any]:
    compressed = _compressed_size(path, header, body[:8], len(body))
    num_bytes = header.num_points * header.dtype.itemsize
    try:
        plain = decompress_lzf(body[8 : 8 + compressed], num_bytes)
    except ValueError as error:
        raise _damaged(path, f"must hold intact compressed points, got {error}") from None
    # Field after field, each for all points.
    points = np.zeros(header.num_points, dtype=header.dtype)
    start = 0
    for name in header.dtype.names or ():
        size = header.dtype[name].itemsize * header.num_points
        field = np.frombuffer(plain[start : start + size], dtype=header.dtype[name].base)
        points[name] = field.reshape(points[name].shape)
        start += size
    return points


def _compressed_size(path: Path, header: PcdHeader, start: bytes, size: int) -> int:
    """Bytes of the compressed block, from the two numbers before it."""
    _require_bytes(path, 8, len(start))
    compressed, plain = (int(number) for number in np.frombuffer(start, dtype="<u4"))
    if plain != header.num_points * header.dtype.itemsize:
        expected = header.num_points * header.dtype.itemsize
        raise _damaged(path, f"must hold {expected} bytes of points, got {plain} after decompression")
    _require_bytes(path, 8 + compressed, size)
    return compressed


def decompress_lzf(data: bytes, num_bytes: int) -> bytes:
    """Undo LibLZF's compression. A run starts with a control byte c: c < 32, c + 1 bytes as they are; else a copy of
    (c >> 5) + 2 bytes (7: plus the next byte) from (c & 31) * 256 + next byte + 1 bytes back.

    Raises:
        ValueError: the data does not give exactly ``num_bytes``.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end and len(out) <= num_bytes:
            control = data[position]
            position += 1
            if control < 32:
                if position + control >= end:
                    raise ValueError("data that ends within a run")
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[position]
                position += 1
            back = ((control & 31) << 8) + data[position] + 1
            position += 1
            first = len(out) - back
            if first < 0:
                raise ValueError("a copy from before the start")
            if back >= length:
                out += out[first : first + length]
            else:  # the copy reads what it writes
                out += (out[first:] * math.ceil(length / back))[:length]
    except IndexError:
        raise ValueError("data that ends within a run") from None
    if len(out) != num_bytes:
        raise ValueError(f"{len(out)} bytes instead of {num_bytes}")
    return bytes(out)


def _require_bytes(path: Path, needed: int, size: int) -> None:
    if size < needed:
        raise _damaged(path, f"must hold {needed} bytes of points, got {size}: truncated?")


def _damaged(path: Path, what: str) -> FrameError:
    return FrameError(path, f".pcd file {what}")
