# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Pseudo labels: look-up by scaled pixel, and every way in which a label file can be wrong."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pred.data.frame import FrameError
from pred.data.labels import PseudoLabel, find_label_file

# A 4 x 2 label map of an 8 x 4 image: each label cell covers 2 x 2 pixels.
CLASS_IDS = np.array([[0, 13, 19, 255], [18, 1, 2, 8]], dtype=np.uint8)
CENTRES = np.array([[0.0, 0.0], [3.9, 1.9], [4.0, 1.0], [7.99, 0.5], [1.0, 2.0], [7.99, 3.99]])
CLASS_AT_CENTRES = [0, 13, -1, -1, 18, 8]


def probabilities(dtype: type = np.float32) -> NDArray[Any]:
    """[19, 2, 4]: 0.75 for the class of CLASS_IDS, the rest to class 5; nothing where ignored."""
    values: NDArray[Any] = np.zeros((19, 2, 4), dtype=dtype)
    for row, column in np.ndindex(2, 4):
        if CLASS_IDS[row, column] < 19:
            values[CLASS_IDS[row, column], row, column] = 0.75
            values[5, row, column] += 0.25
    return values


def label(source: Path | NDArray[np.generic]) -> PseudoLabel:
    return PseudoLabel(source, width=8, height=4)


def save_palette(path: Path) -> None:
    image = Image.fromarray(CLASS_IDS).convert("P")
    image.putdata(CLASS_IDS.ravel().tolist())
    image.putpalette([value for index in range(256) for value in (index, 255 - index, 7)])
    image.save(path)


