"""COLMAP camera models: parameters, image sizes and projection."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.io.colmap import normalized_from_px as normalized_from_px
from megloc_kapture.io.colmap import px_from_cam as px_from_cam
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, ONE_FOCAL_MODELS, Camera, RigidTransform

PINHOLE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
# models whose first distortion parameter is the coefficient of the squared radius
RADIAL_MODELS = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})


# model with one focal length -> model with two, with the same distortion parameters first
_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}


def focal_px(camera: Camera) -> float:
    if camera.model in ONE_FOCAL_MODELS:
        return camera.params[0]
    return 0.5 * (camera.params[0] + camera.params[1])


def _principal_point_index(camera: Camera) -> int:
    return 1 if camera.model in ONE_FOCAL_MODELS else 2


def principal_point_px(camera: Camera) -> tuple[float, float]:
    k = _principal_point_index(camera)
    return camera.params[k], camera.params[k + 1]


def shift_principal_point(camera: Camera, x_px: float, y_px: float | None = None) -> Camera:
    """Shift the principal point by (``x_px``, ``y_px``); ``y_px`` is ``x_px`` by default."""
    k = _principal_point_index(camera)
    params = list(camera.params)
    params[k] += x_px
    params[k + 1] += x_px if y_px is None else y_px
    return replace(camera, params=tuple(params))


def scale_focal(camera: Camera, factor: float) -> Camera:
    k = _principal_point_index(camera)
    params = tuple(factor * value for value in camera.params[:k]) + camera.params[k:]
    return replace(camera, params=params)


def radial_distortion(camera: Camera) -> float:
    """Return the coefficient of the squared radius; the model must be in RADIAL_MODELS."""
    return camera.params[_principal_point_index(camera) + 2]


def with_distortion(camera: Camera, radial: float) -> Camera:
    """Replace the :func:`radial_distortion`."""
    k = _principal_point_index(camera) + 2
    return replace(camera, params=(*camera.params[:k], radial, *camera.params[k + 1 :]))


def with_two_focals(camera: Camera) -> Camera:
    """Return the same camera in a model with two focal lengths."""
    if camera.model not in ONE_FOCAL_MODELS:
        return camera
    model = _TWO_FOCAL_MODEL[camera.model]
    params = (camera.params[0], *camera.params)
    rest = (0.0,) * (CAMERA_MODEL_NUM_PARAMS[model] - len(params))
    return replace(camera, model=model, params=params + rest)


def same_lens(first: Camera, second: Camera) -> bool:
    """Return True for equal distortion models and coefficients; all else may differ."""
    a, b = with_two_focals(first), with_two_focals(second)
    return a.model == b.model and a.params[4:] == b.params[4:]


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """Scale a camera, with sides rounded to pixels; focal lengths and principal point follow."""
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    x, y = width / camera.width, height / camera.height
    params = list(camera.params)
    by = [0.5 * (x + y), x, y] if camera.model in ONE_FOCAL_MODELS else [x, y, x, y]
    params[: len(by)] = [p * b for p, b in zip(params, by, strict=False)]
    return replace(camera, width=width, height=height, params=tuple(params))


def reduced_size(width: int, height: int, max_size_px: int | None) -> tuple[int, int]:
    """Return a size with a longer side of at most ``max_size_px``, in whole pixels, at least 1."""
    longer = max(width, height)
    if max_size_px is None or longer <= max_size_px:
        return width, height
    scale = max_size_px / longer
    return max(round(width * scale), 1), max(round(height * scale), 1)


def reduced_camera(camera: Camera, max_side_px: int) -> Camera:
    """Scale a camera down to a longer side of at most ``max_side_px``."""
    longer = max(camera.width, camera.height)
    return camera if longer <= max_side_px else scaled_camera(camera, max_side_px / longer)


def bearing_rays(camera: Camera, points_px: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the rays (x/z, y/z, 1) of pixels (N, 2) in the camera frame, float64 (N, 3)."""
    xy = normalized_from_px(camera, points_px)
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


@lru_cache(maxsize=8)
def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Return rays (H * W, 3), z = 1, through the pixel centres, row by row; cached, read-only."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = bearing_rays(camera, np.stack([x.ravel(), y.ravel()], axis=1))
    rays.flags.writeable = False
    return rays


def project(
    camera: Camera, cam_from_world: RigidTransform, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Project world points (N, 3) to pixels (N, 2) float64; NaN behind the camera."""
    return px_from_cam(camera, cam_from_world.apply(points_world))


def in_image(camera: Camera, px: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return the mask (N,) of pixels (N, 2) inside the camera's image; NaN is outside."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((px >= 0) & (px < (camera.width, camera.height))).all(axis=1))


def values_at(
    image: NDArray[Any], camera: Camera, px: NDArray[np.floating[Any]], outside: float
) -> NDArray[Any]:
    """Return the values (N,) of a camera's image (H, W) at pixels (N, 2); ``outside`` beyond it."""
    inside = in_image(camera, px)
    column, row = px[inside].astype(np.int64).T
    values = np.full(len(px), outside, image.dtype)
    values[inside] = image[row, column]
    return values


# a, b, c of a Kinect's depth noise a + b z + c z^2 = 0.0012 + 0.0019 (z - 0.4)^2
STRUCTURED_LIGHT = (0.001504, -0.00152, 0.0019)


def depth_noise(
    depth: NDArray[np.float64], noise: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the standard deviation of a sensor's depth, a + b z + c z^2."""
    a, b, c = noise
    return a + depth * (b + depth * c)
