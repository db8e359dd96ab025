"""Absolute pose of a camera or a rig: estimation, then refinement on the inliers with covariance.

The refinement is Levenberg-Marquardt on the reprojection errors in pixels of all cameras of the rig
together, under each camera's real model. A residual counts by the uncertainty of its pixel and its
point: where the map knows the point's covariance C for a noise of 1 px, the residual's is
``sigma^2 (I + m^2 J C J^T)``, and its distance is Mahalanobis'; m is the noise of the map's
keypoints as a share of sigma, which also has what viewpoint, calibration and the map's poses do to
a query. The Cauchy loss' scale follows the residuals: a map that is good to a tenth of a pixel and
one that is good to three need different ones (figures in docs/experiments/pose.md).

The covariance is by first-order propagation (Hartley and Zisserman, Multiple View Geometry, section
5.2.2): with J the Jacobian of the whitened reprojections with respect to the pose it is
``sigma^2 (J^T J)^-1``, sigma estimated from the residuals. A pose that its inliers do not
determine, or place too badly to be of use, is a failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.localization.estimation import (
    AbsolutePoseOptions,
    PoseEstimate,
    PoseProblem,
    View,
    estimate_pose,
    too_few_agree,
    undo_recentring,
)
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

_ROUNDS = 2
_MIN_SIGMA_PX = 0.1
# the median of the length of a normal vector in two dimensions (Rayleigh), of deviation 1
_RAYLEIGH_MEDIAN = 1.1774100225154747
# the scale at which the Cauchy loss has 95 % of least squares' efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385
# a handful of perfect matches is no proof of perfection
_MIN_VARIANCE_PX2 = 0.1**2
_MAX_CONDITION = 1e12


def refine_pose(
    problem: PoseProblem, estimate: PoseEstimate, options: AbsolutePoseOptions | None = None
) -> Pose | Failure:
    """Refine an estimate of ``rig_from_world`` of the same problem.

    Returns
    -------
    Pose whose ``cam_from_world`` is ``rig_from_world``, with its covariance and the inlier mask
    over the matches of all views in order (inliers by their error in pixels, whatever their
    points' uncertainty); or Failure with the reason.
    """
    from megloc_kapture.localization import pose_kernels

    options = options or AbsolutePoseOptions()
    count = len(problem.points)
    problem = replace(problem, covariances=problem.covariances * options.map_noise**2)
    start = undo_recentring(estimate.rig_from_world, -problem.offset)
    pose = start.rotation_matrix(), np.array(start.translation)
    matches = problem.matches
    errors, squared, depths = np.empty(count), np.empty(count), np.empty(count)
    whitening, gradient, information = np.empty((count, 3)), np.empty(6), np.empty((6, 6))
    for remaining in range(_ROUNDS, -1, -1):
        pose_kernels.measure(matches, estimate.usable, *pose, errors, whitening, squared, depths)
        inliers = errors <= options.max_error_px
        rows = np.flatnonzero(inliers)
        if len(rows) < options.min_inliers:
            return too_few_agree(len(rows), count, options)
        sigma = max(_median(squared[rows]) ** 0.5 / _RAYLEIGH_MEDIAN, _MIN_SIGMA_PX)
        squared_scale = (_CAUCHY_EFFICIENT * sigma) ** 2
        if remaining > 0:
            pose = pose_kernels.levenberg_marquardt(
                matches, rows, whitening, *pose, sigma, squared_scale
            )
    pose_kernels.normal_equations(matches, rows, whitening, *pose, np.inf, gradient, information)
    covariance = pose_covariance(
        np.triu(information) + np.triu(information, 1).T, _variance(squared[rows], squared_scale)
    )
    if covariance is None:
        return Failure(
            "the pose is not determined by its inliers (degenerate configuration)",
            num_matches=count,
            num_inliers=len(rows),
        )
    # a left perturbation acts in the camera frame: the covariance does not see the offset
    found = Pose(
        cam_from_world=undo_recentring(RigidTransform.from_matrix(*pose), problem.offset),
        num_matches=count,
        num_inliers=len(rows),
        inliers=inliers,
        covariance=covariance,
    )
    return check_stable(found, _median(depths[rows]), options)


def check_stable(pose: Pose, depth: float, options: AbsolutePoseOptions) -> Pose | Failure:
    """The pose, or a Failure where its covariance says that the centre may be anywhere.

    Parameters
    ----------
    depth : the median of the inliers', unit of the map.
    """
    if pose.covariance is None:
        return pose
    deviation = center_deviation(pose.covariance) / depth
    if deviation <= options.max_center_deviation:
        return pose
    return Failure(
        f"the pose is unstable: its centre's standard deviation is {deviation:.2g} of the "
        f"inliers' median depth, at most {options.max_center_deviation:g} is allowed",
        num_matches=pose.num_matches,
        num_inliers=pose.num_inliers,
    )


def _variance(squared: NDArray[np.float64], squared_scale: float) -> float:
    """Variance by which the inverse normal matrix becomes the covariance of the Cauchy estimate.

    Of squared whitened residuals (M,). Huber's proposal (Robust Statistics, section 7.6) with
    expectations over the directions of residuals in the plane: ``E[w^2 e^2] / 2`` over
    ``E[w^2]^2``, w the weight of the loss. It is the variance of the noise, over the efficiency of
    the loss, where the noise is Gaussian.
    """
    squared_weights = 1.0 / (1.0 + squared / squared_scale) ** 2
    degrees_of_freedom = max(2 * len(squared) - 6, 1)
    return float(squared_weights @ squared / degrees_of_freedom / squared_weights.mean() ** 2)


def _median(values: NDArray[np.float64]) -> float:
    # np.median takes ten times as long for so few
    upper = len(values) // 2
    lower = (len(values) - 1) // 2
    parted = np.partition(values, (lower, upper))
    return float(0.5 * (parted[lower] + parted[upper]))


def pose_covariance(
    information: NDArray[np.float64], variance_px2: float
) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of a pose from its normal matrix ``J^T J`` (6, 6) for a noise of 1 px.

    Order: rotation in radians, then translation in the unit of the map, both of a left
    perturbation: ``cam_from_world_true = exp(rotation, translation) cam_from_world``.

    Returns None when the matrix does not determine the pose.
    """
    if not np.isfinite(information).all() or not (np.diagonal(information) > 0).all():
        return None
    # columns differ by the scene's scale: equilibrate before judging the condition
    scale = np.sqrt(np.diagonal(information))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] * _MAX_CONDITION <= values[-1]:
        return None
    half = vectors / np.sqrt(values) / scale[:, None]
    return np.asarray(max(variance_px2, _MIN_VARIANCE_PX2) * (half @ half.T))


