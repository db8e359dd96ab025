"""2D-3D matches of a camera or a rig, and the first estimate of its pose: LO-RANSAC by poselib.

P3P where the matches of one camera have to do, GP3P where several cameras of a rig have some.
The same seed gives the same pose, from however many threads. A failure is a falsy value with its
reason, never an invented pose.
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

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import focal_px, normalized_from_px
from megloc_kapture.values import Camera, Failure, Options, RigidTransform

# GP3P draws from C's rand(), one state for the whole process
_RAND = threading.Lock()


@dataclass(frozen=True, eq=False)
class View:
    """One camera and its matches; a camera on its own is a rig of one, at its origin.

    Attributes
    ----------
    camera : the intrinsics.
    cam_from_rig : the camera in its rig; the identity for a camera on its own.
    points_px : float (N, 2) pixels, first pixel's centre at (0.5, 0.5).
    points_world : float64 (N, 3) the points that they are matched with.
    point_covariances : float64 (N, 6) of the points as xx, xy, xz, yy, yz, zz in the map's unit
        squared, for a measurement noise of 1 px, not finite where unknown; or None. An unknown
        covariance counts as none at all.

    Raises
    ------
    DataError : the arrays do not have these shapes.
    """

    camera: Camera
    cam_from_rig: RigidTransform
    points_px: NDArray[np.floating[Any]]
    points_world: NDArray[np.float64]
    point_covariances: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        count = len(self.points_px)
        if self.points_px.shape != (count, 2) or self.points_world.shape != (count, 3):
            raise DataError(
                f"pixels {self.points_px.shape} and points {self.points_world.shape} of a view "
                "are not (N, 2) and (N, 3)"
            )
        if self.point_covariances is not None and self.point_covariances.shape != (count, 6):
            raise DataError(
                f"covariances {self.point_covariances.shape} of {count} points are not ({count}, 6)"
            )


def split_by_view(views: Sequence[View], per_match: NDArray[Any]) -> list[NDArray[Any]]:
    """One part for each view of what runs over the matches of all views, such as inliers (N,)."""
    return np.split(per_match, np.cumsum([len(view.points_px) for view in views])[:-1])


@dataclass(frozen=True, eq=False)
class PoseProblem:
    """The matches of a camera, or of all cameras of a rig, that its pose is estimated from.

    Attributes
    ----------
    views : of each camera, as they were given.
    points_px, points : float64 (N, 2) and (N, 3), the latter minus ``offset``.
    covariances : float64 (N, 6), or (0, 6) where no view has any.
    starts : int64 (V + 1,) first match of each view.
    cameras : of the views in their rig, as
        :func:`~megloc_kapture.geometry.projection.packed_views` has them.
    offset : float64 (3,), a point amid the others: far from the origin (ECEF) float64 loses what
        a recentred world keeps.
    """

    views: tuple[View, ...]
    points_px: NDArray[np.float64]
    points: NDArray[np.float64]
    covariances: NDArray[np.float64]
    starts: NDArray[np.int64]
    cameras: tuple[NDArray[Any], ...]
    offset: NDArray[np.float64]

    @classmethod
    def of(cls, views: Sequence[View]) -> PoseProblem:
        """The problem of any number of views, their matches in the same order."""
        from megloc_kapture.geometry.projection import packed_views

        starts = np.zeros(len(views) + 1, dtype=np.int64)
        np.cumsum([len(view.points_px) for view in views], out=starts[1:])
        world = _joined([view.points_world for view in views], 3)
        offset = _amid(world)
        covariances = np.zeros((0, 6))
        if any(view.point_covariances is not None for view in views):
            covariances = _joined(
                [
                    np.zeros((len(view.points_px), 6))
                    if view.point_covariances is None
                    else view.point_covariances
                    for view in views
                ],
                6,
            )
        return cls(
            views=tuple(views),
            points_px=_joined([view.points_px for view in views], 2),
            points=world - offset,
            covariances=covariances,
            starts=starts,
            cameras=packed_views(
                [view.camera for view in views], [view.cam_from_rig for view in views]
            ),
            offset=offset,
        )

    @property
    def matches(self) -> tuple[NDArray[Any], ...]:
        """The arrays that :mod:`~megloc_kapture.localization.pose_kernels` calls ``matches``."""
        return (self.points_px, self.points, self.covariances, self.starts, *self.cameras)


def _joined(parts: Sequence[NDArray[np.floating[Any]]], width: int) -> NDArray[np.float64]:
    return np.concatenate([np.zeros((0, width)), *parts], dtype=np.float64)


def _amid(points: NDArray[np.float64]) -> NDArray[np.float64]:
    # the median of some of them: any point nearby serves, and wrong points must not move it far
    some = points[:: max(1, len(points) // 64)]
    some = np.sort(some[np.isfinite(some).all(axis=1)], axis=0)
    return some[len(some) // 2] if len(some) else np.zeros(3)


def undo_recentring(pose: RigidTransform, offset: NDArray[np.float64]) -> RigidTransform:
    """``rig_from_world`` of a pose in a world that was moved by minus ``offset`` (3,)."""
    t = np.array(pose.translation) - pose.rotation_matrix() @ offset
    return RigidTransform(pose.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


class AbsolutePoseOptions(Options):
    """Options of the pose estimation."""

    max_error_px: float = Field(default=12.0, gt=0, description="reprojection error of an inlier")
    min_inliers: int = Field(default=12, ge=4, description="fewer is a failure")
    max_center_deviation: float = Field(
        default=0.2,
        gt=0,
        description="largest standard deviation of the camera's centre, as a share of its "
        "inliers' median depth; more is a failure",
    )
    map_noise: float = Field(
        default=1 / 3,
        ge=0,
        description="noise of the keypoints that the map's points come from, as a share of the "
        "residuals'; 0: points count as exact",
    )
    min_iterations: int = Field(default=100, gt=0, description="RANSAC's")
    max_iterations: int = Field(default=20_000, gt=0, description="RANSAC's")
    confidence: float = Field(
        default=0.9999, gt=0, lt=1, description="RANSAC stops when it is as sure of its best pose"
    )
    seed: int = Field(default=0, ge=0, description="of RANSAC's samples")

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
class PoseEstimate:
    """A pose that enough matches agree with, before its refinement.

    Attributes
    ----------
    rig_from_world : the pose; ``cam_from_world`` where the only view is at the rig's origin.
    usable : bool (N,) over the matches of all views in order: point and ray are finite.
    inliers : bool (N,), usable and within the error that is allowed, under the camera's model.
    errors_px : float64 (N,) reprojection errors; infinite behind a camera and where not usable.
    """

    rig_from_world: RigidTransform
    usable: NDArray[np.bool_]
    inliers: NDArray[np.bool_]
    errors_px: NDArray[np.float64]

    @property
    def num_inliers(self) -> int:
        return int(np.count_nonzero(self.inliers))


def estimate_pose(
    problem: PoseProblem, options: AbsolutePoseOptions | None = None
) -> PoseEstimate | Failure:
    """Estimate ``rig_from_world`` from the matches of one camera or several.

    A view without matches, or whose matches are all wrong, is no harm.

    Returns
    -------
    PoseEstimate, or Failure with the reason.
    """
    options = options or AbsolutePoseOptions()
    count = len(problem.points)
    if count < options.min_inliers:
        return Failure(
            f"{count} 2D-3D matches, at least {options.min_inliers} are needed", num_matches=count
        )
    # a camera's distortion cannot be undone everywhere: such rays are NaN
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
    errors_px, _ = _measured(problem, rig_from_world, usable)
    inliers = errors_px <= options.max_error_px
    num_inliers = int(np.count_nonzero(inliers))
    if num_inliers < options.min_inliers:
        return too_few_agree(num_inliers, count, options)
    pose = undo_recentring(rig_from_world, problem.offset)
    return PoseEstimate(pose, usable, inliers, errors_px)


def too_few_agree(num_inliers: int, count: int, options: AbsolutePoseOptions) -> Failure:
    """No pose has enough inliers."""
    return Failure(
        f"{num_inliers} of {count} 2D-3D matches agree, at least {options.min_inliers} are needed",
        num_matches=count,
        num_inliers=num_inliers,
    )


def _measured(
    problem: PoseProblem, rig_from_world: RigidTransform, usable: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors in pixels (N,), infinite behind the camera and where a match is not ``usable``; and
    their lengths when whitened.

    ``rig_from_world`` is that of the recentred world.
    """
    from megloc_kapture.localization import pose_kernels

    count = len(usable)
    errors, squared = np.empty(count), np.full(count, np.inf)
    pose_kernels.measure(
        problem.matches,
        usable,
        rig_from_world.rotation_matrix(),
        np.array(rig_from_world.translation),
        errors,
        np.empty((count, 3)),
        squared,
        np.empty(count),
    )
    return errors, np.sqrt(squared)


