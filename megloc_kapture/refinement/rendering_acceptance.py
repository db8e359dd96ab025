"""When a pose found by rendering takes the place of the old one.

It must look more like the query than the old one, in most parts of the query, and it must differ
from the old one by more than its own uncertainty: images say where a camera is to some millimetres,
and a pose that is as good as that gains nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import movement
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.refinement.photometric import MIN_POINTS, Alignment, LevelProblem
from megloc_kapture.refinement.photometric_covariance import covariance
from megloc_kapture.refinement.photometric_fit import Comparison, compared
from megloc_kapture.refinement.rendering_options import RenderingOptions
from megloc_kapture.values import RigidTransform

# squared distance between two poses over the covariance of one that chance exceeds once in a
# thousand times: the chi-squared distribution of six degrees of freedom
CHI2_OF_CHANCE = 22.46


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that may take the place of the old one.

    Attributes
    ----------
    problem : at the finest level, with all points.
    free : the same without what something else hides.
    alignment : of ``free``.
    """

    problem: LevelProblem
    free: LevelProblem
    alignment: Alignment


def judged(
    start: RigidTransform,
    found: Candidate,
    overlaps: tuple[float, float],
    options: RenderingOptions,
) -> PoseRefinement:
    """The new pose with its covariance, or the old one and why.

    Both are compared on all points, also those that something may hide.

    Parameters
    ----------
    start : the old ``cam_from_world``.
    overlaps : shares of the query that references cover, at the old pose and at the new one.
    """
    pose = found.alignment.cam_from_world
    comparison = compared(found.problem, start, pose)
    moved_m, turned_deg = movement(start, pose)
    measures = {
        "cost_before": comparison.before.cost,
        "cost_after": comparison.after.cost,
        "significance": comparison.significance,
        "correlation_before": comparison.before.correlation,
        "correlation_after": comparison.after.correlation,
        "overlap_before": overlaps[0],
        "overlap_after": overlaps[1],
        "moved_m": moved_m,
        "turned_deg": turned_deg,
        "moved_px": _moved_px(found.problem, start, pose),
        "points": float(comparison.after.count),
        "references": float(len(np.unique(found.problem.chosen.groups))),
    }
    uncertainty = covariance(found.free, found.alignment)
    if uncertainty is not None:
        measures["claimed_m"] = float(np.sqrt(np.trace(uncertainty[3:, 3:])))
        measures["claimed_deg"] = float(np.degrees(np.sqrt(np.trace(uncertainty[:3, :3]))))
        measures["squared_distance"] = squared_distance(start, pose, uncertainty)
    reason = _too_far(moved_m, turned_deg, options) or _no_better(comparison, overlaps, options)
    if reason:
        return PoseRefinement(start, reason, measures)
    if uncertainty is None:
        return PoseRefinement(start, "the images do not determine the pose", measures)
    if not measures["squared_distance"] > CHI2_OF_CHANCE:
        return PoseRefinement(start, "it is as near as the images can tell", measures)
    return PoseRefinement(pose, "", measures, uncertainty)


def squared_distance(
    old: RigidTransform, new: RigidTransform, covariance: NDArray[np.float64]
) -> float:
    """Of two poses over the covariance (6, 6) of the new one, as of ``Pose``; exact where small."""
    old_from_new = old @ new.inverse()
    w, x, y, z = old_from_new.quat_wxyz
    turn = 2.0 * np.copysign(1.0, w) * np.array([x, y, z])
    step = np.concatenate([turn, old_from_new.translation])
    return float(step @ np.linalg.solve(covariance, step))


def _moved_px(problem: LevelProblem, old: RigidTransform, new: RigidTransform) -> float:
    """Median by which points move in the image, in pixels of the level."""
    points = problem.chosen.points
    ahead = (old.apply(points)[:, 2] > 0) & (new.apply(points)[:, 2] > 0)
    if not ahead.any():
        return float("inf")
    scale = np.array([problem.level.scale_x, problem.level.scale_y])
    px = [project(problem.camera, pose, points[ahead]) * scale for pose in (old, new)]
    return float(np.median(np.linalg.norm(px[1] - px[0], axis=1)))


def _too_far(moved_m: float, turned_deg: float, options: RenderingOptions) -> str:
    if moved_m > options.max_translation_m:
        return f"would move {moved_m:.2f} m, more than {options.max_translation_m:g} m"
    if turned_deg > options.max_rotation_deg:
        return f"would turn {turned_deg:.2f} deg, more than {options.max_rotation_deg:g} deg"
    return ""


def _no_better(
    comparison: Comparison, overlaps: tuple[float, float], options: RenderingOptions
) -> str:
    after, significance = comparison.after, comparison.significance
    if after.count < MIN_POINTS:
        return f"only {after.count} points are seen from both poses"
    if after.correlation < options.min_correlation:
        return (
            f"references and query correlate by {after.correlation:.2f}, "
            f"less than {options.min_correlation:g}"
        )
    if significance < options.min_significance:
        return (
            f"the cost improves by {significance:.1f} of its standard errors, "
            f"less than {options.min_significance:g}"
        )
    if overlaps[1] < (1.0 - options.max_overlap_loss) * overlaps[0]:
        return f"the overlap falls from {overlaps[0]:.0%} to {overlaps[1]:.0%}"
    return ""
