"""Pose of a rig of cameras from the 2D-3D matches of all of them (generalized absolute pose)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, focal_px, px_from_cam
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    poselib_pinhole,
    rigid_from_poselib,
    undo_recentring,
)
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform


@dataclass(frozen=True, eq=False)
class RigView:
    """One camera of a rig and its matches: pixels (N, 2) and world points (N, 3)."""

    camera: Camera
    cam_from_rig: RigidTransform
    points_px: NDArray[np.float64]
    points_world: NDArray[np.float64]


def rig_pose(
    views: Sequence[RigView], options: AbsolutePoseOptions | None = None
) -> Pose | Failure:
    """Estimate ``rig_from_world`` (GP3P in LO-RANSAC); a camera without matches is no harm.

    Returns
    -------
    Pose whose ``cam_from_world`` is ``rig_from_world``, or Failure with the reason. The inlier
    mask runs over the matches of all views, in order.
    """
    import poselib

    options = options or AbsolutePoseOptions()
    count = sum(len(view.points_px) for view in views)
    if count < options.min_inliers:
        return Failure(
            f"{count} 2D-3D matches, at least {options.min_inliers} are needed", num_matches=count
        )
    # a camera's distortion cannot be undone everywhere: such rays are NaN
    all_rays = [bearing_rays(view.camera, view.points_px) for view in views]
    usable = [
        np.isfinite(rays).all(axis=1) & np.isfinite(view.points_world).all(axis=1)
        for rays, view in zip(all_rays, views, strict=True)
    ]
    num_usable = int(sum(mask.sum() for mask in usable))
    if num_usable < options.min_inliers:
        return Failure(
            f"{num_usable} of {count} 2D-3D matches can be used, at least {options.min_inliers} "
            "are needed",
            num_matches=count,
        )
    offset = np.median(
        np.concatenate([view.points_world[mask] for view, mask in zip(views, usable, strict=True)]),
        axis=0,
    )
    points_2d, points_3d, extrinsics, cameras = [], [], [], []
    for view, rays, mask in zip(views, all_rays, usable, strict=True):
        if not mask.any():
            continue
        focal = focal_px(view.camera)
        points_2d.append(rays[mask, :2] * focal)
        points_3d.append(view.points_world[mask] - offset)
        extrinsic = poselib.CameraPose()
        extrinsic.q = np.array(view.cam_from_rig.quat_wxyz)
        extrinsic.t = np.array(view.cam_from_rig.translation)
        extrinsics.append(extrinsic)
        cameras.append(poselib_pinhole(focal))
    # its minimal solver draws from C's rand() whatever its own seed is: the last digits differ
    ctypes.CDLL(None).srand(ctypes.c_uint(options.seed))
    found, _ = poselib.estimate_generalized_absolute_pose(
        points_2d,
        points_3d,
        extrinsics,
        cameras,
        options.for_poselib(),
        {"loss_type": "CAUCHY", "loss_scale": 1.0},
    )
    rig_from_world = undo_recentring(rigid_from_poselib(found), offset)
    inliers = []
    for view, usable_here in zip(views, usable, strict=True):
        cam_from_world = view.cam_from_rig @ rig_from_world
        pixels = px_from_cam(view.camera, cam_from_world.apply(view.points_world))
        errors = np.linalg.norm(pixels - view.points_px, axis=1)
        inliers.append(usable_here & (np.nan_to_num(errors, nan=np.inf) <= options.max_error_px))
    mask = np.concatenate(inliers)
    if mask.sum() < options.min_inliers:
        return Failure(
            f"{mask.sum()} of {count} 2D-3D matches agree, at least {options.min_inliers} "
            "are needed",
            num_matches=count,
            num_inliers=int(mask.sum()),
        )
    return Pose(rig_from_world, num_matches=count, num_inliers=int(mask.sum()), inliers=mask)
