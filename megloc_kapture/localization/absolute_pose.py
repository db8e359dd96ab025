"""Absolute pose of one camera from 2D-3D matches.

LO-RANSAC over P3P and non-linear refinement by poselib; the same seed gives the same pose. A
failure is a falsy value with its reason, never an invented pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import bearing_rays, focal_px, px_from_cam
from megloc_kapture.localization.covariance import pose_covariance
from megloc_kapture.values import Camera, Failure, Options, Pose, RigidTransform


class AbsolutePoseOptions(Options):
    """Options of the pose estimation."""

    max_error_px: float = Field(default=12.0, gt=0, description="reprojection error of an inlier")
    min_inliers: int = Field(default=12, ge=4, description="fewer is a failure")
    min_iterations: int = Field(default=1000, gt=0)
    max_iterations: int = Field(default=20_000, gt=0)
    confidence: float = Field(default=0.9999, gt=0, lt=1)
    robust_scale_px: float = Field(default=1.0, gt=0, description="of the Cauchy loss")
    seed: int = Field(default=0, ge=0)


@dataclass(frozen=True, eq=False)
class _Estimate:
    cam_from_world: RigidTransform
    inliers: NDArray[np.bool_]


def absolute_pose(
    points_px: NDArray[np.floating[Any]],
    points_world: NDArray[np.float64],
    camera: Camera,
    options: AbsolutePoseOptions | None = None,
) -> Pose | Failure:
    """Estimate ``cam_from_world``.

    Parameters
    ----------
    points_px : (N, 2), first pixel's centre at (0.5, 0.5).
    points_world : float64 (N, 3).

    Returns
    -------
    Pose with inlier mask and covariance, or Failure with the reason.
    """
    options = options or AbsolutePoseOptions()
    count = len(points_px)
    if count < options.min_inliers:
        return Failure(
            f"{count} 2D-3D matches, at least {options.min_inliers} are needed",
            num_matches=count,
        )
    # far from the origin (ECEF) float64 loses what a recentred world keeps
    offset = np.median(points_world, axis=0)
    local = points_world - offset
    estimate = _estimate(points_px, local, camera, options)
    num_inliers = int(estimate.inliers.sum())
    if num_inliers < options.min_inliers:
        return Failure(
            f"{num_inliers} of {count} 2D-3D matches agree, at least {options.min_inliers} "
            "are needed",
            num_matches=count,
            num_inliers=num_inliers,
        )
    pose = estimate.cam_from_world
    covariance = pose_covariance(pose, camera, points_px[estimate.inliers], local[estimate.inliers])
    if covariance is None:
        return Failure(
            "the pose is not determined by its inliers (degenerate configuration)",
            num_matches=count,
            num_inliers=num_inliers,
        )
    # a left perturbation acts in the camera frame: the covariance does not see the offset
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    world = RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))
    return Pose(
        cam_from_world=world,
        num_matches=count,
        num_inliers=num_inliers,
        inliers=estimate.inliers,
        covariance=covariance,
    )


def _estimate(
    points_px: NDArray[np.floating[Any]],
    points: NDArray[np.float64],
    camera: Camera,
    options: AbsolutePoseOptions,
) -> _Estimate:
    import poselib

    # undistorted pixels of a pinhole with the same focal length: poselib's own list of camera
    # models is shorter than COLMAP's
    focal = focal_px(camera)
    rays = bearing_rays(camera, points_px)
    usable = np.isfinite(rays).all(axis=1) & np.isfinite(points).all(axis=1)
    pinhole = {
        "model": "PINHOLE",
        "width": 1,
        "height": 1,
        "params": [focal, focal, 0.0, 0.0],
    }
    found, _ = poselib.estimate_absolute_pose(
        np.ascontiguousarray(rays[usable, :2] * focal),
        np.ascontiguousarray(points[usable]),
        pinhole,
        {
            "max_reproj_error": options.max_error_px,
            "min_iterations": options.min_iterations,
            "max_iterations": options.max_iterations,
            "success_prob": options.confidence,
            "seed": options.seed,
        },
        {"loss_type": "CAUCHY", "loss_scale": options.robust_scale_px},
    )
    quat = np.asarray(found.q, dtype=np.float64)
    quat = quat / np.linalg.norm(quat)
    t = np.asarray(found.t, dtype=np.float64)
    pose = RigidTransform(
        (float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])),
        (float(t[0]), float(t[1]), float(t[2])),
    )
    errors = np.linalg.norm(px_from_cam(camera, pose.apply(points)) - points_px, axis=1)
    return _Estimate(pose, np.nan_to_num(errors, nan=np.inf) <= options.max_error_px)
