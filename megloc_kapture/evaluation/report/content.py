"""Numbers, sentences and tables of reports; recall as in papers: ``89.8 / 96.1 / 99.4``."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from megloc_kapture.evaluation.comparison import (
    NUM_RESAMPLES,
    SIGNIFICANCE,
    AgreementRow,
    Comparison,
    MedianDifference,
    PairedTest,
    inliers_quartiles,
)
from megloc_kapture.evaluation.metrics import (
    Confidence,
    RecallAt,
    RecallRow,
    Threshold,
    pose_errors,
)
from megloc_kapture.evaluation.scoring import NO_POSE, Evaluation, QueryResult
from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.values import MIN_CONFIDENCE, PoseRefinement

if TYPE_CHECKING:
    from pandas import DataFrame


INTERVALS = "95 % confidence intervals of recall, queries assumed independent (%)"
CONFIDENT = f"Recall if poses with a confidence below {MIN_CONFIDENCE:g} are misses (%)"
# the recall of fewer queries is an example, not a measurement
FEW = 10
_NAMES_SHOWN = 5
_FALLBACK_POSES = {
    "retrieval": "of the best retrieved image",
    "rig": "derived from another camera of the rig",
}
_MAX_WIDTH = 30
_REASONS_SHOWN = 3
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


def format_percent(share: float) -> str:
    return f"{100.0 * share:.1f}"


def format_metres(position_m: float) -> str:
    return f"{position_m:.4f}" if position_m < 1 else f"{position_m:.2f}"


def format_degrees(angle_deg: float) -> str:
    return f"{angle_deg:.3f}" if angle_deg < 1 else f"{angle_deg:.2f}"


def format_median(position_m: float, angle_deg: float) -> str:
    if not math.isfinite(position_m):
        return "inf"
    return f"{format_metres(position_m)}, {format_degrees(angle_deg)}"


def counted(number: int, noun: str, plural: str = "") -> str:
    regular = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else plural or regular}"


def bounds(thresholds: Sequence[Threshold]) -> str:
    return " / ".join(str(threshold) for threshold in thresholds)


def criterion(evaluation: Evaluation) -> str:
    """Return the rule by which recall is counted."""
    with_angles = any(threshold.angle_deg is not None for threshold in evaluation.thresholds)
    errors = "Both errors" if with_angles else "Position error"
    if evaluation.by_center is not None:
        errors = "Errors of the rotation and" if with_angles else "Error"
        errors += " of the translation relative to the given reference"
    return f"{errors} at or below (<=) the threshold; a query without a pose counts as a miss."


def notes(evaluation: Evaluation) -> list[str]:
    row = evaluation.row()
    sentences = [evaluation.alignment] if evaluation.alignment else []
    if row.num_queries < FEW:
        sentences.append(
            f"too few queries ({row.num_queries}) to compare recall: the intervals are wide"
        )
    kinds = {query.fallback for query in evaluation.queries} - {"none"}
    if row.num_fallback:
        whose = " or the one ".join(_FALLBACK_POSES[kind] for kind in sorted(kinds))
        without = counted(row.num_fallback, "query")
        sentences.append(
            f"{without} could not be localized and got the pose {whose} instead; recall and the "
            "median over all queries include these poses"
        )
    if row.num_missing == row.num_queries:
        sentences.append("no query has a pose")
    elif absent := [q.name for q in evaluation.queries if q.reason == NO_POSE]:
        lack = counted(len(absent), "query has", "queries have")
        sentences.append(
            f"{lack} no pose in the result: {_first(absent)}; if these are map images, give true "
            "poses of the queries alone"
        )
    if equal := [q.name for q in evaluation.queries if q.truth and q.truth == q.cam_from_world]:
        have = counted(len(equal), "pose equals", "poses equal")
        sentences.append(
            f"{have} the true pose to the last digit: {_first(equal)}; if these are map images, "
            "give true poses of the queries alone"
        )
    missing = evaluation.without_truth
    if missing:
        lack = counted(
            len(missing), "image has no true pose and is", "images have no true pose and are"
        )
        sentences.append(f"{lack} not counted: {_first(missing)}")
        if evaluation.truth_known_by:
            sentences.append(evaluation.truth_known_by.rstrip("."))
        if row.num_missing == row.num_queries:
            sentences.append("no estimated image is in the ground truth; the names may not agree")
    if number := len(evaluation.not_scored):
        ignored = counted(number, "image with a true pose is", "images with a true pose are")
        sentences.append(f"{ignored} not scored by this benchmark")
    return sentences


def _first(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMES_SHOWN]) + (", ..." if names[_NAMES_SHOWN:] else "")


def confidence_sentences(confidence: Confidence, coarsest: Threshold) -> list[str]:
    sentences = []
    if confidence.num_poses:
        share = format_percent(confidence.num_wrong / confidence.num_poses)
        interval = f"{100 * confidence.wrong_low:.1f}-{100 * confidence.wrong_high:.1f}"
        sentences.append(
            f"{counted(confidence.num_poses, 'pose')} with a confidence, {confidence.num_wrong} of "
            f"them wrong (beyond {coarsest}): {share} % ({interval})"
        )
    if confidence.num_wrong:
        by_inliers = confidence.area_by_inliers
        than = "" if by_inliers is None else f" ({by_inliers:.4f} if ranked by inliers)"
        sentences.append(
            f"calibration error {confidence.calibration_error:.3f}; area under the "
            f"risk-coverage curve {confidence.area:.4f}{than}, at best {confidence.least_area:.4f}"
        )
    if confidence.num_nowhere:
        sentences.append(
            f"{counted(confidence.num_nowhere, 'query shows', 'queries show')} nothing of the map: "
            f"{confidence.num_nowhere_refused} not localized, "
            f"{confidence.num_nowhere - confidence.num_nowhere_refused} localized wrongly"
        )
    return sentences


def consistency_sentence(row: ConsistencyRow) -> str:
    frame = f" in {row.frame}" if row.frame else ""
    if row.reason:
        return f"{row.method}{frame} is not used: {row.reason}"
    return (
        f"{row.method}{frame} is used; {row.images} held-out map images move by "
        f"{format_movement(row.moved_m, row.turned_deg)}, {row.moved_px:.1f} px (medians; "
        f"estimated accuracy {format_movement(row.claimed_m, row.claimed_deg)})"
    )


def format_movement(metres: float, degrees: float) -> str:
    return f"{format_metres(metres)} m, {format_degrees(degrees)} deg"


def agreement_sentence(row: AgreementRow) -> str:
    if not row.num_only_first and not row.num_only_second:
        return "The same queries have a pose in both results."
    return (
        f"Only {row.first} has a pose for {counted(row.num_only_first, 'query')}, "
        f"only {row.second} for {row.num_only_second}."
    )


def threshold_sentence(test: PairedTest) -> str:
    first, second, where = test.first, test.second, f"At {test.threshold},"
    only_first, only_second = len(test.only_first), len(test.only_second)
    if not only_first and not only_second:
        if not test.both:
            return f"{where} neither {first} nor {second} localizes any query."
        return f"{where} {first} and {second} localize the same {_queries(test.both)}."
    return (
        f"{where} {first} localizes {_queries(only_first)} that {second} misses and {second} "
        f"localizes {only_second or 'none'} that {first} misses: {_verdict(test)}."
    )


def median_sentence(difference: MedianDifference) -> str:
    medians = {difference.first: difference.first_m, difference.second: difference.second_m}
    lost = [label for label, value in medians.items() if math.isinf(value)]
    if lost:
        return (
            f"At least half of the queries of {' and of '.join(lost)} have no pose, so there is no "
            "median."
        )
    both = (
        "The median position error is "
        + " and ".join(f"{format_metres(value)} m for {name}" for name, value in medians.items())
        + f": {_signed(difference.first_m - difference.second_m)} m"
    )
    if math.isnan(difference.low_m):
        return f"{both}; too few queries to tell it from chance."
    verdict = "the difference is real" if difference.is_real else "the difference could be chance"
    interval = f"{_signed(difference.low_m)} to {_signed(difference.high_m)}"
    return f"{both}, 95 % interval {interval} m; {verdict}."


def comparison_sentences(comparison: Comparison) -> list[str]:
    tests = [threshold_sentence(test) for test in comparison.tests]
    return tests + [median_sentence(median) for median in comparison.medians]


def method_sentence(comparison: Comparison) -> str:
    number = len(comparison.tests)
    holm = f", after Holm's correction for {number} tests" if number > 1 else ""
    return (
        'Exact McNemar test on the same queries, assumed independent, two-sided; "real": p at '
        f"or below {SIGNIFICANCE:g}{holm}. Intervals of medians: {NUM_RESAMPLES} resamples of the "
        "queries."
    )


def _verdict(test: PairedTest) -> str:
    p = "p < 0.001" if test.p_adjusted < 0.001 else f"p = {test.p_adjusted:.2g}"
    if test.is_real:
        return f"the difference is real ({p})"
    # even the most uneven split of so few queries would not be significant
    if 2.0 * 0.5 ** (len(test.only_first) + len(test.only_second)) > SIGNIFICANCE:
        return f"too few queries differ to tell it from chance ({p})"
    return f"the difference could be chance ({p})"


def _queries(number: int) -> str:
    return "no query" if number == 0 else counted(number, "query")


def _signed(metres: float) -> str:
    if math.isinf(metres):
        return "-inf" if metres < 0 else "+inf"
    return f"{'-' if metres < 0 else '+'}{format_metres(abs(metres))}"


def recall_table(evaluations: Sequence[Evaluation]) -> DataFrame:
    """Return recall and medians, one row per condition and result."""
    return _frame(
        {
            **label,
            "queries": row.num_queries,
            "localized": _localized(row),
            "recall (%)": _joined(row.recall),
            "median (m, deg)": format_median(row.median_position_m, row.median_angle_deg),
            "median of localized": format_median(
                row.median_localized_position_m, row.median_localized_angle_deg
            )
            if row.num_localized
            else "-",
        }
        for label, row in _rows(evaluations)
    )


def interval_table(evaluations: Sequence[Evaluation]) -> DataFrame:
    """Return the confidence intervals of recall, one column per threshold."""
    return _frame(
        label
        | {
            str(at.threshold): f"{format_percent(at.low)}-{format_percent(at.high)}"
            for at in row.recall
        }
        for label, row in _rows(evaluations)
    )


def _rows(evaluations: Sequence[Evaluation]) -> Iterator[tuple[dict[str, str], RecallRow]]:
    for group in zip(*(evaluation.rows for evaluation in evaluations), strict=True):
        for evaluation, row in zip(evaluations, group, strict=True):
            result = {"result": _shortened(evaluation.label)} if evaluations[1:] else {}
            yield {**_condition(row.name), **result}, row


def confident_table(evaluation: Evaluation) -> DataFrame | None:
    """Return recall with poses of low confidence as misses; None without confidences."""
    rows = [
        {
            **_condition(row.name),
            "queries": row.num_queries,
            "accepted": row.num_localized,
            "recall (%)": _joined(row.recall),
        }
        for row in evaluation.rows_above(MIN_CONFIDENCE)
    ]
    return _frame(rows) if rows else None


def result_table(evaluation: Evaluation) -> DataFrame:
    """Return the share of localized queries, and their inliers, of a result without truth."""

    def inliers(name: str) -> str:
        quartiles = inliers_quartiles(evaluation, name)
        return " / ".join(f"{value:.0f}" for value in quartiles or ()) or "-"

    return _frame(
        {
            **_condition(row.name),
            "queries": row.num_queries,
            "localized": _localized(row),
            "%": format_percent(row.num_localized / max(row.num_queries, 1)),
            "inliers, quartiles": inliers(row.name),
        }
        for row in evaluation.rows
    )


def agreement_table(rows: Iterable[AgreementRow]) -> DataFrame:
    """Return the share of queries whose poses in two results agree."""
    return _frame(
        {
            "first": _shortened(row.first),
            "second": _shortened(row.second),
            **_condition(row.name),
            "queries": row.num_queries,
            "both have a pose": row.num_both,
            "agree (%)": _joined(row.within),
            "median (m, deg)": format_median(row.median_m, row.median_deg).replace("inf", "-"),
        }
        for row in rows
    )


def query_table(evaluation: Evaluation, queries: Sequence[QueryResult]) -> DataFrame:
    """Return one row per query, without columns that are empty."""
    centers = evaluation.by_center
    of_center = {} if centers is None else {q.name: q.position_m for q in centers.queries}

    def number(value: float | None, form: Any) -> str:
        return form(value) if value is not None and np.isfinite(value) else ""

    frame = _frame(
        {
            "image": query.name,
            "condition": query.condition,
            "outcome": query.outcome,
            "position (m)" if centers is None else "relative (m)": number(
                query.position_m, format_metres
            ),
            "centre (m)": number(of_center.get(query.name), format_metres),
            "angle (deg)": number(query.angle_deg, format_degrees),
            "inliers": number(query.num_inliers, str),
            "matches": number(query.num_matches, str),
            "confidence": number(query.confidence, "{:.2f}".format),
            "reason": query.reason,
        }
        for query in queries
    )
    return frame.loc[:, (frame != "").any()]


def refinement_table(evaluation: Evaluation) -> DataFrame | None:
    """Summarize pose refinement, one row per method; None if nothing was refined."""
    estimated = {q.name for q in evaluation.queries if q.cam_from_world is not None}
    truth = {q.name: q.truth for q in evaluation.queries if q.truth is not None}
    by_method: dict[str, list[tuple[str, PoseRefinement]]] = {}
    for image, steps in sorted(evaluation.context.refinements.items()):
        if image in estimated:
            for step in steps:
                by_method.setdefault(step.method, []).append((image, step))
    table = []
    for method, refined in by_method.items():
        accepted = [(image, step) for image, step in refined if step.accepted]
        reasons = Counter(_NUMBER.sub("…", step.reason) for _, step in refined if step.reason)
        listed = (f"{count} x {reason}" for reason, count in reasons.most_common(_REASONS_SHOWN))
        moved = [(step.moved_m, step.turned_deg) for _, step in accepted]
        line: dict[str, Any] = {"step": method, "queries": len(refined), "accepted": len(accepted)}
        line |= {"moved by (median)": _medians(moved)}
        if truth:
            names = [image for image, _ in accepted if image in truth]
            old = {image: step.before for image, step in accepted if step.before is not None}
            new = {image: step.cam_from_world for image, step in accepted}
            for heading, poses in (("error before", old), ("error after", new)):
                errors = pose_errors(poses, truth, names)
                line[heading] = _medians(zip(errors.position_m, errors.angle_deg, strict=True))
        table.append({**line, "reasons for rejection": "; ".join(listed)})
    return _frame(table) if table else None


def as_text(frame: DataFrame) -> str:
    """Format a table with left-aligned columns, two spaces apart."""
    cells = frame.astype(str)
    form: dict[Any, Any] = {
        name: f"{{:<{max([len(str(name)), *column.str.len()]) + 1}}}".format
        for name, column in cells.items()
    }
    text = cells.to_string(index=False, justify="left", formatters=form)
    return "\n".join(line.rstrip() for line in text.split("\n"))


def _frame(rows: Iterable[dict[str, Any]]) -> DataFrame:
    import pandas as pd  # slow import

    return pd.DataFrame(list(rows))


def _condition(name: str) -> dict[str, str]:
    return {"condition": _shortened(name or "(no condition)")}


def _localized(row: RecallRow) -> str:
    guessed = f" (+{row.num_fallback})" if row.num_fallback else ""
    return f"{row.num_localized}{guessed}"


def _joined(recall: Sequence[RecallAt]) -> str:
    return " / ".join(format_percent(at.recall) for at in recall)


def _medians(pairs: Iterable[tuple[float, float]]) -> str:
    values = np.array(list(pairs))
    return format_movement(*np.median(values, axis=0).tolist()) if len(values) else ""


def _shortened(name: str) -> str:
    half = (_MAX_WIDTH - 3) // 2
    return name if len(name) <= _MAX_WIDTH else f"{name[:half]}...{name[-half:]}"
