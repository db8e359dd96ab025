"""Where a pixel of a processed image is in the original one, and the reverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, normalized_from_px, px_from_cam
from megloc_kapture.preprocessing.resizing import with_two_focals
from megloc_kapture.preprocessing.undistortion import PINHOLE_MODELS
from megloc_kapture.values import Camera

# a point may leave the image by rounding
_ROUNDING_PX = 1e-6
# two that are one up to what COLMAP's iterations leave
_SAME_PX = 1e-3

Floats = NDArray[np.float64]


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
    """Whether two cameras differ by their focal lengths and principal points at most."""
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
    """Whether each ray (N, 3) and pixel (N, 2) of a camera belong to each other, bool (N,).

    The polynomials of the models fold over beyond some angle: a ray out there has a pixel too,
    but it is that of a ray nearer to the axis.
    """
    if camera.model in PINHOLE_MODELS:
        return np.asarray(np.isfinite(points_px).all(axis=1))
    focals = np.array(with_two_focals(camera).params[:2])
    off = (normalized_from_px(camera, points_px) - rays[:, :2]) * focals
    again = px_from_cam(camera, rays) - points_px
    return np.asarray((np.hypot(*off.T) <= _SAME_PX) & (np.hypot(*again.T) <= _SAME_PX))
