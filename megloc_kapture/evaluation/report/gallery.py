"""Queries of a report one by one: pictures with inliers, beside what they match, and the table.

What is missing or cannot be read is left out: a report without it is better than none.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import within
from megloc_kapture.evaluation.report.document import (
    Block,
    Card,
    Cards,
    Cell,
    Paragraph,
    Picture,
    Pictures,
    Table,
    column,
)
from megloc_kapture.evaluation.report.pictures import (
    SmallImage,
    dotted,
    encoded,
    image_tag,
    read_small,
    side_by_side,
)
from megloc_kapture.evaluation.report.queries import (
    Chosen,
    ShownQuery,
    StoredInliers,
    order_of_badness,
    query_facts,
    spread,
)
from megloc_kapture.evaluation.report.wording import counted, format_degrees, format_metres
from megloc_kapture.evaluation.results import Poses, ResultContext, are_ranked
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.kapture import FeatureReader, KaptureFolder, MatchesReader
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.values import Camera, RigidTransform

# a picture takes about 10 kB and, of a large photograph, 50 ms
MAX_PICTURES = 120
_CARD, _LARGE, _SMALL = (200, 150), (400, 300), (190, 143)
_MAX_DOTS, _MAX_LINES = 120, 120
_DOT = "#3dff7c"
# more rows than anybody reads; the CSV beside the report has them all
_MAX_ROWS = 500
# of the best, of the typical and of the worst, which come first
_EACH = 3
_CLUSTERS_TOLD, _ALIGNED_SHOWN, _CANDIDATES_SHOWN = 4, 2, 4
_NOT_SEEN = 255  # grey level of what no map image shows
# of the candidates, those looked at for the one with most matches
_CANDIDATES_COMPARED = 50
# viewing directions within 60 degrees may see the same
_FACING_COSINE = 0.5
# how far a match may lie beside its epipolar line and still fit
_MAX_ERROR_PX = 8.0
AGREES, DISAGREES, UNKNOWN = "#12a150", "#e02424", "#f2b705"


def gallery_blocks(stored: StoredInliers, queries: Sequence[ShownQuery]) -> tuple[Block, ...]:
    """The pictures of queries; nothing where no image can be shown.

    Three of the best, of the typical and of the worst stand first, then the others, the worst
    first. Of more than 120 queries these nine, the worst half of the others, and some of the rest.

    Parameters
    ----------
    stored : their images and inliers.
    queries : worst first.
    """
    folder = stored.context.queries
    first, others = _first(queries)
    shown = first + [(query, "") for query in _some(others, MAX_PICTURES - len(first))]
    cards = []
    for query, role in shown:
        picture = _small(folder, query.image, _CARD)
        if picture is None:
            continue
        pixels = stored.of(query)[0]
        pixels = pixels[spread(len(pixels), _MAX_DOTS)]
        element = dotted(picture, pixels, _DOT, query.name)
        outcome = "no pose" if query.estimated is None else query.outcome
        sort = {
            "error": None if math.isnan(query.position_m) else query.position_m,
            "inliers": query.num_inliers,
            "confidence": query.confidence,
        }
        known = {name: float(value) for name, value in sort.items() if value is not None}
        facts = tuple(query_facts(query))
        cards.append(Card(query.name, element, facts, role, query.condition, outcome, known))
    if not cards:
        return ()
    told = "The best, typical and worst ones first. " if first else "The worst first. "
    if len(queries) > len(shown):
        told += f"{len(shown)} of {len(queries)} queries; the table below has more. "
    if any("<path" in card.element for card in cards):
        told += "Dots: inliers, matches whose point lies within 12 pixels under the estimated pose."
    return Paragraph(told.strip()), Cards(tuple(cards))


def _first(
    queries: Sequence[ShownQuery],
) -> tuple[list[tuple[ShownQuery, str]], list[ShownQuery]]:
    """The best, the typical and the worst with what each is, and the other queries."""
    number = len(queries)
    if number < 4 * _EACH:
        return [], list(queries)
    middle = (number - _EACH) // 2
    chosen = {
        **{number - 1 - k: "best" for k in range(_EACH)},
        **{middle + k: "typical" for k in range(_EACH)},
        **{k: "worst" for k in range(_EACH)},
    }
    others = [query for at, query in enumerate(queries) if at not in chosen]
    return [(queries[at], role) for at, role in chosen.items()], others


def _some(queries: Sequence[ShownQuery], most: int) -> list[ShownQuery]:
    """The worst, up to half of what there is room for, and some of the rest evenly spread."""
    if len(queries) <= most:
        return list(queries)
    worst = most // 2
    rest = queries[worst:]
    return [*queries[:worst], *(rest[at] for at in spread(len(rest), most - worst))]


def query_table(evaluation: Evaluation) -> tuple[Table, int]:
    """The worst 500 queries, those without a pose first, then by falling error, then by name.

    Returns
    -------
    The table, and the number of queries that are left out.
    """
    by_center = evaluation.by_center
    met = [within(evaluation.errors, threshold) for threshold in evaluation.thresholds]
    centers_m = (by_center or evaluation).errors.position_m.tolist()
    queries = evaluation.queries
    ranked = sorted(range(len(queries)), key=lambda i: order_of_badness(queries[i]))[:_MAX_ROWS]
    rows = [queries[i] for i in ranked]

    def dots(index: int) -> Cell:
        marks = ("●" if own[index] else Markup("<i>○</i>") for own in met)
        return Cell("", page=Markup("").join(marks), style="c dots")

    def outcome(at: int) -> Cell:
        own = rows[at].outcome
        return Cell("no pose" if own == "missing" else own, style=own)

    def figures(heading: str, values: Sequence[float], form: Callable[[float], str]) -> None:
        texts = [form(value) if math.isfinite(value) else "" for value in values]
        columns.append(column(heading, texts, str, kind="count"))

    every = range(len(rows))
    columns = [
        column("#", every, lambda at: Cell(str(at + 1), style="soft"), kind="count"),
        column("image", rows, lambda row: Cell(row.image, style="name")),
    ]
    if any(query.condition for query in queries):
        columns.append(column("condition", rows, lambda row: row.condition))
    columns += [column("outcome", every, outcome), column("met", ranked, dots)]
    position = "position (m)" if by_center is None else "relative (m)"
    figures(position, [row.position_m for row in rows], format_metres)
    if by_center is not None:
        figures("centre (m)", [centers_m[index] for index in ranked], format_metres)
    figures("angle (deg)", [row.angle_deg for row in rows], format_degrees)
    nan = math.nan
    if any(query.num_inliers is not None for query in queries):
        inliers = [nan if row.num_inliers is None else row.num_inliers for row in rows]
        matches = [nan if row.num_matches is None else row.num_matches for row in rows]
        figures("inliers", inliers, str)
        figures("matches", matches, str)
    if any(query.confidence is not None for query in queries):
        sure = [nan if row.confidence is None else row.confidence for row in rows]
        figures("confidence", sure, "{:.2f}".format)
    columns.append(column("reason", rows, lambda row: row.reason))
    return Table(tuple(columns), tall=True), max(len(queries) - _MAX_ROWS, 0)


@dataclass(frozen=True, eq=False)
class MatchLines:
    """Matched pixels of two images.

    Attributes
    ----------
    query_px, map_px : float64 (M, 2).
    """

    query_px: NDArray[np.float64]
    map_px: NDArray[np.float64]


class StoredMatches:
    """Reads the matches that a run left in its workspace; knows none where there are none.

    Of several types of keypoints the first one counts that has matches, and keypoints on both
    sides.
    """

    def __init__(self, context: ResultContext) -> None:
        self._matches: MatchesReader | None = None
        self._keypoints: tuple[FeatureReader, FeatureReader] | None = None
        queries, mapping = context.queries, context.mapping
        if queries is None or mapping is None:
            return
        with contextlib.suppress(DataError):
            drawn = set(queries.types("keypoints")) & set(mapping.types("keypoints"))
            known = [name for name in queries.types("matches") if name in drawn]
            if known:
                # those of a guided pyramid hold the others
                chosen = min(known, key=lambda name: (base_type(name) == name, name))
                keypoints = queries.keypoints(chosen), mapping.keypoints(chosen)
                self._matches, self._keypoints = queries.matches(chosen), keypoints

    def count(self, query: str, image: str) -> int | None:
        """Matches of a pair; None where nothing is known of it."""
        found = self._indices(query, image)
        return None if found is None else len(found)

    def lines(self, query: str, image: str) -> MatchLines | None:
        """Matches of a pair as pixels; None where nothing is known of it."""
        indices = self._indices(query, image)
        if indices is None or self._keypoints is None:
            return None
        pixels = []
        with contextlib.suppress(DataError):
            for reader, name, own in zip(self._keypoints, (query, image), indices.T, strict=True):
                if name not in reader:
                    return None
                keypoints = reader.read(name)
                if len(keypoints) <= own.max(initial=-1):
                    return None
                pixels.append(np.asarray(keypoints[own, :2], dtype=np.float64))
        return MatchLines(*pixels) if len(pixels) == 2 else None

    def _indices(self, query: str, image: str) -> NDArray[np.int64] | None:
        with contextlib.suppress(DataError):
            if self._matches is not None and (query, image) in self._matches:
                return self._matches.read(query, image)[0]
        return None


def fits_poses(
    lines: MatchLines, query_camera: Camera, map_camera: Camera, map_from_query: RigidTransform
) -> NDArray[np.bool_]:
    """(M,) whether each match lies within 8 pixels of its epipolar line in the query.

    Where the two cameras stand in one place every match fits.
    """
    rays = bearing_rays(query_camera, lines.query_px)
    map_rays = bearing_rays(map_camera, lines.map_px)
    t = np.array(map_from_query.translation)
    # x_map^T [t] R x_query = 0: the plane of both centres and the map's ray, seen by the query
    normals = np.cross(map_rays, t) @ map_from_query.rotation_matrix()
    length = np.linalg.norm(normals[:, :2], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        beside = np.abs(np.einsum("ij,ij->i", normals, rays)) / length
    return np.asarray(~(beside * focal_px(query_camera) > _MAX_ERROR_PX))


class QueryPictures:
    """Pictures of queries beside map images, from what a run left in its workspace.

    Parameters
    ----------
    ranked : whether the order of a query's candidates means anything.
    """

    def __init__(self, context: ResultContext, map_poses: Poses, *, ranked: bool = True) -> None:
        self._context, self._ranked, self._map_poses = context, ranked, map_poses
        self._matches = StoredMatches(context)
        quats, translations = stack_poses(map_poses.values())
        self._centers = camera_centers(quats, translations)
        self._forward = rotate(invert_quats(quats), np.array([0.0, 0.0, 1.0]))

    def of(self, chosen: Chosen) -> Pictures:
        """The query beside its best match, what else was a candidate, and its clusters' views."""
        query = _small(self._context.queries, chosen.image, _LARGE)
        candidates = chosen.candidates
        compared = candidates[:_CANDIDATES_COMPARED]
        counts = {c: self._matches.count(chosen.image, c) for c in compared}
        best = max(counts, key=lambda c: counts[c] or 0) if counts else ""
        nearest = self._nearest(chosen.pose)
        if not best:
            best, nearest = nearest, ""
        first = [c for c in candidates if c != best][: _CANDIDATES_SHOWN - 1]
        shown = {c: self._facts(c, chosen, self._role(c, chosen), counts.get(c)) for c in first}
        if nearest and nearest != best and nearest not in shown:
            shown[nearest] = self._facts(nearest, chosen, f"nearest to the {chosen.pose_name} pose")
        others = []
        for image, facts in shown.items():
            if (small := _small(self._context.mapping, image, _SMALL)) is not None:
                others.append(Picture(image_tag(small, image), ", ".join(facts)))
        panels = self._aligned(chosen.image)
        note = "The places it may be at, their images warped to the pose each gives; white: not "
        return Pictures(
            name=chosen.name,
            facts=(*chosen.facts, *self._clusters(chosen.image)),
            main=None if query is None else self._beside(chosen, query, best),
            others=tuple(others),
            note=f"{note}seen from there." if panels else "",
            panels=panels,
        )

    def _aligned(self, query: str) -> tuple[Picture, ...]:
        """The map images of the best two clusters, warped to the pose each gives the query.

        Nothing where there is one cluster, or the map has no depth.
        """
        mapping, queries = self._context.mapping, self._context.queries
        rows = [
            (row, row.cam_from_world, row.score)
            for row in self._context.clusters.get(query, ())
            if row.cam_from_world is not None and row.score is not None
        ]
        rows.sort(key=lambda one: (one[0].chosen != "yes", -one[2], one[0].cluster))
        if len(rows) < 2 or mapping is None or queries is None:
            return ()
        # only a report with such pictures waits for what warps them
        from megloc_kapture.localization.ranking import aligned_view
        from megloc_kapture.stages.scene import KaptureScene

        found: list[Picture] = []
        with contextlib.suppress(DataError):
            scene = KaptureScene(mapping, queries)
            camera = queries.read().camera_of(query)
            for row, pose, score in rows[:_ALIGNED_SHOWN]:
                view = aligned_view(camera, pose, row.images, scene)
                if not view.valid.any():
                    continue
                pixels = np.where(view.valid[..., None], view.image, np.uint8(_NOT_SEEN))
                facts = (
                    f"cluster {row.cluster}, {'chosen' if row.chosen == 'yes' else 'not chosen'}",
                    f"score {score:.3g}",
                    counted(row.num_inliers, "inlier", "inliers"),
                    f"{100 * view.valid.mean():.0f} % of the view is shown",
                )
                image = encoded(pixels.astype(np.uint8), pixels.shape[1] / camera.width)
                name = f"what place {len(found) + 1} shows of {query}"
                found.append(Picture(image_tag(image, name), ", ".join(facts)))
        return tuple(found)

    def _clusters(self, query: str) -> tuple[str, ...]:
        """One line on the clusters of candidates, the chosen one first; none where all are one."""
        rows = self._context.clusters.get(query, ())
        if len(rows) < 2:
            return ()
        ranked = sorted(rows, key=lambda row: (row.chosen != "yes", -row.num_inliers, row.cluster))
        said = [
            f"{counted(len(row.images), 'image', 'images')} ({row.images[0]} first), "
            f"{row.num_inliers} inliers of {row.num_matches}"
            for row in ranked[:_CLUSTERS_TOLD]
        ]
        more = f"; and {len(rows) - _CLUSTERS_TOLD} more" if len(rows) > _CLUSTERS_TOLD else ""
        return (f"{len(rows)} clusters of candidates: {'; '.join(said)}{more}",)

    def _beside(self, chosen: Chosen, query: SmallImage, best: str) -> Picture:
        """The query beside the map image ``best``, and what is said of the two."""
        other = _small(self._context.mapping, best, _LARGE) if best else None
        if other is None:
            return Picture(image_tag(query, chosen.image))
        facts = self._facts(best, chosen, self._role(best, chosen))
        lines = self._matches.lines(chosen.image, best)
        if lines is None:
            lines, fits = MatchLines(np.zeros((0, 2)), np.zeros((0, 2))), None
        else:
            fits = self._fits(lines, chosen, best)
            facts.append(counted(len(lines.query_px), "match", "matches"))
        if fits is not None and len(fits):
            facts.append(f"{int(fits.sum())} of them agree with the {chosen.pose_name} pose")
        drawn = spread(len(lines.query_px), _MAX_LINES)
        colors = [UNKNOWN] * len(drawn)
        if fits is not None:
            colors = [AGREES if fit else DISAGREES for fit in fits[drawn].tolist()]
        points = lines.query_px[drawn], lines.map_px[drawn]
        element = side_by_side(query, other, points, colors, f"{chosen.image} and {best}")
        caption = Markup('Right: <span class="name">{}</span>, {}').format(best, ", ".join(facts))
        return Picture(element, caption)

    def _role(self, image: str, chosen: Chosen) -> str:
        """A candidate's rank, where candidates were ranked at all; others are the nearest."""
        if image not in chosen.candidates:
            return f"nearest to the {chosen.pose_name} pose"
        return f"candidate {chosen.candidates.index(image) + 1}" if self._ranked else "candidate"

    def _facts(self, image: str, chosen: Chosen, role: str, count: int | None = None) -> list[str]:
        facts = [role]
        if chosen.pose is not None and image in self._map_poses:
            apart = float(np.linalg.norm(chosen.pose.center() - self._map_poses[image].center()))
            facts.append(f"{apart:.1f} {self._context.unit} from the {chosen.pose_name} place")
        if count is not None:
            facts.append(counted(count, "match", "matches"))
        return facts

    def _nearest(self, pose: RigidTransform | None) -> str:
        """The map image nearest to a pose, of those that look its way where there are any."""
        if pose is None or not self._map_poses:
            return ""
        distance = np.linalg.norm(self._centers - pose.center(), axis=1)
        facing = self._forward @ pose.rotation_matrix()[2] > _FACING_COSINE
        if facing.any():
            distance = np.where(facing, distance, np.inf)
        return list(self._map_poses)[int(np.argmin(distance))]

    def _fits(self, lines: MatchLines, chosen: Chosen, image: str) -> NDArray[np.bool_] | None:
        queries, mapping, pose = self._context.queries, self._context.mapping, chosen.pose
        if queries is None or mapping is None or pose is None or image not in self._map_poses:
            return None
        with contextlib.suppress(DataError):
            cameras = queries.read().camera_of(chosen.image), mapping.read().camera_of(image)
            return fits_poses(lines, *cameras, self._map_poses[image] @ pose.inverse())
        return None


def _small(folder: KaptureFolder | None, image: str, box: tuple[int, int]) -> SmallImage | None:
    """An image made small; None where it cannot be read."""
    with contextlib.suppress(DataError):
        if folder is not None:
            return read_small(folder.image_path(image), box)
    return None


def query_pictures(
    chosen: Sequence[Chosen], context: ResultContext, map_poses: Poses
) -> list[Pictures]:
    """Pictures of all chosen queries of one result."""
    ranked = are_ranked(one.candidates for one in chosen)
    pictures = QueryPictures(context, map_poses, ranked=ranked)
    return [pictures.of(one) for one in chosen]
