"""Acceptance test of a refined pose, with its fit to the references and its covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import movement, perturbed
from megloc_kapture.plugins import PoseRefinement
from megloc_kapture.refinement.photometric import (
    LOSS_SCALE,
    MIN_POINTS,
    Alignment,
    LevelProblem,
    NormalEquations,
)
from megloc_kapture.refinement.pyramid import Appearance
from megloc_kapture.values import Options, RigidTransform

# squared Mahalanobis distance of two poses above which they differ significantly: chi-squared
# quantile, six degrees of freedom, p = 0.999
CHI2_OF_CHANCE = 22.46
# smaller displacements, in pixels of the level, are rounding errors, however small the covariance
_LEAST_PX = 1e-3
Float64 = NDArray[np.float64]
_CHANGE = 0.5  # largest change of the residuals by a finite difference, in standard deviations
# smallest accepted decrease of the robust cost, in standard errors
_MIN_SIGNIFICANCE = 2.5
# smallest accepted correlation of the query with the warped references
MIN_CORRELATION = 0.12
# share of the overlap at the old pose that the new pose may lose
_MAX_OVERLAP_LOSS = 0.1
# smallest curvature of the objective, as a share of the normal equations' curvature
_LEAST_SHARE = 0.02
# displacement of points on either side of a finite difference, in pixels of the level
_CURVATURE_PX = 0.5
# perturbations along each direction, in steps that move points by about _CURVATURE_PX
_START_STEPS = (-4.0, -2.0, 0.0, 2.0, 4.0)
# the pose is undetermined below this ratio of the normal equations' smallest to largest eigenvalue
_LEAST_CURVATURE = 1e-7


class RenderingOptions(Options):
    appearance: Appearance = Field(
        default="normalised",
        description="normalised: compare brightness with locally normalised mean and contrast, "
        "even between day and night; colours: compare red, green and blue, normalised likewise",
    )
    max_references: int = Field(
        default=4, gt=0, description="largest number of reference images with depth"
    )
    max_side_px: int = Field(
        default=640, ge=64, description="longer side of the finest level; larger images are reduced"
    )
    max_translation_m: float = Field(
        default=0.5, gt=0, description="largest accepted movement of the camera centre"
    )
    max_rotation_deg: float = Field(default=5.0, gt=0, description="largest accepted rotation")
    require_consistent_map: bool = Field(
        default=True,
        description="refine only if held-out map images, when refined, keep their poses",
    )
    accept_always: bool = Field(
        default=False,
        description="accept every refined pose without tests; require_consistent_map still tests "
        "the map",
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    problem: LevelProblem  # with all points of the level
    free: LevelProblem  # without occluded cells
    alignment: Alignment


def accept_or_keep(
    start: RigidTransform,
    candidate: Candidate,
    overlaps: tuple[float, float],
    options: RenderingOptions,
) -> PoseRefinement:
    """Return the new pose with its covariance, or the old pose with the reason for keeping it."""
    pose = candidate.alignment.cam_from_world
    moved_m, turned_deg = movement(start, pose)
    measures = {
        **compare_poses(candidate.problem, start, pose),
        "overlap_before": overlaps[0],
        "overlap_after": overlaps[1],
        "moved_m": moved_m,
        "turned_deg": turned_deg,
        "moved_px": _moved_px(candidate.problem, start, pose),
        "references": float(len(np.unique(candidate.problem.chosen.groups))),
    }
    uncertainty = covariance(candidate.free, candidate.alignment)
    if uncertainty is not None:
        measures["claimed_m"] = float(np.sqrt(np.trace(uncertainty[3:, 3:])))
        measures["claimed_deg"] = float(np.degrees(np.sqrt(np.trace(uncertainty[:3, :3]))))
        measures["squared_distance"] = squared_distance(start, pose, uncertainty)
    if options.accept_always:
        return PoseRefinement(pose, "", measures, uncertainty)
    reason = _too_far(moved_m, turned_deg, options) or _no_better(measures)
    if reason:
        return PoseRefinement(start, reason, measures)
    if uncertainty is None:
        return PoseRefinement(start, "the images do not determine the pose", measures)
    if measures["moved_px"] < _LEAST_PX or not measures["squared_distance"] > CHI2_OF_CHANCE:
        return PoseRefinement(
            start, "the images do not distinguish the old pose from the refined pose", measures
        )
    return PoseRefinement(pose, "", measures, uncertainty)


def squared_distance(
    old: RigidTransform, new: RigidTransform, covariance: NDArray[np.float64]
) -> float:
    """Return the squared Mahalanobis distance of two poses; covariance (6, 6) as in ``Pose``."""
    old_from_new = old @ new.inverse()
    w, x, y, z = old_from_new.quat_wxyz
    turn = 2.0 * np.copysign(1.0, w) * np.array([x, y, z])
    step = np.concatenate([turn, old_from_new.translation])
    return float(step @ np.linalg.solve(covariance, step))


def _moved_px(problem: LevelProblem, old: RigidTransform, new: RigidTransform) -> float:
    points = problem.chosen.points
    ahead = (old.apply(points)[:, 2] > 0) & (new.apply(points)[:, 2] > 0)
    if not ahead.any():
        return float("inf")
    scale = np.array([problem.level.scale_x, problem.level.scale_y])
    px = [project(problem.camera, pose, points[ahead]) * scale for pose in (old, new)]
    return float(np.median(np.linalg.norm(px[1] - px[0], axis=1)))


def _too_far(moved_m: float, turned_deg: float, options: RenderingOptions) -> str:
    if moved_m > options.max_translation_m:
        return f"the pose would move {moved_m:.2f} m, more than {options.max_translation_m:g} m"
    if turned_deg > options.max_rotation_deg:
        return (
            f"the pose would turn {turned_deg:.2f} deg, more than {options.max_rotation_deg:g} deg"
        )
    return ""


def _no_better(measures: Mapping[str, float]) -> str:
    correlation_after, significance = measures["correlation_after"], measures["significance"]
    overlap, overlap_after = measures["overlap_before"], measures["overlap_after"]
    if measures["points"] < MIN_POINTS:
        return f"only {measures['points']:.0f} points are seen from both poses"
    if correlation_after < MIN_CORRELATION:
        return (
            f"the correlation of references and query is {correlation_after:.2f}, "
            f"less than {MIN_CORRELATION:g}"
        )
    if significance < _MIN_SIGNIFICANCE:
        return (
            f"the cost decreases by {significance:.1f} standard errors, "
            f"less than {_MIN_SIGNIFICANCE:g}"
        )
    if overlap_after < (1.0 - _MAX_OVERLAP_LOSS) * overlap:
        return f"the overlap falls from {overlap:.0%} to {overlap_after:.0%}"
    return ""


def compare_poses(
    problem: LevelProblem, old: RigidTransform, new: RigidTransform
) -> dict[str, float]:
    """Compare two poses over the points that are visible from both.

    Return their costs, the significance of the difference, the correlations of query and reference
    values over all points and channels, and the number of points.
    """
    aligned = [problem.nuisance_at(pose) for pose in (old, new)]
    rows = [problem.rows(at) for at in aligned]
    hidden = np.isnan(rows[0][:, 0, 0]) | np.isnan(rows[1][:, 0, 0])
    for each in rows:
        each[hidden, :, 0] = np.nan
    deviation = aligned[1].deviation
    squared_scale = (LOSS_SCALE * max(deviation, 1e-12)) ** 2
    gained = _losses(rows[0][~hidden], squared_scale) - _losses(rows[1][~hidden], squared_scale)
    # sum of the cells' gains divided by its standard error, for independent gains with mean 0
    sums = np.bincount(problem.cells(new, ~hidden), gained)
    error = float(np.sqrt(np.square(sums).sum()))
    costs = [problem.system_of(each, squared_scale).mean_cost / squared_scale for each in rows]
    correlations = [correlation(problem, each) for each in rows]
    return {
        "cost_before": costs[0],
        "cost_after": costs[1],
        "significance": float(sums.sum()) / error if error > 0 else 0.0,
        "correlation_before": correlations[0],
        "correlation_after": correlations[1],
        "points": float((~hidden).sum()),
    }


def _losses(rows: Float64, squared_scale: float) -> Float64:
    squared = np.square(rows[..., 0]).mean(1) / squared_scale
    return np.asarray(0.5 * squared / (1.0 + squared))


def correlation(problem: LevelProblem, rows: Float64) -> float:
    """Return the correlation of query and reference values, from ``rows`` of the problem."""
    chosen, seen = problem.chosen, ~np.isnan(rows[:, 0, 0])
    query, reference, groups = rows[seen][..., 7], chosen.values[seen], chosen.groups[seen]
    product, query_square, reference_square = 0.0, 0.0, 0.0
    for group in range(problem.num_groups):
        ours = groups == group
        if not ours.any():
            continue
        a = query[ours] - query[ours].mean(0)
        b = reference[ours] - reference[ours].mean(0)
        product += float((a * b).sum())
        query_square += float((a * a).sum())
        reference_square += float((b * b).sum())
    squares = query_square * reference_square
    return product / float(np.sqrt(squares)) if squares > 0 else 0.0


def covariance(problem: LevelProblem, at: Alignment) -> Float64 | None:
    """Estimate the pose covariance (6, 6), as in ``Pose``; None if the pose is undetermined.

    The sandwich estimate is clustered by cells of the query, so that correlated residuals enlarge
    it (Liang and Zeger, Biometrika 1986). It uses the curvature of the objective instead of the
    normal equations, which count the query's noise as gradient. Errors shared by the whole image
    (map poses, depth, calibration) are not included.
    """
    rows = problem.rows(at)
    scale2 = max(at.squared_scale, 1e-24)
    system = problem.system_of(rows, scale2)
    reduced = system.reduced()
    if system.count < MIN_POINTS or reduced is None:
        return None
    inverse = _inverse_curvature(problem, at, scale2, system)
    if inverse is None:
        return None
    scatter = _scatter(problem, at, rows, scale2, reduced[2])
    return None if scatter is None else np.asarray(inverse @ scatter @ inverse)


def _scatter(
    problem: LevelProblem, at: Alignment, rows: Float64, squared_scale: float, projection: Float64
) -> Float64 | None:
    """Return the sum of outer products (6, 6) of the cells' scores; None for too few cells."""
    seen = ~np.isnan(rows[:, 0, 0])
    rows, groups = rows[seen], problem.chosen.groups[seen]
    weight = (1.0 + np.square(rows[..., 0]).mean(1) / squared_scale) ** -2 / rows.shape[1]
    # total derivative with respect to the pose, with gain and bias eliminated
    nuisance = np.stack([rows[..., 7], np.ones(rows.shape[:2])], axis=-1)
    derivative = rows[..., 1:7] - np.einsum("ncpi,nci->ncp", projection[groups], nuisance)
    score = np.einsum("n,nc,ncp->np", weight, rows[..., 0], derivative)
    cells = problem.cells(at.cam_from_world, seen)
    sums = np.zeros((int(cells.max()) + 1, 6))
    np.add.at(sums, cells, score)
    occupied = len(np.unique(cells))
    return sums.T @ sums * occupied / (occupied - 6) if occupied > 6 else None


