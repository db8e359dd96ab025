"""The files of an evaluation: recall.json, recall.txt, per_query.csv, report.html."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from megloc_kapture.evaluation.evaluate import Evaluation, QueryResult
from megloc_kapture.evaluation.report import render_report
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


def write_evaluation(
    folder: Path | str,
    evaluation: Evaluation,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Write the four files into ``folder``, each atomically; returns name -> path.

    Parameters
    ----------
    map_poses, provenance : see :func:`megloc_kapture.evaluation.report.render_report`.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    folder = Path(folder)
    names = (RECALL_JSON, RECALL_TEXT, PER_QUERY_CSV, REPORT_HTML)
    paths = {name: folder / name for name in names}
    # the report first: whatever is wrong with its data is found before anything is written
    page = render_report(evaluation, map_poses=map_poses, provenance=provenance)
    write_json(paths[RECALL_JSON], recall_summary(evaluation))
    write_bytes(paths[RECALL_TEXT], recall_table(evaluation).encode("utf-8"))
    write_csv_table(
        paths[PER_QUERY_CSV], PER_QUERY_COLUMNS, map(_per_query_row, evaluation.queries)
    )
    write_bytes(paths[REPORT_HTML], page.encode("utf-8"))
    return paths


def recall_summary(evaluation: Evaluation) -> dict[str, Any]:
    """What ``recall.json`` holds, as plain JSON data; an infinite median is null."""
    return {
        "label": evaluation.label,
        "criterion": criterion(evaluation.thresholds),
        "thresholds": [threshold.model_dump(mode="json") for threshold in evaluation.thresholds],
        "rows": [row.model_dump(mode="json") for row in evaluation.rows],
        "notes": notes(evaluation),
        "without_truth": list(evaluation.without_truth),
        "not_scored": list(evaluation.not_scored),
    }


def _per_query_row(query: QueryResult) -> tuple[str, ...]:
    posed = math.isfinite(query.position_m)
    return (
        query.image,
        query.condition,
        query.outcome,
        repr(query.position_m) if posed else "",
        repr(query.angle_deg) if posed else "",
        "" if query.num_matches is None else str(query.num_matches),
        "" if query.num_inliers is None else str(query.num_inliers),
        query.reason,
    )
