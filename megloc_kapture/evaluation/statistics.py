"""Several results on the same queries: paired tests between them, mean and spread over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import ALL, LEVEL, Threshold, within
from megloc_kapture.evaluation.scoring import Evaluation, Reported, query_columns

SIGNIFICANCE = 0.05
DIFFERENCES_COLUMNS = (
    "position_m",
    "angle_deg",
    "found_by",
    "missed_by",
    "image",
    "condition",
    "found_position_error_m",
    "found_angle_error_deg",
    "missed_position_error_m",
    "missed_angle_error_deg",
)
NUM_RESAMPLES = 2000
# of four queries the interval holds the true difference in 88 % of cases, of six in 95 %
# (400 simulated results each); the sign test needs six as well to call anything real
MIN_RESAMPLED = 6
# numbers held at a time while resampling
_CHUNK = 4_000_000


@dataclass(frozen=True, slots=True)
class PairedTest:
    """One threshold, one group of queries, two results.

    Parameters
    ----------
    first, second : positions of the two results in the list that was compared.
    row : the condition or pool, or ``"all"``.
    only_first, only_second : queries within the threshold in one of the results only; sorted.
    both, neither : numbers of the other queries of the group.
    p_value : of the exact McNemar test, two-sided: how often chance alone, at equal methods,
        splits the differing queries at least as unevenly.
    p_adjusted : the same after Holm's correction for all tests of its family.
    """

    first: int
    second: int
    row: str
    threshold: Threshold
    both: int
    neither: int
    only_first: tuple[str, ...]
    only_second: tuple[str, ...]
    p_value: float
    p_adjusted: float

    @property
    def is_real(self) -> bool:
        """True where chance is an unlikely explanation, at 5 %."""
        return self.p_adjusted <= SIGNIFICANCE


@dataclass(frozen=True, slots=True)
class MedianDifference:
    """Difference of the median position errors of two results, over all queries.

    Parameters
    ----------
    first, second : positions of the two results in the list that was compared.
    first_m, second_m : the medians in metres, infinite where most queries have no pose.
    low_m, high_m : 95 % interval of ``first_m - second_m``, from resampling the queries; NaN of
        fewer than six, which are too few to say.
    """

    first: int
    second: int
    first_m: float
    second_m: float
    low_m: float
    high_m: float

    @property
    def is_real(self) -> bool:
        """True where the interval leaves out "no difference"."""
        return self.low_m > 0.0 or self.high_m < 0.0


@dataclass(frozen=True, eq=False, slots=True)
class SeveralResults(Reported):
    """Results on the same queries, in the order they were given."""

    evaluations: tuple[Evaluation, ...]

    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query; those of a result are called ``label: column``."""
        columns: dict[str, list[Any]] = {}
        for evaluation in self.evaluations:
            for name, values in query_columns(evaluation.queries).items():
                shared = name in ("image", "condition")
                columns.setdefault(name if shared else f"{evaluation.label}: {name}", values)
        return columns


@dataclass(frozen=True, eq=False, slots=True)
class Comparison(SeveralResults):
    """Results on the same queries, compared two by two.

    Parameters
    ----------
    tests : of all queries together, by pair of results and threshold; one family for Holm.
    tests_by_row : of the conditions and pools; another family.
    medians : one per pair of results.
    """

    tests: tuple[PairedTest, ...]
    tests_by_row: tuple[PairedTest, ...]
    medians: tuple[MedianDifference, ...]

    def differences(self) -> dict[str, list[Any]]:
        """Column -> values, of every query that one result alone finds, by pair and threshold."""
        index = {name: i for i, name in enumerate(self.evaluations[0].errors.names)}
        columns: dict[str, list[Any]] = {name: [] for name in DIFFERENCES_COLUMNS}
        for test in self.tests:
            bounds = test.threshold.position_m, test.threshold.angle_deg
            first, second = self.evaluations[test.first], self.evaluations[test.second]
            alone = [(first, second, name) for name in test.only_first]
            alone += [(second, first, name) for name in test.only_second]
            for finder, other, name in alone:
                found, missed = finder.queries[index[name]], other.queries[index[name]]
                named = finder.label, other.label, name, found.condition
                errors = found.position_m, found.angle_deg, missed.position_m, missed.angle_deg
                for column, value in zip(columns.values(), (*bounds, *named, *errors), strict=True):
                    column.append(value)
        return columns


