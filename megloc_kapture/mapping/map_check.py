"""Checks of a prebuilt map: its pixel origin, and its consistency.

COLMAP's pixel origin is the corner of the first pixel; many networks and simulators use its centre.
If keypoints and intrinsics have different origins, the reprojection error shows it. Otherwise
principal points at exactly ((w - 1) / 2, (h - 1) / 2) indicate the centre.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import (
    focal_px,
    normalized_from_px,
    principal_point_px,
    project,
    scale_focal,
)
from megloc_kapture.geometry.poses import CONVENTIONS
from megloc_kapture.values import Camera, RigidTransform

Origin = Literal["corner", "centre"]
Floats = NDArray[np.float64]

_HALF = 0.5
_MIN_GAIN = 0.005  # a smaller relative decrease of the reprojection error is noise
# largest median error of an image: a share of its longer side, or the second value if larger
_MAX_SHARE, _MIN_LIMIT_PX = 0.01, 8.0
_MAX_FAILING = 0.2  # largest share of failing images; even a good map has some wrong poses


@dataclass(frozen=True, eq=False)
class ObservedKeypoints:
    """A map image with keypoints (K, 2) and observations.

    ``rows`` and ``points`` (M,) are the rows of the observed keypoints and of their map points.
    """

    name: str
    camera: Camera
    cam_from_world: RigidTransform
    keypoints_px: NDArray[np.floating]
    rows: NDArray[np.integer]
    points: NDArray[np.integer]

    def errors_px(self, xyz: Floats, shift_px: float = 0.0) -> Floats:
        """Return reprojection errors (M,); NaN behind the camera.

        ``xyz`` (N, 3) are all map points; ``shift_px`` is added to the keypoints.
        """
        with np.errstate(invalid="ignore"):
            seen = project(self.camera, self.cam_from_world, xyz[self.points])
            return np.linalg.norm(seen - (self.keypoints_px[self.rows] + shift_px), axis=1)


@dataclass(frozen=True)
class PixelOrigin:
    """Pixel origins of a map as stored, and the reason for this result.

    ``error_px`` has the median reprojection error for each assumed origin of the intrinsics; NaN
    without observations.
    """

    intrinsics: Origin
    keypoints: Origin
    error_px: dict[Origin, float]
    reason: str

    @property
    def intrinsics_shift_px(self) -> float:
        """Return the shift of principal points to COLMAP's origin."""
        return _HALF if self.intrinsics == "centre" else 0.0

    @property
    def keypoints_shift_px(self) -> float:
        """Return the shift of keypoints to COLMAP's origin."""
        return _HALF if self.keypoints == "centre" else 0.0


def find_pixel_origin(
    images: Sequence[ObservedKeypoints],
    xyz: Floats,
    *,
    cameras: Sequence[Camera],
    keypoints_at: Origin | None = None,
) -> PixelOrigin:
    """Find the pixel origin of intrinsics and keypoints from a sample of map images.

    ``keypoints_at`` is the keypoints' origin if known.
    """
    observed = [image for image in images if len(image.rows)]
    errors = {
        shift: float(np.nanmedian(np.concatenate([i.errors_px(xyz, shift) for i in observed])))
        if observed
        else math.nan
        for shift in (0.0, _HALF, -_HALF)
    }
    centred = bool(cameras) and all(
        principal_point_px(c) == ((c.width - 1) / 2, (c.height - 1) / 2) for c in cameras
    )
    shared: Origin = keypoints_at or ("centre" if centred else "corner")
    best = 0.0
    for shift in (_HALF, -_HALF):
        if errors[shift] < (1.0 - _MIN_GAIN) * errors[best]:
            best = shift
    intrinsics: Origin
    keypoints: Origin
    if best > 0:
        intrinsics, keypoints = "corner", "centre"
        reason = "the points reproject best with half a pixel added to the keypoints"
    elif best < 0:
        intrinsics, keypoints = "centre", "corner"
        reason = "the points reproject best with half a pixel added to the principal points"
    else:
        intrinsics = keypoints = shared
        if keypoints_at:
            where = "and the origin of this keypoints type is known"
        elif centred:
            where = "and every principal point is ((w-1)/2, (h-1)/2)"
        else:
            where = "so COLMAP's corner is assumed"
        fit = "keypoints and intrinsics have the same origin"
        reason = f"{fit if observed else 'no observation to compare with'}, {where}"
    shift_of_keypoints = _HALF if keypoints == "centre" else 0.0
    by_origin: dict[Origin, float] = {
        "corner": errors[shift_of_keypoints],
        "centre": errors[shift_of_keypoints - _HALF],
    }
    return PixelOrigin(intrinsics, keypoints, by_origin, reason)


