# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""ONCE evaluation: the official results (PRED_TEST_FIXTURES), cases worked out by hand, files and errors."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pred import cli
from pred.data.frame import Boxes, FrameError
from pred.data.once_writer import OnceRecord, write_once, write_once_splits
from pred.evaluate_once import (
    BINS_M,
    MIN_IOU,
    By,
    FrameBoxes,
    Iou,
    average_precisions,
    evaluate_once,
    pair_ious,
    score_thresholds,
    with_means,
)
from pred.ops import reference

CAR = [10.0, 5.0, -1.0, 4.0, 2.0, 1.5, 0.3]


def frame(*boxes: list[float], name: str = "Car", scores: list[float] | None = None) -> FrameBoxes:
    values = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    return FrameBoxes(None, [name] * len(values), values, np.array(scores or [0.5] * len(values), dtype=np.float64))


def at(x: float, y: float = 0.0, yaw: float = 0.0, **sizes: float) -> list[float]:
    return [x, y, -1.0, sizes.get("l", 4.0), sizes.get("w", 2.0), sizes.get("h", 1.5), yaw]


def ap(
    truth: list[FrameBoxes], predictions: list[FrameBoxes], by: By = "superclass", iou: Iou = "official"
) -> dict[str, float]:
    return dict(average_precisions(truth, predictions, by, iou))


def vehicle(truth: list[FrameBoxes], predictions: list[FrameBoxes], iou: Iou = "official") -> float:
    return ap(truth, predictions, "superclass", iou)["AP_Vehicle/overall"]


# The official results


@pytest.mark.parametrize(
    ("case", "by", "iou", "table"),
    [
        ("perfect", "superclass", "official", "superclass"),
        ("perfect", "class", "official", "classes"),
        ("noisy", "superclass", "official", "superclass"),
        ("noisy", "class", "official", "classes"),
        ("noisy", "superclass", "true", "superclass_true_ccw_iou"),
        ("noisy", "class", "true", "classes_true_ccw_iou"),
    ],
)
def test_official_results(once_golden: dict[str, Any], tmp_path: Path, case: str, by: By, iou: Iou, table: str) -> None:
    (tmp_path / "truth.json").write_text(json.dumps(once_golden["gt"]))
    (tmp_path / "predictions.json").write_text(json.dumps(once_golden["cases"][case]["pred"]))
    result = evaluate_once(tmp_path / "predictions.json", tmp_path / "truth.json", by=by, iou=iou)
    expected = once_golden["cases"][case]["result"][table]
    assert result["ap"].keys() == expected.keys()
    for key, value in expected.items():
        assert result["ap"][key] == pytest.approx(value, abs=1e-9), key


# By hand


def test_perfect_predictions() -> None:
    truth = [frame(at(10), at(0, 40), at(-55, 10)), frame(), frame(at(8, 8, 2.0))]
    assert ap(truth, truth)["AP_Vehicle/overall"] == pytest.approx(100)
    for by in MIN_IOU:
        values = ap(truth, truth, by=by)
        name = "Vehicle" if by == "superclass" else "Car"
        assert {key for key, value in values.items() if value == pytest.approx(100)} == {
            f"AP_{name}/{bin_name}" for bin_name in BINS_M
        }
        # Without any box of the truth the official evaluation counts 0, in the mean too.
        assert with_means(values, by)["AP_mean/overall"] == pytest.approx(100 / len(MIN_IOU[by]))


def test_no_predictions_and_no_truth() -> None:
    truth = [frame(at(10)), frame(at(20))]
    assert vehicle(truth, [frame(), frame()]) == 0
    assert vehicle([frame(), frame()], truth) == 0
    assert vehicle([frame()], [frame()]) == 0
    assert vehicle([], []) == 0


def test_precision_and_recall_by_hand() -> None:
    truth = [frame(at(10), at(20))]
    hits, wrong = [at(10), at(20)], at(0, 20)
    # The two hits make recall 1/2 and 1; levels up to 3/4, midway, are read at the first: 1 to 37 of 50.
    for score, expected in ((0.95, 100 * 2 / 3), (0.7, 2 * (37 + 13 * 2 / 3)), (0.3, 100.0)):
        found = [frame(*hits, wrong, scores=[0.9, 0.5, score])]
        assert vehicle(truth, found) == pytest.approx(expected)
    # One of two is found: recall ends at 1/2.
    assert vehicle(truth, [frame(hits[0])]) == pytest.approx(50)
    # One prediction serves one box.
    assert vehicle([frame(at(10), at(10.1))], [frame(at(10))]) == pytest.approx(50)
    # Twice the same box: the second is wrong, but scores less.
    assert vehicle(truth, [frame(*hits, hits[0], scores=[0.9, 0.5, 0.4])]) == pytest.approx(100)
    assert vehicle(truth, [frame(*hits, hits[0], scores=[0.9, 0.5, 0.8])]) == pytest.approx(2 * (37 + 13 * 2 / 3))


