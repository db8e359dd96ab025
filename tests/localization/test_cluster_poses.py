"""Poses of clusters: two places that look alike, and a query at one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from poses import error_vector, rigid
from pydantic import ValidationError
from scipy.cluster.hierarchy import fcluster, linkage

from megloc_kapture.errors import PluginError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.geometry.poses import perturbed
from megloc_kapture.localization import cluster_poses as module
from megloc_kapture.localization.absolute_pose import AbsolutePoseOptions
from megloc_kapture.localization.cluster_poses import (
    ClusterOptions,
    cluster_by_centers,
    cluster_by_shared_points,
    cluster_candidates,
    interleave,
    localize_in_clusters,
    poses_of_cameras,
    transform_covariance,
)
from megloc_kapture.localization.map_index import (
    ImageMatches,
    MapIndex,
    PoseProblem,
    QueryView,
    TypedMatches,
)
from megloc_kapture.plugins import PoseHypothesis
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform

CAMERA = Camera("OPENCV", 640, 480, (500.0, 505.0, 320.0, 240.0, -0.1, 0.02, 0.001, -0.001))
ALONE = RigidTransform.identity()
PER_PLACE = 100
FAR = np.array([50.0, 0.0, 0.0])
TRUTH = rigid(np.radians([3, -5, 2]), [0.2, -0.1, 0.4])
PLACES = ("right/1", "right/2"), ("wrong/1", "wrong/2")


def points(seed: int = 0) -> NDArray[np.float64]:
    """Return the same points at two places, 50 m apart."""
    rng = np.random.default_rng(seed)
    place = rng.uniform((-2, -2, 4), (2, 2, 8), (PER_PLACE, 3))
    return np.concatenate([place, place + FAR])


def index(xyz: NDArray[np.float64]) -> MapIndex:
    """Index a map whose images see all points of their place in the points' order."""
    names = tuple(name for place in PLACES for name in place)
    rows = np.arange(PER_PLACE)
    return MapIndex.build(
        xyz,
        names,
        np.repeat(np.arange(4), PER_PLACE),
        np.tile(rows, 4),
        np.concatenate([rows, rows, rows + PER_PLACE, rows + PER_PLACE]),
    )


def matches(shares: Mapping[str, Sequence[int]]) -> list[ImageMatches]:
    """Match keypoints of images to the query's keypoints with the same row."""
    return [
        (name, np.stack([np.array(rows)] * 2, axis=1), np.full(len(rows), 0.9))
        for name, rows in shares.items()
    ]


def view(
    shares: Mapping[str, int | Sequence[int]], cam_from_rig: RigidTransform = ALONE, name: str = "q"
) -> QueryView:
    """Return a view of the right place; ``shares`` has rows or counts of matches by image."""
    rows = {n: range(share) if isinstance(share, int) else share for n, share in shares.items()}
    xyz = points()
    seen = project(CAMERA, cam_from_rig @ TRUTH, xyz[:PER_PLACE]).astype(np.float32)
    return QueryView(name, CAMERA, (TypedMatches(index(xyz), seen, matches(rows)),), cam_from_rig)


def by_inliers(hypotheses: Sequence[PoseHypothesis]) -> NDArray[np.float64]:
    return np.array([sum(v.inliers.sum() for v in h.views) for h in hypotheses], np.float64)


def localize(
    *views: QueryView, clusters: Sequence[Sequence[str]] = PLACES, **more: object
) -> tuple[Pose | Failure, PoseProblem | None]:
    settings: dict[str, object] = {"rank": by_inliers} | more
    return localize_in_clusters(views, clusters, AbsolutePoseOptions(), **settings)  # type: ignore[arg-type]


SHARES = {"wrong/1": 60, "right/1": 80, "right/2": 90, "wrong/2": 20}


def test_each_cluster_has_its_pose_and_the_best_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    result, problem = localize(view(SHARES))
    assert isinstance(result, Pose)
    assert np.linalg.norm(result.cam_from_world.center() - TRUTH.center()) < 1e-5
    assert result.candidates == PLACES[0] and result.cluster == 0
    right, wrong = result.clusters
    assert (right.num_matches, right.num_inliers, right.score) == (90, 90, 90.0)
    assert (wrong.num_matches, wrong.num_inliers, wrong.candidates) == (60, 60, PLACES[1])
    assert wrong.cam_from_world is not None
    # the same view at the other place, 50 m away
    np.testing.assert_allclose(wrong.cam_from_world.center() - TRUTH.center(), FAR, atol=1e-3)
    assert problem is not None and len(problem.points) == 90
    steps = {"correspondences", "estimation", "ranking", "refinement"}
    assert result.covariance is not None and set(result.seconds) == steps
    # only the clusters with the most matches are tried
    monkeypatch.setattr(module, "MAX_CLUSTERS", 1)
    result, _ = localize(view(SHARES), clusters=PLACES[::-1])
    assert [cluster.candidates for cluster in result.clusters] == [PLACES[0]]