@pytest.mark.parametrize("kind", ["grey", "palette", "memory", "function"])
def test_hard_labels(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "label.png"
    if kind == "grey":
        Image.fromarray(CLASS_IDS).save(path)
    elif kind == "palette":
        save_palette(path)
    pseudo_label = {"memory": label(CLASS_IDS), "function": PseudoLabel(lambda: CLASS_IDS, 8, 4)}.get(kind, label(path))
    found = pseudo_label.lookup(CENTRES)
    assert found.class_id.tolist() == CLASS_AT_CENTRES
    assert found.confidence.tolist() == [1, 1, 0, 0, 1, 1]
    assert found.target.dtype == found.confidence.dtype == np.float32
    expected = np.zeros((6, 19))
    expected[[0, 1, 4, 5], [0, 13, 18, 8]] = 1
    assert np.array_equal(found.target, expected)
    assert np.array_equal(pseudo_label.class_map(), np.where(CLASS_IDS == 19, 255, CLASS_IDS))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("kind", ["npy", "npz", "compressed"])
def test_probabilities(tmp_path: Path, kind: str, dtype: type) -> None:
    path = tmp_path / ("label.npy" if kind == "npy" else "label.npz")
    if kind == "npy":
        np.save(path, probabilities(dtype))
    elif kind == "npz":
        np.savez(path, probabilities=probabilities(dtype))
    else:
        np.savez_compressed(path, probabilities=probabilities(dtype))
    found = label(path).lookup(CENTRES)
    assert found.class_id.tolist() == CLASS_AT_CENTRES
    assert found.confidence.tolist() == [0.75, 0.75, 0, 0, 0.75, 0.75]
    assert found.target[1, 13] == 0.75 and found.target[1, 5] == 0.25
    assert found.target.dtype == np.float32
    assert np.array_equal(label(path).class_map(), np.where(CLASS_IDS == 19, 255, CLASS_IDS))


def test_npy_is_memory_mapped(tmp_path: Path) -> None:
    path = tmp_path / "label.npy"
    np.save(path, probabilities())
    assert isinstance(label(path)._load(), np.memmap)


def test_no_pixels() -> None:
    for source in (CLASS_IDS, probabilities()):
        found = label(source).lookup(np.zeros((0, 2)))
        assert found.target.shape == (0, 19) and found.class_id.shape == (0,)


def test_find_label_file(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"stem\.a\.png: label file must exist as one of .*npz"):
        find_label_file(tmp_path, "stem.a")
    (tmp_path / "stem.a.npz").touch()
    assert find_label_file(tmp_path, "stem.a").name == "stem.a.npz"


def test_missing_files(tmp_path: Path) -> None:
    for suffix in ("png", "npy", "npz"):
        with pytest.raises(FrameError, match=rf"gone\.{suffix}: .*must exist, got no such file"):
            label(tmp_path / f"gone.{suffix}").lookup(CENTRES)
    with pytest.raises(FrameError, match=r"gone\.jpg: label must be one of"):
        label(tmp_path / "gone.jpg").lookup(CENTRES)


def claimed_png(width: int, height: int) -> bytes:
    """A PNG, 8-bit grey, whose header claims pixels that are not there: decoding it fails."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


def test_unusable_png(tmp_path: Path) -> None:
    path = tmp_path / "label.png"

    def message_for(pixels: NDArray[np.generic]) -> str:
        Image.fromarray(pixels).save(path)
        with pytest.raises(FrameError) as caught:
            label(path).lookup(CENTRES)
        assert str(caught.value).startswith(f"{path}: ")
        return caught.value.what

    assert "255 (ignored), got 20, 33" in message_for(np.array([[20, 0, 0, 0], [33, 1, 1, 1]], dtype=np.uint8))
    assert "aspect ratio of its 8 x 4 image, got 2 x 4" in message_for(CLASS_IDS.T.copy())
    assert "got PNG of mode RGB" in message_for(np.zeros((2, 4, 3), dtype=np.uint8))
    assert "got PNG of mode I;16" in message_for(np.zeros((2, 4), dtype=np.uint16))

    big = np.random.default_rng(0).integers(0, 19, (200, 400), dtype=np.uint8)
    Image.fromarray(big).save(path)
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(FrameError, match=r"label\.png: image file must be readable, got"):
        PseudoLabel(path, 400, 200).lookup(CENTRES)
    path.write_bytes(claimed_png(9_000, 9_000))
    with pytest.raises(FrameError, match="at most 4 times the width and height of its 8 x 4 image, got 9000 x 9000"):
        label(path).lookup(CENTRES)
    path.write_bytes(b"not an image")
    with pytest.raises(FrameError, match=r"label\.png: image file must be readable, got UnidentifiedImageError"):
        label(path).lookup(CENTRES)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.01, 1.5])
def test_values_that_are_no_probabilities(tmp_path: Path, value: float) -> None:
    path = tmp_path / "label.npy"
    wrong = probabilities()
    wrong[3, 1, 2] = value
    np.save(path, wrong)
    with pytest.raises(FrameError, match=r"label\.npy: probabilities must be finite, in \[0, 1\]"):
        label(path).lookup(np.array([[4.5, 2.5]]))
    # The cell is not looked up here.
    label(path).lookup(np.array([[0.5, 0.5]]))


def test_sum_of_probabilities() -> None:
    values = np.zeros((19, 2, 4), dtype=np.float32)
    values[:2] = 0.504
    label(values).lookup(CENTRES)
    values[:2] = 0.506
    with pytest.raises(FrameError, match=r"pseudo label in memory: .*sum 1\.012 in one pixel"):
        label(values).lookup(CENTRES)


def test_unusable_numpy_files(tmp_path: Path) -> None:
    npy, npz = tmp_path / "label.npy", tmp_path / "label.npz"

    def message_for(path: Path) -> str:
        with pytest.raises(FrameError) as caught:
            label(path).lookup(CENTRES)
        assert str(caught.value).startswith(f"{path}: ")
        return caught.value.what

    np.save(npy, probabilities()[:18])
    assert "got float32 [18, 2, 4]" in message_for(npy)
    np.save(npy, probabilities().astype(np.float64))
    assert "got float64 [19, 2, 4]" in message_for(npy)
    np.save(npy, np.array({"a": 1}), allow_pickle=True)
    assert "readable .npy file" in message_for(npy)
    np.save(npy, probabilities())
    npy.write_bytes(npy.read_bytes()[:-8])
    assert "readable .npy file" in message_for(npy)
    npy.write_bytes(b"")
    assert "readable .npy file" in message_for(npy)

    np.savez(npz, other=probabilities())
    assert "must hold the key 'probabilities' or shape, steps, codes, got ['other.npy']" in message_for(npz)
    np.savez(npz, probabilities=np.array([object()], dtype=object))
    assert "got object [1]" in message_for(npz)
    np.savez(npz, probabilities=probabilities())
    whole = npz.read_bytes()
    npz.write_bytes(whole[:-60])
    assert "readable .npz file, got BadZipFile" in message_for(npz)
    damaged = bytearray(whole)
    damaged[300] ^= 0xFF
    npz.write_bytes(damaged)
    assert "readable .npz file, got BadZipFile" in message_for(npz)


def test_npz_that_claims_a_huge_array_is_refused_before_allocation(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (19, 400_000, 800_000)}
    )
    path = tmp_path / "label.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("probabilities.npy", header.getvalue())
    with pytest.raises(FrameError, match=r"label\.npz: label must have at most 4 times the width and height"):
        label(path).lookup(CENTRES)
