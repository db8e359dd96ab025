"""Figures of results whose true poses nobody publishes."""

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
from megloc_kapture.evaluation.results import Poses, Result, ResultContext, are_ranked
from megloc_kapture.evaluation.scoring import QueryResult, Reported, query_result
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.tables import QueryStatus
from megloc_kapture.values import RigidTransform

CAUTION = (
    "None of these figures is accuracy: retrieval may look in the wrong place, and results that "
    "share a mistake agree."
)
PRIOR_DISTANCES_M = (5.0, 10.0, 25.0)
PRIOR_ANGLE_DEG = 45.0
_QUERY_COLUMNS = ("outcome", "num_matches", "num_inliers")
_CANDIDATE_COLUMNS = {
    "first_candidate_m": "first_m",
    "first_candidate_deg": "first_deg",
    "nearest_candidate": "nearest",
    "nearest_candidate_m": "nearest_m",
    "nearest_candidate_deg": "nearest_deg",
}
_QUARTILES = (0.25, 0.5, 0.75)


@dataclass(frozen=True, slots=True)
class NearCandidates:
    """Distances of a pose from the map images it was estimated from.

    Parameters
    ----------
    first_m, first_deg : distance to the first candidate's camera centre, and the angle between
        the two viewing directions; NaN where nobody ranked the candidates.
    nearest : the candidate whose centre is nearest.
    nearest_m, nearest_deg : the same for it.
    """

    first_m: float
    first_deg: float
    nearest: str
    nearest_m: float
    nearest_deg: float


@dataclass(frozen=True, slots=True)
class WithinDistance:
    """Queries within a distance of their candidate, and their share of those compared."""

    distance_m: float
    num_within: int
    share: float


@dataclass(frozen=True, slots=True)
class PriorAgreement:
    """Agreement of a group's localized poses with one of their candidates.

    Parameters
    ----------
    num_compared : localized queries with a candidate that has a pose in the map.
    within : how many of these lie within 5, 10 and 25 m.
    num_same_direction : how many look within 45 degrees of the candidate's direction.
    median_m, median_deg : of the distances and angles.
    """

    num_compared: int
    within: tuple[WithinDistance, ...]
    num_same_direction: int
    median_m: float
    median_deg: float


@dataclass(frozen=True, slots=True)
class RowWithoutTruth:
    """One condition, pool or ``"all"`` of one result.

    Parameters
    ----------
    inliers_quartiles : 25, 50, 75 % over the localized queries; None where nothing says them.
    first_candidate, nearest_candidate : agreement with them; None: no map, or no candidates, or
        nobody ranked them.
    """

    name: str
    num_queries: int
    num_localized: int
    num_fallback: int
    num_missing: int
    inliers_quartiles: tuple[float, float, float] | None
    first_candidate: PriorAgreement | None
    nearest_candidate: PriorAgreement | None


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
    """Everything that can be said.

    Parameters
    ----------
    statement : who knows the true poses.
    thresholds : of the agreement between results.
    agreement : per pair of results, per row; empty for one result.
    apart : per pair of results, how far their poses of each query are apart; infinite where one
        has none.
    """

    statement: str
    thresholds: tuple[Threshold, ...]
    results: tuple[ResultWithoutTruth, ...]
    agreement: tuple[AgreementRow, ...]
    apart: tuple[PoseErrors, ...]

    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query; of several results they are called ``label: column``,
        and the distances of their poses follow."""
        columns: dict[str, list[Any]] = {}
        for result in self.results:
            before = f"{result.label}: " if self.results[1:] else ""
            queries = result.queries
            near = [query.near for query in queries]
            columns["image"] = [query.image for query in queries]
            columns["condition"] = [query.condition for query in queries]
            for name in _QUERY_COLUMNS:
                columns[before + name] = [getattr(query, name) for query in queries]
            for name, attribute in _CANDIDATE_COLUMNS.items():
                columns[before + name] = [getattr(one, attribute, None) for one in near]
            columns[before + "reason"] = [query.reason for query in queries]
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
    map_poses: Poses | None = None,
    statement: str = "",
) -> WithoutTruth:
    """Localized share, inliers, agreement with retrieval and between results, all in one frame.

    Parameters
    ----------
    queries : every query that counts; by default all that any of the results is about.
    conditions, condition_order, pools : as in
        :func:`megloc_kapture.evaluation.scoring.evaluate_poses`.
    thresholds : of the agreement between two results.
    map_poses : ``cam_from_world`` of the map's images, in the same frame.
    statement : who knows the true poses; empty: they were not given.

    Raises
    ------
    DataError : there is no query.
    OptionError : no result, two with one label, or two rows would bear one name.
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
    pairs = list(combinations(range(len(results)), 2))
    apart = []
    for i, j in pairs:
        first, second = results[i].poses, results[j].poses
        shared = {image: first[image] for image in images if image in first and image in second}
        apart.append(pose_errors(shared, second, images))
    return WithoutTruth(
        statement=statement or "No true poses were given.",
        thresholds=tuple(thresholds),
        results=tuple(
            _result(result, images, of_image, members, map_poses or {}) for result in results
        ),
        agreement=tuple(
            row
            for pair, errors in zip(pairs, apart, strict=True)
            for row in _agreement(results, pair, errors, members, thresholds)
        ),
        apart=tuple(apart),
    )


