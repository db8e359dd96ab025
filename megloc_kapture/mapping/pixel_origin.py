"""Pixel origin of a map of another tool.

COLMAP has (0, 0) at the corner of the first pixel, many networks and simulators at its centre.
Keypoints and intrinsics of one map need not agree. What can be measured is their offset: half a
pixel too much or too little shows in the reprojection error of the map's own points. Where the
two agree, the principal points tell which origin they share: a camera whose principal point is
((w - 1) / 2, (h - 1) / 2) exactly was described with the origin at the centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import principal_point_px, project
from megloc_kapture.values import Camera, RigidTransform

Origin = Literal["corner", "centre"]

_HALF = 0.5
# a smaller gain than this is noise, and the simpler explanation stands
_MIN_GAIN = 0.005


@dataclass(frozen=True, eq=False)
class ObservedKeypoints:
    """A map image with its observations.

    Attributes
    ----------
    keypoints_px : (K, 2), all of the image.
    rows, points : int (M,), rows of the keypoints and of the map's points that they observe.
    """

    name: str
    camera: Camera
    cam_from_world: RigidTransform
    keypoints_px: NDArray[np.floating]
    rows: NDArray[np.integer]
    points: NDArray[np.integer]

    def errors_px(self, xyz: NDArray[np.float64], shift_px: float = 0.0) -> NDArray[np.float64]:
        """Distances (M,) of the points (N, 3), seen by the camera, from the keypoints moved by
        ``shift_px``; NaN for a point behind it."""
        with np.errstate(invalid="ignore"):
            seen = project(self.camera, self.cam_from_world, xyz[self.points])
            return np.linalg.norm(seen - (self.keypoints_px[self.rows] + shift_px), axis=1)


@dataclass(frozen=True)
class PixelOrigin:
    """Pixel origin of a map, and the evidence for it.

    Attributes
    ----------
    intrinsics, keypoints : the origin each is stored with.
    error_px : median reprojection error with the intrinsics' origin taken as corner or centre,
        the keypoints' origin as found; NaN without observations.
    reason : in words.
    """

    intrinsics: Origin
    keypoints: Origin
    error_px: dict[Origin, float]
    reason: str

    @property
    def intrinsics_shift_px(self) -> float:
        """To be added to principal points to have COLMAP's."""
        return _HALF if self.intrinsics == "centre" else 0.0

    @property
    def keypoints_shift_px(self) -> float:
        """To be added to keypoints to have COLMAP's."""
        return _HALF if self.keypoints == "centre" else 0.0


def find_pixel_origin(
    images: Sequence[ObservedKeypoints],
    xyz: NDArray[np.float64],
    *,
    cameras: Sequence[Camera],
    keypoints_at: Origin | None = None,
) -> PixelOrigin:
    """Find the pixel origin of intrinsics and keypoints.

    Parameters
    ----------
    images : a sample of the map's images, keypoints as stored.
    xyz : (N, 3), all points.
    cameras : all cameras of the map.
    keypoints_at : the keypoints' origin where it is known.
    """
    errors = {shift: _median_error(images, xyz, shift) for shift in (0.0, _HALF, -_HALF)}
    centred = bool(cameras) and all(_centred_on_pixel(camera) for camera in cameras)
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
            where = "and no principal point says otherwise"
        fit = (
            "keypoints and intrinsics fit each other as stored"
            if images
            else "no observation to compare with"
        )
        reason = f"{fit}, {where}"
    shift_of_keypoints = _HALF if keypoints == "centre" else 0.0
    by_origin: dict[Origin, float] = {
        "corner": errors[shift_of_keypoints],
        "centre": errors[shift_of_keypoints - _HALF],
    }
    return PixelOrigin(intrinsics, keypoints, by_origin, reason)


def _median_error(
    images: Sequence[ObservedKeypoints], xyz: NDArray[np.float64], shift_px: float
) -> float:
    errors = [image.errors_px(xyz, shift_px) for image in images if len(image.rows)]
    return float(np.nanmedian(np.concatenate(errors))) if errors else float("nan")


def _centred_on_pixel(camera: Camera) -> bool:
    cx, cy = principal_point_px(camera)
    return cx == (camera.width - 1) / 2 and cy == (camera.height - 1) / 2
