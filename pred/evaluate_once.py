# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred evaluate once PREDICTIONS`: average precision of 3D boxes as the ONCE benchmark counts it.

The rules are those of once_devkit (``once_eval/evaluation.py``), worked out here without a GPU and for all frames and
score thresholds at once. Per class and distance bin:

1. Boxes outside the bin are *ignored*: they cost nothing, and neither does what is matched to them. That holds for
   out-of-bin boxes of other classes too (a quirk, kept).
2. A prediction can match a box of the truth if their 3D IoU is above the class's threshold and their headings differ by
   at most 90 degrees. Boxes of the truth choose in file order.
3. Every box takes its highest-scoring free prediction; the scores of the hits give up to 51 thresholds, where recall
   passes 0, 1/50, ..., 1.
4. At each threshold every box takes the free prediction of largest IoU (an ignored one only where there is no other);
   precision = hits / (hits + free predictions left over).
5. AP = 100 times the mean, over thresholds 1 to 50, of the largest precision at that threshold or a later one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table

from pred.data.frame import FrameError
from pred.data.once import CLASSES, OnceFrames
from pred.data.tables import read_json
from pred.ops import box_iou_3d
from pred.progress import Progress
from pred.run_folder import write_json

By = Literal["superclass", "class"]
Iou = Literal["official", "true"]

VEHICLES = ("Car", "Bus", "Truck")
SUPERCLASS = "Vehicle"
MIN_IOU: dict[By, dict[str, float]] = {
    "superclass": {SUPERCLASS: 0.7, "Pedestrian": 0.3, "Cyclist": 0.5},
    "class": {"Car": 0.7, "Bus": 0.7, "Truck": 0.7, "Pedestrian": 0.3, "Cyclist": 0.5},
}
"""IoU that a match must exceed."""
BINS_M = {"overall": (0.0, math.inf), "0-30m": (0.0, 30.0), "30-50m": (30.0, 50.0), "50m-inf": (50.0, math.inf)}
"""Range of the box centre from the LiDAR, lower bound included."""
RECALL_POSITIONS = 50
OFFICIAL_MAX_DISTANCE_M = 5.0
"""The official IoU on the CPU is 0 for centres further apart."""

COUNTED, IGNORED, OTHER_CLASS = 0, 1, -1


@dataclass
class FrameBoxes:
    """Boxes of one frame, of the truth or predicted.

    Attributes:
        frame_id: the data set's name of the frame, or None where the file gives none.
        names: M class names.
        boxes: [M, 7] float64 x, y, z, length, width, height, yaw in the LiDAR frame.
        scores: [M] float64; zeros for the truth.
    """

    frame_id: str | None
    names: list[str]
    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]


def evaluate_once(
    predictions: Path,
    truth: Path,
    split: str | None = None,
    by: By = "superclass",
    iou: Iou = "official",
    output: Path | None = None,
) -> dict[str, Any]:
    """Compare a file of predictions with a ONCE tree or a file, print the table and write it as JSON.

    Args:
        predictions: JSON list with an entry {frame_id, name, score, boxes_3d} per frame.
        truth: root of a ONCE tree, whose annotated frames are taken, or a JSON list with entries {frame_id, name,
            boxes_3d}. Without any frame_id in both files, frames correspond by their order.
        split: list in ImageSets/ of the tree; None: all sequences.
        by: superclass counts Car, Bus and Truck as Vehicle; class keeps them apart.
        iou: see `pair_ious`.
        output: file to write; ``<predictions>_ap.json`` by default.

    Returns:
        What the file holds: plain values, AP in percent.

    Raises:
        FrameError, ValueError: a file is missing or damaged, or frames do not correspond; the text names it.
    """
    output = predictions.with_name(f"{predictions.stem}_ap.json") if output is None else output
    if not output.parent.is_dir():
        raise ValueError(f"output must lie in an existing folder, got {output}")
    known = {*CLASSES, SUPERCLASS} if by == "superclass" else {*CLASSES}
    expected = read_truth(truth, split, known)
    predicted = read_boxes(predictions, known, with_scores=True)
    found = align(predicted, predictions, expected, truth)
    unused = len(predicted) - len(found)
    columns = len(MIN_IOU[by]) * len(BINS_M)
    with Progress("evaluated column", columns) as progress:
        ap = {}
        for key, value in average_precisions(expected, found, by, iou):
            ap[key] = value
            progress.advance()
        counts = ground_truth_counts(expected, by)
        result = {
            "predictions": str(predictions),
            "truth": str(truth),
            "split": split,
            "by": by,
            "iou": iou,
            "frames": len(expected),
            "predicted_frames_without_truth": unused,
            "predicted_boxes": sum(len(frame.names) for frame in found),
            "true_boxes": counts,
            "ap": with_means(ap, by),
        }
        write_json(output, result)
        progress.console.print(results_table(result))
        empty = [key for key, count in counts.items() if count == 0]
        if empty:
            progress.message(f"no box of the truth, so 0, which the mean includes: {', '.join(empty)}")
        if unused:
            progress.message(f"{unused} predicted frame(s) are not in the truth and do not count")
        progress.message(f"written: {output}")
    return result


