"""Poses before and after refinement: counts, errors, and the map's images seen from both."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import Threshold, pose_errors, within
from megloc_kapture.evaluation.report.document import (
    Block,
    Cell,
    Paragraph,
    Picture,
    Pictures,
    Table,
    column,
)
from megloc_kapture.evaluation.report.pictures import encoded, image_tag
from megloc_kapture.evaluation.report.wording import (
    format_degrees,
    format_metres,
    format_percent,
)
from megloc_kapture.evaluation.results import Poses, ResultContext
from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.plugins import RankingScene
from megloc_kapture.values import Camera, RefinementRow, RigidTransform

_REASONS_TOLD = 4
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_SHOWN = 4
_LONG_SIDE_PX = 420
_TILES = 8  # along the longer side of a picture
_LEAST_SHOWN = 0.2  # share of a query's pixels that map images must show


# a row of ``refinement.csv`` and the pose it ended with
_Step = tuple[RefinementRow, RigidTransform]


def refinement_blocks(
    context: ResultContext,
    estimated: Poses,
    truth: Poses | None = None,
    thresholds: Sequence[Threshold] = (),
) -> tuple[Block, ...]:
    """A table of the steps over all queries, recall before and after, and a few queries' looks.

    Parameters
    ----------
    estimated, truth : ``cam_from_world`` of the queries by image, after all refinement.
    thresholds : of the recall that is told, where there is truth.

    Returns
    -------
    Empty where nothing was refined.
    """
    refinements = {i: rows for i, rows in context.refinements.items() if rows and i in estimated}
    if not refinements:
        return ()
    truth = truth or {}
    # the same refiners for every query, in one order; each step ends with what the next begins with
    chains = [
        list(zip(rows, [*(row.before for row in rows[1:]), estimated[image]], strict=True))
        for image, rows in sorted(refinements.items())
    ]
    steps = [[c[k] for c in chains if k < len(c)] for k in range(max(map(len, chains)))]
    pictures = list(_looks(context, refinements, estimated, truth))
    explained = Paragraph(
        "The queries that moved most. Every other tile is of the query, the others are map images "
        "warped to its pose, where they show something: edges go on from tile to tile where the "
        "pose is right."
    )
    recall = _recall(refinements, estimated, truth, thresholds)
    return (
        _steps_table(steps, truth),
        Paragraph(f"Movement and errors are those of the accepted poses.{recall}"),
        *(Paragraph(f"{consistency_sentence(row)}.") for row in context.consistency),
        *([explained] if pictures else []),
        *pictures,
    )


def consistency_sentence(row: ConsistencyRow) -> str:
    """The verdict of a map's own images on a refiner, and how far they move."""
    frame = f" in {row.frame}" if row.frame else ""
    told = f"{row.method}{frame} is {f'not used: {row.reason}' if row.reason else 'used'}"
    if row.reason:
        return told
    return (
        f"{told}; {row.images} map images held out move by {_moved(row.moved_m, row.turned_deg)}, "
        f"{row.moved_px:.1f} px (medians; claimed to {_moved(row.claimed_m, row.claimed_deg)})"
    )


def _steps_table(steps: Sequence[Sequence[_Step]], truth: Poses) -> Table:
    accepted = [[(row, after) for row, after in own if row.accepted] for own in steps]

    def moved(own: Sequence[_Step]) -> str:
        return _medians([row.moved_m for row, _ in own], [row.turned_deg for row, _ in own])

    def kept(own: Sequence[_Step]) -> Cell:
        """Counts of the reasons, numbers aside, the most frequent first; one a line."""
        reasons = [_NUMBER.sub("…", row.reason) for row, _ in own if not row.accepted]
        told = Counter(reasons).most_common(_REASONS_TOLD)
        lines = [f"{count} x {reason}" for reason, count in told]
        rest = len(reasons) - sum(count for _, count in told)
        lines += [f"{rest} x something else"] if rest else []
        return Cell("", page=Markup("<br>").join(lines), style="small")

    columns = [
        column("step", steps, lambda own: own[0][0].method),
        column("queries", steps, len, kind="count"),
        column("accepted", accepted, len, kind="count"),
        column("moved by\n(median)", accepted, moved, kind="count"),
    ]
    known = [[(row, after) for row, after in own if row.image in truth] for own in accepted]
    if any(known):
        errors = [_errors(own, truth) for own in known]
        columns += [
            column("error before\n(median)", errors, lambda own: own[0], kind="count"),
            column("error after\n(median)", errors, lambda own: own[1], kind="count"),
            column("nearer\nthe truth", errors, lambda own: own[2], kind="count"),
        ]
    columns.append(column("the other poses stay", steps, kept))
    return Table(tuple(columns))


