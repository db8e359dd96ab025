"""Queries that a page shows: the worst, the disputed, the doubtful, with images and matches."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import within
from megloc_kapture.evaluation.report.document import Picture, Pictures
from megloc_kapture.evaluation.report.pictures import (
    AGREES,
    DISAGREES,
    UNKNOWN,
    MatchLines,
    SmallImage,
    StoredMatches,
    encoded,
    fits_poses,
    image_tag,
    read_small,
    side_by_side,
)
from megloc_kapture.evaluation.report.shown_queries import query_facts
from megloc_kapture.evaluation.report.wording import counted, format_metres
from megloc_kapture.evaluation.results import ResultContext, are_ranked
from megloc_kapture.evaluation.scoring import Evaluation, QueryResult
from megloc_kapture.evaluation.without_truth import QueryWithoutTruth, ResultWithoutTruth
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import RigidTransform

NUM_SHOWN = 10
_LARGE = (400, 300)
_SMALL = (190, 143)
_CLUSTERS_TOLD = 4
_ALIGNED_SHOWN = 2
_NOT_SEEN = 255  # grey level of what no map image shows
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


def order_of_badness(query: QueryResult) -> tuple[float, float, str]:
    """Sorts queries the worst first: those without a pose, then by falling error, then by name."""
    return -query.position_m, -query.angle_deg, query.image


def worst_queries(evaluation: Evaluation, number: int = NUM_SHOWN) -> list[Chosen]:
    """The worst queries of a result; at most half of them without a pose, where others are left.

    Of those without a pose the ones with most inliers come first: they failed most narrowly.
    """
    ranked = sorted(evaluation.queries, key=order_of_badness)
    lost = [query for query in ranked if query.outcome == "missing"]
    lost.sort(key=lambda query: (-(query.num_inliers or 0), query.image))
    posed = [query for query in ranked if query.outcome != "missing"]
    num_posed = min(len(posed), max(number - len(lost), (number + 1) // 2))
    return [
        Chosen(
            name=query.image,
            image=evaluation.image(query.image),
            facts=("; ".join(query_facts(query)),),
            candidates=_candidates(evaluation, query),
            pose=evaluation.truth[query.image],
            pose_name="true",
        )
        for query in posed[:num_posed] + lost[: number - num_posed]
    ]


def disputed_queries(
    evaluations: Sequence[Evaluation], number: int = NUM_SHOWN
) -> list[tuple[int, Chosen]]:
    """Queries that results disagree about most, then those that are worst in all of them.

    Returns
    -------
    Position of the result that does worst on the query, whose matches are shown, and the query.
    """
    thresholds = evaluations[0].thresholds
    met = np.stack([sum(within(e.errors, t).astype(int) for t in thresholds) for e in evaluations])
    errors = np.stack([e.errors.position_m for e in evaluations])
    dispute = met.max(axis=0) - met.min(axis=0)
    names = evaluations[0].errors.names
    best = errors.min(axis=0)
    by_dispute = sorted(np.flatnonzero(dispute > 0).tolist(), key=lambda i: (-dispute[i], names[i]))
    by_error = sorted(range(len(names)), key=lambda i: (-best[i], -errors[:, i].max(), names[i]))
    chosen = by_dispute[: number - number // 3]
    chosen += [i for i in by_error if i not in set(chosen)][: number - len(chosen)]
    found = []
    for index in chosen:
        queries = [evaluation.queries[index] for evaluation in evaluations]
        worst = max(range(len(queries)), key=lambda k: (errors[k, index], -k))
        facts = tuple(
            f"{evaluation.label}: {', '.join(query_facts(query))}"
            for evaluation, query in zip(evaluations, queries, strict=True)
        )
        of_worst = evaluations[worst]
        found.append(
            (
                worst,
                Chosen(
                    name=names[index],
                    image=of_worst.image(names[index]),
                    facts=facts,
                    candidates=_candidates(of_worst, queries[worst]),
                    pose=of_worst.truth[names[index]],
                    pose_name="true",
                ),
            )
        )
    return found


def doubtful_queries(result: ResultWithoutTruth, number: int = NUM_SHOWN) -> list[Chosen]:
    """Localized queries that are least sure: far from every candidate, or of few inliers."""
    localized = [query for query in result.queries if query.outcome == "localized"]
    known = [q.num_inliers for q in localized if q.num_inliers is not None]
    few = float(np.quantile(known, 0.25)) if known else -math.inf

    def doubt(query: QueryWithoutTruth) -> tuple[bool, float, str]:
        far = query.near is not None and query.near.nearest_m > 25.0
        count = math.inf if query.num_inliers is None else query.num_inliers
        return not (far and count <= few), count, query.image

    return [
        Chosen(
            name=query.image,
            image=query.image,
            facts=("; ".join(_facts_without_truth(query)),),
            candidates=query.candidates,
            pose=result.poses[query.image],
            pose_name="estimated",
        )
        for query in sorted(localized, key=doubt)[:number]
    ]


def _candidates(evaluation: Evaluation, query: QueryResult) -> tuple[str, ...]:
    """Map images the pose comes from; where nothing says so, its pair's reference."""
    if query.candidates or query.image not in evaluation.pairs:
        return query.candidates
    return (evaluation.pairs[query.image].reference,)


def _facts_without_truth(query: QueryWithoutTruth) -> tuple[str, ...]:
    facts = []
    if query.num_inliers is not None:
        facts.append(f"{query.num_inliers} inliers of {query.num_matches}")
    if query.near is not None:
        if math.isfinite(query.near.first_m):
            facts.append(f"{format_metres(query.near.first_m)} m from its first candidate")
        facts.append(f"{format_metres(query.near.nearest_m)} m from the nearest candidate")
    return tuple(facts)


