"""Comparison of results on the same queries: paired tests, or agreement without true poses."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, compress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from megloc_kapture.errors import OptionError, check_option, require
from megloc_kapture.evaluation.metrics import (
    LEVEL,
    PoseErrors,
    RecallAt,
    Threshold,
    pose_errors,
    recall_row,
    row_members,
    thresholds_from_pairs,
    within,
)
from megloc_kapture.evaluation.results import Result
from megloc_kapture.evaluation.scoring import Evaluation, Reported, query_result, recall_rows
from megloc_kapture.io.dataset_tables import NO_TABLES, SideTables

SIGNIFICANCE = 0.05
NUM_RESAMPLES, _CHUNK = 2000, 250
# with four queries the interval covers the true difference in 88 % of simulations, with six in 95 %
MIN_RESAMPLED = 6


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Exact McNemar test of two results at one threshold.

    ``first`` and ``second`` are labels. ``only_first`` and ``only_second`` are the queries within
    the threshold in one result only; ``both`` and ``neither`` count the other queries.
    ``p_adjusted`` is the p-value after Holm's correction for all tests of the comparison.
    """

    first: str
    second: str
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
    """Median position errors of two results; infinite if half or more queries have no pose.

    ``first`` and ``second`` are labels. ``low_m`` to ``high_m`` is the 95 % bootstrap interval of
    ``first_m - second_m``, NaN for fewer than six queries.
    """

    first: str
    second: str
    first_m: float
    second_m: float
    low_m: float
    high_m: float

    @property
    def is_real(self) -> bool:
        return self.low_m > 0.0 or self.high_m < 0.0


@dataclass(frozen=True, eq=False, slots=True)
class Comparison(Reported):
    """Results on the same queries, compared pairwise."""

    evaluations: tuple[Evaluation, ...]
    tests: tuple[PairedTest, ...]
    medians: tuple[MedianDifference, ...]


def compare(evaluations: Sequence[Evaluation]) -> Comparison:
    """Compare at least two results on the same queries, thresholds and conditions."""
    _check_comparable(evaluations)
    tests, medians = list[PairedTest](), []
    resampled = {e.label: _resampled_medians(e.errors.position_m) for e in evaluations}
    for first, second in combinations(evaluations, 2):
        pair = first.label, second.label
        tests += [_paired_test(first, second, threshold) for threshold in first.thresholds]
        medians_m = first.row().median_position_m, second.row().median_position_m
        interval_m = float("nan"), float("nan")
        if len(first.queries) >= MIN_RESAMPLED:
            interval_m = difference_interval(*(resampled[label] for label in pair))
        medians.append(MedianDifference(*pair, *medians_m, *interval_m))
    adjusted = holm([test.p_value for test in tests]).tolist()
    corrected = (replace(t, p_adjusted=p) for t, p in zip(tests, adjusted, strict=True))
    return Comparison(tuple(evaluations), tuple(corrected), tuple(medians))


def _paired_test(first: Evaluation, second: Evaluation, threshold: Threshold) -> PairedTest:
    """Return the test at a threshold, without the correction for the number of tests."""
    a, b = within(first.errors, threshold), within(second.errors, threshold)
    names = np.array(first.errors.names, dtype=object)
    only_first, only_second = names[a & ~b].tolist(), names[b & ~a].tolist()
    p_value = mcnemar(len(only_first), len(only_second))
    return PairedTest(
        first=first.label,
        second=second.label,
        threshold=threshold,
        both=int((a & b).sum()),
        neither=int((~a & ~b).sum()),
        only_first=tuple(only_first),
        only_second=tuple(only_second),
        p_value=p_value,
        p_adjusted=p_value,
    )


def _check_comparable(evaluations: Sequence[Evaluation]) -> None:
    check_option(len(evaluations) >= 2, "at least two results are needed to compare")
    first = evaluations[0]
    labels = [evaluation.label for evaluation in evaluations]
    if len(set(labels)) != len(labels):
        name = max(labels, key=labels.count)
        raise OptionError(f"two results are called {name!r}; give each a label")
    for other in evaluations[1:]:
        both = f"{first.label} and {other.label} have different"
        check_option(first.thresholds == other.thresholds, f"{both} thresholds")
        check_option(first.errors.names == other.errors.names, f"{both} queries")
        ours = [query.condition for query in first.queries]
        theirs = [query.condition for query in other.queries]
        check_option(ours == theirs, f"{both} conditions")


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the two-sided p-value of the exact McNemar test.

    Null hypothesis: a query that only one method localizes is equally likely to be localized by
    either.
    """
    from scipy.special import bdtr

    fewer, number = min(only_first, only_second), only_first + only_second
    return min(2.0 * float(bdtr(float(fewer), number, 0.5)), 1.0)


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Adjust p-values (N,) by Holm's method, which bounds the chance of any false positive."""
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted


