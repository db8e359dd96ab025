"""What the places a query may be at show of it: map images brought to each place's pose."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pictures import Picture, data_picture
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.io.cluster_table import ClusterRow

_SHOWN = 2
_NOTHING = 255  # grey level of what no map image shows


@dataclass(frozen=True)
class AlignedView:
    """A place's images, warped to its pose of the query.

    Attributes
    ----------
    row : the cluster in ``clusters.csv``.
    share : of the pixels that are shown, 0 to 1.
    """

    row: ClusterRow
    picture: Picture
    share: float


def best_first(rows: Sequence[ClusterRow]) -> list[ClusterRow]:
    """Clusters with a pose: the chosen one, then by score."""
    posed = [row for row in rows if row.cam_from_world is not None and row.score is not None]
    return sorted(posed, key=lambda row: (row.chosen != "yes", -(row.score or 0.0), row.cluster))


def aligned_views(around: Surroundings, query: str) -> list[AlignedView]:
    """The best two places of a query; nothing where there is one, or the map has no depth."""
    rows = best_first(around.clusters.get(query, ()))
    if len(rows) < 2 or around.mapping is None or around.queries is None:
        return []
    # only a report with such pictures waits for what warps them
    from megloc_kapture.stages.perceptual_ranking import aligned_view
    from megloc_kapture.stages.ranking_scene import KaptureScene

    found = []
    # a report without these pictures is better than none
    with contextlib.suppress(DataError):
        scene = KaptureScene(around.mapping, around.queries)
        camera = around.queries.read().camera_of(query)
        for row in rows[:_SHOWN]:
            if row.cam_from_world is None:
                continue
            view = aligned_view(camera, row.cam_from_world, row.images, scene)
            share = float(view.valid.mean())
            if share > 0:
                found.append(
                    AlignedView(row, _picture(view.image, view.valid, camera.width), share)
                )
    return found


def _picture(image: NDArray[np.uint8], valid: NDArray[np.bool_], full_width: int) -> Picture:
    shown = np.where(valid[..., None], image, np.uint8(_NOTHING)).astype(np.uint8)
    return data_picture(shown, shown.shape[1] / full_width)
