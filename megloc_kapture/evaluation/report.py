"""One self-contained HTML page about one result: no script, no link to the outside, no date."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from megloc_kapture.evaluation import figures, tables
from megloc_kapture.evaluation.evaluate import Evaluation, QueryResult
from megloc_kapture.evaluation.provenance import package_versions
from megloc_kapture.evaluation.recall import within
from megloc_kapture.values import RigidTransform

# more rows than anybody reads; the CSV beside the report has them all
_MAX_ROWS = 500


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of the table of queries, as text."""

    query: QueryResult
    position_m: str
    angle_deg: str
    met: tuple[bool, ...]


def render_report(
    evaluation: Evaluation,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> str:
    """The report's HTML; the same arguments give the same text.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above.
    provenance : options, preset, inputs: plain JSON data, shown at the end with the versions.
    """
    above, num_outside = figures.map_from_above(evaluation, map_poses)
    inliers = figures.errors_against_inliers(evaluation)
    rows = worst_first(evaluation)
    environment = Environment(
        loader=PackageLoader("megloc_kapture.evaluation"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("report.html").render(
        evaluation=evaluation,
        title=evaluation.label or "Evaluation",
        overall=evaluation.row(),
        criterion=tables.criterion(evaluation.thresholds),
        notes=tables.notes(evaluation),
        format=tables,
        infinity=math.inf,
        curves=Markup(figures.recall_curves(evaluation)),
        inliers=None if inliers is None else Markup(inliers),
        above=Markup(above),
        num_outside=num_outside,
        rows=rows[:_MAX_ROWS],
        num_hidden=max(len(rows) - _MAX_ROWS, 0),
        has_conditions=any(query.condition for query in evaluation.queries),
        has_status=any(query.num_inliers is not None for query in evaluation.queries),
        versions=package_versions(),
        provenance=json.dumps(dict(provenance), indent=2, ensure_ascii=False) if provenance else "",
    )


def worst_first(evaluation: Evaluation) -> list[_Row]:
    """Rows of all queries: those without a pose first, then by falling error, then by name."""
    met = np.stack([within(evaluation.errors, t) for t in evaluation.thresholds], axis=1).tolist()
    rows = [
        _Row(
            query=query,
            position_m=tables.format_metres(query.position_m) if _posed(query) else "",
            angle_deg=tables.format_degrees(query.angle_deg) if _posed(query) else "",
            met=tuple(flags),
        )
        for query, flags in zip(evaluation.queries, met, strict=True)
    ]
    rows.sort(key=lambda row: (-row.query.position_m, -row.query.angle_deg, row.query.image))
    return rows


def _posed(query: QueryResult) -> bool:
    return math.isfinite(query.position_m)
