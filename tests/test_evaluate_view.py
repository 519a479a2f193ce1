# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from pred import cli
from pred.config import plain
from pred.data.batch import TrainingBatches, build_source, evaluation_batch, evaluation_rows
from pred.data.frame import CLASS_NAMES, Boxes, Camera, Frame, FrameError, inside_range, outside_ego_box
from pred.data.image_depth import DepthMap
from pred.data.labels import PseudoLabel
from pred.data.lidarseg import MERGED_NAMES
from pred.data.masking import is_held_out
from pred.data.nuscenes import NuScenesFrames
from pred.evaluate import (
    Confusion,
    Scores,
    add_scores,
    error_summary,
    evaluate_rendering,
    range_of_nearest_visible,
    results_table,
    returns_of,
    shows_nearer_surface,
    trained_tokens,
)
from pred.models.pretrainer import Pretrainer, RenderedView
from pred.pretrain import PretrainConfig, pretrain
from pred.run_folder import RunFolder
from pred.view import (
    CLASS_COLOURS,
    FARTHEST_M,
    NEAREST_M,
    blank,
    class_colours,
    dimmed,
    distance_colours,
    draw_boxes,
    draw_points,
    faded,
    near_cells,
    pixel_rays,
    pixels_from_above,
    sdf_colours,
    view,
)
from pred.world import make_world
from tests.data.tiny_tree import write_tree
from tests.tiny_run import WORLD, tiny_config


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> PretrainConfig:
    """Of a run that has been trained a little."""
    config = tiny_config(tmp_path_factory.mktemp("runs") / "run", steps=150, lr=1e-2, checkpoint_every=1000)
    pretrain(config)
    return config


def run_of(config: PretrainConfig) -> Path:
    assert config.run is not None
    return Path(config.run)


# Evaluation


def test_evaluation_compares_trained_untrained_and_nearest(
    config: PretrainConfig, capfd: pytest.CaptureFixture[str]
) -> None:
    result = evaluate_rendering(config, run_of(config))
    assert json.loads((run_of(config) / "evaluation_rendering.json").read_text()) == result
    assert result["frames"] == 2 and result["skipped"] == {}
    trained, untrained = result["trained"], result["untrained"]
    assert trained["depth_mean_m"] < untrained["depth_mean_m"]
    assert trained["semantic_accuracy"] > untrained["semantic_accuracy"]
    assert 0 < result["nearest_visible"]["depth_median_m"] < result["nearest_visible"]["depth_mean_m"]
    ratio = trained["depth_mean_m"] / result["nearest_visible"]["depth_mean_m"]
    assert trained["depth_mean_over_nearest_visible"] == pytest.approx(ratio)
    assert sum(result["semantic_rays_by_class"].values()) == result["semantic_rays"]
    by_class = sum(
        trained["semantic_accuracy_by_class"][name] * n for name, n in result["semantic_rays_by_class"].items()
    )
    assert by_class / result["semantic_rays"] == pytest.approx(trained["semantic_accuracy"])
    output = capfd.readouterr().out
    for text in ("median absolute depth error", "untrained", "nearest visible", "semantic accuracy", "road ("):
        assert text in output


def test_evaluation_repeats_and_uses_the_checkpoint_asked_for(config: PretrainConfig, tmp_path: Path) -> None:
    first = evaluate_rendering(config, run_of(config), max_frames=1)
    assert evaluate_rendering(config, run_of(config), max_frames=1) == first
    assert first["frames"] == 1
    early = pretrain(tiny_config(tmp_path / "early", steps=1))
    other = evaluate_rendering(config, run_of(config), next(early.glob("checkpoints/*.pt")), max_frames=1)
    assert other["untrained"] == first["untrained"] and other["trained"] != first["trained"]


def test_evaluated_rays_are_the_held_out_returns_and_no_others(config: PretrainConfig) -> None:
    frame = build_source(config.data).load(0)
    batch = evaluation_batch(frame, config.data, config.point_range, seed=0)
    targets = (batch.depth.directions * batch.depth.depth_m[..., None])[0][batch.depth.valid[0]]
    held = frame.points[is_held_out(frame.point_index, frame.token, config.data.holdout_fraction), :3]
    distance = torch.cdist(targets.double(), torch.from_numpy(held).double()).min(dim=1).values
    assert len(targets) > 300 and distance.max() < 1e-3
    # Neither the input of the evaluation nor that of any training step holds one.
    steps = TrainingBatches(config.data, config.point_range, 0, 6)
    for points in [batch.points, *(steps[step].points for step in range(6) if steps[step].tokens == [frame.token])]:
        assert torch.cdist(points[:, :3].double(), torch.from_numpy(held).double()).min() > 1e-6


