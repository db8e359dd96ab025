"""Greedy coverage against brute force."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from megloc_kapture.retrieval.coverage import most_covering


def ids(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_a_neighbour_of_the_best_makes_way_for_what_adds_more() -> None:
    images = [ids(0, 1, 2, 3), ids(0, 1, 2), ids(7, 8), ids()]
    assert most_covering(images, 2) == ([0, 2], [4, 2])
    # what adds nothing comes in order of its matches, and of its place
    assert most_covering(images, 9) == ([0, 2, 1, 3], [4, 2, 0, 0])
    assert most_covering([ids(), ids()], 9) == ([0, 1], [0, 0])
    assert most_covering([], 3) == ([], [])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sets(st.integers(0, 12)), max_size=6), st.integers(1, 4))
def test_it_is_never_far_from_the_best(sets: list[set[int]], keep: int) -> None:
    order, added = most_covering([ids(*sorted(one)) for one in sets], keep)
    assert len(order) == len(set(order)) == min(keep, len(sets))
    covered = set().union(*(sets[at] for at in order))
    assert sum(added) == len(covered)
    best = max(
        (len(set().union(*some)) for some in combinations(sets, min(keep, len(sets)))), default=0
    )
    assert len(covered) >= (1 - 1 / np.e) * best
    assert sorted(added, reverse=True) == added
