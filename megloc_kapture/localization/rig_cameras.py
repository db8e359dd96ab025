"""What the pose of a rig says of each of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.poses import cross_matrix
from megloc_kapture.localization.cluster_poses import ClusterLocalization, QueryView
from megloc_kapture.values import ClusterPose, Failure, Pose, RigidTransform


def poses_of_cameras(
    views: Sequence[QueryView], found: ClusterLocalization
) -> list[Pose | Failure]:
    """One result per camera of a localized rig, with its own matches and inliers.

    A camera without any inlier has not been localized, whatever the others say: it fails, and it
    is for who asked to give it its pose through the rig.
    """
    result = found.result
    if not isinstance(result, Pose) or result.inliers is None:
        raise ValueError("the rig has no pose, or its inliers are not known")
    masks = np.split(result.inliers, np.cumsum(found.matches_of_views)[:-1])
    cameras: list[Pose | Failure] = []
    for view, inliers in zip(views, masks, strict=True):
        num_inliers = int(inliers.sum())
        if num_inliers == 0:
            cameras.append(
                Failure(
                    "no inlier in this camera; others of its rig were localized",
                    num_matches=len(inliers),
                    candidates=result.candidates,
                    clusters=_of_camera(result.clusters, view.cam_from_rig),
                    seconds=result.seconds,
                )
            )
            continue
        cameras.append(
            replace(
                result,
                cam_from_world=view.cam_from_rig @ result.cam_from_world,
                clusters=_of_camera(result.clusters, view.cam_from_rig),
                num_matches=len(inliers),
                num_inliers=num_inliers,
                inliers=inliers,
                covariance=None
                if result.covariance is None
                else moved_covariance(result.covariance, view.cam_from_rig),
            )
        )
    return cameras


def _of_camera(
    clusters: Sequence[ClusterPose], cam_from_rig: RigidTransform
) -> tuple[ClusterPose, ...]:
    """The clusters of a rig, with the poses of one of its cameras."""
    return tuple(
        cluster
        if cluster.cam_from_world is None
        else replace(cluster, cam_from_world=cam_from_rig @ cluster.cam_from_world)
        for cluster in clusters
    )


def moved_covariance(
    covariance: NDArray[np.float64], cam_from_rig: RigidTransform
) -> NDArray[np.float64]:
    """Covariance (6, 6) of ``cam_from_rig @ rig_from_world`` of one of ``rig_from_world``.

    Both of left perturbations, rotation first: with ``C exp(xi) = exp(Ad_C xi) C`` it is
    ``Ad_C covariance Ad_C^T`` (Barfoot, State Estimation for Robotics, section 7.1.4).
    """
    rotation = cam_from_rig.rotation_matrix()
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = rotation
    adjoint[3:, :3] = cross_matrix(np.array(cam_from_rig.translation)) @ rotation
    return np.asarray(adjoint @ covariance @ adjoint.T)
