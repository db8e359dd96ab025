"""Resizing and undistortion of images, their cameras and their keypoints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.cameras import bearing_rays, normalized_from_px, px_from_cam
from megloc_kapture.io.colmap_cameras import undistorted_pinhole
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, ONE_FOCAL_MODELS, Camera

# a point may leave the image by rounding
_ROUNDING_PX = 1e-6
# two that are one up to what COLMAP's iterations leave
_SAME_PX = 1e-3
Floats = NDArray[np.float64]
# the model with two focal lengths that has each one's distortion among its own, in the same order
_TWO_FOCAL_MODEL = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}
PINHOLE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
# models whose distortion is a polynomial of the tangent: without coefficients there is none (the
# fisheye models' is one of the angle)
_POLYNOMIAL_MODELS = frozenset({"OPENCV", "FULL_OPENCV"})


@dataclass(frozen=True, slots=True)
class PixelMap:
    """Carries points between an image and what pre-processing made of it, in double precision.

    Both cameras look along the same axes from the same centre, so a pixel is carried through its
    ray. Where they share their distortion that is a scale per axis, else COLMAP's camera models.

    Parameters
    ----------
    original, processed : the cameras of the two images.
    """

    original: Camera
    processed: Camera

    def original_from_processed(self, points_px: NDArray[np.floating[Any]]) -> Floats:
        """Points (N, 2) of the processed image in the original one; float64 (N, 2).

        NaN where the original image does not reach.
        """
        return _carried(self.processed, self.original, points_px)

    def processed_from_original(self, points_px: NDArray[np.floating[Any]]) -> Floats:
        """Points (N, 2) of the original image in the processed one; float64 (N, 2).

        NaN where the processed image does not reach: cropped away, or beyond what a pinhole sees.
        """
        return _carried(self.original, self.processed, points_px)


def same_lens(first: Camera, second: Camera) -> bool:
    """True if two cameras differ by their focal lengths and principal points at most."""
    a, b = with_two_focals(first), with_two_focals(second)
    return a.model == b.model and a.params[4:] == b.params[4:]


def _carried(source: Camera, target: Camera, points_px: NDArray[np.floating[Any]]) -> Floats:
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    if same_lens(source, target):
        a, b = (np.array(with_two_focals(camera).params[:4]) for camera in (source, target))
        found = (points - a[2:]) * (b[:2] / a[:2]) + b[2:]
    else:
        rays = bearing_rays(source, points)
        found = px_from_cam(target, rays)
        found[~(sees(source, rays, points) & sees(target, rays, found))] = np.nan
    limit = np.array([target.width, target.height]) + _ROUNDING_PX
    found[~((found >= -_ROUNDING_PX) & (found <= limit)).all(axis=1)] = np.nan
    return found


def sees(camera: Camera, rays: Floats, points_px: Floats) -> NDArray[np.bool_]:
    """Mask (N,): ray (N, 3) and pixel (N, 2) of a camera belong to each other.

    The polynomials of the models fold over beyond some angle: a ray out there has a pixel too,
    but it is that of a ray nearer to the axis.
    """
    if camera.model in PINHOLE_MODELS:
        return np.asarray(np.isfinite(points_px).all(axis=1))
    focals = np.array(with_two_focals(camera).params[:2])
    off = (normalized_from_px(camera, points_px) - rays[:, :2]) * focals
    again = px_from_cam(camera, rays) - points_px
    return np.asarray((np.hypot(*off.T) <= _SAME_PX) & (np.hypot(*again.T) <= _SAME_PX))


def fitted_size(
    width: int, height: int, max_size_px: int, *, upscale: bool = False
) -> tuple[int, int]:
    """Size whose larger side is ``max_size_px``, the ratio kept as whole pixels allow.

    Parameters
    ----------
    upscale : enlarge smaller images too, which adds pixels but nothing that can be seen.
    """
    larger = max(width, height)
    if larger <= max_size_px and not upscale:
        return width, height
    # in whole numbers, half up: no rounding of a float can make two machines differ
    smaller = max(1, (2 * min(width, height) * max_size_px + larger) // (2 * larger))
    return (max_size_px, smaller) if width >= height else (smaller, max_size_px)


def cropped_size(width: int, height: int, multiple_of: int) -> tuple[int, int]:
    """The largest size within an image both of whose sides are multiples of a number.

    Raises
    ------
    OptionError : a side is smaller than that number.
    """
    if min(width, height) < multiple_of:
        raise OptionError(
            f"an image of {width}x{height} cannot be cropped to multiples of {multiple_of}"
        )
    return width - width % multiple_of, height - height % multiple_of


def with_two_focals(camera: Camera) -> Camera:
    """The same camera in a model with two focal lengths; itself where it has them already."""
    if camera.model not in ONE_FOCAL_MODELS:
        return camera
    model = _TWO_FOCAL_MODEL[camera.model]
    params = (camera.params[0], *camera.params)
    rest = (0.0,) * (CAMERA_MODEL_NUM_PARAMS[model] - len(params))
    return replace(camera, model=model, params=params + rest)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera of an image that was resized as a whole to ``width`` x ``height``.

    Rounded to whole pixels the two sides may be scaled differently; a model with one focal
    length then becomes the one with two that has the same distortion.
    """
    scale_x, scale_y = width / camera.width, height / camera.height
    # compared as whole numbers: equal ratios may round to different floats
    if width * camera.height != height * camera.width:
        camera = with_two_focals(camera)
    else:
        scale_y = scale_x
    if camera.model in ONE_FOCAL_MODELS:
        focal, cx, cy, *distortion = camera.params
        params = (focal * scale_x, cx * scale_x, cy * scale_y, *distortion)
    else:
        fx, fy, cx, cy, *distortion = camera.params
        params = (fx * scale_x, fy * scale_y, cx * scale_x, cy * scale_y, *distortion)
    return replace(camera, width=width, height=height, params=params)


def resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The image (H, W, ...) scaled as a whole to ``height`` x ``width``.

    Smaller pixels are the means of what they cover, so that nothing is aliased; larger ones are
    interpolated by cubics.
    """
    import cv2

    old_height, old_width = image.shape[:2]
    if (old_width, old_height) == (width, height):
        return image
    shrinks = width <= old_width and height <= old_height
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))


def undistorted_camera(camera: Camera, *, blank_pixels: float = 0.0) -> Camera:
    """The camera of the undistorted image, as COLMAP chooses it: its focal lengths are kept.

    Parameters
    ----------
    blank_pixels : 0: as large as it can be without a pixel that the image does not show; 1: as
        large as it must be to show all of the image; in between, in between.

    Returns
    -------
    A pinhole camera; the argument itself where it is one already.
    """
    if camera.model in PINHOLE_MODELS:
        return camera
    lens = with_two_focals(camera)
    if lens.model in _POLYNOMIAL_MODELS and not any(lens.params[4:]):
        return replace(lens, model="PINHOLE", params=lens.params[:4])
    return undistorted_pinhole(camera, blank_pixels=blank_pixels)
