"""Which map images are right for a query of Aachen's twin, and how many of them a ranking finds."""

from __future__ import annotations

import numpy as np
from megloc_twins.aachen import AachenTwinOptions, build_aachen_frames
from megloc_twins.frames import Frame
from megloc_twins.squares import build_place
from megloc_twins.viewpoints import CoarseView, coarse_view, overlap
from numpy.typing import NDArray

MIN_OVERLAP = 0.3  # share of the surface points of the query that a right image sees


def twin_overlaps(
    queries: list[str], images: list[str], options: AachenTwinOptions | None = None
) -> NDArray[np.float64]:
    """Share (Q, M) of what each query sees that each image sees too, by the exact geometry.

    Both may be any images of the twin. Images of different places share nothing.
    """
    options = options or AachenTwinOptions()
    shots = build_aachen_frames(options)
    named = {shot.name: shot for shot in (*shots.mapping(), *shots.queries())}
    world = options.world()
    surfaces = [
        build_place(world, index).surfaces_in_world() for index in range(options.num_places)
    ]
    views: dict[str, CoarseView] = {}

    def view(shot: Frame) -> CoarseView:
        if shot.name not in views:
            views[shot.name] = coarse_view(surfaces[shot.place], shot.camera, shot.cam_from_world)
        return views[shot.name]

    shares = np.zeros((len(queries), len(images)))
    for row, query in zip(shares, queries, strict=True):
        for column, image in enumerate(images):
            if named[query].place == named[image].place:
                row[column] = overlap(view(named[query]), view(named[image]))
    return shares


def recalls(
    similarities: NDArray[np.floating], right: NDArray[np.bool_], counts: tuple[int, ...]
) -> list[tuple[float, float]]:
    """For each N, in percent: queries with a right image among their first N; and of the right
    images that fit into the first N the share that is there, mean over the queries.

    Queries without a right image are left out.
    """
    asked = right.any(axis=1)
    order = np.argsort(-similarities[asked], axis=1, kind="stable")
    found = np.take_along_axis(right[asked], order, axis=1)
    possible = right[asked].sum(axis=1)
    rows = []
    for count in counts:
        hits = found[:, :count].sum(axis=1)
        share = hits / np.minimum(possible, count)
        rows.append((100.0 * float((hits > 0).mean()), 100.0 * float(share.mean())))
    return rows
