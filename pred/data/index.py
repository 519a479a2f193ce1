# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The frame index of a data set: files, times, poses and boxes of all frames in one memory-mapped file.

Reading the tables of a large data set takes a minute and gigabytes; its index opens in a moment, and the processes that
use it share its pages. The file is a cache: it names the tables that it was made from with their sizes and
modification times, and is made anew when one of them has changed, or when its checksum shows that it is damaged.

The file holds Arrow IPC streams, one after the other, one per table of `SCHEMAS`, each with one record batch. The first
one's metadata tells the format's version and the sources. The last four bytes are the CRC-32 of all before them, lowest
byte first. Paths are relative to the root of the data set. A pose is a translation (metres) and a unit quaternion
w, x, y, z.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.ipc
from numpy.typing import NDArray

from pred.checkpoint import atomic_write, remove_leftovers
from pred.data.frame import Frame, FrameError, pose_matrix

FILE_NAME = "pred_index.arrow"
FORMAT_VERSION = 2
"""Counts changes of `SCHEMAS` and of what the columns mean; files of another version are made anew."""

_CHECKSUM_BYTES = 4
_CHUNK_BYTES = 1 << 22
_METADATA_KEY = b"pred_index"
_POSE = pa.list_(pa.float64(), 7)
_READING = [("path", pa.string()), ("time_us", pa.int64()), ("calibration", pa.int32()), ("pose", pa.int32())]
_IMAGE = pa.struct([*_READING, ("width", pa.int32()), ("height", pa.int32())])
_BOX = pa.struct([("name", pa.string()), ("pose", _POSE), ("size_lwh", pa.list_(pa.float64(), 3))])

SCHEMAS = {
    "calibrations": pa.schema(
        [
            ("channel", pa.string()),
            ("pose", _POSE),
            ("intrinsics", pa.list_(pa.float64(), 9)),
            ("distortion", pa.list_(pa.float64())),
        ]
    ),
    "poses": pa.schema([("pose", _POSE)]),
    "sweeps": pa.schema([*_READING, ("previous", pa.int32()), ("frame", pa.int32())]),
    "frames": pa.schema(
        [
            ("token", pa.string()),
            ("recording", pa.string()),
            ("sweep", pa.int32()),
            ("images", pa.list_(_IMAGE)),
            ("annotated", pa.uint8()),
            ("boxes", pa.list_(_BOX)),
        ]
    ),
}

Stamp = dict[str, Any]


@dataclass
class Calibrations:
    """Mounted sensors, C in all.

    Attributes:
        channel: [C] name of the sensor.
        pose: [C, 7] vehicle from sensor.
        intrinsics: [C, 3, 3] of cameras; zero for others.
        distortion: [C] lists of coefficients; empty for undistorted images.
    """

    channel: pa.StringArray
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    distortion: pa.ListArray


@dataclass
class Readings:
    """Files that sensors wrote, n in all.

    Attributes:
        path: [n] file.
        time_us: [n] microseconds.
        calibration: [n] row of `Calibrations`.
        pose: [n] row of `FrameIndex.poses`, the vehicle at that time; -1: not known.
    """

    path: pa.StringArray
    time_us: NDArray[np.int64]
    calibration: NDArray[np.int32]
    pose: NDArray[np.int32]


@dataclass
class Sweeps(Readings):
    """LiDAR sweeps.

    Attributes:
        previous: [n] row of the sweep before; -1 where a recording starts.
        frame: [n] frame whose own sweep it is; -1 for sweeps in between.
    """

    previous: NDArray[np.int32]
    frame: NDArray[np.int32]


@dataclass
class Images(Readings):
    """Camera images; frame f owns rows ``offsets[f]:offsets[f + 1]``.

    Attributes:
        width, height: [n] pixels; 0 where only the image's header tells.
        offsets: [F + 1].
    """

    width: NDArray[np.int32]
    height: NDArray[np.int32]
    offsets: NDArray[np.int32]


