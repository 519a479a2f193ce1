# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Segmentation networks of Hugging Face `transformers` with Cityscapes classes: loading, checks, input and output.

What transformers lets pass with a warning is refused here: a head without weights, a guessed preprocessor. Nothing is
unpickled beyond tensors, and no code of a checkpoint is run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from pred.data.frame import CLASS_NAMES, FrameError

PREPROCESSOR_FILE = "preprocessor_config.json"


def require_transformers() -> Any:
    """The package transformers.

    Raises:
        RuntimeError: it is not installed; names the extra.
    """
    os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")  # what it would warn about is checked here
    try:
        import transformers
    except ImportError as error:
        raise RuntimeError(
            f"pred label: transformers must be installed, got {error}; pip install 'pred-lidar[label]'"
        ) from None
    transformers.utils.logging.disable_progress_bar()
    return transformers


@dataclass
class Segmenter:
    """A network with its preprocessing.

    Attributes:
        model: the network in evaluation mode.
        processor: transformers' image processor of the checkpoint.
        channels: [19] the network's channel of each Cityscapes class.
        size: (width, height) to which images are resized; None: as the processor is configured.
    """

    model: Any
    processor: Any
    channels: list[int]
    size: tuple[int, int] | None = None

    def pixel_values(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """[B, 3, h, w] float32 input of the network for images [height, width, 3], all of one size.

        The whole image is resized, never cropped, so that pixels of image and output correspond by their sizes alone.
        """
        # A processor takes any keyword; it must not be told to crop what its class does not know.
        options: dict[str, Any] = {"return_tensors": "pt"}
        if getattr(self.processor, "do_center_crop", None):
            options["do_center_crop"] = False
        if self.size is not None:
            options |= {"do_resize": True, "size": {"height": self.size[1], "width": self.size[0]}}
        values: Tensor = self.processor(images=list(images), **options)["pixel_values"]
        return values

    @torch.no_grad()
    def logits(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """[B, 19, h, w] float32 scores in the order of the Cityscapes train ids, on the network's own output grid.

        Raises:
            ValueError: they are not finite.
        """
        values = self.pixel_values(images).to(self.model.device)
        logits: Tensor = self.model(pixel_values=values).logits.float()[:, self.channels]
        if not bool(torch.isfinite(logits).all()):
            raise ValueError("the network's output must be finite, got NaN or Inf")
        return logits


def probabilities_at(
    logits: Tensor,  # [19, h, w]
    rows: NDArray[np.int64],  # [N]
    columns: NDArray[np.int64],  # [N]
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """[N, 19] class probabilities at cells of a label grid of ``shape`` (rows, columns) over the same image.

    Scores are interpolated between the centres of the network's cells (bilinear, half-pixel centres: that is
    ``align_corners=False``; beyond the outermost centres the nearest counts), then the softmax is taken.
    """
    grid = np.stack([(2 * columns + 1) / shape[1] - 1, (2 * rows + 1) / shape[0] - 1], axis=-1).astype(np.float32)
    places = torch.from_numpy(grid).to(logits.device)[None, None]
    sampled = F.grid_sample(logits[None], places, mode="bilinear", padding_mode="border", align_corners=False)
    probabilities: NDArray[np.float32] = sampled[0, :, 0].T.softmax(dim=-1).cpu().numpy()
    return probabilities


def load_segmenter(name: str, size: tuple[int, int] | None = None) -> Segmenter:
    """A checkpoint from a local folder, or by its id from the Hugging Face hub.

    Args:
        name: folder or hub id.
        size: (width, height) of the network's input; None: as the checkpoint's preprocessor resizes.

    Raises:
        FrameError: it is missing or damaged, has no preprocessor configuration, other classes than the 19 of
            Cityscapes, or parts without weights.
        RuntimeError: transformers is not installed.
    """
    transformers = require_transformers()
    folder = Path(name)
    if folder.is_dir():
        if not (folder / PREPROCESSOR_FILE).is_file():
            raise FrameError(folder / PREPROCESSOR_FILE, _NO_PREPROCESSOR)
    elif folder.exists() or not re.fullmatch(r"[\w.-]+(/[\w.-]+)?", name) or name.startswith("."):
        raise FrameError(name, "model must be a folder or an id of the Hugging Face hub, got neither")
    # Damaged and missing files surface as OSError, ValueError, KeyError, RuntimeError, SafetensorError, ...
    try:
        config = transformers.AutoConfig.from_pretrained(name, trust_remote_code=False)
    except Exception as error:
        what = "have a readable config.json" if folder.is_dir() else "be a folder or an id of the Hugging Face hub"
        raise FrameError(name, f"model must {what}, got {_first_line(error)}") from None
    channels = cityscapes_channels(name, config.id2label)
    try:
        processor = transformers.AutoImageProcessor.from_pretrained(name, trust_remote_code=False, backend="pil")
    except Exception as error:
        raise FrameError(f"{name}/{PREPROCESSOR_FILE}", f"{_NO_PREPROCESSOR}: {_first_line(error)}") from None
    try:
        model, report = transformers.AutoModelForSemanticSegmentation.from_pretrained(
            name,
            config=config,
            trust_remote_code=False,
            weights_only=True,
            ignore_mismatched_sizes=True,
            output_loading_info=True,
            dtype=torch.float32,
        )
    except Exception as error:
        raise FrameError(
            name, f"model must be a checkpoint for semantic segmentation, got {_first_line(error)}"
        ) from None
    mismatched = [entry if isinstance(entry, str) else entry[0] for entry in report["mismatched_keys"]]
    absent = sorted({*report["missing_keys"], *mismatched})
    if absent:
        raise FrameError(
            name,
            f"model must hold all its weights, got none (or of another shape) for {len(absent)} such as {absent[0]}",
        )
    model.eval().requires_grad_(False)
    return Segmenter(model, processor, channels, size)


_NO_PREPROCESSOR = (
    "model must come with its preprocessor configuration, got none: input scaled otherwise than in training "
    "gives wrong labels without any error"
)


def cityscapes_channels(name: str, id2label: Mapping[int, str] | None) -> list[int]:
    """[19] the channel of each Cityscapes class, by its name whatever its case and separators.

    Raises:
        FrameError: the classes are others.
    """
    found = {_plain(str(label)): int(channel) for channel, label in (id2label or {}).items()}
    missing = [label for label in CLASS_NAMES if label not in found]
    if missing or len(id2label or {}) != len(CLASS_NAMES):
        kind = ""
        if "aeroplane" in found and "tvmonitor" in found or len(found) == 21:
            kind = "; 21 classes are those of PASCAL VOC, which has no road, building or vegetation"
        raise FrameError(
            name,
            f"id2label must name the {len(CLASS_NAMES)} classes of Cityscapes, got {len(found)} such as "
            f"{', '.join(list(found)[:3])}, without {', '.join(missing[:3]) or 'more'}{kind}",
        )
    return [found[label] for label in CLASS_NAMES]


def _plain(label: str) -> str:
    return re.sub(r"[\s_-]+", " ", label.strip().lower())


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[0]}"
