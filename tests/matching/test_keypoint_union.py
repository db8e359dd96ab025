"""Keypoints that are added: rows never change, and one place has one keypoint."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.matching.keypoint_union import SAME_PLACE_PX, KeypointUnion

# a grid of quarter pixels: distances of exactly one pixel, and equal ones, are common
PLACES = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(-20, 20)).map(lambda xy: (xy[0] / 4, xy[1] / 4)),
    max_size=25,
)


def array(places: list[tuple[float, float]]) -> np.ndarray:
    xy = np.array(places, np.float32).reshape(-1, 2)
    return np.concatenate([xy, np.arange(len(xy), dtype=np.float32)[:, None]], axis=1)


def nearest(keypoint: np.ndarray, among: np.ndarray) -> int:
    if len(among) == 0:
        return -1
    distance = np.linalg.norm(among[:, :2].astype(np.float64) - keypoint[:2], axis=1)
    row = int(distance.argmin())
    return row if distance[row] <= SAME_PLACE_PX else -1


@given(base=PLACES, more=PLACES)
def test_against_looking_at_all_of_them(
    base: list[tuple[float, float]], more: list[tuple[float, float]]
) -> None:
    union = KeypointUnion(array(base))
    kept = array(base)
    for keypoint in array(more):
        expected = nearest(keypoint, kept[: len(base)])  # those that were there come first
        if expected < 0:
            behind = nearest(keypoint, kept[len(base) :])
            expected = behind if behind < 0 else behind + len(base)
        (found,) = union.find(keypoint[None]).tolist()
        assert found == expected
        if found < 0:
            assert union.append(keypoint) == len(kept)
            kept = np.concatenate([kept, keypoint[None]])
    np.testing.assert_array_equal(union.keypoints_px(), kept)
    np.testing.assert_array_equal(union.keypoints_px()[: len(base)], array(base))
    np.testing.assert_array_equal(union.added(), kept[len(base) :])
    # opened again with what was added, it finds the same
    again = KeypointUnion(array(base), union.added())
    np.testing.assert_array_equal(again.find(array(more)), union.find(array(more)))


@given(base=PLACES, more=PLACES, taken_back=st.integers(0, 25))
def test_what_is_taken_back_was_never_there(
    base: list[tuple[float, float]], more: list[tuple[float, float]], taken_back: int
) -> None:
    union = KeypointUnion(array(base))
    for keypoint in array(more):
        if union.find(keypoint[None])[0] < 0:
            union.append(keypoint)
    length = max(len(base), len(union) - taken_back)
    expected = KeypointUnion(array(base), union.added()[: length - len(base)])
    union.truncate(length)
    np.testing.assert_array_equal(union.keypoints_px(), expected.keypoints_px())
    np.testing.assert_array_equal(union.find(array(more)), expected.find(array(more)))


def test_of_several_at_one_place_the_first_is_meant() -> None:
    # SIFT has a keypoint for each orientation
    union = KeypointUnion(array([(9.0, 9.0), (5.0, 5.0), (5.0, 5.0)]))
    assert union.find(array([(5.3, 5.0)])).tolist() == [1]


def test_no_keypoints_at_all() -> None:
    union = KeypointUnion(np.zeros((0, 2), np.float32))
    assert union.find(np.zeros((0, 2), np.float32)).shape == (0,)
    assert union.keypoints_px().shape == union.added().shape == (0, 2)
