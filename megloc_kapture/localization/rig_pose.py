"""Pose of a rig of cameras from the 2D-3D matches of all of them, in one call."""

from __future__ import annotations

from collections.abc import Sequence

from megloc_kapture.localization.estimation import AbsolutePoseOptions, estimate_stacked
from megloc_kapture.localization.pose_refinement import refine_stacked
from megloc_kapture.localization.views import View, stack_views
from megloc_kapture.values import Failure, Pose

__all__ = ["AbsolutePoseOptions", "RigView", "rig_pose"]

RigView = View


def rig_pose(views: Sequence[View], options: AbsolutePoseOptions | None = None) -> Pose | Failure:
    """Estimate ``rig_from_world``; a camera without matches is no harm.

    Returns
    -------
    Pose whose ``cam_from_world`` is ``rig_from_world``, with its covariance, or Failure with the
    reason. The inlier mask runs over the matches of all views in order
    (:func:`megloc_kapture.localization.views.split_by_view`).
    """
    options = options or AbsolutePoseOptions()
    stacked = stack_views(views)
    estimate = estimate_stacked(stacked, options)
    if isinstance(estimate, Failure):
        return estimate
    return refine_stacked(stacked, estimate, options)
