"""Clusters of candidates, against scipy's single linkage and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.cluster.hierarchy import fcluster, linkage

from megloc_kapture.localization.clusters import (
    ClusterOptions,
    cluster_by_centers,
    cluster_by_shared_points,
    cluster_candidates,
)
from megloc_kapture.localization.map_index import MapIndex

NAMES = ("a", "b", "c", "d")
CENTERS = {
    name: np.array([x, 0.0, 0.0]) for name, x in zip(NAMES, (0.0, 10.0, 1.0, 2.5), strict=True)
}


def partition(labels: NDArray[np.int64]) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(labels == label).tolist()) for label in set(labels.tolist())}


@given(
    st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=2, max_size=30, unique=True),
    st.integers(1, 12),
)
def test_centres_are_joined_as_by_single_linkage(
    centers: list[tuple[int, int, int]], radius: int
) -> None:
    points = np.array(centers, np.float64)
    labels = cluster_by_centers(points, radius)
    # half a unit off the grid's own distances would change nothing; a radius met exactly joins
    theirs = fcluster(linkage(points, "single"), radius + 1e-9, "distance")
    assert partition(labels) == partition(np.asarray(theirs, np.int64))
    first_seen = [labels.tolist().index(label) for label in range(labels.max() + 1)]
    assert first_seen == sorted(first_seen)


def test_few_centres() -> None:
    assert cluster_by_centers(np.zeros((0, 3)), 1.0).tolist() == []
    assert cluster_by_centers(np.zeros((1, 3)), 1.0).tolist() == [0]


def test_shared_points_join_from_the_threshold_on() -> None:
    shared = np.array([[9, 5, 0], [5, 9, 4], [0, 4, 9]])
    assert cluster_by_shared_points(shared, 5).tolist() == [0, 0, 1]
    assert cluster_by_shared_points(shared, 4).tolist() == [0, 0, 0]
    assert cluster_by_shared_points(shared, 6).tolist() == [0, 1, 2]


def test_without_any_shared_point_all_are_one() -> None:
    assert cluster_by_shared_points(np.diag([5, 5, 5]), 1).tolist() == [0, 0, 0]


def index() -> MapIndex:
    """a and c see points 0 to 2, b and d see points 3 to 5, c and d both see point 6."""
    seen = {"a": (0, 1, 2), "b": (3, 4, 5), "c": (0, 1, 2, 6), "d": (3, 4, 5, 6)}
    image_ids = [NAMES.index(name) for name in NAMES for _ in seen[name]]
    points = [point for name in NAMES for point in seen[name]]
    keypoints = [row for name in NAMES for row in range(len(seen[name]))]
    return MapIndex.build(
        np.zeros((7, 3)), NAMES, np.array(image_ids), np.array(keypoints), np.array(points)
    )


def clusters(options: ClusterOptions, frames: str = "xxxx") -> list[tuple[str, ...]]:
    return cluster_candidates(NAMES, tuple(frames), options, centers=CENTERS, indices=[index()])


def test_candidates_are_divided_as_asked() -> None:
    assert clusters(ClusterOptions(by="none")) == [NAMES]
    assert clusters(ClusterOptions(by="poses", radius=1.0)) == [("a", "c"), ("b",), ("d",)]
    assert clusters(ClusterOptions(by="poses", radius=1.5)) == [("a", "c", "d"), ("b",)]
    by = ClusterOptions(by="covisibility", min_shared_points=2)
    assert clusters(by) == [("a", "c"), ("b", "d")]
    assert clusters(ClusterOptions(by="covisibility", min_shared_points=1)) == [NAMES]


def test_frames_are_never_mixed() -> None:
    assert clusters(ClusterOptions(by="none"), "xyxy") == [("a", "c"), ("b", "d")]
    near = ClusterOptions(by="poses", radius=100.0)
    assert clusters(near, "xxxy") == [("a", "b", "c"), ("d",)]


def test_points_shared_in_several_keypoints_types_add_up() -> None:
    options = ClusterOptions(by="covisibility", min_shared_points=2)
    found = cluster_candidates(
        NAMES, ("",) * 4, options, centers=CENTERS, indices=[index(), index()]
    )
    assert found == [NAMES]  # c and d share one point in each


def test_poses_need_a_scale() -> None:
    with pytest.raises(ValidationError, match="radius"):
        ClusterOptions(by="poses")