def _inverse_curvature(
    problem: LevelProblem, at: Alignment, squared_scale: float, system: NormalEquations
) -> Float64 | None:
    whitened = whitened_directions(problem, system)
    if whitened is None:
        return None
    steps, change = whitened
    weights = float(system.own[..., 2].sum())
    shrink = min(1.0, (_CHANGE * at.deviation) ** 2 * weights / change)
    steps, change = steps * np.sqrt(shrink), change * shrink
    columns = []
    for step in steps.T:
        ends = []
        for sign in (1.0, -1.0):
            moved = replace(at, cam_from_world=perturbed(at.cam_from_world, sign * step))
            reduced = problem.system_at(moved, squared_scale).reduced()
            if reduced is None:
                return None
            ends.append(reduced[1])
        columns.append(steps.T @ (ends[0] - ends[1]) / 2.0)
    curvature = 0.5 * (np.array(columns) + np.array(columns).T)
    values, vectors = np.linalg.eigh(curvature)
    if not values[0] > _LEAST_SHARE * change:
        return None
    half = steps @ (vectors / np.sqrt(values))
    return np.asarray(half @ half.T)


def whitened_directions(
    problem: LevelProblem, system: NormalEquations
) -> tuple[Float64, float] | None:
    """Return pose steps (6, 6), in columns, that whiten the normal equations.

    Steps move points by about half a pixel of the level; the least determined direction is first.
    Also returns the change of the weighted sum of squared residuals, the same for every step.
    """
    reduced = system.reduced()
    if reduced is None:
        return None
    usual = _CURVATURE_PX / problem.px_per_step()
    scaled = reduced[0] * np.outer(usual, usual)
    values, vectors = np.linalg.eigh(scaled)
    if not values[0] > _LEAST_CURVATURE * values[-1]:
        return None
    change = float(np.trace(scaled)) / 6.0
    return usual[:, None] * vectors * np.sqrt(change / values), change


def perturbed_starts(problem: LevelProblem, at: Alignment) -> list[Alignment]:
    """Return alignments perturbed along the two least determined directions, lowest cost first."""
    scale2 = at.squared_scale
    whitened = whitened_directions(problem, problem.system_at(at, scale2)) if scale2 > 0 else None
    if whitened is None:
        return []
    first, second = whitened[0][:, 0], whitened[0][:, 1]
    steps = [a * first + b * second for a in _START_STEPS for b in _START_STEPS if a or b]
    others = [replace(at, cam_from_world=perturbed(at.cam_from_world, step)) for step in steps]
    costs = [problem.system_at(each, scale2).mean_cost for each in others]
    return [others[k] for k in np.argsort(costs, kind="stable")]
