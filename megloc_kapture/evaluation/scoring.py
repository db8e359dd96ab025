"""One result against true poses: errors, outcomes, recall; and by MLAD's metric of pairs.

The MLAD challenges hand out pairs of a reference and a query and score ``|t - t_true|`` of
``query_from_reference``, without the rotation. That length mixes the error of the camera's centre
with the error of its rotation times the distance of the two cameras, so the distance of the
centres is reported beside it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
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
    recall_row,
    row_members,
)
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.geometry.poses import compose, invert, stack_poses
from megloc_kapture.io.dataset_tables import RelocalizationPair
from megloc_kapture.io.files import write_bytes
from megloc_kapture.io.tables import Fallback, QueryStatus
from megloc_kapture.refinement.acceptance import squared_distance
from megloc_kapture.values import RigidTransform

if TYPE_CHECKING:
    from pandas import DataFrame

    from megloc_kapture.evaluation.report.reports import AnyReported
    from megloc_kapture.evaluation.statistics import Comparison

_CHI2_95 = 12.592  # quantile of six degrees of freedom

Outcome = Literal["localized", "fallback", "missing"]
# column of a table of queries -> attribute
_COLUMNS = {
    **{name: name for name in ("image", "condition", "outcome")},
    **{"position_error_m": "position_m", "angle_error_deg": "angle_deg"},
    **{name: name for name in ("num_matches", "num_inliers", "confidence", "reason")},
}


@dataclass(frozen=True, slots=True)
class QueryResult:
    """The outcome of one query.

    Parameters
    ----------
    image, condition : the query and what it is reported under (``""``: nothing).
    outcome : ``localized``, ``fallback`` (its pose is a guess) or ``missing`` (no pose).
    reason : why it was not localized; empty for a localized query.
    position_m, angle_deg : errors in metres and degrees, infinite without a pose; NaN where the
        truth is not known.
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
    __slots__ = ()

    @abstractmethod
    def per_query(self) -> dict[str, list[Any]]:
        """Column -> one value per query, as in ``per_query.csv``."""

    def __str__(self) -> str:
        from megloc_kapture.evaluation.report.reports import report_text

        # the three subclasses are what reports know
        return report_text(cast("AnyReported", self)).removesuffix("\n")

    def html(self, path: Path | str) -> None:
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


