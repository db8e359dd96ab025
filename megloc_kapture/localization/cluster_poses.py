"""Cluster-wise localization: one pose per cluster of candidates, the best one refined.

MegLoc, section "Cluster-wise localization": retrieval returns images of several similar locations,
and matches with images of one location are outliers to the pose at another. So candidates are
clustered by camera centres or co-visibility, and the query is localized with each cluster
separately.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from megloc_kapture.errors import PluginError
from megloc_kapture.localization.absolute_pose import (
    AbsolutePoseOptions,
    PoseEstimate,
    estimate_pose,
    refine_pose,
    transform_covariance,
)
from megloc_kapture.localization.confidence import match_sources, with_confidence
from megloc_kapture.localization.focal_length import (
    estimate_with_intrinsics,
    focal_misfit,
    is_uncertain,
    refine_with_intrinsics,
)
from megloc_kapture.localization.map_index import Correspondences, MapIndex, PoseProblem, QueryView
from megloc_kapture.localization.ranking import poses_agree
from megloc_kapture.localization.structure import displacements_rad
from megloc_kapture.plugins import HypothesisView, PoseHypothesis, RankingScene
from megloc_kapture.values import Failure, Options, Pose

Rank = Callable[[Sequence[PoseHypothesis]], NDArray[np.float64]]
OfViews = Sequence[Sequence[Correspondences]]
"""2D-3D matches of each view, by keypoints type."""


# images that share fewer points are not linked
_MIN_SHARED_POINTS = 10
# a pose is estimated for at most this many clusters, those with the most matches
MAX_CLUSTERS = 10


class ClusterOptions(Options):
    by: Literal["none", "poses", "covisibility"] = Field(
        default="covisibility",
        description="none: all candidates in one cluster; poses: images with nearby camera "
        "centres; covisibility: images that see the same points",
    )
    radius: float | None = Field(
        default=None,
        gt=0,
        description="for poses: largest distance between two linked camera centres, in map units; "
        "connected images form a cluster",
    )

    @model_validator(mode="after")
    def _has_scale(self) -> ClusterOptions:
        if self.by == "poses" and self.radius is None:
            raise ValueError("clusters by poses need a radius, in the map's unit")
        return self


def cluster_by_centers(centers: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """Cluster centres (N, 3) by single linkage; labels (N,) in order of first members."""
    if len(centers) == 0:
        return np.zeros(0, np.int64)
    pairs = cKDTree(centers).query_pairs(radius, output_type="ndarray")
    return _components(len(centers), pairs)


def cluster_by_shared_points(
    shared: NDArray[np.int64], min_shared_points: int
) -> NDArray[np.int64]:
    """Cluster images by numbers of shared points (N, N); labels (N,) in order of first members.

    If no two images share a point, as when all points come from depth, all form one cluster.
    """
    apart = shared - np.diag(np.diag(shared))
    if not apart.any():
        return np.zeros(len(shared), np.int64)
    return _components(len(shared), np.argwhere(np.triu(apart) >= min_shared_points))


def cluster_candidates(
    images: Sequence[str],
    frames: Sequence[str],
    options: ClusterOptions,
    *,
    centers: Mapping[str, NDArray[np.float64]],
    indices: Sequence[MapIndex],
) -> list[tuple[str, ...]]:
    """Divide candidates, best first, into clusters within one coordinate frame each.

    ``centers`` are camera centres (3,); ``indices`` has one map index per keypoints type.
    """
    clusters: list[list[int]] = []
    for frame in dict.fromkeys(frames):
        members = [at for at, frame_of_image in enumerate(frames) if frame_of_image == frame]
        names = [images[at] for at in members]
        if options.by == "poses" and options.radius is not None:
            labels = cluster_by_centers(np.array([centers[name] for name in names]), options.radius)
        elif options.by == "covisibility":
            shared = sum(
                (index.shared_points(names) for index in indices),
                np.zeros((len(names), len(names)), np.int64),
            )
            labels = cluster_by_shared_points(shared, _MIN_SHARED_POINTS)
        else:
            labels = np.zeros(len(names), np.int64)
        clusters += [
            [members[at] for at in np.flatnonzero(labels == label)] for label in np.unique(labels)
        ]
    return [tuple(images[at] for at in cluster) for cluster in sorted(clusters)]


def _components(count: int, pairs: NDArray[np.integer]) -> NDArray[np.int64]:
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def interleave(rankings: Sequence[Sequence[str]]) -> list[str]:
    ranks = zip_longest(*rankings)
    return list(dict.fromkeys(name for rank in ranks for name in rank if name is not None))


def localize_in_clusters(
    views: Sequence[QueryView],
    clusters: Sequence[Sequence[str]],
    options: AbsolutePoseOptions,
    *,
    rank: Rank,
    frames: Sequence[str] | None = None,
    centers: Mapping[str, NDArray[np.float64]] | None = None,
    min_confidence: float | None = None,
    scene: RankingScene | None = None,
) -> tuple[Pose | Failure, PoseProblem | None]:
    """Estimate one pose per cluster of candidate images and refine the best.

    Two clusters are merged first if the pose of one explains the inliers of the other: images that
    look in different directions share no points but may show the same location. For a rig, the pose
    is ``rig_from_world`` and the inlier mask runs over views, then keypoints types.

    Parameters
    ----------
    rank : function that scores hypotheses; higher is better.
    frames : coordinate frame of each cluster; clusters of different frames are not merged.
    centers : camera centres (3,) of the map images; needed for ``min_confidence``.
    min_confidence : poses of lower confidence fail; None computes no confidence.
    scene : reader of query and map images, whose pixels are compared if the residuals of a pose are
        unusually large.
    """
    clock = Clock()
    matched = interleave([view.matched_images() for view in views])
    rank_of = {image: rank for rank, image in enumerate(matched)}
    clusters = [[image for image in cluster if image in rank_of] for cluster in clusters]
    every = [typed for view in views for typed in view.matches]
    counts = [sum(int(typed.are_with(cluster).sum()) for typed in every) for cluster in clusters]
    by_matches = sorted(range(len(clusters)), key=lambda at: (-counts[at], at))
    tried = sorted(at for at in by_matches[:MAX_CLUSTERS] if counts[at])
    clock.lap("correspondences")

    def attempt(cluster: Sequence[str], frame: str) -> _Attempt:
        correspondences = [
            [typed.correspondences(cluster) for typed in view.matches] for view in views
        ]
        problem = PoseProblem.of(
            [view.view(of_view) for view, of_view in zip(views, correspondences, strict=True)]
        )
        clock.lap("correspondences")
        if is_uncertain(problem):
            problem, estimate = estimate_with_intrinsics(problem, options)
        else:
            estimate = estimate_pose(problem, options)
        hypothesis = None
        if isinstance(estimate, PoseEstimate):
            hypothesis = _hypothesis(tuple(cluster), views, problem, estimate, options)
        clock.lap("estimation")
        return _Attempt(tuple(cluster), frame, correspondences, problem, estimate, hypothesis)

    attempts = [attempt(clusters[at], frames[at] if frames else "") for at in tried]
    attempts = _join_agreeing(attempts, attempt, rank_of.__getitem__)
    if not attempts:
        return Failure("no match has a map point", seconds=clock.seconds), None
    hypotheses = [each.hypothesis for each in attempts if each.hypothesis is not None]
    of_ranker = np.asarray(rank(hypotheses) if hypotheses else (), np.float64)
    if of_ranker.shape != (len(hypotheses),) or np.isnan(of_ranker).any():
        wanted = f"expected {len(hypotheses)} numbers"
        raise PluginError(f"the pose ranker returned {of_ranker.tolist()}, {wanted}")
    scores = iter(of_ranker.tolist())
    ranked = tuple(
        each.result(None if each.hypothesis is None else next(scores)) for each in attempts
    )
    clock.lap("ranking")
    best = _best(ranked)
    problem, estimate = attempts[best].problem, attempts[best].estimate
    if isinstance(estimate, Failure):
        others = f", the best of {len(ranked)} clusters" if len(ranked) > 1 else ""
        counted = estimate.num_matches, estimate.num_inliers
        result: Pose | Failure = Failure(estimate.reason + others, *counted)
    else:
        if is_uncertain(problem):
            problem, result = refine_with_intrinsics(problem, estimate, options, views[0].camera)
        else:
            result = refine_pose(problem, estimate, options)
        clock.lap("refinement")
        if min_confidence is not None and isinstance(result, Pose):
            of_views = attempts[best].correspondences
            sources = match_sources(views, of_views, ranked[best].candidates, centers or {})
            if scene is not None:
                seen = partial(displacements_rad, problem, views, of_views, scene)
                sources = replace(sources, displacements_rad=seen)
            known = result.camera is None
            misfit = focal_misfit(problem, result, options) if known else None
            result = with_confidence(
                problem, result, sources, options.max_error_px, min_confidence, misfit
            )
            clock.lap("confidence")
    result = replace(
        result, candidates=ranked[best].candidates, clusters=ranked, seconds=clock.seconds
    )
    if isinstance(result, Failure):
        return result, None
    pose = replace(
        result,
        cluster=best,
        inlier_points_px=problem.points_px[result.inliers],
        inlier_points_world=problem.points[result.inliers] + problem.offset,
    )
    return pose, problem


@dataclass(frozen=True, eq=False)
class _Attempt:
    cluster: tuple[str, ...]
    frame: str
    correspondences: OfViews
    problem: PoseProblem
    estimate: PoseEstimate | Failure
    hypothesis: PoseHypothesis | None

    def result(self, score: float | None) -> Pose | Failure:
        estimate = self.estimate
        if isinstance(estimate, Failure):
            return replace(estimate, candidates=self.cluster)
        counted = (len(estimate.inliers), estimate.num_inliers)
        return Pose(estimate.rig_from_world, *counted, candidates=self.cluster, score=score)

    def agrees(self, other: _Attempt) -> bool:
        if self.frame != other.frame or self.hypothesis is None or other.hypothesis is None:
            return False
        return poses_agree(self.hypothesis, other.hypothesis)


def _join_agreeing(
    attempts: list[_Attempt],
    attempt: Callable[[Sequence[str], str], _Attempt],
    rank_of: Callable[[str], int],
) -> list[_Attempt]:
    """Merge attempts with agreeing poses unless that loses inliers; keep the order."""
    groups: list[list[_Attempt]] = []
    for each in attempts:
        group = next((group for group in groups if each.agrees(group[0])), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    merged: list[_Attempt] = []
    for group in groups:
        together = group[0]
        if len(group) > 1:
            images = [image for each in group for image in each.cluster]
            together = attempt(sorted(images, key=rank_of), together.frame)
        kept = together.estimate.num_inliers >= max(each.estimate.num_inliers for each in group)
        merged += [together] if kept else group
    return merged


def _best(clusters: Sequence[Pose | Failure]) -> int:
    """Return the index of the cluster with the best score; without scores, the most inliers."""

    def key(at: int) -> tuple[bool, float, int, int, int]:
        cluster = clusters[at]
        score = -np.inf if cluster.score is None else cluster.score
        return cluster.score is not None, score, cluster.num_inliers, cluster.num_matches, -at

    return max(range(len(clusters)), key=key)


def _hypothesis(
    images: tuple[str, ...],
    views: Sequence[QueryView],
    problem: PoseProblem,
    estimate: PoseEstimate,
    options: AbsolutePoseOptions,
) -> PoseHypothesis:
    parts = map(problem.split, (problem.points_px, estimate.errors_px, estimate.inliers))
    posed = tuple(
        HypothesisView(
            name=query.name,
            camera=view.camera,
            cam_from_world=view.cam_from_rig @ estimate.rig_from_world,
            points_px=points_px,
            points_world=view.points_world,
            errors_px=errors_px,
            inliers=inliers,
        )
        for query, view, points_px, errors_px, inliers in zip(
            views, problem.views, *parts, strict=True
        )
    )
    return PoseHypothesis(images, posed, options.max_error_px)


class Clock:
    """Elapsed seconds by step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def start(self) -> None:
        """Discard the time since the last lap."""
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Add the time since the last lap to a step."""
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._last
        self._last = now


def poses_of_cameras(
    views: Sequence[QueryView], rig: Pose, problem: PoseProblem
) -> list[Pose | Failure]:
    """Return one result per camera of a rig localized by :func:`localize_in_clusters`.

    A camera without inliers fails, even though the rig has a pose.
    """
    assert rig.inliers is not None and rig.covariance is not None
    assert rig.inlier_points_px is not None and rig.inlier_points_world is not None
    of_views = problem.split(rig.inliers)
    starts = np.cumsum([inliers.sum() for inliers in of_views])[:-1]
    px_of_views = np.split(rig.inlier_points_px, starts)
    points_of_views = np.split(rig.inlier_points_world, starts)
    cameras: list[Pose | Failure] = []
    for view, inliers, px, points in zip(
        views, of_views, px_of_views, points_of_views, strict=True
    ):
        clusters = tuple(
            cluster
            if cluster.cam_from_world is None
            else replace(cluster, cam_from_world=view.cam_from_rig @ cluster.cam_from_world)
            for cluster in rig.clusters
        )
        pose = replace(
            rig,
            name=view.name,
            cam_from_world=view.cam_from_rig @ rig.cam_from_world,
            clusters=clusters,
            num_matches=len(inliers),
            num_inliers=len(px),
            inliers=inliers,
            inlier_points_px=px,
            inlier_points_world=points,
            covariance=transform_covariance(rig.covariance, view.cam_from_rig),
        )
        failure = Failure(
            "no inlier in this camera; other cameras of its rig were localized",
            name=view.name,
            num_matches=len(inliers),
            candidates=rig.candidates,
            clusters=clusters,
            seconds=rig.seconds,
        )
        cameras.append(pose if len(px) else failure)
    return cameras
