"""Queries that reports show: which, in what order, what is said of each, and its stored inliers."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import Threshold, within
from megloc_kapture.evaluation.report.wording import format_degrees, format_metres
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.evaluation.scoring import Evaluation, QueryResult
from megloc_kapture.evaluation.without_truth import ResultWithoutTruth
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.kapture import FeatureReader, MatchesReader
from megloc_kapture.localization.map_index import MapIndex, TypedMatches
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.values import RigidTransform

NUM_SHOWN = 10
# a match is an inlier within so many pixels of its point, as when a pose is estimated
INLIER_PX = 12.0
_NOTHING = np.zeros((0, 2)), np.zeros((0, 3))
# from right to wrong, told apart with any colour vision; then without a pose, and unknown
_SCALE = ("#4cc3f0", "#7fd17f", "#f4d35e", "#ff9f45", "#ff4d4d")
NO_POSE_COLOR, UNKNOWN_COLOR = "#9aa5b1", "#c9a7ff"
# least confidences of the colours
_SURE = (0.95, 0.8, 0.6)


@dataclass(frozen=True, kw_only=True)
class ShownQuery(QueryResult):
    """A query as the view and the gallery show it; ``image`` is its image in any case.

    Attributes
    ----------
    name : what it is called.
    estimated, truth : ``cam_from_world``; None where there is none.
    color, meaning : of its error where the truth is known, else of its confidence.
    """

    name: str
    estimated: RigidTransform | None
    truth: RigidTransform | None
    color: str
    meaning: str

    def rank(self) -> tuple[float, float, float, str]:
        """Sorts the worst first: without a pose, then by falling error, or rising confidence, or
        rising number of inliers; then by name."""
        error = 0.0 if math.isnan(self.position_m) else self.position_m
        sure = self.confidence if self.confidence is not None else 1.0
        lost = math.inf if self.estimated is None else error
        return -lost, sure, float(self.num_inliers or 0), self.name


def query_facts(query: QueryResult) -> list[str]:
    """The outcome of a query in words, in order."""
    said = []
    if query.outcome == "missing":
        said.append(f"no pose ({query.reason})" if query.reason else "no pose")
    elif not math.isnan(query.position_m):
        error = f"{format_metres(query.position_m)} m, {format_degrees(query.angle_deg)} deg"
        said.append(f"{error} off")
    if query.outcome == "fallback":
        said.append(f"fallback pose ({query.reason})")
    if query.num_inliers is not None:
        said.append(f"{query.num_inliers} inliers of {query.num_matches}")
    if query.confidence is not None:
        said.append(f"confidence {query.confidence:.2f}")
    return said


def shown_queries(result: Evaluation | ResultWithoutTruth) -> list[ShownQuery]:
    """The queries of a result, the worst first."""
    evaluation = result if isinstance(result, Evaluation) else None
    poses = result.estimated if isinstance(result, Evaluation) else result.poses
    shown = []
    attributes = [own.name for own in fields(QueryResult)]
    for query in result.queries:
        name = query.image
        known = {attribute: getattr(query, attribute) for attribute in attributes}
        if evaluation is not None:
            known["image"] = evaluation.image(name)
        if name not in poses:
            color, meaning = NO_POSE_COLOR, "no pose"
        else:
            color, meaning = _color(query, () if evaluation is None else evaluation.thresholds)
        shown.append(
            ShownQuery(
                **known,
                name=name,
                estimated=poses.get(name),
                truth=None if evaluation is None else evaluation.truth.get(name),
                color=color,
                meaning=meaning,
            )
        )
    return sorted(shown, key=ShownQuery.rank)


def _color(query: QueryResult, thresholds: Sequence[Threshold]) -> tuple[str, str]:
    """Colour of a query with a pose, and its meaning."""
    if thresholds:
        shown = thresholds[: len(_SCALE) - 1]
        for color, threshold in zip(_SCALE, shown, strict=False):
            if threshold.holds(query.position_m, query.angle_deg):
                return color, f"within {threshold}"
        return _SCALE[-1], f"beyond {shown[-1]}"
    if query.confidence is None:
        return UNKNOWN_COLOR, "pose, confidence not known"
    for color, least in zip(_SCALE, _SURE, strict=False):
        if query.confidence >= least:
            return color, f"confidence {least:g} or more"
    return _SCALE[-1], f"confidence below {_SURE[-1]:g}"


def legend(queries: Sequence[ShownQuery]) -> list[tuple[str, str]]:
    """The colours of queries and their meaning, from right to wrong, those in use alone."""
    used = {query.meaning: query.color for query in queries}
    order = [*_SCALE, UNKNOWN_COLOR, NO_POSE_COLOR]
    return [(used[m], m) for m in sorted(used, key=lambda m: order.index(used[m]))]


@dataclass(frozen=True)
class Chosen:
    """A query to show beside what it matches.

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


def _chosen(evaluation: Evaluation, query: QueryResult, *facts: str) -> Chosen:
    """Its candidates are those its pose comes from; where nothing says so, its pair's reference."""
    name, pair = query.image, evaluation.pairs.get(query.image)
    candidates = query.candidates or (() if pair is None else (pair.reference,))
    image = evaluation.image(name)
    return Chosen(name, image, facts, candidates, evaluation.truth[name], "true")


def order_of_badness(query: QueryResult) -> tuple[float, float, str]:
    """Sorts queries the worst first: those without a pose, then by falling error, then by name."""
    return -query.position_m, -query.angle_deg, query.image


