"""Cameras of COLMAP's models: their parameters, their images' sizes, and projection."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.colmap import normalized_from_px as normalized_from_px
from megloc_kapture.io.colmap import px_from_cam as px_from_cam
from megloc_kapture.values import (
    CAMERA_MODEL_NUM_PARAMS,
    ONE_FOCAL_MODELS,
    Camera,
    RigidTransform,
)

PINHOLE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
# models whose first distortion parameter multiplies the squared radius
RADIAL_MODELS = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})


# the model with two focal lengths that has each one's distortion among its own, in the same order
_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}


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


def with_two_focals(camera: Camera) -> Camera:
    """The same camera in a model with two focal lengths; itself where it has them already."""
    if camera.model not in ONE_FOCAL_MODELS:
        return camera
    model = _TWO_FOCAL_MODEL[camera.model]
    params = (camera.params[0], *camera.params)
    rest = (0.0,) * (CAMERA_MODEL_NUM_PARAMS[model] - len(params))
    return replace(camera, model=model, params=params + rest)


def same_lens(first: Camera, second: Camera) -> bool:
    """True if two cameras differ by their focal lengths and principal points at most."""
    a, b = with_two_focals(first), with_two_focals(second)
    return a.model == b.model and a.params[4:] == b.params[4:]


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The same view in an image of another size, rounded to whole pixels, at least one.

    Everything scales by what its side really scales by; one focal length for both sides by the
    mean of the two.
    """
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    x, y = width / camera.width, height / camera.height
    params = list(camera.params)
    by = [0.5 * (x + y), x, y] if camera.model in ONE_FOCAL_MODELS else [x, y, x, y]
    params[: len(by)] = [p * b for p, b in zip(params, by, strict=False)]
    return replace(camera, width=width, height=height, params=tuple(params))


def reduced_camera(camera: Camera, max_side_px: int) -> Camera:
    """The camera of the image reduced to a longer side; itself where it is no larger."""
    longer = max(camera.width, camera.height)
    return camera if longer <= max_side_px else scaled_camera(camera, max_side_px / longer)


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


def in_image(camera: Camera, px: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Mask (N,) of the pixels (N, 2) that are inside of a camera's image; NaN is not."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((px >= 0) & (px < (camera.width, camera.height))).all(axis=1))