def _errors(steps: Sequence[_Step], truth: Poses) -> tuple[str, str, str]:
    """Median errors before and after, and how many came nearer to the truth."""
    if not steps:
        return "", "", ""
    names = [row.image for row, _ in steps]
    old = pose_errors({row.image: row.before for row, _ in steps}, truth, names)
    new = pose_errors({row.image: after for row, after in steps}, truth, names)
    nearer = f"{int((new.position_m < old.position_m).sum())} of {len(names)}"
    before, after = (_medians(each.position_m, each.angle_deg) for each in (old, new))
    return before, after, nearer


def _medians(
    position_m: Sequence[float] | NDArray[np.float64],
    angle_deg: Sequence[float] | NDArray[np.float64],
) -> str:
    if not len(position_m):
        return ""
    return _moved(float(np.median(position_m)), float(np.median(angle_deg)))


def _moved(metres: float, degrees: float) -> str:
    return f"{format_metres(metres)} m, {format_degrees(degrees)} deg"


def _recall(
    refinements: Mapping[str, Sequence[RefinementRow]],
    estimated: Poses,
    truth: Poses,
    thresholds: Sequence[Threshold],
) -> str:
    if not truth or not thresholds:
        return ""
    first = {image: rows[0].before for image, rows in refinements.items()}
    told = []
    for poses in ({**estimated, **first}, estimated):
        errors = pose_errors(poses, truth)
        shares = [float(within(errors, threshold).mean()) for threshold in thresholds]
        told.append(" / ".join(format_percent(share) for share in shares))
    return f" Recall (%) of all queries: {told[0]} before, {told[1]} after."


def _looks(
    context: ResultContext,
    refinements: Mapping[str, Sequence[RefinementRow]],
    estimated: Poses,
    truth: Poses,
) -> Iterator[Pictures]:
    """Refined queries in tiles with what map images show at their poses, before and after.

    Of the queries with a new pose those that moved most; none where the map has no depth.
    """
    if context.mapping is None or context.queries is None:
        return
    # only a report with such pictures waits for what warps them
    from megloc_kapture.stages.scene import KaptureScene

    refined = [i for i, rows in refinements.items() if any(row.accepted for row in rows)]
    refined.sort(key=lambda name: (-sum(row.moved_m for row in refinements[name]), name))
    shown = 0
    # a report without these pictures is better than none
    with contextlib.suppress(DataError):
        scene = KaptureScene(context.mapping, context.queries)
        for image in refined:
            rows = refinements[image]
            chosen = [row.images for row in context.clusters.get(image, ()) if row.chosen == "yes"]
            if not chosen:
                continue
            poses = {"before": rows[0].before, "after": estimated[image]}
            camera = context.queries.read().camera_of(image)
            panels = _tiled(scene, image, camera, poses, chosen[0], truth)
            if not panels:
                continue
            facts = tuple(
                f"{row.method} moved it by {_moved(row.moved_m, row.turned_deg)}"
                if row.accepted
                else f"{row.method} left it: {row.reason}"
                for row in rows
            )
            yield Pictures(image, facts, panels=panels)
            shown += 1
            if shown == _SHOWN:
                return


def _tiled(
    scene: RankingScene,
    image: str,
    camera: Camera,
    poses: Mapping[str, RigidTransform],
    map_images: Sequence[str],
    truth: Poses,
) -> tuple[Picture, ...]:
    """A picture of the query and the map's images per pose; none where the map shows too little.

    ``poses`` has what each is called: before, after.
    """
    from megloc_kapture.localization.ranking import (
        AlignedViewOptions,
        aligned_view,
        query_at_size,
        warp_source,
    )

    options = AlignedViewOptions(long_side=_LONG_SIDE_PX)
    # both pictures show the same map images, or nearly
    read = cache(partial(warp_source, scene=scene))
    found = []
    for step, pose in poses.items():
        view = aligned_view(camera, pose, map_images, scene, options, source_of=read)
        if view.valid.mean() < _LEAST_SHOWN:
            return ()
        height, width = view.valid.shape
        query = query_at_size(scene.query_image(image), width, height)
        tiles = in_tiles(query, view.image, view.valid)
        element = image_tag(encoded(tiles, width / camera.width), f"{image} and the map {step}")
        error = ""
        if image in truth:
            errors = pose_errors({image: pose}, truth, [image])
            error = f": {_moved(float(errors.position_m[0]), float(errors.angle_deg[0]))} off"
        found.append(Picture(element, step + error))
    return tuple(found)


def in_tiles(
    query: NDArray[np.uint8], warped: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """The query, uint8 (H, W, 3), with every other tile from the map where that is ``valid``."""
    height, width = valid.shape
    tile_px = -(-max(height, width) // _TILES)
    rows, columns = np.mgrid[:height, :width] // tile_px
    from_map = ((rows + columns) % 2 == 1) & valid
    return np.where(from_map[..., None], warped, query).astype(np.uint8)
