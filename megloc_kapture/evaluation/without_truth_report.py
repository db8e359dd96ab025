"""The report about results whose truth is not known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from megloc_kapture.evaluation.figure_above import views_without_truth
from megloc_kapture.evaluation.figure_style import colors_of
from megloc_kapture.evaluation.gallery import exhibits
from megloc_kapture.evaluation.mask_pictures import mask_pictures
from megloc_kapture.evaluation.page import render_page
from megloc_kapture.evaluation.refined_poses import refined_poses
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.without_truth import WithoutTruth
from megloc_kapture.evaluation.worst_queries import doubtful_queries
from megloc_kapture.values import RigidTransform


def render_without_truth(
    found: WithoutTruth,
    *,
    map_poses: Mapping[str, RigidTransform] | None = None,
    provenance: Mapping[str, Any] | None = None,
    around: Sequence[Surroundings] = (),
) -> str:
    """The report's HTML; the same arguments give the same text.

    Parameters
    ----------
    map_poses, provenance : as in :func:`megloc_kapture.evaluation.report.render_report`.
    around : of each result; empty: no images are shown.
    """
    places = list(around) or [Surroundings()] * len(found.results)
    return render_page(
        "without_truth.html",
        provenance=provenance,
        found=found,
        title=" and ".join(result.label for result in found.results) or "Without truth",
        colors=colors_of([result.label for result in found.results]),
        views=[
            views_without_truth(result, map_poses or {}, place.frames, prefix=f"above{number}-")
            for number, (result, place) in enumerate(zip(found.results, places, strict=True))
        ],
        exhibits=[
            exhibits(doubtful_queries(result), place, map_poses or {})
            for result, place in zip(found.results, places, strict=True)
        ],
        refined=[
            refined_poses(place, result.poses)
            for result, place in zip(found.results, places, strict=True)
        ],
        masks=[mask_pictures(place.masked) for place in places],
    )
