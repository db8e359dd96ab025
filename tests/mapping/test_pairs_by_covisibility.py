"""Pairs by co-visibility against sets of points, and where tracks are as long as the map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.mapping import pairs_by_covisibility as module
from megloc_kapture.mapping.pairs_by_covisibility import (
    PairsByCovisibilityOptions,
    pairs_by_covisibility,
)


def by_sets(
    num_images: int, observations: Sequence[tuple[int, int]], options: PairsByCovisibilityOptions
) -> list[list[int]]:
    """``observations`` are points and images."""
    seen: list[set[int]] = [set() for _ in range(num_images)]
    for point, image in observations:
        seen[image].add(point)
    found = set()
    for image in range(num_images):
        shared = [(-len(seen[image] & seen[other]), other) for other in range(num_images)]
        shared.remove((-len(seen[image]), image))
        for count, other in sorted(shared)[: options.top_k]:
            if -count >= options.min_shared_points:
                found.add((min(image, other), max(image, other)))
    return [list(pair) for pair in sorted(found)]


@given(
    st.integers(1, 12),
    st.lists(st.tuples(st.integers(0, 15), st.integers(0, 11)), max_size=80),
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(1, 20),
)
def test_equal_to_the_sets(
    num_images: int,
    observations: list[tuple[int, int]],
    top_k: int,
    min_shared_points: int,
    chunk: int,
) -> None:
    """Observations in any order, some twice; images without any; ties."""
    observations = [(point, image) for point, image in observations if image < num_images]
    arrays = np.array(observations, dtype=np.int64).reshape(-1, 2)
    options = PairsByCovisibilityOptions(top_k=top_k, min_shared_points=min_shared_points)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_CHUNK", chunk)
        found = pairs_by_covisibility(num_images, arrays[:, 0], arrays[:, 1], options)
    assert found.dtype == np.int64 and found.shape[1] == 2
    assert found.tolist() == by_sets(num_images, observations, options)


def test_the_same_from_many_chunks_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points, images = rng.integers(0, 500, 8000), rng.integers(0, 300, 8000)
    options = PairsByCovisibilityOptions(top_k=7, min_shared_points=2)
    expected = by_sets(300, list(zip(points.tolist(), images.tolist(), strict=True)), options)
    for chunk in (7, 1000):
        monkeypatch.setattr(module, "_CHUNK", chunk)
        assert pairs_by_covisibility(300, points, images, options).tolist() == expected


def everywhere(num_points: int, num_images: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Every point seen by every image."""
    points = np.repeat(np.arange(num_points), num_images)
    return points, np.tile(np.arange(num_images), num_points)


def test_a_point_that_every_image_sees_is_not_squared() -> None:
    """The pairs of 20,000 images would be 200 million for each of its points."""
    options = PairsByCovisibilityOptions(top_k=3, min_shared_points=2)
    found = pairs_by_covisibility(20_000, *everywhere(2, 20_000), options)
    # everybody shares as much: the first within reach
    assert (np.bincount(found.ravel(), minlength=20_000) >= 3).all()
    assert len(found) <= 20_000 * 3
    assert np.diff(found, axis=1).max() == module._TRACK_WINDOW


def test_in_a_long_track_an_image_counts_those_near_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_TRACK_WINDOW", 3)
    options = PairsByCovisibilityOptions(top_k=100, min_shared_points=1)
    # near in the track, not in the numbers of the images
    images = 10 * np.arange(9)
    found = pairs_by_covisibility(100, np.zeros(9, dtype=int), images, options)
    expected = [[10 * a, 10 * b] for a in range(9) for b in range(a + 1, min(a + 4, 9))]
    assert found.tolist() == expected


def test_nothing_observed() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert pairs_by_covisibility(5, none, none).shape == (0, 2)