class QueryPictures:
    """Pictures of queries, from what a run left in its workspace.

    What is missing or cannot be read is left out: a report without it is better than none.
    """

    def __init__(
        self,
        context: ResultContext,
        map_poses: Mapping[str, RigidTransform],
        *,
        ranked: bool = True,
    ) -> None:
        """``ranked`` : whether the order of a query's candidates means anything."""
        self._context, self._ranked = context, ranked
        self._map_poses = map_poses
        self._matches = StoredMatches(context)
        quats, translations = stack_poses(map_poses.values())
        self._centers = camera_centers(quats, translations)
        self._forward = rotate(invert_quats(quats), _FORWARD)

    def of(self, chosen: Chosen) -> Pictures:
        """The query beside its best match, what else was a candidate, and its clusters' views."""
        query = _small(self._context.queries, chosen.image, _LARGE)
        candidates = list(chosen.candidates)
        counts = {
            c: self._matches.count(chosen.image, c) for c in candidates[:_CANDIDATES_COMPARED]
        }
        best = max(counts, key=lambda c: counts[c] or 0) if counts else ""
        nearest = self._nearest(chosen.pose)
        if not best:
            best, nearest = nearest, ""
        shown = [(c, counts.get(c)) for c in candidates if c != best][: _CANDIDATES_SHOWN - 1]
        others = [
            (image, self._facts(image, chosen, self._role(image, candidates), count))
            for image, count in shown
        ]
        if nearest and nearest != best and nearest not in dict(shown):
            role = f"nearest to the {chosen.pose_name} pose"
            others.append((nearest, self._facts(nearest, chosen, role, None)))
        small = [(i, facts, _small(self._context.mapping, i, _SMALL)) for i, facts in others]
        panels = self._aligned(chosen.image)
        return Pictures(
            name=chosen.name,
            facts=(*chosen.facts, *self._clusters(chosen.image)),
            main=None if query is None else self._beside(chosen, query, best),
            others=tuple(
                Picture(image_tag(image, name), ", ".join(facts))
                for name, facts, image in small
                if image is not None
            ),
            note="The places it may be at, their images warped to the pose each gives; white: not "
            "seen from there."
            if panels
            else "",
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
        from megloc_kapture.stages.perceptual_ranking import aligned_view
        from megloc_kapture.stages.ranking_scene import KaptureScene

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
        role = f"nearest to the {chosen.pose_name} pose"
        if best in chosen.candidates:
            role = self._role(best, chosen.candidates)
        lines = self._matches.lines(chosen.image, best)
        facts = list(self._facts(best, chosen, role, None))
        points = (np.zeros((0, 2)), np.zeros((0, 2)))
        colors: list[str] = []
        if lines is not None:
            number = len(lines.query_px)
            fits = self._fits(lines, chosen, best)
            facts.append(counted(number, "match", "matches"))
            if fits is not None and number:
                facts.append(f"{int(fits.sum())} of them agree with the {chosen.pose_name} pose")
            drawn = np.linspace(0, number - 1, min(number, _MAX_LINES)).round().astype(np.int64)
            drawn = np.unique(drawn)
            points = (lines.query_px[drawn], lines.map_px[drawn])
            colors = [UNKNOWN] * len(drawn)
            if fits is not None:
                colors = [AGREES if fit else DISAGREES for fit in fits[drawn].tolist()]
        element = side_by_side(query, other, points, colors, f"{chosen.image} and {best}")
        caption = Markup('Right: <span class="name">{}</span>, {}').format(best, ", ".join(facts))
        return Picture(element, caption)

    def _facts(self, image: str, chosen: Chosen, role: str, count: int | None) -> tuple[str, ...]:
        facts = [role]
        if chosen.pose is not None and image in self._map_poses:
            apart = float(np.linalg.norm(chosen.pose.center() - self._map_poses[image].center()))
            facts.append(f"{apart:.1f} {self._context.unit} from the {chosen.pose_name} place")
        if count is not None:
            facts.append(counted(count, "match", "matches"))
        return tuple(facts)

    def _role(self, image: str, candidates: Sequence[str]) -> str:
        """A candidate's rank, where candidates were ranked at all."""
        return f"candidate {candidates.index(image) + 1}" if self._ranked else "candidate"

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
        queries, mapping = self._context.queries, self._context.mapping
        if queries is None or mapping is None or chosen.pose is None:
            return None
        if image not in self._map_poses:
            return None
        map_from_query = self._map_poses[image] @ chosen.pose.inverse()
        with contextlib.suppress(DataError):
            cameras = queries.read().camera_of(chosen.image), mapping.read().camera_of(image)
            return fits_poses(lines, *cameras, map_from_query)
        return None


def _small(folder: KaptureFolder | None, image: str, box: tuple[int, int]) -> SmallImage | None:
    with contextlib.suppress(DataError):
        if folder is not None:
            return read_small(folder.image_path(image), width=box[0], height=box[1])
    return None


def query_pictures(
    chosen: Sequence[Chosen], context: ResultContext, map_poses: Mapping[str, RigidTransform]
) -> list[Pictures]:
    """Pictures of all chosen queries of one result."""
    ranked = are_ranked(one.candidates for one in chosen)
    pictures = QueryPictures(context, map_poses, ranked=ranked)
    return [pictures.of(one) for one in chosen]
