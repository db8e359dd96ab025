"""The files of an evaluation: recall.json, recall.txt, per_query.csv, report.html."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from megloc_kapture.evaluation.evaluate import Evaluation, QueryResult
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.tables import criterion, notes, recall_table
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.json_model import write_json
from megloc_kapture.values import RigidTransform

RECALL_JSON = "recall.json"
RECALL_TEXT = "recall.txt"
PER_QUERY_CSV = "per_query.csv"
REPORT_HTML = "report.html"

PER_QUERY_COLUMNS = (
    "image",
    "condition",
    "outcome",
    "position_error_m",
    "angle_error_deg",
    "num_matches",
    "num_inliers",
    "reason",
)
# of MLAD's pairs, behind the others: the position error is the relative translation's
PAIR_COLUMNS = ("reference", "center_error_m")


def write_evaluation(
    folder: Path | str,
    evaluation: Evaluation,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Surroundings | None = None,
) -> dict[str, Path]:
    """Write the four files into ``folder``, each atomically; returns name -> path.

    Parameters
    ----------
    map_poses, provenance, around : see :func:`megloc_kapture.evaluation.report.render_report`.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    folder = Path(folder)
    names = (RECALL_JSON, RECALL_TEXT, PER_QUERY_CSV, REPORT_HTML)
    paths = {name: folder / name for name in names}
    # the report first: whatever is wrong with its data is found before anything is written
    # matplotlib loads with it, which other commands need not wait for
    from megloc_kapture.evaluation.report import render_report

    page = render_report(evaluation, map_poses=map_poses, provenance=provenance, around=around)
    write_json(paths[RECALL_JSON], recall_summary(evaluation))
    write_bytes(paths[RECALL_TEXT], recall_table(evaluation).encode("utf-8"))
    rows = [query_cells(query) for query in evaluation.queries]
    columns: tuple[str, ...] = PER_QUERY_COLUMNS
    by_center = evaluation.by_center
    if by_center is not None:
        columns += PAIR_COLUMNS
        rows = [
            (*row, evaluation.pairs[query.image].reference, number(query.position_m))
            for row, query in zip(rows, by_center.queries, strict=True)
        ]
    write_csv_table(paths[PER_QUERY_CSV], columns, rows)
    write_bytes(paths[REPORT_HTML], page.encode("utf-8"))
    return paths


def recall_summary(evaluation: Evaluation) -> dict[str, Any]:
    """What ``recall.json`` holds, as plain JSON data; an infinite median is null."""
    by_center = evaluation.by_center
    summary: dict[str, Any] = {
        "label": evaluation.label,
        "criterion": criterion(evaluation.thresholds, relative=by_center is not None),
        "thresholds": [threshold.model_dump(mode="json") for threshold in evaluation.thresholds],
        "rows": [row.model_dump(mode="json") for row in evaluation.rows],
        "notes": notes(evaluation),
        "without_truth": list(evaluation.without_truth),
        "not_scored": list(evaluation.not_scored),
    }
    if by_center is not None:
        summary["rows_by_center"] = [row.model_dump(mode="json") for row in by_center.rows]
    return summary


def query_cells(query: QueryResult) -> tuple[str, ...]:
    """One query as a row of ``PER_QUERY_COLUMNS``; errors without a pose are empty."""
    return (
        query.image,
        query.condition,
        query.outcome,
        number(query.position_m),
        number(query.angle_deg),
        "" if query.num_matches is None else str(query.num_matches),
        "" if query.num_inliers is None else str(query.num_inliers),
        query.reason,
    )


def number(value: float) -> str:
    """The shortest text that reads back to the same float64; infinite: empty."""
    return repr(float(value)) if math.isfinite(value) else ""
