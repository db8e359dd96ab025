"""Resizing and undistortion of images and masks, their cameras and their keypoints.

Images are resampled once, because undistorting first and resizing afterwards would blur twice: each
pixel of an undistorted, reduced image is the average of a square of samples of the original.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.cameras import (
    PINHOLE_MODELS,
    RADIAL_MODELS,
    bearing_rays,
    focal_px,
    normalized_from_px,
    principal_point_px,
    px_from_cam,
    radial_distortion,
    same_lens,
    scale_focal,
    shift_principal_point,
    with_distortion,
    with_two_focals,
)
from megloc_kapture.io.colmap import undistorted_pinhole
from megloc_kapture.values import ONE_FOCAL_MODELS, Camera

# check every 16th pixel: points between two valid ones are valid, as distortion changes slowly
_CHECKED_EVERY = 16
# grid spacing of interpolated maps, in original pixels: errors are below 0.005 px, while OpenCV's
# interpolation rounds to 1/32 px
_INTERPOLATED_PX = 4
# tolerance for points on the image border
_ROUNDING_PX = 1e-6
# tolerance for the residual of COLMAP's iterative undistortion
_SAME_PX = 1e-3
Floats = NDArray[np.float64]
# in these models distortion is a polynomial (or a ratio of two) in the tangent of the angle, so
# zero coefficients mean no distortion (unlike in fisheye models)
_POLYNOMIAL_MODELS = frozenset({"OPENCV", "FULL_OPENCV"})
Float32 = NDArray[np.float32]


def processed_image(image: NDArray[np.uint8], plan: FramePlan) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) of the processed camera; black outside the original."""
    if not plan.warps:
        width, height = plan.resized
        whole = resized(image, width, height)
        return np.ascontiguousarray(whole[: plan.processed.height, : plan.processed.width])
    import cv2

    samples = max(1, math.ceil(plan.shrink - 1e-9))
    interpolation = cv2.INTER_LINEAR if samples > 1 else cv2.INTER_CUBIC
    x, y = _sampled_at(plan, samples)
    seen = cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    if samples > 1:
        size = (plan.processed.width, plan.processed.height)
        seen = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)
    reached = reached_region(plan)
    if reached is not None:
        seen[~reached] = 0
    return np.asarray(seen)


def processed_mask(mask: NDArray[np.bool_], plan: FramePlan) -> NDArray[np.bool_]:
    """Resample a mask to the size (H, W) of the processed image, with nearest neighbours."""
    size = (plan.processed.height, plan.processed.width)
    if not plan.changes_pixels:
        return mask
    if not plan.warps:
        # OpenCV's nearest-neighbour resizing samples at a pixel's corner, not at its centre
        rows, columns = (
            (2 * np.arange(number) + 1) * old_side // (2 * side)
            for number, old_side, side in zip(size, mask.shape, plan.resized[::-1], strict=True)
        )
        return np.ascontiguousarray(mask[np.ix_(rows, columns)])
    x, y = _sampled_at(plan, 1)
    column = np.clip(np.floor(x + 0.5), 0, mask.shape[1] - 1).astype(np.int32)
    row = np.clip(np.floor(y + 0.5), 0, mask.shape[0] - 1).astype(np.int32)
    return np.asarray(mask[row, column])


@lru_cache(maxsize=2)
def reached_region(plan: FramePlan) -> NDArray[np.bool_] | None:
    """Return the mask (H, W) of processed pixels inside the original; None if all are."""
    if not plan.warps:
        return None
    width, height = plan.processed.width, plan.processed.height
    some = [
        np.append(np.arange(0, side - 1, _CHECKED_EVERY), side - 1) + 0.5
        for side in (width, height)
    ]
    if _reaches(plan, *some).all():
        return None
    full = _reaches(plan, np.arange(width) + 0.5, np.arange(height) + 0.5)
    full.setflags(write=False)
    return full


def _reaches(
    plan: FramePlan, x: NDArray[np.floating[Any]], y: NDArray[np.floating[Any]]
) -> NDArray[np.bool_]:
    rays = bearing_rays(plan.processed, _grid(x, y))
    original_px = px_from_cam(plan.original, rays)
    inside = (
        (original_px >= 0) & (original_px <= [plan.original.width, plan.original.height])
    ).all(axis=1)
    return np.asarray((inside & sees(plan.original, rays, original_px)).reshape(len(y), len(x)))


def _grid(x: NDArray[np.floating[Any]], y: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)


