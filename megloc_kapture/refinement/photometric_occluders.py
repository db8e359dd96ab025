"""Which parts of a query show what the references show, and which are hidden by something else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.refinement.photometric import Alignment, LevelProblem

# points from which a cell tells whether it looks like the references, and how well it then must, as
# a share of what a good one does
_CELL_POINTS = 20
_AGREES = 0.5


def agreeing(problem: LevelProblem, at: Alignment) -> NDArray[np.bool_]:
    """Points (N,) of the cells of the query that look like the references, others left out.

    What stands in front of a scene is not a few odd residuals but a whole part of the image, in
    which nothing correlates.
    """
    rows = problem.rows(at)
    seen = np.flatnonzero(~np.isnan(rows[:, 0, 0]))
    keep = np.ones(len(rows), np.bool_)
    if len(seen) == 0:
        return keep
    cells = problem.cells(at.cam_from_world, seen)
    groups = problem.chosen.groups[seen]
    ours = rows[seen, :, 7] * at.gains[groups] + at.biases[groups]
    theirs = problem.chosen.values[seen]
    count = np.bincount(cells)
    filled = np.maximum(count, 1)[:, None]

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        channels = [np.bincount(cells, channel, len(count)) for channel in values.T]
        return np.stack(channels, axis=1)

    ours = ours - (summed(ours) / filled)[cells]
    theirs = theirs - (summed(theirs) / filled)[cells]
    product = summed(ours**2).sum(1) * summed(theirs**2).sum(1)
    correlation = summed(ours * theirs).sum(1) / np.sqrt(np.maximum(product, 1e-30))
    told = count >= _CELL_POINTS
    if told.sum() > 0:
        limit = _AGREES * float(np.percentile(correlation[told], 75))
        keep[seen] = ~told[cells] | (correlation[cells] >= limit)
    return keep
