"""One result against true poses: errors, outcomes, recall."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.confidence import Confidence, confidence_of
from megloc_kapture.evaluation.metrics import (
    DEFAULT_THRESHOLDS,
    PoseErrors,
    RecallRow,
    Threshold,
    pose_errors,
    recall_rows,
    row_members,
)
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.io.dataset_tables import RelocalizationPair
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.tables import Fallback, QueryStatus
from megloc_kapture.values import RigidTransform

if TYPE_CHECKING:
    from pandas import DataFrame

    from megloc_kapture.evaluation.report.reports import AnyReported
    from megloc_kapture.evaluation.statistics import Comparison

Outcome = Literal["localized", "fallback", "missing"]


@dataclass(frozen=True, slots=True)
class QueryResult:
    """The outcome of one scored query.

    Parameters
    ----------
    image, condition : the query and what it is reported under (``""``: nothing).
    outcome : ``localized``, ``fallback`` (its pose is a guess) or ``missing`` (no pose).
    reason : why it was not localized; empty for a localized query.
    position_m, angle_deg : errors in metres and degrees, infinite without a pose.
    num_matches, num_inliers : from the status table; None without one.
    fallback : what kind of guess a fallback pose is.
    candidates : map images the pose comes from, best first; from the status table.
    confidence : probability that the pose is right, as the result says; None where it does not.
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
    confidence: float | None = None


class Reported(ABC):
    """A result, or several, that a report can be made of; prints as its tables."""

    __slots__ = ()

    @abstractmethod
    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query, as in ``per_query.csv``."""

    def __str__(self) -> str:
        from megloc_kapture.evaluation.report.reports import report_text

        # of this class there are the four kinds that reports know
        return report_text(cast("AnyReported", self)).removesuffix("\n")

    def html(self, path: Path | str) -> None:
        """Write the report as an HTML page.

        Raises
        ------
        DataError : the map that the context of a result knows is broken.
        OutputError : the file cannot be written.
        """
        from megloc_kapture.evaluation.report.reports import render_report

        write_bytes(path, render_report(cast("AnyReported", self)).encode("utf-8"))

    def to_pandas(self) -> DataFrame:
        """One row per query, by image, with the columns of ``per_query.csv``.

        Errors are in metres and degrees, and infinite where a query has no pose: they lie beyond
        every threshold, and raise a median instead of leaving it. Counts that may be unknown are
        pandas' nullable integers.
        """
        import pandas as pd  # only those who ask for it wait for it

        columns = {
            name: pd.array(values, dtype="Int64") if "num_" in name else values
            for name, values in self.per_query().items()
        }
        return pd.DataFrame(columns).set_index("image")


@dataclass(frozen=True, eq=False, slots=True)
class Evaluation(Reported):
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
    nowhere : queries that show nothing of the map, sorted by name; they are right without a pose,
        and stand in no row.
    by_center : None where the position error is the distance of the camera centres. Where it is
        another (see :mod:`megloc_kapture.evaluation.scoring`), the same queries' evaluation by
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
    nowhere: tuple[QueryResult, ...] = ()
    by_center: Evaluation | None = None
    context: ResultContext = field(default_factory=ResultContext)

    @property
    def confidence(self) -> Confidence | None:
        """The confidences of the result against the truth; None where it brings none."""
        return confidence_of(self.queries, self.thresholds[-1], self.nowhere)

    def compare(self, *others: Evaluation) -> Comparison:
        """Test the differences from results on the same queries, which need other labels.

        Raises
        ------
        OptionError : two results of one label, or not of the same queries and thresholds.
        """
        from megloc_kapture.evaluation.statistics import compare

        return compare([self, *others])

    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query; of MLAD's pairs the position error is the translation's
        relative to the reference."""
        columns = query_columns(self.queries)
        if self.by_center is not None:
            columns["reference"] = [self.pairs[query.image].reference for query in self.queries]
            columns["center_error_m"] = [query.position_m for query in self.by_center.queries]
        return columns

    def row(self, name: str = "all") -> RecallRow:
        """The recall row of a condition or pool; KeyError for an unknown name."""
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(name)

    def image(self, query: str) -> str:
        """The image of a query, which in ``queries`` may be called by its pair."""
        return self.pairs[query].query if query in self.pairs else query


def query_columns(queries: Sequence[QueryResult]) -> dict[str, list[Any]]:
    """Column -> one value per query, as tables of queries have them."""
    known = any(query.confidence is not None for query in queries)
    return {
        "image": [query.image for query in queries],
        "condition": [query.condition for query in queries],
        "outcome": [query.outcome for query in queries],
        "position_error_m": [query.position_m for query in queries],
        "angle_error_deg": [query.angle_deg for query in queries],
        "num_matches": [query.num_matches for query in queries],
        "num_inliers": [query.num_inliers for query in queries],
        **({"confidence": [query.confidence for query in queries]} if known else {}),
        "reason": [query.reason for query in queries],
    }


def evaluate_poses(
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
    nowhere: Collection[str] = (),
    confidences: Mapping[str, float] | None = None,
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
    condition_order, pools : see :func:`megloc_kapture.evaluation.metrics.row_members`.
    label : what to call this result.
    errors : of exactly the counted queries, sorted by name, where they are measured in another
        way than by camera centres and rotation angle.
    nowhere : images that are known to show nothing of the map.
    confidences : of poses, where ``statuses`` do not say them.

    Raises
    ------
    DataError : no scored query has a true pose, so that there is nothing to count; or an image
        that shows nothing of the map has one.
    OptionError : two rows of the table would bear one name, or there is no threshold.
    """
    if not thresholds:
        raise OptionError("at least one recall threshold is needed")
    counted = tuple(sorted(n for n in truth if scored is None or n in scored))
    if both := set(nowhere).intersection(truth):
        raise DataError(f"{min(both)!r} is said to show nothing of the map, and has a true pose")
    if not counted:
        raise DataError("no query with a true pose to count: is this the right ground truth?")
    wanted = set(estimated) if scored is None else set(estimated) | set(scored)
    if errors is None:
        errors = pose_errors(estimated, truth, counted)
    queries = tuple(
        _query_result(
            name, (position_m, angle_deg), name in estimated, conditions, statuses, confidences
        )
        for name, position_m, angle_deg in zip(
            counted, errors.position_m.tolist(), errors.angle_deg.tolist(), strict=True
        )
    )
    strays = tuple(
        _query_result(name, (np.inf, np.inf), name in estimated, conditions, statuses, confidences)
        for name in sorted(nowhere)
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
        nowhere=strays,
        without_truth=tuple(sorted(wanted - set(truth) - set(nowhere))),
        not_scored=tuple(sorted(set(truth) - set(counted))),
    )


def _query_result(
    image: str,
    errors: tuple[float, float],
    has_pose: bool,
    conditions: Mapping[str, str] | None,
    statuses: Mapping[str, QueryStatus] | None,
    confidences: Mapping[str, float] | None,
) -> QueryResult:
    status = None if statuses is None else statuses.get(image)
    outcome: Outcome = "localized"
    reason = ""
    fallback: Fallback = "none"
    if not has_pose:
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
        position_m=errors[0],
        angle_deg=errors[1],
        num_matches=None if status is None else status.num_matches,
        num_inliers=None if status is None else status.num_inliers,
        fallback=fallback,
        candidates=() if status is None else status.candidates,
        confidence=(confidences or {}).get(image) if status is None else status.confidence,
    )