@dataclass
class IndexedBoxes:
    """Annotated boxes, m in all; frame f owns rows ``offsets[f]:offsets[f + 1]``.

    Attributes:
        name: [m] category.
        pose: [m, 7] from box to the world (nuScenes) or to the frame's LiDAR (ONCE), as the data set has it.
        size_lwh: [m, 3] metres.
        offsets: [F + 1].
        annotated: [F] whether somebody looked for objects in the frame.
    """

    name: pa.StringArray
    pose: NDArray[np.float64]
    size_lwh: NDArray[np.float64]
    offsets: NDArray[np.int32]
    annotated: NDArray[np.bool_]


@dataclass
class FrameIndex:
    """What a reader knows of a data set without opening its sensor files.

    Attributes:
        calibrations: sensors.
        poses: [P, 7] world from vehicle.
        sweeps: LiDAR sweeps of all recordings.
        token: [F] identities of the frames.
        recording: [F] scene or sequence that a frame belongs to.
        sweep: [F] row of a frame's own sweep; -1: it has none.
        images: images of the frames.
        boxes: annotated boxes of the frames.
    """

    calibrations: Calibrations
    poses: NDArray[np.float64]
    sweeps: Sweeps
    token: pa.StringArray
    recording: pa.StringArray
    sweep: NDArray[np.int32]
    images: Images
    boxes: IndexedBoxes

    def __len__(self) -> int:
        return len(self.token)

    def frames_of(self, recordings: set[str]) -> NDArray[np.int64]:
        """Rows of the frames that belong to the named recordings, in order."""
        mask = pc.is_in(self.recording, value_set=strings(sorted(recordings)))
        return np.flatnonzero(mask.to_numpy(zero_copy_only=False))


class IndexedFrames:
    """What the readers of data sets with an index have in common; they set the three attributes.

    Attributes:
        root: folder of the data set.
        _index: the index of all its frames.
        _rows: [n] rows of the index that are this source's frames, in order.
    """

    root: Path
    _index: FrameIndex
    _rows: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self._rows)

    def token(self, index: int) -> str:
        """Identity of frame ``index``."""
        return str(self._index.token[self._row(index)])

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_index"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In another process the file is opened again, instead of sending its content there."""
        vars(self).update(state)
        self._index = self._open_index()

    def load(self, index: int) -> Frame:
        """Frame ``index``."""
        raise NotImplementedError

    def _open_index(self) -> FrameIndex:
        raise NotImplementedError

    def _row(self, index: int) -> int:
        """Row of the index of frame ``index``."""
        if not 0 <= index < len(self):
            raise IndexError(f"index must be in [0, {len(self)}), got {index}")
        return int(self._rows[index])

    def _file(self, readings: Readings, row: int) -> Path:
        return self.root / str(readings.path[row])


def open_index(folder: Path, sources: Sequence[Path], build: Callable[[], FrameIndex]) -> FrameIndex:
    """The index of the data set whose tables lie in ``folder``; made first where it is missing, out of date or damaged.

    It lies in ``folder``, or in the user's cache folder (``$XDG_CACHE_HOME/pred``) where that cannot be written. Of
    several processes one makes it, the others wait.

    Args:
        folder: folder of the tables.
        sources: files below it that the index depends on.
        build: reads them.

    Raises:
        FrameError: a table is missing or damaged, or the index can be written nowhere.
    """
    places = index_files(folder)
    index = _first_fresh(places, _stamp(folder, sources))
    if index is not None:
        return index
    with _locked(folder):
        stamp = _stamp(folder, sources)  # before they are read: what changes from now on makes the index stale
        index = _first_fresh(places, stamp)
        return index if index is not None else _write_and_open(places, build(), stamp)