def test_thresholds_by_hand() -> None:
    assert len(score_thresholds(np.array([0.5]), 1)) == 51
    thresholds = score_thresholds(np.array([0.5, 0.9]), 2)
    assert len(thresholds) == 51 and (thresholds[:38] == 0.9).all() and (thresholds[38:] == 0.5).all()
    assert len(score_thresholds(np.array([0.5]), 2)) == 26
    assert len(score_thresholds(np.zeros(0), 3)) == 0
    many = score_thresholds(np.linspace(0, 1, 500), 500)
    assert len(many) == 51 and (np.diff(many) < 0).all()


def test_shifted_box() -> None:
    truth = [frame(at(10))]
    # IoU of a 4 m box moved by d along itself: (4 - d) / (4 + d); 0.7 at d = 0.7059.
    assert vehicle(truth, [frame(at(10.70))]) == pytest.approx(100)
    assert vehicle(truth, [frame(at(10.71))]) == 0
    (value,) = pair_ious(truth, [frame(at(10.7))]).iou
    assert value == pytest.approx(3.3 / 4.7)


def test_orientation() -> None:
    truth = [frame(at(10, yaw=0.2))]
    for iou in ("official", "true"):
        assert vehicle(truth, [frame(at(10, yaw=0.2 + 2 * math.pi))], iou) == pytest.approx(100)
        assert vehicle(truth, [frame(at(10, yaw=0.2 + math.pi))], iou) == 0
        assert vehicle(truth, [frame(at(10, yaw=0.2 - math.pi))], iou) == 0
    # A square box turned by a quarter is the same box; a little more is another heading.
    square = [frame(at(10, l=2, w=2))]
    assert vehicle(square, [frame(at(10, yaw=math.pi / 2, l=2, w=2))]) == pytest.approx(100)
    assert vehicle(square, [frame(at(10, yaw=math.pi / 2 + 1e-6, l=2, w=2))]) == 0
    # More than a full turn apart: the official code takes any heading then.
    assert len(pair_ious(truth, [frame(at(10, yaw=0.2 + 3 * math.pi))], "official").iou) == 1
    assert len(pair_ious(truth, [frame(at(10, yaw=0.2 + 3 * math.pi))], "true").iou) == 0


def test_official_iou_turns_boxes_clockwise() -> None:
    # Moved sideways, seen along the true heading; along the length, where the heading is taken the other way round.
    angle = math.pi / 4
    a = [0.0, 0.0, 0.0, 4.0, 1.0, 1.0, angle]
    b = [-0.5 * math.sin(angle), 0.5 * math.cos(angle), 0.0, 4.0, 1.0, 1.0, angle]
    assert pair_ious([frame(a)], [frame(b)], "true").iou == pytest.approx([0.5 / 1.5])
    assert pair_ious([frame(a)], [frame(b)], "official").iou == pytest.approx([3.5 / 4.5])


def test_pairs_are_all_that_overlap() -> None:
    rng = np.random.default_rng(0)
    frames = []
    for count in (30, 0, 40, 20):
        boxes = np.concatenate([rng.uniform(-5, 5, (count, 3)), rng.uniform(0.5, 6, (count, 4))], axis=1)
        frames.append(frame(*boxes.tolist()))
    pairs = pair_ious(frames, frames[::-1], "true")
    expected = {}
    for truth, found, first_truth, first in zip(frames, frames[::-1], (0, 30, 30, 70), (0, 20, 60, 60), strict=True):
        iou = reference.box_iou_3d(torch.from_numpy(truth.boxes), torch.from_numpy(found.boxes)).numpy()
        for i, a in enumerate(truth.boxes):
            for j, b in enumerate(found.boxes):
                turn = abs(math.remainder(a[6] - b[6], 2 * math.pi))
                if iou[i, j] > 0 and turn <= math.pi / 2:
                    expected[first_truth + i, first + j] = iou[i, j]
    assert len(expected) > 50
    got = {(i, j): iou for i, j, iou in zip(*(column.tolist() for column in pairs), strict=True)}
    assert got == pytest.approx(expected)
    assert list(zip(pairs.truth, pairs.prediction, strict=True)) == sorted(
        zip(pairs.truth, pairs.prediction, strict=True)
    )


