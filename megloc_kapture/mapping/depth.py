"""Depth maps of map images, which lift keypoints to 3D points and verify triangulated points.

A point observed by an image must lie on the surface that the depth sensor measured there. The
tolerance covers the noise of sensor and point, and a small window allows for edges. Observations
without depth are kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from megloc_kapture.geometry.cameras import (
    STRUCTURED_LIGHT,
    bearing_rays,
    depth_noise,
    focal_px,
    px_from_cam,
)
from megloc_kapture.plugins import DepthView
from megloc_kapture.values import Camera, Options, RigidTransform

Floats = NDArray[np.float64]
# if the depth sensor is next to the camera, a keypoint's pixel in the depth map depends on its
# depth, so both are iterated; points that do not converge are hidden behind an edge
_ROUNDS = 6
_SETTLED = 0.01  # largest relative change of a converged depth in the last round
# standard deviations of estimated depth are for a keypoint noise of 1 / _PIXELS_OF_SIGMA pixels
_PIXELS_OF_SIGMA = 3.0
# if the four depths around a keypoint differ by more than this share of the smallest, the keypoint
# is on an edge and has no depth
MAX_DEPTH_JUMP = 0.1
# noise of triangulated points, from keypoints and map poses: with the sensor's noise alone, half
# the points would be rejected (docs/experiments/map-refinement.md)
KEYPOINT_NOISE_PX = 2.0
# a point may lie anywhere between the extreme depths within this many pixels: allows for edges and
# for misregistration of image and depth
_WINDOW_PX = 3
_SAME_CENTRE_M = 1e-9  # smaller offsets are rounding of composed transforms


def lift_keypoints(
    keypoints_px: NDArray[np.floating[Any]],
    depth_m: NDArray[np.float32],
    image_camera: Camera,
    depth_camera: Camera,
    image_from_depth: RigidTransform,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Lift an image's keypoints (N, 2 or more) to 3D with a depth map taken at the same time.

    Depth is interpolated between four pixels. If some are unknown, the nearest known one is used.

    Parameters
    ----------
    depth_m : float32 (H, W), along the depth camera's axis, 0 or less where unknown.
    image_from_depth : from the depth camera's frame to the image camera's, metres.

    Returns
    -------
    Points float64 (N, 3) in the image camera's frame, NaN without depth, and a validity mask (N,).
    """
    rays = bearing_rays(image_camera, np.asarray(keypoints_px, np.float64)[:, :2])
    depth_from_image = image_from_depth.inverse()
    points = np.full(rays.shape, np.nan)
    if not len(rays) or not (depth_m > 0).any():
        return points, np.zeros(len(rays), bool)
    same_centre = bool(np.linalg.norm(image_from_depth.translation) < _SAME_CENTRE_M)
    # if both cameras have the same centre, a ray projects to one pixel of the depth map
    z = np.full(len(rays), 1.0 if same_centre else float(np.median(depth_m[depth_m > 0])))
    settled = np.zeros(len(rays), bool)
    for _ in range(1 if same_centre else _ROUNDS):
        in_depth = depth_from_image.apply(rays * z[:, None])
        depth = sample_depth(depth_m, px_from_cam(depth_camera, in_depth), MAX_DEPTH_JUMP)
        with np.errstate(invalid="ignore", divide="ignore"):
            lifted = image_from_depth.apply(in_depth * (depth / in_depth[:, 2])[:, None])
            change = np.abs(lifted[:, 2] - z)
            settled = np.isfinite(depth) & (in_depth[:, 2] > 0) & (lifted[:, 2] > 0)
            if not same_centre:
                settled &= change <= _SETTLED * z
        z = np.where(np.isfinite(lifted[:, 2]) & (lifted[:, 2] > 0), lifted[:, 2], z)
    points[settled] = (rays * z[:, None])[settled]
    return points, settled