# Files


def read_truth(path: Path, split: str | None, known: set[str]) -> list[FrameBoxes]:
    """Annotated frames of a ONCE tree (a folder) or the frames of a JSON file."""
    if not path.is_dir():
        if split is not None:
            raise ValueError(f"split must only be given for a ONCE tree, got {split!r} for {path}")
        return read_boxes(path, known, with_scores=False)
    source = OnceFrames(path, split=split, labels="none")
    frames = []
    for index in range(len(source)):
        annotation = source.annotation(index)
        if annotation is not None:
            names, boxes = annotation
            frames.append(FrameBoxes(source.frame_id(index), names, boxes, np.zeros(len(names))))
    if not frames:
        raise FrameError(path, f"must hold annotated frames in split {split}, got none of {len(source)} frames")
    return frames


def read_boxes(path: Path, known: set[str], with_scores: bool) -> list[FrameBoxes]:
    """Frames of a JSON list with entries {frame_id, name, score, boxes_3d}.

    Raises:
        FrameError: the file is missing or damaged, or an entry breaks a rule; the text says which.
    """
    entries = read_json(path, "file of boxes")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FrameError(path, "must be a list of {frame_id, name, score, boxes_3d}, got another structure")
    return [_read_entry(path, number, entry, known, with_scores) for number, entry in enumerate(entries)]


def align(
    predictions: list[FrameBoxes], predictions_path: Path, truth: list[FrameBoxes], truth_path: Path
) -> list[FrameBoxes]:
    """The predictions in the order of the truth: by frame_id, or by their order where neither file has any.

    Raises:
        FrameError: a frame has no entry or several, or the numbers of frames differ.
    """
    if not any(frame.frame_id for frame in [*predictions, *truth]):
        if len(predictions) != len(truth):
            raise FrameError(
                predictions_path,
                f"must have the {len(truth)} frames of {truth_path}, got {len(predictions)} (and no frame_id)",
            )
        return predictions
    by_id = _by_id(predictions, predictions_path)
    missing = [frame_id for frame_id in _by_id(truth, truth_path) if frame_id not in by_id]
    if missing:
        raise FrameError(
            predictions_path,
            f"must have an entry for every frame of {truth_path} (an empty one where nothing was found), "
            f"got none for {len(missing)} of {len(truth)} frames, first {missing[0]}",
        )
    return [by_id[str(frame.frame_id)] for frame in truth]


def _by_id(frames: list[FrameBoxes], path: Path) -> dict[str, FrameBoxes]:
    by_id: dict[str, FrameBoxes] = {}
    for number, frame in enumerate(frames):
        if frame.frame_id is None:
            raise FrameError(path, f"every entry must have a frame_id, got none in entry {number}")
        if frame.frame_id in by_id:
            raise FrameError(path, f"frame_id must be unique, got {frame.frame_id} twice")
        by_id[frame.frame_id] = frame
    return by_id


