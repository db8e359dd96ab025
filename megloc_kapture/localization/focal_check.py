"""Whether a camera's focal length fits the matches of its pose.

A wrong focal length hides in the pose: the camera is moved nearer or farther, and most matches
still agree. What gives it away is perspective. The pose is refined once more with the focal length
set free (Gauss-Newton on rays, Cauchy weights); where it moves by far more than its own
uncertainty, the camera is said not to fit. Of a flat scene seen straight on nothing can be said.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import focal_px, normalized_from_px
from megloc_kapture.localization.estimation import PoseProblem
from megloc_kapture.values import Pose

# errors of a map are alike in neighbouring points: the deviation is too small by some factor
_MIN_CHANGE, _MIN_SIGMAS = 0.04, 5.0
_MIN_INLIERS = 30
_ROUNDS = 12
_SMALL_STEP = 1e-4


def focal_remark(problem: PoseProblem, pose: Pose) -> str | None:
    """In words, that another focal length fits better; None where the given one may be right.

    Parameters
    ----------
    problem : of one camera on its own; of a rig nothing is said.
    pose : of it, with its inliers.
    """
    if len(problem.views) != 1 or pose.inliers is None or pose.num_inliers < _MIN_INLIERS:
        return None
    (view,) = problem.views
    rays = normalized_from_px(view.camera, problem.points_px[pose.inliers])
    points = problem.points[pose.inliers] + problem.offset
    cam_from_world = view.cam_from_rig @ pose.cam_from_world
    found = _freed_focal(cam_from_world.apply(points), rays)
    if found is None:
        return None
    scale, deviation = found
    if abs(math.log(scale)) < max(_MIN_CHANGE, _MIN_SIGMAS * deviation):
        return None
    given = focal_px(view.camera)
    return (
        f"the focal length of {given:.0f} px does not fit: {scale * given:.0f} +- "
        f"{scale * deviation * given:.0f} px would"
    )


def _freed_focal(
    points: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[float, float] | None:
    """The factor by which the focal length fits best, and the deviation of its logarithm.

    Parameters
    ----------
    points : (N, 3) in the camera.
    rays : (N, 2) of the pixels, by the given focal length.
    """
    log_scale = 0.0
    for _ in range(_ROUNDS):
        ahead = points[:, 2] > 0
        if ahead.sum() < _MIN_INLIERS:
            return None
        x, y, z = points[ahead].T
        u, v = x / z, y / z
        scale = math.exp(log_scale)
        residuals = np.stack([scale * u, scale * v], axis=1) - rays[ahead]
        zero = np.zeros_like(u)
        # columns: a left rotation, a translation in the camera, the logarithm of the scale
        jacobian = scale * np.stack(
            [
                np.stack([-u * v, 1 + u * u, -v, 1 / z, zero, -u / z, u], axis=1),
                np.stack([-1 - v * v, u * v, u, zero, 1 / z, -v / z, v], axis=1),
            ],
            axis=1,
        )
        squared = (residuals**2).sum(axis=1)
        variance = max(float(np.median(squared)) / (2 * math.log(2)), 1e-14)
        weights = 1 / (1 + squared / (5.7 * variance))
        information = np.einsum("nik,n,nil->kl", jacobian, weights, jacobian)
        gradient = np.einsum("nik,n,ni->k", jacobian, weights, residuals)
        size = np.sqrt(np.diagonal(information)) + 1e-300
        values, vectors = np.linalg.eigh(information / np.outer(size, size))
        if values[0] < 1e-10 * values[-1]:
            return None
        covariance = vectors @ np.diag(1 / values) @ vectors.T / np.outer(size, size)
        step = -covariance @ gradient
        deviation = math.sqrt(variance * covariance[6, 6])
        if not np.isfinite(step).all() or abs(log_scale + step[6]) > 1.5:
            return None
        points = points + np.cross(step[:3], points) + step[3:6]
        log_scale += float(step[6])
        if abs(step[6]) < _SMALL_STEP:
            break
    return math.exp(log_scale), deviation
