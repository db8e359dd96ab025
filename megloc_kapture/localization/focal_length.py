"""Focal length and other intrinsics of a query's camera, estimated from the inliers of its pose.

A wrong focal length moves the camera along its axis while most matches still agree. So the focal
length is estimated again once a pose is known (Gauss-Newton on rays, Cauchy weights). A calibrated
camera is kept; if another focal length fits far better, the pose gets a remark and a lower
confidence. An uncertain camera (``Camera.focal_deviation``) gets the most probable intrinsics given
a prior (EXIF, image centre, no distortion), which pycolmap's refinement does not support; the pose
covariance includes their uncertainty. Where the matches do not determine the intrinsics, the prior
does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import (
    RADIAL_MODELS,
    focal_px,
    normalized_from_px,
    principal_point_px,
    radial_distortion,
    scale_focal,
    shift_principal_point,
    with_distortion,
)
from megloc_kapture.io.colmap import focal_from_matches
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    check_stable,
    estimate_pose,
    refine_pose,
)
from megloc_kapture.localization.map_index import PoseProblem, View
from megloc_kapture.values import Camera, Failure, LocalizationResult, Pose, RigidTransform

Floats = NDArray[np.float64]
# _CORRELATED: errors of neighbouring map points are correlated, so standard deviations that assume
# independent matches are too small by this factor; _MIN_ERROR_PX: smallest assumed standard
# deviation of a match
_CORRELATED, _MIN_ERROR_PX = 5.0, 0.5
# a focal length contradicts a calibrated one if they differ by this many standard deviations
_MIN_SIGMAS = 3.0
_MIN_INLIERS = 30
_DOES_NOT_FIT = "does not fit"
_ROUNDS = 12
_SMALL_STEP = 1e-4
# largest relative change of a converged focal length
_SETTLED = 1e-4
_MAX_UPDATES = 8
# the prior is doubted if the focal length from the matches (P4Pf) differs from it by more than this
# many standard deviations
_MAX_DEVIATIONS = 3.0
# _DOUBTED_DEVIATION: relative standard deviation of a doubted prior; _MIN_DOUBTED: a prior with a
# smaller one comes from calibration or several images, and is never doubted
_DOUBTED_DEVIATION, _MIN_DOUBTED = 0.7, 0.1
# prior standard deviations: principal point as a share of the longer side, radial distortion
_PRINCIPAL_POINT_DEVIATION, _DISTORTION_DEVIATION = 0.01, 0.1
# standard deviations of a calibrated camera's focal length (relative) and radial distortion
_CALIBRATED, _CALIBRATED_DISTORTION = 0.01, 0.02
# effective number of independent matches
_INDEPENDENT = 30
# matches were verified with the given focal length, which biases the estimate towards it by this
# share of their difference
_BIASED_BY = 0.1
# a photograph whose focal length differs from the shared one by more than this many standard
# deviations was taken at a different zoom
_MAX_SIGMAS = 3.0
# factor on the standard deviation of the shared focal length, because errors of the map and of the
# lens model are correlated between photographs
_ALIKE = 2.0


@dataclass(frozen=True, eq=False)
class _Fit:
    """Best correction of a camera and its pose.

    ``change`` (3 or 4,): logarithm of the focal length's factor; shift of the principal point,
    divided by the focal length; change of the radial distortion. ``pose_covariance`` (6, 6):
    contribution of the camera's uncertainty to the pose covariance. ``depth``: median depth of the
    inliers.
    """

    change: Floats
    deviation: float  # relative, of the focal length
    rig_from_world: RigidTransform
    pose_covariance: Floats
    depth: float


def is_uncertain(problem: PoseProblem) -> bool:
    """Return True for a single camera with an uncertain focal length."""
    return len(problem.views) == 1 and problem.views[0].camera.focal_deviation > 0


def focal_misfit(
    problem: PoseProblem, pose: Pose, options: AbsolutePoseOptions
) -> tuple[str, float] | None:
    """Return a remark if another focal length fits far better than the given one.

    The second value is the resulting motion of the camera centre, divided by the median distance of
    the inliers. Return None otherwise, for rigs, for few inliers, and if the matches do not
    determine the focal length.
    """
    if len(problem.views) != 1 or pose.inliers is None or pose.num_inliers < _MIN_INLIERS:
        return None
    given = problem.views[0].camera
    fit = _freed(problem, given, pose.cam_from_world, pose.inliers, options.max_error_px)
    if fit is not None and not fit.contradicts:
        return None
    # the inliers of a grossly wrong focal length favour it, or their fit does not converge, so
    # search again among all matches
    if (alternative := _with_focal_from_matches(problem, options)) is not None:
        other, estimate = alternative
        start = estimate.rig_from_world, estimate.inliers
        second = _freed(other, given, *start, options.max_error_px)
        if second is not None and (
            estimate.num_inliers > pose.num_inliers if fit is None else second.cost < fit.cost
        ):
            fit = second
    if fit is None or not fit.contradicts:
        return None
    shift = np.linalg.norm(fit.rig_from_world.center() - pose.cam_from_world.center())
    return (
        f"the focal length of {focal_px(given):.0f} px {_DOES_NOT_FIT}: {fit.focal_px:.0f} +- "
        f"{fit.focal_px * fit.deviation:.0f} px would",
        float(shift) / fit.distance,
    )


@dataclass(frozen=True)
class _Freed:
    """Pose and focal length estimated together.

    ``deviation``: relative standard deviation of the focal length's change, with calibration error
    and bias; ``contradicts``: the change is significant; ``cost``: sum of squared errors of all
    matches, truncated at the inlier threshold; ``distance``: median distance of the inliers from
    the camera.
    """

    focal_px: float
    deviation: float
    contradicts: bool
    rig_from_world: RigidTransform
    cost: float
    distance: float


def _freed(
    problem: PoseProblem,
    given: Camera,
    rig_from_world: RigidTransform,
    inliers: NDArray[np.bool_],
    max_error_px: float,
) -> _Freed | None:
    """Estimate pose and focal length, and other intrinsics within their calibration error.

    None if the matches do not determine the focal length. Each round selects the inliers again.
    """
    (view,) = problem.views
    focal = focal_px(view.camera)
    rays, points = normalized_from_px(view.camera, problem.points_px), problem.points
    usable = np.isfinite(rays).all(axis=1) & np.isfinite(points).all(axis=1)
    rays, points, inliers = rays[usable], points[usable] + problem.offset, inliers[usable]
    larger = max(view.camera.width, view.camera.height) / focal
    principal_point = _PRINCIPAL_POINT_DEVIATION * larger
    deviations = np.array([1.0, principal_point, principal_point, _CALIBRATED_DISTORTION])
    moved, change, expected = view.cam_from_rig @ rig_from_world, np.zeros(4), np.zeros(4)
    for _ in range(_ROUNDS):
        in_camera = moved.apply(points[inliers])
        solved = _free_camera(rays[inliers], in_camera, focal, change, expected, deviations, 1.0)
        if solved is None:
            return None
        change, motion, _, covariance = solved
        moved = motion @ moved
        in_camera = moved.apply(points)
        ahead = in_camera[:, 2] > 0
        residuals = np.full(rays.shape, np.inf)
        residuals[ahead], _ = _linearized(rays[ahead], in_camera[ahead], change)
        errors_px = np.linalg.norm(residuals, axis=1) * focal
        before, inliers = inliers, errors_px <= max_error_px
        if inliers.sum() < _MIN_INLIERS:
            return None
        if (before == inliers).all():
            break
    estimated_px = focal * math.exp(change[0])
    from_given = math.log(estimated_px / focal_px(given))
    alone = math.sqrt(covariance[6, 6] * (1 + inliers.sum() / _INDEPENDENT))
    deviation = math.hypot(alone, _CALIBRATED, _BIASED_BY * from_given)
    return _Freed(
        focal_px=estimated_px,
        deviation=deviation,
        contradicts=abs(from_given) >= _MIN_SIGMAS * deviation,
        rig_from_world=view.cam_from_rig.inverse() @ moved,
        cost=float((np.minimum(errors_px, max_error_px) ** 2).sum()),
        distance=float(np.median(np.linalg.norm(in_camera[inliers], axis=1))),
    )


def misfits_text(results: Iterable[LocalizationResult], where: str) -> str | None:
    """Report how many queries have a focal length, as given, that does not fit."""
    count = sum(any(_DOES_NOT_FIT in remark for remark in result.remarks) for result in results)
    if not count:
        return None
    return f"the given focal length {_DOES_NOT_FIT} in {count} queries: see the remarks in {where}"


def estimate_remark(camera: Camera, given: Camera) -> str:
    found_px, given_px = focal_px(camera), focal_px(given)
    return (
        f"focal length estimated: {found_px:.0f} +- {camera.focal_deviation * found_px:.0f} px "
        f"({given_px:.0f} px +- {100 * given.focal_deviation:.0f} % was assumed)"
    )


def estimate_with_intrinsics(
    problem: PoseProblem, options: AbsolutePoseOptions
) -> tuple[PoseProblem, PoseEstimate | Failure]:
    """Estimate pose and intrinsics of an uncertain camera.

    The returned problem has the estimated camera; its ``focal_deviation`` is larger than the given
    one if the matches contradict the given focal length.
    """
    given = problem.views[0].camera
    best = estimate_pose(problem, options)
    if (alternative := _with_focal_from_matches(problem, options)) is not None:
        other, of_other = alternative
        if of_other.num_inliers > best.num_inliers and _is_possible(other, of_other, given):
            problem, best = other, of_other
    if isinstance(best, PoseEstimate):
        fit = _fit(problem, best.rig_from_world, best.inliers, given)
        if fit is not None:
            refined = _with_camera(problem, _changed(problem.views[0].camera, fit.change))
            estimate = estimate_pose(refined, options)
            if isinstance(estimate, PoseEstimate) and estimate.num_inliers >= best.num_inliers:
                return refined, estimate
    return problem, best


def _with_focal_from_matches(
    problem: PoseProblem, options: AbsolutePoseOptions
) -> tuple[PoseProblem, PoseEstimate] | None:
    """Estimate the focal length from all matches, and the pose with it; None if either fails.

    The prior in the camera of the returned problem is weaker if the matches contradict it.
    """
    given = problem.views[0].camera
    free = focal_from_matches(
        problem.points_px, problem.points, given, options.max_error_px, options.seed
    )
    if free is None:
        return None
    factor = free / focal_px(given)
    camera = scale_focal(given, factor)
    if abs(math.log(factor)) > _MAX_DEVIATIONS * given.focal_deviation:
        camera = replace(camera, focal_deviation=max(_DOUBTED_DEVIATION, given.focal_deviation))
    other = _with_camera(problem, camera)
    estimate = estimate_pose(other, options)
    return (other, estimate) if isinstance(estimate, PoseEstimate) else None


def _is_possible(problem: PoseProblem, estimate: PoseEstimate, given: Camera) -> bool:
    """Return True if the prior allows the focal length, or the matches contradict the prior."""
    camera = problem.views[0].camera
    change = math.log(focal_px(camera) / focal_px(given))
    if abs(change) <= _MAX_DEVIATIONS * given.focal_deviation:
        return True
    if given.focal_deviation < _MIN_DOUBTED or estimate.num_inliers < _MIN_INLIERS:
        return False
    fit = _fit(problem, estimate.rig_from_world, estimate.inliers, given)
    if fit is None:
        return False
    change += float(fit.change[0])
    return abs(change) > _MAX_DEVIATIONS * max(given.focal_deviation, fit.deviation)


def refine_with_intrinsics(
    problem: PoseProblem, estimate: PoseEstimate, options: AbsolutePoseOptions, given: Camera
) -> tuple[PoseProblem, Pose | Failure]:
    """Refine pose and intrinsics of an uncertain camera alternately.

    ``given`` is the camera with its prior deviation. The returned problem and Pose have the refined
    intrinsics; the posterior ``focal_deviation`` is in the Pose's camera only.
    """
    updates = 0
    while True:
        pose = refine_pose(problem, estimate, options)
        if isinstance(pose, Failure) or pose.inliers is None or pose.covariance is None:
            return problem, pose
        fit = _fit(problem, pose.cam_from_world, pose.inliers, given)
        if fit is None:
            return problem, Failure(
                "the focal length is unknown, and the matches do not determine it",
                num_matches=pose.num_matches,
                num_inliers=pose.num_inliers,
            )
        if abs(fit.change[0]) < _SETTLED or updates == _MAX_UPDATES:
            covariance = pose.covariance + fit.pose_covariance
            camera = replace(problem.views[0].camera, focal_deviation=fit.deviation)
            pose = replace(pose, covariance=covariance, camera=camera)
            return problem, check_stable(pose, covariance, fit.depth)
        updates += 1
        problem = _with_camera(problem, _changed(problem.views[0].camera, fit.change))
        estimate = replace(estimate, rig_from_world=fit.rig_from_world)


def _with_camera(problem: PoseProblem, camera: Camera) -> PoseProblem:
    return PoseProblem.of([replace(problem.views[0], camera=camera)])


def _changed(camera: Camera, change: Floats) -> Camera:
    focal = focal_px(camera)
    camera = shift_principal_point(camera, *(focal * change[1:3]).tolist())
    camera = scale_focal(camera, math.exp(change[0]))
    if len(change) < 4:
        return camera
    return with_distortion(camera, radial_distortion(camera) + float(change[3]))


def _prior_of(camera: Camera, given: Camera) -> tuple[Floats, Floats]:
    """Return the change from a camera to the given one, and the prior's standard deviations."""
    focal = focal_px(camera)
    shift = np.subtract(principal_point_px(given), principal_point_px(camera)) / focal
    known = max(given.focal_deviation, camera.focal_deviation)
    # an accurate focal length comes from calibration or several images, as do the other intrinsics
    deviation = min(_PRINCIPAL_POINT_DEVIATION, known) * max(camera.width, camera.height) / focal
    change = [math.log(focal_px(given) / focal), *shift]
    deviations = [known, deviation, deviation]
    if camera.model in RADIAL_MODELS:
        change.append(radial_distortion(given) - radial_distortion(camera))
        deviations.append(min(_DISTORTION_DEVIATION, known))
    return np.array(change), np.array(deviations)


