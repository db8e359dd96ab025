"""The map's index against a dictionary."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.localization.map_index import (
    Correspondences,
    MapIndex,
    TypedMatches,
    resolve_conflicts,
)

observations = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 9), st.integers(0, 19)), max_size=60
)
# keypoint, point, similarity, image
rows = st.lists(
    st.tuples(
        st.integers(0, 6),
        st.integers(0, 6),
        st.sampled_from([-0.5, -0.0, 0.0, 0.1, 0.5, 0.9, 1e300]),
        st.integers(0, 3),
    ),
    max_size=40,
)
wide = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 2047, 2048, 70_000, 2**31 - 1]),
        st.sampled_from([0, 5, 2048, 2**22, 2**31 - 1]),
        st.floats(allow_nan=False, allow_infinity=False),
        st.integers(0, 3),
    ),
    max_size=40,
)


def build(rows: list[tuple[int, int, int]], names: tuple[str, ...]) -> MapIndex:
    array = np.array(rows, dtype=np.int64).reshape(-1, 3)
    xyz = np.arange(60.0).reshape(20, 3)
    return MapIndex.build(xyz, names, array[:, 0], array[:, 1], array[:, 2])


@given(observations)
def test_observations_of_each_image_ascend(rows: list[tuple[int, int, int]]) -> None:
    names = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    index = build(rows, names)
    for image_id, name in enumerate(names):
        mine = sorted((k, p) for i, k, p in rows if i == image_id)
        keypoints, points = index.observed(name)
        assert list(zip(keypoints.tolist(), points.tolist(), strict=True)) == mine
    assert [len(part) for part in index.observed("not in the map.jpg")] == [0, 0]
    times = [sum(point == p for _, _, p in rows) for point in range(20)]
    assert index.seen_once.tolist() == [number == 1 for number in times]


@given(observations, st.lists(st.sampled_from("abcdz"), max_size=6))
def test_shared_points_equal_to_sets(rows: list[tuple[int, int, int]], asked: list[str]) -> None:
    index = build(rows, ("a", "b", "c", "d"))
    points = [
        {p for i, _, p in rows if "abcd"[i] == name} if name != "z" else set() for name in asked
    ]
    shared = index.shared_points(asked)
    assert (shared.dtype, shared.shape) == (np.int64, (len(asked), len(asked)))
    assert shared.tolist() == [[len(mine & other) for other in points] for mine in points]


def test_observations_of_unknown_images_are_refused() -> None:
    with pytest.raises(ValueError):
        build([(1, 0, 0)], ("a",))


def resolve(matches: list[tuple[int, int, float, int]]) -> Correspondences:
    keypoints, points, similarities, images = zip(*matches, strict=True) if matches else [()] * 4
    return resolve_conflicts(
        np.array(keypoints, dtype=np.int64),
        np.array(points, dtype=np.int64),
        np.array(similarities, dtype=np.float64),
        np.array(images, dtype=np.int64),
        np.zeros(len(matches), np.bool_),
    )


def triples(result: Correspondences) -> list[tuple[int, int, int]]:
    columns = (result.keypoint_ids, result.point_ids, result.support)
    assert all(column.dtype == np.int64 for column in columns)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def greedy(matches: list[tuple[int, int, float, int]]) -> list[tuple[int, int, int]]:
    """Take pairs by number of images, then similarity; each keypoint and point once."""
    support = Counter((k, p) for k, p, _, _ in matches)
    best: dict[tuple[int, int], float] = {}
    for k, p, similarity, _ in matches:
        best[k, p] = max(similarity, best.get((k, p), -np.inf))
    keypoints: set[int] = set()
    points: set[int] = set()
    chosen = []
    for keypoint, point in sorted(support, key=lambda pair: (-support[pair], -best[pair], pair)):
        if keypoint not in keypoints and point not in points:
            keypoints.add(keypoint)
            points.add(point)
            chosen.append((keypoint, point, support[keypoint, point]))
    return sorted(chosen)


@given(st.one_of(rows, wide), st.randoms(use_true_random=False))
def test_matches_equal_a_greedy_loop(matches: Any, random: Any) -> None:
    expected = greedy(matches)
    assert triples(resolve(matches)) == expected
    random.shuffle(matches)
    assert triples(resolve(matches)) == expected


MAP = MapIndex.build(
    np.arange(12.0).reshape(4, 3),
    ("a", "b"),
    image_ids=np.array([0, 0, 0, 1]),
    keypoint_ids=np.array([5, 7, 7, 5]),
    point_ids=np.array([0, 3, 1, 2]),
)


def test_matches_with_map_keypoints_that_observe_a_point() -> None:
    given = [
        ("a", np.array([[10, 5], [11, 6], [12, 7]]), np.array([0.9, 0.8, 0.7])),
        ("c", np.array([[14, 5]]), np.array([0.5])),  # not in the map
        ("e", np.zeros((0, 2), np.int64), np.zeros(0, np.float32)),
        ("b", np.array([[13, 5], [10, 9]], np.uint32), np.array([0.5, 0.4], np.float32)),
    ]
    typed = TypedMatches(MAP, np.zeros((15, 2), np.float32), given)
    keypoint_ids, point_ids, similarities, image_rows = typed.observed
    assert keypoint_ids.tolist() == [10, 12, 13]
    assert point_ids.tolist() == [0, 1, 2]  # keypoint 7 observes two points: the first counts
    assert similarities.tolist() == [0.9, 0.7, 0.5]
    assert image_rows.tolist() == [0, 0, 3]
    assert triples(typed.correspondences()) == [(10, 0, 1), (12, 1, 1), (13, 2, 1)]
    # other images are ignored
    assert triples(typed.correspondences(["c", "e", "b"])) == [(13, 2, 1)]
    assert triples(typed.correspondences([])) == []
    none = [("a", np.zeros((0, 2), np.int64), np.zeros(0))]
    for few in ([], none):
        assert triples(replace(typed, matches=few).correspondences(["a"])) == []
