"""Keypoints are found again by place, and at one place by order."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.stages.found_again import rows_at_their_places, rows_found_again


def points(*xy: tuple[float, float]) -> np.ndarray:
    return np.array(xy, dtype=np.float32).reshape(-1, 2)


def test_rows_are_found_by_place() -> None:
    stored = points((1, 1), (5, 5), (9, 9))
    extracted = points((9, 9.01), (1, 1), (7, 7), (20, 20))
    assert rows_found_again(stored, extracted).tolist() == [1, -1, 0]
    assert rows_found_again(stored, stored).tolist() == [0, 1, 2]


def test_keypoints_at_one_place_are_joined_in_order() -> None:
    stored = points((1, 1), (1, 1), (2, 2), (1, 1))
    extracted = points((2, 2), (1, 1), (3, 3), (1, 1))
    assert rows_found_again(stored, extracted).tolist() == [1, 3, 0, -1]


def test_nothing_to_find() -> None:
    empty = points()
    assert rows_found_again(points((1, 1)), empty).tolist() == [-1]
    assert rows_found_again(empty, points((1, 1))).shape == (0,)
    assert rows_found_again(empty, empty).dtype == np.int64


def at_places(stored: np.ndarray, extracted: np.ndarray, shift: float) -> list[tuple[int, int]]:
    of, rows = rows_at_their_places(stored, extracted, shift)
    assert of.dtype == rows.dtype == np.int64
    return list(zip(of.tolist(), rows.tolist(), strict=True))


def test_all_orientations_of_the_nearest_place_are_found() -> None:
    stored = points((1, 1), (30, 30), (9, 9))
    extracted = points((9, 9), (1.3, 1), (9.05, 9), (1.9, 1), (1.3, 1.02))
    # (1.9, 1) is near enough, but another place
    assert at_places(stored, extracted, 1.0) == [(0, 1), (0, 4), (2, 0), (2, 2)]
    assert at_places(stored, extracted, 0.2) == [(2, 0), (2, 2)]
    assert at_places(points((30, 30)), extracted, 0.2) == []


def test_no_place_has_no_keypoint() -> None:
    assert at_places(points(), points((1, 1)), 1.0) == []
    assert at_places(points((1, 1)), points(), 1.0) == []


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.floats(0, 0.4))
def test_shifted_and_shuffled_keypoints_are_all_found(seed: int, count: int, shift: float) -> None:
    rng = np.random.default_rng(seed)
    # a place each, at least 2 px from the next
    places = (rng.permutation(400)[:count, None] // [20, 1] % 20 * 3.0).astype(np.float32)
    order = rng.permutation(count)
    moved = (places + rng.uniform(-shift, shift, places.shape)).astype(np.float32)[order]
    assert at_places(places, moved, 1.0) == list(enumerate(np.argsort(order).tolist()))
