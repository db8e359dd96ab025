"""How uncertain an alignment is, by what its own residuals say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.refinement.photometric import (
    MIN_POINTS,
    Alignment,
    LevelProblem,
    perturbed,
)
from megloc_kapture.refinement.photometric_directions import even_steps
from megloc_kapture.refinement.photometric_equations import NormalEquations

Float64 = NDArray[np.float64]

_CHANGE = 0.5  # of the residuals by a difference at most, in their deviations
# of the normal equations, that the objective's own curvature must have
_LEAST_SHARE = 0.02


def covariance(problem: LevelProblem, at: Alignment) -> Float64 | None:
    """Covariance (6, 6) of the pose, as of ``Pose``; None where it is not determined.

    The sandwich of the objective's curvature with the scores of cells of the query, each taken as
    one observation (Liang and Zeger, Biometrika 1986): what neighbouring residuals have in common
    (blur, light, the query's noise seen by several references) makes it larger as it must. The
    curvature is that of the objective about the pose and not of its normal equations, in which the
    query's noise passes for gradients. Errors that the whole image shares, of the map's poses and
    depths or of the calibration, are not in the residuals and thus not in the covariance.
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
    problem: LevelProblem,
    at: Alignment,
    rows: Float64,
    squared_scale: float,
    projection: Float64,
) -> Float64 | None:
    """Squared scores (6, 6) of the cells; None where there are too few."""
    seen = ~np.isnan(rows[:, 0, 0])
    rows, groups = rows[seen], problem.chosen.groups[seen]
    weight = (1.0 + np.square(rows[..., 0]).mean(1) / squared_scale) ** -2 / rows.shape[1]
    # the derivative by the pose where gain and bias follow it
    own = np.stack([rows[..., 7], np.ones(rows.shape[:2])], axis=-1)
    derivative = rows[..., 1:7] - np.einsum("ncpi,nci->ncp", projection[groups], own)
    score = np.einsum("n,nc,ncp->np", weight, rows[..., 0], derivative)
    cells = problem.cells(at.cam_from_world, seen)
    sums = np.zeros((int(cells.max()) + 1, 6))
    np.add.at(sums, cells, score)
    occupied = len(np.unique(cells))
    return sums.T @ sums * occupied / (occupied - 6) if occupied > 6 else None


def _inverse_curvature(
    problem: LevelProblem, at: Alignment, squared_scale: float, system: NormalEquations
) -> Float64 | None:
    """Inverse (6, 6) of the second derivatives by the pose; None where it is no minimum.

    Differences are taken along the even steps.
    """
    found = even_steps(problem, system)
    if found is None:
        return None
    steps, change = found
    # not so far that the loss takes the change for outliers
    weights = float(system.own[..., 2].sum())
    nearer = min(1.0, (_CHANGE * at.deviation) ** 2 * weights / change)
    steps, change = steps * np.sqrt(nearer), change * nearer
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
    # normal equations would have six values of ``change``
    if not values[0] > _LEAST_SHARE * change:
        return None
    half = steps @ (vectors / np.sqrt(values))
    return np.asarray(half @ half.T)