def _read_entry(path: Path, number: int, entry: dict[str, Any], known: set[str], with_scores: bool) -> FrameBoxes:
    frame_id = None if entry.get("frame_id") is None else str(entry["frame_id"])
    where = f"entry {number}" + (f" (frame {frame_id})" if frame_id else "")
    try:
        names = [str(name) for name in entry["name"]]
        boxes = np.asarray(entry["boxes_3d"], dtype=np.float64)
        scores = np.asarray(entry["score"], dtype=np.float64) if with_scores else np.zeros(len(names))
    except KeyError as error:
        raise FrameError(path, f"{where} must have the key {error}, got none") from None
    except (TypeError, ValueError, OverflowError) as error:
        raise FrameError(path, f"{where} must hold lists of names and numbers, got {error}") from None
    unknown = sorted({*names} - known)
    if unknown:
        raise FrameError(path, f"{where}: name must be one of {', '.join(sorted(known))}, got {unknown[0]!r}")
    if boxes.size == 0:
        boxes = boxes.reshape(0, 7)
    if boxes.shape != (len(names), 7) or scores.shape != (len(names),):
        raise FrameError(
            path,
            f"{where}: name, score and boxes_3d must be of one length, with 7 numbers per box, "
            f"got {len(names)} names, scores {list(scores.shape)}, boxes {list(boxes.shape)}",
        )
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise FrameError(path, f"{where}: score and boxes_3d must be finite, got NaN or Inf")
    if not (boxes[:, 3:6] >= 0).all():
        raise FrameError(path, f"{where}: sizes of boxes must not be negative, got {boxes[:, 3:6].min():g}")
    return FrameBoxes(frame_id, names, boxes, scores)


# Matching


class Pairs(NamedTuple):
    """Boxes of the truth and predictions of the same frame that overlap, in the order of truth, then prediction.

    Rows count through the boxes of all frames, one after the other.
    """

    truth: NDArray[np.int64]  # [K] row
    prediction: NDArray[np.int64]  # [K] row
    iou: NDArray[np.float64]  # [K] > 0


def average_precisions(
    truth: Sequence[FrameBoxes], predictions: Sequence[FrameBoxes], by: By = "superclass", iou: Iou = "official"
) -> Iterator[tuple[str, float]]:
    """("AP_<class>/<bin>", AP in percent) for every class and bin; 0 where the truth holds no box.

    Args:
        truth, predictions: the same frames in the same order; boxes in the LiDAR frame, metres.
        by, iou: as in `evaluate_once`.
    """
    pairs = pair_ious(truth, predictions, iou)
    truth_boxes, truth_names = _joined(truth)
    boxes, names = _joined(predictions)
    scores = np.concatenate([np.zeros(0), *(frame.scores for frame in predictions)])
    for class_name, min_iou in MIN_IOU[by].items():
        for bin_name, bounds_m in BINS_M.items():
            truth_state = _states(truth_boxes, truth_names, class_name, bounds_m)
            state = _states(boxes, names, class_name, bounds_m)
            kept = (
                (pairs.iou > min_iou)
                & (truth_state[pairs.truth] != OTHER_CLASS)
                & (state[pairs.prediction] != OTHER_CLASS)
            )
            candidates = Pairs._make(column[kept] for column in pairs)
            hit_scores = _scores_of_hits(candidates, truth_state, state, scores)
            thresholds = score_thresholds(hit_scores, int(np.count_nonzero(truth_state == COUNTED)))
            precision = np.zeros(RECALL_POSITIONS + 1)
            precision[: len(thresholds)] = _precisions(candidates, truth_state, state, scores, thresholds)
            interpolated = np.maximum.accumulate(precision[::-1])[::-1]
            yield f"AP_{class_name}/{bin_name}", float(interpolated[1:].mean() * 100)