def test_the_ranker_chooses_the_cluster() -> None:
    asked: list[tuple[str, ...]] = []

    def rank(hypotheses: Sequence[PoseHypothesis]) -> NDArray[np.float64]:
        asked.extend(h.images for h in hypotheses)
        (shown,) = hypotheses[1].views
        assert shown.name == "q" and shown.camera == CAMERA
        assert shown.errors_px[shown.inliers].max() < 0.1
        return np.array([0.0, 1.0])

    result, _ = localize(view(SHARES), rank=rank)
    assert asked == [PLACES[0], PLACES[1]]
    assert isinstance(result, Pose) and result.cluster == 1
    np.testing.assert_allclose(result.cam_from_world.center() - TRUTH.center(), FAR, atol=1e-5)
    # ties go to the first
    result, _ = localize(view(SHARES), rank=lambda hypotheses: [1] * len(hypotheses))
    assert isinstance(result, Pose) and result.cluster == 0
    for scores in (np.ones(1), np.full(2, np.nan)):
        with pytest.raises(PluginError, match=r"ranker returned \[.*\], expected 2 numbers"):
            localize(view(SHARES), rank=lambda _, scores=scores: scores)


def test_clusters_of_the_same_place_are_merged() -> None:
    """Two images of the right place match different keypoints and are in different clusters."""
    query = view({"right/2": range(50, 100), "wrong/1": 70, "right/1": 50})
    split = [("right/2",), ("wrong/1",), ("right/1",)]
    result, _ = localize(query, clusters=split)
    assert isinstance(result, Pose) and result.num_inliers == 100
    assert [cluster.candidates for cluster in result.clusters] == [
        ("right/2", "right/1"),
        ("wrong/1",),
    ]
    apart, _ = localize(query, clusters=split, frames=["a", "a", "b"])
    assert isinstance(apart, Pose) and len(apart.clusters) == 3


def test_a_failure_describes_the_best_cluster() -> None:
    result, _ = localize(view({"wrong/1": 5, "right/1": 9}))
    assert isinstance(result, Failure)
    assert "9 2D-3D matches" in result.reason and "the best of 2 clusters" in result.reason
    assert result.candidates == ("right/1",) and result.num_matches == 9
    assert [cluster.num_matches for cluster in result.clusters] == [9, 5]


def test_without_points_localization_fails() -> None:
    empty = np.zeros(0, np.int64)
    bare = MapIndex.build(np.zeros((0, 3)), (), empty, empty, empty)
    typed = TypedMatches(bare, np.zeros((1, 2), np.float32), matches({"right/1": [0]}))
    result, _ = localize(QueryView("q", CAMERA, (typed,)))
    assert result == Failure("no match has a map point")
    # matches of several keypoint types are used together
    few = view({"right/1": 8}).matches
    assert isinstance(localize(QueryView("q", CAMERA, few))[0], Failure)
    result, _ = localize(QueryView("q", CAMERA, few * 2))
    assert isinstance(result, Pose) and result.num_matches == 16


SIDE = rigid([0.0, 0.21, 0.0], [-0.4, 0.05, 0.1])


@pytest.mark.parametrize("of_side", [{}, {"wrong/1": 20}, {"right/2": 30}])
def test_a_rig_is_localized_even_if_a_camera_has_no_inliers(of_side: dict[str, int]) -> None:
    views = view({"right/1": 90}), view(of_side, SIDE, name="side")
    rig, problem = localize(*views)
    assert isinstance(rig, Pose) and problem is not None
    assert np.linalg.norm(rig.cam_from_world.center() - TRUTH.center()) < 1e-4
    front, side = poses_of_cameras(views, rig, problem)
    assert isinstance(front, Pose) and front.covariance is not None
    assert front.num_matches == front.num_inliers == 90
    if "right/2" in of_side:
        assert isinstance(side, Pose) and side.num_matches == 30
        assert np.linalg.norm(side.cam_from_world.center() - (SIDE @ TRUTH).center()) < 1e-4
        assert side.covariance is not None
    else:
        assert isinstance(side, Failure) and "no inlier in this camera" in side.reason


