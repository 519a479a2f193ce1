# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Class probabilities at a few cells of an image, in a small file: what `pred label` writes.

Probabilities are stored as the cube roots of their values in 8 bits, all but the largest of a cell, which is what the
others leave of 1. The steps of the cube root are fine where probabilities are small, so the many small ones add up to
the right sum. docs/labels.md describes the file.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pred.data.frame import NUM_CLASSES

CODES, STEPS, SHAPE = "codes", "steps", "shape"
"""Keys of the file."""
LARGEST = 255
"""Code of the largest probability of a cell; no other reaches it."""
ZIP_TIME = (1980, 1, 1, 0, 0, 0)
DECODED = np.append((np.arange(LARGEST, dtype=np.float64) / LARGEST) ** 3, 0.0)
"""Probability of each code; that of `LARGEST` is what the others leave."""


@dataclass
class SoftLabels:
    """Probabilities at N cells of a grid that covers the image.

    Attributes:
        shape: rows and columns of the grid.
        cells: [N] int64, row * columns + column, ascending.
        codes: [19, N] uint8.
    """

    shape: tuple[int, int]
    cells: NDArray[np.int64]
    codes: NDArray[np.uint8]

    def at(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.float32]:
        """[M, 19] probabilities at cells of the grid; zero where nothing is stored."""
        wanted = row * self.shape[1] + column
        place = np.searchsorted(self.cells, wanted)
        stored = np.zeros(len(wanted), dtype=np.bool_)
        inside = place < len(self.cells)
        stored[inside] = self.cells[place[inside]] == wanted[inside]
        probabilities = np.zeros((len(wanted), NUM_CLASSES), dtype=np.float32)
        probabilities[stored] = decode(self.codes[:, place[stored]])
        return probabilities


def encode(probabilities: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """[19, N] codes of probabilities [N, 19] that sum to 1 in each row.

    Raises:
        ValueError: a row holds NaN, values outside [0, 1], or another sum.
    """
    values = np.asarray(probabilities, dtype=np.float64)
    good = (values >= 0).all(axis=1) & (values <= 1).all(axis=1) & (np.abs(values.sum(axis=1) - 1) <= 1e-3)
    if not good.all():
        raise ValueError(f"probabilities must be in [0, 1] with a sum of 1, got {values[np.argmin(good)].tolist()}")
    # At most half of a probability of 1 is left for the second largest, so its code is 202 at most.
    roots, row, largest = np.cbrt(values) * LARGEST, np.arange(len(values)), values.argmax(axis=1)
    codes = np.rint(roots).astype(np.uint8)
    codes[row, largest] = LARGEST
    # Where classes are nearly equal, rounding may leave less than the second largest has; rounding down leaves more.
    others = DECODED[codes]
    overtaken = 1.0 - others.sum(axis=1) <= others.max(axis=1, initial=0.0)
    codes[overtaken] = np.floor(roots[overtaken]).astype(np.uint8)
    codes[row, largest] = LARGEST
    return np.ascontiguousarray(codes.T)


def decode(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[N, 19] probabilities of codes [19, N] as `read` accepts them."""
    values = DECODED[codes.T]
    largest = (codes == LARGEST).argmax(axis=0)
    values[np.arange(len(values)), largest] = 1.0 - values.sum(axis=1)
    return values.astype(np.float32)


def to_bytes(shape: tuple[int, int], cells: NDArray[np.int64], probabilities: NDArray[np.floating[Any]]) -> bytes:
    """A file with the probabilities [N, 19] at ascending ``cells`` [N]; equal arguments give equal bytes."""
    steps = np.diff(cells, prepend=0).astype(np.uint32)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        arrays: dict[str, NDArray[Any]] = {SHAPE: np.array(shape, np.int32), STEPS: steps, CODES: encode(probabilities)}
        for key, array in arrays.items():
            member = io.BytesIO()
            npy_format.write_array(member, array, allow_pickle=False)
            entry = zipfile.ZipInfo(f"{key}.npy", ZIP_TIME)
            archive.writestr(entry, member.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=9)
    return file.getvalue()


def from_arrays(shape: NDArray[Any], steps: NDArray[Any], codes: NDArray[Any]) -> SoftLabels:
    """Labels of a file's arrays, whose types and sizes are known to fit.

    Raises:
        ValueError: their values break a rule; the text says which.
    """
    rows, columns = map(int, shape)
    cells = np.cumsum(steps, dtype=np.int64)
    if len(cells) and ((steps[1:] == 0).any() or cells[-1] >= rows * columns):
        raise ValueError(f"{STEPS} must lead to ascending cells of a grid of {rows} x {columns}, got others")
    if ((codes == LARGEST).sum(axis=0) != 1).any():
        raise ValueError(f"{CODES} must hold {LARGEST} once in each cell, got cells with another number")
    total = DECODED[codes].sum(axis=0)
    if (total > 1).any():
        raise ValueError(f"{CODES} must stand for probabilities with a sum of at most 1, got {total.max():g}")
    return SoftLabels((rows, columns), cells, codes)
