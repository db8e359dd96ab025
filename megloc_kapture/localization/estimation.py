"""First estimate of a pose and its inliers: LO-RANSAC by poselib.

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

from megloc_kapture.geometry.cameras import focal_px, normalized_from_px
from megloc_kapture.localization.views import (
    StackedViews,
    View,
    stack_views,
    undo_recentring,
)
from megloc_kapture.values import Failure, Options, RigidTransform

# GP3P draws from C's rand(), one state for the whole process
_RAND = threading.Lock()


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
    min_iterations: int = Field(default=100, gt=0)
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
    views: Sequence[View], options: AbsolutePoseOptions | None = None
) -> PoseEstimate | Failure:
    """Estimate ``rig_from_world`` from the matches of one camera or several.

    A view without matches, or whose matches are all wrong, is no harm.

    Returns
    -------
    PoseEstimate, or Failure with the reason.
    """
    return estimate_stacked(stack_views(views), options or AbsolutePoseOptions())


def estimate_stacked(stacked: StackedViews, options: AbsolutePoseOptions) -> PoseEstimate | Failure:
    """:func:`estimate_pose` of views that are stacked already."""
    count = len(stacked.points)
    if count < options.min_inliers:
        return Failure(
            f"{count} 2D-3D matches, at least {options.min_inliers} are needed", num_matches=count
        )
    # a camera's distortion cannot be undone everywhere: such rays are NaN
    rays = np.concatenate([normalized_from_px(v.camera, v.points_px) for v in stacked.views])
    usable = np.isfinite(rays).all(axis=1) & np.isfinite(stacked.points).all(axis=1)
    num_usable = int(np.count_nonzero(usable))
    if num_usable < options.min_inliers:
        return Failure(
            f"{num_usable} of {count} 2D-3D matches can be used, at least {options.min_inliers} "
            "are needed",
            num_matches=count,
        )
    rig_from_world = _ransac(stacked, rays, usable, options)
    errors_px = _errors_px(stacked, rig_from_world, usable)
    inliers = errors_px <= options.max_error_px
    num_inliers = int(np.count_nonzero(inliers))
    if num_inliers < options.min_inliers:
        return too_few_agree(num_inliers, count, options)
    pose = undo_recentring(rig_from_world, stacked.offset)
    return PoseEstimate(pose, usable, inliers, errors_px)


def too_few_agree(num_inliers: int, count: int, options: AbsolutePoseOptions) -> Failure:
    """No pose has enough inliers."""
    return Failure(
        f"{num_inliers} of {count} 2D-3D matches agree, at least {options.min_inliers} are needed",
        num_matches=count,
        num_inliers=num_inliers,
    )


def _errors_px(
    stacked: StackedViews, rig_from_world: RigidTransform, usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Errors in pixels (N,), infinite behind the camera and where a match is not ``usable``.

    ``rig_from_world`` is that of the recentred world.
    """
    from megloc_kapture.localization import pose_kernels

    count = len(usable)
    errors = np.empty(count)
    pose_kernels.measure(
        pose_kernels.matches_of(stacked),
        usable,
        rig_from_world.rotation_matrix(),
        np.array(rig_from_world.translation),
        errors,
        np.empty((count, 3)),
        np.empty(count),
        np.empty(count),
    )
    return errors


def _ransac(
    stacked: StackedViews,
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
        stacked.views, stacked.starts[:-1].tolist(), stacked.starts[1:].tolist(), strict=True
    ):
        rows = first + np.flatnonzero(usable[first:last])
        if len(rows) == 0:
            continue
        # undistorted pixels of a pinhole with the same focal length: poselib's own list of camera
        # models is shorter than COLMAP's
        focal = focal_px(view.camera)
        points_2d.append(rays[rows] * focal)
        points_3d.append(stacked.points[rows])
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