@lru_cache(maxsize=4)
def _sampled_at(plan: FramePlan, samples: int) -> tuple[Float32, Float32]:
    """Return x and y, float32, where to sample the original; the first pixel's centre is (0, 0)."""
    import cv2

    width, height = plan.processed.width, plan.processed.height
    # the coordinates vary smoothly: compute them at the centres of blocks, and interpolate
    square = max(1, round(_INTERPOLATED_PX / max(plan.shrink, 1.0)))
    columns, rows = -(-width // square) + 2, -(-height // square) + 2
    x, y = ((np.arange(number) - 0.5) * square for number in (columns, rows))
    original_px = px_from_cam(plan.original, bearing_rays(plan.processed, _grid(x, y))) - 0.5
    original_px = original_px.reshape(rows, columns, 2).astype(np.float32)
    margin = square * samples
    if margin > 1:
        size = (margin * columns, margin * rows)
        original_px = np.asarray(cv2.resize(original_px, size, interpolation=cv2.INTER_LINEAR))
    original_px = original_px[margin:, margin:][: samples * height, : samples * width]
    maps = tuple(np.ascontiguousarray(original_px[..., k], np.float32) for k in (0, 1))
    for coordinates in maps:
        coordinates.setflags(write=False)
    return maps[0], maps[1]


_SIDE_STEP_PX = 8  # sides of preprocessed images are multiples of this


@dataclass(frozen=True, slots=True)
class FramePlan:
    """A camera before and after pre-processing; the pose does not change.

    ``resized`` is (width, height) before the crop; ``shrink`` is the number of original pixels per
    processed pixel, along a side.
    """

    original: Camera
    processed: Camera
    resized: tuple[int, int]
    shrink: float

    @property
    def warps(self) -> bool:
        return not same_lens(self.original, self.processed)

    @property
    def changes_pixels(self) -> bool:
        size = (self.processed.width, self.processed.height)
        return self.warps or size != (self.original.width, self.original.height)

    def original_of(self, estimated: Camera) -> Camera:
        """Return the original camera for an estimate of the processed camera."""
        if not self.changes_pixels:
            return estimated
        px = focal_px(self.original) / focal_px(self.processed)
        shift = np.subtract(principal_point_px(estimated), principal_point_px(self.processed)) * px
        camera = shift_principal_point(self.original, *shift.tolist())
        camera = scale_focal(camera, focal_px(estimated) / focal_px(self.processed))
        if camera.model in RADIAL_MODELS and estimated.model in RADIAL_MODELS:
            camera = with_distortion(camera, radial_distortion(estimated))
        return replace(camera, focal_deviation=estimated.focal_deviation)


def plan_frame(
    camera: Camera,
    *,
    max_size_px: int | None = None,
    upscale: bool = False,
    undistort: bool = False,
) -> FramePlan:
    """Plan the new size and projection of a camera's images; by default neither changes."""
    lens = undistorted_camera(camera) if undistort else camera
    warps = not same_lens(camera, lens)
    width, height = lens.width, lens.height
    if max_size_px is not None:
        width, height = fitted_size(lens.width, lens.height, max_size_px, upscale=upscale)
    processed = scaled_camera(lens, width, height)
    if warps or max_size_px is not None:
        cropped_width, cropped_height = cropped_size(width, height)
        processed = replace(processed, width=cropped_width, height=cropped_height)
    shrink = max(lens.width / width, lens.height / height)
    return FramePlan(camera, processed, (width, height), shrink)


def carry_points(source: Camera, target: Camera, points_px: NDArray[np.floating[Any]]) -> Floats:
    """Map points (N, 2) along their rays between cameras with the same centre and axes.

    Returns float64 (N, 2), NaN outside the target image.
    """
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    if same_lens(source, target):
        a, b = (np.array(with_two_focals(camera).params[:4]) for camera in (source, target))
        moved = (points - a[2:]) * (b[:2] / a[:2]) + b[2:]
    else:
        rays = bearing_rays(source, points)
        moved = px_from_cam(target, rays)
        moved[~(sees(source, rays, points) & sees(target, rays, moved))] = np.nan
    limit = np.array([target.width, target.height]) + _ROUNDING_PX
    moved[~((moved >= -_ROUNDING_PX) & (moved <= limit)).all(axis=1)] = np.nan
    return moved


def sees(camera: Camera, rays: Floats, points_px: Floats) -> NDArray[np.bool_]:
    """Return the mask (N,) of rays (N, 3) that match their pixels (N, 2).

    Distortion polynomials fold over: far rays may project to the pixels of rays nearer to the axis.
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
    """Return the size with a longer side of ``max_size_px``; enlarge only with ``upscale``."""
    larger = max(width, height)
    if larger <= max_size_px and not upscale:
        return width, height
    # round half up in integers: float rounding could differ between machines
    smaller = max(1, (2 * min(width, height) * max_size_px + larger) // (2 * larger))
    return (max_size_px, smaller) if width >= height else (smaller, max_size_px)


def cropped_size(width: int, height: int) -> tuple[int, int]:
    """Return a size cropped to multiples of 8 at the right and bottom, as feature maps need."""
    if min(width, height) < _SIDE_STEP_PX:
        raise OptionError(
            f"an image of {width}x{height} cannot be cropped to multiples of {_SIDE_STEP_PX}"
        )
    return width - width % _SIDE_STEP_PX, height - height % _SIDE_STEP_PX


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of a resized image, with two focal lengths if the scales differ."""
    scale_x, scale_y = width / camera.width, height / camera.height
    # compare integers: equal ratios may round to different floats
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
    """Resize an image (H, W, ...): area averaging to shrink, cubic interpolation to enlarge."""
    import cv2

    old_height, old_width = image.shape[:2]
    if (old_width, old_height) == (width, height):
        return image
    shrinks = width <= old_width and height <= old_height
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))


def undistorted_camera(camera: Camera) -> Camera:
    """Return the pinhole camera of an undistorted image without blank pixels."""
    if camera.model in PINHOLE_MODELS:
        return camera
    lens = with_two_focals(camera)
    if lens.model in _POLYNOMIAL_MODELS and not any(lens.params[4:]):
        return replace(lens, model="PINHOLE", params=lens.params[:4])
    return undistorted_pinhole(camera)