def _resampled_medians(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return medians (2000,) of bootstrap samples of values (N,), which may be infinite.

    The draws depend on N only, so medians of results on the same queries are paired.
    """
    rng, size = np.random.default_rng(0), (_CHUNK, len(values))
    chunks = (values[rng.integers(len(values), size=size)] for _ in range(NUM_RESAMPLES // _CHUNK))
    return np.concatenate([np.median(drawn, axis=1) for drawn in chunks])


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


CAUTION = "These figures do not measure accuracy: results that share a mistake agree."


@dataclass(frozen=True, slots=True)
class AgreementRow:
    """Agreement of two results in one row of the table.

    ``first`` and ``second`` are labels. ``within`` has, per threshold, the share of all queries
    whose two poses differ by at most the threshold. ``median_m`` and ``median_deg`` are medians of
    the pose differences over the queries with a pose in both results.
    """

    first: str
    second: str
    name: str
    num_queries: int
    num_both: int
    num_only_first: int
    num_only_second: int
    within: tuple[RecallAt, ...]
    median_m: float
    median_deg: float


@dataclass(frozen=True, eq=False, slots=True)
class WithoutTruth(Reported):
    """Results without true poses.

    ``statement`` explains why there are no true poses. ``agreement`` has one row per pair of
    results and condition. ``apart`` has the pose differences of each pair of results, infinite if
    one of the poses is missing.
    """

    statement: str
    thresholds: tuple[Threshold, ...]
    evaluations: tuple[Evaluation, ...]
    agreement: tuple[AgreementRow, ...]
    apart: tuple[PoseErrors, ...]

    def per_query(self) -> dict[str, list[Any]]:
        columns = Reported.per_query(self)
        labels = [result.label for result in self.evaluations]
        for (first, second), apart in zip(combinations(labels, 2), self.apart, strict=True):
            columns[f"{first} to {second}: position_m"] = apart.position_m.tolist()
            columns[f"{first} to {second}: angle_deg"] = apart.angle_deg.tolist()
        return columns


def evaluate_without_truth(
    results: Sequence[Result],
    benchmark: SideTables = NO_TABLES,
    *,
    queries: Collection[str] | None = None,
) -> WithoutTruth:
    """Count localized queries, and compare the results. All poses must be in one coordinate frame.

    By default, ``queries`` are all images of the results. The benchmark's thresholds apply to the
    pose differences of two results.
    """
    labels = [result.label for result in results]
    if not results or len(set(labels)) != len(labels):
        raise OptionError("at least one result is needed, and labels must differ")
    images = sorted({i for r in results for i in r.images} if queries is None else set(queries))
    require(images, "there are no queries: the results contain no images")
    conditions = benchmark.conditions(images)
    members = row_members([conditions.get(image, "") for image in images], benchmark.protocol)
    thresholds = thresholds_from_pairs(benchmark.protocol.thresholds)
    agreement, apart = list[AgreementRow](), []
    for pair in combinations(results, 2):
        first, second = (result.poses for result in pair)
        shared = {image: first[image] for image in images if image in first and image in second}
        errors = pose_errors(shared, second, images)
        apart.append(errors)
        has_pose = [np.array([image in poses for image in images]) for poses in (first, second)]
        for name, chosen in members.items():
            row = recall_row(name, errors, thresholds, members=chosen)
            agreement.append(
                AgreementRow(
                    first=pair[0].label,
                    second=pair[1].label,
                    name=name,
                    num_queries=row.num_queries,
                    num_both=int((has_pose[0] & has_pose[1] & chosen).sum()),
                    num_only_first=int((has_pose[0] & ~has_pose[1] & chosen).sum()),
                    num_only_second=int((has_pose[1] & ~has_pose[0] & chosen).sum()),
                    within=row.recall,
                    median_m=row.median_localized_position_m,
                    median_deg=row.median_localized_angle_deg,
                )
            )
    return WithoutTruth(
        statement=benchmark.protocol.truth or "No true poses were given.",
        thresholds=thresholds,
        evaluations=tuple(_counted(result, images, conditions, members) for result in results),
        agreement=tuple(agreement),
        apart=tuple(apart),
    )


def _counted(
    result: Result,
    images: Sequence[str],
    conditions: Mapping[str, str],
    members: Mapping[str, NDArray[np.bool_]],
) -> Evaluation:
    queries = tuple(query_result(result, i, conditions, (math.nan, math.nan)) for i in images)
    # the result is compared with itself: rows only count its poses, thresholds are empty
    errors = pose_errors(result.poses, result.poses, images)
    return Evaluation(
        label=result.label,
        thresholds=(),
        rows=recall_rows(queries, errors, (), members),
        members=members,
        queries=queries,
        without_truth=(),
        not_scored=(),
        context=result.context,
    )


def inliers_quartiles(evaluation: Evaluation, row: str) -> tuple[float, float, float] | None:
    """Return the quartiles of the inlier counts of localized queries; None if unknown."""
    inliers = [
        query.num_inliers
        for query in compress(evaluation.queries, evaluation.members[row])
        if query.outcome == "localized" and query.num_inliers is not None
    ]
    if not inliers:
        return None
    low, middle, high = np.quantile(inliers, (0.25, 0.5, 0.75)).tolist()
    return low, middle, high
