"""One camera of several photographs: their estimates of it joined, their poses solved with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from megloc_kapture.geometry.cameras import focal_px
from megloc_kapture.localization.estimation import (
    AbsolutePoseOptions,
    PoseEstimate,
    PoseProblem,
    View,
)
from megloc_kapture.localization.focal_length import refine_with_intrinsics
from megloc_kapture.values import Camera, Pose, RigidTransform

# an estimate this many standard deviations off is of another zoom
_MAX_SIGMAS = 3.0
# errors of a map, and a lens that is none of the model, are alike in photographs: their number
# averages less out than if they were independent (measured: docs/photos.md)
_ALIKE = 2.0


def shared_camera(cameras: Sequence[Camera]) -> Camera:
    """The camera that estimates of one camera agree on: medians, weighted by their certainty.

    Parameters
    ----------
    cameras : estimates, of one model and size, with their ``focal_deviation``; at least one.
    """
    weights = np.array([camera.focal_deviation**-2.0 for camera in cameras])
    params = np.array([camera.params for camera in cameras])
    order = np.argsort(params, axis=0, kind="stable")
    below = np.cumsum(weights[order], axis=0)
    middle = (below < 0.5 * below[-1]).sum(axis=0)
    found = np.take_along_axis(params, order, axis=0)[middle, np.arange(params.shape[1])]
    deviation = _ALIKE / math.sqrt(float(weights.sum()))
    return replace(cameras[0], params=tuple(found.tolist()), focal_deviation=deviation)


def solve_with_shared_camera(poses: Sequence[Pose], options: AbsolutePoseOptions) -> list[Pose]:
    """Poses of photographs of one camera, solved again with what all of them tell of it.

    A photograph whose own estimate contradicts the others', as one at another zoom, keeps it; and
    so does one whose pose was refined by other means.

    Parameters
    ----------
    poses : with the camera that was estimated of each, and their inliers.
    """
    usable = [p.camera for p in poses if p.camera is not None and p.camera.focal_deviation > 0]
    if len(usable) < 2:
        return list(poses)
    shared = shared_camera(usable)
    near = [camera for camera in usable if _agrees(camera, shared)]
    if len(near) < 2:
        return list(poses)
    shared = shared_camera(near)
    return [
        _solved(pose, shared, len(near), options)
        if pose.camera in near and not pose.refinements
        else pose
        for pose in poses
    ]


def _agrees(camera: Camera, shared: Camera) -> bool:
    apart = math.log(focal_px(camera) / focal_px(shared))
    return abs(apart) <= _MAX_SIGMAS * math.hypot(camera.focal_deviation, shared.focal_deviation)


def _solved(pose: Pose, shared: Camera, number: int, options: AbsolutePoseOptions) -> Pose:
    """The pose with the shared camera; the pose itself where its inliers do not allow it."""
    if pose.inlier_points_px is None or pose.inlier_points_world is None:
        return pose
    inliers = pose.inlier_points_px, pose.inlier_points_world
    problem = PoseProblem.of([View(shared, RigidTransform.identity(), *inliers)])
    every = np.ones(len(problem.points), bool)
    start = PoseEstimate(pose.cam_from_world, every, every, np.zeros(len(every)))
    _, found = refine_with_intrinsics(problem, start, options, shared)
    if not isinstance(found, Pose) or found.camera is None:
        return pose
    camera = found.camera
    remark = (
        f"focal length estimated of {number} photographs: {focal_px(camera):.0f} +- "
        f"{camera.focal_deviation * focal_px(camera):.0f} px"
    )
    return replace(
        pose,
        cam_from_world=found.cam_from_world,
        covariance=found.covariance,
        camera=camera,
        remarks=(*(r for r in pose.remarks if not r.startswith("focal length estimated")), remark),
    )