def test_official_iou_ends_at_five_metres() -> None:
    a, b = at(0, l=40), at(5.1, l=40)
    assert pair_ious([frame(a)], [frame(b)], "true").iou == pytest.approx([34.9 / 45.1])
    assert len(pair_ious([frame(a)], [frame(b)], "official").iou) == 0
    assert len(pair_ious([frame(a)], [frame(at(5.0, l=40))], "official").iou) == 1


def test_boxes_outside_the_bin_are_ignored() -> None:
    # Truth at 29.9 m; the prediction lies at 30.1 m, in the next bin: neither hit, nor miss, nor wrong.
    values = ap([frame(at(29.9), at(10))], [frame(at(30.1), at(10), scores=[0.9, 0.5])])
    assert values["AP_Vehicle/overall"] == pytest.approx(100)
    # The near box of the truth that found the ignored prediction is not a miss, but gives no hit either.
    assert values["AP_Vehicle/0-30m"] == pytest.approx(50)
    assert values["AP_Vehicle/30-50m"] == 0
    # Nor does it make up for a wrong prediction: precision 1/2 up to recall 1/2.
    values = ap([frame(at(29.9), at(10))], [frame(at(30.1), at(10), at(0, 20), scores=[0.9, 0.5, 0.7])])
    assert values["AP_Vehicle/0-30m"] == pytest.approx(25)
    # Without a match, a prediction outside the bin costs nothing inside of it.
    values = ap([frame(at(10), at(40))], [frame(at(10), at(0, 45), at(40), scores=[0.5, 0.9, 0.4])])
    assert values["AP_Vehicle/0-30m"] == pytest.approx(100)
    assert values["AP_Vehicle/30-50m"] == pytest.approx(50)
    # Bounds belong to the farther bin; the range is that of the centre in space.
    [(x, z)] = [(math.sqrt(30.0**2 - 1), -1.0)]
    values = ap([frame([x, 0, z, 4, 2, 1.5, 0])], [frame([x, 0, z, 4, 2, 1.5, 0])])
    assert values["AP_Vehicle/30-50m"] + values["AP_Vehicle/0-30m"] == pytest.approx(100)
    assert ap([frame(at(30, 0))], [frame(at(30, 0))])["AP_Vehicle/0-30m"] == 0


def test_counted_predictions_go_before_ignored_ones() -> None:
    # Both predictions fit; the ignored one (30.1 m) fits better and comes first.
    truth = [frame(at(29.95))]
    values = ap(truth, [frame(at(30.1), at(29.6), scores=[0.9, 0.8])])
    # The highest score decides which hits set thresholds: the ignored one, so there is none.
    assert values["AP_Vehicle/0-30m"] == 0
    # The other way round there are two, and at the lower one all three predictions are there to be chosen.
    values = ap([frame(at(29.95), at(10))], [frame(at(30.1), at(29.6), at(10), scores=[0.8, 0.9, 0.5])])
    assert values["AP_Vehicle/0-30m"] == pytest.approx(100)


def test_out_of_bin_boxes_of_other_classes_are_ignored_not_rejected() -> None:
    """A quirk of the official code: a far pedestrian of the truth absorbs a car that is predicted there."""
    truth = [frame(at(10)), frame(at(29.9), name="Pedestrian")]
    truth[1].boxes[0, 0] = 30.1
    predicted = [frame(at(10), scores=[0.5]), frame(at(29.9), scores=[0.9])]
    values = ap(truth, predicted)
    assert values["AP_Vehicle/0-30m"] == pytest.approx(100)  # absorbed
    assert values["AP_Vehicle/overall"] == pytest.approx(50)  # wrong


def test_classes_and_super_class() -> None:
    truth = [frame(at(10), name="Car")]
    predicted = [frame(at(10), name="Truck")]
    assert vehicle(truth, predicted) == pytest.approx(100)
    values = ap(truth, predicted, by="class")
    assert values["AP_Car/overall"] == values["AP_Truck/overall"] == 0
    assert vehicle(truth, [frame(at(10), name="Vehicle")]) == pytest.approx(100)
    assert vehicle(truth, [frame(at(10), name="Pedestrian")]) == 0
    # Thresholds: 0.3 for pedestrians, 0.5 for cyclists; a 4 m box moved by 2 m has 1/3, by 1.3 m 0.51.
    for name, shift, found in (("Pedestrian", 2.0, 100), ("Cyclist", 2.0, 0), ("Cyclist", 1.3, 100)):
        values = ap([frame(at(10), name=name)], [frame(at(10 + shift), name=name)])
        assert values[f"AP_{name}/overall"] == pytest.approx(found)


