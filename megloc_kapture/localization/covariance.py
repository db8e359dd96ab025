"""Covariance of an estimated camera pose.

First-order propagation (Hartley and Zisserman, Multiple View Geometry, section 5.2.2): with J the
Jacobian of the reprojections with respect to the pose, the covariance is
``sigma^2 (J^T J)^-1``, sigma estimated from the residuals.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.values import Camera, RigidTransform


def projection_jacobian(camera: Camera, points_in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative of pixels with respect to points in the camera frame: (N, 2, 3) float64.

    By central differences, so that every COLMAP camera model is covered; the step is relative
    to the depth.
    """
    step = 1e-6 * np.maximum(points_in_cam[:, 2], 1e-12)
    jacobian = np.empty((len(points_in_cam), 2, 3))
    for axis in range(3):
        delta = np.zeros_like(points_in_cam)
        delta[:, axis] = step
        forward = px_from_cam(camera, points_in_cam + delta)
        backward = px_from_cam(camera, points_in_cam - delta)
        jacobian[:, :, axis] = (forward - backward) / (2.0 * step[:, None])
    return jacobian


def pose_covariance(
    cam_from_world: RigidTransform,
    camera: Camera,
    points_px: NDArray[np.floating[Any]],
    points_world: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of a pose from its inliers.

    Order: rotation in radians, then translation in the unit of the map, both of a left
    perturbation: ``cam_from_world_true = exp(rotation, translation) cam_from_world``.

    Returns None when the inliers do not determine the pose.
    """
    points = cam_from_world.apply(points_world)
    residuals = px_from_cam(camera, points) - points_px
    usable = np.isfinite(residuals).all(axis=1)
    points, residuals = points[usable], residuals[usable]
    count = len(points)
    if count < 4:
        return None
    by_point = projection_jacobian(camera, points)
    # d(R x + t) of a left perturbation: -[p]_x for the rotation, identity for the translation
    jacobian = np.empty((count, 2, 6))
    x, y, z = points.T
    minus_cross = np.zeros((count, 3, 3))
    minus_cross[:, 0, 1], minus_cross[:, 0, 2] = z, -y
    minus_cross[:, 1, 0], minus_cross[:, 1, 2] = -z, x
    minus_cross[:, 2, 0], minus_cross[:, 2, 1] = y, -x
    jacobian[:, :, :3] = by_point @ minus_cross
    jacobian[:, :, 3:] = by_point
    stacked = jacobian.reshape(-1, 6)
    # columns differ by the scene's scale: equilibrate before judging the condition
    scale = np.linalg.norm(stacked, axis=0)
    if not np.isfinite(scale).all() or (scale == 0).any():
        return None
    information = (stacked / scale).T @ (stacked / scale)
    if np.linalg.cond(information) > 1e12:
        return None
    degrees_of_freedom = max(2 * count - 6, 1)
    # a floor of a tenth of a pixel: a handful of perfect matches is no proof of perfection
    sigma2 = max(float((residuals**2).sum()) / degrees_of_freedom, 0.1**2)
    inverse = np.linalg.inv(information)
    return np.asarray(sigma2 * inverse / np.outer(scale, scale))
