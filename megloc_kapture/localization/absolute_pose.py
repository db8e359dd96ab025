"""Absolute pose of one camera from 2D-3D matches: estimation and refinement in one call."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.localization.estimation import AbsolutePoseOptions
from megloc_kapture.localization.rig_pose import rig_pose
from megloc_kapture.localization.views import View
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

__all__ = ["AbsolutePoseOptions", "absolute_pose"]


def absolute_pose(
    points_px: NDArray[np.floating[Any]],
    points_world: NDArray[np.float64],
    camera: Camera,
    options: AbsolutePoseOptions | None = None,
    point_covariances: NDArray[np.float64] | None = None,
) -> Pose | Failure:
    """Estimate ``cam_from_world``.

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
