# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Semantic pseudo labels of images: hard class maps, per-pixel probabilities, and probabilities at some pixels.

A label map may be smaller or larger than its image (segmenters often run on a scaled copy); image
pixels are scaled to it. It must show the whole image, so its aspect ratio must be the image's.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pred.data import soft_labels
from pred.data.frame import NUM_CLASSES, FrameError, decode_image, open_image
from pred.data.soft_labels import SoftLabels

IGNORED_CLASS_IDS = (19, 255)
PROBABILITIES_KEY = "probabilities"
SOFT_KEYS = (soft_labels.SHAPE, soft_labels.STEPS, soft_labels.CODES)
LABEL_SUFFIXES = (".png", ".npy", ".npz")
MAX_PROBABILITY_SUM = 1.01  # room for float16 rounding
MAX_SCALE = 4  # of a label map against its image: damage must not claim gigabytes

CheckHeader = Callable[[tuple[int, ...], np.dtype[Any]], None]
"""Raises for the shape and type of a label that cannot be used, before anything is allocated for it."""


class LabelLookup(NamedTuple):
    """Labels at N pixels.

    Attributes:
        target: [N, 19] float32 class probabilities; one-hot for hard labels, zero where ignored.
        confidence: [N] float32, the largest probability; 1 for hard labels, 0 where ignored.
        class_id: [N] int64, the most probable class; -1 where ignored.
    """

    target: NDArray[np.float32]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]


