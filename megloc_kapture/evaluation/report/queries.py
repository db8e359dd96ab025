"""Queries in reports and the 3D view: order, colours, facts, and stored inliers; the top view."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import Threshold, from_fine_to_coarse
from megloc_kapture.evaluation.report.content import format_movement
from megloc_kapture.evaluation.results import ResultContext
from megloc_kapture.evaluation.scoring import Evaluation, QueryResult
from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import invert_quats, rotate
from megloc_kapture.io.kapture import FeatureReader, MatchesReader
from megloc_kapture.localization.map_index import MapIndex, TypedMatches
from megloc_kapture.matching.guided_pyramid import base_type

NUM_SHOWN = 10
# inlier threshold, as in pose estimation
INLIER_PX = 12.0
# from small to large errors; distinguishable with a colour vision deficiency
_SCALE = ("#4cc3f0", "#7fd17f", "#f4d35e", "#ff9f45", "#ff4d4d")
NO_POSE_COLOR, UNKNOWN_COLOR = "#9aa5b1", "#c9a7ff"
# lower bounds of confidence for the first colours of _SCALE
_CONFIDENCES = (0.95, 0.8, 0.6)


def query_facts(query: QueryResult) -> list[str]:
    """Return the outcome of a query as phrases for the report."""
    facts = []
    if query.outcome == "missing":
        facts.append(f"no pose ({query.reason})" if query.reason else "no pose")
    elif not math.isnan(query.position_m):
        facts.append(f"{format_movement(query.position_m, query.angle_deg)} off")
    if query.outcome == "fallback":
        facts.append(f"fallback pose ({query.reason})")
    if query.num_inliers is not None:
        facts.append(f"{query.num_inliers} inliers of {query.num_matches}")
    if query.confidence is not None:
        facts.append(f"confidence {query.confidence:.2f}")
    return facts


def shown_queries(evaluation: Evaluation) -> list[QueryResult]:
    """Return all queries with colours, worst first."""
    shown = []
    for query in evaluation.queries:
        color, meaning = NO_POSE_COLOR, "no pose"
        if query.cam_from_world is not None:
            color, meaning = _color(query, evaluation.thresholds)
        shown.append(replace(query, color=color, meaning=meaning))
    return sorted(shown, key=_worst_first)


def _worst_first(query: QueryResult) -> tuple[float, float, float, str]:
    """Return a sort key: no pose first, then by error, confidence, number of inliers, name."""
    error = 0.0 if math.isnan(query.position_m) else query.position_m
    confidence = query.confidence if query.confidence is not None else 1.0
    badness = math.inf if query.cam_from_world is None else error
    return -badness, confidence, float(query.num_inliers or 0), query.name


def _color(query: QueryResult, thresholds: Sequence[Threshold]) -> tuple[str, str]:
    if thresholds:
        shown = from_fine_to_coarse(thresholds)[: len(_SCALE) - 1]
        for color, threshold in zip(_SCALE, shown, strict=False):
            if threshold.holds(query.position_m, query.angle_deg):
                return color, f"within {threshold}"
        return _SCALE[-1], f"beyond {shown[-1]}"
    if query.confidence is None:
        return UNKNOWN_COLOR, "pose, confidence unknown"
    for color, least in zip(_SCALE, _CONFIDENCES, strict=False):
        if query.confidence >= least:
            return color, f"confidence {least:g} or more"
    return _SCALE[-1], f"confidence below {_CONFIDENCES[-1]:g}"


def frame_of_query(query: QueryResult, frames: Mapping[str, str]) -> str:
    """Return the frame of a query, else of its best candidate with a frame, else the condition."""
    known = (frames[image] for image in (query.image, *query.candidates) if image in frames)
    return next(known, query.condition)


def legend(queries: Sequence[QueryResult]) -> list[tuple[str, str]]:
    """Return the colours in use and their meanings, from best to worst."""
    used = {query.meaning: query.color for query in queries}
    order = [*_SCALE, UNKNOWN_COLOR, NO_POSE_COLOR]
    return [(used[m], m) for m in sorted(used, key=lambda m: order.index(used[m]))]


def worst_queries(queries: Sequence[QueryResult]) -> list[QueryResult]:
    """Return up to ten of the ranked queries, at least half of them with a pose if possible."""
    lost = [query for query in queries if query.cam_from_world is None]
    posed = [query for query in queries if query.cam_from_world is not None]
    num_posed = min(len(posed), max(NUM_SHOWN - len(lost), (NUM_SHOWN + 1) // 2))
    return posed[:num_posed] + lost[: NUM_SHOWN - num_posed]


# keypoints and matches of the queries, and map points, of one keypoints type
InlierSource = tuple[FeatureReader, MatchesReader, MapIndex]


def inlier_sources(context: ResultContext) -> list[InlierSource]:
    """Open the stored data from which inliers can be recomputed; broken data are skipped."""
    # slow import
    from megloc_kapture.stages.query_poses import type_in_map
    from megloc_kapture.stages.scene import index_map

    sources: list[InlierSource] = []
    queries, mapping = context.queries, context.mapping
    if queries is None or mapping is None or not mapping.has_points():
        return sources
    with contextlib.suppress(DataError):
        types = set(queries.types("matches"))
        # skip the base type of a guided pyramid, which includes its matches
        types -= {base_type(name) for name in types if base_type(name) != name}
        for name in sorted(types & set(queries.types("keypoints"))):
            index = index_map(mapping, type_in_map(mapping, name))
            sources.append((queries.keypoints(name), queries.matches(name), index))
    return sources


def inliers_of(
    query: QueryResult, context: ResultContext, sources: Sequence[InlierSource]
) -> NDArray[np.float64]:
    """Return world points (K, 3) of a pose's inliers, recomputed if they are not in memory.

    Missing or broken data are skipped: a picture without inliers is better than none.
    """
    pose, queries = context.localized.get(query.image), context.queries
    if pose is not None and pose.inlier_points_world is not None:
        return pose.inlier_points_world
    inliers = [np.zeros((0, 3))]
    if query.cam_from_world is None or query.outcome != "localized" or queries is None:
        return inliers[0]
    with contextlib.suppress(DataError):
        for keypoints, matches, index in sources:
            camera = queries.read().camera_of(query.image)
            pairs = [(query.image, image) for image in query.candidates]
            read = [(pair[1], *matches.read(*pair)) for pair in pairs if pair in matches]
            if not read or query.image not in keypoints:
                continue
            stored = keypoints.read(query.image)
            ids = TypedMatches(index, stored, read).correspondences()
            pixels = np.asarray(stored[:, :2], np.float64)
            if len(pixels) <= ids.keypoint_ids.max(initial=-1):
                continue
            px, xyz = pixels[ids.keypoint_ids], index.xyz[ids.point_ids]
            errors_px = np.linalg.norm(project(camera, query.cam_from_world, xyz) - px, axis=1)
            inliers.append(xyz[errors_px <= INLIER_PX])
    return np.concatenate(inliers)


def spread(number: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of ``number`` positions, evenly spread."""
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))


