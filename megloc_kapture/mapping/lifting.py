"""Keypoints to 3D points through a depth map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, px_from_cam
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]

# a depth sensor beside the camera sees each point at a pixel that depends on its depth; a few
# rounds find it, and what has not settled to a hundredth of its depth lies behind an edge
_ROUNDS = 6
_SETTLED = 0.01
_SAME_CENTRE_M = 1e-9  # an offset that is left over from composing transforms


class LiftingOptions(Options):
    """Which depths are trusted."""

    max_jump: float = Field(
        default=0.1,
        gt=0,
        description="the four depths around a keypoint may differ by this share of the smallest; "
        "beyond, it lies on an edge and has no depth",
    )


def lift_keypoints(
    keypoints_px: NDArray[np.floating[Any]],
    depth_m: NDArray[np.float32],
    image_camera: Camera,
    depth_camera: Camera,
    image_from_depth: RigidTransform,
    options: LiftingOptions | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """3D points of an image's keypoints, through a depth map of the same moment.

    Depth is interpolated between the four pixels around a keypoint; where some of them have none,
    the nearest that has counts.

    Parameters
    ----------
    keypoints_px : (N, 2 or more), x and y first, in the image; COLMAP's pixel origin.
    depth_m : float32 (H, W), along the depth camera's axis, 0 or less where unknown.
    image_from_depth : from the depth camera's frame to the image camera's, metres.

    Returns
    -------
    points : float64 (N, 3) in the image camera's frame, metres; NaN where there is no depth.
    valid : bool (N,).
    """
    options = options or LiftingOptions()
    rays = bearing_rays(image_camera, np.asarray(keypoints_px, np.float64)[:, :2])
    depth_from_image = image_from_depth.inverse()
    known = depth_m[depth_m > 0]
    points = np.full(rays.shape, np.nan)
    if not len(known) or not len(rays):
        return points, np.zeros(len(rays), bool)
    same_centre = bool(np.linalg.norm(image_from_depth.translation) < _SAME_CENTRE_M)
    z = np.full(len(rays), float(np.median(known)))
    settled = np.zeros(len(rays), bool)
    for _ in range(1 if same_centre else _ROUNDS):
        in_depth = depth_from_image.apply(rays * z[:, None])
        depth = _sample(depth_m, px_from_cam(depth_camera, in_depth), options.max_jump)
        with np.errstate(invalid="ignore", divide="ignore"):
            lifted = image_from_depth.apply(in_depth * (depth / in_depth[:, 2])[:, None])
            change = np.abs(lifted[:, 2] - z)
            settled = np.isfinite(depth) & (in_depth[:, 2] > 0) & (lifted[:, 2] > 0)
            if not same_centre:
                settled &= change <= _SETTLED * z
        z = np.where(np.isfinite(lifted[:, 2]) & (lifted[:, 2] > 0), lifted[:, 2], z)
    points[settled] = (rays * z[:, None])[settled]
    return points, settled


def _sample(depth_m: NDArray[np.float32], pixels: Floats, max_jump: float) -> Floats:
    """Depth at pixels (N, 2), float64 (N,); NaN where it is unknown or jumps."""
    height, width = depth_m.shape
    result = np.full(len(pixels), np.nan)
    inside = np.isfinite(pixels).all(axis=1)
    inside &= (pixels >= 0).all(axis=1) & (pixels[:, 0] <= width) & (pixels[:, 1] <= height)
    # in array coordinates the centre of the first pixel is (0, 0)
    x, y = (pixels[inside] - 0.5).T
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    columns = np.clip(np.stack([left, left + 1, left, left + 1]), 0, width - 1)
    rows = np.clip(np.stack([top, top, top + 1, top + 1]), 0, height - 1)
    corners = depth_m[rows, columns].astype(np.float64)
    right, bottom = x - left, y - top
    weights = np.stack(
        [
            (1 - right) * (1 - bottom),
            right * (1 - bottom),
            (1 - right) * bottom,
            right * bottom,
        ]
    )
    there = np.isfinite(corners) & (corners > 0)
    smooth = (weights * corners).sum(axis=0)
    nearest = np.take_along_axis(corners, np.where(there, weights, -1.0).argmax(0)[None], 0)[0]
    depth = np.where(there.all(axis=0), smooth, nearest)
    low = np.where(there, corners, np.inf).min(axis=0)
    high = np.where(there, corners, -np.inf).max(axis=0)
    usable = there.any(axis=0) & (high - low <= max_jump * low)
    result[inside] = np.where(usable, depth, np.nan)
    return result
