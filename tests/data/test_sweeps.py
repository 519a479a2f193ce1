# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pred
from pred.data import sweeps

EGO_BOX = (-1.0, -2.0, 1.0, 3.0)


@pytest.fixture(params=["host", "numpy"])
def place(request: pytest.FixtureRequest) -> Callable[..., Any]:
    if request.param == "host":
        if sweeps._host is None:
            pytest.skip("pred._host is not built for this Python")
        return sweeps.place_sweep
    return sweeps.place_sweep_reference


def test_hand_computed(place: Callable[..., Any]) -> None:
    """A quarter turn to the left and 10 m forward; the second point lies on the own car."""
    points = np.array([[5, 1, 0.5, 7, 31], [0, 2.9, 0, 9, 3], [0, 3.0, -1, 8, 2]], np.float32)
    T = np.array([[0, -1, 0, 0], [1, 0, 0, 10], [0, 0, 1, 2], [0, 0, 0, 1]], np.float64)
    placed, kept = place(points, T, EGO_BOX, 0.25)
    assert placed.dtype == np.float32 and kept.dtype == np.int64
    assert kept.tolist() == [0, 2]
    assert placed.tolist() == [[-1, 15, 2.5, 7, 0.25], [-3, 10, 1, 8, 0.25]]


@pytest.mark.parametrize("num_points", [0, 1, 1000])
def test_host_equals_numpy(num_points: int) -> None:
    if sweeps._host is None:
        pytest.skip("pred._host is not built for this Python")
    rng = np.random.default_rng(num_points)
    points = rng.uniform(-30, 30, (num_points, 5)).astype(np.float32)
    angle = 0.3
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = rng.uniform(-5, 5, 3)
    actual, actual_kept = sweeps.place_sweep(points, T, EGO_BOX, 0.05)
    expected, expected_kept = sweeps.place_sweep_reference(points, T, EGO_BOX, 0.05)
    assert np.array_equal(actual_kept, expected_kept)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=4e-6)  # one rounding to float32 at 40 m


def test_a_module_that_does_not_load_leaves_its_reason(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / f"_host{EXTENSION_SUFFIXES[0]}").write_bytes(b"junk")
    monkeypatch.setattr(pred, "__path__", [str(tmp_path)])
    monkeypatch.delattr(pred, "_host", raising=False)
    monkeypatch.delitem(sys.modules, "pred._host", raising=False)
    assert sweeps.__file__ is not None
    spec = importlib.util.spec_from_file_location("another_sweeps", sweeps.__file__)
    assert spec is not None and spec.loader is not None
    another = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(another)
    assert another._host is None and str(tmp_path / "_host") in another.HOST_ERROR
    points = np.array([[5, 1, 0.5, 7, 31]], np.float32)
    assert another.place_sweep(points, np.eye(4), EGO_BOX, 0.25)[0].tolist() == [[5, 1, 0.5, 7, 0.25]]


def test_shapes_are_checked() -> None:
    if sweeps._host is None:
        pytest.skip("pred._host is not built for this Python")
    with pytest.raises(ValueError, match=r"points must have shape \[N, >=4\]"):
        sweeps.place_sweep(np.zeros((3, 2), np.float32), np.eye(4), EGO_BOX, 0.0)