def _fit(
    problem: PoseProblem,
    rig_from_world: RigidTransform,
    inliers: NDArray[np.bool_],
    given: Camera,
) -> _Fit | None:
    """Fit the camera to the inliers; None if they do not determine it. ``given`` is the prior."""
    (view,) = problem.views
    expected, deviations = _prior_of(view.camera, given)
    start = view.cam_from_rig @ rig_from_world
    solved = _free_camera(
        normalized_from_px(view.camera, problem.points_px[inliers]),
        start.apply(problem.points[inliers] + problem.offset),
        focal_px(view.camera),
        np.zeros(len(expected)),
        expected,
        deviations,
        _CORRELATED,
    )
    if solved is None:
        return None
    change, moved, depth, covariance = solved
    of_camera, between = covariance[6:, 6:], covariance[:6, 6:]
    return _Fit(
        change=change,
        deviation=math.sqrt(of_camera[0, 0]),
        rig_from_world=view.cam_from_rig.inverse() @ moved @ start,
        pose_covariance=between @ np.linalg.solve(of_camera, between.T),
        depth=depth,
    )


def _free_camera(
    rays: Floats,
    points: Floats,
    focal: float,
    change: Floats,
    expected: Floats,
    deviations: Floats,
    correlated: float,
) -> tuple[Floats, RigidTransform, float, Floats] | None:
    """Fit pose and camera change to inliers' rays (N, 2) and points (N, 3) in the camera frame.

    ``expected`` and ``deviations`` are the prior of ``change`` (:class:`_Fit`). ``correlated``
    multiplies the noise of the matches, whose errors are correlated. Returns the change, the motion
    of the points, their median depth and the covariance of motion (left perturbation) and change;
    None if undetermined.
    """
    rotation, translation = np.eye(3), np.zeros(3)
    prior_weight = (correlated / deviations) ** 2
    intrinsics = np.arange(6, 6 + len(change))
    for _ in range(_ROUNDS):
        ahead = points[:, 2] > 0
        if ahead.sum() < 4:
            return None
        residuals, jacobian = _linearized(rays[ahead], points[ahead], change)
        squared = (residuals**2).sum(axis=1)
        variance = max(float(np.median(squared)) / (2 * math.log(2)), 1e-14)
        weights = 1 / (1 + squared / (5.7 * variance))
        information = np.einsum("nik,n,nil->kl", jacobian, weights, jacobian)
        gradient = np.einsum("nik,n,ni->k", jacobian, weights, residuals)
        # the lower bound is for errors of the lens model, which do not average out
        trusted = max(variance, (_MIN_ERROR_PX / focal) ** 2)
        information[intrinsics, intrinsics] += trusted * prior_weight
        gradient[intrinsics] += trusted * prior_weight * (change - expected)
        size = np.sqrt(np.diagonal(information)) + 1e-300
        values, vectors = np.linalg.eigh(information / np.outer(size, size))
        if values[0] < 1e-10 * values[-1]:
            return None
        covariance = vectors @ np.diag(1 / values) @ vectors.T / np.outer(size, size)
        step = -covariance @ gradient
        if not np.isfinite(step).all() or abs(change[0] + step[6]) > 1.5:
            return None
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        points = points @ turn.T + step[3:6]
        rotation, translation = turn @ rotation, turn @ translation + step[3:6]
        change = change + step[6:]
        if abs(step[6]) < _SMALL_STEP:
            break
    motion = RigidTransform.from_matrix(rotation, translation)
    depth = float(np.median(points[ahead, 2]))
    return change, motion, depth, covariance * correlated**2 * trusted


