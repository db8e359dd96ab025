"""Absolute pose of a camera or a rig: LO-RANSAC by poselib, then refinement with covariance.

P3P for one camera, GP3P for several. The refinement is Levenberg-Marquardt with a Cauchy loss on
reprojection errors in pixels. With the covariance C of a map point for a noise of 1 px, the
covariance of a residual is ``sigma^2 (I + m^2 J C J^T)``; m is the map's keypoint noise relative to
sigma. The scale of the loss follows the residuals, because maps differ in accuracy
(docs/experiments/pose.md). The pose covariance is ``sigma^2 (J^T J)^-1`` of the whitened
reprojections (Hartley and Zisserman, Multiple View Geometry, section 5.2.2).
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import focal_px, normalized_from_px
from megloc_kapture.geometry.poses import cross_matrix, perturbed, unstack_poses
from megloc_kapture.localization.map_index import PoseProblem, View, undo_recentring
from megloc_kapture.values import Camera, Failure, Options, Pose, RigidTransform

# GP3P uses C's rand(), whose state is global
_RAND = threading.Lock()
_ROUNDS = 2
_MIN_SIGMA_PX = 0.1
# median of the Rayleigh distribution of scale 1
_RAYLEIGH_MEDIAN = 1.1774100225154747
# scale of the Cauchy loss for 95 % efficiency under Gaussian noise
_CAUCHY_EFFICIENT = 2.385
# a few perfect matches do not prove that there is no noise
_MIN_VARIANCE_PX2 = 0.1**2
_MAX_CONDITION = 1e12
_MAX_STEPS = 20
# iteration ends below this squared length of a step, in standard deviations
_LAST_STEP = 1e-5
# smallest damping after a rejected step
_DAMPING = 1e-4
# RANSAC of absolute poses
_MIN_ITERATIONS, _MAX_ITERATIONS, _CONFIDENCE = 100, 20_000, 0.9999
# largest standard deviation of the camera's centre, as a share of its inliers' median depth
_MAX_CENTER_DEVIATION = 0.2
# noise of the map's keypoints relative to that of the residuals (docs/experiments/pose.md)
_MAP_NOISE = 1 / 3
Floats = NDArray[np.float64]


class AbsolutePoseOptions(Options):
    max_error_px: float = Field(
        default=12.0, gt=0, description="largest reprojection error of an inlier"
    )
    min_inliers: int = Field(default=12, ge=4, description="queries with fewer inliers fail")
    seed: int = Field(default=0, ge=0, description="seed of RANSAC's samples")

    def for_poselib(self) -> dict[str, Any]:
        """Return the RANSAC options under poselib's names."""
        return {
            "max_reproj_error": self.max_error_px,
            "min_iterations": _MIN_ITERATIONS,
            "max_iterations": _MAX_ITERATIONS,
            "success_prob": _CONFIDENCE,
            "seed": self.seed,
        }


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose with enough inliers, before its refinement.

    ``usable`` and ``inliers``: bool (N,) over the matches of all views; usable if point and ray are
    finite. ``errors_px``: float64 (N,), infinite behind a camera and where not usable.
    """

    rig_from_world: RigidTransform
    usable: NDArray[np.bool_]
    inliers: NDArray[np.bool_]
    errors_px: Floats

    @property
    def num_inliers(self) -> int:
        return int(np.count_nonzero(self.inliers))


def absolute_pose(
    points_px: NDArray[np.floating[Any]],
    points_world: Floats,
    camera: Camera,
    options: AbsolutePoseOptions | None = None,
) -> Pose | Failure:
    """Estimate ``cam_from_world`` of one camera from pixels (N, 2) and world points (N, 3)."""
    return rig_pose([View(camera, RigidTransform.identity(), points_px, points_world)], options)


def rig_pose(views: Sequence[View], options: AbsolutePoseOptions | None = None) -> Pose | Failure:
    """Estimate ``rig_from_world`` of a rig, see :func:`estimate_pose` and :func:`refine_pose`."""
    options = options or AbsolutePoseOptions()
    problem = PoseProblem.of(views)
    estimate = estimate_pose(problem, options)
    if isinstance(estimate, Failure):
        return estimate
    return refine_pose(problem, estimate, options)


def estimate_pose(problem: PoseProblem, options: AbsolutePoseOptions) -> PoseEstimate | Failure:
    count = len(problem.points)
    if count < options.min_inliers:
        return Failure(
            f"{count} 2D-3D matches, at least {options.min_inliers} are needed", num_matches=count
        )
    # rays are NaN where the distortion is not invertible
    rays = np.concatenate([normalized_from_px(v.camera, v.points_px) for v in problem.views])
    usable = np.isfinite(rays).all(axis=1) & np.isfinite(problem.points).all(axis=1)
    num_usable = int(np.count_nonzero(usable))
    if num_usable < options.min_inliers:
        return Failure(
            f"{num_usable} of {count} 2D-3D matches can be used, at least {options.min_inliers} "
            "are needed",
            num_matches=count,
        )
    rig_from_world = _ransac(problem, rays, usable, options)
    errors_px = np.where(usable, _Projected.of(problem, rig_from_world).errors_px, np.inf)
    inliers = errors_px <= options.max_error_px
    num_inliers = int(np.count_nonzero(inliers))
    if num_inliers < options.min_inliers:
        return _too_few_agree(num_inliers, count, options)
    pose = undo_recentring(rig_from_world, problem.offset)
    return PoseEstimate(pose, usable, inliers, errors_px)


def _too_few_agree(num_inliers: int, count: int, options: AbsolutePoseOptions) -> Failure:
    return Failure(
        f"{num_inliers} of {count} 2D-3D matches agree, at least {options.min_inliers} are needed",
        num_matches=count,
        num_inliers=num_inliers,
    )


def match_errors(problem: PoseProblem, rig_from_world: RigidTransform) -> tuple[Floats, Floats]:
    """Return the errors in pixels (N,) of all matches and their Mahalanobis distances (N,).

    The covariance of an error is that of a 1 px noise plus the point's projected covariance.
    Errors and distances are infinite behind the camera and for points that are not finite.
    """
    pose = undo_recentring(rig_from_world, -problem.offset)
    projected = _Projected.of(problem, pose)
    whitened = _whitened(projected.residuals, _whitening(problem, projected, pose, 1.0))
    distances = np.linalg.norm(whitened, axis=1)
    return projected.errors_px, np.where(np.isfinite(distances), distances, np.inf)


@dataclass(frozen=True, eq=False)
class _Projected:
    """Points of a problem projected in the recentred world.

    ``residuals`` (N, 2) in pixels, NaN behind a camera; ``slopes`` (N, 2, 3), derivatives of the
    pixels with respect to the points in the rig frame; ``in_rig`` (N, 3), these points; ``depths``
    (N,) in the camera.
    """

    residuals: Floats
    slopes: Floats
    in_rig: Floats
    depths: Floats

    @classmethod
    def of(
        cls,
        problem: PoseProblem,
        rig_from_world: RigidTransform,
        rows: NDArray[np.int64] | None = None,
    ) -> _Projected:
        """Project the matches ``rows``, ascending; all of them by default."""
        from megloc_kapture.geometry.projection import project_with_jacobian

        rows = np.arange(len(problem.points)) if rows is None else rows
        in_rig = rig_from_world.apply(problem.points[rows])
        bounds = np.searchsorted(rows, problem.starts).tolist()
        residuals, slopes, depths = [], [], []
        for view, first, last in zip(problem.views, bounds[:-1], bounds[1:], strict=True):
            in_cam = view.cam_from_rig.apply(in_rig[first:last])
            px, by_point = project_with_jacobian(view.camera, in_cam)
            residuals.append(px - problem.points_px[rows[first:last]])
            if view.cam_from_rig != RigidTransform.identity():
                by_point = by_point @ view.cam_from_rig.rotation_matrix()
            slopes.append(by_point)
            depths.append(in_cam[:, 2])
        return cls(
            np.concatenate(residuals), np.concatenate(slopes), in_rig, np.concatenate(depths)
        )

    @property
    def errors_px(self) -> Floats:
        errors = np.linalg.norm(self.residuals, axis=1)
        return np.where(np.isfinite(errors), errors, np.inf)

    def jacobian(self, whitening: Floats) -> Floats:
        """Return the Jacobian (N, 2, 6) of whitened residuals for a left perturbation of the pose.

        The first three columns are for rotation, the others for translation.
        """
        by_point = _whitened(self.slopes, whitening)
        # a^T (omega x p) = omega^T (p x a)
        (x, y, z), (a, b, c) = self.in_rig.T[:, :, None], np.moveaxis(by_point, 2, 0)
        return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c], axis=2)


def _whitening(
    problem: PoseProblem, projected: _Projected, rig_from_world: RigidTransform, map_noise: float
) -> Floats:
    """Return inverse Cholesky factors (N, 3) of ``I + m^2 J C J^T``: elements 00, 10, 11."""
    whitening = np.tile([1.0, 0.0, 1.0], (len(problem.points), 1))
    if len(problem.covariances) == 0 or map_noise == 0:
        return whitening
    by_world = projected.slopes.reshape(-1, 3) @ (map_noise * rig_from_world.rotation_matrix())
    u, v = by_world.reshape(-1, 2, 3).transpose(1, 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        s00 = 1.0 + _quadratic(problem.covariances, u, u)
        s01 = _quadratic(problem.covariances, u, v)
        left = 1.0 + _quadratic(problem.covariances, v, v) - s01**2 / s00
    # unknown covariances are treated as zero
    known = (s00 > 0) & (s00 < np.inf) & (left > 0) & (left < np.inf)
    s00, s01, left = s00[known], s01[known], left[known]
    whitening[known] = np.stack([s00**-0.5, -s01 / s00 * left**-0.5, left**-0.5], axis=1)
    return whitening


def _quadratic(covariances: Floats, u: Floats, v: Floats) -> Floats:
    """Return ``u^T C v`` (N,) of vectors (3, N), C stored as xx, xy, xz, yy, yz, zz."""
    xx, xy, xz, yy, yz, zz = covariances.T
    return (
        u[0] * (xx * v[0] + xy * v[1] + xz * v[2])
        + u[1] * (xy * v[0] + yy * v[1] + yz * v[2])
        + u[2] * (xz * v[0] + yz * v[1] + zz * v[2])
    )


def _whitened(values: Floats, whitening: Floats) -> Floats:
    """Multiply residuals (N, 2), or their derivatives (N, 2, K), by inverse Cholesky factors."""
    w00, w10, w11 = whitening.T.reshape(3, -1, *(1,) * (values.ndim - 2))
    first, second = values[:, 0], values[:, 1]
    return np.stack([w00 * first, w10 * first + w11 * second], axis=1)


def _ransac(
    problem: PoseProblem, rays: Floats, usable: NDArray[np.bool_], options: AbsolutePoseOptions
) -> RigidTransform:
    """Estimate ``rig_from_world`` in the recentred world."""
    import poselib

    # skip poselib's final bundle adjustment, which is slower than our refinement; the local
    # optimisation of LO-RANSAC is not affected
    bundle = {"max_iterations": 0}
    points_2d, points_3d, extrinsics, pinholes, cams_from_rig = [], [], [], [], []
    starts = problem.starts.tolist()
    for view, first, last in zip(problem.views, starts[:-1], starts[1:], strict=True):
        rows = first + np.flatnonzero(usable[first:last])
        if len(rows) == 0:
            continue
        # pass undistorted pinhole pixels: poselib has fewer camera models than COLMAP
        focal = focal_px(view.camera)
        points_2d.append(rays[rows] * focal)
        points_3d.append(problem.points[rows])
        pinholes.append(
            {"model": "PINHOLE", "width": 1, "height": 1, "params": [focal, focal, 0.0, 0.0]}
        )
        cams_from_rig.append(view.cam_from_rig)
        extrinsic = poselib.CameraPose()
        extrinsic.q = np.array(view.cam_from_rig.quat_wxyz)
        extrinsic.t = np.array(view.cam_from_rig.translation)
        extrinsics.append(extrinsic)
    if len(points_2d) == 1:
        pose, _ = poselib.estimate_absolute_pose(
            points_2d[0], points_3d[0], pinholes[0], options.for_poselib(), bundle
        )
        return cams_from_rig[0].inverse() @ _rigid_from_poselib(pose)
    # GP3P ignores poselib's seed and uses C's rand(); poselib releases the GIL, so lock out other
    # threads
    with _RAND:
        ctypes.CDLL(None).srand(ctypes.c_uint(options.seed))
        pose, _ = poselib.estimate_generalized_absolute_pose(
            points_2d, points_3d, extrinsics, pinholes, options.for_poselib(), bundle
        )
    return _rigid_from_poselib(pose)


def _rigid_from_poselib(pose: Any) -> RigidTransform:
    quat = np.asarray(pose.q, dtype=np.float64)
    quat = quat / np.linalg.norm(quat)
    return unstack_poses(quat[None], np.asarray(pose.t, dtype=np.float64)[None])[0]


def refine_pose(
    problem: PoseProblem, estimate: PoseEstimate, options: AbsolutePoseOptions
) -> Pose | Failure:
    """Refine an estimate of ``rig_from_world`` of the same problem.

    The refined ``rig_from_world`` is the ``cam_from_world`` of the returned Pose, which also has
    the covariance and the inlier mask over all views. Inliers are selected by errors in pixels,
    without the points' covariances.
    """
    count = len(problem.points)
    pose = undo_recentring(estimate.rig_from_world, -problem.offset)
    for remaining in range(_ROUNDS, -1, -1):
        projected = _Projected.of(problem, pose)
        inliers = estimate.usable & (projected.errors_px <= options.max_error_px)
        rows = np.flatnonzero(inliers)
        if len(rows) < options.min_inliers:
            return _too_few_agree(len(rows), count, options)
        whitening = _whitening(problem, projected, pose, _MAP_NOISE)
        whitened = _whitened(projected.residuals[rows], whitening[rows])
        squared = (whitened**2).sum(axis=1)
        sigma = max(_median(squared) ** 0.5 / _RAYLEIGH_MEDIAN, _MIN_SIGMA_PX)
        if remaining > 0:
            pose = _minimised(problem, pose, rows, whitening[rows], sigma)
    jacobian = _Projected.of(problem, pose, rows).jacobian(whitening[rows]).reshape(-1, 6)
    variance = _variance(squared, (_CAUCHY_EFFICIENT * sigma) ** 2)
    covariance = pose_covariance(jacobian.T @ jacobian, variance)
    if covariance is None:
        return Failure(
            "the pose is not determined by its inliers (degenerate configuration)",
            num_matches=count,
            num_inliers=len(rows),
        )
    # a left perturbation acts in the camera frame: the offset does not change the covariance
    refined = Pose(
        cam_from_world=undo_recentring(pose, problem.offset),
        num_matches=count,
        num_inliers=len(rows),
        inliers=inliers,
        covariance=covariance,
    )
    return check_stable(refined, covariance, _median(projected.depths[rows]))


def _minimised(
    problem: PoseProblem,
    pose: RigidTransform,
    rows: NDArray[np.int64],
    whitening: Floats,
    sigma: float,
) -> RigidTransform:
    """Minimise the Cauchy loss of whitened residuals by Levenberg-Marquardt.

    A residual of length e has the weight ``w = 1 / (1 + e^2 / c^2)``. The gradient is the sum of
    ``w J^T r``. The Hessian is approximated by the sum of ``w^2 J^T J``, its expectation over
    directions of r.
    """
    squared_scale = (_CAUCHY_EFFICIENT * sigma) ** 2
    best, least, damping = pose, np.inf, 0.0
    gradient, hessian = np.zeros(6), np.zeros((6, 6))
    for _ in range(_MAX_STEPS):
        projected = _Projected.of(problem, pose, rows)
        whitened = _whitened(projected.residuals, whitening)
        growth = 1.0 + (whitened**2).sum(axis=1) / squared_scale
        # the cost is NaN if a point moved behind the camera
        cost = float(np.log(growth).sum())
        if cost < least:
            best, least, damping = pose, cost, 0.1 * damping
            jacobian = projected.jacobian(whitening) / growth[:, None, None]
            flat = jacobian.reshape(-1, 6)
            gradient, hessian = flat.T @ whitened.ravel(), flat.T @ flat
        else:
            damping = max(10.0 * damping, _DAMPING)
        try:
            damped = hessian + damping * np.diag(np.diagonal(hessian))
            step = np.asarray(-np.linalg.solve(damped, gradient), np.float64)
        except np.linalg.LinAlgError:  # the inliers do not determine the pose
            return best
        pose = perturbed(best, np.asarray(step, np.float64))
        if -(gradient @ step) < _LAST_STEP * sigma**2:
            return pose
    return best


def check_stable(pose: Pose, covariance: Floats, depth: float) -> Pose | Failure:
    """Return the pose, or a Failure if its centre is too uncertain.

    The limit is relative to the inliers' median ``depth``.
    """
    deviation = center_deviation(covariance) / depth
    if deviation <= _MAX_CENTER_DEVIATION:
        return pose
    return Failure(
        f"the pose is unstable: its centre's standard deviation is {deviation:.2g} of the "
        f"inliers' median depth, at most {_MAX_CENTER_DEVIATION:g} is allowed",
        num_matches=pose.num_matches,
        num_inliers=pose.num_inliers,
    )


def _variance(squared: Floats, squared_scale: float) -> float:
    """Return the variance factor of a Cauchy estimate's covariance from squared residuals (M,).

    Huber proposes ``E[w^2 e^2] / 2`` over ``E[w^2]^2`` (Robust Statistics, section 7.6).
    """
    squared_weights = 1.0 / (1.0 + squared / squared_scale) ** 2
    degrees_of_freedom = max(2 * len(squared) - 6, 1)
    return float(squared_weights @ squared / degrees_of_freedom / squared_weights.mean() ** 2)


def _median(values: Floats) -> float:
    # np.median is ten times slower for small arrays
    upper = len(values) // 2
    lower = (len(values) - 1) // 2
    parted = np.partition(values, (lower, upper))
    return float(0.5 * (parted[lower] + parted[upper]))


def pose_covariance(information: Floats, variance_px2: float) -> Floats | None:
    """Return the pose covariance (6, 6) from the normal matrix ``J^T J`` for a noise of 1 px.

    The left perturbation ``exp(...) cam_from_world`` is ordered rotation in radians, then
    translation. None if the matrix is singular.
    """
    if not np.isfinite(information).all() or not (np.diagonal(information) > 0).all():
        return None
    # equilibrate first: the columns differ by the scale of the scene
    scale = np.sqrt(np.diagonal(information))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] * _MAX_CONDITION <= values[-1]:
        return None
    half = vectors / np.sqrt(values) / scale[:, None]
    return np.asarray(max(variance_px2, _MIN_VARIANCE_PX2) * (half @ half.T))


def center_deviation(covariance: Floats) -> float:
    """Return the camera centre's largest standard deviation over all directions."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))


def transform_covariance(covariance: Floats, cam_from_rig: RigidTransform) -> Floats:
    """Transform a covariance (6, 6) of ``rig_from_world`` to ``cam_from_rig @ rig_from_world``.

    ``Ad_C covariance Ad_C^T`` (Barfoot, State Estimation for Robotics, section 7.1.4).
    """
    rotation = cam_from_rig.rotation_matrix()
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = rotation
    adjoint[3:, :3] = cross_matrix(np.array(cam_from_rig.translation)) @ rotation
    return np.asarray(adjoint @ covariance @ adjoint.T)
