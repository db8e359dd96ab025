"""The map's index against a dictionary."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.localization.map_index import (
    Correspondences,
    MapIndex,
    ObservedMatches,
    observed_matches,
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


def test_an_image_that_is_not_in_the_map() -> None:
    index = build([(0, 1, 2)], ("a.jpg",))
    assert [len(part) for part in index.observed("z.jpg")] == [0, 0]


def test_an_image_without_observations_between_two_that_have_some() -> None:
    index = build([(0, 1, 2), (2, 5, 3)], ("a.jpg", "b.jpg", "c.jpg"))
    assert [len(part) for part in index.observed("b.jpg")] == [0, 0]
    assert [part.tolist() for part in index.observed("c.jpg")] == [[5], [3]]


def test_a_map_without_observations() -> None:
    assert [len(part) for part in build([], ("a.jpg",)).observed("a.jpg")] == [0, 0]
    assert build([], ()).row_of_image == {}


def test_points_keep_all_their_digits() -> None:
    xyz = np.array([[4.2e6 + 1e-9, 1.7e5, 4.78e6]])
    empty = np.zeros(0, dtype=np.int64)
    np.testing.assert_array_equal(MapIndex.build(xyz, (), empty, empty, empty).xyz, xyz)


@given(observations, st.lists(st.sampled_from("abcdz"), max_size=6))
def test_shared_points_equal_to_sets(rows: list[tuple[int, int, int]], asked: list[str]) -> None:
    index = build(rows, ("a", "b", "c", "d"))
    points = [
        {p for i, _, p in rows if "abcd"[i] == name} if name != "z" else set() for name in asked
    ]
    shared = index.shared_points(asked)
    assert (shared.dtype, shared.shape) == (np.int64, (len(asked), len(asked)))
    assert shared.tolist() == [[len(mine & other) for other in points] for mine in points]


def test_shared_points_of_images_with_many() -> None:
    rng = np.random.default_rng(0)
    images, keypoints = np.repeat(np.arange(30), 500), np.tile(np.arange(500), 30)
    points = rng.integers(0, 6000, len(images)) * 5000  # ids of many digits
    names = tuple(f"{i:02}" for i in range(30))
    xyz = np.zeros((0, 3))
    index = MapIndex.build(xyz, names, images, keypoints, points)
    sets = [set(points[images == i].tolist()) for i in range(30)]
    asked = [3, 1, 29, 0, 17]
    expected = [[len(sets[i] & sets[j]) for j in asked] for i in asked]
    assert index.shared_points([names[i] for i in asked]).tolist() == expected


def test_nothing_in_it_can_be_written_to() -> None:
    xyz = np.zeros((3, 3))
    index = MapIndex.build(xyz, ("a",), *(np.zeros(1, np.int64),) * 3)
    for array in (index.xyz, index.offsets, index.keypoint_ids, index.point_ids):
        assert not array.flags.writeable
    xyz[0] = 1.0  # whose array it is may go on writing


def test_an_observation_of_an_image_that_has_no_name() -> None:
    with pytest.raises(ValueError):
        build([(1, 0, 0)], ("a",))


def observed(matches: list[tuple[int, int, float, int]]) -> ObservedMatches:
    keypoints, points, similarities, images = zip(*matches, strict=True) if matches else [()] * 4
    return ObservedMatches(
        np.array(keypoints, dtype=np.int64),
        np.array(points, dtype=np.int64),
        np.array(similarities, dtype=np.float64),
        np.array(images, dtype=np.int64),
        4,
    )


def resolve(
    keypoints: list[int], points: list[int], similarities: list[float]
) -> tuple[list[int], list[int], list[int]]:
    images = [0] * len(keypoints)
    found = observed(list(zip(keypoints, points, similarities, images, strict=True))).resolve()
    return found.keypoint_ids.tolist(), found.point_ids.tolist(), found.support.tolist()


def triples(found: Correspondences) -> list[tuple[int, int, int]]:
    columns = (found.keypoint_ids, found.point_ids, found.support)
    assert all(column.dtype == np.int64 for column in columns)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def greedy(matches: list[tuple[int, int, float, int]]) -> list[tuple[int, int, int]]:
    support = Counter((k, p) for k, p, _, _ in matches)
    best = {pair: max(s for k, p, s, _ in matches if (k, p) == pair) for pair in support}
    left = sorted(support, key=lambda pair: (-support[pair], -best[pair], pair))
    chosen = []
    while left:
        keypoint, point = left[0]
        chosen.append((keypoint, point, support[keypoint, point]))
        left = [(k, p) for k, p in left if k != keypoint and p != point]
    return sorted(chosen)


def resolve_by_numpy(
    keypoint_ids: NDArray[np.int64], point_ids: NDArray[np.int64], similarities: NDArray[np.float64]
) -> list[tuple[int, int, int]]:
    """How it was done before it was compiled."""
    pairs, inverse, support = np.unique(
        np.stack([keypoint_ids, point_ids], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    best = np.full(len(pairs), -np.inf)
    np.maximum.at(best, inverse.reshape(-1), similarities)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -best, -support))
    taken_keypoints: set[int] = set()
    taken_points: set[int] = set()
    chosen = []
    for row, (keypoint, point) in zip(order.tolist(), pairs[order].tolist(), strict=True):
        if keypoint not in taken_keypoints and point not in taken_points:
            taken_keypoints.add(keypoint)
            taken_points.add(point)
            chosen.append(row)
    return [(*pairs[row].tolist(), int(support[row])) for row in sorted(chosen)]


@given(st.one_of(rows, wide))
def test_equal_to_a_greedy_loop(matches: list[tuple[int, int, float, int]]) -> None:
    assert triples(observed(matches).resolve()) == greedy(matches)


def test_equal_to_numpy_on_as_many_matches_as_a_query_has() -> None:
    for seed, num_points in ((0, 500), (1, 3000), (2, 100_000)):
        rng = np.random.default_rng(seed)
        keypoints = rng.integers(0, 3000, 8000)
        points = rng.integers(0, num_points, 8000)
        again = rng.integers(0, 4000, 4000)  # pairs that several images agree on
        keypoints[4000:], points[4000:] = keypoints[again], points[again]
        scores = np.round(rng.normal(size=8000), 1)  # with ties, and of both signs
        images = rng.integers(0, 20, 8000)
        mine = ObservedMatches(keypoints, points, scores, images, 20).resolve()
        assert triples(mine) == resolve_by_numpy(keypoints, points, scores)


@given(rows, st.lists(st.booleans(), min_size=4, max_size=4))
def test_images_that_are_left_out_have_no_say(
    matches: list[tuple[int, int, float, int]], kept: list[bool]
) -> None:
    found = observed(matches).resolve(np.array(kept))
    assert triples(found) == greedy([match for match in matches if kept[match[3]]])


@given(rows, st.randoms(use_true_random=False))
def test_every_keypoint_and_point_once_whatever_the_order(
    matches: list[tuple[int, int, float, int]], random: object
) -> None:
    found = observed(matches).resolve()
    assert len(set(found.keypoint_ids.tolist())) == len(found.keypoint_ids)
    assert len(set(found.point_ids.tolist())) == len(found.point_ids)
    assert (np.diff(found.keypoint_ids) > 0).all()
    random.shuffle(matches)  # type: ignore[attr-defined]
    assert triples(observed(matches).resolve()) == triples(found)


def test_what_most_images_say_wins() -> None:
    # keypoint 4 meets point 7 in two images and point 8 in one, where it is more similar
    assert resolve([4, 4, 4], [8, 7, 7], [0.99, 0.6, 0.7]) == ([4], [7], [2])


def test_then_the_most_similar_wins() -> None:
    assert resolve([1, 2], [5, 5], [0.6, 0.8]) == ([2], [5], [1])


def test_a_loser_gets_its_second_choice() -> None:
    found = resolve([1, 1, 2, 2], [5, 5, 5, 6], [0.9, 0.9, 0.8, 0.2])
    assert found == ([1, 2], [5, 6], [2, 1])


def test_nothing_to_resolve() -> None:
    assert triples(observed([]).resolve()) == []
    assert triples(observed([(1, 2, 0.5, 0)]).resolve(np.zeros(4, dtype=bool))) == []


MAP = MapIndex.build(
    np.arange(12.0).reshape(4, 3),
    ("a", "b"),
    image_ids=np.array([0, 0, 0, 1]),
    keypoint_ids=np.array([5, 7, 7, 5]),
    point_ids=np.array([0, 3, 1, 2]),
)


def test_matches_with_map_keypoints_that_observe_a_point() -> None:
    found = observed_matches(
        MAP,
        [
            ("a", np.array([[10, 5], [11, 6], [12, 7]]), np.array([0.9, 0.8, 0.7])),
            ("c", np.array([[14, 5]]), np.array([0.5])),  # not in the map
            ("a", np.zeros((0, 2), np.int64), np.zeros(0, np.float32)),
            ("b", np.array([[13, 5], [10, 9]], np.uint32), np.array([0.5, 0.4], np.float32)),
        ],
    )
    assert found.keypoint_ids.tolist() == [10, 12, 13]
    assert found.point_ids.tolist() == [0, 1, 2]  # the first of the two of keypoint 7
    assert found.similarities.tolist() == [0.9, 0.7, 0.5]
    assert found.image_rows.tolist() == [0, 0, 3]
    assert found.num_images == 4
    rows = np.array([False, True, True, True])
    assert triples(found.resolve(rows)) == [(13, 2, 1)]


def test_no_matches_at_all() -> None:
    empty = [("a", np.zeros((0, 2), np.int64), np.zeros(0))]
    for matches in ([], empty):
        found = observed_matches(MAP, matches)
        assert found.num_images == len(matches)
        assert triples(found.resolve()) == []
