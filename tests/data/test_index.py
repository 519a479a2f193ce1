# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The index file: what is written is read, nothing stale is used, and it finds a place."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import pickle
import signal
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pytest

from pred.data import index as index_module
from pred.data.frame import FrameError
from pred.data.index import FILE_NAME, FORMAT_VERSION, SCHEMAS, FrameIndex, index_files, read_index, write_index
from pred.data.nuscenes import NuScenesFrames, build_index
from tests.data.tiny_tree import Tree, write_tree


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tree:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return write_tree(tmp_path / "root", scenes=("scene-a", "scene-b"))


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Table folders, once for each time that one is read."""
    folders: list[Path] = []

    def counted(tables: Path) -> FrameIndex:
        folders.append(tables)
        return build_index(tables)

    monkeypatch.setattr("pred.data.nuscenes.build_index", counted)
    return folders


def leaves(value: Any) -> Iterator[Any]:
    if is_dataclass(value):
        for field in fields(value):
            yield from leaves(getattr(value, field.name))
    else:
        yield value


def equal(one: FrameIndex, other: FrameIndex) -> bool:
    for a, b in zip(leaves(one), leaves(other), strict=True):
        same = a.equals(b) if isinstance(a, pa.Array) else np.array_equal(a, b) and a.dtype == b.dtype
        if not same:
            return False
    return True


def test_round_trip(tree: Tree, tmp_path: Path) -> None:
    built = build_index(tree.tables)
    path = tmp_path / "file.arrow"
    stamp = {"table.json": [3, 4]}
    write_index(path, built, stamp)
    opened = read_index(path, stamp)
    assert opened is not None and equal(opened, built)
    assert len(opened) == 4 and opened.token.to_pylist() == tree.tokens
    assert opened.recording.to_pylist() == ["scene-a"] * 2 + ["scene-b"] * 2
    assert opened.frames_of({"scene-b", "other"}).tolist() == [2, 3]
    assert opened.sweeps.previous.tolist() == [-1, 0, 1, 2, -1, 4, 5, 6]
    assert opened.sweeps.frame.tolist() == [-1, 0, -1, 1, -1, 2, -1, 3] and opened.sweep.tolist() == [1, 3, 5, 7]
    assert opened.images.offsets.tolist() == [0, 2, 4, 6, 8] and opened.boxes.offsets.tolist() == [0, 1, 2, 3, 4]
    assert opened.images.path[1].as_py() == str(tree.images[0]["CAM_FRONT"].relative_to(tree.root))
    # Nothing is copied out of the file.
    assert not any(
        array.flags.owndata or array.flags.writeable for array in leaves(opened) if isinstance(array, np.ndarray)
    )
    assert [path.name for path in tmp_path.iterdir() if "partial" in path.name] == []


def test_any_arrow_library_reads_the_file(tree: Tree) -> None:
    NuScenesFrames(tree.root)
    with pa.memory_map(str(tree.tables / FILE_NAME)) as source:
        streams = {name: pa.ipc.open_stream(source).read_all() for name in SCHEMAS}
        assert source.tell() == source.size() - 4
        content = (tree.tables / FILE_NAME).read_bytes()
        assert int.from_bytes(content[-4:], "little") == zlib.crc32(content[:-4])
    header = json.loads(streams["calibrations"].schema.metadata[b"pred_index"])
    assert header["version"] == FORMAT_VERSION
    table = tree.tables / "sample_data.json"
    assert header["sources"]["sample_data.json"] == [table.stat().st_size, table.stat().st_mtime_ns]
    assert streams["frames"].column("boxes")[0][0]["name"].as_py() == "vehicle.car"
    for name, schema in SCHEMAS.items():
        assert streams[name].schema.equals(schema)


def test_an_empty_index(tmp_path: Path) -> None:
    tree = write_tree(tmp_path, scenes=())
    with pytest.raises(ValueError, match=r"data\.split must select samples .* got none: None"):
        NuScenesFrames(tree.root)
    assert (tree.tables / FILE_NAME).is_file()
    with pytest.raises(ValueError, match=r"got none: None"):
        NuScenesFrames(tree.root)


def test_tables_are_read_once(tree: Tree, builds: list[Path]) -> None:
    frames = NuScenesFrames(tree.root)
    again = NuScenesFrames(tree.root, split="second")
    assert builds == [tree.tables]
    assert [frames.token(index) for index in range(4)] == tree.tokens
    assert [again.token(index) for index in range(2)] == tree.tokens[2:]


@pytest.mark.parametrize("table", ["sensor", "sample", "ego_pose", "instance", "sample_annotation"])
def test_a_changed_table_makes_it_stale(tree: Tree, builds: list[Path], table: str) -> None:
    NuScenesFrames(tree.root)
    path = tree.tables / f"{table}.json"
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    NuScenesFrames(tree.root)
    assert len(builds) == 2
    path.write_text(path.read_text() + " ")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    NuScenesFrames(tree.root)
    NuScenesFrames(tree.root)
    assert len(builds) == 3
    path.unlink()
    with pytest.raises(FrameError, match=rf"{table}\.json: table must exist"):
        NuScenesFrames(tree.root)


def test_another_table_does_not(tree: Tree, builds: list[Path]) -> None:
    NuScenesFrames(tree.root)
    (tree.tables / "attribute.json").write_text("[ ]")
    NuScenesFrames(tree.root)
    assert len(builds) == 1


def test_a_new_answer_after_a_change(tree: Tree) -> None:
    assert NuScenesFrames(tree.root).load(0).boxes is not None
    tree.edit("category", lambda rows: rows[1].update(name="vehicle.bus"))
    boxes = NuScenesFrames(tree.root).load(0).boxes
    assert boxes is not None and boxes.names == ["vehicle.bus"]


def test_a_moved_root_keeps_its_index(tree: Tree, builds: list[Path]) -> None:
    NuScenesFrames(tree.root)
    moved = tree.root.rename(tree.root.parent / "moved")
    frame = NuScenesFrames(moved).load(0)
    assert len(builds) == 1 and frame.source.startswith(str(moved))


@pytest.mark.parametrize("damage", ["empty", "shorter than the checksum", "short", "tail", "text", "longer", "header"])
def test_damaged_files_are_made_anew(tree: Tree, builds: list[Path], damage: str) -> None:
    before = NuScenesFrames(tree.root).load(0)
    path = tree.tables / FILE_NAME
    content = path.read_bytes()
    changed = {
        "empty": b"",
        "shorter than the checksum": b"xy",
        "short": content[:100],
        "tail": content[:-900],
        "text": b"something else",
        "longer": content + b"\0",
        "header": content.replace(b'"sources"', b'"sources '),
    }
    path.write_bytes(changed[damage])
    with pytest.warns(UserWarning, match=rf"{path}: index must be intact, got .*; it is made anew"):
        after = NuScenesFrames(tree.root).load(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        NuScenesFrames(tree.root)
    assert len(builds) == 2 and path.read_bytes() == content
    assert np.array_equal(after.T_world_from_lidar, before.T_world_from_lidar)


def test_a_file_of_another_version_is_made_anew(tree: Tree, builds: list[Path]) -> None:
    NuScenesFrames(tree.root)
    path = tree.tables / FILE_NAME
    content = path.read_bytes()
    number = f'"version": {FORMAT_VERSION}'.encode()
    path.write_bytes(content.replace(number, b'"version": 0'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        NuScenesFrames(tree.root)
    assert len(builds) == 2 and path.read_bytes() == content


def test_no_changed_bit_is_trusted(tree: Tree, tmp_path: Path) -> None:
    """Wherever it is: in numbers, texts, offsets, the structure or the checksum itself."""
    path = tmp_path / "file.arrow"
    stamp = {"table.json": [3, 4]}
    write_index(path, build_index(tree.tables), stamp)
    content = bytearray(path.read_bytes())
    number = np.float64(build_index(tree.tables).poses[0, 0]).tobytes()
    places = [content.index(number) + 6, *range(0, len(content), 37), *range(len(content) - 4, len(content))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for place in places:
            content[place] ^= 0x10
            path.write_bytes(content)
            assert read_index(path, stamp) is None, place
            content[place] ^= 0x10
    path.write_bytes(content)
    assert read_index(path, stamp) is not None


@pytest.mark.parametrize("column", ["token", "path"])
def test_texts_that_reach_outside_of_the_file(tree: Tree, tmp_path: Path, column: str) -> None:
    """Reading one would end the process."""
    built = build_index(tree.tables)
    owner: Any = built if column == "token" else built.images
    texts = getattr(owner, column)
    offsets = np.arange(len(texts) + 1, dtype=np.int32)
    write_index(tmp_path / "good.arrow", built, {})
    assert read_index(tmp_path / "good.arrow", {}) is not None
    for wrong in (1 << 30, -5):
        offsets[1] = wrong
        buffers = pa.py_buffer(offsets.copy()), pa.py_buffer(b"x" * len(texts))
        setattr(owner, column, pa.StringArray.from_buffers(len(texts), *buffers))
        write_index(tmp_path / "bad.arrow", built, {})
        with pytest.warns(UserWarning, match="index must be intact"):
            assert read_index(tmp_path / "bad.arrow", {}) is None


@contextmanager
def _refuse(path: Path, folder: Path) -> Iterator[IO[bytes]]:
    if path.parent == folder:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    with _ATOMIC_WRITE(path) as file:
        yield file


_ATOMIC_WRITE = index_module.atomic_write


def test_cache_folder_where_the_tables_are_read_only(
    tree: Tree, builds: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "atomic_write", lambda path: _refuse(path, tree.tables))
    NuScenesFrames(tree.root)
    assert NuScenesFrames(tree.root).load(3).token == tree.tokens[3]
    assert len(builds) == 1
    beside, cached = index_files(tree.tables)
    assert not beside.exists() and cached.is_file() and cached.is_relative_to(tree.root.parent / "cache" / "pred")


def test_no_place_at_all(tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    (tree.root.parent / "cache").write_text("a file")
    monkeypatch.setattr(index_module, "atomic_write", lambda path: _refuse(path, tree.tables))
    with pytest.raises(
        FrameError, match=r"index must be writable there or in \$XDG_CACHE_HOME, got .*Permission denied"
    ):
        NuScenesFrames(tree.root)


def test_a_failed_build_leaves_nothing(tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise RuntimeError("killed")

    before = sorted(tree.tables.iterdir())
    monkeypatch.setattr(index_module.pa.ipc, "new_stream", fail)
    with pytest.raises(RuntimeError, match="killed"):
        NuScenesFrames(tree.root)
    assert sorted(tree.tables.iterdir()) == before


def _die_while_writing(root: Path) -> None:
    os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[assignment]
    NuScenesFrames(root)


def test_a_killed_build_is_done_again(tree: Tree) -> None:
    before = sorted(tree.tables.iterdir())
    process = multiprocessing.get_context("fork").Process(target=_die_while_writing, args=(tree.root,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    left = sorted(set(tree.tables.iterdir()) - set(before))
    assert [path.suffix for path in left] == [".partial"]
    NuScenesFrames(tree.root)
    assert sorted(tree.tables.iterdir()) == sorted([*before, tree.tables / FILE_NAME])


def test_another_process_opens_the_file_itself(tree: Tree, builds: list[Path]) -> None:
    frames = NuScenesFrames(tree.root, split="second")
    sent = pickle.dumps(frames)
    assert len(sent) < 2000
    received = pickle.loads(sent)
    assert len(builds) == 1
    assert np.array_equal(received.load(1).points, frames.load(1).points)


def _open(root: Path, barrier: Any, results: Any) -> None:
    def counted(tables: Path) -> FrameIndex:
        results.put("built")
        return build_index(tables)

    import pred.data.nuscenes

    pred.data.nuscenes.build_index = counted  # type: ignore[assignment]
    barrier.wait()
    results.put(NuScenesFrames(root).token(0))


def test_of_processes_that_start_together_one_builds(tree: Tree) -> None:
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(3), context.Queue()
    processes = [context.Process(target=_open, args=(tree.root, barrier, results)) for _ in range(3)]
    for process in processes:
        process.start()
    answers = sorted(results.get(timeout=60) for _ in range(4))
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert answers == ["built", *[tree.tokens[0]] * 3]
