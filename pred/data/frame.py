# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""One recorded (or simulated) moment: LiDAR points, calibrated cameras, poses, boxes.

Frames are cheap to hold: images and pseudo labels load when they are asked for. All geometry is in
the LiDAR frame of the data set at the frame's LiDAR time, in metres; ``T_a_from_b`` maps
coordinates of b to those of a.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    from pred.data.image_depth import DepthMap
    from pred.data.labels import PseudoLabel

NUM_CLASSES = 19
"""Cityscapes train ids 0..18; 19 (background) and 255 mean "no label"."""

CLASS_NAMES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
    "vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train",
    "motorcycle", "bicycle",
)  # fmt: skip

MIN_PROJECTION_DEPTH_M = 0.1
"""Nearer points (and those behind the camera) have no pixel."""

ImageSource = Path | NDArray[np.uint8] | Callable[[], NDArray[np.uint8]]


class FrameError(ValueError):
    """A file of a frame cannot be used. The text names the file and what is wrong with it."""

    def __init__(self, path: str | Path, what: str) -> None:
        super().__init__(str(path), what)
        self.path = str(path)
        self.what = what

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


def unreadable(path: Path, error: OSError, what: str, hint: str = "") -> FrameError:
    """The error of a file that is missing (``hint`` says what to do) or cannot be opened; ``what`` it is."""
    if isinstance(error, FileNotFoundError):
        return FrameError(path, f"{what} must exist, got no such file{hint}")
    return FrameError(path, f"{what} must be readable, got {error}")


