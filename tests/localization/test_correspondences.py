"""Conflicts among 2D-3D matches, by hand and by a plain greedy loop."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.localization.correspondences import resolve

rows = st.lists(
    st.tuples(st.integers(0, 6), st.integers(0, 6), st.sampled_from([0.1, 0.5, 0.5, 0.9])),
    max_size=40,
)


def greedy(matches: list[tuple[int, int, float]]) -> list[tuple[int, int, int]]:
    support = Counter((k, p) for k, p, _ in matches)
    best = {pair: max(s for k, p, s in matches if (k, p) == pair) for pair in support}
    left = sorted(support, key=lambda pair: (-support[pair], -best[pair], pair))
    chosen = []
    while left:
        keypoint, point = left[0]
        chosen.append((keypoint, point, support[keypoint, point]))
        left = [(k, p) for k, p in left if k != keypoint and p != point]
    return sorted(chosen)


@given(rows)
def test_equal_to_a_greedy_loop(matches: list[tuple[int, int, float]]) -> None:
    array = np.array(matches).reshape(-1, 3)
    found = resolve(array[:, 0].astype(np.int64), array[:, 1].astype(np.int64), array[:, 2])
    triples = zip(
        found.keypoint_ids.tolist(), found.point_ids.tolist(), found.support.tolist(), strict=True
    )
    assert list(triples) == greedy(matches)
    assert all(a.dtype == np.int64 for a in (found.keypoint_ids, found.point_ids, found.support))


@given(rows, st.randoms(use_true_random=False))
def test_every_keypoint_and_point_once_whatever_the_order(
    matches: list[tuple[int, int, float]], random: object
) -> None:
    array = np.array(matches).reshape(-1, 3)
    found = resolve(array[:, 0].astype(np.int64), array[:, 1].astype(np.int64), array[:, 2])
    assert len(set(found.keypoint_ids.tolist())) == len(found.keypoint_ids)
    assert len(set(found.point_ids.tolist())) == len(found.point_ids)
    assert (np.diff(found.keypoint_ids) > 0).all()
    random.shuffle(matches)  # type: ignore[attr-defined]
    mixed = np.array(matches).reshape(-1, 3)
    again = resolve(mixed[:, 0].astype(np.int64), mixed[:, 1].astype(np.int64), mixed[:, 2])
    np.testing.assert_array_equal(found.keypoint_ids, again.keypoint_ids)
    np.testing.assert_array_equal(found.point_ids, again.point_ids)
    np.testing.assert_array_equal(found.support, again.support)


def test_what_most_images_say_wins() -> None:
    # keypoint 4 meets point 7 in two images and point 8 in one, where it is more similar
    found = resolve(np.array([4, 4, 4]), np.array([8, 7, 7]), np.array([0.99, 0.6, 0.7]))
    assert (found.keypoint_ids.tolist(), found.point_ids.tolist()) == ([4], [7])
    assert found.support.tolist() == [2]


def test_then_the_most_similar_wins() -> None:
    found = resolve(np.array([1, 2]), np.array([5, 5]), np.array([0.6, 0.8]))
    assert (found.keypoint_ids.tolist(), found.point_ids.tolist()) == ([2], [5])


def test_a_loser_gets_its_second_choice() -> None:
    found = resolve(np.array([1, 1, 2, 2]), np.array([5, 5, 5, 6]), np.array([0.9, 0.9, 0.8, 0.2]))
    assert (found.keypoint_ids.tolist(), found.point_ids.tolist()) == ([1, 2], [5, 6])


def test_nothing_to_resolve() -> None:
    empty = np.zeros(0, dtype=np.int64)
    found = resolve(empty, empty, np.zeros(0))
    assert len(found.keypoint_ids) == len(found.point_ids) == len(found.support) == 0


def test_indices_as_matches_files_and_maps_hold_them() -> None:
    found = resolve(
        np.array([3, 1], dtype=np.int64),
        np.array([2**31 - 1, 0], dtype=np.int32).astype(np.int64),
        np.array([0.5, 0.5], dtype=np.float32),
    )
    assert found.point_ids.tolist() == [0, 2**31 - 1]
