# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of procedural streets, made in memory when they are asked for."""

# No `from __future__ import annotations`: the configuration reader needs real types.

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import Camera, Frame
from pred.data.labels import PseudoLabel
from pred.data.world import sensors
from pred.data.world.street import Street, build_street
from pred.random import numpy_generator


@dataclass
class StreetConfig:
    """The embedded street data: size, and the seed that draws it.

    Attributes:
        frames: number of frames.
        frames_per_street: frames along one street before the next street is drawn.
        image_width: width of the six camera images in pixels; the intrinsics follow it.
        image_height: height of the images in pixels; the horizon stays in the middle.
        seed: draws the streets and the sensor noise.
    """

    frames: int = 16
    frames_per_street: int = 4
    image_width: int = 400
    image_height: int = 225
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("frames", "frames_per_street", "image_width", "image_height"):
            if getattr(self, name) < 1:
                raise ValueError(f"street: {name} must be at least 1, got {getattr(self, name)}")


class StreetFrames:
    """A `pred.data.frame.FrameSource` of streets. Frame ``index`` is a function of the seed and ``index`` alone.

    Each street has its own world frame. Points carry exact classes (`Frame.semantics`), cameras exact label maps;
    pictures and label maps are rendered when they are asked for.

    Args:
        config: sizes and seed.
        seed: replaces ``config.seed`` when given, for example to see other streets of the same kind.
        labels: False: cameras without label maps (LiDAR-only).
    """

    def __init__(self, config: StreetConfig, seed: int | None = None, labels: bool = True) -> None:
        self.config = config
        self.seed = config.seed if seed is None else seed
        self.labels = labels
        # Streets come from a generator each, so a cache changes the time and nothing else. Eight streets take some
        # 70 MB, 400 label maps of the default size 36 MB.
        self._street = lru_cache(maxsize=8)(self._build_street)
        self._label_map = lru_cache(maxsize=400)(self._render_labels)

    def __reduce__(self) -> tuple[Any, ...]:
        # Scenes cannot be sent to another process, and need not be.
        return StreetFrames, (self.config, self.seed, self.labels)

    def __len__(self) -> int:
        return self.config.frames

    def token(self, index: int) -> str:
        """Identity of frame ``index``."""
        return f"street-{self.seed}-{self._checked(index):06d}"

    def load(self, index: int) -> Frame:
        """Frame ``index``: LiDAR sweep with exact classes, six cameras, pose."""
        token = self.token(index)
        street, T_world_from_lidar = self._place(index)
        sweep = sensors.scan(street.scene, T_world_from_lidar, numpy_generator(self.seed, token, "scan"))
        return Frame(
            token=token,
            points=sweep.points,
            point_index=sweep.ray_index,
            is_keyframe=np.ones(len(sweep.points), dtype=np.bool_),
            cameras=[self._camera(index, mount) for mount in range(len(sensors.MOUNTS))],
            T_world_from_lidar=T_world_from_lidar,
            source=f"procedural {token}",
            semantics=sweep.class_id,
        )

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"street: index must be in [0, {len(self)}), got {index}")
        return index

    def _build_street(self, number: int) -> Street:
        return build_street(numpy_generator(self.seed, "street", number), self.config.frames_per_street)

    def _place(self, index: int) -> tuple[Street, NDArray[np.float64]]:
        """Street and LiDAR pose of a frame."""
        number, step = divmod(index, self.config.frames_per_street)
        street = self._street(number)
        return street, street.T_world_from_ego[step] @ sensors.T_EGO_FROM_LIDAR

    def _camera(self, index: int, mount: int) -> Camera:
        width, height = self.config.image_width, self.config.image_height
        camera = sensors.mounted_camera(sensors.MOUNTS[mount], width, height)
        camera.image = partial(self._render_image, index, camera)
        if self.labels:
            camera.labels = PseudoLabel(partial(self._label_map, index, mount), width, height)
        return camera

    def _render_image(self, index: int, camera: Camera) -> NDArray[np.uint8]:
        street, T_world_from_lidar = self._place(index)
        return sensors.render_image(street.scene, camera, T_world_from_lidar, street.sun)

    def _render_labels(self, index: int, mount: int) -> NDArray[np.uint8]:
        street, T_world_from_lidar = self._place(index)
        width, height = self.config.image_width, self.config.image_height
        camera = sensors.mounted_camera(sensors.MOUNTS[mount], width, height)
        labels = sensors.render_labels(street.scene, camera, T_world_from_lidar)
        labels.flags.writeable = False  # shared through the cache
        return labels