def _result(
    result: Result,
    images: Sequence[str],
    conditions: Mapping[str, str],
    members: Mapping[str, NDArray[np.bool_]],
    map_poses: Poses,
) -> ResultWithoutTruth:
    statuses = result.statuses or {}
    # a guess taken from a candidate agrees with it, which says nothing
    guessed = {image for image, status in statuses.items() if status.fallback != "none"}
    localized = [image for image in images if image in result.poses and image not in guessed]
    near = {}
    if result.context.unit == METRES:  # distances are told in metres, or not at all
        near = near_candidates(result.poses, statuses, localized, map_poses)
    queries = tuple(
        query_result(
            image,
            conditions.get(image, ""),
            statuses.get(image),
            has_pose=image in result.poses,
            errors=(math.nan, math.nan),
            confidence=result.confidences.get(image),
            no_pose="no pose",
            near=near.get(image),
        )
        for image in images
    )
    rows = tuple(_row(name, list(compress(queries, chosen))) for name, chosen in members.items())
    return ResultWithoutTruth(result.label, rows, queries, result.poses, result.context)


def near_candidates(
    poses: Poses,
    statuses: Mapping[str, QueryStatus],
    images: Sequence[str],
    map_poses: Poses,
) -> dict[str, NearCandidates]:
    """Image -> the first and the nearest of its candidates that have a pose in the map; images
    without any are left out. ``map_poses`` are in the frame of ``poses``."""
    index_of = {name: index for index, name in enumerate(map_poses)}
    known = {
        image: [index_of[c] for c in statuses[image].candidates if c in index_of]
        for image in images
        if image in statuses
    }
    known = {image: candidates for image, candidates in known.items() if candidates}
    if not known:
        return {}
    counts = [len(candidates) for candidates in known.values()]
    candidates = np.concatenate([np.array(c, dtype=np.int64) for c in known.values()])
    centers, directions = _centers_and_directions([poses[image] for image in known])
    map_centers, map_directions = _centers_and_directions(list(map_poses.values()))
    owner = np.repeat(np.arange(len(known)), counts)
    distance_m = np.linalg.norm(centers[owner] - map_centers[candidates], axis=1)
    cosine = np.einsum("ij,ij->i", directions[owner], map_directions[candidates])
    angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    names = list(map_poses)
    ranked = are_ranked(status.candidates for status in statuses.values())
    found, first = dict[str, NearCandidates](), 0
    for image, count in zip(known, counts, strict=True):
        nearest = first + int(np.argmin(distance_m[first : first + count]))
        found[image] = NearCandidates(
            first_m=float(distance_m[first]) if ranked else math.nan,
            first_deg=float(angle_deg[first]) if ranked else math.nan,
            nearest=names[int(candidates[nearest])],
            nearest_m=float(distance_m[nearest]),
            nearest_deg=float(angle_deg[nearest]),
        )
        first += count
    return found


def _centers_and_directions(
    poses: Sequence[RigidTransform],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Camera centres (N, 3) and unit viewing directions (N, 3) in the world."""
    quats, translations = stack_poses(poses)
    directions = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))
    return camera_centers(quats, translations), directions


def _row(name: str, queries: Sequence[QueryResult]) -> RowWithoutTruth:
    localized = [query for query in queries if query.outcome == "localized"]
    inliers = [query.num_inliers for query in localized if query.num_inliers is not None]
    near = [query.near for query in localized if query.near is not None]
    quartiles = None
    if inliers:
        low, middle, high = np.quantile(inliers, _QUARTILES).tolist()
        quartiles = (low, middle, high)
    return RowWithoutTruth(
        name=name,
        num_queries=len(queries),
        num_localized=len(localized),
        num_fallback=sum(query.outcome == "fallback" for query in queries),
        num_missing=sum(query.outcome == "missing" for query in queries),
        inliers_quartiles=quartiles,
        first_candidate=_prior([(n.first_m, n.first_deg) for n in near]),
        nearest_candidate=_prior([(n.nearest_m, n.nearest_deg) for n in near]),
    )


def _prior(pairs: Sequence[tuple[float, float]]) -> PriorAgreement | None:
    pairs = [pair for pair in pairs if not math.isnan(pair[0])]
    if not pairs:
        return None
    distance_m, angle_deg = np.array(pairs).T
    return PriorAgreement(
        num_compared=len(pairs),
        within=tuple(
            WithinDistance(bound, int(near.sum()), float(near.mean()))
            for bound in PRIOR_DISTANCES_M
            for near in [distance_m <= bound]
        ),
        num_same_direction=int((angle_deg <= PRIOR_ANGLE_DEG).sum()),
        median_m=float(np.median(distance_m)),
        median_deg=float(np.median(angle_deg)),
    )


def _agreement(
    results: Sequence[Result],
    pair: tuple[int, int],
    apart: PoseErrors,
    members: Mapping[str, NDArray[np.bool_]],
    thresholds: Sequence[Threshold],
) -> list[AgreementRow]:
    in_first, in_second = (
        np.array([image in results[index].poses for image in apart.names]) for index in pair
    )
    rows = []
    for name, chosen in members.items():
        row = recall_row(name, apart, thresholds, members=chosen)
        rows.append(
            AgreementRow(
                first=pair[0],
                second=pair[1],
                name=name,
                num_queries=row.num_queries,
                num_both=int((in_first & in_second & chosen).sum()),
                num_only_first=int((in_first & ~in_second & chosen).sum()),
                num_only_second=int((in_second & ~in_first & chosen).sum()),
                within=row.recall,
                median_m=row.median_localized_position_m,
                median_deg=row.median_localized_angle_deg,
            )
        )
    return rows
