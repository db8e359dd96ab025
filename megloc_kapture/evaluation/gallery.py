"""Queries to look at: their images, their best matches, and what else was a candidate."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.aligned_views import aligned_views
from megloc_kapture.evaluation.match_lines import MatchLines, StoredMatches, fits_poses
from megloc_kapture.evaluation.pictures import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    Picture,
    image_tag,
    side_by_side,
    small_picture,
)
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.tables import counted
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.values import RigidTransform

_LARGE = (400, 300)
_SMALL = (190, 143)
_CLUSTERS_TOLD = 4
_CANDIDATES_SHOWN = 4
# of the candidates, those looked at for the one with most matches
_CANDIDATES_COMPARED = 50
_MAX_LINES = 120
_FORWARD = np.array([0.0, 0.0, 1.0])
# viewing directions within 60 degrees may see the same
_FACING_COSINE = 0.5


@dataclass(frozen=True)
class Chosen:
    """A query to show.

    Attributes
    ----------
    name : what it is called on the page.
    image : its image.
    facts : what stands under its name, in order.
    candidates : map images, best first.
    pose : ``cam_from_world`` that matches are judged by; None: unknown.
    pose_name : what that pose is: ``true`` or ``estimated``.
    """

    name: str
    image: str
    facts: tuple[str, ...]
    candidates: tuple[str, ...]
    pose: RigidTransform | None
    pose_name: str


@dataclass(frozen=True)
class Shown:
    """One image of the map beside a query, with what is known of it."""

    image: str
    facts: tuple[str, ...]
    picture: Markup


@dataclass(frozen=True)
class Exhibit:
    """A query as the page shows it.

    Attributes
    ----------
    picture : the query, beside its best match where there is one; None: no image file.
    best : the map image on the right of ``picture``; empty: none.
    caption : of the lines between the two.
    others : further map images.
    aligned : the best two places, brought to their poses; empty where there is no choice, or the
        map has no depth.
    """

    name: str
    facts: tuple[str, ...]
    picture: Markup | None
    best: str
    caption: str
    others: tuple[Shown, ...]
    aligned: tuple[Shown, ...] = ()


class Gallery:
    """Makes exhibits of queries from what lies around a result."""

    def __init__(self, around: Surroundings, map_poses: Mapping[str, RigidTransform]) -> None:
        self._around = around
        self._map_poses = map_poses
        self._matches: StoredMatches | None = None
        with contextlib.suppress(DataError):
            self._matches = StoredMatches(around)
        quats, translations = stack_poses(map_poses.values())
        self._centers = camera_centers(quats, translations)
        self._forward = rotate(invert_quats(quats), _FORWARD)

    def exhibit(self, chosen: Chosen) -> Exhibit:
        """Show one query; what is missing or cannot be read is left out."""
        query = _picture(self._around.queries, chosen.image, _LARGE)
        candidates = list(chosen.candidates)
        counts = {c: self._count(chosen.image, c) for c in candidates[:_CANDIDATES_COMPARED]}
        best = max(counts, key=lambda c: counts[c] or 0) if counts else ""
        nearest = self._nearest(chosen.pose)
        if not best:
            best, nearest = nearest, ""
        picture, caption = None, ""
        if query is not None:
            picture, caption = self._beside(chosen, query, best)
        shown = [(c, counts.get(c)) for c in candidates if c != best][: _CANDIDATES_SHOWN - 1]
        others = []
        for image, count in shown:
            facts = self._facts(image, chosen, f"candidate {candidates.index(image) + 1}", count)
            others.append((image, facts))
        if nearest and nearest != best and nearest not in dict(shown):
            facts = self._facts(nearest, chosen, f"nearest to the {chosen.pose_name} pose", None)
            others.append((nearest, facts))
        pictures = [(i, f, _picture(self._around.mapping, i, _SMALL)) for i, f in others]
        return Exhibit(
            name=chosen.name,
            facts=(*chosen.facts, *self._clusters(chosen.image)),
            picture=picture,
            best=best if caption else "",
            caption=caption,
            others=tuple(
                Shown(image, facts, image_tag(small, image))
                for image, facts, small in pictures
                if small is not None
            ),
            aligned=self._aligned(chosen.image),
        )

    def _aligned(self, query: str) -> tuple[Shown, ...]:
        shown = []
        for number, view in enumerate(aligned_views(self._around, query), 1):
            row = view.row
            facts = (
                f"cluster {row.cluster}, {'chosen' if row.chosen == 'yes' else 'not chosen'}",
                f"score {row.score:.3g}",
                counted(row.num_inliers, "inlier", "inliers"),
                f"{100 * view.share:.0f} % of the view is shown",
            )
            name = f"what place {number} shows of {query}"
            shown.append(Shown(row.images[0], facts, image_tag(view.picture, name)))
        return tuple(shown)

    def _clusters(self, query: str) -> tuple[str, ...]:
        """One line on the clusters of candidates, the chosen one first; none where all are one."""
        rows = self._around.clusters.get(query, ())
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

    def _beside(self, chosen: Chosen, query: Picture, best: str) -> tuple[Markup, str]:
        """The query beside the map image ``best``, and what is said of the two."""
        other = _picture(self._around.mapping, best, _LARGE) if best else None
        if other is None:
            return image_tag(query, chosen.image), ""
        role = f"nearest to the {chosen.pose_name} pose"
        if best in chosen.candidates:
            role = f"candidate {chosen.candidates.index(best) + 1}"
        lines = self._lines(chosen.image, best)
        facts = list(self._facts(best, chosen, role, None))
        points = (np.zeros((0, 2)), np.zeros((0, 2)))
        colors: list[str] = []
        if lines is not None:
            fits = self._fits(lines, chosen, best)
            facts.append(_matches_said(len(lines.query_px), fits, chosen.pose_name))
            drawn = np.unique(
                np.linspace(0, len(lines.query_px) - 1, min(len(lines.query_px), _MAX_LINES))
                .round()
                .astype(np.int64)
            )
            points = (lines.query_px[drawn], lines.map_px[drawn])
            colors = [UNKNOWN] * len(drawn)
            if fits is not None:
                colors = [AGREES if fit else DISAGREES for fit in fits[drawn].tolist()]
        picture = side_by_side(query, other, points, colors, f"{chosen.image} and {best}")
        return picture, ", ".join(facts)

    def _facts(self, image: str, chosen: Chosen, role: str, count: int | None) -> tuple[str, ...]:
        facts = [role]
        if chosen.pose is not None and image in self._map_poses:
            apart = float(np.linalg.norm(chosen.pose.center() - self._map_poses[image].center()))
            facts.append(f"{apart:.1f} m from the {chosen.pose_name} place")
        if count is not None:
            facts.append(counted(count, "match", "matches"))
        return tuple(facts)

    def _nearest(self, pose: RigidTransform | None) -> str:
        """The map image nearest to a pose, of those that look its way where there are any."""
        if pose is None or not self._map_poses:
            return ""
        distance = np.linalg.norm(self._centers - pose.center(), axis=1)
        facing = self._forward @ pose.rotation_matrix()[2] > _FACING_COSINE
        if facing.any():
            distance = np.where(facing, distance, np.inf)
        return list(self._map_poses)[int(np.argmin(distance))]

    # a report without some matches is better than none
    def _count(self, query: str, image: str) -> int | None:
        with contextlib.suppress(DataError):
            return None if self._matches is None else self._matches.count(query, image)
        return None

    def _lines(self, query: str, image: str) -> MatchLines | None:
        with contextlib.suppress(DataError):
            return None if self._matches is None else self._matches.lines(query, image)
        return None

    def _fits(self, lines: MatchLines, chosen: Chosen, image: str) -> NDArray[np.bool_] | None:
        queries, mapping = self._around.queries, self._around.mapping
        if queries is None or mapping is None or chosen.pose is None:
            return None
        if image not in self._map_poses:
            return None
        map_from_query = self._map_poses[image] @ chosen.pose.inverse()
        with contextlib.suppress(DataError):
            return fits_poses(
                lines,
                queries.read().camera_of(chosen.image),
                mapping.read().camera_of(image),
                map_from_query,
            )
        return None


def _matches_said(number: int, fits: NDArray[np.bool_] | None, pose_name: str) -> str:
    said = counted(number, "match", "matches")
    if fits is None or not number:
        return said
    return f"{said}, {int(fits.sum())} of them agree with the {pose_name} pose"


def _picture(folder: KaptureFolder | None, image: str, box: tuple[int, int]) -> Picture | None:
    if folder is None:
        return None
    try:
        return small_picture(folder.image_path(image), width=box[0], height=box[1])
    except DataError:
        # a report without this image is better than none
        return None


def exhibits(
    chosen: Sequence[Chosen],
    around: Surroundings | None,
    map_poses: Mapping[str, RigidTransform],
) -> list[Exhibit]:
    """All chosen queries as the page shows them."""
    gallery = Gallery(around or Surroundings(), map_poses)
    return [gallery.exhibit(one) for one in chosen]