def pair_ious(truth: Sequence[FrameBoxes], predictions: Sequence[FrameBoxes], iou: Iou = "official") -> Pairs:
    """3D IoU of all pairs of one frame whose headings differ by at most 90 degrees.

    ``official`` does what the official code does, for comparison with published figures: it turns boxes clockwise by
    their yaw, where labels mean counter-clockwise; sets pairs with centres more than 5 m apart to 0; and does not wrap
    heading differences beyond 360 degrees. ``true`` is the IoU of the boxes.
    """
    truth_rows, rows = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    first_truth = first = 0
    for expected, found in zip(truth, predictions, strict=True):
        near_truth, near = np.nonzero(_may_overlap(expected.boxes, found.boxes))
        truth_rows.append(near_truth + first_truth)
        rows.append(near + first)
        first_truth, first = first_truth + len(expected.names), first + len(found.names)
    truth_row, row = np.concatenate(truth_rows), np.concatenate(rows)
    a, b = _joined(truth)[0][truth_row], _joined(predictions)[0][row]
    turn = np.abs(a[:, 6] - b[:, 6])
    if iou == "official":
        turn = np.where(turn >= np.pi, 2 * np.pi - turn, turn)
        allowed = (turn <= np.pi / 2) & (np.linalg.norm(a[:, :3] - b[:, :3], axis=1) <= OFFICIAL_MAX_DISTANCE_M)
        clockwise = np.array([1, 1, 1, 1, 1, 1, -1])
        a, b = a * clockwise, b * clockwise
    else:
        turn = turn % (2 * np.pi)
        allowed = np.minimum(turn, 2 * np.pi - turn) <= np.pi / 2
    iou_3d = box_iou_3d(torch.from_numpy(a), torch.from_numpy(b), aligned=True).numpy()
    values = np.where(allowed, iou_3d, 0.0)
    kept = values > 0
    return Pairs(truth_row[kept], row[kept], values[kept])


def score_thresholds(hit_scores: NDArray[np.float64], num_truth: int) -> NDArray[np.float64]:
    """[<= 51] scores, falling, at which recall passes 0, 1/50, ..., 1, midway between two hits; one score may serve
    several levels.

    Args:
        hit_scores: [H] scores of hits, in any order.
        num_truth: counted boxes of the truth, at least H.
    """
    step = 1 / RECALL_POSITIONS
    thresholds: list[float] = []
    level = 0.0
    falling = np.sort(hit_scores)[::-1]
    for number, score in enumerate(falling, start=1):
        last = number == len(falling)
        twice_midway = number / num_truth + (number if last else number + 1) / num_truth
        if twice_midway < 2 * level and not last:
            continue
        thresholds.append(float(score))
        level += step
        while twice_midway + 1e-6 > 2 * level:  # the official margin against rounding
            thresholds.append(float(score))
            level += step
    return np.array(thresholds[: RECALL_POSITIONS + 1])


