# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""`pred label` and `pred label train` with tiny networks that are built here; nothing is downloaded."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from pred.cli import main
from pred.data.batch import DataConfig, TrainingBatches, build_source
from pred.data.frame import CLASS_NAMES, FrameError
from pred.data.nuscenes import NuScenesFrames
from pred.data.soft_labels import decode
from pred.data.world.nuscenes_writer import WorldSettings
from pred.data_check import check_data
from pred.label import LabelConfig, label
from pred.label_train import LabelTrainConfig, class_weights, random_crop, train_segmenter
from pred.run_folder import RunFolderError, one_writer
from pred.segmenter import cityscapes_channels, load_segmenter, probabilities_at
from pred.world import make_world
from tests.data.own_tree import write_own_tree
from tests.data.tiny_tree import Tree, write_tree

transformers = pytest.importorskip("transformers", reason="transformers is missing: pip install 'pred-lidar[label]'")

Edit = dict[str, Any]


def make_model(folder: Path, names: tuple[str, ...] = CLASS_NAMES, kind: str = "mobilenet") -> Path:
    """A checkpoint with random weights and Cityscapes classes."""
    labels = dict(enumerate(names))
    torch.manual_seed(0)
    if kind == "segformer":
        config = transformers.SegformerConfig(
            num_encoder_blocks=2, depths=[1, 1], sr_ratios=[2, 1], hidden_sizes=[8, 16], patch_sizes=[7, 3],
            strides=[4, 2], num_attention_heads=[1, 2], mlp_ratios=[2, 2], decoder_hidden_size=16, id2label=labels,
        )  # fmt: skip
        model = transformers.SegformerForSemanticSegmentation(config)
        settings: Edit = {"image_processor_type": "SegformerImageProcessor", "size": {"height": 64, "width": 64}}
    else:
        config = transformers.MobileNetV2Config(depth_multiplier=0.1, output_stride=8, id2label=labels)
        model = transformers.MobileNetV2ForSemanticSegmentation(config)
        settings = {"image_processor_type": "MobileNetV2ImageProcessor", "size": {"height": 72, "width": 128}}
    for parameter in model.parameters():  # outputs that differ from place to place
        if parameter.ndim == 4:
            torch.nn.init.kaiming_normal_(parameter)
    model.save_pretrained(folder)
    settings |= {
        "do_resize": True, "do_rescale": True, "rescale_factor": 1 / 255, "do_normalize": True, "resample": 2,
        "image_mean": [0.5, 0.4, 0.3], "image_std": [0.5, 0.25, 0.2], "do_center_crop": kind == "mobilenet",
        "crop_size": {"height": 16, "width": 16},
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model(tmp_path_factory.mktemp("model") / "tiny")


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return write_tree(tmp_path / "data", scenes=("scene-a", "scene-b"))


def image_of(width: int = 64, height: int = 36) -> Any:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# The network


def test_input_is_resized_whole_and_normalised(model: Path) -> None:
    """Without the normalisation a network still gives labels, wrong ones."""
    image = image_of()
    values = load_segmenter(str(model)).pixel_values([image])[0].numpy()
    resized = np.asarray(Image.fromarray(image).resize((128, 72), Image.Resampling.BILINEAR), dtype=np.float32) / 255
    expected = (resized - np.array([0.5, 0.4, 0.3])) / np.array([0.5, 0.25, 0.2])
    assert np.allclose(values, expected.transpose(2, 0, 1), atol=1e-5)
    assert load_segmenter(str(model), (32, 16)).pixel_values([image]).shape == (1, 3, 16, 32)


def test_probabilities_are_those_of_the_whole_upsampled_map() -> None:
    logits = torch.randn(19, 9, 16, generator=torch.Generator().manual_seed(0))
    dense = F.interpolate(logits[None], size=(90, 200), mode="bilinear", align_corners=False)[0].softmax(0)
    row, column = np.divmod(np.array([0, 199, 90 * 200 - 1, 4321, 9999]), 200)
    found = probabilities_at(logits, row, column, (90, 200))
    assert np.allclose(found, dense.permute(1, 2, 0).numpy()[row, column], atol=1e-5)


def test_channels_follow_the_names() -> None:
    names = [name.upper().replace(" ", "_") for name in reversed(CLASS_NAMES)]
    assert cityscapes_channels("m", dict(enumerate(names))) == list(range(18, -1, -1))


def test_other_order_gives_the_same_scores(model: Path, tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(19)
    other = transformers.AutoModelForSemanticSegmentation.from_pretrained(model)
    for parameter in other.segmentation_head.classifier.parameters():
        parameter.data = parameter.data[torch.from_numpy(order)]
    other.config.id2label = {place: CLASS_NAMES[index].title() for place, index in enumerate(order)}
    other.save_pretrained(tmp_path)
    shutil.copy(model / "preprocessor_config.json", tmp_path)
    first, second = (load_segmenter(str(folder)).logits([image_of()]) for folder in (model, tmp_path))
    assert torch.allclose(first, second, atol=1e-5) and float(first.std()) > 0


def test_segmenter_that_resizes_to_a_square(tmp_path: Path, tree: Tree) -> None:
    folder = make_model(tmp_path / "former", kind="segformer")
    assert load_segmenter(str(folder)).logits([image_of()]).shape == (1, 19, 16, 16)
    label(LabelConfig(model=str(folder), data=DataConfig(root=str(tree.root)), previews=0))
    frame = NuScenesFrames(tree.root, labels="pseudo/former").load(0)
    assert frame.cameras[0].labels is not None and frame.cameras[0].labels.class_map().shape == (36, 64)


def test_refused_checkpoints(model: Path, tmp_path: Path) -> None:
    def message(folder: str | Path) -> str:
        with pytest.raises(FrameError) as caught:
            load_segmenter(str(folder))
        return str(caught.value)

    assert "must be a folder or an id of the Hugging Face hub, got neither" in message(tmp_path / "absent")
    voc = ("background", "aeroplane", *map(str, range(18)), "tvmonitor")
    assert "id2label must name the 19 classes of Cityscapes, got 21 such as background" in message(
        make_model(tmp_path / "voc", voc)
    )
    assert "those of PASCAL VOC" in message(tmp_path / "voc")
    assert "without road" in message(make_model(tmp_path / "names", tuple(f"LABEL_{index}" for index in range(19))))
    twenty = make_model(tmp_path / "twenty", (*CLASS_NAMES, "void"))
    assert "got 20 such as" in message(twenty)

    copy = shutil.copytree(model, tmp_path / "copy")
    (copy / "preprocessor_config.json").unlink()
    assert "preprocessor_config.json: model must come with its preprocessor configuration, got none" in message(copy)

    from safetensors.torch import load_file, save_file

    for name, change in (
        ("missing", lambda weights: weights.pop("segmentation_head.classifier.convolution.weight")),
        (
            "mismatched",
            lambda weights: weights.update({"segmentation_head.classifier.convolution.bias": torch.ones(7)}),
        ),
    ):
        copy = shutil.copytree(model, tmp_path / name)
        weights = load_file(copy / "model.safetensors")
        change(weights)
        save_file(weights, copy / "model.safetensors", metadata={"format": "pt"})
        assert "must hold all its weights" in message(copy) and "segmentation_head.classifier" in message(copy)
    copy = shutil.copytree(model, tmp_path / "truncated")
    content = (copy / "model.safetensors").read_bytes()
    (copy / "model.safetensors").write_bytes(content[: len(content) // 2])
    assert "model must be a checkpoint for semantic segmentation, got" in message(copy)


def test_pickles_are_not_run(model: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(model, tmp_path / "pickle")
    (copy / "model.safetensors").unlink()

    class Hostile:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"weights": Hostile()}, copy / "pytorch_model.bin")
    with pytest.raises(FrameError, match="model must be a checkpoint"):
        load_segmenter(str(copy))
    assert not (tmp_path / "ran").exists()


# Labelling


def test_labels_at_lidar_pixels(model: Path, tree: Tree) -> None:
    statistics = label(LabelConfig(model=str(model), data=DataConfig(root=str(tree.root)), previews=1))
    assert (statistics.frames, statistics.images, statistics.kept) == (4, 8, 0)
    folder = tree.root / "pseudo" / "tiny"
    assert len(list((folder / "previews").rglob("*.png"))) == 1
    segmenter = load_segmenter(str(model))
    seen = 0
    source = NuScenesFrames(tree.root, labels="pseudo/tiny", ego_box=(0.0, 0.0, 0.0, 0.0))  # as labelled: all returns
    for index in range(len(source)):
        frame = source.load(index)
        for camera in frame.cameras:
            uv, depth = camera.project(frame.points[frame.is_keyframe, :3])
            uv = uv[camera.in_image(uv, depth)]
            assert camera.labels is not None
            found = camera.labels.lookup(uv)
            assert (found.class_id >= 0).all()
            dense = F.interpolate(segmenter.logits([camera.load_image()]), size=(36, 64), mode="bilinear")[0].softmax(0)
            column, row = np.floor(uv).astype(int).T
            assert np.abs(found.target - dense.numpy()[:, row, column].T).max() < 0.01
            assert np.count_nonzero(camera.labels.class_map() < 255) == len(np.unique(row * 64 + column))
            seen += len(uv)
    assert seen == statistics.class_counts.sum() > 100
    assert check_data(tree.root, tree.tables.name, "pseudo/tiny").num_problems == 0


@pytest.fixture(params=["once", "folder"])
def unlabelled(request: pytest.FixtureRequest, tmp_path: Path) -> DataConfig:
    """A data set with images and no labels yet: a made drive in the ONCE layout, or own drives."""
    root = tmp_path / "data"
    if request.param == "once":
        make_world(root, WorldSettings(scenes=1, keyframes=2, image_scale=0.05, layout="once"), workers=1)
    else:
        write_own_tree(root)
        shutil.rmtree(root / "pseudo")
    return DataConfig(
        request.param, str(root), batch_size=2, semantic_rays_per_camera=20, depth_rays=50, mask_ratio=0.5, workers=0
    )


def test_batch_of_labels_of_other_layouts(model: Path, unlabelled: DataConfig) -> None:
    """Every semantic ray bears what the file of its image says at the pixel that the ray goes through."""
    arguments = ["--data.dataset", unlabelled.dataset, "--data.root", str(unlabelled.root), "--previews", "1"]
    assert main(["label", "--model", str(model), *arguments]) == 0
    folder = Path(str(unlabelled.root)) / "pseudo" / "tiny"
    assert len(list((folder / "previews").rglob("*.png"))) == 1
    source = build_source(unlabelled)
    batch = TrainingBatches(unlabelled, (-25.0, -25.0, -5.0, 25.0, 25.0, 5.0), seed=0, total_steps=1)[0]
    assert batch.semantic is not None and batch.skipped == []
    frames = {source.token(index): source.load(index) for index in range(len(source))}
    assert batch.semantic.valid.sum(dim=1).min() >= 20
    assert len(batch.semantic.target[batch.semantic.valid].unique(dim=0)) > 5
    for place, token in enumerate(batch.tokens):
        left = batch.semantic.valid[place].numpy().copy()
        origins, directions = (
            rays[place].double().numpy() for rays in (batch.semantic.origins, batch.semantic.directions)
        )
        returns = origins + directions * batch.semantic.range_m[place, :, None].numpy()
        recording, _, stem = token.rpartition("_" if unlabelled.dataset == "once" else "/")
        for camera in frames[token].cameras:
            own = left & np.isclose(origins, camera.T_lidar_from_camera[:3, 3], rtol=0, atol=1e-5).all(axis=1)
            stored = np.load(folder / recording / camera.name / f"{stem}.npz")
            assert stored["shape"].tolist() == [camera.height, camera.width]
            column, row = np.floor(camera.project(returns[own])[0]).astype(int).T
            cells = np.cumsum(stored["steps"], dtype=np.int64).tolist()
            at = [cells.index(cell) for cell in row * camera.width + column]  # nothing else may have a ray
            expected = decode(stored["codes"][:, at])
            np.testing.assert_array_equal(batch.semantic.target[place, own].numpy(), expected)
            np.testing.assert_array_equal(batch.semantic.confidence[place, own].numpy(), expected.max(axis=1))
            left &= ~own
        assert not left.any()


def test_killed_and_continued(model: Path, tree: Tree) -> None:
    config = LabelConfig(model=str(model), data=DataConfig(root=str(tree.root)), previews=2)
    label(config)
    folder = tree.root / "pseudo" / "tiny"
    whole = files(folder)
    shutil.rmtree(folder)

    command = [sys.executable, "-m", "pred", "label", "--model", str(model), "--data.root", str(tree.root)]
    with subprocess.Popen([*command, "--previews", "2"], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None and len(list(folder.glob("CAM_*/*.npz"))) < 2:
            time.sleep(0.001)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    kept = len(list(folder.glob("CAM_*/*.npz")))
    assert 2 <= kept < 8
    label_file = next(folder.glob("CAM_*/*.npz"))
    label_file.write_bytes(label_file.read_bytes()[:-9])  # a disk's fault, not a kill's
    label_file.with_name(f".{label_file.name}.77.partial").touch()
    statistics = label(config)
    assert statistics.kept == kept - 1 and statistics.images == 8
    assert files(folder) == whole and not list(folder.rglob("*.partial"))
    assert label(config).kept == 8


def test_one_writer(model: Path, tree: Tree) -> None:
    config = LabelConfig(model=str(model), data=DataConfig(root=str(tree.root)), previews=0)
    with one_writer(config.folder), pytest.raises(RunFolderError, match="tiny: must have one writer, got another"):
        label(config)
    assert label(config).images == 8


def test_other_settings_are_refused(model: Path, tree: Tree, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["label", "--model", str(model), "--data.root", str(tree.root), "--previews", "0"]
    assert main(arguments) == 0
    assert "mean confidence" in capsys.readouterr().out
    assert main([*arguments, "--size", "[32, 18]"]) == 1
    assert "size must be None as in settings.json, got [32, 18]" in capsys.readouterr().err
    assert main([*arguments, "--size", "[32, 18]", "--out", "small"]) == 0
    foreign = tree.root / "pseudo" / "foreign"
    foreign.mkdir()
    (foreign / "mine.txt").touch()
    with pytest.raises(RunFolderError, match=r"foreign: must be new or empty, or hold settings\.json, got mine\.txt"):
        label(LabelConfig(model=str(model), out="foreign", data=DataConfig(root=str(tree.root))))


def test_wrong_arguments(model: Path) -> None:
    with pytest.raises(ValueError, match="data.root must name the folder"):
        LabelConfig(model=str(model))
    with pytest.raises(ValueError, match="model must be a hub id or a folder"):
        LabelConfig()
    for out in ("a/b", "..", ""):
        with pytest.raises(ValueError, match="out must be a plain name"):
            LabelConfig(model="m", out=out, data=DataConfig(root="r"))


# Training


@pytest.fixture
def coloured(tmp_path: Path) -> Tree:
    """A data set whose colours tell the class: the left half red road, the right half blue sky."""
    tree = write_tree(tmp_path / "data", scenes=("scene-a", "scene-b"))
    classes = np.zeros((36, 64), dtype=np.uint8)
    classes[:, 32:] = 10
    classes[0] = 255
    image = np.where(classes[..., None] == 10, (0, 0, 250), (250, 0, 0)).astype(np.uint8)
    for images in tree.images:
        for camera, path in images.items():
            Image.fromarray(image).save(path)
            exact = tree.root / "pseudo" / "exact" / camera / f"{path.stem}.png"
            exact.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(classes).save(exact)
    (tree.tables / "splits.json").write_text(json.dumps({"train": ["scene-a"], "val": ["scene-b"]}))
    return tree


def train_config(tree: Tree, out: Path, **settings: Any) -> LabelTrainConfig:
    data = DataConfig(root=str(tree.root), labels="pseudo/exact")
    defaults: Edit = {"steps": 12, "width": 0.1, "scale": 1.0, "crop": (64, 32), "batch_size": 2, "checkpoint_every": 3}
    return LabelTrainConfig(out=str(out), data=data, **{**defaults, **settings})


def test_training_leaves_a_checkpoint_that_labels(coloured: Tree, tmp_path: Path) -> None:
    out = train_segmenter(train_config(coloured, tmp_path / "net", steps=40, lr=1e-2))
    measured = json.loads((out / "evaluation.json").read_text())
    assert measured["classes"] == 2 and measured["images"] == 4 and measured["iou"]["car"] is None
    assert measured["share_of_cells"]["road"] == pytest.approx(0.5)
    config = transformers.AutoConfig.from_pretrained(out)
    assert [config.id2label[index] for index in range(19)] == list(CLASS_NAMES)
    assert config.label2id["sky"] == 10
    assert not (out / "checkpoints").exists()
    label(LabelConfig(model=str(out), data=DataConfig(root=str(coloured.root)), previews=0))
    train_segmenter(train_config(coloured, tmp_path / "further", steps=2, init=str(out)))


def test_killed_training_ends_in_the_same_bits(coloured: Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = train_segmenter(train_config(coloured, tmp_path / "whole"))
    import pred.label_train

    make_batch = pred.label_train.make_batch

    def dying(*arguments: Any) -> Any:
        if arguments[3] == 8:
            raise KeyboardInterrupt
        return make_batch(*arguments)

    config = train_config(coloured, tmp_path / "broken")
    monkeypatch.setattr(pred.label_train, "make_batch", dying)
    with pytest.raises(KeyboardInterrupt):
        train_segmenter(config)
    monkeypatch.setattr(pred.label_train, "make_batch", make_batch)
    leftover = tmp_path / "broken" / ".model.safetensors.77.partial"
    leftover.touch()
    resumed = train_segmenter(config)
    assert not leftover.exists()
    assert (resumed / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    with pytest.raises(RunFolderError, match=r"lr must be 0\.003 as in settings\.json, got 0\.5"):
        train_segmenter(train_config(coloured, tmp_path / "broken", lr=0.5))


def test_crops_keep_image_and_classes_together() -> None:
    config = LabelTrainConfig(scale=2.0, crop=(32, 32))
    classes = np.zeros((36, 64), dtype=np.uint8)
    classes[:, 32:] = 13
    image = np.repeat((classes * 10 + 60)[..., None], 3, axis=2)
    for seed in range(20):
        picture, found = random_crop(image, classes, config, np.random.default_rng(seed))
        assert picture.size == (32, 32) and found.shape == (32, 32) and set(np.unique(found)) <= {0, 13}
        bright = np.asarray(picture)[..., 0] > np.asarray(picture)[..., 0].mean()
        if len(np.unique(found)) == 2:
            assert (bright == (found == 13)).mean() > 0.9


def test_class_weights() -> None:
    frequency = np.zeros(19)
    frequency[:2] = [0.8, 0.2]
    weight = class_weights(frequency, 1.0)
    assert weight[:3].tolist() == pytest.approx([0.625, 2.5, 2.5])  # 1/f, over a mean of 2
    assert class_weights(frequency, 0.0).tolist() == [1.0] * 19


def test_training_needs_labels(coloured: Tree, tmp_path: Path) -> None:
    config = train_config(coloured, tmp_path / "net")
    config.data.labels = "none"
    with pytest.raises(FrameError, match="frames must have labels"):
        train_segmenter(config)
    assert not (tmp_path / "net").exists()