@dataclass
class PseudoLabel:
    """The pseudo label of one image; files are read when looked up.

    Attributes:
        source: ``.png`` (palette or grey, Cityscapes train ids; 19 and 255 are ignored), ``.npy``
            or ``.npz`` (key ``probabilities``; float16 or float32 [19, h, w]; or the keys of
            `pred.data.soft_labels`: cells that are not stored are ignored); or such an array,
            uint8 [h, w] class ids or [19, h, w] probabilities, or a function that makes it.
        width, height: size of the image in pixels.
    """

    source: Path | NDArray[Any] | Callable[[], NDArray[Any]]
    width: int
    height: int

    @property
    def name(self) -> str:
        """File name, or a description for an array in memory; opens every error text."""
        return str(self.source) if isinstance(self.source, Path) else "pseudo label in memory"

    def lookup(self, uv: NDArray[np.float64]) -> LabelLookup:
        """Labels at image pixels ``uv`` [N, 2]: nearest label cell, pixels outside are clamped.

        Of probability files only the values looked up are read and checked.

        Raises:
            FrameError: the file is missing or damaged, has a wrong type, shape or aspect ratio,
                holds other class ids, or values that are no probabilities.
        """
        label_map = self._load()
        row, column = label_cells(uv, (self.height, self.width), label_map.shape[-2:])
        if isinstance(label_map, SoftLabels):
            return self._soft_lookup(label_map.at(row, column).T)
        if label_map.ndim == 2:
            return _hard_lookup(label_map[row, column])
        return self._soft_lookup(label_map[:, row, column])

    def class_map(self) -> NDArray[np.uint8]:
        """[h, w] most probable class of every label cell, 255 where ignored; raises as `lookup`."""
        label_map = self._load()
        if isinstance(label_map, SoftLabels):
            class_map = np.full(label_map.shape, 255, dtype=np.uint8)
            class_map.flat[label_map.cells] = soft_labels.decode(label_map.codes).argmax(axis=1)
            return class_map
        if label_map.ndim == 2:
            return np.where(label_map < NUM_CLASSES, label_map, 255).astype(np.uint8)
        looked_up = self._soft_lookup(label_map.reshape(NUM_CLASSES, -1))
        class_id = np.where(looked_up.class_id < 0, 255, looked_up.class_id)
        return class_id.astype(np.uint8).reshape(label_map.shape[1:])

    def _load(self) -> NDArray[Any] | SoftLabels:
        label_map: NDArray[Any] | SoftLabels
        if not isinstance(self.source, Path):
            label_map = np.asarray(self.source() if callable(self.source) else self.source)
        elif self.source.suffix == ".png":
            label_map = _read_png(self.source, self._check_header)
        elif self.source.suffix == ".npy":
            label_map = _map_npy(self.source)
        elif self.source.suffix == ".npz":
            label_map = _read_npz(self.source, self._check_header, self._check_grid)
            if isinstance(label_map, SoftLabels):
                return label_map
        else:
            raise FrameError(self.source, f"label must be one of {LABEL_SUFFIXES}")
        self._check_header(label_map.shape, label_map.dtype)
        if label_map.ndim == 2:
            self._check_class_ids(label_map)
        return label_map

    def _check_header(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        hard = len(shape) == 2 and dtype == np.uint8
        soft = len(shape) == 3 and shape[0] == NUM_CLASSES and dtype in (np.float16, np.float32)
        if not (hard or soft) or 0 in shape:
            raise FrameError(
                self.name,
                "label must be uint8 [h, w] class ids or float16/float32 "
                f"[{NUM_CLASSES}, h, w] probabilities, got {dtype} {list(shape)}",
            )
        self._check_grid(shape[-2:])

    def _check_grid(self, shape: tuple[int, ...]) -> None:
        map_height, map_width = shape
        if map_height < 1 or map_width < 1:
            raise FrameError(self.name, f"label must have at least 1 x 1 cells, got {list(shape)}")
        if map_height * map_width > MAX_SCALE**2 * self.height * self.width:
            raise FrameError(
                self.name,
                f"label must have at most {MAX_SCALE} times the width and height of its {self.width} x {self.height} "
                f"image, got {map_width} x {map_height}",
            )
        # One label cell of tolerance: 1600 x 900 at 1/8 is 200 x 112.5.
        if abs(map_width * self.height / self.width - map_height) > 1.0:
            raise FrameError(
                self.name,
                f"label must have the aspect ratio of its {self.width} x {self.height} image, "
                f"got {map_width} x {map_height}",
            )

    def _check_class_ids(self, label_map: NDArray[np.uint8]) -> None:
        present = np.flatnonzero(np.bincount(label_map.ravel(), minlength=256))
        unknown = present[(present >= NUM_CLASSES) & ~np.isin(present, IGNORED_CLASS_IDS)]
        if len(unknown):
            raise FrameError(
                self.name,
                "label must hold Cityscapes train ids 0..18, or 19 and 255 (ignored), "
                f"got {', '.join(map(str, unknown[:8]))}",
            )

    def _soft_lookup(self, probabilities: NDArray[Any]) -> LabelLookup:
        target = np.ascontiguousarray(probabilities.T, dtype=np.float32)  # [N, 19]
        total = target.sum(axis=1)
        # Written so that NaN fails.
        good = (target >= 0).all(axis=1) & (target <= 1).all(axis=1) & (total <= MAX_PROBABILITY_SUM)
        if not good.all():
            worst = target[np.argmin(good)]
            raise FrameError(
                self.name,
                "probabilities must be finite, in [0, 1], with a sum of at most 1, "
                f"got min {worst.min():g}, max {worst.max():g}, sum {worst.sum():g} in one pixel",
            )
        confidence = target.max(axis=1, initial=0.0)
        class_id = np.where(confidence > 0, target.argmax(axis=1), -1)
        return LabelLookup(target, confidence, class_id)


def label_cells(
    uv: NDArray[np.float64], image_shape: tuple[int, int], map_shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row [N] and column [N] of the label cells that hold image pixels ``uv`` [N, 2]; pixels outside are clamped.

    Shapes are (rows, columns) of the image and of the label map.
    """
    row, column = (
        np.floor(uv[:, axis] * (map_shape[side] / image_shape[side])).astype(np.int64).clip(0, map_shape[side] - 1)
        for side, axis in ((0, 1), (1, 0))
    )
    return row, column


def label_folder(root: Path, labels: str | None) -> Path | None:
    """The folder that ``data.labels`` means: its path under the root; "auto", the only one under ``pseudo/`` or None if
    there is none; or "none".

    Raises:
        FrameError: there is no such folder, or "auto" has several to choose from.
    """
    if labels is None or labels == "none":
        return None
    if labels == "auto":
        folders = sorted(path for path in (root / "pseudo").glob("*") if path.is_dir())
        if len(folders) > 1:
            names = ", ".join(path.name for path in folders)
            raise FrameError(root / "pseudo", f"must hold one label folder, or data.labels name it, got {names}")
        return folders[0] if folders else None
    if not (root / labels).is_dir():
        raise FrameError(root / labels, "data.labels must be a folder, got no such folder")
    return root / labels


def find_label_file(folder: Path, stem: str) -> Path:
    """The label file ``<folder>/<stem>`` with one of the known suffixes.

    Raises:
        FrameError: there is none.
    """
    for suffix in LABEL_SUFFIXES:
        path = folder / f"{stem}{suffix}"
        if path.is_file():
            return path
    raise FrameError(
        folder / f"{stem}.png",
        f"label file must exist as one of {LABEL_SUFFIXES}, got no such file",
    )


def _hard_lookup(class_ids: NDArray[np.uint8]) -> LabelLookup:
    labelled = class_ids < NUM_CLASSES
    target = np.zeros((len(class_ids), NUM_CLASSES), dtype=np.float32)
    target[np.flatnonzero(labelled), class_ids[labelled]] = 1.0
    class_id = np.where(labelled, class_ids.astype(np.int64), -1)
    return LabelLookup(target, labelled.astype(np.float32), class_id)


def _read_png(path: Path, check_header: CheckHeader) -> NDArray[Any]:
    with open_image(path) as image:
        if image.format != "PNG" or image.mode not in ("P", "L"):
            raise FrameError(
                path,
                f"label must be a PNG of mode P (palette) or L (8-bit grey), got {image.format} of mode {image.mode}",
            )
        check_header((image.height, image.width), np.dtype(np.uint8))
        return decode_image(path, image)


def _map_npy(path: Path) -> NDArray[Any]:
    """Memory-map: only the pages that are looked up get read. Pickles are refused."""
    try:
        return npy_format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise FrameError(path, "label file must exist, got no such file") from None
    # A damaged header surfaces as ValueError, OSError, SyntaxError, EOFError, OverflowError, ...
    except Exception as error:
        raise FrameError(path, _unreadable(".npy", error)) from None


def _read_npz(
    path: Path,
    check_header: CheckHeader,
    check_grid: Callable[[tuple[int, ...]], None],
) -> NDArray[Any] | SoftLabels:
    try:
        with zipfile.ZipFile(path) as archive:
            held = archive.namelist()
            if f"{PROBABILITIES_KEY}.npy" in held:
                # Claimed sizes are checked before anything is allocated for them.
                check_header(*_header(archive, PROBABILITIES_KEY))
                return _array(archive, PROBABILITIES_KEY)
            if not {f"{key}.npy" for key in SOFT_KEYS} <= set(held):
                raise FrameError(path, f"must hold the key {PROBABILITIES_KEY!r} or {', '.join(SOFT_KEYS)}, got {held}")
            return _read_soft(path, archive, check_grid)
    except FrameError:
        raise
    except FileNotFoundError:
        raise FrameError(path, "label file must exist, got no such file") from None
    # Damage surfaces as BadZipFile, zlib.error, ValueError, OSError, EOFError, ...
    except Exception as error:
        raise FrameError(path, _unreadable(".npz", error)) from None


def _read_soft(path: Path, archive: zipfile.ZipFile, check_grid: Callable[[tuple[int, ...]], None]) -> SoftLabels:
    headers = {key: _header(archive, key) for key in SOFT_KEYS}
    num_cells = headers[soft_labels.STEPS][0]
    if headers[soft_labels.SHAPE] != ((2,), np.int32):
        raise FrameError(path, f"{soft_labels.SHAPE} must be int32 [2], got {_described(headers[soft_labels.SHAPE])}")
    shape = _array(archive, soft_labels.SHAPE)
    check_grid(tuple(map(int, shape)))
    for key, dtype, wanted in (
        (soft_labels.STEPS, np.uint32, num_cells),
        (soft_labels.CODES, np.uint8, (NUM_CLASSES, *num_cells)),
    ):
        if headers[key] != (wanted, dtype) or len(num_cells) != 1 or num_cells[0] > int(shape[0]) * int(shape[1]):
            raise FrameError(
                path,
                f"{key} must be {np.dtype(dtype)} of [{'19, ' if key == soft_labels.CODES else ''}N] for N cells of a "
                f"grid of {shape[0]} x {shape[1]}, got {_described(headers[key])}",
            )
    try:
        return soft_labels.from_arrays(shape, _array(archive, soft_labels.STEPS), _array(archive, soft_labels.CODES))
    except ValueError as error:
        raise FrameError(path, f"label is damaged: {error}") from None


def _header(archive: zipfile.ZipFile, key: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    with archive.open(f"{key}.npy") as stream:
        return _npy_header(stream)


def _array(archive: zipfile.ZipFile, key: str) -> NDArray[Any]:
    name = f"{key}.npy"
    with archive.open(name) as stream:
        shape, dtype = _npy_header(stream)
        num_bytes = stream.tell() + math.prod(shape) * dtype.itemsize
    if archive.getinfo(name).file_size != num_bytes:
        raise ValueError(f"{archive.getinfo(name).file_size} bytes of {name} instead of {num_bytes}")
    with archive.open(name) as stream:
        array: NDArray[Any] = npy_format.read_array(stream, allow_pickle=False)
        stream.read()  # the end, where the checksum is compared
        return array


def _described(header: tuple[tuple[int, ...], np.dtype[Any]]) -> str:
    return f"{header[1]} {list(header[0])}"


def _npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = npy_format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = npy_format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = npy_format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"unsupported .npy version {version}")
    return shape, dtype


def _unreadable(kind: str, error: Exception) -> str:
    return f"label must be a readable {kind} file, got {type(error).__name__}: {error}"