def map_fault(images: Sequence[ObservedKeypoints], xyz: Floats) -> str | None:
    """Return why a map contradicts itself; None if it is consistent.

    ``images`` is a sample sorted by name; ``xyz`` are all points, float64 (N, 3).
    """
    if not np.isfinite(xyz).all():
        count = int((~np.isfinite(xyz).all(axis=1)).sum())
        return f"{count} of {len(xyz)} points are not finite"
    for image in images:
        if not np.isfinite(image.keypoints_px).all():
            return f"keypoints of {image.name} are not finite"
        if reason := camera_fault(image.camera):
            return f"the camera of {image.name} is impossible: {reason}"
    observed = [image for image in images if len(image.rows)]
    if not observed:
        return None
    poses = (image.cam_from_world for image in images)
    rounded = {tuple(round(v, 9) for v in (*p.quat_wxyz, *p.translation)) for p in poses}
    if len(images) > 2 and len(rounded) == 1:
        return f"all {len(images)} images have the same pose"
    errors = _median_errors_px(observed, xyz)
    sides = (max(image.camera.width, image.camera.height) for image in observed)
    limits = [max(_MIN_LIMIT_PX, _MAX_SHARE * side) for side in sides]
    checked = zip(observed, errors, limits, strict=True)
    failing = [image.name for image, error, limit in checked if not error <= limit]
    if len(failing) <= _MAX_FAILING * len(observed):
        return None
    message = (
        f"the points do not fit the keypoints: {len(failing)} of {len(observed)} images, such as "
        f"{failing[0]}, have a median reprojection error above {min(limits):.3g} px; "
    )
    median = float(np.median(errors))
    if np.isfinite(median):
        message += f"the median over these images is {median:.3g} px"
    else:
        message += "most points are behind the cameras"
    best, error = _likely_mistake(observed, xyz)
    if error > max(np.median(limits) / 2, 4.0) or error > np.median(errors) / 4:
        return message
    return f"{message}; with {best} it would be {error:.2g} px"


def camera_fault(camera: Camera) -> str | None:
    """Return why intrinsics are impossible; None if they are possible."""
    size = max(camera.width, camera.height)
    cx, cy = principal_point_px(camera)
    if not (-size <= cx <= 2 * size and -size <= cy <= 2 * size):
        return f"the principal point is ({cx:g}, {cy:g}) in {camera.width}x{camera.height} pixels"
    focal = focal_px(camera)
    if not 0.05 * size <= focal <= 100 * size:
        return f"the focal length is {focal:g} px in {camera.width}x{camera.height} pixels"
    # distortion of a real lens is moderate halfway to the borders
    halfway = np.array([[0.25, 0.5], [0.75, 0.5], [0.5, 0.25], [0.5, 0.75]])
    pixels = halfway * (camera.width, camera.height)
    rays = normalized_from_px(camera, pixels)
    if not np.isfinite(rays).all():
        return "its distortion is not invertible halfway to the image's border"
    flat = (pixels - (cx, cy)) / focal
    lengths, straight = np.linalg.norm(rays, axis=1), np.linalg.norm(flat, axis=1)
    ratios = lengths[straight > 0.02] / straight[straight > 0.02]
    if len(ratios) and not (ratios.min() > 0.5 and ratios.max() < 3.0):
        farthest = max(ratios.tolist(), key=lambda ratio: abs(math.log(max(ratio, 1e-6))))
        return f"its distortion divides image radii by {farthest:.2g}"
    return None


def _median_errors_px(images: Iterable[ObservedKeypoints], xyz: Floats) -> Floats:
    """Return median reprojection errors of images; infinite if most points are behind a camera."""
    errors = (image.errors_px(xyz) for image in images)
    return np.array([np.median(np.where(np.isfinite(each), each, np.inf)) for each in errors])


def _likely_mistake(images: Sequence[ObservedKeypoints], xyz: Floats) -> tuple[str, float]:
    """Return the interpretation of the map with the smallest error, and its median error."""
    best = ("", np.inf)
    for name, read_images in _readings(images, xyz):
        error = float(np.median(_median_errors_px(read_images, xyz)))
        # of interpretations with similar errors take the first, which is the simplest
        if error < 0.9 * best[1]:
            best = (name, error)
    return best


def _readings(
    images: Sequence[ObservedKeypoints], xyz: Floats
) -> Iterator[tuple[str, list[ObservedKeypoints]]]:
    """Yield the images in other interpretations of the map."""
    yield (
        "keypoints read as (y, x)",
        [replace(image, keypoints_px=image.keypoints_px[:, ::-1]) for image in images],
    )
    for name, convention in CONVENTIONS.items():
        yield name, [replace(i, cam_from_world=convention(i.cam_from_world)) for i in images]
    factors = _factors(images, xyz)
    if (scale := factors.get("keypoints")) is not None:
        yield (
            f"keypoints multiplied by {scale:.3g}",
            [replace(i, keypoints_px=i.keypoints_px.astype(np.float64) * scale) for i in images],
        )
    if (longer := factors.get("focal")) is not None:
        yield (
            f"a focal length {longer:.3g} times as long",
            [replace(image, camera=scale_focal(image.camera, longer)) for image in images],
        )


def _factors(images: Sequence[ObservedKeypoints], xyz: Floats) -> dict[str, float]:
    """Return the scale factors of keypoints and of focal length that fit best."""
    of_keypoints, of_focal = [], []
    for image in images:
        pixels = image.keypoints_px[image.rows].astype(np.float64)
        with np.errstate(all="ignore"):
            seen = project(image.camera, image.cam_from_world, xyz[image.points])
            of_keypoints.append((seen / pixels).ravel())
            centre = np.array(principal_point_px(image.camera))
            of_focal.append(((pixels - centre) / (seen - centre)).ravel())
    ratios = {"keypoints": np.concatenate(of_keypoints), "focal": np.concatenate(of_focal)}
    finite = {name: each[np.isfinite(each)] for name, each in ratios.items()}
    medians = {name: float(np.median(each)) for name, each in finite.items() if len(each)}
    return {name: value for name, value in medians.items() if 0.02 < value < 50.0}