def compare(evaluations: Sequence[Evaluation]) -> Comparison:
    """Compare at least two results on the same queries, thresholds and conditions; OptionError: see
    :func:`check_comparable`."""
    check_comparable(evaluations)
    pairs = list(combinations(range(len(evaluations)), 2))
    rows = [name for name in evaluations[0].members if name != ALL]
    return Comparison(
        evaluations=tuple(evaluations),
        tests=_family(evaluations, pairs, [ALL]),
        tests_by_row=_family(evaluations, pairs, rows),
        medians=_median_differences(evaluations, pairs),
    )


def check_comparable(evaluations: Sequence[Evaluation]) -> None:
    """Raise OptionError for results that do not belong beside each other: fewer than two, two with
    one label, or not of the same queries, thresholds and conditions."""
    if len(evaluations) < 2:
        raise OptionError("at least two results are needed to compare")
    first = evaluations[0]
    labels = [evaluation.label for evaluation in evaluations]
    if len(set(labels)) != len(labels):
        raise OptionError(f"two results are called {max(labels, key=labels.count)!r}")
    for other in evaluations[1:]:
        if other.thresholds != first.thresholds:
            raise OptionError(f"{first.label} and {other.label} have different thresholds")
        if other.errors.names != first.errors.names:
            raise OptionError(f"{first.label} and {other.label} count different queries")
        if [q.condition for q in other.queries] != [q.condition for q in first.queries]:
            raise OptionError(f"{first.label} and {other.label} have different conditions")


