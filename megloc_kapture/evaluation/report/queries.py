"""Queries as reports and the 3D view show them: order, colours, facts, and stored inliers."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import Threshold
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
            if name in evaluation.pairs and not query.candidates:
                known["candidates"] = (evaluation.pairs[name].reference,)
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


def worst_queries(queries: Sequence[ShownQuery]) -> list[ShownQuery]:
    """The worst ten of ranked queries; at most half of them without a pose, if others are left."""
    lost = [query for query in queries if query.estimated is None]
    posed = [query for query in queries if query.estimated is not None]
    num_posed = min(len(posed), max(NUM_SHOWN - len(lost), (NUM_SHOWN + 1) // 2))
    return posed[:num_posed] + lost[: NUM_SHOWN - num_posed]


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
