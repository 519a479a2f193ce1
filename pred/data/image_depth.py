# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Depth maps of images, as 16-bit PNG: metres = value / 256 along the optical axis, 0 = no depth.

That is the convention of the KITTI depth benchmark (its development kit's readme).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import FrameError, decode_image, open_image

VALUES_PER_M = 256.0


@dataclass
class DepthMap:
    """The depth map of one image; the file is read when looked up.

    Attributes:
        path: 16-bit grey PNG.
        width, height: size of the image in pixels, which is the map's.
    """

    path: Path
    width: int
    height: int

    def lookup(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N] metres along the optical axis at image pixels ``uv`` [N, 2]; NaN where there is none, and outside.

        Raises:
            FrameError: the file is missing or damaged, no 16-bit grey PNG, or of another size.
        """
        values = self._load()
        column, row = np.floor(uv).T
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        found = np.zeros(len(uv))
        found[inside] = values[row[inside].astype(np.int64), column[inside].astype(np.int64)]
        return np.where(found > 0, found / VALUES_PER_M, np.nan)

    def _load(self) -> NDArray[np.uint16]:
        with open_image(self.path) as image:
            if image.format != "PNG" or image.mode not in ("I;16", "I"):  # I: older Pillow
                raise FrameError(
                    self.path, f"depth map must be a 16-bit grey PNG, got {image.format} of mode {image.mode}"
                )
            if image.size != (self.width, self.height):
                raise FrameError(
                    self.path,
                    f"depth map must have its image's {self.width} x {self.height} pixels, "
                    f"got {image.size[0]} x {image.size[1]}",
                )
            return decode_image(self.path, image).astype(np.uint16, copy=False)


def depth_folder(root: Path, image_depth: str | None) -> Path | None:
    """The folder that ``data.image_depth`` means: its path under the root; None for None and "none".

    Raises:
        FrameError: there is no such folder.
    """
    if image_depth in (None, "none"):
        return None
    folder = root / str(image_depth)
    if not folder.is_dir():
        raise FrameError(folder, "data.image_depth must be a folder, got no such folder")
    return folder
