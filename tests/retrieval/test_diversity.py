"""A diversified ranking against its definition."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from megloc_kapture.retrieval.diversity import DiversityOptions, diversified

AHEAD = np.array([0.0, 0.0, 1.0])


def ahead(count: int) -> np.ndarray:
    return np.tile(AHEAD, (count, 1))


def test_near_duplicates_make_way_for_other_places() -> None:
    centers = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [9, 0, 0], [9.1, 0, 0]], float)
    options = DiversityOptions(max_per_place=2, radius=1.0)
    found = diversified(np.arange(5), centers, ahead(5), 4, options)
    assert found.tolist() == [0, 1, 3, 4]
    assert diversified(np.arange(5), centers, ahead(5), 3, options).tolist() == [0, 1, 3]


def test_what_was_passed_over_fills_the_rest() -> None:
    centers = np.zeros((4, 3))
    options = DiversityOptions(max_per_place=1, radius=1.0)
    assert diversified(np.arange(4), centers, ahead(4), 3, options).tolist() == [0, 1, 2]


def test_images_that_look_elsewhere_are_another_place() -> None:
    directions = np.array([AHEAD, AHEAD, [1.0, 0.0, 0.0]])
    options = DiversityOptions(max_per_place=1, radius=1.0, angle_deg=45)
    found = diversified(np.array([0, 1, 2]), np.zeros((3, 3)), directions, 2, options)
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
    found = diversified(ranking, centers, directions, top_k, options).tolist()

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
