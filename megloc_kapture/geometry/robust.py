"""The scale of residuals of which many may be wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# the standard deviation of normal values over the median of their magnitudes: 1 / (quantile of 3/4)
_DEVIATION_OF_MEDIAN = 1.482602218505602


def deviation_by_median(residuals: NDArray[np.floating[Any]]) -> np.float64:
    """Standard deviation of normal values around 0, by the median of their magnitudes.

    Up to half of the values cannot spoil it (Rousseeuw and Croux, JASA 1993). NaN of none.
    """
    return _DEVIATION_OF_MEDIAN * np.median(np.abs(residuals))