@dataclass
class Camera:
    """A calibrated pinhole camera of one frame.

    Attributes:
        name: channel, for example ``CAM_FRONT``.
        intrinsics: [3, 3] float64 for an image of ``width`` x ``height`` pixels.
        T_camera_from_lidar: [4, 4] float64, from the LiDAR frame at LiDAR time to the camera frame
            at the camera's own time (ego motion between the two is part of it). Camera axes:
            x right, y down, z forward.
        width, height: image size in pixels.
        image: file, array [height, width, 3], or a function that makes the array; None where there
            is no image.
        labels: semantic pseudo label of the image, or None.
        depth: depth map of the image, or None.
    """

    name: str
    intrinsics: NDArray[np.float64]
    T_camera_from_lidar: NDArray[np.float64]
    width: int
    height: int
    image: ImageSource | None = None
    labels: PseudoLabel | None = None
    depth: DepthMap | None = None

    def __post_init__(self) -> None:
        self.intrinsics = _matrix(self.intrinsics, 3, f"camera {self.name}: intrinsics")
        self.T_camera_from_lidar = _matrix(self.T_camera_from_lidar, 4, f"camera {self.name}: T_camera_from_lidar")

    @property
    def T_lidar_from_camera(self) -> NDArray[np.float64]:  # noqa: N802
        """[4, 4] float64; its last column holds the camera centre in the LiDAR frame."""
        return invert_rigid(self.T_camera_from_lidar)

    def project(self, points_lidar: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project [N, 3] points: pixels ``uv`` [N, 2] and depth on the optical axis [N], metres.

        Pixels of points nearer than ``MIN_PROJECTION_DEPTH_M`` are meaningless but finite; see
        `in_image`. Pixel (0, 0) covers u and v in [0, 1).
        """
        points_camera = transform_points(self.T_camera_from_lidar, points_lidar)
        z_depth_m = points_camera[:, 2]
        homogeneous = points_camera @ self.intrinsics.T
        divisor = np.where(z_depth_m >= MIN_PROJECTION_DEPTH_M, homogeneous[:, 2], 1.0)
        return homogeneous[:, :2] / divisor[:, None], z_depth_m

    def in_image(self, uv: NDArray[np.float64], z_depth_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[N] mask of projected points that lie in front of the camera and inside the image."""
        u, v = uv[:, 0], uv[:, 1]
        inside = (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)
        return inside & (z_depth_m >= MIN_PROJECTION_DEPTH_M)

    def depth_at(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth of the image [N] at pixels ``uv`` [N, 2], metres along the optical axis; NaN where it has none.

        Raises:
            FrameError: there is no depth map, or it is missing, damaged, or of another size or type.
        """
        if self.depth is None:
            raise FrameError(f"camera {self.name}", "depth map must be given, got None: see data.image_depth")
        return self.depth.lookup(uv)

    def load_image(self) -> NDArray[np.uint8]:
        """The image, uint8 [height, width, 3] RGB.

        Raises:
            FrameError: there is no image, or it is missing, damaged, or of another size or mode.
        """
        if self.image is None:
            raise FrameError(f"camera {self.name}", "image must be given, got None")
        if isinstance(self.image, Path):
            where, image = str(self.image), read_rgb(self.image)
        else:
            where = f"camera {self.name}"
            image = np.asarray(self.image() if callable(self.image) else self.image)
        expected = (self.height, self.width, 3)
        if image.shape != expected or image.dtype != np.uint8:
            raise FrameError(
                where,
                f"image must be uint8 of shape {expected}, got {image.dtype} {image.shape}",
            )
        return image


@dataclass
class Boxes:
    """Annotated boxes in the LiDAR frame.

    Attributes:
        centre_m: [M, 3] float64.
        size_m: [M, 3] float64, length (along the heading), width, height.
        yaw_rad: [M] float64, heading in the x-y plane, counter-clockwise from +x, in [-pi, pi].
        names: M category names of the data set.
    """

    centre_m: NDArray[np.float64]
    size_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    names: list[str]

    def __len__(self) -> int:
        return len(self.names)


@dataclass
class Frame:
    """One keyframe with the sweeps that came before it.

    Attributes:
        token: identity of the frame; part of every random key.
        points: [N, 5] float32: x, y, z (metres, keyframe LiDAR frame), intensity, dt (seconds
            behind the keyframe; 0 for its own returns).
        point_index: [N] int64, index of the return in its own sweep file.
        is_keyframe: [N] bool, the return belongs to the keyframe's own sweep.
        cameras: calibrated cameras.
        T_world_from_lidar: [4, 4] float64 at LiDAR time.
        source: file or description, for error texts.
        semantics: [N] exact classes of simulated points (train ids, 255 = none), or None.
        boxes: annotations, or None.
        earlier_keyframes: for each sweep that is the keyframe of an earlier frame, that frame's
            token and the sweep's rows in ``points``. What that frame holds out is no input here either.
    """

    token: str
    points: NDArray[np.float32]
    point_index: NDArray[np.int64]
    is_keyframe: NDArray[np.bool_]
    cameras: list[Camera] = field(default_factory=list)
    T_world_from_lidar: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    source: str = ""
    semantics: NDArray[np.integer[Any]] | None = None
    boxes: Boxes | None = None
    earlier_keyframes: dict[str, slice] = field(default_factory=dict)

    def __post_init__(self) -> None:
        name = self.source or self.token
        num_points = len(self.points)
        if self.points.shape != (num_points, 5) or self.points.dtype != np.float32:
            got = f"{self.points.dtype} {list(self.points.shape)}"
            raise ValueError(f"{name}: points must be float32 of shape [N, 5], got {got}")
        for attribute in ("point_index", "is_keyframe", "semantics"):
            array = getattr(self, attribute)
            if array is not None and array.shape != (num_points,):
                raise ValueError(f"{name}: {attribute} must have shape [{num_points}], got {list(array.shape)}")
        self.T_world_from_lidar = _matrix(self.T_world_from_lidar, 4, f"{name}: T_world_from_lidar")


class FrameSource(Protocol):
    """A sequence of frames: a data set on disk or a simulated world.

    Loading a frame twice gives equal frames.
    """

    def __len__(self) -> int: ...

    def token(self, index: int) -> str:
        """Identity of frame ``index``, without loading it."""
        ...

    def load(self, index: int) -> Frame:
        """Frame ``index``; raises `FrameError` when one of its files cannot be used."""
        ...


def transform_points(T_a_from_b: NDArray[np.float64], points_b: NDArray[Any]) -> NDArray[np.float64]:
    """Apply a rigid transform [4, 4] to points [N, 3]; float64 result."""
    return points_b.astype(np.float64) @ T_a_from_b[:3, :3].T + T_a_from_b[:3, 3]


def require_intrinsics(intrinsics: Any, what: str) -> NDArray[np.float64]:
    """[3, 3] float64: a pinhole camera without zero focal lengths, which would project everything to NaN.

    Raises:
        ValueError: it opens with ``what``.
    """
    try:
        matrix = np.asarray(intrinsics, dtype=np.float64)
    except (ValueError, TypeError):
        matrix = np.zeros(0)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ValueError(f"{what} must be 3 x 3 finite numbers, got {intrinsics}")
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and matrix[2].tolist() == [0, 0, 1]):
        raise ValueError(f"{what} must have positive focal lengths and the last row 0, 0, 1, got {matrix.tolist()}")
    return matrix


def require_inside(path: str) -> str:
    """A path below the root of a data set.

    Raises:
        ValueError: it leads elsewhere.
    """
    if not path or Path(path).is_absolute() or ".." in Path(path).parts or "\0" in path:
        raise ValueError(f"{path!r}, which is no path below the root")
    return path


def invert_rigid(T_a_from_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a rigid transform [4, 4], without the rounding of a general inverse."""
    inverse = np.eye(4)
    inverse[:3, :3] = T_a_from_b[:3, :3].T
    inverse[:3, 3] = -T_a_from_b[:3, :3].T @ T_a_from_b[:3, 3]
    return inverse


def pose_matrix(
    translation_m: NDArray[np.float64],  # [3]
    quaternion_wxyz: NDArray[np.float64],  # [4], of any length but 0
) -> NDArray[np.float64]:
    """[4, 4] rigid transform of a translation and a quaternion."""
    w, x, y, z = quaternion_wxyz / np.linalg.norm(quaternion_wxyz)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation_m
    return matrix


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] unit quaternion w, x, y, z of a rotation matrix [3, 3], w >= 0.

    4 q q^T is linear in the matrix; its longest column is q, up to length and sign, without any division by a small
    number.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    outer = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    column = outer[:, outer.diagonal().argmax()]
    unit: NDArray[np.float64] = column / np.linalg.norm(column)
    return -unit if unit[0] < 0 else unit


EgoBox = tuple[float, float, float, float]
"""(x_min, y_min, x_max, y_max) of the own car, metres, LiDAR frame."""
EGO_BOX: EgoBox = (-1.0, -2.0, 1.0, 3.0)
"""The own car of nuScenes, in its axes: x right, y forward."""
ONCE_EGO_BOX: EgoBox = (-1.0, -3.0, 1.0, 2.0)
"""The same in the axes of ONCE: x left, y back."""


def inside_range(points: NDArray[Any], point_range: tuple[float, ...]) -> NDArray[np.bool_]:
    """[N] mask of points (columns x, y, z, ...) in (x_min, y_min, z_min, x_max, y_max, z_max).

    The upper bounds are outside, as in `pred.ops.voxelize`; NaN is outside.
    """
    lower = np.asarray(point_range[:3], dtype=points.dtype)
    upper = np.asarray(point_range[3:], dtype=points.dtype)
    xyz = points[:, :3]
    return np.all((xyz >= lower) & (xyz < upper), axis=1)


def outside_ego_box(points: NDArray[Any], ego_box: tuple[float, ...]) -> NDArray[np.bool_]:
    """[N] mask of points (columns x, y, ...) outside (x_min, y_min, x_max, y_max), the own car."""
    x_min, y_min, x_max, y_max = ego_box
    x, y = points[:, 0], points[:, 1]
    return ~((x > x_min) & (x < x_max) & (y > y_min) & (y < y_max))


def open_image(path: Path) -> Image.Image:
    """Open an image file and read its header; every way in which that fails becomes a `FrameError`."""
    try:
        return Image.open(path)
    except FileNotFoundError:
        raise FrameError(path, "image file must exist, got no such file") from None
    except Exception as error:
        raise _unreadable_image(path, error) from None


def decode_image(path: Path, image: Image.Image) -> NDArray[Any]:
    """Pixels of the image that `open_image` has opened; damage is a `FrameError`.

    Check the size first: a file of a few bytes can claim gigabytes of pixels.
    """
    try:
        image.load()
    except Exception as error:
        raise _unreadable_image(path, error) from None
    return np.asarray(image)


def _unreadable_image(path: Path, error: Exception) -> FrameError:
    # Pillow reports damage as OSError, SyntaxError, ValueError, EOFError, struct.error, ...
    return FrameError(path, f"image file must be readable, got {type(error).__name__}: {error}")


def rgb_image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file in pixels, from its header.

    Raises:
        FrameError: it is missing, no image, or not RGB.
    """
    with open_image(path) as image:
        size, mode = image.size, image.mode
    if mode != "RGB":
        raise FrameError(path, f"image must have mode RGB, got {mode}")
    return size


def check_image_header(path: Path, width: int, height: int) -> None:
    """Check size and mode of an image file without decoding it.

    Raises:
        FrameError: it is missing, no image, or not RGB of ``width`` x ``height`` pixels.
    """
    with open_image(path) as image:
        size, mode = image.size, image.mode
    if (size, mode) != ((width, height), "RGB"):
        raise FrameError(
            path, f"image must be RGB of {width} x {height} pixels, got {mode} of {size[0]} x {size[1]} pixels"
        )


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode an RGB image file, [height, width, 3]; raises as `open_image`, or where the mode is another."""
    with open_image(path) as image:
        if image.mode != "RGB":
            raise FrameError(path, f"image must have mode RGB, got {image.mode}")
        return decode_image(path, image)


def _matrix(value: Any, size: int, what: str) -> NDArray[np.float64]:
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != (size, size):
        raise ValueError(f"{what} must have shape [{size}, {size}], got {list(matrix.shape)}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{what} must be finite, got NaN or Inf")
    return matrix
