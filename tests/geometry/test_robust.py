"""The deviation of normal values by their median, and what outliers do to it."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from megloc_kapture.geometry.robust import deviation_by_median


def test_the_factor_is_that_of_the_normal_distribution() -> None:
    quarter = NormalDist().inv_cdf(0.75)
    assert deviation_by_median(np.array([-quarter, quarter])) == pytest.approx(1.0, rel=1e-15)


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_outliers_hardly_move_it(wrong: float) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(scale=0.2, size=200_000)
    values[rng.random(len(values)) < wrong] = 1e6
    # of a tenth of outliers the median is the quantile of 5/9 of what is left
    expected = 0.2 * NormalDist().inv_cdf(0.5 + 0.25 / (1 - wrong)) / NormalDist().inv_cdf(0.75)
    assert deviation_by_median(values) == pytest.approx(expected, rel=0.01)
