"""What is known of results whose true poses nobody publishes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.metrics import (
    DEFAULT_THRESHOLDS,
    PoseErrors,
    RecallAt,
    Threshold,
    pose_errors,
    recall_row,
    row_members,
)
from megloc_kapture.evaluation.results import Poses, Result, ResultContext
from megloc_kapture.evaluation.scoring import QueryResult, Reported, query_columns, query_result

CAUTION = "None of these figures is accuracy: results that share a mistake agree."


@dataclass(frozen=True, slots=True)
class RowWithoutTruth:
    """One condition, pool or ``"all"`` of one result.

    ``inliers_quartiles`` are 25, 50 and 75 % over the localized queries; None if unknown.
    """

    name: str
    num_queries: int
    num_localized: int
    num_fallback: int
    num_missing: int
    inliers_quartiles: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False, slots=True)
class ResultWithoutTruth:
    """One result: rows, and queries whose errors are NaN."""

    label: str
    rows: tuple[RowWithoutTruth, ...]
    queries: tuple[QueryResult, ...]
    poses: Poses
    context: ResultContext = field(default_factory=ResultContext)


@dataclass(frozen=True, slots=True)
class AgreementRow:
    """Two results in one condition, pool or ``"all"``.

    Parameters
    ----------
    first, second : positions of the results in the list.
    num_both, num_only_first, num_only_second : queries with a pose in both or one of them.
    within : per threshold the queries whose two poses differ by no more, as a share of all
        queries, with its confidence interval.
    median_m, median_deg : of the differences where both have a pose; infinite where none has.
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
    """Results without truth.

    Parameters
    ----------
    statement : who knows the true poses.
    thresholds : of the agreement between results.
    agreement : per pair of results, per row; empty for one result.
    apart : per pair of results the differences of their poses; infinite where one has none.
    """

    statement: str
    thresholds: tuple[Threshold, ...]
    results: tuple[ResultWithoutTruth, ...]
    agreement: tuple[AgreementRow, ...]
    apart: tuple[PoseErrors, ...]

    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query; of several results they are called ``label: column``,
        followed by the differences of their poses."""
        columns: dict[str, list[Any]] = {}
        for result in self.results:
            before = f"{result.label}: " if self.results[1:] else ""
            for name, values in query_columns(result.queries).items():
                if name in ("image", "condition"):
                    columns[name] = values
                elif "error" not in name:
                    columns[before + name] = values
        labels = [result.label for result in self.results]
        for (first, second), apart in zip(combinations(labels, 2), self.apart, strict=True):
            columns[f"{first} to {second}: position_m"] = apart.position_m.tolist()
            columns[f"{first} to {second}: angle_deg"] = apart.angle_deg.tolist()
        return columns


def evaluate_without_truth(
    results: Sequence[Result],
    *,
    queries: Sequence[str] | None = None,
    conditions: Mapping[str, str] | None = None,
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
    condition_order: Sequence[str] = (),
    pools: Mapping[str, Sequence[str]] | None = None,
    statement: str = "",
) -> WithoutTruth:
    """Count localized queries and inliers, and compare results with each other, in one frame.

    Parameters
    ----------
    queries : every query that counts; by default all that any of the results is about.
    conditions, condition_order, pools : as in
        :func:`megloc_kapture.evaluation.scoring.evaluate_poses`.
    thresholds : of the agreement between two results.
    statement : who knows the true poses; empty: they were not given.
    """
    labels = [result.label for result in results]
    if not results or len(set(labels)) != len(labels):
        raise OptionError("results need different labels, and at least one is needed")
    images = sorted({i for r in results for i in r.images} if queries is None else set(queries))
    if not images:
        raise DataError("no query: the results name no image")
    of_image = conditions or {}
    members = row_members(
        [of_image.get(image, "") for image in images], order=condition_order, pools=pools
    )
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
        statement=statement or "No true poses were given.",
        thresholds=tuple(thresholds),
        results=tuple(_result(result, images, of_image, members) for result in results),
        agreement=tuple(agreement),
        apart=tuple(apart),
    )


def _result(
    result: Result,
    images: Sequence[str],
    conditions: Mapping[str, str],
    members: Mapping[str, NDArray[np.bool_]],
) -> ResultWithoutTruth:
    queries = tuple(
        query_result(
            image,
            conditions.get(image, ""),
            (result.statuses or {}).get(image),
            has_pose=image in result.poses,
            errors=(math.nan, math.nan),
            confidence=result.confidences.get(image),
        )
        for image in images
    )
    rows = tuple(_row(name, list(compress(queries, chosen))) for name, chosen in members.items())
    return ResultWithoutTruth(result.label, rows, queries, result.poses, result.context)


def _row(name: str, queries: Sequence[QueryResult]) -> RowWithoutTruth:
    localized = [query for query in queries if query.outcome == "localized"]
    inliers = [query.num_inliers for query in localized if query.num_inliers is not None]
    quartiles = None
    if inliers:
        low, middle, high = np.quantile(inliers, (0.25, 0.5, 0.75)).tolist()
        quartiles = (low, middle, high)
    return RowWithoutTruth(
        name=name,
        num_queries=len(queries),
        num_localized=len(localized),
        num_fallback=sum(query.outcome == "fallback" for query in queries),
        num_missing=sum(query.outcome == "missing" for query in queries),
        inliers_quartiles=quartiles,
    )