def reprojection_errors_px(
    problem: PoseProblem, rig_from_world: RigidTransform
) -> NDArray[np.float64]:
    """Errors in pixels (N,) of all matches; infinite behind a camera and where a point is none."""
    return _measured_in_world(problem, rig_from_world)[0]


def whitened_errors_px(problem: PoseProblem, rig_from_world: RigidTransform) -> NDArray[np.float64]:
    """As :func:`reprojection_errors_px`, by Mahalanobis' distance: an error of one pixel, and what
    the point's covariance makes of it, count as one."""
    return _measured_in_world(problem, rig_from_world)[1]


def _measured_in_world(
    problem: PoseProblem, rig_from_world: RigidTransform
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    usable = np.asarray(np.isfinite(problem.points).all(axis=1))
    return _measured(problem, undo_recentring(rig_from_world, -problem.offset), usable)


def _ransac(
    problem: PoseProblem,
    rays: NDArray[np.float64],
    usable: NDArray[np.bool_],
    options: AbsolutePoseOptions,
) -> RigidTransform:
    """``rig_from_world`` in the recentred world."""
    import poselib

    # its last bundle adjustment takes longer than the whole refinement that follows instead; the
    # local optimisations of the RANSAC are not concerned
    bundle = {"max_iterations": 0}
    points_2d, points_3d, extrinsics, pinholes, cams_from_rig = [], [], [], [], []
    for view, first, last in zip(
        problem.views, problem.starts[:-1].tolist(), problem.starts[1:].tolist(), strict=True
    ):
        rows = first + np.flatnonzero(usable[first:last])
        if len(rows) == 0:
            continue
        # undistorted pixels of a pinhole with the same focal length: poselib's own list of camera
        # models is shorter than COLMAP's
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
        found, _ = poselib.estimate_absolute_pose(
            points_2d[0], points_3d[0], pinholes[0], options.for_poselib(), bundle
        )
        return cams_from_rig[0].inverse() @ _rigid_from_poselib(found)
    # GP3P draws from C's rand() whatever poselib's own seed is, and the last digits follow; other
    # threads must not draw in between, for the lock of the interpreter is not held
    with _RAND:
        ctypes.CDLL(None).srand(ctypes.c_uint(options.seed))
        found, _ = poselib.estimate_generalized_absolute_pose(
            points_2d, points_3d, extrinsics, pinholes, options.for_poselib(), bundle
        )
    return _rigid_from_poselib(found)


def _rigid_from_poselib(found: Any) -> RigidTransform:
    """poselib's pose as ours, its quaternion of unit length."""
    quat = np.asarray(found.q, dtype=np.float64)
    quat = quat / np.linalg.norm(quat)
    t = np.asarray(found.t, dtype=np.float64)
    return RigidTransform(
        (float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])),
        (float(t[0]), float(t[1]), float(t[2])),
    )
