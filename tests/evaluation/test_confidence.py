"""Confidence intervals: scipy's figures, and the coverage they promise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from megloc_kapture.evaluation.confidence import confidence_interval
from megloc_kapture.evaluation.pose_errors import PoseErrors
from megloc_kapture.evaluation.recall import recall_row
from megloc_kapture.evaluation.thresholds import Threshold

QUARTER = Threshold(position_m=0.25, angle_deg=2.0)


def coverage(low: np.ndarray, high: np.ndarray, trials: int, share: float) -> float:
    """Exact probability that the intervals (trials + 1,) of all counts hold the true share."""
    counts = np.arange(trials + 1)
    held = (low <= share) & (share <= high)
    return float(stats.binom.pmf(counts, trials, share)[held].sum())


@given(st.integers(0, 60), st.integers(0, 60))
def test_equal_to_scipy(successes: int, failures: int) -> None:
    trials = successes + failures
    low, high = confidence_interval(successes, trials)
    if trials == 0:
        assert (low, high) == (0.0, 1.0)
        return
    theirs = stats.binomtest(successes, trials).proportion_ci(method="exact")
    assert (float(low), float(high)) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


@pytest.mark.parametrize("trials", [12, 98, 191])
def test_never_below_nominal_where_wilsons_is(trials: int) -> None:
    counts = np.arange(trials + 1)
    low, high = confidence_interval(counts, trials)
    wilson = [stats.binomtest(int(k), trials).proportion_ci(method="wilson") for k in counts]
    their_low, their_high = np.array([(ci.low, ci.high) for ci in wilson]).T
    shares = np.linspace(0.001, 0.999, 999)
    ours = [coverage(low, high, trials, share) for share in shares]
    theirs = [coverage(their_low, their_high, trials, share) for share in shares]
    assert min(ours) >= 0.95
    assert min(theirs) < 0.94  # the reason for ours
    # and not safe by being useless
    assert (high - low).mean() < 1.2 * (their_high - their_low).mean()


@pytest.mark.parametrize(("num_queries", "true_recall"), [(98, 0.99), (191, 0.77), (40, 0.5)])
def test_recall_rows_cover_the_true_recall(num_queries: int, true_recall: float) -> None:
    # a method that meets the threshold with a known probability, evaluated again and again
    rng = np.random.default_rng(5)
    names = tuple(f"{i}.jpg" for i in range(num_queries))
    num_runs = 1500
    held = 0
    for _ in range(num_runs):
        met = rng.random(num_queries) < true_recall
        position_m = np.where(met, 0.2, np.where(rng.random(num_queries) < 0.5, 3.0, np.inf))
        angle_deg = np.where(np.isfinite(position_m), 1.0, np.inf)
        (at,) = recall_row("x", PoseErrors(names, position_m, angle_deg), [QUARTER]).recall
        held += at.low <= true_recall <= at.high
    # three standard deviations of the simulation below nominal
    assert held / num_runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / num_runs)
    assert held < num_runs


def test_of_another_level() -> None:
    theirs = stats.binomtest(7, 20).proportion_ci(0.8, method="exact")
    low, high = confidence_interval([7, 20], [20, 20], level=0.8)
    assert (low[0], high[0]) == pytest.approx((theirs.low, theirs.high))
    assert high[1] == 1.0
