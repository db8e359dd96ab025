"""Tables of reports as data frames, and their text."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from megloc_kapture.evaluation.metrics import RecallAt, RecallRow, pose_errors
from megloc_kapture.evaluation.report.wording import (
    format_degrees,
    format_interval,
    format_median,
    format_metres,
    format_movement,
    format_percent,
)
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.without_truth import (
    AgreementRow,
    WithoutTruth,
    inliers_quartiles,
)
from megloc_kapture.values import MIN_CONFIDENCE

if TYPE_CHECKING:
    from pandas import DataFrame

    from megloc_kapture.evaluation.report.queries import ShownQuery

_MAX_WIDTH = 30
_REASONS_SHOWN = 3
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


def recall_table(evaluations: Sequence[Evaluation]) -> DataFrame:
    """Return recall and medians; several results are below each other in each condition."""
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
        {**label, **{str(at.threshold): format_interval(at) for at in row.recall}}
        for label, row in _rows(evaluations)
    )


def _rows(evaluations: Sequence[Evaluation]) -> Iterator[tuple[dict[str, str], RecallRow]]:
    for group in zip(*(evaluation.rows for evaluation in evaluations), strict=True):
        for evaluation, row in zip(evaluations, group, strict=True):
            result = {"result": _shortened(evaluation.label)} if evaluations[1:] else {}
            yield {**_condition(row.name), **result}, row


def confident_table(evaluation: Evaluation) -> DataFrame | None:
    """Return recall that counts doubtful poses as misses; None without confidences."""
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
    """Return localized share and inliers of a result without truth."""

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


def agreement_table(found: WithoutTruth, rows: Iterable[AgreementRow]) -> DataFrame:
    """Return the share of queries whose poses in two results agree."""
    return _frame(
        {
            "first": _shortened(found.evaluations[row.first].label),
            "second": _shortened(found.evaluations[row.second].label),
            **_condition(row.name),
            "queries": row.num_queries,
            "both have a pose": row.num_both,
            "agree (%)": _joined(row.within),
            "median (m, deg)": format_median(row.median_m, row.median_deg).replace("inf", "-"),
        }
        for row in rows
    )


def query_table(evaluation: Evaluation, queries: Sequence[ShownQuery]) -> DataFrame:
    """Return one row per query, without columns that are empty."""
    centers = evaluation.by_center
    of_center = {} if centers is None else {q.image: q.position_m for q in centers.queries}

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
    """Return the steps of pose refinement over all queries; None if nothing was refined."""
    estimated, truth = evaluation.estimated, evaluation.truth
    steps: dict[str, list[tuple[Any, Any]]] = {}
    for image, rows in sorted(evaluation.context.refinements.items()):
        if image in estimated:
            # each step ends with the pose that the next begins with
            ends = [*(row.before for row in rows[1:]), estimated[image]]
            for row, after in zip(rows, ends, strict=True):
                steps.setdefault(row.method, []).append((row, after))
    table = []
    for method, refined in steps.items():
        accepted = [(row, after) for row, after in refined if row.accepted]
        reasons = Counter(_NUMBER.sub("…", row.reason) for row, _ in refined if not row.accepted)
        listed = (f"{count} x {reason}" for reason, count in reasons.most_common(_REASONS_SHOWN))
        moved = [(row.moved_m, row.turned_deg) for row, _ in accepted]
        line: dict[str, Any] = {"step": method, "queries": len(refined), "accepted": len(accepted)}
        line |= {"moved by (median)": _medians(moved)}
        if truth:
            names = [row.image for row, _ in accepted if row.image in truth]
            old, new = {r.image: r.before for r, _ in accepted}, {r.image: p for r, p in accepted}
            for heading, poses in (("error before", old), ("error after", new)):
                errors = pose_errors(poses, truth, names)
                line[heading] = _medians(zip(errors.position_m, errors.angle_deg, strict=True))
        table.append({**line, "why other poses stay": "; ".join(listed)})
    return _frame(table) if table else None


def as_text(frame: DataFrame) -> str:
    """Format a table with left-aligned columns, two blanks apart."""
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
