"""Reranking by coverage and by diversity."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from megloc_kapture.retrieval.reranking import DiversityOptions, diversify, greedy_coverage

AHEAD = np.array([0.0, 0.0, 1.0])


def ids(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_a_neighbour_of_the_best_makes_way_for_what_adds_more() -> None:
    images = [ids(0, 1, 2, 3), ids(0, 1, 2), ids(7, 8), ids()]
    assert greedy_coverage(images, 2) == ([0, 2], [4, 2])
    # what adds nothing comes in order of its matches, and of its place
    assert greedy_coverage(images, 9) == ([0, 2, 1, 3], [4, 2, 0, 0])
    assert greedy_coverage([ids(), ids()], 9) == ([0, 1], [0, 0])
    assert greedy_coverage([], 3) == ([], [])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sets(st.integers(0, 12)), max_size=6), st.integers(1, 4))
def test_it_is_never_far_from_the_best(sets: list[set[int]], keep: int) -> None:
    order, added = greedy_coverage([ids(*sorted(one)) for one in sets], keep)
    assert len(order) == len(set(order)) == min(keep, len(sets))
    covered = set().union(*(sets[at] for at in order))
    assert sum(added) == len(covered)
    best = max(
        (len(set().union(*some)) for some in combinations(sets, min(keep, len(sets)))), default=0
    )
    assert len(covered) >= (1 - 1 / np.e) * best
    assert sorted(added, reverse=True) == added


def ahead(count: int) -> np.ndarray:
    return np.tile(AHEAD, (count, 1))


def test_near_duplicates_make_way_for_other_places() -> None:
    centers = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [9, 0, 0], [9.1, 0, 0]], float)
    options = DiversityOptions(max_per_place=2, radius=1.0)
    found = diversify(np.arange(5), centers, ahead(5), 4, options)
    assert found.tolist() == [0, 1, 3, 4]
    assert diversify(np.arange(5), centers, ahead(5), 3, options).tolist() == [0, 1, 3]


def test_what_was_passed_over_fills_the_rest() -> None:
    centers = np.zeros((4, 3))
    options = DiversityOptions(max_per_place=1, radius=1.0)
    assert diversify(np.arange(4), centers, ahead(4), 3, options).tolist() == [0, 1, 2]


def test_images_that_look_elsewhere_are_another_place() -> None:
    directions = np.array([AHEAD, AHEAD, [1.0, 0.0, 0.0]])
    options = DiversityOptions(max_per_place=1, radius=1.0, angle_deg=45)
    found = diversify(np.array([0, 1, 2]), np.zeros((3, 3)), directions, 2, options)
    assert found.tolist() == [0, 2]


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 3), st.floats(0.1, 3))
def test_against_its_definition(seed: int, top_k: int, most: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 15))
    centers = rng.uniform(0, 4, (count, 3))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranking = rng.permutation(count)
    options = DiversityOptions(max_per_place=most, radius=radius, angle_deg=60)
    found = diversify(ranking, centers, directions, top_k, options).tolist()

    def near(a: int, b: int) -> bool:
        angle = np.rad2deg(np.arccos(np.clip(directions[a] @ directions[b], -1, 1)))
        return bool(np.linalg.norm(centers[a] - centers[b]) <= radius and angle <= 60)

    kept: list[int] = []
    for position in range(count):
        others = [k for k in kept if near(ranking[k], ranking[position])]
        if len(kept) < top_k and len(others) < most:
            kept.append(position)
    rest = [position for position in range(count) if position not in kept]
    assert found == (kept + rest)[:top_k]