def test_scores_of_known_renderings(config: PretrainConfig) -> None:
    frame = build_source(config.data).load(0)
    batch = evaluation_batch(frame, config.data, config.point_range, seed=0)
    assert batch.semantic is not None
    semantics = batch.semantic
    target = semantics.target

    class Oracle:
        """Right about every class but the cars, which it does not see; 0.5 m too far everywhere."""

        def encode(self, points: Tensor, offsets: Tensor) -> Tensor:
            return points

        def render(self, bev: Tensor, origins: Tensor, directions: Tensor) -> RenderedView:
            if origins is semantics.origins:
                opacity = 1.0 - target[..., CLASS_NAMES.index("car")]
                return RenderedView(torch.zeros_like(opacity), opacity, target * opacity[..., None])
            opacity = torch.full_like(batch.depth.depth_m, 0.25)
            return RenderedView(batch.depth.depth_m + 0.5, opacity, torch.zeros(0))

    scores = Scores()
    add_scores(scores, Oracle(), batch)  # type: ignore[arg-type]
    summary = scores.summary()
    assert summary["depth_median_m"] == pytest.approx(0.5, abs=1e-5)
    assert summary["depth_mean_m"] == pytest.approx(0.5, abs=1e-5)
    assert summary["opacity_mean"] == pytest.approx(0.25)
    # A ray that sees nothing is wrong, whatever the first class is.
    by_class = summary["semantic_accuracy_by_class"]
    assert by_class.pop("car") == 0.0 and set(by_class.values()) == {1.0}
    cars = float((target.argmax(-1) == CLASS_NAMES.index("car"))[semantics.valid].float().mean())
    assert cars > 0 and summary["semantic_accuracy"] == pytest.approx(1 - cars)


def test_nearest_visible_point_by_hand() -> None:
    points = torch.tensor([[10.0, 0.0, 0.0], [0.0, 3.0, 4.0], [-1.0, 0.0, 0.0]])
    directions = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.8, 0.0]])
    # The third: 53.1 degrees to -x, acos(0.48) = 61.3 degrees to (0, 0.6, 0.8).
    assert range_of_nearest_visible(points, directions).tolist() == [10.0, 5.0, 1.0]
    assert range_of_nearest_visible(points, directions[:0]).shape == (0,)
    assert range_of_nearest_visible(points[:0], directions).isnan().all()


def test_nearest_visible_point_tells_a_thousandth_of_a_degree() -> None:
    angles = torch.deg2rad(torch.tensor([0.0, 0.001, 0.002], dtype=torch.float64))
    ranges = torch.tensor([5.0, 6.0, 7.0])
    points = (torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1) * ranges[:, None]).float()
    directions = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1).float()
    assert torch.allclose(range_of_nearest_visible(points, directions), ranges)


def test_nothing_to_measure_gives_none_and_no_warning() -> None:
    empty = Scores().summary()
    assert empty["depth_median_m"] is None and empty["semantic_accuracy"] is None and empty["opacity_mean"] is None
    assert error_summary(np.zeros(0, np.float32)) == {"depth_median_m": None, "depth_mean_m": None}
    result = {
        "frames": 1, "depth_rays": 0, "semantic_rays": 0, "semantic_rays_by_class": {}, "nearest_visible": {},
        "returns_by_class": {}, "projected_label": {}, "all_returns": False, "trained": empty, "untrained": empty,
    }  # fmt: skip
    assert results_table(result).row_count == 5


def test_lidar_only_run_is_evaluated_and_viewed(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config.data, "labels", "none")
    result = evaluate_rendering(config, run_of(config), max_frames=1)
    assert result["semantic_rays"] == 0 and result["trained"]["semantic_accuracy"] is None
    assert result["trained"]["depth_median_m"] > 0
    assert len(view(config, run_of(config), columns=8)) == 7


