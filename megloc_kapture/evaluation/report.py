"""The report about one result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from megloc_kapture.evaluation import figures, tables
from megloc_kapture.evaluation.evaluate import Evaluation, QueryResult
from megloc_kapture.evaluation.figure_above import views_of_evaluation
from megloc_kapture.evaluation.gallery import exhibits
from megloc_kapture.evaluation.mask_pictures import mask_pictures
from megloc_kapture.evaluation.page import render_page
from megloc_kapture.evaluation.recall import within
from megloc_kapture.evaluation.refined_poses import RefinedPoses, refined_poses
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.worst_queries import order_of_badness, worst_queries
from megloc_kapture.values import RigidTransform

# more rows than anybody reads; the CSV beside the report has them all
_MAX_ROWS = 500


@dataclass(frozen=True, slots=True)
class QueryRow:
    """One line of the table of queries, as text."""

    query: QueryResult
    position_m: str
    angle_deg: str
    center_m: str
    met: tuple[bool, ...]


def render_report(
    evaluation: Evaluation,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Surroundings | None = None,
) -> str:
    """The report's HTML; the same arguments give the same text.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above.
    provenance : options, preset, inputs: plain JSON data, shown at the end with the versions.
    around : where the images, masks and matches of queries are.
    """
    inliers = figures.errors_against_inliers(evaluation)
    rows = worst_first(evaluation)
    frames = {} if around is None else around.frames
    return render_page(
        "report.html",
        provenance=provenance,
        evaluation=evaluation,
        title=evaluation.label or "Evaluation",
        overall=evaluation.row(),
        relative=evaluation.by_center is not None,
        notes=tables.notes(evaluation),
        curves=Markup(figures.recall_curves(evaluation)),
        inliers=None if inliers is None else Markup(inliers),
        views=views_of_evaluation(evaluation, map_poses, frames),
        exhibits=exhibits(worst_queries(evaluation), around, map_poses or {}),
        refined=_refined(evaluation, around),
        masks=mask_pictures([] if around is None else around.masked),
        rows=rows[:_MAX_ROWS],
        num_hidden=max(len(rows) - _MAX_ROWS, 0),
        has_conditions=any(query.condition for query in evaluation.queries),
        has_status=any(query.num_inliers is not None for query in evaluation.queries),
    )


def _refined(evaluation: Evaluation, around: Surroundings | None) -> RefinedPoses:
    # a query that is called by its pair may be there several times
    if evaluation.pairs:
        return RefinedPoses()
    return refined_poses(around, evaluation.estimated, evaluation.truth, evaluation.thresholds)


def worst_first(evaluation: Evaluation) -> list[QueryRow]:
    """Rows of all queries: those without a pose first, then by falling error, then by name."""
    met = np.stack([within(evaluation.errors, t) for t in evaluation.thresholds], axis=1).tolist()
    by_center = (evaluation.by_center or evaluation).errors.position_m.tolist()
    rows = [
        QueryRow(
            query=query,
            position_m=tables.format_metres(query.position_m) if _posed(query) else "",
            angle_deg=tables.format_degrees(query.angle_deg) if _posed(query) else "",
            center_m=tables.format_metres(center_m) if _posed(query) else "",
            met=tuple(flags),
        )
        for query, flags, center_m in zip(evaluation.queries, met, by_center, strict=True)
    ]
    rows.sort(key=lambda row: order_of_badness(row.query))
    return rows


def _posed(query: QueryResult) -> bool:
    return math.isfinite(query.position_m)