@dataclass(frozen=True, slots=True)
class CovarianceCheck:
    num_poses: int
    num_within: int


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
    covariance : how many poses come with a covariance, and of how many the error lies within the
        region that it claims to hold 95 % of the errors; None where none has one.
    nowhere : queries that show nothing of the map, sorted by name; they are right without a pose,
        and stand in no row.
    by_center : of MLAD's pairs, the same queries' evaluation by the distance of the camera centres;
        None where that is the position error anyway.
    alignment : how the poses were aligned with the truth, or that they could be.
    """

    label: str
    thresholds: tuple[Threshold, ...]
    rows: tuple[RecallRow, ...]
    members: Mapping[str, NDArray[np.bool_]]
    queries: tuple[QueryResult, ...]
    errors: PoseErrors
    truth: Poses
    estimated: Poses
    without_truth: tuple[str, ...]
    not_scored: tuple[str, ...]
    truth_known_by: str = ""
    pairs: Mapping[str, RelocalizationPair] = field(default_factory=dict)
    nowhere: tuple[QueryResult, ...] = ()
    covariance: CovarianceCheck | None = None
    by_center: Evaluation | None = None
    context: ResultContext = field(default_factory=ResultContext)
    alignment: str = ""

    @property
    def confidence(self) -> Confidence | None:
        return confidence_of(self.queries, self.thresholds[-1], self.nowhere)

    def rows_above(self, min_confidence: float) -> tuple[RecallRow, ...]:
        """The recall rows when each pose below a confidence counts as a miss; empty where no pose
        has a confidence."""
        if all(query.confidence is None for query in self.queries):
            return ()
        doubtful = [
            query.confidence is not None and query.confidence < min_confidence
            for query in self.queries
        ]
        position_m = np.where(doubtful, np.inf, self.errors.position_m)
        angle_deg = np.where(doubtful, np.inf, self.errors.angle_deg)
        errors = PoseErrors(self.errors.names, position_m, angle_deg)
        return _rows(self.queries, errors, self.thresholds, self.members)

    def compare(self, *others: Evaluation) -> Comparison:
        """Test the differences from results on the same queries, which need other labels; see
        :func:`megloc_kapture.evaluation.statistics.compare`."""
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
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(name)

    def image(self, query: str) -> str:
        return self.pairs[query].query if query in self.pairs else query


def query_columns(queries: Sequence[QueryResult]) -> dict[str, list[Any]]:
    """Column -> one value per query, as tables of queries have them."""
    shown = dict(_COLUMNS)
    if all(query.confidence is None for query in queries):
        del shown["confidence"]
    return {name: [getattr(query, own) for query in queries] for name, own in shown.items()}


def evaluate_poses(
    estimated: Poses,
    truth: Poses,
    *,
    conditions: Mapping[str, str] | None = None,
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
    scored: Collection[str] | None = None,
    statuses: Mapping[str, QueryStatus] | None = None,
    condition_order: Sequence[str] = (),
    pools: Mapping[str, Sequence[str]] | None = None,
    label: str = "",
    nowhere: Collection[str] = (),
    confidences: Mapping[str, float] | None = None,
    covariances: Mapping[str, NDArray[np.float64]] | None = None,
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
    nowhere : images that are known to show nothing of the map.
    confidences : of poses, where ``statuses`` do not say them.
    covariances : of poses, float64 (6, 6) as of ``Pose``.
    """
    if not thresholds:
        raise OptionError("at least one recall threshold is needed")
    counted = tuple(sorted(n for n in truth if scored is None or n in scored))
    if both := set(nowhere).intersection(truth):
        raise DataError(f"{min(both)!r} is said to show nothing of the map, and has a true pose")
    if not counted:
        raise DataError("no query with a true pose to count: is this the right ground truth?")
    wanted = set(estimated) if scored is None else set(estimated) | set(scored)
    errors = pose_errors(estimated, truth, counted)

    def result(name: str, position_m: float, angle_deg: float) -> QueryResult:
        status = (statuses or {}).get(name)
        return query_result(
            name,
            (conditions or {}).get(name, ""),
            status,
            has_pose=name in estimated,
            errors=(position_m, angle_deg),
            confidence=(confidences or {}).get(name),
        )

    found = zip(counted, errors.position_m.tolist(), errors.angle_deg.tolist(), strict=True)
    queries = tuple(result(*one) for one in found)
    members = row_members(
        [query.condition for query in queries], order=condition_order, pools=pools
    )
    return Evaluation(
        label=label,
        thresholds=tuple(thresholds),
        rows=_rows(queries, errors, thresholds, members),
        members=members,
        queries=queries,
        errors=errors,
        truth={name: truth[name] for name in counted},
        estimated={name: estimated[name] for name in counted if name in estimated},
        covariance=_check_covariances(queries, estimated, truth, covariances or {}),
        nowhere=tuple(result(name, np.inf, np.inf) for name in sorted(nowhere)),
        without_truth=tuple(sorted(wanted - set(truth) - set(nowhere))),
        not_scored=tuple(sorted(set(truth) - set(counted))),
    )


def _check_covariances(
    queries: Sequence[QueryResult],
    estimated: Poses,
    truth: Poses,
    covariances: Mapping[str, NDArray[np.float64]],
) -> CovarianceCheck | None:
    names = [q.image for q in queries if q.outcome == "localized" and q.image in covariances]
    within = sum(
        squared_distance(truth[name], estimated[name], covariances[name]) <= _CHI2_95
        for name in names
    )
    return CovarianceCheck(len(names), within) if names else None


def _rows(
    queries: Sequence[QueryResult],
    errors: PoseErrors,
    thresholds: Sequence[Threshold],
    members: Mapping[str, NDArray[np.bool_]],
) -> tuple[RecallRow, ...]:
    guessed = np.array([query.outcome == "fallback" for query in queries])
    return tuple(
        recall_row(name, errors, thresholds, members=chosen, fallback=guessed)
        for name, chosen in members.items()
    )


def query_result(
    image: str,
    condition: str,
    status: QueryStatus | None,
    *,
    has_pose: bool,
    errors: tuple[float, float],
    confidence: float | None = None,
) -> QueryResult:
    """Return the outcome of a query; errors are in metres and degrees."""
    if status is None:
        outcome: Outcome = "localized" if has_pose else "missing"
        reason = "" if has_pose else "no pose in the result"
        return QueryResult(image, condition, outcome, reason, *errors, confidence=confidence)
    outcome, reason = "missing", status.reason
    if has_pose and status.fallback == "none":
        outcome, reason = "localized", ""
    elif has_pose:
        outcome = "fallback"
    elif status.status == "localized":
        reason = "status says localized, but the result has no pose"
    return QueryResult(
        image,
        condition,
        outcome,
        reason,
        *errors,
        status.num_matches,
        status.num_inliers,
        status.fallback if has_pose else "none",
        status.candidates,
        status.confidence,
    )


