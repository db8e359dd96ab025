"""Refined queries in tiles with what map images show at their poses, before and after."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pictures import data_picture, image_tag
from megloc_kapture.evaluation.pose_errors import pose_errors
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.tables import format_degrees, format_metres
from megloc_kapture.plugins import RankingScene
from megloc_kapture.values import Camera, RefinementRow, RigidTransform

if TYPE_CHECKING:
    from megloc_kapture.geometry.warping import WarpSource

Poses = Mapping[str, RigidTransform]

_SHOWN = 4
_LONG_SIDE_PX = 420
_TILES = 8  # along the longer side of a picture
_LEAST_SHOWN = 0.2  # share of a query's pixels that map images must show


@dataclass(frozen=True)
class RefinedView:
    """A query in tiles with what map images show at its pose, before and after.

    Attributes
    ----------
    facts : what each step did.
    panels : before, after: a picture and what stands below it.
    """

    query: str
    facts: tuple[str, ...]
    panels: tuple[tuple[Markup, str], ...]


def refined_views(
    around: Surroundings,
    refinements: Mapping[str, Sequence[RefinementRow]],
    estimated: Poses,
    truth: Poses,
) -> list[RefinedView]:
    """Of the queries with a new pose those that moved most; none where the map has no depth.

    Parameters
    ----------
    refinements : rows of each query, in the order of the steps.
    estimated : the poses after all of them.
    """
    if around.mapping is None or around.queries is None:
        return []
    # only a report with such pictures waits for what warps them
    from megloc_kapture.stages.perceptual_ranking import warp_source
    from megloc_kapture.stages.ranking_scene import KaptureScene

    refined = [i for i, rows in refinements.items() if any(row.accepted for row in rows)]
    found: list[RefinedView] = []
    # a report without these pictures is better than none
    with contextlib.suppress(DataError):
        scene = KaptureScene(around.mapping, around.queries)
        for image in sorted(refined, key=lambda name: (-_moved_m(refinements[name]), name)):
            poses = {"before": refinements[image][0].before, "after": estimated[image]}
            places = [row.images for row in around.clusters.get(image, ()) if row.chosen == "yes"]
            if not places:
                continue
            camera = around.queries.read().camera_of(image)
            # both pictures show the same map images, or nearly
            read = cache(partial(warp_source, scene=scene))
            pictures = [
                _picture(camera, pose, places[0], scene, read, (image, step))
                for step, pose in poses.items()
            ]
            if not all(pictures):
                continue
            captions = [step + _error(pose, image, truth) for step, pose in poses.items()]
            panels = tuple(zip(pictures, captions, strict=True))
            found.append(RefinedView(image, _facts(refinements[image]), panels))
            if len(found) == _SHOWN:
                break
    return found


def _moved_m(rows: Sequence[RefinementRow]) -> float:
    return sum(row.moved_m for row in rows)


def _picture(
    camera: Camera,
    pose: RigidTransform,
    images: Sequence[str],
    scene: RankingScene,
    read: Callable[[str], WarpSource | None],
    title: tuple[str, str],
) -> Markup:
    """The query's pixels and those of the map in turn; empty where the map shows too little.

    ``title`` is the query, and which of its poses this is.
    """
    from megloc_kapture.stages.perceptual_ranking import (
        AlignedViewOptions,
        aligned_view,
        query_at_size,
    )

    options = AlignedViewOptions(long_side=_LONG_SIDE_PX)
    view = aligned_view(camera, pose, images, scene, options, source_of=read)
    if view.valid.mean() < _LEAST_SHOWN:
        return Markup()
    image, step = title
    height, width = view.valid.shape
    mixed = in_tiles(query_at_size(scene.query_image(image), width, height), view.image, view.valid)
    return image_tag(data_picture(mixed, width / camera.width), f"{image} and the map {step}")


def in_tiles(
    query: NDArray[np.uint8], warped: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """The query, uint8 (H, W, 3), with every other tile from the map where that is ``valid``."""
    height, width = valid.shape
    tile_px = -(-max(height, width) // _TILES)
    rows, columns = np.mgrid[:height, :width] // tile_px
    from_map = ((rows + columns) % 2 == 1) & valid
    return np.where(from_map[..., None], warped, query).astype(np.uint8)


def _facts(rows: Sequence[RefinementRow]) -> tuple[str, ...]:
    return tuple(
        f"{row.method} moved it by {format_metres(row.moved_m)} m, "
        f"{format_degrees(row.turned_deg)} deg"
        if row.accepted
        else f"{row.method} left it: {row.reason}"
        for row in rows
    )


def _error(pose: RigidTransform, image: str, truth: Poses) -> str:
    if image not in truth:
        return ""
    errors = pose_errors({image: pose}, truth, [image])
    metres, degrees = float(errors.position_m[0]), float(errors.angle_deg[0])
    return f": {format_metres(metres)} m, {format_degrees(degrees)} deg off"