def test_rays_nearer_than_near_m_are_not_evaluated(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    everything = evaluate_rendering(config, run_of(config), max_frames=1)
    monkeypatch.setattr(config.renderer, "near_m", 8.0)
    far = evaluate_rendering(config, run_of(config), max_frames=1)
    assert 0 < far["depth_rays"] < everything["depth_rays"]


def test_broken_frames_are_skipped_on_request(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    load = NuScenesFrames.load

    def load_but_the_first(self: NuScenesFrames, index: int) -> Frame:
        if index == 0:
            raise FrameError("sweep.bin", "must hold points, got 3 bytes")
        return load(self, index)

    monkeypatch.setattr(NuScenesFrames, "load", load_but_the_first)
    with pytest.raises(FrameError, match=r"sweep\.bin: must hold points"):
        evaluate_rendering(config, run_of(config))
    monkeypatch.setattr(config.data, "on_error", "skip")
    result = evaluate_rendering(config, run_of(config))
    assert result["frames"] == 1 and result["skipped"] == {
        build_source(config.data).token(0): "sweep.bin: must hold points, got 3 bytes"
    }


def test_no_usable_frame_gives_no_figures(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    def load_nothing(self: NuScenesFrames, index: int) -> Frame:
        raise FrameError("sweep.bin", "must hold points, got 3 bytes")

    monkeypatch.setattr(NuScenesFrames, "load", load_nothing)
    monkeypatch.setattr(config.data, "on_error", "skip")
    result = evaluate_rendering(config, run_of(config))
    assert result["frames"] == result["depth_rays"] == result["semantic_rays"] == 0 and len(result["skipped"]) == 2
    for name in ("trained", "untrained", "nearest_visible"):
        assert result[name]["depth_mean_m"] is None and result[name]["depth_median_m"] is None
    assert result["trained"]["depth_mean_over_nearest_visible"] is None
    assert json.loads((run_of(config) / "evaluation_rendering.json").read_text()) == result


# True classes of returns


def test_data_without_classes_of_points_has_no_figures_of_them(
    config: PretrainConfig, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    tree = write_tree(tmp_path / "data")
    other = replace(config, data=replace(config.data, root=str(tree.root)))
    result = evaluate_rendering(other, run_of(config))
    assert result["depth_rays"] > 0 and result["semantic_rays"] > 0 and result["frames_trained_on"] == 0
    assert result["returns_by_class"] == result["projected_label"]["returns"] == {}
    assert result["trained"]["returns"] == result["untrained"]["returns"] == {}
    assert "class along the ray from the LiDAR" not in capfd.readouterr().out


def test_pixels_that_show_a_nearer_surface() -> None:
    z_depth_m = np.array([10.0, 10.0, 10.0, 10.0, 10.0])
    # Nearer by more than 0.5 m + 2 % of what the image shows: 9.3 + 0.5 + 0.186 < 10, 9.4 + 0.5 + 0.188 > 10.
    image_depth_m = np.array([9.3, 9.4, 2.0, 30.0, np.nan])
    assert shows_nearer_surface(z_depth_m, image_depth_m).tolist() == [True, False, True, False, False]


def test_confusion_by_hand() -> None:
    confusion = Confusion()
    names = {name: k for k, name in enumerate(MERGED_NAMES)}
    road, car = names["road"], names["car"]
    true = np.array([road, road, road, road, car, car, -1, -1])
    predicted = np.array([road, road, car, -1, car, names["bus"], road, -1])
    confusion.add(true, predicted)
    assert confusion.count_by_class() == {"road": 4, "car": 2}
    summary = confusion.summary()
    assert summary["accuracy"] == 0.5 and summary["mean_class_accuracy"] == 0.5
    # Intersections 2 and 1, unions 4 and 2 + 1: what is called a bus is missing, without a class of its own.
    assert summary["iou_by_class"] == pytest.approx({"road": 0.5, "car": 1 / 3})
    assert summary["miou"] == pytest.approx(5 / 12)
    assert Confusion().summary()["miou"] is None


def test_pixels_of_returns_by_hand(tmp_path: Path) -> None:
    """A camera at the LiDAR that looks along +x; a second one that looks the same way comes too late."""
    T_camera_from_lidar = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
    intrinsics = np.array([[10.0, 0, 10], [0, 10.0, 5], [0, 0, 1]])
    depth_m = np.full((10, 20), 20.0)
    depth_m[:, :10] = 5.0  # a wall on the left
    Image.fromarray((depth_m * 256).astype(np.uint16)).save(tmp_path / "depth.png")
    labels = np.full((10, 20), CLASS_NAMES.index("road"), dtype=np.uint8)
    labels[:, :10] = CLASS_NAMES.index("wall")
    labels[0] = 255

    def camera(label_map: NDArray[np.uint8]) -> Camera:
        return Camera(
            "camera", intrinsics, T_camera_from_lidar, 20, 10,
            labels=PseudoLabel(label_map, 20, 10), depth=DepthMap(tmp_path / "depth.png", 20, 10),
        )  # fmt: skip

    xyz = [(10, 5, 0), (5, 2, 0), (10, -5, 0), (10, -5, 4.5), (-10, 0, 0), (10, 5, 0)]
    points = np.zeros((6, 5), dtype=np.float32)
    points[:, :3] = np.array(xyz)
    names = ["car", "wall", "road", "vegetation", "car", None]
    semantics = np.array([255 if name is None else CLASS_NAMES.index(name) for name in names])
    cameras = [camera(labels), camera(np.zeros_like(labels))]
    frame = Frame("token", points, np.arange(6), np.ones(6, dtype=bool), cameras, semantics=semantics)
    found = returns_of(frame, np.arange(6))
    assert found is not None and found.occluded is not None
    merged = {name: k for k, name in enumerate(MERGED_NAMES)}
    manmade, road, car = merged["manmade"], merged["road"], merged["car"]
    assert found.merged.tolist() == [car, manmade, road, merged["vegetation"], car, -1]
    assert found.in_image.tolist() == [True, True, True, True, False, True]
    assert found.occluded.tolist() == [True, False, False, False, False, True]
    assert found.projected[:3].tolist() == [manmade, manmade, road]
    assert found.projected[3] == -1  # no label there
    assert {name: int(mask.sum()) for name, mask in found.groups().items()} == {"all": 6, "in_image": 5, "occluded": 2}
    assert returns_of(replace(frame, semantics=None), np.arange(6)) is None
    without_depth = returns_of(replace(frame, cameras=[replace(cameras[0], depth=None)]), np.arange(6))
    assert without_depth is not None and set(without_depth.groups()) == {"all", "in_image"}


def test_rendered_classes_are_compared_with_the_true_ones(config: PretrainConfig, tmp_path: Path) -> None:
    """A made world knows them, and its labels are exact: pixels are wrong by parallax only."""
    result = evaluate_rendering(config, run_of(config), max_frames=1)
    counts = result["returns_by_class"]
    assert set(counts) == {"all", "in_image"} and sum(counts["all"].values()) <= result["depth_rays"]
    assert set(result["projected_label"]["returns"]) == {"in_image"}
    assert result["projected_label"]["returns"]["in_image"]["accuracy"] > 0.8
    for name in ("trained", "untrained"):
        assert set(result[name]["returns"]) == set(counts)
    assert result["trained"]["returns"]["all"]["accuracy"] > result["untrained"]["returns"]["all"]["accuracy"]
    assert result["frames_trained_on"] == 1


def test_all_returns_of_unseen_frames_only(config: PretrainConfig, tmp_path: Path) -> None:
    """Frames are known by their tokens, whatever their folder, split or version is called."""
    link = tmp_path / "link"
    link.symlink_to(str(config.data.root))
    same: list[dict[str, Any]] = [
        {},
        {"root": str(link)},
        {"root": f"{config.data.root}/"},
        {"version": "v1.0-world"},
        {"split": "all"},
    ]
    for changes in same:
        own = replace(config, data=replace(config.data, **changes))
        with pytest.raises(ValueError, match="that the run was not trained on, got 1 of 1 that it was"):
            evaluate_rendering(own, run_of(config), max_frames=1, all_returns=True)
    make_world(tmp_path / "other", replace(WORLD, seed=1, keyframes=1), workers=1)
    other = replace(config, data=replace(config.data, root=str(tmp_path / "other")))
    held_out = evaluate_rendering(other, run_of(config))
    every = evaluate_rendering(other, run_of(config), all_returns=True)
    assert every["all_returns"] and held_out["frames_trained_on"] == every["frames_trained_on"] == 0
    assert every["depth_rays"] > 5 * held_out["depth_rays"]


def test_frames_of_a_run_whose_data_have_moved(config: PretrainConfig, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    moved = replace(config, data=replace(config.data, root=str(tmp_path / "gone")))
    run.start(yaml.safe_dump(plain(moved)))
    assert len(trained_tokens(run, config.data)) == 2
    assert trained_tokens(run, replace(config.data, dataset="folder")) == set()


def test_all_returns_are_those_that_are_not_visible(config: PretrainConfig) -> None:
    frame = build_source(config.data).load(0)
    held_out = evaluation_rows(frame, config.data, config.point_range, seed=0)
    every = evaluation_rows(frame, config.data, config.point_range, seed=0, all_returns=True)
    assert (every.visible == held_out.visible).all()
    assert not set(every.visible) & set(every.returns) and set(held_out.returns) < set(every.returns)
    inside = inside_range(frame.points, config.point_range) & outside_ego_box(frame.points, config.data.own_car)
    inside &= np.linalg.norm(frame.points[:, :3], axis=1) > 1.0
    expected = set(np.flatnonzero(inside & frame.is_keyframe)) - set(every.visible)
    assert set(every.returns) == expected


# Pictures


def test_view_writes_a_picture_per_camera_and_one_from_above(
    config: PretrainConfig, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", str(run_of(config)), "--columns", "16"]) == 0
    output = capfd.readouterr().out
    pictures = sorted((run_of(config) / "pictures").iterdir())
    assert len(pictures) == 7 and pictures[-1].name == "000000_bev.png"
    for path in pictures:
        assert str(path) in output
        with Image.open(path) as picture:
            assert picture.mode == "RGB" and picture.width > 1200
            # Something was drawn: many colours, not a black page.
            assert len(picture.getcolors(1 << 24)) > 100
    with Image.open(run_of(config) / "pictures" / "000000_CAM_FRONT.png") as picture:
        colours = {colour for _, colour in picture.crop((656, 48, 1296, 408)).getcolors(1 << 24)}
    road = tuple(CLASS_COLOURS[0].tolist())
    assert road in colours and colours <= {tuple(colour) for colour in CLASS_COLOURS.tolist()} | {(0, 0, 0)}


def test_lidar_only_view_without_image_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = write_tree(tmp_path / "data")
    for image in (image for images in tree.images for image in images.values()):
        image.unlink()
    config = tiny_config(tmp_path / "run", steps=1)
    config.data.root, config.data.labels = str(tree.root), "none"
    pretrain(config)
    texts = []

    def noted_blank(size: tuple[int, int], text: str) -> Image.Image:
        texts.append(text)
        return blank(size, text)

    monkeypatch.setattr("pred.view.blank", noted_blank)
    names = [path.name for path in view(config, run_of(config), columns=8)]
    assert names == ["000000_CAM_BACK.png", "000000_CAM_FRONT.png", "000000_bev.png"]
    assert texts.count("no image") == texts.count("no pseudo label") == 2


def test_pixel_rays_point_at_their_pixels(config: PretrainConfig) -> None:
    for camera in build_source(config.data).load(1).cameras:
        origins, directions = pixel_rays(camera, columns=4, rows=2)
        assert np.allclose(np.linalg.norm(directions, axis=1), 1)
        uv, z_depth_m = camera.project(origins + 7.0 * directions)
        u = (np.arange(4) + 0.5) * camera.width / 4
        v = (np.arange(2) + 0.5) * camera.height / 2
        assert np.allclose(uv[:, 0].reshape(2, 4), u) and np.allclose(uv[:, 1].reshape(2, 4), v[:, None])
        assert (z_depth_m > 0).all()


def test_points_are_drawn_at_their_pixel_in_their_colour() -> None:
    panel = Image.new("RGB", (200, 100))
    draw_points(panel, np.array([[150.0, 50.0], [50.0, 25.0]]), np.array([[255, 0, 0], [0, 255, 0]], np.uint8))
    picture = np.asarray(panel)
    assert (picture[49:52, 149:152] == (255, 0, 0)).all() and (picture[24:27, 49:52] == (0, 255, 0)).all()
    assert np.count_nonzero(picture.any(axis=-1)) == 18


def test_cells_near_a_return() -> None:
    cells = np.array([[0.5, 0.5], [4.9, 2.0], [-1.0, 3.0], [2.0, 9.0]])  # column, row; the last two are outside
    expected = [[1, 1, 0, 0, 0, 0], [1, 1, 0, 1, 1, 1], [0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 1, 1]]
    assert near_cells(cells, (4, 6), radius=1).astype(int).tolist() == expected
    assert near_cells(cells, (4, 6), radius=0).sum() == 2
    assert not near_cells(np.zeros((0, 2)), (4, 6), radius=3).any()
    colours = np.full((1, 2, 3), 100, np.uint8)
    assert dimmed(colours, np.array([[True, False]]))[0, :, 0].tolist() == [100, 35]


def test_only_what_was_taught_is_bright(config: PretrainConfig) -> None:
    """The panel of a real picture: sky and facades above the LiDAR's view are dim; the road is not."""
    view(config, run_of(config), columns=16)
    with Image.open(run_of(config) / "pictures" / "000000_CAM_FRONT.png") as picture:
        # Without the house on the right, whose near corner the LiDAR sees up to the upper edge.
        distance = np.asarray(picture.crop((656, 436, 1136, 796))).astype(int)
    assert distance[:60].max() < 128 and distance[250:].max() > 200


def test_from_above_forward_is_up_and_right_is_right(config: PretrainConfig) -> None:
    panel = Image.new("RGB", (512, 512))  # of +-25.6 m: 10 pixels per metre
    pixels = pixels_from_above(np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 20.0]]), panel, config)
    assert np.allclose(pixels, [[256, 256], [356, 256], [256, 56]])


def test_boxes_are_drawn_around_their_centre(config: PretrainConfig) -> None:
    panel = Image.new("RGB", (512, 512))
    boxes = Boxes(np.array([[5.0, 5.0, 0.0]]), np.array([[4.0, 2.0, 1.5]]), np.array([math.pi / 2]), ["car"])
    draw_boxes(panel, boxes, config)  # heading up: 2 m wide, 4 m long
    rows, columns = np.nonzero(np.asarray(panel).any(axis=-1))
    assert (columns.min(), columns.max()) == (296, 316) and (rows.min(), rows.max()) == (186, 226)


def test_colours_of_distances() -> None:
    middle = math.sqrt(NEAREST_M * FARTHEST_M)
    colours = distance_colours(np.array([0.0, NEAREST_M, middle, FARTHEST_M, 1e9])).astype(int)
    assert (colours[0] == colours[1]).all() and (colours[3] == colours[4]).all()
    assert colours[1][0] > colours[1][2] and colours[3][2] > colours[3][1]  # near is red, far is blue
    assert (np.abs(colours[2] - colours[1]).sum() > 100) and (np.abs(colours[2] - colours[3]).sum() > 100)


def test_colours_of_classes_opacity_and_signed_distance() -> None:
    assert class_colours(np.array([[0, 255]], np.uint8)).tolist() == [[[128, 64, 128], [0, 0, 0]]]
    assert len(CLASS_COLOURS) == len(CLASS_NAMES) == len(set(map(tuple, CLASS_COLOURS.tolist())))
    colours = np.full((1, 3, 3), 200, np.uint8)
    assert faded(colours, np.array([[1.0, 0.0, 0.5]]))[0, :, 0].tolist() == [200, 60, 130]
    outside, inside = sdf_colours(np.array([[0.4, 0.45], [-0.4, -0.45]]))[:, 1].astype(int)
    assert outside[2] > outside[0] and inside[0] > inside[2]


def test_real_keyframe_is_evaluated_and_viewed(nuscenes_tiny: Path, tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run", steps=2)
    config.data.root = str(nuscenes_tiny)
    pretrain(config)
    result = evaluate_rendering(config, run_of(config))
    assert result["depth_rays"] > 1000 and result["semantic_rays"] > 1000
    assert 0 < result["nearest_visible"]["depth_median_m"] < result["nearest_visible"]["depth_mean_m"] < 5
    paths = view(config, run_of(config), columns=16)
    assert [path.name for path in paths][-1] == "000000_bev.png" and len(paths) == 7


def test_rendering_leaves_the_network_alone(config: PretrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluation neither updates running statistics nor builds a graph."""
    seen: list[Any] = []
    render = Pretrainer.render

    def watched(self: Pretrainer, *arguments: Any, **options: Any) -> RenderedView:
        rendered = render(self, *arguments, **options)
        seen.append((self.training, rendered.depth_m.requires_grad))
        return rendered

    monkeypatch.setattr(Pretrainer, "render", watched)
    evaluate_rendering(config, run_of(config), max_frames=1)
    assert len(seen) == 4 and set(seen) == {(False, False)}
