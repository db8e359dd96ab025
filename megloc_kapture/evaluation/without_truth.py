"""Evaluation of results without true poses: counts, inliers, and agreement of results."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.metrics import (
    PoseErrors,
    RecallAt,
    Threshold,
    pose_errors,
    recall_row,
    row_members,
)
from megloc_kapture.evaluation.protocols import Benchmark
from megloc_kapture.evaluation.results import Result
from megloc_kapture.evaluation.scoring import (
    Evaluation,
    Reported,
    query_result,
    recall_rows,
)

CAUTION = "None of these figures is accuracy: results that share a mistake agree."


Quartiles = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class AgreementRow:
    """Agreement of the results at positions ``first`` and ``second`` in one row of the table.

    ``within`` counts queries whose two poses differ by no more than a threshold, as a share of all
    queries; the medians of the differences are over queries with a pose in both.
    """

    first: int
    second: int
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

    ``statement`` names the owner of the true poses; ``thresholds`` and ``agreement`` are for each
    pair of results, as is ``apart``: the differences of their poses, infinite if one is missing.
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
    benchmark: Benchmark = Benchmark(),  # noqa: B008
    *,
    queries: Collection[str] | None = None,
    thresholds: Sequence[Threshold] | None = None,
) -> WithoutTruth:
    """Count localized queries, and compare results in one frame with each other.

    ``queries`` are by default all that any result names; ``thresholds`` limit the differences of
    two results.
    """
    labels = [result.label for result in results]
    if not results or len(set(labels)) != len(labels):
        raise OptionError("results need different labels, and at least one is needed")
    images = sorted({i for r in results for i in r.images} if queries is None else set(queries))
    if not images:
        raise DataError("no query: the results name no image")
    conditions = benchmark.conditions(images)
    members = row_members([conditions.get(image, "") for image in images], benchmark.protocol)
    thresholds = tuple(thresholds or benchmark.thresholds())
    agreement, apart = list[AgreementRow](), []
    for i, j in combinations(range(len(results)), 2):
        first, second = results[i].poses, results[j].poses
        shared = {image: first[image] for image in images if image in first and image in second}
        errors = pose_errors(shared, second, images)
        apart.append(errors)
        has_pose = [np.array([image in poses for image in images]) for poses in (first, second)]
        for name, chosen in members.items():
            row = recall_row(name, errors, thresholds, members=chosen)
            agreement.append(
                AgreementRow(
                    first=i,
                    second=j,
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
    # rows count poses; without thresholds nothing depends on the errors
    errors = pose_errors(result.poses, result.poses, images)
    return Evaluation(
        label=result.label,
        thresholds=(),
        rows=recall_rows(queries, errors, (), members),
        members=members,
        queries=queries,
        errors=errors,
        truth={},
        estimated=result.poses,
        without_truth=(),
        not_scored=(),
        context=result.context,
    )


def inliers_quartiles(evaluation: Evaluation, row: str) -> Quartiles | None:
    """Return 25, 50 and 75 % of the inliers of localized queries; None if unknown."""
    inliers = [
        query.num_inliers
        for query in compress(evaluation.queries, evaluation.members[row])
        if query.outcome == "localized" and query.num_inliers is not None
    ]
    if not inliers:
        return None
    low, middle, high = np.quantile(inliers, (0.25, 0.5, 0.75)).tolist()
    return low, middle, high