def _linearized(rays: Floats, points: Floats, change: Floats) -> tuple[Floats, Floats]:
    """Return residuals (N, 2) of points in front of the camera and their derivatives (N, 2, 6 + C).

    The columns are a left rotation, a translation and ``change``; the pose columns ignore how the
    distortion factor changes with the point's position.
    """
    x, y, z = points.T
    u, v = x / z, y / z
    zeros, ones, radius2 = np.zeros_like(u), np.ones_like(u), u * u + v * v
    scale = math.exp(change[0])
    slope = scale * (1 + change[3:].sum() * radius2)
    at = np.stack([slope * u, slope * v], axis=1)
    pose_columns = slope[:, None, None] * np.stack(
        [
            np.stack([-u * v, 1 + u * u, -v, 1 / z, zeros, -u / z], axis=1),
            np.stack([-1 - v * v, u * v, u, zeros, 1 / z, -v / z], axis=1),
        ],
        axis=1,
    )
    columns = [
        at,
        np.stack([ones, zeros], axis=1),
        np.stack([zeros, ones], axis=1),
        (scale * radius2)[:, None] * np.stack([u, v], axis=1),
    ]
    camera_columns = np.stack(columns[: len(change)], axis=2)
    return at + change[1:3] - rays, np.concatenate([pose_columns, camera_columns], axis=2)


