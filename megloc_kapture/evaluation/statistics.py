"""Paired comparison of results on the same queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import LEVEL, Threshold, within
from megloc_kapture.evaluation.scoring import Evaluation, Reported

SIGNIFICANCE = 0.05
NUM_RESAMPLES, _CHUNK = 2000, 250
# with four queries the interval covers the true difference in 88 % of simulations, with six in 95 %
MIN_RESAMPLED = 6


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Exact McNemar test of two results, by position, at one threshold.

    ``only_first`` and ``only_second`` are the queries within the threshold in one result only;
    ``both`` and ``neither`` count the others. ``p_adjusted`` has Holm's correction for all tests of
    the comparison.
    """

    first: int
    second: int
    threshold: Threshold
    both: int
    neither: int
    only_first: tuple[str, ...]
    only_second: tuple[str, ...]
    p_value: float
    p_adjusted: float

    @property
    def is_real(self) -> bool:
        return self.p_adjusted <= SIGNIFICANCE


@dataclass(frozen=True, slots=True)
class MedianDifference:
    """Median position errors of two results, by position; infinite if most queries have no pose.

    ``low_m`` to ``high_m`` is the 95 % interval of ``first_m - second_m`` from resampling the
    queries; NaN for fewer than six.
    """

    first: int
    second: int
    first_m: float
    second_m: float
    low_m: float
    high_m: float

    @property
    def is_real(self) -> bool:
        return self.low_m > 0.0 or self.high_m < 0.0


@dataclass(frozen=True, eq=False, slots=True)
class Comparison(Reported):
    """Results on the same queries, compared two by two."""

    evaluations: tuple[Evaluation, ...]
    tests: tuple[PairedTest, ...]
    medians: tuple[MedianDifference, ...]


def compare(evaluations: Sequence[Evaluation]) -> Comparison:
    """Compare at least two results on the same queries, thresholds and conditions."""
    _check_comparable(evaluations)
    names = np.array(evaluations[0].errors.names, dtype=object)
    tables, medians = [], []
    resampled = [_resampled_medians(e.errors.position_m) for e in evaluations]
    for i, j in combinations(range(len(evaluations)), 2):
        for threshold in evaluations[0].thresholds:
            a, b = (within(evaluations[k].errors, threshold) for k in (i, j))
            tables.append((i, j, threshold, a, b))
        first_m, second_m = (evaluations[k].row().median_position_m for k in (i, j))
        interval_m = float("nan"), float("nan")
        if len(names) >= MIN_RESAMPLED:
            interval_m = difference_interval(resampled[i], resampled[j])
        medians.append(MedianDifference(i, j, first_m, second_m, *interval_m))
    p_values = [mcnemar(int((a & ~b).sum()), int((b & ~a).sum())) for *_, a, b in tables]
    tests = tuple(
        PairedTest(
            first=i,
            second=j,
            threshold=threshold,
            only_first=tuple(names[a & ~b].tolist()),
            only_second=tuple(names[b & ~a].tolist()),
            both=int((a & b).sum()),
            neither=int((~a & ~b).sum()),
            p_value=p_value,
            p_adjusted=adjusted,
        )
        for (i, j, threshold, a, b), p_value, adjusted in zip(
            tables, p_values, holm(p_values).tolist(), strict=True
        )
    )
    return Comparison(tuple(evaluations), tests, tuple(medians))


def _check_comparable(evaluations: Sequence[Evaluation]) -> None:
    if len(evaluations) < 2:
        raise OptionError("at least two results are needed to compare")
    first = evaluations[0]
    labels = [evaluation.label for evaluation in evaluations]
    if len(set(labels)) != len(labels):
        raise OptionError(f"two results are called {max(labels, key=labels.count)!r}")
    for other in evaluations[1:]:
        for kind, ours, theirs in (
            ("thresholds", first.thresholds, other.thresholds),
            ("queries", first.errors.names, other.errors.names),
            (
                "conditions",
                [query.condition for query in first.queries],
                [query.condition for query in other.queries],
            ),
        ):
            if ours != theirs:
                raise OptionError(f"{first.label} and {other.label} have different {kind}")


def mcnemar(only_first: int, only_second: int) -> float:
    """Two-sided p-value of the exact McNemar test.

    Among queries that only one method finds, either method is as likely if both are equally good.
    """
    from scipy.special import bdtr

    fewer, number = min(only_first, only_second), only_first + only_second
    return min(2.0 * float(bdtr(float(fewer), number, 0.5)), 1.0)


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Adjust p-values (N,) by Holm's method for the chance of any false alarm among N tests."""
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted


def _resampled_medians(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return medians (2000,) of resampled values (N,), which may be infinite.

    The same N draws the same positions, so results on the same queries stay paired.
    """
    rng = np.random.default_rng(0)
    medians = list[NDArray[np.float64]]()
    for _ in range(NUM_RESAMPLES // _CHUNK):
        drawn = values[rng.integers(len(values), size=(_CHUNK, len(values)))]
        # twice as fast as np.median
        middle = (len(values) - 1) // 2, len(values) // 2
        drawn.partition(middle, axis=1)
        medians.append(0.5 * (drawn[:, middle[0]] + drawn[:, middle[1]]))
    return np.concatenate(medians)


def difference_interval(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the middle 95 % of the differences of paired medians; inf - inf counts as zero."""
    with np.errstate(invalid="ignore"):
        difference = first - second
    difference[np.isnan(difference)] = 0.0
    # interpolation between infinities would give NaN
    tail = (1.0 - LEVEL) / 2.0
    low = np.quantile(difference, tail, method="lower")
    high = np.quantile(difference, 1.0 - tail, method="higher")
    return float(low), float(high)