def relative_translation_errors(
    estimated: tuple[NDArray[np.float64], NDArray[np.float64]],
    truth: tuple[NDArray[np.float64], NDArray[np.float64]],
    references: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """``|t - t_true|`` (N,) of ``query_from_reference``, in metres.

    Parameters
    ----------
    estimated, truth, references : ``cam_from_world`` of the queries, and of the reference each is
        paired with, in one frame: quaternions (N, 4), w first, and translations (N, 3).
    """
    world_from_reference = invert(*references)
    _, found = compose(*estimated, *world_from_reference)
    _, true = compose(*truth, *world_from_reference)
    return np.asarray(np.linalg.norm(found - true, axis=1), dtype=np.float64)


def evaluate_pairs(
    estimated: Mapping[RelocalizationPair, RigidTransform],
    truth: Poses,
    pairs: Sequence[RelocalizationPair],
    references: Poses,
    *,
    thresholds: Sequence[Threshold],
    statuses: Mapping[str, QueryStatus] | None = None,
    label: str = "",
) -> Evaluation:
    """Evaluate by MLAD's metric: every pair counts once, and each file is a condition.

    A pair is called by its query; where that stands in several, with reference and file as well.

    Parameters
    ----------
    estimated : ``cam_from_world`` of a pair's query; pairs may be absent.
    truth, references : ``cam_from_world`` of queries and references, in the same frame, metres.
    statuses : rows of ``status.csv`` by image.

    Returns
    -------
    The errors' position is the relative translation's; ``by_center`` has the distances of the
    centres. Pairs whose query has no true pose are named in ``without_truth``.
    """
    absent = next((pair for pair in pairs if pair.reference not in references), None)
    if absent is not None:
        raise DataError(f"reference {absent.reference!r} of {absent.file!r} has no pose in the map")
    times = Counter(pair.query for pair in pairs)
    named = {
        p.query if times[p.query] == 1 else f"{p.query} from {p.reference}, {p.file}": p
        for p in pairs
    }
    if len(named) != len(pairs):
        raise DataError("a pair of reference and query is listed twice in one file")
    called = _conditions(dict.fromkeys(pair.file for pair in pairs))
    statuses = statuses or {}
    of_pairs = {n: statuses[p.query] for n, p in named.items() if p.query in statuses}
    by_center = evaluate_poses(
        {n: estimated[p] for n, p in named.items() if p in estimated},
        {n: truth[p.query] for n, p in named.items() if p.query in truth},
        conditions={n: called[p.file] for n, p in named.items()} if len(called) > 1 else None,
        thresholds=thresholds,
        scored=named.keys(),
        statuses=of_pairs,
        condition_order=list(called.values()),
        label=label,
    )
    names = by_center.errors.names
    found = by_center.errors.has_pose
    posed = [name for name, has in zip(names, found, strict=True) if has]
    position_m = np.full(len(names), np.inf)
    position_m[found] = relative_translation_errors(
        stack_poses(estimated[named[name]] for name in posed),
        stack_poses(truth[named[name].query] for name in posed),
        stack_poses(references[named[name].reference] for name in posed),
    )
    errors = PoseErrors(names, position_m, by_center.errors.angle_deg)
    queries = tuple(
        replace(query, position_m=error_m)
        for query, error_m in zip(by_center.queries, position_m.tolist(), strict=True)
    )
    return replace(
        by_center,
        errors=errors,
        queries=queries,
        rows=_rows(queries, errors, thresholds, by_center.members),
        pairs={name: named[name] for name in names},
        by_center=by_center,
    )


def _conditions(files: Iterable[str]) -> dict[str, str]:
    whole = {file: PurePosixPath(file).stem for file in files}
    short = {}
    for file, stem in whole.items():
        target = stem.rsplit("_to_", 1)[-1]
        for prefix in ("relocalizationFile_", "reloc_", "recording_"):
            target = target.removeprefix(prefix)
        short[file] = target
    return short if len(set(short.values())) == len(short) else whole
