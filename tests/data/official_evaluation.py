# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The evaluations of nuscenes-devkit on a world's own truth, as it is or changed by a known amount."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

Change = Callable[[dict[str, Any]], None]


def predictions(devkit: Any, split: str, change: Change) -> dict[str, Any]:
    utils = pytest.importorskip("nuscenes.eval.detection.utils")
    names = json.loads((Path(devkit.table_root) / "splits.json").read_text())[split]
    results: dict[str, list[dict[str, Any]]] = {}
    for sample in devkit.sample:
        if devkit.get("scene", sample["scene_token"])["name"] not in names:
            continue
        boxes = results.setdefault(sample["token"], [])
        for token in sample["anns"]:
            annotation = devkit.get("sample_annotation", token)
            name = utils.category_to_detection_name(annotation["category_name"])
            if name is None or annotation["num_lidar_pts"] == 0:
                continue
            attributes = [devkit.get("attribute", attribute)["name"] for attribute in annotation["attribute_tokens"]]
            box = {
                "sample_token": sample["token"],
                "translation": list(annotation["translation"]),
                "size": list(annotation["size"]),
                "rotation": list(annotation["rotation"]),
                "velocity": devkit.box_velocity(token)[:2].tolist(),
                "detection_name": name,
                "detection_score": 1.0 - 1e-3 * len(boxes),
                "attribute_name": attributes[0] if attributes else "",
            }
            change(box)
            boxes.append(box)
    meta = {f"use_{sensor}": sensor == "lidar" for sensor in ("camera", "lidar", "radar", "map", "external")}
    return {"meta": meta, "results": results}


def evaluate(devkit: Any, split: str, folder: Path, change: Change) -> dict[str, Any]:
    config = pytest.importorskip("nuscenes.eval.common.config")
    official = pytest.importorskip("nuscenes.eval.detection.evaluate")
    (folder / "results.json").write_text(json.dumps(predictions(devkit, split, change)))
    evaluation = official.DetectionEval(
        devkit,
        config.config_factory("detection_cvpr_2019"),
        str(folder / "results.json"),
        split,
        str(folder / "evaluation"),
        verbose=False,
    )
    metrics, _ = evaluation.evaluate()
    found: dict[str, Any] = metrics.serialize()
    return found


def check_perturbed(devkit: Any, folder: Path, shift_m: float, before: Change = lambda box: None) -> None:
    """Boxes that are shifted, too large, turned and too fast give those errors, and are found all the same.

    ``shift_m`` must bring no box nearer to another one's truth; ``before`` changes each box first.
    """
    quaternion = pytest.importorskip("pyquaternion").Quaternion

    def change(box: dict[str, Any]) -> None:
        before(box)
        box["translation"][0] += shift_m
        box["size"] = [1.1 * side for side in box["size"]]
        box["rotation"] = (quaternion(axis=[0, 0, 1], radians=0.1) * quaternion(box["rotation"])).elements.tolist()
        box["velocity"][1] += 0.4

    found = evaluate(devkit, "all", folder, change)
    assert found["mean_ap"] == pytest.approx(1.0, abs=1e-6)
    assert found["tp_errors"] == pytest.approx(
        {"trans_err": shift_m, "scale_err": 1 - 1.1**-3, "orient_err": 0.1, "vel_err": 0.4, "attr_err": 0.0}, abs=1e-6
    )


def evaluate_true_lidarseg(devkit: Any, split: str, folder: Path) -> dict[str, Any]:
    """Result of the official lidarseg evaluation for predictions that are the world's own labels."""
    official = pytest.importorskip("nuscenes.eval.lidarseg.evaluate")
    mapper = official.LidarsegClassMapper(devkit)
    results = folder / "results" / "lidarseg" / split
    results.mkdir(parents=True)
    for record in devkit.lidarseg:
        labels = np.fromfile(Path(devkit.dataroot) / record["filename"], np.uint8)
        points = devkit.get("sample_data", record["sample_data_token"])["filename"]
        assert len(labels) * 20 == (Path(devkit.dataroot) / points).stat().st_size
        # Predictions have no class 0; points of this class do not count.
        predicted = mapper.convert_label(labels).clip(1).astype(np.uint8)
        predicted.tofile(results / f"{record['sample_data_token']}_lidarseg.bin")
    found: dict[str, Any] = official.LidarSegEval(devkit, str(folder / "results"), split).evaluate()
    return found
