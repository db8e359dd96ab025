"""How sure a share is that was counted on finitely many queries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LEVEL = 0.95


def confidence_interval(
    successes: ArrayLike, trials: ArrayLike, *, level: float = LEVEL
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Exact (Clopper-Pearson) confidence interval of a share.

    It holds the true share with at least ``level`` probability, whatever the share and the number
    of trials. Wilson's interval is a little narrower but does so on average only: with 98 queries
    its 95 % are 91 % where recall is near 99 %, which is where papers compare. The exact one costs
    a few tenths of a percent of width there.

    Queries count as independent draws. Those of one drive are not quite, so that the interval of
    such a set is rather too narrow than too wide.

    Parameters
    ----------
    successes, trials : whole numbers (...), ``0 <= successes <= trials``; shapes broadcast.
    level : confidence, above 0 and below 1.

    Returns
    -------
    low, high : float64 (...); 0 and 1 where there was no trial.
    """
    from scipy.special import betaincinv

    k, n = np.broadcast_arrays(
        np.asarray(successes, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    )
    tail = (1.0 - level) / 2.0
    low, high = np.zeros(k.shape), np.ones(k.shape)
    some, not_all = k > 0, k < n
    low[some] = betaincinv(k[some], (n - k + 1.0)[some], tail)
    high[not_all] = betaincinv((k + 1.0)[not_all], (n - k)[not_all], 1.0 - tail)
    return low, high