def test_equal_and_degenerate_boxes_give_finite_values() -> None:
    flat = [10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    truth = [frame(CAR, CAR, flat)]
    values = ap(truth, [frame(CAR, CAR, flat, flat, scores=[0.9, 0.9, 0.9, 0.9])])
    assert np.isfinite(list(values.values())).all()
    # Two of three boxes found, two predictions wrong.
    assert values["AP_Vehicle/overall"] == pytest.approx(2 * 33 * 0.5)


def test_frames_do_not_mix() -> None:
    truth = [frame(at(10)), frame(at(20))]
    assert vehicle(truth, [frame(at(20)), frame(at(10))]) == 0
    with pytest.raises(ValueError):
        vehicle(truth, [frame()])


# Files


def entry(frame_id: str | None, *boxes: list[float], **changes: Any) -> dict[str, Any]:
    content = {"name": ["Car"] * len(boxes), "score": [0.5] * len(boxes), "boxes_3d": list(boxes)} | changes
    return content if frame_id is None else {"frame_id": frame_id, **content}


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    points = np.ones((5, 4), dtype=np.float32)
    boxes = [
        Boxes(np.array([CAR[:3]]), np.array([CAR[3:6]]), np.array([CAR[6]]), ["Car"]),
        None,
        Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), []),
    ]
    write_once(tmp_path / "tree", "000027", [OnceRecord(1000 + n, points, boxes=boxes[n]) for n in range(3)])
    write_once(tmp_path / "tree", "000028", [OnceRecord(2000 + n, points, boxes=boxes[n]) for n in range(2)])
    write_once_splits(tmp_path / "tree", {"val": ["000027"]})
    return tmp_path / "tree"