def index_files(folder: Path) -> tuple[Path, Path]:
    """Where the index of a table folder may lie, the preferred place first."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    name = hashlib.blake2b(str(folder.resolve()).encode(), digest_size=8).hexdigest()
    return folder / FILE_NAME, cache / "pred" / f"{name}-{FILE_NAME}"


def write_index(path: Path, index: FrameIndex, stamp: Stamp) -> None:
    """Write an index file, atomically. ``stamp`` tells what it was made from."""
    metadata = {_METADATA_KEY: json.dumps({"version": FORMAT_VERSION, "sources": stamp}).encode()}
    with atomic_write(path) as file:
        for name, columns in _columns(index).items():
            schema = SCHEMAS[name].with_metadata(metadata)
            metadata = {}
            with pa.ipc.new_stream(file, schema) as writer:
                writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
        file.flush()
        file.write(_checksum(Path(file.name), file.tell()))


def read_index(path: Path, stamp: Stamp) -> FrameIndex | None:
    """Open an index file; None where there is none, or none of this format and of these sources.

    Warns:
        UserWarning: the file is damaged; None.
    """
    try:
        return _read_index(path, stamp)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, pa.ArrowException) as error:
        warnings.warn(f"{path}: index must be intact, got {error}; it is made anew", UserWarning, stacklevel=2)
        return None


def _read_index(path: Path, stamp: Stamp) -> FrameIndex | None:
    with pa.memory_map(str(path)) as source:
        header = json.loads((pa.ipc.open_stream(source).schema.metadata or {}).get(_METADATA_KEY, b"null"))
        if header != {"version": FORMAT_VERSION, "sources": stamp}:
            return None
        # Read and not mapped: the pages do not become this process's.
        size = source.size() - _CHECKSUM_BYTES
        source.seek(size)
        if source.read() != _checksum(path, size):
            raise ValueError("a wrong checksum")
        source.seek(0)
        batches: dict[str, pa.RecordBatch] = {}
        for name, schema in SCHEMAS.items():
            reader = pa.ipc.open_stream(source)
            if not reader.schema.equals(schema):
                raise ValueError(f"another schema of {name}")
            (batches[name],) = reader
            _require_sound(batches[name])
        return _from_batches(batches)


def _checksum(path: Path, size: int) -> bytes:
    """CRC-32 of the first ``size`` bytes of a file."""
    crc = 0
    with open(path, "rb") as file:
        while size > 0 and (chunk := file.read(min(size, _CHUNK_BYTES))):
            crc = zlib.crc32(chunk, crc)
            size -= len(chunk)
    return crc.to_bytes(_CHECKSUM_BYTES, "little")


def rigid(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] matrix of one pose of an index, [7]."""
    return pose_matrix(pose[:3], pose[3:])


def strings(values: Sequence[str]) -> pa.StringArray:
    """A column of texts."""
    return pa.array(values, pa.string())


def number_lists(values: Sequence[Sequence[float]]) -> pa.ListArray:
    """A column of lists of numbers."""
    return pa.array(values, pa.list_(pa.float64()))


def offsets_of(owner: NDArray[np.integer[Any]], num_frames: int) -> NDArray[np.int32]:
    """[F + 1] offsets of the rows of each frame, once they are sorted by the frame that owns them."""
    counts = np.bincount(owner, minlength=num_frames)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _first_fresh(places: Sequence[Path], stamp: Stamp) -> FrameIndex | None:
    return next((index for place in places if (index := read_index(place, stamp)) is not None), None)


def _write_and_open(places: Sequence[Path], built: FrameIndex, stamp: Stamp) -> FrameIndex:
    errors = []
    for place in places:
        try:
            if place is not places[0]:
                place.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(place)
            write_index(place, built, stamp)
        except OSError as error:
            errors.append(str(error))
            continue
        index = read_index(place, stamp)
        if index is not None:
            return index
        errors.append(f"{place} cannot be read back")
    raise FrameError(places[0], f"index must be writable there or in $XDG_CACHE_HOME, got {'; '.join(errors)}")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One process at a time; without effect where the file system has no locks."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # no such folder: reading its tables will say so
        yield
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError:
            pass
        yield
    finally:
        os.close(descriptor)


def _stamp(folder: Path, sources: Sequence[Path]) -> Stamp:
    return {str(path.relative_to(folder)): _size_and_time(path) for path in sources}


