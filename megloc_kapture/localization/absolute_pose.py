"""Absolute pose of one camera from 2D-3D matches.

LO-RANSAC over P3P by poselib, then robust refinement whose scale follows the residuals: a map
that is good to a tenth of a pixel and one that is good to three need different ones (figures in
docs/choices.md). The same seed gives the same pose. A failure is a falsy value with its reason,
never an invented pose.
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

_REFINEMENTS = 2
_MIN_SIGMA_PX = 0.1
# the scale at which the Cauchy loss has 95 % of least squares' efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385


class AbsolutePoseOptions(Options):
    """Options of the pose estimation."""

    max_error_px: float = Field(default=12.0, gt=0, description="reprojection error of an inlier")
    min_inliers: int = Field(default=12, ge=4, description="fewer is a failure")
    min_iterations: int = Field(default=1000, gt=0)
    max_iterations: int = Field(default=20_000, gt=0)
    confidence: float = Field(default=0.9999, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)

    def for_poselib(self) -> dict[str, Any]:
        """The RANSAC options in poselib's names."""
        return {
            "max_reproj_error": self.max_error_px,
            "min_iterations": self.min_iterations,
            "max_iterations": self.max_iterations,
            "success_prob": self.confidence,
            "seed": self.seed,
        }


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
    finite = np.isfinite(points_world).all(axis=1)
    offset = np.median(points_world[finite], axis=0) if finite.any() else np.zeros(3)
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
    return Pose(
        cam_from_world=undo_recentring(pose, offset),
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
    # a camera's distortion cannot be undone everywhere: such rays are NaN
    usable = np.asarray(np.isfinite(rays).all(axis=1) & np.isfinite(points).all(axis=1))
    if usable.sum() < options.min_inliers:
        return _Estimate(RigidTransform.identity(), np.zeros(len(usable), dtype=np.bool_))
    pinhole = poselib_pinhole(focal)
    found, _ = poselib.estimate_absolute_pose(
        np.ascontiguousarray(rays[usable, :2] * focal),
        np.ascontiguousarray(points[usable]),
        pinhole,
        options.for_poselib(),
        {"loss_type": "CAUCHY", "loss_scale": 1.0},
    )
    pose = rigid_from_poselib(found)
    errors = np.where(usable, _errors_px(pose, points_px, points, camera), np.inf)
    for _ in range(_REFINEMENTS):
        inliers = errors <= options.max_error_px
        if inliers.sum() < options.min_inliers:
            break
        # the median of a Rayleigh distribution is 1.1774 sigma
        sigma = max(float(np.median(errors[inliers])) / 1.1774, _MIN_SIGMA_PX)
        found, _ = poselib.refine_absolute_pose(
            np.ascontiguousarray(rays[inliers, :2] * focal),
            np.ascontiguousarray(points[inliers]),
            found,
            pinhole,
            {"loss_type": "CAUCHY", "loss_scale": _CAUCHY_EFFICIENT * sigma},
        )
        pose = rigid_from_poselib(found)
        errors = np.where(usable, _errors_px(pose, points_px, points, camera), np.inf)
    return _Estimate(pose, errors <= options.max_error_px)


def poselib_pinhole(focal: float) -> dict[str, Any]:
    """A camera for undistorted pixels measured from the principal point."""
    return {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}


def undo_recentring(pose: RigidTransform, offset: NDArray[np.float64]) -> RigidTransform:
    """``cam_from_world`` of a pose estimated in a world moved by minus ``offset`` (3,)."""
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    return RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


def rigid_from_poselib(found: Any) -> RigidTransform:
    """poselib's pose as ours, its quaternion of unit length."""
    quat = np.asarray(found.q, dtype=np.float64)
    quat = quat / np.linalg.norm(quat)
    t = np.asarray(found.t, dtype=np.float64)
    return RigidTransform(
        (float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])),
        (float(t[0]), float(t[1]), float(t[2])),
    )


def _errors_px(
    pose: RigidTransform,
    points_px: NDArray[np.floating[Any]],
    points: NDArray[np.float64],
    camera: Camera,
) -> NDArray[np.float64]:
    """Reprojection errors (N,), infinite behind the camera."""
    difference = px_from_cam(camera, pose.apply(points)) - points_px
    return np.asarray(np.nan_to_num(np.linalg.norm(difference, axis=1), nan=np.inf))
