"""Unions of keypoints, and matches of a pair combined with those of its variants."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.matching.guided_pyramid import ImageVariant, VariantMatches
from megloc_kapture.matching.pyramid_combination import SAME_KEYPOINT_PX, KeypointUnion, combine

# a grid of quarter pixels: distances of exactly one pixel, and equal ones, are common
POSITIONS = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(-20, 20)).map(lambda xy: (xy[0] / 4, xy[1] / 4)),
    max_size=25,
)


def array(positions: list[tuple[float, float]]) -> np.ndarray:
    xy = np.array(positions, np.float32).reshape(-1, 2)
    return np.concatenate([xy, np.arange(len(xy), dtype=np.float32)[:, None]], axis=1)


DESCRIPTOR = np.zeros(4, np.float32)


def union_of(base: np.ndarray, added: np.ndarray) -> KeypointUnion:
    union = KeypointUnion(base)
    for keypoint in added:
        union.append(keypoint, DESCRIPTOR)
    return union


def nearest(keypoint: np.ndarray, among: np.ndarray) -> int:
    if len(among) == 0:
        return -1
    distance = np.linalg.norm(among[:, :2].astype(np.float64) - keypoint[:2], axis=1)
    row = int(distance.argmin())
    return row if distance[row] <= SAME_KEYPOINT_PX else -1


@given(base=POSITIONS, more=POSITIONS)
def test_the_union_equals_a_search_of_all_keypoints(
    base: list[tuple[float, float]], more: list[tuple[float, float]]
) -> None:
    union = KeypointUnion(array(base))
    kept = array(base)
    for keypoint in array(more):
        expected = nearest(keypoint, kept[: len(base)])  # the base comes first
        if expected < 0:
            behind = nearest(keypoint, kept[len(base) :])
            expected = behind if behind < 0 else behind + len(base)
        (result,) = union.find(keypoint[None]).tolist()
        assert result == expected
        if result < 0:
            assert union.append(keypoint, DESCRIPTOR) == len(kept)
            kept = np.concatenate([kept, keypoint[None]])
    assert len(union) == len(kept)
    np.testing.assert_array_equal(union.added(), kept[len(base) :])
    assert union.find(np.zeros((0, 3), np.float32)).shape == (0,)
    # a union with the added keypoints finds the same
    again = union_of(array(base), union.added())
    np.testing.assert_array_equal(again.find(array(more)), union.find(array(more)))


@given(base=POSITIONS, more=POSITIONS, taken_back=st.integers(0, 25))
def test_truncation_removes_keypoints(
    base: list[tuple[float, float]], more: list[tuple[float, float]], taken_back: int
) -> None:
    union = KeypointUnion(array(base))
    for keypoint in array(more):
        if union.find(keypoint[None])[0] < 0:
            union.append(keypoint, DESCRIPTOR)
    length = max(len(base), len(union) - taken_back)
    expected = union_of(array(base), union.added()[: length - len(base)])
    union.truncate(length)
    np.testing.assert_array_equal(union.added(), expected.added())
    assert len(union.descriptors) == len(union) - len(base)
    np.testing.assert_array_equal(union.find(array(more)), expected.find(array(more)))


def variant_matches(
    positions: list[tuple[float, float]], others: list[int], scores: list[float] | None = None
) -> VariantMatches:
    return VariantMatches(
        ImageVariant(0.5),
        np.array(positions, np.float32).reshape(-1, 2),
        np.tile(np.arange(len(positions), dtype=np.float32)[:, None], (1, 4)),
        np.array(others, np.int64),
        np.array(scores or [1.0] * len(others), np.float32),
    )


def grid(count: int) -> np.ndarray:
    """Return keypoints ten pixels apart."""
    return np.stack([np.arange(count) * 10.0, np.zeros(count)], axis=1).astype(np.float32)


BASE = (np.array([[0, 0], [1, 1]]), np.array([0.9, 0.8]))


def test_mode_all_adds_new_matches() -> None:
    keypoints = KeypointUnion(grid(5))
    tried = [
        # at keypoint 2; new; new, but its partner is matched; at keypoint 1, which is matched
        variant_matches([(20.5, 0.5), (5, 5), (6, 50), (10, 0)], [7, 8, 0, 9], [0.1, 0.2, 1, 1]),
        variant_matches([(5, 5.9)], [10]),  # its keypoint equals (5, 5), which is matched
    ]
    matches, scores = combine(BASE, [(0, each) for each in tried], "all", [keypoints])
    assert matches.tolist() == [[0, 0], [1, 1], [5, 8], [2, 7]]
    np.testing.assert_allclose(scores, [0.9, 0.8, 0.2, 0.1])
    np.testing.assert_array_equal(keypoints.descriptors, [tried[0].descriptors[1]])
    np.testing.assert_array_equal(keypoints.added(), [(5, 5)])


def test_variants_of_both_images_add_to_both() -> None:
    first, second = KeypointUnion(grid(3)), KeypointUnion(grid(4))
    tried = [(0, variant_matches([(5, 5)], [3])), (1, variant_matches([(6, 6), (7, 60)], [2, 1]))]
    matches, scores = combine(BASE, tried, "all", (first, second))
    # the variant with more matches comes first; row 1 of the first image is matched
    assert matches.tolist() == [[0, 0], [1, 1], [2, 4], [3, 3]]
    for union, (_, variant) in zip((first, second), tried, strict=True):
        np.testing.assert_array_equal(union.descriptors, variant.descriptors[:1])


def test_mode_max_takes_the_variant_with_most_matches() -> None:
    rich = variant_matches([(5, 5), (0, 0.5), (15, 5)], [0, 5, 6])
    richer = variant_matches([(5, 45), (10, 40), (15, 45), (20, 40)], [0, 5, 6, 7])
    keypoints = KeypointUnion(grid(5))
    matches, scores = combine(BASE, [(0, rich), (0, richer)], "max", [keypoints])
    assert matches.tolist() == [[5, 0], [6, 5], [7, 6], [8, 7]]
    matches, scores = combine(BASE, [(0, rich)], "max", [KeypointUnion(grid(5))])
    assert matches.tolist() == [[5, 0], [0, 5], [6, 6]]


def test_mode_max_keeps_the_base_unless_a_variant_has_more() -> None:
    keypoints = KeypointUnion(grid(5))
    # as many matches; three matches, two of which share a keypoint
    some = variant_matches([(5, 5), (15, 5)], [4, 5])
    seemingly = variant_matches([(5, 5), (5, 5.5), (15, 5)], [4, 5, 6])
    for tried in ([], [(0, some)], [(0, seemingly)]):
        matches, scores = combine(BASE, tried, "max", [keypoints])
        assert matches.tolist() == BASE[0].tolist()
        assert not keypoints.descriptors and len(keypoints) == 5
