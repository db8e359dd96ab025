"""The report about several results: a comparison, or the runs of one method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from megloc_kapture.evaluation import figures, tables
from megloc_kapture.evaluation.comparison import Comparison
from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.figure_above import AboveView, views_of_evaluation
from megloc_kapture.evaluation.figure_style import colors_of
from megloc_kapture.evaluation.gallery import Exhibit, Gallery
from megloc_kapture.evaluation.page import render_page
from megloc_kapture.evaluation.seeds import Seeds
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.worst_queries import disputed_queries
from megloc_kapture.values import RigidTransform

Poses = Mapping[str, RigidTransform]


@dataclass(frozen=True, slots=True)
class ResultSection:
    """What the page says of one of the results alone."""

    label: str
    color: str
    notes: list[str]
    views: list[AboveView]
    inliers: Markup | None


def render_comparison(
    comparison: Comparison,
    *,
    map_poses: Poses | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> str:
    """The page about results that are compared; the same arguments give the same text.

    Parameters
    ----------
    map_poses, provenance : as in :func:`megloc_kapture.evaluation.report.render_report`.
    around : of each result; empty: no images are shown.
    """
    return render_page(
        "comparison.html",
        provenance=provenance,
        title=" and ".join(evaluation.label for evaluation in comparison.evaluations),
        comparison=comparison,
        seeds=None,
        **_common(comparison.evaluations, map_poses or {}, around),
    )


def render_seeds(
    seeds: Seeds,
    *,
    map_poses: Poses | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> str:
    """The page about runs of one method; see :func:`render_comparison`."""
    return render_page(
        "comparison.html",
        provenance=provenance,
        title=f"{len(seeds.evaluations)} runs of one method",
        comparison=None,
        seeds=seeds,
        **_common(seeds.evaluations, map_poses or {}, around),
    )


def _common(
    evaluations: Sequence[Evaluation], map_poses: Poses, around: Sequence[Surroundings]
) -> dict[str, Any]:
    colors = colors_of([evaluation.label for evaluation in evaluations])
    places = list(around) or [Surroundings()] * len(evaluations)
    by_row = figures.curves_by_row(evaluations)
    sections = []
    for number, (evaluation, place) in enumerate(zip(evaluations, places, strict=True)):
        inliers = figures.errors_against_inliers(evaluation, prefix=f"inliers{number}")
        views = views_of_evaluation(evaluation, map_poses, place.frames, prefix=f"above{number}-")
        sections.append(
            ResultSection(
                evaluation.label,
                colors[evaluation.label],
                tables.notes(evaluation),
                views,
                None if inliers is None else Markup(inliers),
            )
        )
    return {
        "evaluations": evaluations,
        "thresholds": evaluations[0].thresholds,
        "colors": colors,
        "relative": evaluations[0].by_center is not None,
        "intervals": Markup(figures.recall_intervals(evaluations)),
        "curves": Markup(figures.compared_curves(evaluations)),
        "by_row": None if by_row is None else Markup(by_row),
        "sections": sections,
        "exhibits": _exhibits(evaluations, map_poses, places),
        "rows": list(zip(*(evaluation.rows for evaluation in evaluations), strict=True)),
    }


def _exhibits(
    evaluations: Sequence[Evaluation], map_poses: Poses, around: Sequence[Surroundings]
) -> list[Exhibit]:
    galleries = [Gallery(place, map_poses) for place in around]
    return [galleries[worst].exhibit(chosen) for worst, chosen in disputed_queries(evaluations)]
