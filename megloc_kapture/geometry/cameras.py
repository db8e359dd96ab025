"""Projection under COLMAP's camera models, and the pixel origin of intrinsics."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.colmap import normalized_from_px as normalized_from_px
from megloc_kapture.io.colmap import px_from_cam as px_from_cam
from megloc_kapture.values import ONE_FOCAL_MODELS, Camera, RigidTransform

# models whose first distortion parameter multiplies the squared radius
RADIAL_MODELS = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})


def focal_px(camera: Camera) -> float:
    """Mean focal length in pixels."""
    if camera.model in ONE_FOCAL_MODELS:
        return camera.params[0]
    return 0.5 * (camera.params[0] + camera.params[1])


def _principal_point_index(camera: Camera) -> int:
    return 1 if camera.model in ONE_FOCAL_MODELS else 2


def principal_point_px(camera: Camera) -> tuple[float, float]:
    """Principal point (cx, cy) in pixels."""
    k = _principal_point_index(camera)
    return camera.params[k], camera.params[k + 1]


def shift_principal_point(camera: Camera, x_px: float, y_px: float | None = None) -> Camera:
    """The camera with its principal point moved, in y as in x unless ``y_px`` is given."""
    k = _principal_point_index(camera)
    params = list(camera.params)
    params[k] += x_px
    params[k + 1] += x_px if y_px is None else y_px
    return replace(camera, params=tuple(params))


def scale_focal(camera: Camera, factor: float) -> Camera:
    """The camera with its focal length, or both of them, so many times as long."""
    k = _principal_point_index(camera)
    params = tuple(factor * value for value in camera.params[:k]) + camera.params[k:]
    return replace(camera, params=params)


def radial_distortion(camera: Camera) -> float:
    """The factor of the squared radius; of one of RADIAL_MODELS."""
    return camera.params[_principal_point_index(camera) + 2]


def with_distortion(camera: Camera, radial: float) -> Camera:
    """The camera with this :func:`radial_distortion`."""
    k = _principal_point_index(camera) + 2
    return replace(camera, params=(*camera.params[:k], radial, *camera.params[k + 1 :]))


def swap_principal_point(camera: Camera) -> Camera:
    """The camera with cx and cy exchanged."""
    k = _principal_point_index(camera)
    cx, cy = camera.params[k : k + 2]
    return replace(camera, params=(*camera.params[:k], cy, cx, *camera.params[k + 2 :]))


def bearing_rays(camera: Camera, points_px: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Homogeneous rays (x/z, y/z, 1) in the camera frame of pixels (N, 2); float64 (N, 3)."""
    xy = normalized_from_px(camera, points_px)
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


@lru_cache(maxsize=8)
def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Rays (H * W, 3) with z = 1 through the centres of a camera's pixels, row by row; read-only.

    Kept, for images share few cameras, and distortion is slow to undo.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = bearing_rays(camera, np.stack([x.ravel(), y.ravel()], axis=1))
    rays.flags.writeable = False
    return rays


def project(
    camera: Camera, cam_from_world: RigidTransform, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels (N, 2) float64 of world points (N, 3); NaN for points behind the camera."""
    return px_from_cam(camera, cam_from_world.apply(points_world))