def shared_camera(cameras: Sequence[Camera]) -> Camera:
    """Combine estimates of one camera by medians of the parameters, weighted by 1 / variance."""
    weights = np.array([camera.focal_deviation**-2.0 for camera in cameras])
    params = np.array([camera.params for camera in cameras])
    order = np.argsort(params, axis=0, kind="stable")
    below = np.cumsum(weights[order], axis=0)
    middle = (below < 0.5 * below[-1]).sum(axis=0)
    medians = np.take_along_axis(params, order, axis=0)[middle, np.arange(params.shape[1])]
    deviation = _ALIKE / math.sqrt(float(weights.sum()))
    return replace(cameras[0], params=tuple(medians.tolist()), focal_deviation=deviation)


def solve_with_shared_camera(poses: Sequence[Pose], options: AbsolutePoseOptions) -> list[Pose]:
    """Re-solve poses of photographs taken by one camera with a shared estimate of its intrinsics.

    A pose is kept as it is if its focal length contradicts the shared one (a different zoom) or if
    it was refined by another method.
    """
    usable = [p.camera for p in poses if p.camera is not None and p.camera.focal_deviation > 0]
    if len(usable) < 2:
        return list(poses)
    shared = shared_camera(usable)
    near = [
        camera
        for camera in usable
        if abs(math.log(focal_px(camera) / focal_px(shared)))
        <= _MAX_SIGMAS * math.hypot(camera.focal_deviation, shared.focal_deviation)
    ]
    if len(near) < 2:
        return list(poses)
    shared = shared_camera(near)
    return [
        _solved(pose, shared, len(near), options)
        if pose.camera in near and not pose.refinements
        else pose
        for pose in poses
    ]


def _solved(pose: Pose, shared: Camera, number: int, options: AbsolutePoseOptions) -> Pose:
    """Solve a pose with the shared camera; return it unchanged if that fails."""
    if pose.inlier_points_px is None or pose.inlier_points_world is None:
        return pose
    inliers = pose.inlier_points_px, pose.inlier_points_world
    problem = PoseProblem.of([View(shared, RigidTransform.identity(), *inliers)])
    every = np.ones(len(problem.points), bool)
    start = PoseEstimate(pose.cam_from_world, every, every, np.zeros(len(every)))
    _, solved = refine_with_intrinsics(problem, start, options, shared)
    if not isinstance(solved, Pose) or solved.camera is None:
        return pose
    camera = solved.camera
    remark = (
        f"focal length estimated from {number} photographs: {focal_px(camera):.0f} +- "
        f"{camera.focal_deviation * focal_px(camera):.0f} px"
    )
    return replace(
        pose,
        cam_from_world=solved.cam_from_world,
        covariance=solved.covariance,
        camera=camera,
        remarks=(*(r for r in pose.remarks if not r.startswith("focal length estimated")), remark),
    )
