# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""A LiDAR and six cameras modelled on the nuScenes car: where they are, and how what they measure follows from hits."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.frame import Camera, invert_rigid

NUM_RINGS, NUM_COLUMNS = 32, 1085
LOWEST_RING_DEG, HIGHEST_RING_DEG = -30.67, 10.67
MAX_RANGE_M = 105.0
RANGE_NOISE_M = 0.02
MIN_RANGE_M = 0.5

# The LiDAR stands 1.84 m above the road; its x axis points to the car's right, its y axis ahead.
T_EGO_FROM_LIDAR = np.array([[0.0, 1.0, 0.0, 0.94], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.84], [0.0, 0.0, 0.0, 1.0]])


class Mount(NamedTuple):
    """Place and optics of a camera: metres in the ego frame, yaw counter-clockwise from ahead, pitch upwards, focal
    length and principal point (None: the middle) in pixels of an image of 1600 x 900."""

    name: str
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    focal_px: float
    pitch_deg: float = 0.0
    centre_px: tuple[float, float] | None = None


MOUNT_IMAGE_WIDTH, MOUNT_IMAGE_HEIGHT = 1600, 900

CALIBRATED_MOUNTS = (
    Mount("CAM_FRONT", 1.70, 0.02, 1.51, 0.3, 1266.0, -0.3, (816.0, 492.0)),
    Mount("CAM_FRONT_RIGHT", 1.55, -0.49, 1.50, -56.4, 1261.0, -0.8, (808.0, 495.0)),
    Mount("CAM_BACK_RIGHT", 1.01, -0.48, 1.56, -110.8, 1260.0, -0.9, (807.0, 501.0)),
    Mount("CAM_BACK", 0.03, 0.0, 1.58, 179.9, 809.0, 1.0, (829.0, 482.0)),
    Mount("CAM_BACK_LEFT", 1.04, 0.48, 1.59, 108.6, 1257.0, -0.9, (792.0, 493.0)),
    Mount("CAM_FRONT_LEFT", 1.52, 0.49, 1.51, 55.2, 1273.0, 0.1, (827.0, 480.0)),
)
"""The calibration of one nuScenes car, rounded."""


@lru_cache(maxsize=1)
def lidar_directions() -> NDArray[np.float64]:
    """[32 * 1085, 3] unit directions in the LiDAR frame: columns clockwise from the left, rings upwards."""
    azimuth = np.pi - 2 * np.pi * np.arange(NUM_COLUMNS) / NUM_COLUMNS
    elevation = np.deg2rad(np.linspace(LOWEST_RING_DEG, HIGHEST_RING_DEG, NUM_RINGS))
    azimuth, elevation = (angle.ravel() for angle in np.meshgrid(azimuth, elevation, indexing="ij"))
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    directions.flags.writeable = False
    return directions


def returned_light(
    reflectance: NDArray[np.float32],  # [N]
    cosine: NDArray[np.float32],  # [N] of the angle between the ray and the surface's normal
    speckle: NDArray[np.float64],  # [N] random factor
) -> NDArray[np.float64]:
    """[N] share of the light that comes back: by material and angle of incidence."""
    return np.asarray(reflectance * (0.2 + 0.8 * cosine) * speckle)


def mounted_camera(mount: Mount, width: int, height: int) -> Camera:
    """The camera of a mount, its intrinsics scaled to the width of the image, without picture or labels."""
    yaw = np.deg2rad(mount.yaw_deg)
    c, s = np.cos(yaw), np.sin(yaw)
    T_ego_from_camera = np.eye(4)
    # Columns: the camera's x (right), y (down) and z (ahead) axes.
    level = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    if mount.pitch_deg:
        c, s = np.cos(np.deg2rad(mount.pitch_deg)), np.sin(np.deg2rad(mount.pitch_deg))
        level = level @ [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    T_ego_from_camera[:3, :3] = level
    T_ego_from_camera[:3, 3] = mount.x_m, mount.y_m, mount.z_m
    focal_px = mount.focal_px * width / MOUNT_IMAGE_WIDTH
    centre_x, centre_y = width / 2, height / 2
    if mount.centre_px is not None:
        centre_x = mount.centre_px[0] * width / MOUNT_IMAGE_WIDTH
        centre_y = mount.centre_px[1] * height / MOUNT_IMAGE_HEIGHT
    intrinsics = np.array([[focal_px, 0.0, centre_x], [0.0, focal_px, centre_y], [0.0, 0.0, 1.0]])
    T_camera_from_lidar = invert_rigid(T_ego_from_camera) @ T_EGO_FROM_LIDAR
    return Camera(mount.name, intrinsics, T_camera_from_lidar, width, height)


def camera_rays(
    camera: Camera, T_world_from_lidar: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origin [3] and unit directions [height * width, 3] of the rays through the pixel centres, world frame."""
    T_world_from_camera = T_world_from_lidar @ camera.T_lidar_from_camera
    v, u = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    to_world = T_world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    directions = pixels @ to_world.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return T_world_from_camera[:3, 3].astype(np.float32), directions.astype(np.float32)


def shade(
    origin: NDArray[np.float32],  # [3]
    directions: NDArray[np.float32],  # [N, 3] unit
    solid: NDArray[np.int64],  # [M] rays that meet something
    t_m: NDArray[np.float32],  # [M]
    normal: NDArray[np.float32],  # [M, 3]
    colours: NDArray[np.float32],  # [M, 3]
    sun: NDArray[np.float32],  # [3]
    occluded: Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.bool_]],
) -> NDArray[np.uint8]:
    """Colours of N rays, uint8 [N, 3]: Lambert shading with cast shadows and haze; sky where a ray meets nothing."""
    up = directions[:, 2:].clip(0, 1)
    sky = _HORIZON + (_ZENITH - _HORIZON) * np.sqrt(up)
    t_m = t_m[:, None]
    # A little off the surface, or it would shade itself.
    places = origin + directions[solid] * t_m + normal * np.float32(0.01)
    facing = (normal @ sun).clip(0, 1)
    lit = np.flatnonzero(facing)
    towards_sun = np.broadcast_to(sun, (len(lit), 3))
    facing[lit[occluded(places[lit], towards_sun)]] = 0
    light = _AMBIENT * (1 + 0.25 * normal[:, 2:]) + _SUNLIGHT * facing[:, None]
    haze = 1 - np.exp(-t_m / _VISIBILITY_M)
    image = sky.copy()
    image[solid] = colours * light * (1 - haze) + _HORIZON * haze
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)


_HORIZON = np.array([0.82, 0.88, 0.94], dtype=np.float32)
_ZENITH = np.array([0.30, 0.52, 0.84], dtype=np.float32)
_AMBIENT = np.array([0.50, 0.53, 0.60], dtype=np.float32)
_SUNLIGHT = np.array([0.68, 0.64, 0.56], dtype=np.float32)
_VISIBILITY_M = np.float32(400.0)
