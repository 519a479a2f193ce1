# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Compact soft labels: round trip, size, the loss computed with them, and damaged or hostile files."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from pred.data import soft_labels
from pred.data.frame import FrameError
from pred.data.labels import PseudoLabel, label_cells
from pred.losses import semantic_loss

SHAPE = (9, 16)
CELLS = np.array([0, 5, 16, 143])


def softmax(rng: np.random.Generator, num: int, scale: float) -> NDArray[np.float32]:
    scores = rng.normal(size=(num, 19)) * scale
    values = np.exp(scores - scores.max(axis=1, keepdims=True))
    return (values / values.sum(axis=1, keepdims=True)).astype(np.float32)


def write(path: Path, **arrays: Any) -> PseudoLabel:
    """A file whose arrays are those of `CELLS`, or the given ones."""
    probabilities = np.zeros((len(CELLS), 19))
    probabilities[np.arange(4), [3, 0, 18, 7]] = 0.875
    probabilities[:, 10] = 0.125
    content: dict[str, Any] = {
        "shape": np.array(SHAPE, dtype=np.int32),
        "steps": np.diff(CELLS, prepend=0).astype(np.uint32),
        "codes": soft_labels.encode(probabilities),
    }
    np.savez(path, **{**content, **arrays})
    return PseudoLabel(path, width=32, height=18)


def test_codes_by_hand() -> None:
    probabilities = np.zeros((1, 19))
    probabilities[0, [2, 5, 7]] = [0.86, 0.125, 0.015]
    codes = soft_labels.encode(probabilities)
    # 255 * cbrt(0.125) = 127.5, to even; 255 * cbrt(0.015) = 62.9
    assert codes[[2, 5, 7], 0].tolist() == [255, 128, 63] and codes.sum() == 255 + 128 + 63
    decoded = soft_labels.decode(codes)[0]
    expected = [(128 / 255) ** 3, (63 / 255) ** 3]
    assert decoded[[5, 7]] == pytest.approx(expected, rel=1e-6)
    assert decoded[2] == pytest.approx(1 - sum(expected), rel=1e-6)


@pytest.mark.parametrize("scale", [0.0, 0.01, 0.3, 1.0, 5.0])
def test_the_most_probable_class_stays(scale: float) -> None:
    """Also where classes are so close that rounding could change their order; ties take the first class."""
    probabilities = softmax(np.random.default_rng(0), 20_000, scale)
    decoded = soft_labels.decode(soft_labels.encode(probabilities))
    assert np.array_equal(decoded.argmax(axis=1), probabilities.argmax(axis=1))
    # Rounded down, each of 18 others loses up to a step of its code, which is 3 x 96^2 / 255^3 near 1 / 19.
    assert np.abs(decoded - probabilities).max() < 18 * 3 * 96**2 / 255**3 and (decoded >= 0).all()


def test_lookup_and_class_map(tmp_path: Path) -> None:
    label = write(tmp_path / "label.npz")
    # The image is 32 x 18, so a cell has 2 x 2 pixels: cells 0, 5, none, 16, 143.
    found = label.lookup(np.array([[1.9, 0.1], [10.0, 1.99], [12.0, 0.0], [0.0, 2.0], [31.9, 17.9]]))
    assert found.class_id.tolist() == [3, 0, -1, 18, 7]
    assert found.confidence[[0, 1, 3, 4]] == pytest.approx(0.875, abs=2e-3) and found.confidence[2] == 0
    assert not found.target[2].any() and found.target.dtype == np.float32
    assert found.target[[0, 1, 3, 4]].sum(axis=1) == pytest.approx(1.0, abs=1e-6)
    expected = np.full(SHAPE, 255, dtype=np.uint8)
    expected.flat[CELLS] = [3, 0, 18, 7]
    assert np.array_equal(label.class_map(), expected)


def test_no_cells(tmp_path: Path) -> None:
    path = tmp_path / "label.npz"
    path.write_bytes(soft_labels.to_bytes(SHAPE, np.zeros(0, dtype=np.int64), np.zeros((0, 19))))
    label = PseudoLabel(path, 16, 9)
    assert label.lookup(np.array([[3.0, 3.0]])).class_id.tolist() == [-1]
    assert (label.class_map() == 255).all()


def test_bytes_depend_on_the_content_alone() -> None:
    values = softmax(np.random.default_rng(1), 4, 3.0)
    assert soft_labels.to_bytes(SHAPE, CELLS, values) == soft_labels.to_bytes(SHAPE, CELLS, values.copy())


@pytest.mark.parametrize("scale", [1.0, 6.0, 14.0])
def test_size_and_loss_of_a_keyframe(tmp_path: Path, scale: float) -> None:
    """Six images of 4,000 LiDAR pixels, from unsure (mean confidence 0.2) to sure labels."""
    rng = np.random.default_rng(0)
    num_bytes, pairs = 0, []
    for camera in range(6):
        uv = rng.uniform((0, 0), (1600, 900), size=(4000, 2))
        row, column = label_cells(uv, (900, 1600), (900, 1600))
        cells, place = np.unique(row * 1600 + column, return_inverse=True)
        exact = softmax(rng, len(cells), scale)
        path = tmp_path / f"{camera}.npz"
        path.write_bytes(soft_labels.to_bytes((900, 1600), cells, exact))
        num_bytes += path.stat().st_size
        stored = PseudoLabel(path, 1600, 900).lookup(uv)
        assert (stored.class_id >= 0).all()
        pairs.append((exact[place], stored))
    assert num_bytes <= 500_000

    exact = np.concatenate([pair[0] for pair in pairs])
    stored_target = np.concatenate([pair[1].target for pair in pairs])
    stored_confidence = np.concatenate([pair[1].confidence for pair in pairs])
    valid = torch.ones(1, len(exact), dtype=torch.bool)
    for rendered in (exact, np.roll(exact, 1, axis=0), 0.9 * exact + 0.1 / 19, softmax(rng, len(exact), 2.0)):

        def loss(target: NDArray[np.float32], confidence: NDArray[np.float32], rendered: Any = rendered) -> float:
            first, second, third = (torch.from_numpy(x)[None].double() for x in (rendered, target, confidence))
            return semantic_loss(first, second, third, valid).item()

        assert loss(stored_target, stored_confidence) == pytest.approx(loss(exact, exact.max(axis=1)), rel=1e-3)