def worst_queries(evaluation: Evaluation) -> list[Chosen]:
    """The worst queries of a result; at most half of them without a pose, where others are left.

    Of those without a pose the ones with most inliers come first: they failed most narrowly.
    """
    ranked = sorted(evaluation.queries, key=order_of_badness)
    lost = [query for query in ranked if query.outcome == "missing"]
    lost.sort(key=lambda query: (-(query.num_inliers or 0), query.image))
    posed = [query for query in ranked if query.outcome != "missing"]
    num_posed = min(len(posed), max(NUM_SHOWN - len(lost), (NUM_SHOWN + 1) // 2))
    shown = posed[:num_posed] + lost[: NUM_SHOWN - num_posed]
    return [_chosen(evaluation, query, "; ".join(query_facts(query))) for query in shown]


def disputed_queries(evaluations: Sequence[Evaluation]) -> list[tuple[int, Chosen]]:
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
    chosen = by_dispute[: NUM_SHOWN - NUM_SHOWN // 3]
    chosen += [i for i in by_error if i not in set(chosen)][: NUM_SHOWN - len(chosen)]
    found = []
    for index in chosen:
        worst = int(np.argmax(errors[:, index]))
        facts = (f"{e.label}: {', '.join(query_facts(e.queries[index]))}" for e in evaluations)
        of_worst = evaluations[worst]
        found.append((worst, _chosen(of_worst, of_worst.queries[index], *facts)))
    return found


def doubtful_queries(result: ResultWithoutTruth) -> list[Chosen]:
    """Localized queries that are least sure: far from every candidate, or of few inliers."""
    localized = [query for query in result.queries if query.outcome == "localized"]
    known = [q.num_inliers for q in localized if q.num_inliers is not None]
    few = float(np.quantile(known, 0.25)) if known else -math.inf

    def doubt(query: QueryResult) -> tuple[bool, float, str]:
        far = query.near is not None and query.near.nearest_m > 25.0
        count = math.inf if query.num_inliers is None else query.num_inliers
        return not (far and count <= few), count, query.image

    def facts(query: QueryResult) -> list[str]:
        said, near = [], query.near
        if query.num_inliers is not None:
            said.append(f"{query.num_inliers} inliers of {query.num_matches}")
        if near is not None and math.isfinite(near.first_m):
            said.append(f"{format_metres(near.first_m)} m from its first candidate")
        if near is not None:
            said.append(f"{format_metres(near.nearest_m)} m from the nearest candidate")
        return said

    return [
        Chosen(
            *(q.image, q.image, ("; ".join(facts(q)),)),
            *(q.candidates, result.poses[q.image], "estimated"),
        )
        for q in sorted(localized, key=doubt)[:NUM_SHOWN]
    ]


@dataclass(eq=False)
class StoredInliers:
    """The 2D-3D matches of queries that agree with their poses, from what a run left behind.

    A workspace keeps the matches of a query with map images, and the map says which of their
    keypoints observe a point; those whose point lies within 12 pixels of the keypoint under the
    query's pose are inliers. Nothing is known where matches, keypoints or points are missing or
    broken: a picture without some inliers is better than none. Poses in memory bring their own.
    """

    context: ResultContext
    _found: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(
        init=False, default_factory=dict
    )

    @cached_property
    def _sources(self) -> list[tuple[FeatureReader, MatchesReader, MapIndex]]:
        # only those who draw inliers wait for what reads maps
        from megloc_kapture.stages.query_poses import type_in_map
        from megloc_kapture.stages.shared_index import index_map

        sources: list[tuple[FeatureReader, MatchesReader, MapIndex]] = []
        queries, mapping = self.context.queries, self.context.mapping
        if queries is None or mapping is None or not mapping.has_points():
            return sources
        with contextlib.suppress(DataError):
            kept = set(queries.types("matches"))
            # those of a guided pyramid hold the others
            kept -= {base_type(name) for name in kept if base_type(name) != name}
            for name in sorted(kept & set(queries.types("keypoints"))):
                index = index_map(mapping, type_in_map(mapping, name))
                sources.append((queries.keypoints(name), queries.matches(name), index))
        return sources

    @property
    def known(self) -> bool:
        """Whether matches and points are there at all."""
        return bool(self._sources or self.context.localized)

    def of(self, query: ShownQuery) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (K, 2) of the inliers of a query's pose, and their points (K, 3) in the world."""
        if query.image not in self._found:
            self._found[query.image] = self._read(query)
        return self._found[query.image]

    def _read(self, query: ShownQuery) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        here, queries = self.context.localized.get(query.image), self.context.queries
        if here is not None and here.inlier_points_world is not None:
            px, xyz = here.inlier_points_px, here.inlier_points_world
            return (np.zeros((len(xyz), 2)) if px is None else px), xyz
        if query.estimated is None or query.outcome != "localized" or queries is None:
            return _NOTHING
        found = [_NOTHING]
        with contextlib.suppress(DataError):
            for keypoints, matches, index in self._sources:
                camera = queries.read().camera_of(query.image)
                pairs = [(query.image, image) for image in query.candidates]
                read = [(pair[1], *matches.read(*pair)) for pair in pairs if pair in matches]
                if not read or query.image not in keypoints:
                    continue
                stored = keypoints.read(query.image)
                one = TypedMatches(index, stored, read).correspondences()
                pixels = np.asarray(stored[:, :2], np.float64)
                if len(pixels) <= one.keypoint_ids.max(initial=-1):
                    continue
                px, xyz = pixels[one.keypoint_ids], index.xyz[one.point_ids]
                apart = np.linalg.norm(project(camera, query.estimated, xyz) - px, axis=1)
                found.append((px[apart <= INLIER_PX], xyz[apart <= INLIER_PX]))
        return np.concatenate([px for px, _ in found]), np.concatenate([xyz for _, xyz in found])


def spread(number: int, most: int) -> NDArray[np.int64]:
    """At most ``most`` of ``number`` positions, evenly spread; the same each time."""
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))