def mcnemar(only_first: ArrayLike, only_second: ArrayLike) -> NDArray[np.float64]:
    """Two-sided p-values of the exact McNemar test, of numbers (...) of queries that one of two
    results alone finds.

    Queries that both or neither find say nothing about a difference; of the others each falls to
    either side with probability one half when the methods are equally good.
    """
    from scipy.special import bdtr

    b, c = np.broadcast_arrays(np.asarray(only_first), np.asarray(only_second))
    fewer = np.minimum(b, c).astype(np.float64)
    return np.asarray(np.minimum(2.0 * bdtr(fewer, b + c, 0.5), 1.0), dtype=np.float64)


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values (N,) adjusted by Holm: the chance of even one false alarm among N stays as said."""
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted


def resampled_medians(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Medians (2000,) of values (N,) drawn again with replacement; values may be infinite.

    The same N draws the same positions, so that results on the same queries stay paired.
    """
    rng = np.random.default_rng(0)
    size = len(values)
    step = max(_CHUNK // max(size, 1), 1)
    medians = np.empty(NUM_RESAMPLES)
    for start in range(0, NUM_RESAMPLES, step):
        count = min(step, NUM_RESAMPLES - start)
        drawn = values[rng.integers(size, size=(count, size))]
        medians[start : start + count] = _medians(drawn)
    return medians


def difference_interval(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[float, float]:
    """The middle 95 % of ``first - second``, paired medians of :func:`resampled_medians`; the
    difference of infinities is zero."""
    with np.errstate(invalid="ignore"):
        apart = first - second
    apart = np.where(np.isnan(apart), 0.0, apart)
    # of the values themselves: to interpolate between infinities gives NaN
    tail = (1.0 - LEVEL) / 2.0
    low = np.quantile(apart, tail, method="lower")
    high = np.quantile(apart, 1.0 - tail, method="higher")
    return float(low), float(high)


def _medians(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Medians (R,) of rows (R, N) that may hold infinities; reorders the rows."""
    size = values.shape[1]
    lower, upper = (size - 1) // 2, size // 2
    values.partition((lower, upper), axis=1)
    return 0.5 * (values[:, lower] + values[:, upper])


def _family(
    evaluations: Sequence[Evaluation], pairs: Sequence[tuple[int, int]], rows: Sequence[str]
) -> tuple[PairedTest, ...]:
    names = np.array(evaluations[0].errors.names, dtype=object)
    thresholds, members = evaluations[0].thresholds, evaluations[0].members
    met = [[within(e.errors, threshold) for threshold in thresholds] for e in evaluations]
    keys = list(product(pairs, rows, range(len(thresholds))))
    tables = []
    for (i, j), row, index in keys:
        a, b, chosen = met[i][index], met[j][index], members[row]
        tables.append((a & ~b & chosen, b & ~a & chosen, a & b & chosen, ~a & ~b & chosen))
    p_values = mcnemar(*([int(table[side].sum()) for table in tables] for side in (0, 1)))
    return tuple(
        PairedTest(
            first=pair[0],
            second=pair[1],
            row=row,
            threshold=thresholds[index],
            only_first=tuple(names[only_first].tolist()),
            only_second=tuple(names[only_second].tolist()),
            both=int(both.sum()),
            neither=int(neither.sum()),
            p_value=float(p),
            p_adjusted=float(adjusted),
        )
        for (pair, row, index), (only_first, only_second, both, neither), p, adjusted in zip(
            keys, tables, p_values, holm(p_values), strict=True
        )
    )


def _median_differences(
    evaluations: Sequence[Evaluation], pairs: Sequence[tuple[int, int]]
) -> tuple[MedianDifference, ...]:
    medians = [evaluation.row().median_position_m for evaluation in evaluations]
    few = len(evaluations[0].queries) < MIN_RESAMPLED
    resampled = [] if few else [resampled_medians(e.errors.position_m) for e in evaluations]
    found = []
    for i, j in pairs:
        unknown = float("nan"), float("nan")
        interval = unknown if few else difference_interval(resampled[i], resampled[j])
        found.append(MedianDifference(i, j, medians[i], medians[j], *interval))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Spread:
    """One figure over the runs.

    Parameters
    ----------
    mean, smallest, largest : over the runs.
    deviation : standard deviation of a run (N - 1 in the denominator).
    """

    mean: float
    deviation: float
    smallest: float
    largest: float


@dataclass(frozen=True, slots=True)
class SeedsAt:
    """Recall at one threshold over the runs.

    Parameters
    ----------
    mean, deviation, smallest, largest : of recall, as in :class:`Spread`.
    found_always, found_sometimes, found_never : queries within the threshold in all, some or none
        of the runs.
    """

    threshold: Threshold
    mean: float
    deviation: float
    smallest: float
    largest: float
    found_always: int
    found_sometimes: int
    found_never: int


@dataclass(frozen=True, slots=True)
class SeedsRow:
    """One condition, pool or ``"all"`` over the runs.

    Parameters
    ----------
    num_queries : the same in every run.
    num_localized : queries whose pose was estimated.
    median_position_m : of all queries, by run; a run where most lack a pose makes it infinite.
    """

    name: str
    num_queries: int
    num_localized: Spread
    recall: tuple[SeedsAt, ...]
    median_position_m: Spread


@dataclass(frozen=True, eq=False, slots=True)
class Seeds(SeveralResults):
    """Runs of one method and what they have in common; ``rows`` as those of each run."""

    rows: tuple[SeedsRow, ...]


def over_seeds(evaluations: Sequence[Evaluation]) -> Seeds:
    """Mean and spread of at least two runs of one method; OptionError: see
    :func:`check_comparable`."""
    check_comparable(evaluations)
    first = evaluations[0]
    # runs, thresholds, queries
    met = np.stack([[within(e.errors, t) for t in first.thresholds] for e in evaluations])
    rows = []
    for position, (name, chosen) in enumerate(first.members.items()):
        of_runs = [evaluation.rows[position] for evaluation in evaluations]
        recall = []
        for index, threshold in enumerate(first.thresholds):
            always = met[:, index, chosen].all(axis=0)
            ever = met[:, index, chosen].any(axis=0)
            spread = _spread([row.recall[index].recall for row in of_runs])
            counts = (int(own.sum()) for own in (always, ever & ~always, ~ever))
            recall.append(SeedsAt(threshold, *astuple(spread), *counts))
        rows.append(
            SeedsRow(
                name=name,
                num_queries=int(chosen.sum()),
                num_localized=_spread([float(row.num_localized) for row in of_runs]),
                recall=tuple(recall),
                median_position_m=_spread([row.median_position_m for row in of_runs]),
            )
        )
    return Seeds(tuple(evaluations), tuple(rows))


def _spread(values: Sequence[float]) -> Spread:
    numbers = np.array(values, dtype=np.float64)
    finite = bool(np.isfinite(numbers).all())
    return Spread(
        mean=float(numbers.mean()),
        deviation=float(numbers.std(ddof=1)) if finite else float("inf"),
        smallest=float(numbers.min()),
        largest=float(numbers.max()),
    )
