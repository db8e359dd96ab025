"""Weights of the features that are fused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError


def normalized_weights(weights: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    """Weights (count,) that sum to one; all equal where none are given.

    Raises
    ------
    OptionError : another number of weights, or one that is not finite and positive. A feature that
        is not to count is left out: harmonic means and ranks have no place for a weight of zero.
    """
    given = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if count == 0 or given.shape != (count,):
        raise OptionError(f"{given.size} weights for {count} global features")
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise OptionError(f"weights {given.tolist()} are not all finite and positive")
    normalized: NDArray[np.float64] = given / given.sum()
    return normalized