def _scores_of_hits(
    pairs: Pairs, truth_state: NDArray[np.int64], state: NDArray[np.int64], scores: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[H] scores of the hits when every box of the truth takes its highest-scoring free prediction."""
    taken = np.zeros(len(scores), dtype=np.bool_)
    hits = []
    for group in _groups(pairs.truth):
        free = pairs.prediction[group]
        free = free[~taken[free]]
        if len(free):
            best = free[scores[free].argmax()]
            taken[best] = True
            if truth_state[pairs.truth[group.start]] == COUNTED and state[best] == COUNTED:
                hits.append(scores[best])
    return np.array(hits)


def _precisions(
    pairs: Pairs,
    truth_state: NDArray[np.int64],
    state: NDArray[np.int64],
    scores: NDArray[np.float64],
    thresholds: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[T] precision at each threshold; 0 where nothing counts."""
    distinct, column_of = np.unique(thresholds, return_inverse=True)
    columns = np.arange(len(distinct))
    above = scores[:, None] >= distinct  # [predictions, distinct]
    taken = np.zeros_like(above)
    hits = np.zeros(len(distinct), dtype=np.int64)
    for group in _groups(pairs.truth):
        rows = pairs.prediction[group]
        free = above[rows] & ~taken[rows]
        counted = free & (state[rows] == COUNTED)[:, None]
        is_hit = counted.any(axis=0)
        best = np.where(counted, pairs.iou[group, None], 0.0).argmax(axis=0)
        # Without a counted prediction the first ignored one.
        choice = np.where(is_hit, best, free.argmax(axis=0))
        matched = free.any(axis=0)
        taken[rows[choice[matched]], columns[matched]] = True
        if truth_state[pairs.truth[group.start]] == COUNTED:
            hits += is_hit
    left_over = (above & ~taken & (state == COUNTED)[:, None]).sum(axis=0)
    counted_in_all = hits + left_over
    precision = np.divide(hits, counted_in_all, out=np.zeros(len(distinct)), where=counted_in_all > 0)
    return precision[column_of]


def _groups(truth_rows: NDArray[np.int64]) -> list[slice]:
    """Slices of a sorted array with equal entries."""
    bounds = [0, *(np.flatnonzero(np.diff(truth_rows)) + 1).tolist(), len(truth_rows)]
    return [slice(start, end) for start, end in zip(bounds[:-1], bounds[1:], strict=True) if start < end]


def _may_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[A, B] mask: the circles around two boxes, seen from above, meet."""
    reach = (np.hypot(a[:, 3], a[:, 4])[:, None] + np.hypot(b[:, 3], b[:, 4])) / 2
    offset = a[:, None, :2] - b[:, :2]
    meet: NDArray[np.bool_] = np.hypot(offset[..., 0], offset[..., 1]) <= reach
    return meet


def _states(
    boxes: NDArray[np.float64], names: NDArray[np.str_], class_name: str, bounds_m: tuple[float, float]
) -> NDArray[np.int64]:
    """[M] COUNTED, IGNORED or OTHER_CLASS."""
    members = (*VEHICLES, SUPERCLASS) if class_name == SUPERCLASS else (class_name,)
    range_m = np.linalg.norm(boxes[:, :3], axis=1)
    inside = (range_m >= bounds_m[0]) & (range_m < bounds_m[1])
    return np.where(inside, np.where(np.isin(names, members), COUNTED, OTHER_CLASS), IGNORED)


def _joined(frames: Sequence[FrameBoxes]) -> tuple[NDArray[np.float64], NDArray[np.str_]]:
    """Boxes [M, 7] and names [M] of all frames."""
    boxes = np.concatenate([np.zeros((0, 7)), *(frame.boxes for frame in frames)])
    return boxes, np.array([name for frame in frames for name in frame.names], dtype=np.str_)


# Report


def ground_truth_counts(truth: Sequence[FrameBoxes], by: By) -> dict[str, int]:
    """Boxes of the truth that count, by "<class>/<bin>"."""
    boxes, names = _joined(truth)
    return {
        f"{class_name}/{bin_name}": int(np.count_nonzero(_states(boxes, names, class_name, bounds_m) == COUNTED))
        for class_name in MIN_IOU[by]
        for bin_name, bounds_m in BINS_M.items()
    }


def with_means(ap: dict[str, float], by: By) -> dict[str, float]:
    """The APs and, as "AP_mean/<bin>", their means over the classes."""
    means = {f"AP_mean/{name}": float(np.mean([ap[f"AP_{cls}/{name}"] for cls in MIN_IOU[by]])) for name in BINS_M}
    return {**ap, **means}


def results_table(result: dict[str, Any]) -> Table:
    """AP by class and bin."""
    table = Table(title=f"{result['frames']} frame(s), {result['predicted_boxes']} predictions, {result['iou']} IoU")
    table.add_column("AP, %", justify="left")
    for name in BINS_M:
        table.add_column(name, justify="right")
    for row in (*MIN_IOU[result["by"]], "mean"):
        if row == "mean":
            table.add_section()
        table.add_row(row, *(f"{result['ap'][f'AP_{row}/{name}']:.2f}" for name in BINS_M))
    return table
