"""How well poses fit: robust cost and correlation of the query with the warped references."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.refinement.photometric import LOSS_SCALE, Alignment, LevelProblem
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.values import RigidTransform

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a pose fits.

    Attributes
    ----------
    cost : mean of the robust loss, over the square of its scale: 0 to 0.5.
    correlation : of the query's values with the references', over all points and channels.
    count : of points that are seen.
    """

    cost: float
    correlation: float
    count: int


@dataclass(frozen=True, eq=False)
class Comparison:
    """An old pose and a new one on the points that both see.

    Attributes
    ----------
    before, after : how well they fit.
    significance : by how many of its standard errors the cost falls. Cells of the query count as
        one observation each: a pose that is better shows it in most of them, one that was tuned to
        noise, or to what looks alike by chance, in some.
    """

    before: Fit
    after: Fit
    significance: float


def compared(problem: LevelProblem, old: RigidTransform, new: RigidTransform) -> Comparison:
    """How well two poses fit, on the points that both see, each with its own gains and biases.

    Both with the loss' scale of the new one.
    """
    aligned = [problem.nuisance_at(pose) for pose in (old, new)]
    rows = [problem.rows(at) for at in aligned]
    hidden = np.isnan(rows[0][:, 0, 0]) | np.isnan(rows[1][:, 0, 0])
    for each in rows:
        each[hidden, :, 0] = np.nan
    deviation = aligned[1].deviation
    cells = problem.cells(new, ~hidden)
    gained = _losses(rows[0][~hidden], deviation) - _losses(rows[1][~hidden], deviation)
    before, after = (_fit(problem, each, deviation) for each in rows)
    return Comparison(before, after, _significance(gained, cells))


def _losses(rows: Float64, deviation: float) -> Float64:
    """Robust loss of each point, over the square of its scale: 0 to 0.5."""
    squared = np.square(rows[..., 0]).mean(1) / (LOSS_SCALE * max(deviation, 1e-12)) ** 2
    return np.asarray(0.5 * squared / (1.0 + squared))


def _significance(gained: Float64, cells: NDArray[np.int64]) -> float:
    """Sum of the gains over its standard error, if the cells' gains were independent, of mean 0."""
    sums = np.bincount(cells, gained)
    error = float(np.sqrt(np.square(sums).sum()))
    return float(sums.sum()) / error if error > 0 else 0.0


def correlation(problem: LevelProblem, at: Alignment) -> float:
    """Of the query's values with the references'; see :class:`Fit`."""
    return _correlation(problem.rows(at), problem.chosen, problem.num_groups)


def _fit(problem: LevelProblem, rows: Float64, deviation: float) -> Fit:
    squared_scale = (LOSS_SCALE * max(deviation, 1e-12)) ** 2
    system = problem.system_of(rows, squared_scale)
    return Fit(
        system.mean_cost / squared_scale,
        _correlation(rows, problem.chosen, problem.num_groups),
        system.count,
    )


def _correlation(rows: Float64, chosen: ChosenPoints, num_groups: int) -> float:
    """Correlation of two sets of values whose means are those of each reference and channel."""
    seen = ~np.isnan(rows[:, 0, 0])
    query, reference, groups = (
        rows[seen][..., 7],
        chosen.values[seen],
        chosen.groups[seen],
    )
    together = apart_query = apart_reference = 0.0
    for group in range(num_groups):
        ours = groups == group
        if not ours.any():
            continue
        a = query[ours] - query[ours].mean(0)
        b = reference[ours] - reference[ours].mean(0)
        together += float((a * b).sum())
        apart_query += float((a * a).sum())
        apart_reference += float((b * b).sum())
    product = apart_query * apart_reference
    return together / float(np.sqrt(product)) if product > 0 else 0.0