def test_a_transformed_covariance_is_that_of_the_camera_s_steps() -> None:
    root = np.random.default_rng(3).normal(size=(6, 6))
    camera, size = SIDE @ TRUTH, 1e-6
    steps = [error_vector(camera, SIDE @ perturbed(TRUTH, size * step)) for step in np.eye(6)]
    jacobian = np.stack(steps, axis=1) / size
    expected = jacobian @ root @ root.T @ jacobian.T
    np.testing.assert_allclose(transform_covariance(root @ root.T, SIDE), expected, rtol=1e-4)


def test_rankings_are_interleaved() -> None:
    assert interleave([["a", "b", "c"], ["b", "d"], []]) == ["a", "b", "d", "c"]
    assert interleave([]) == []


NAMES = ("a", "b", "c", "d")
CENTERS = {
    name: np.array([x, 0.0, 0.0]) for name, x in zip(NAMES, (0.0, 10.0, 1.0, 2.5), strict=True)
}


def partition(labels: NDArray[np.int64]) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(labels == label).tolist()) for label in set(labels.tolist())}


@given(
    st.lists(st.tuples(*[st.integers(-20, 20)] * 3), max_size=30, unique=True), st.integers(1, 12)
)
def test_centres_are_clustered_by_single_linkage(centers: Any, radius: int) -> None:
    points = np.array(centers, np.float64).reshape(-1, 3)
    labels = cluster_by_centers(points, radius)
    if len(centers) < 2:
        assert labels.tolist() == [0] * len(centers)
        return
    # a distance equal to the radius joins
    theirs = fcluster(linkage(points, "single"), radius + 1e-9, "distance")
    assert partition(labels) == partition(np.asarray(theirs, np.int64))
    first_seen = [labels.tolist().index(label) for label in range(labels.max() + 1)]
    assert first_seen == sorted(first_seen)


@pytest.mark.parametrize(
    ("shared", "least", "labels"),
    [
        ([[9, 5, 0], [5, 9, 4], [0, 4, 9]], 5, [0, 0, 1]),
        ([[9, 5, 0], [5, 9, 4], [0, 4, 9]], 4, [0, 0, 0]),
        ([[9, 5, 0], [5, 9, 4], [0, 4, 9]], 6, [0, 1, 2]),
        ([[5, 0, 0], [0, 5, 0], [0, 0, 5]], 1, [0, 0, 0]),  # no shared points: a single cluster
    ],
)
def test_images_with_enough_shared_points_join(shared: Any, least: int, labels: list[int]) -> None:
    assert cluster_by_shared_points(np.array(shared), least).tolist() == labels


def small_index() -> MapIndex:
    """a and c see points 0 to 2, b and d see points 3 to 5, c and d both see point 6."""
    seen = {"a": (0, 1, 2), "b": (3, 4, 5), "c": (0, 1, 2, 6), "d": (3, 4, 5, 6)}
    image_ids = [NAMES.index(name) for name in NAMES for _ in seen[name]]
    points = [point for name in NAMES for point in seen[name]]
    keypoints = [row for name in NAMES for row in range(len(seen[name]))]
    return MapIndex.build(
        np.zeros((7, 3)), NAMES, np.array(image_ids), np.array(keypoints), np.array(points)
    )


AC, BD = ("a", "c"), ("b", "d")


@pytest.mark.parametrize(
    ("options", "frames", "types", "expected"),
    [
        ({"by": "none"}, "xxxx", 1, [NAMES]),
        ({"by": "none"}, "xyxy", 1, [AC, BD]),
        ({"by": "poses", "radius": 1.0}, "xxxx", 1, [AC, ("b",), ("d",)]),
        ({"by": "poses", "radius": 1.5}, "xxxx", 1, [("a", "c", "d"), ("b",)]),
        ({"by": "poses", "radius": 100.0}, "xxxy", 1, [("a", "b", "c"), ("d",)]),
        ({"by": "covisibility"}, "xxxx", 1, [AC, BD]),
        # c and d share one point in each of two keypoints types
        ({"by": "covisibility"}, "xxxx", 2, [NAMES]),
    ],
)
def test_candidates_are_clustered_within_their_frames(
    options: dict[str, object],
    frames: str,
    types: int,
    expected: list[tuple[str, ...]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_MIN_SHARED_POINTS", 2)
    chosen = ClusterOptions.model_validate(options)
    indices = [small_index()] * types
    actual = cluster_candidates(NAMES, tuple(frames), chosen, centers=CENTERS, indices=indices)
    assert actual == expected


def test_clusters_by_poses_need_a_radius() -> None:
    with pytest.raises(ValidationError, match="radius"):
        ClusterOptions(by="poses")
