# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Info files of OpenPCDet and mmdetection3d for nuScenes: which samples, in which order, with which boxes.

They are pickles, which can run any code while they are read. Here only numbers, texts, containers and stand-ins for
NumPy arrays come out of them; anything else is refused by name. NumPy's own unpickling is left out too, since a damaged
file can crash the process in it.

Known forms: OpenPCDet's list of dictionaries (``nuscenes_infos_10sweeps_train.pkl``); mmdetection3d 1.1 and later,
``{"metainfo", "data_list"}``; before that ``{"metadata", "infos"}``.
"""

from __future__ import annotations

import pickle
import re
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import FrameError


@dataclass
class InfoFrame:
    """One sample of an info file.

    Attributes:
        token: sample token.
        centres_m: [M, 3] float64 centres of its boxes in the LiDAR frame; None where the file has no boxes.
    """

    token: str
    centres_m: NDArray[np.float64] | None


def load_info(path: str | Path) -> list[InfoFrame]:
    """Samples of an info file, in its order.

    Raises:
        FrameError: the file is missing, damaged, of no known form, or holds anything but plain values and arrays.
    """
    path = Path(path)
    content = _unpickle(path)
    if isinstance(content, dict):
        infos = content.get("data_list", content.get("infos"))
    else:
        infos = content
    if not isinstance(infos, list) or not infos:
        got = (
            f"a dictionary with {', '.join(map(str, content))}" if isinstance(content, dict) else type(content).__name__
        )
        raise FrameError(path, f"info file must hold a list of samples, or one as data_list or infos, got {got}")
    frames = []
    for number, info in enumerate(infos):
        try:
            frames.append(_frame(info))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            what = f"no {error}" if isinstance(error, KeyError) else str(error)
            raise FrameError(
                path, f"sample {number} must have a nuScenes token and boxes of 7 numbers, got {what}"
            ) from None
    return frames


def _frame(info: Any) -> InfoFrame:
    token = info["token"]
    if not isinstance(token, str):
        raise ValueError(f"token {token!r}")
    boxes: Any
    if "instances" in info:
        boxes = [instance["bbox_3d"] for instance in info["instances"]]
    elif "gt_boxes" in info:
        boxes = info["gt_boxes"]
        boxes = boxes.to_numpy() if isinstance(boxes, _Array) else boxes
    else:
        return InfoFrame(token, None)
    if not len(boxes):
        return InfoFrame(token, np.zeros((0, 3)))
    numbers = np.asarray(boxes, dtype=np.float64).reshape(len(boxes), -1)
    if numbers.shape[1] < 7:
        raise ValueError(f"boxes of {numbers.shape[1]} numbers")
    return InfoFrame(token, numbers[:, :3])


def _unpickle(path: Path) -> Any:
    try:
        with open(path, "rb") as file:
            return _PlainUnpickler(file).load()
    except FileNotFoundError:
        raise FrameError(path, "info file must exist, got no such file") from None
    except _RefusedError as error:
        raise FrameError(path, f"info file must hold plain values and NumPy arrays only, got {error}") from None
    # Damage shows as UnpicklingError, EOFError, ValueError, IndexError, MemoryError, ...
    except Exception as error:
        raise FrameError(path, f"info file must be a readable pickle, got {type(error).__name__}: {error}") from None


class _RefusedError(Exception):
    """A pickle asks for something that is neither a plain value nor an array."""


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        # NumPy 2 moved numpy.core to numpy._core.
        found = _ALLOWED.get((module.replace("numpy._core", "numpy.core"), name))
        if found is None:
            raise _RefusedError(f"{module}.{name}")
        return found

    def persistent_load(self, pid: Any) -> NoReturn:
        raise _RefusedError("a persistent id")


class _Dtype:
    """Stands for ``numpy.dtype``, whose own way to take its state from a damaged pickle crashes."""

    def __init__(self, text: str, *rest: object) -> None:
        if not re.fullmatch(r"[a-zA-Z?]\d*", text):
            raise ValueError(f"array of type {text}")
        self._text = text
        self._order = "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._order = str(state[1])

    def to_numpy(self) -> np.dtype[Any]:
        dtype = np.dtype(self._text)
        if dtype.kind not in "biuf":
            raise ValueError(f"array of type {self._text}")
        return dtype.newbyteorder({"<": "<", ">": ">"}.get(self._order, "="))  # type: ignore[arg-type]


class _Array:
    """Stands for ``numpy.ndarray``: shape, type and bytes, of which `to_numpy` makes the array if it is numeric."""

    def __init__(self, *arguments: object) -> None:
        """Of an array without its state nothing is known: ``_reconstruct`` makes one, and the state follows."""
        self._state: tuple[Any, ...] = (1, (0,), None, False, b"")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._state = state

    def to_numpy(self) -> NDArray[Any]:
        _, shape, dtype, is_fortran, data = self._state
        if not (isinstance(dtype, _Dtype) and isinstance(data, bytes | bytearray)):
            raise ValueError("an array of objects")
        return np.frombuffer(bytes(data), dtype.to_numpy()).reshape(shape, order="F" if is_fortran else "C")


def _array_from_buffer(
    data: object, dtype: object, shape: object, order: object, axis_order: object = None
) -> _Array | None:
    if axis_order is not None:
        return None
    array = _Array()
    array.__setstate__((1, shape, dtype, order == "F", data))
    return array


def _scalar(dtype: _Dtype, data: object = b"") -> Any:
    """A number; None for scalars of other types, which are not looked at."""
    try:
        (number,) = np.frombuffer(data, dtype.to_numpy())  # type: ignore[call-overload]
    except ValueError:
        return None
    return number


def _encode(text: str, encoding: str) -> bytes:
    """Bytes, as pickles of protocols 0 to 2 spell them."""
    if encoding != "latin1":
        raise _RefusedError(f"_codecs.encode to {encoding}")
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _array_from_buffer,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
    **{
        (module, kind.__name__): kind
        for module in ("builtins", "__builtin__")
        for kind in (set, frozenset, bytes, bytearray, complex)
    },
}
