"""Compare estimated poses with true ones: the one entry to errors, recall and their books."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.pose_errors import PoseErrors, pose_errors
from megloc_kapture.evaluation.recall import RecallRow, recall_rows, row_members
from megloc_kapture.evaluation.thresholds import DEFAULT_THRESHOLDS, Threshold
from megloc_kapture.io.challenge_tables import RelocalizationPair
from megloc_kapture.io.status_table import Fallback, QueryStatus
from megloc_kapture.values import RigidTransform

Outcome = Literal["localized", "fallback", "missing"]


@dataclass(frozen=True, slots=True)
class QueryResult:
    """What became of one scored query.

    Parameters
    ----------
    image, condition : the query and what it is reported under (``""``: nothing).
    outcome : ``localized``, ``fallback`` (its pose is a guess) or ``missing`` (no pose).
    reason : why it was not localized; empty for a localized query.
    position_m, angle_deg : errors in metres and degrees, infinite without a pose.
    num_matches, num_inliers : from the status table; None without one.
    fallback : what kind of guess a fallback pose is.
    candidates : map images the pose comes from, best first; from the status table.
    """

    image: str
    condition: str
    outcome: Outcome
    reason: str
    position_m: float
    angle_deg: float
    num_matches: int | None = None
    num_inliers: int | None = None
    fallback: Fallback = "none"
    candidates: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Evaluation:
    """Everything known about one result.

    Parameters
    ----------
    label : what the result is called in tables.
    thresholds : of the recall rows, in their order.
    rows : recall per condition, pools, and ``"all"``, which is the last.
    members : row name -> bool (N,), the queries it counts.
    queries : every counted query, sorted by name.
    errors : the same queries' errors as arrays.
    truth, estimated : ``cam_from_world`` of the counted queries (estimated: those that have one).
    without_truth : images that were estimated (or asked to be scored) but have no true pose;
        sorted. They are reported, never counted.
    not_scored : images with a true pose that the benchmark does not count; sorted.
    truth_known_by : who knows the true poses that are not published; empty: said nowhere.
    pairs : of MLAD's challenges, what a query is called in ``queries`` -> its pair; else empty.
    by_center : None where the position error is the distance of the camera centres. Where it is
        another (see :mod:`megloc_kapture.evaluation.relative`), the same queries' evaluation by
        that distance.
    """

    label: str
    thresholds: tuple[Threshold, ...]
    rows: tuple[RecallRow, ...]
    members: Mapping[str, NDArray[np.bool_]]
    queries: tuple[QueryResult, ...]
    errors: PoseErrors
    truth: Mapping[str, RigidTransform]
    estimated: Mapping[str, RigidTransform]
    without_truth: tuple[str, ...]
    not_scored: tuple[str, ...]
    truth_known_by: str = ""
    pairs: Mapping[str, RelocalizationPair] = field(default_factory=dict)
    by_center: Evaluation | None = None

    def row(self, name: str = "all") -> RecallRow:
        """The recall row of a condition or pool; KeyError for an unknown name."""
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(name)

    def image(self, query: str) -> str:
        """The image of a query, which in ``queries`` may be called by its pair."""
        return self.pairs[query].query if query in self.pairs else query


def evaluate(
    estimated: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    *,
    conditions: Mapping[str, str] | None = None,
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
    scored: Collection[str] | None = None,
    statuses: Mapping[str, QueryStatus] | None = None,
    condition_order: Sequence[str] = (),
    pools: Mapping[str, Sequence[str]] | None = None,
    label: str = "",
    errors: PoseErrors | None = None,
) -> Evaluation:
    """Errors, recall and outcomes of ``estimated``.

    The queries are the images of ``truth``, those of them that are in ``scored`` where it is
    given. Every one of them stands in the denominator of recall, with or without a pose.

    Parameters
    ----------
    estimated, truth : ``cam_from_world`` by image name, in one frame, metres.
    conditions : image -> condition; images may be absent from it.
    scored : the images the benchmark counts; None counts all of ``truth``.
    statuses : rows of ``status.csv``: reasons, inliers, and which poses are fallbacks.
    condition_order, pools : see :func:`megloc_kapture.evaluation.recall.row_members`.
    label : what to call this result.
    errors : of exactly the counted queries, sorted by name, where they are measured in another
        way than by camera centres and rotation angle.

    Raises
    ------
    DataError : no scored query has a true pose, so that there is nothing to count.
    OptionError : two rows of the table would bear one name, or there is no threshold.
    """
    if not thresholds:
        raise OptionError("at least one recall threshold is needed")
    counted = tuple(sorted(n for n in truth if scored is None or n in scored))
    if not counted:
        raise DataError("no query with a true pose to count: is this the right ground truth?")
    wanted = set(estimated) if scored is None else set(estimated) | set(scored)
    if errors is None:
        errors = pose_errors(estimated, truth, counted)
    queries = tuple(
        _query_result(name, position_m, angle_deg, conditions, statuses)
        for name, position_m, angle_deg in zip(
            counted, errors.position_m.tolist(), errors.angle_deg.tolist(), strict=True
        )
    )
    members = row_members(
        [query.condition for query in queries], order=condition_order, pools=pools
    )
    guessed = np.array([query.outcome == "fallback" for query in queries])
    return Evaluation(
        label=label,
        thresholds=tuple(thresholds),
        rows=recall_rows(errors, thresholds, members, fallback=guessed),
        members=members,
        queries=queries,
        errors=errors,
        truth={name: truth[name] for name in counted},
        estimated={name: estimated[name] for name in counted if name in estimated},
        without_truth=tuple(sorted(wanted - set(truth))),
        not_scored=tuple(sorted(set(truth) - set(counted))),
    )


def _query_result(
    image: str,
    position_m: float,
    angle_deg: float,
    conditions: Mapping[str, str] | None,
    statuses: Mapping[str, QueryStatus] | None,
) -> QueryResult:
    status = None if statuses is None else statuses.get(image)
    outcome: Outcome = "localized"
    reason = ""
    fallback: Fallback = "none"
    if not np.isfinite(position_m):
        outcome = "missing"
        reason = "no pose in the result" if status is None else status.reason
        if status is not None and status.status == "localized":
            reason = "status says localized, but the result has no pose"
    elif status is not None and status.fallback != "none":
        outcome = "fallback"
        reason, fallback = status.reason, status.fallback
    return QueryResult(
        image=image,
        condition="" if conditions is None else conditions.get(image, ""),
        outcome=outcome,
        reason=reason,
        position_m=position_m,
        angle_deg=angle_deg,
        num_matches=None if status is None else status.num_matches,
        num_inliers=None if status is None else status.num_inliers,
        fallback=fallback,
        candidates=() if status is None else status.candidates,
    )
