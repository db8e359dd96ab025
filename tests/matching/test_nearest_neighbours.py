"""Nearest neighbours against loops over all pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.matching import nearest_neighbours
from megloc_kapture.matching.nearest_neighbours import (
    NearestNeighbourOptions,
    NearestNeighbours,
    match_nearest,
)
from megloc_kapture.values import ImageFeatures


def by_loops(
    a: NDArray[Any], b: NDArray[Any], options: NearestNeighbourOptions
) -> list[tuple[int, int]]:
    a, b = a.astype(np.float64), b.astype(np.float64)
    products = [[float(np.dot(x, y)) for y in b] for x in a]
    matches: list[tuple[int, int]] = []
    taken: set[int] = set()
    for i, row in enumerate(products):
        best, *others = sorted(range(len(b)), key=lambda j: (-row[j], j))
        if options.max_ratio is not None and others:
            nearest, second = (np.linalg.norm(a[i] - b[j]) for j in (best, others[0]))
            # equal ones differ by rounding
            if nearest > options.max_ratio * second + 1e-7:
                continue
        if options.min_similarity is not None and row[best] < options.min_similarity:
            continue
        if options.mutual:
            if row[best] < max(other[best] for other in products) or best in taken:
                continue
            taken.add(best)
        matches.append((i, best))
    return matches


@st.composite
def descriptors(draw: st.DrawFn) -> tuple[NDArray[Any], NDArray[Any], int]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count_a, count_b = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    size, block = draw(st.integers(1, 4)), draw(st.integers(1, 40))
    if draw(st.booleans()):
        # few values, so that exact ties are everywhere
        a, b = rng.integers(0, 4, (count_a, size)), rng.integers(0, 4, (count_b, size))
        return a.astype(np.uint8), b.astype(np.uint8), block
    a, b = rng.normal(size=(count_a, size)), rng.normal(size=(count_b, size))
    return a.astype(np.float32), b.astype(np.float32), block


@given(
    descriptors(), st.booleans(), st.sampled_from([None, 2.5]), st.sampled_from([None, 0.75, 0.95])
)
def test_equal_to_loops_over_all_pairs(
    problem: tuple[NDArray[Any], NDArray[Any], int],
    mutual: bool,
    min_similarity: float | None,
    max_ratio: float | None,
) -> None:
    a, b, block = problem
    options = NearestNeighbourOptions(
        mutual=mutual, min_similarity=min_similarity, max_ratio=max_ratio
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nearest_neighbours, "_BLOCK_ROWS", block)
        matches, scores = match_nearest(a, b, options)
    assert matches.dtype == np.int64 and scores.dtype == np.float32
    if a.dtype == np.uint8:
        assert [tuple(m) for m in matches.tolist()] == by_loops(a, b, options)
    else:
        expected = by_loops(a, b, options)
        assert len(matches) == len(expected)
        # two float32 products may tie in float32 only: compare by value
        result = np.einsum("nd,nd->n", a[matches[:, 0]], b[matches[:, 1]])
        truth = [float(a[i].astype(np.float64) @ b[j].astype(np.float64)) for i, j in expected]
        np.testing.assert_allclose(result, truth, atol=1e-5)
    products = a.astype(np.float64) @ b.astype(np.float64).T
    for (i, j), score in zip(matches.tolist(), scores.tolist(), strict=True):
        others = [other for other in range(len(b)) if other != j]
        second = max(others, key=lambda other: (products[i, other], -other), default=j)
        apart = ((a[i].astype(float) - b[[j, second]]) ** 2).sum(axis=1)
        np.testing.assert_allclose(score, 1 - apart[0] / apart[1] if apart[1] else 0.0, atol=1e-5)


def test_empty_sets_have_no_matches() -> None:
    same = np.ones((3, 4), dtype=np.float32)
    for a, b in ((same[:0], same), (same, same[:0]), (same[:0], same[:0])):
        matches, scores = match_nearest(a, b)
        assert matches.shape == (0, 2) and matches.dtype == np.int64
        assert scores.shape == (0,) and scores.dtype == np.float32
    with pytest.raises(DataError, match="4 and 2 dimensions"):
        match_nearest(same, same[:, :2])


def test_uint8_descriptors_do_not_wrap_around() -> None:
    a = np.array([[255, 0], [0, 255]], dtype=np.uint8)
    b = np.array([[0, 200], [250, 10]], dtype=np.uint8)
    matches, scores = match_nearest(a, b)
    assert matches.tolist() == [[0, 1], [1, 0]]
    # (255, 0) from (250, 10) and (0, 200), (0, 255) from (0, 200) and (250, 10)
    distances = [1 - (5**2 + 10**2) / (255**2 + 200**2), 1 - 55**2 / (250**2 + 245**2)]
    np.testing.assert_allclose(scores, distances, rtol=1e-6)


def test_the_plugin_passes_its_options_on() -> None:
    rng, xy = np.random.default_rng(5), np.zeros((30, 2), np.float32)
    a, b = (ImageFeatures(xy[:n], rng.normal(size=(n, 4)), 640, 480) for n in (30, 20))
    options = NearestNeighbourOptions(mutual=False)
    result = NearestNeighbours(options).match(a, b)[0]
    np.testing.assert_array_equal(result, match_nearest(a.descriptors, b.descriptors, options)[0])
    assert len(result) == 30 > len(NearestNeighbours().match(a, b)[0])
