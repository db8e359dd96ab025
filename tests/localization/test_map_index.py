"""The map's index against a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.localization.map_index import MapIndex

observations = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 9), st.integers(0, 19)), max_size=60
)


def build(rows: list[tuple[int, int, int]], names: tuple[str, ...]) -> MapIndex:
    array = np.array(rows, dtype=np.int64).reshape(-1, 3)
    xyz = np.arange(60.0).reshape(20, 3)
    return MapIndex.build(xyz, names, array[:, 0], array[:, 1], array[:, 2])


@given(observations, st.lists(st.integers(0, 12), max_size=15))
def test_equal_to_a_dictionary(rows: list[tuple[int, int, int]], asked: list[int]) -> None:
    names = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    index = build(rows, names)
    for image_id, name in enumerate(names):
        mine = sorted((k, p) for i, k, p in rows if i == image_id)
        keypoints, points = index.observed(name)
        assert list(zip(keypoints.tolist(), points.tolist(), strict=True)) == mine
        first: dict[int, int] = {}
        for keypoint, point in mine:
            first.setdefault(keypoint, point)
        found = index.points_of_keypoints(name, np.array(asked, dtype=np.int64))
        assert found.dtype == np.int64
        assert found.tolist() == [first.get(keypoint, -1) for keypoint in asked]


def test_an_image_that_is_not_in_the_map() -> None:
    index = build([(0, 1, 2)], ("a.jpg",))
    assert index.points_of_keypoints("z.jpg", np.array([1, 2])).tolist() == [-1, -1]
    assert [len(part) for part in index.observed("z.jpg")] == [0, 0]


def test_an_image_without_observations_between_two_that_have_some() -> None:
    index = build([(0, 1, 2), (2, 5, 3)], ("a.jpg", "b.jpg", "c.jpg"))
    assert [len(part) for part in index.observed("b.jpg")] == [0, 0]
    assert index.points_of_keypoints("b.jpg", np.array([1, 5])).tolist() == [-1, -1]
    assert index.points_of_keypoints("c.jpg", np.array([1, 5, 9])).tolist() == [-1, 3, -1]


def test_a_map_without_observations() -> None:
    index = build([], ("a.jpg",))
    assert index.points_of_keypoints("a.jpg", np.array([0])).tolist() == [-1]
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