def test_truth_of_a_tree(tree: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    # Any order; frames that nobody annotated may be among them.
    predictions = write(tmp_path / "p.json", [entry("1001", CAR), entry("1002"), entry("1000", CAR)])
    assert cli.main(["evaluate", "once", str(predictions), "--truth", str(tree), "--split", "val"]) == 0
    output = capfd.readouterr().out
    for text in ("Vehicle", "100.00", "33.33", "30-50m", "2 frame(s), 1 predictions, official IoU"):
        assert text in output
    assert "no box of the truth, so 0, which the mean includes: Vehicle/30-50m, " in output
    assert "1 predicted frame(s) are not in the truth and do not count" in output
    assert f"written: {tmp_path / 'p_ap.json'}" in output
    result = json.loads((tmp_path / "p_ap.json").read_text())
    assert result["ap"]["AP_Vehicle/overall"] == pytest.approx(100) and result["frames"] == 2
    assert result["ap"]["AP_mean/0-30m"] == pytest.approx(100 / 3)
    assert result["true_boxes"]["Vehicle/0-30m"] == 1 and result["true_boxes"]["Cyclist/overall"] == 0
    assert result["predicted_frames_without_truth"] == 1 and result["split"] == "val"


def test_options(tree: Path, tmp_path: Path) -> None:
    frames = [entry("1000", CAR), entry("1002"), entry("2000", CAR)]
    predictions, output = write(tmp_path / "p.json", frames), tmp_path / "out.json"
    arguments = ["evaluate", "once", str(predictions), "--truth", str(tree)]
    assert cli.main([*arguments, "--by", "class", "--iou", "true", "--output", str(output)]) == 0
    result = json.loads(output.read_text())
    assert (result["by"], result["iou"], result["frames"]) == ("class", "true", 3)
    assert result["ap"]["AP_Car/overall"] == pytest.approx(100) and len(result["ap"]) == 24


def test_help_of_evaluations(capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, texts in (
        (["--help"], ("rendering  RUN: ", "once       PREDICTIONS: ")),
        (["once", "--help"], ("pred evaluate once", "--truth", "{superclass,class}", "{official,true}")),
        (["rendering", "--help"], ("pred evaluate rendering", "--frames", "RUN")),
    ):
        with pytest.raises(SystemExit) as stopped:
            cli.main(["evaluate", *arguments])
        assert stopped.value.code == 0
        output = capfd.readouterr().out
        assert all(text in output for text in texts), output
    with pytest.raises(SystemExit) as stopped:
        cli.main(["evaluate", "onse"])
    assert stopped.value.code == 2 and "invalid choice: 'onse'" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({}, "must be a list of {frame_id, name, score, boxes_3d}, got another structure"),
        ([3], "must be a list of"),
        ([entry("1000", CAR, name=["Tram"])], r"entry 0 (frame 1000): name must be one of Bus, Car, .*, got 'Tram'"),
        (
            [{"frame_id": "1000", "name": [], "score": []}],
            "(frame 1000) must have the key 'boxes_3d', got none",
        ),
        ([entry("1000", CAR, score=[])], "entry 0 (frame 1000): name, score and boxes_3d must be of one length"),
        (
            [entry("1000", CAR[:6])],
            "with 7 numbers per box, got 1 names, scores [1], boxes [1, 6]",
        ),
        ([entry("1000", CAR, score=["high"])], "entry 0 (frame 1000) must hold lists of names and numbers, got"),
        ([entry("1000", [*CAR[:6], float("nan")])], "entry 0 (frame 1000): score and boxes_3d must be finite"),
        ([entry("1000", CAR, score=[float("inf")])], "entry 0 (frame 1000): score and boxes_3d must be finite"),
        ([entry("1000", [0, 0, 0, 1, -2, 1, 0])], "entry 0 (frame 1000): sizes of boxes must not be negative, got -2"),
        ([entry("1000"), entry("1000")], "frame_id must be unique, got 1000 twice"),
        ([entry("1000"), entry(None)], "every entry must have a frame_id, got none in entry 1"),
        ([entry("1002")], "got none for 1 of 2 frames, first 1000"),
    ],
)
def test_wrong_predictions(tree: Path, tmp_path: Path, content: Any, text: str) -> None:
    predictions = write(tmp_path / "p.json", content)
    before, _, after = text.partition(".*")
    with pytest.raises(FrameError) as caught:
        evaluate_once(predictions, tree, split="val")
    message = str(caught.value)
    assert message.startswith(f"{predictions}: ") and before in message and message.endswith(after)
    assert not (tmp_path / "p_ap.json").exists()


def test_vehicle_is_no_class(tree: Path, tmp_path: Path) -> None:
    predictions = write(tmp_path / "p.json", [entry("1000", CAR, name=["Vehicle"]), entry("1002")])
    assert evaluate_once(predictions, tree, split="val")["ap"]["AP_Vehicle/overall"] == pytest.approx(100)
    with pytest.raises(FrameError, match="name must be one of Bus, Car, Cyclist, Pedestrian, Truck, got 'Vehicle'"):
        evaluate_once(predictions, tree, split="val", by="class")


def test_wrong_files(tree: Path, tmp_path: Path) -> None:
    predictions = write(tmp_path / "p.json", [entry(None, CAR)])
    truth = write(tmp_path / "t.json", [entry(None, CAR), entry(None)])
    with pytest.raises(FrameError, match=rf"p\.json: must have the 2 frames of {truth}, got 1 \(and no frame_id\)"):
        evaluate_once(predictions, truth)
    with pytest.raises(ValueError, match="split must only be given for a ONCE tree, got 'val' for"):
        evaluate_once(predictions, truth, split="val")
    with pytest.raises(ValueError, match="output must lie in an existing folder, got .*nowhere/x.json"):
        evaluate_once(predictions, truth, output=tmp_path / "nowhere" / "x.json")
    with pytest.raises(FrameError, match=r"none\.json: file of boxes must exist, got no such file"):
        evaluate_once(tmp_path / "none.json", truth)
    with pytest.raises(FrameError, match=r"absent: file of boxes must exist, got no such file"):
        evaluate_once(predictions, tmp_path / "absent")
    write_once(tmp_path / "bare", "000001", [OnceRecord(1, np.ones((1, 4), dtype=np.float32))])
    with pytest.raises(FrameError, match=r"bare: must hold annotated frames in split None, got none of 1 frames"):
        evaluate_once(predictions, tmp_path / "bare")
    (tree / "ImageSets" / "val.txt").write_text("000027\n000029\n")
    with pytest.raises(FrameError, match=r"000029\.json: file of the sequence must exist"):
        evaluate_once(predictions, tree, split="val")
