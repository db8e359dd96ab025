"""Errors, outcomes and recall of one result, from absolute poses or from MLAD's image pairs.

The MLAD challenges (4Seasons relocalization) score ``|t - t_true|`` of ``query_from_reference`` for
pairs of images. That length mixes the error of the camera centre with the rotation error times the
distance between the two cameras, so the error of the centre is reported too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation.metrics import (
    Confidence,
    PoseErrors,
    RecallRow,
    Threshold,
    confidence_of,
    from_fine_to_coarse,
    pose_errors,
    recall_row,
    row_members,
    thresholds_from_pairs,
)
from megloc_kapture.evaluation.results import Poses, Result, ResultContext
from megloc_kapture.geometry.poses import compose, invert, stack_poses
from megloc_kapture.io.dataset_tables import NO_TABLES, ImageGroup, RelocalizationPair, SideTables
from megloc_kapture.io.files import write_bytes
from megloc_kapture.refinement.acceptance import squared_distance
from megloc_kapture.values import LocalizationResult, RigidTransform

if TYPE_CHECKING:
    from pandas import DataFrame

    from megloc_kapture.evaluation.comparison import Comparison

_CHI2_95 = 12.592  # 95 % quantile for six degrees of freedom

NO_POSE = "no pose in the result"
Outcome = Literal["localized", "fallback", "missing"]
_COUNTS = ("num_matches", "num_inliers")
# column of a table of queries -> attribute
_COLUMNS = {
    **{"image": "name", "condition": "condition", "outcome": "outcome"},
    **{"position_error_m": "position_m", "angle_error_deg": "angle_deg"},
    **{name: name for name in (*_COUNTS, "confidence", "reason")},
}


@dataclass(frozen=True, kw_only=True)
class QueryResult(LocalizationResult):
    """Result of one query compared with its true pose; its pose may be a fallback.

    Attributes
    ----------
    image : the query's image in the dataset; an evaluation of pairs has their names in ``name``.
    outcome : ``localized``, ``fallback`` (the pose is a guess) or ``missing``.
    position_m, angle_deg : errors; infinite without a pose and for a query that shows nothing of
        the map, NaN in a comparison without ground truth.
    truth : true ``cam_from_world``, if known.
    color, meaning : for reports, see :func:`~.report.queries.shown_queries`.
    """

    image: str
    condition: str
    outcome: Outcome
    position_m: float
    angle_deg: float
    truth: RigidTransform | None = None
    color: str = ""
    meaning: str = ""


class Reported:
    """Base class of results that have a report."""

    __slots__ = ()

    if TYPE_CHECKING:

        @property
        def evaluations(self) -> tuple[Evaluation, ...]: ...

    def per_query(self) -> dict[str, list[Any]]:
        """Return the columns of ``per_query.csv``, with one value per query."""
        columns: dict[str, list[Any]] = {}
        for evaluation in self.evaluations:
            label = f"{evaluation.label}: " if self.evaluations[1:] else ""
            for name, values in _query_columns(evaluation).items():
                shared = name in ("image", "condition")
                columns.setdefault(name if shared else label + name, values)
        return columns

    def __str__(self) -> str:
        from megloc_kapture.evaluation.report.reports import report_text

        return report_text(self).removesuffix("\n")

    def html(self, path: Path | str) -> None:
        from megloc_kapture.evaluation.report.reports import render_report

        write_bytes(path, render_report(self).encode("utf-8"))

    def to_pandas(self) -> DataFrame:
        """Return the columns of ``per_query.csv``, indexed by image.

        Errors are in metres and degrees; those of queries without a pose are infinite.
        """
        import pandas as pd  # slow import

        columns = {
            name: pd.array(values, dtype="Int64") if name.endswith(_COUNTS) else values
            for name, values in self.per_query().items()
        }
        return pd.DataFrame(columns).set_index("image")


@dataclass(frozen=True, eq=False, slots=True)
class Evaluation(Reported):
    """Evaluation of one result; without true poses ``thresholds`` is empty.

    Attributes
    ----------
    rows : recall per condition, per pool of conditions and, last, for ``"all"``.
    members : row name -> mask (N,) of its queries.
    queries : N counted queries, sorted by name.
    without_truth : images or pairs without a true pose, sorted; reported but not counted.
    not_scored : images with a true pose that the benchmark does not score, sorted; likewise.
    truth_known_by : note on who has the true poses, if they are not published; else empty.
    pairs : name of a query -> its pair, for the MLAD challenges.
    nowhere : queries that show nothing of the map; recall ignores them, and any pose
        estimated for them is wrong.
    by_center : the same pairs of MLAD, evaluated by the error of the camera centre.
    covariance : counts of localized poses: ``num_poses`` have a covariance, ``num_within`` have the
        true pose in its 95 % region.
    alignment : note on how the poses were, or could be, aligned with the truth.
    """

    label: str
    thresholds: tuple[Threshold, ...]
    rows: tuple[RecallRow, ...]
    members: Mapping[str, NDArray[np.bool_]]
    queries: tuple[QueryResult, ...]
    without_truth: tuple[str, ...]
    not_scored: tuple[str, ...]
    truth_known_by: str = ""
    pairs: Mapping[str, RelocalizationPair] = field(default_factory=dict)
    nowhere: tuple[QueryResult, ...] = ()
    covariance: Mapping[str, int] | None = None
    by_center: Evaluation | None = None
    context: ResultContext = field(default_factory=ResultContext)
    alignment: str = ""

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        return (self,)

    @property
    def has_truth(self) -> bool:
        return bool(self.thresholds)

    @property
    def errors(self) -> PoseErrors:
        return PoseErrors(
            tuple(query.name for query in self.queries),
            np.array([query.position_m for query in self.queries], np.float64),
            np.array([query.angle_deg for query in self.queries], np.float64),
        )

    @property
    def confidence(self) -> Confidence | None:
        return confidence_of(self.queries, from_fine_to_coarse(self.thresholds)[-1], self.nowhere)

    def rows_above(self, min_confidence: float) -> tuple[RecallRow, ...]:
        """Return recall rows that count poses below a confidence as misses.

        Empty if no pose has a confidence.
        """
        if all(query.confidence is None for query in self.queries):
            return ()
        doubtful = [
            query.confidence is not None and query.confidence < min_confidence
            for query in self.queries
        ]
        errors = self.errors
        errors.position_m[doubtful] = errors.angle_deg[doubtful] = np.inf
        return recall_rows(self.queries, errors, self.thresholds, self.members)

    def compare(self, *others: Evaluation) -> Comparison:
        """Test the differences from other results on the same queries."""
        from megloc_kapture.evaluation.comparison import compare

        return compare([self, *others])

    def row(self, name: str = "all") -> RecallRow:
        return {row.name: row for row in self.rows}[name]


def _query_columns(evaluation: Evaluation) -> dict[str, list[Any]]:
    columns = {
        name: [getattr(query, attribute) for query in evaluation.queries]
        for name, attribute in _COLUMNS.items()
        if evaluation.has_truth or "error" not in name
    }
    if all(confidence is None for confidence in columns["confidence"]):
        del columns["confidence"]
    if evaluation.by_center is not None:
        pairs, centers = evaluation.pairs, evaluation.by_center.queries
        columns["reference"] = [pairs[query.name].reference for query in evaluation.queries]
        columns["center_error_m"] = [query.position_m for query in centers]
    return columns


def evaluate_poses(
    result: Result,
    truth: Poses,
    benchmark: SideTables = NO_TABLES,
    *,
    nowhere: Collection[str] = (),
) -> Evaluation:
    """Return errors, outcomes and recall of a result.

    Every image of ``truth`` that the benchmark scores counts in the denominator of recall, with or
    without a pose. ``nowhere`` are images that show nothing of the map.
    """
    if both := set(nowhere).intersection(truth):
        raise DataError(
            f"{min(both)!r} has a true pose, but is listed as showing nothing of the map"
        )
    counted = tuple(sorted(benchmark.scored(truth)))
    require(
        counted,
        "no query with a true pose counts in this benchmark: is this the right ground truth?",
    )
    thresholds = thresholds_from_pairs(benchmark.protocol.thresholds)
    conditions = benchmark.conditions({*counted, *nowhere})
    errors = pose_errors(result.poses, truth, counted)
    queries = tuple(
        query_result(result, name, conditions, (position_m, angle_deg), truth[name])
        for name, position_m, angle_deg in zip(
            counted, errors.position_m.tolist(), errors.angle_deg.tolist(), strict=True
        )
    )
    members = row_members([query.condition for query in queries], benchmark.protocol)
    return Evaluation(
        label=result.label,
        thresholds=thresholds,
        rows=recall_rows(queries, errors, thresholds, members),
        members=members,
        queries=queries,
        covariance=_check_covariances(queries, result, truth),
        nowhere=tuple(
            query_result(result, name, conditions, (np.inf, np.inf)) for name in sorted(nowhere)
        ),
        without_truth=tuple(sorted(result.poses.keys() - truth.keys() - set(nowhere))),
        not_scored=tuple(sorted(truth.keys() - set(counted))),
        truth_known_by=benchmark.protocol.truth,
        context=result.context,
    )


def _check_covariances(
    queries: Sequence[QueryResult], result: Result, truth: Poses
) -> dict[str, int] | None:
    covariances = result.covariances
    names = [q.name for q in queries if q.outcome == "localized" and q.name in covariances]
    within = sum(
        squared_distance(truth[name], result.poses[name], covariances[name]) <= _CHI2_95
        for name in names
    )
    return {"num_poses": len(names), "num_within": within} if names else None


def recall_rows(
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
    result: Result,
    image: str,
    conditions: Mapping[str, str],
    errors: tuple[float, float],
    truth: RigidTransform | None = None,
) -> QueryResult:
    """Return the result of a query, given its errors in metres and degrees."""
    pose = result.poses.get(image)
    unknown = LocalizationResult(reason=NO_POSE if pose is None else "")
    status = result.statuses.get(image, unknown)
    outcome: Outcome = "fallback"
    reason = status.reason
    if pose is None:
        outcome = "missing"
        reason = reason or "the status is localized, but the result has no pose"
    elif status.fallback == "none":
        outcome, reason = "localized", ""
    known = {each.name: getattr(status, each.name) for each in fields(LocalizationResult)}
    known |= {"cam_from_world": pose, "reason": reason, "name": image}
    if pose is None:
        known["fallback"] = "none"
    return QueryResult(
        **known,
        image=image,
        condition=conditions.get(image, ""),
        outcome=outcome,
        position_m=errors[0],
        angle_deg=errors[1],
        truth=truth,
    )


def evaluate_pairs(
    result: Result, truth: Poses, benchmark: SideTables, references: Poses
) -> Evaluation:
    """Evaluate by MLAD's metric: every pair counts once.

    If there are several files, each is a condition. A pair is named after its query, or
    "QUERY from REFERENCE, FILE" if the query is in several pairs. Poses are ``cam_from_world`` in
    one frame, in metres. Position errors are those of the relative translation; ``by_center`` has
    those of the camera centre.
    """
    pairs, estimated = benchmark.relocalization, result.by_pair
    if estimated is None:
        estimated = {pair: result.poses[pair.query] for pair in pairs if pair.query in result.poses}
    absent = next((pair for pair in pairs if pair.reference not in references), None)
    if absent is not None:
        raise DataError(f"reference {absent.reference!r} of {absent.file!r} has no pose in the map")
    num_pairs = Counter(pair.query for pair in pairs)
    named = {
        p.query if num_pairs[p.query] == 1 else f"{p.query} from {p.reference}, {p.file}": p
        for p in pairs
    }
    require(len(named) == len(pairs), "a pair of reference and query is listed twice in one file")
    condition_of = _conditions({pair.file for pair in pairs})
    conditions = tuple(filter(None, dict.fromkeys(condition_of[pair.file] for pair in pairs)))
    by_center = evaluate_poses(
        replace(
            result,
            poses={n: estimated[p] for n, p in named.items() if p in estimated},
            statuses={
                n: result.statuses[p.query] for n, p in named.items() if p.query in result.statuses
            },
        ),
        {n: truth[p.query] for n, p in named.items() if p.query in truth},
        SideTables(
            protocol=benchmark.protocol.model_copy(update={"conditions": conditions, "pools": {}}),
            groups={n: ImageGroup(condition=condition_of[p.file]) for n, p in named.items()},
        ),
    )
    errors = by_center.errors
    posed = [named[name] for name, has in zip(errors.names, errors.has_pose, strict=True) if has]
    world_from_reference = invert(*stack_poses(references[pair.reference] for pair in posed))

    def translations(poses: Iterable[RigidTransform]) -> NDArray[np.float64]:
        """Return the translations of ``query_from_reference``, (N, 3)."""
        return compose(*stack_poses(poses), *world_from_reference)[1]

    shifts = translations(estimated[p] for p in posed) - translations(truth[p.query] for p in posed)
    position_m = np.full(len(errors.names), np.inf)
    position_m[errors.has_pose] = np.linalg.norm(shifts, axis=1)
    errors = replace(errors, position_m=position_m)
    queries = tuple(
        replace(
            query,
            position_m=error_m,
            image=named[query.name].query,
            candidates=query.candidates or (named[query.name].reference,),
        )
        for query, error_m in zip(by_center.queries, position_m.tolist(), strict=True)
    )
    return replace(
        by_center,
        queries=queries,
        rows=recall_rows(queries, errors, by_center.thresholds, by_center.members),
        without_truth=tuple(sorted(n for n, p in named.items() if p.query not in truth)),
        pairs={name: named[name] for name in errors.names},
        by_center=by_center,
    )


def _conditions(files: Collection[str]) -> dict[str, str]:
    if len(files) == 1:
        return dict.fromkeys(files, "")
    whole = {file: PurePosixPath(file).stem for file in files}
    short = {}
    for file, stem in whole.items():
        target = stem.rsplit("_to_", 1)[-1]
        for prefix in ("relocalizationFile_", "reloc_", "recording_"):
            target = target.removeprefix(prefix)
        short[file] = target
    return short if len(set(short.values())) == len(short) else whole