def lift_with_covariances(
    keypoints_px: NDArray[np.floating[Any]],
    depth_m: NDArray[np.float32],
    sigma_m: NDArray[np.float32],
    image_camera: Camera,
    depth_camera: Camera,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Lift keypoints with a depth map from the image's camera centre; also return covariances.

    ``sigma_m`` float32 (H, W) are the standard deviations of depth, 0 where unknown, for a keypoint
    noise of a third of a pixel, which pose estimation assumes for a map. Returns points (N, 3) in
    the camera's frame, their covariances (N, 3, 3) for a keypoint noise of 1 px, and a validity
    mask (N,).
    """
    same = RigidTransform.identity()
    points, valid = lift_keypoints(keypoints_px, depth_m, image_camera, depth_camera, same)
    pixels = np.floor(np.nan_to_num(px_from_cam(depth_camera, points))).astype(np.int64)
    rows = np.clip(pixels[:, 1], 0, depth_m.shape[0] - 1)
    columns = np.clip(pixels[:, 0], 0, depth_m.shape[1] - 1)
    along = sigma_m[rows, columns].astype(np.float64)
    valid &= along > 0
    across = np.square(points[:, 2] / focal_px(image_camera))
    rays = points / points[:, 2:]
    covariances = np.square(_PIXELS_OF_SIGMA * along)[:, None, None] * (
        rays[:, :, None] * rays[:, None, :]
    )
    covariances[:, 0, 0] += across
    covariances[:, 1, 1] += across
    return points, covariances, valid


def sample_depth(
    depth_m: NDArray[np.float32], pixels: Floats, max_jump: float, *, whole: bool = False
) -> Floats:
    """Return interpolated depths (N,) at pixels (N, 2), see :func:`lift_keypoints`.

    Depths are NaN outside the map, where depth is unknown, and where neighbours differ by more than
    ``max_jump`` times the smallest. ``whole`` requires all four neighbours to be known.
    """
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
    upper, lower = ((1 - right) * side for side in (1 - bottom, bottom))
    weights = np.stack([upper, right * (1 - bottom), lower, right * bottom])
    measured = np.isfinite(corners) & (corners > 0)
    smooth = (weights * corners).sum(axis=0)
    nearest = np.take_along_axis(corners, np.where(measured, weights, -1.0).argmax(0)[None], 0)[0]
    depth = np.where(measured.all(axis=0), smooth, nearest)
    low = np.where(measured, corners, np.inf).min(axis=0)
    high = np.where(measured, corners, -np.inf).max(axis=0)
    known = measured.all(axis=0) if whole else measured.any(axis=0)
    usable = known & (high - low <= max_jump * low)
    result[inside] = np.where(usable, depth, np.nan)
    return result


class DepthVerificationOptions(Options):
    """Options for depth verification.

    The default noise is that of a structured-light sensor: 0.0012 + 0.0019 (z - 0.4)^2 (Nguyen et
    al., 3DIMPVT 2012, eq. 4). For a laser scan use about ``[0.003, 0, 0]``.
    """

    max_sigmas: float | None = Field(
        default=3.0,
        gt=0,
        description="largest difference from the sensor's depth, in standard deviations; "
        "observations beyond it are dropped; none: ignore depth maps",
    )
    noise: tuple[float, float, float] = Field(
        default=STRUCTURED_LIGHT,
        description="a, b, c of the depth noise a + b z + c z^2 at depth z, in map units",
    )

    @field_validator("noise")
    @classmethod
    def _positive(cls, noise: tuple[float, float, float]) -> tuple[float, float, float]:
        a, b, c = noise
        # the parabola's minimum is at z = -b / 2c if that is positive, else at 0
        lowest = a - b * b / (4.0 * c) if c > 0 and b < 0 else a
        if not np.isfinite(noise).all() or lowest <= 0 or c < 0 or (c == 0 and b < 0):
            raise ValueError("noise must be positive at every depth")
        return noise


def compare_with_depth(
    points_in_image: Floats,
    depth: DepthView,
    options: DepthVerificationOptions,
    sigmas: Floats | float = 0.0,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Compare points (N, 3), in the image camera's frame, with the surface of a depth map.

    ``sigmas`` are the points' standard deviations along the depth camera's axis; NaN, for unknown,
    counts as 0. Returns masks (N,): points in front of the surface, behind it, and points that have
    depth to compare with.
    """
    points = depth.image_from_depth.inverse().apply(np.asarray(points_in_image, np.float64))
    before, behind, checked = np.zeros((3, len(points)), bool)
    if options.max_sigmas is None or not len(points):
        return before, behind, checked
    height, width = depth.depth_m.shape
    pixels = px_from_cam(depth.camera, points)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    rows = np.flatnonzero(inside)
    column, line = np.floor(pixels[rows]).astype(np.int64).T
    reach = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
    columns = np.clip(column[:, None, None] + reach[None, None, :], 0, width - 1)
    lines = np.clip(line[:, None, None] + reach[None, :, None], 0, height - 1)
    window = depth.depth_m[lines, columns].reshape(len(rows), len(reach) ** 2).astype(np.float64)
    known = np.isfinite(window) & (window > 0)
    # skip points next to a hole, where the sensor may have missed the surface
    whole = known.all(axis=1)
    rows, window = rows[whole], window[whole]
    z, low, high = points[rows, 2], window.min(axis=1), window.max(axis=1)
    point_sigmas = np.nan_to_num(np.broadcast_to(sigmas, len(points))[rows])
    below, above = (
        options.max_sigmas * np.hypot(depth_noise(limit, options.noise), point_sigmas)
        for limit in (low, high)
    )
    checked[rows] = True
    before[rows] = z < low - below
    behind[rows] = z > high + above
    return before, behind, checked