def _size_and_time(path: Path) -> list[int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return [status.st_size, status.st_mtime_ns]


def _columns(index: FrameIndex) -> dict[str, list[pa.Array]]:
    calibrations, sweeps, images, boxes = index.calibrations, index.sweeps, index.images, index.boxes
    image_fields = [*_reading_columns(images), pa.array(images.width), pa.array(images.height)]
    box_fields = [boxes.name, _fixed(boxes.pose), _fixed(boxes.size_lwh)]
    return {
        "calibrations": [
            calibrations.channel,
            _fixed(calibrations.pose),
            _fixed(calibrations.intrinsics.reshape(-1, 9)),
            calibrations.distortion,
        ],
        "poses": [_fixed(index.poses)],
        "sweeps": [*_reading_columns(sweeps), pa.array(sweeps.previous), pa.array(sweeps.frame)],
        "frames": [
            index.token,
            index.recording,
            pa.array(index.sweep),
            _lists(images.offsets, pa.StructArray.from_arrays(image_fields, fields=list(_IMAGE))),
            pa.array(boxes.annotated.view(np.uint8)),
            _lists(boxes.offsets, pa.StructArray.from_arrays(box_fields, fields=list(_BOX))),
        ],
    }


def _require_sound(batch: pa.RecordBatch) -> None:
    """
    Raises:
        ValueError: a text or a list of the batch reaches outside of the file.
    """
    batch.validate()  # of offsets, it looks at the first and the last only
    columns = list(batch.columns)
    while columns:
        column = columns.pop()
        if pa.types.is_struct(column.type):
            columns += [column.field(number) for number in range(column.type.num_fields)]
        elif pa.types.is_list(column.type):
            columns.append(column.values)
        if pa.types.is_list(column.type) or pa.types.is_string(column.type):
            offsets = np.frombuffer(column.buffers()[1] or b"", dtype=np.int32)[: len(column) + 1]
            if not (offsets[1:] >= offsets[:-1]).all():
                raise ValueError("offsets must not descend")


def _from_batches(batches: dict[str, pa.RecordBatch]) -> FrameIndex:
    calibrations, frames, sweeps = batches["calibrations"], batches["frames"], batches["sweeps"]
    images, boxes = frames.column("images"), frames.column("boxes")
    return FrameIndex(
        calibrations=Calibrations(
            channel=calibrations.column("channel"),
            pose=_matrix(calibrations.column("pose")),
            intrinsics=_matrix(calibrations.column("intrinsics")).reshape(-1, 3, 3),
            distortion=calibrations.column("distortion"),
        ),
        poses=_matrix(batches["poses"].column("pose")),
        sweeps=Sweeps(
            **_readings(sweeps.column),
            previous=_numbers(sweeps.column("previous")),
            frame=_numbers(sweeps.column("frame")),
        ),
        token=frames.column("token"),
        recording=frames.column("recording"),
        sweep=_numbers(frames.column("sweep")),
        images=Images(
            **_readings(images.values.field),
            width=_numbers(images.values.field("width")),
            height=_numbers(images.values.field("height")),
            offsets=_numbers(images.offsets),
        ),
        boxes=IndexedBoxes(
            name=boxes.values.field("name"),
            pose=_matrix(boxes.values.field("pose")),
            size_lwh=_matrix(boxes.values.field("size_lwh")),
            offsets=_numbers(boxes.offsets),
            annotated=_numbers(frames.column("annotated")).view(np.bool_),
        ),
    )


def _reading_columns(readings: Readings) -> list[pa.Array]:
    return [readings.path, *(pa.array(column) for column in (readings.time_us, readings.calibration, readings.pose))]


def _readings(column: Callable[[str], pa.Array]) -> dict[str, Any]:
    return {"path": column("path"), **{name: _numbers(column(name)) for name in ("time_us", "calibration", "pose")}}


def _lists(offsets: NDArray[np.int32], values: pa.Array) -> pa.ListArray:
    return pa.ListArray.from_arrays(pa.array(offsets), values)


def _fixed(matrix: NDArray[np.float64]) -> pa.FixedSizeListArray:
    return pa.FixedSizeListArray.from_arrays(pa.array(matrix.ravel()), matrix.shape[1])


def _matrix(column: pa.FixedSizeListArray) -> NDArray[np.float64]:
    return _numbers(column.values).reshape(-1, column.type.list_size)


def _numbers(column: pa.Array) -> NDArray[Any]:
    """A view, without a copy."""
    numbers: NDArray[Any] = column.to_numpy(zero_copy_only=True)
    return numbers