# length of the mean downward direction below which the cameras have no common vertical
_MIN_AGREEMENT = 0.5
# a vertical this close to a world axis is snapped to it, for labels x, y and z
_AXIS_COSINE = float(np.cos(np.deg2rad(15.0)))


def top_view(
    quats_wxyz: NDArray[np.float64], centers: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[str, str]]:
    """Return the axes of a view from above, and their labels.

    Parameters: quaternions of ``cam_from_world`` (N, 4) and camera centres (N, 3), N at least 1.
    The vertical is the mean downward direction of the images; if these directions disagree, it is
    the direction of least spread of the centres. The axes (2, 3) are orthonormal world directions
    that point right and up on the page.
    """
    down = rotate(invert_quats(quats_wxyz), np.array([0.0, 1.0, 0.0])).mean(axis=0)
    length = float(np.linalg.norm(down))
    spread = centers - centers.mean(axis=0)
    axes = np.linalg.eigh(spread.T @ spread)[1].T[::-1]
    upward = -down / length if length >= _MIN_AGREEMENT else _signed(axes[2])
    nearest = int(np.argmax(np.abs(upward)))
    if abs(upward[nearest]) >= _AXIS_COSINE:
        first, second = (nearest + 1) % 3, (nearest + 2) % 3
        if upward[nearest] < 0:  # swap, so that the page is not mirrored
            first, second = second, first
        return np.eye(3)[[first, second]], ("xyz"[first], "xyz"[second])
    right = axes[0] - (axes[0] @ upward) * upward
    if np.linalg.norm(right) < 1e-6:  # the cameras are on one vertical line
        right = np.eye(3)[int(np.argmin(np.abs(upward)))]
        right = right - (right @ upward) * upward
    right = _signed(right / np.linalg.norm(right))
    return np.stack([right, np.cross(upward, right)]), ("along the map", "across the map")


def _signed(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    return direction if direction[int(np.argmax(np.abs(direction)))] > 0 else -direction