def test_encode_refuses_what_are_no_probabilities() -> None:
    good = np.full((2, 19), 1 / 19)
    for value in (np.nan, -0.1, 0.5):
        bad = good.copy()
        bad[1, 4] = value
        with pytest.raises(ValueError, match=r"probabilities must be in \[0, 1\] with a sum of 1, got"):
            soft_labels.encode(bad)


def test_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "label.npz"

    def message(**arrays: Any) -> str:
        label = write(path, **arrays)
        with pytest.raises(FrameError) as caught:
            label.lookup(np.zeros((1, 2)))
        with pytest.raises(FrameError):
            label.class_map()
        assert str(caught.value).startswith(f"{path}: ")
        return str(caught.value)

    codes = np.asarray(np.load(path)["codes"]) if write(path) else np.zeros(0)
    assert "shape must be int32 [2], got int64 [2]" in message(shape=np.array(SHAPE))
    assert "at least 1 x 1 cells, got [0, 16]" in message(shape=np.array((0, 16), dtype=np.int32))
    assert "must have at most" in message(shape=np.array((2**30, 2**30), dtype=np.int32))
    assert "aspect ratio" in message(shape=np.array((9, 19), dtype=np.int32))
    assert "codes must be uint8 of [19, N]" in message(codes=codes[:18])
    assert "codes must be uint8 of [19, N]" in message(codes=codes[:, :3])
    assert "steps must be uint32 of [N]" in message(steps=np.zeros((4, 1), dtype=np.uint32))
    assert "steps must be uint32 of [N]" in message(steps=np.array([object()] * 4))
    too_many = np.ones(145, dtype=np.uint32)
    assert "for N cells of a grid of 9 x 16" in message(steps=too_many, codes=np.zeros((19, 145), dtype=np.uint8))
    assert "ascending cells" in message(steps=np.array([0, 5, 0, 7], dtype=np.uint32))
    assert "ascending cells" in message(steps=np.array([0, 5, 11, 128], dtype=np.uint32))
    assert "ascending cells" in message(steps=np.full(4, 2**32 - 1, dtype=np.uint32))
    assert "must hold 255 once" in message(codes=np.zeros((19, 4), dtype=np.uint8))
    twice = codes.copy()
    twice[:2] = 255
    assert "must hold 255 once" in message(codes=twice)
    much = np.full((19, 4), 200, dtype=np.uint8)
    much[0] = 255
    assert "with a sum of at most 1, got" in message(codes=much)


def test_truncated_and_flipped_files(tmp_path: Path) -> None:
    path = tmp_path / "label.npz"
    values = softmax(np.random.default_rng(2), len(CELLS), 4.0)
    whole = soft_labels.to_bytes(SHAPE, CELLS, values)
    right = soft_labels.decode(soft_labels.encode(values))
    label = PseudoLabel(path, 16, 9)
    uv = np.stack([CELLS % 16, CELLS // 16], axis=1) + 0.5
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(FrameError, match="label must be a readable .npz file"):
            label.lookup(uv)
    for place in range(0, len(whole), 7):  # an error that names the file, or the right values
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        try:
            assert np.array_equal(label.lookup(uv).target, right)
        except FrameError as error:
            assert str(path) in str(error)


def test_surplus_bytes_are_not_read(tmp_path: Path) -> None:
    """A small file may hold gigabytes of zeros behind an array."""
    path = tmp_path / "label.npz"
    member = io.BytesIO()
    np.lib.format.write_array(member, np.full((19, 9, 16), 0.05, dtype=np.float32))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("probabilities.npy", member.getvalue() + bytes(1000))
    size = len(member.getvalue())
    with pytest.raises(FrameError, match=rf"label\.npz: .*{size + 1000} bytes of probabilities.npy instead of {size}"):
        PseudoLabel(path, 32, 18).lookup(np.zeros((1, 2)))


def test_claimed_sizes_are_not_trusted(tmp_path: Path) -> None:
    path = tmp_path / "label.npz"
    write(path)
    arrays = {name: np.load(path)[name] for name in ("shape", "steps", "codes")}
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, allow_pickle=False)
            content = member.getvalue()
            if name == "codes":
                content = content.replace(b"(19, 4)", b"(19, 4" + b"0" * 12 + b")").replace(b" " * 12, b"", 1)
            archive.writestr(f"{name}.npy", content)
    with pytest.raises(FrameError, match=r"codes must be uint8 of \[19, N\]"):
        PseudoLabel(path, 32, 18).lookup(np.zeros((1, 2)))