def center_deviation(covariance: NDArray[np.float64]) -> float:
    """Largest standard deviation of the camera's centre over all directions, in the map's unit.

    Of a ``covariance`` (6, 6) as :func:`pose_covariance` has it: a left perturbation moves the
    centre by its translation, seen in the camera, to first order.
    """
    return float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))


def rig_pose(views: Sequence[View], options: AbsolutePoseOptions | None = None) -> Pose | Failure:
    """Estimate ``rig_from_world`` of a rig; a camera without matches is no harm.

    Returns
    -------
    Pose whose ``cam_from_world`` is ``rig_from_world``, with its covariance, or Failure with the
    reason. The inlier mask runs over the matches of all views in order
    (:func:`megloc_kapture.localization.estimation.split_by_view`).
    """
    problem = PoseProblem.of(views)
    estimate = estimate_pose(problem, options)
    if isinstance(estimate, Failure):
        return estimate
    return refine_pose(problem, estimate, options)


def absolute_pose(
    points_px: NDArray[np.floating[Any]],
    points_world: NDArray[np.float64],
    camera: Camera,
    options: AbsolutePoseOptions | None = None,
    point_covariances: NDArray[np.float64] | None = None,
) -> Pose | Failure:
    """Estimate ``cam_from_world`` of one camera.

    Parameters
    ----------
    points_px : (N, 2), first pixel's centre at (0.5, 0.5).
    points_world : float64 (N, 3).
    point_covariances : float64 (N, 6) of the points, as :class:`View` has them, or None.

    Returns
    -------
    Pose with inlier mask and covariance, or Failure with the reason.

    Raises
    ------
    DataError : the arrays do not have these shapes.
    """
    view = View(camera, RigidTransform.identity(), points_px, points_world, point_covariances)
    return rig_pose([view], options)
