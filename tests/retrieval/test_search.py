"""Retrieval against a full stable sort of all scores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.retrieval import search
from megloc_kapture.retrieval.search import rank_by_similarity


def full_sort(
    queries: NDArray[np.float64],
    database: NDArray[np.float64],
    top_k: int,
    permitted: NDArray[np.bool_] | None = None,
) -> tuple[list[list[int]], list[list[float]]]:
    indices, scores = [], []
    for row, query in enumerate(queries):
        products = [float(np.dot(query, other)) for other in database]
        allowed = [k for k in range(len(database)) if permitted is None or bool(permitted[row, k])]
        best = sorted(allowed, key=lambda k: (-products[k], k))[:top_k]
        width = min(top_k, len(database))
        indices.append(best + [-1] * (width - len(best)))
        scores.append([products[k] for k in best] + [-np.inf] * (width - len(best)))
    return indices, scores


@st.composite
def problems(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int, bool]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # small integers: exact products, and ties all over
    size = draw(st.integers(1, 3))
    queries = rng.integers(-2, 3, (draw(st.integers(1, 12)), size)).astype(np.float64)
    database = rng.integers(-2, 3, (draw(st.integers(1, 40)), size)).astype(np.float64)
    return (
        queries,
        database,
        draw(st.integers(1, 45)),
        draw(st.integers(1, 60)),
        draw(st.booleans()),
    )


@given(problems())
@settings(deadline=None)
def test_equal_to_a_full_stable_sort_whatever_the_blocks(
    problem: tuple[NDArray[np.float64], NDArray[np.float64], int, int, bool],
) -> None:
    queries, database, top_k, block, masked = problem
    permitted = None
    if masked:
        rng = np.random.default_rng(top_k)
        permitted = rng.uniform(size=(len(queries), len(database))) < 0.4
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_BLOCK_ELEMENTS", block)
        indices, scores = rank_by_similarity(queries, database, top_k, permitted=permitted)
    expected_indices, expected_scores = full_sort(queries, database, top_k, permitted)
    np.testing.assert_array_equal(indices, expected_indices)
    np.testing.assert_array_equal(scores, np.array(expected_scores, dtype=np.float32))
    assert indices.dtype == np.int64 and scores.dtype == np.float32


def test_more_queries_than_one_block() -> None:
    rng = np.random.default_rng(0)
    queries, database = rng.integers(-3, 4, (600, 4)), rng.integers(-3, 4, (50, 4))
    indices, scores = rank_by_similarity(queries.astype(float), database.astype(float), 7)
    expected = np.argsort(-(queries @ database.T), axis=1, kind="stable")[:, :7]
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_array_equal(
        scores, np.take_along_axis(queries @ database.T, expected, axis=1)
    )


def test_real_vectors_agree_with_the_full_sort() -> None:
    rng = np.random.default_rng(1)
    queries, database = rng.normal(size=(20, 64)), rng.normal(size=(300, 64))
    indices, scores = rank_by_similarity(queries, database, 10)
    products = queries @ database.T
    np.testing.assert_array_equal(indices, np.argsort(-products, axis=1)[:, :10])
    np.testing.assert_allclose(scores, -np.sort(-products, axis=1)[:, :10], rtol=1e-4, atol=1e-4)


def test_rows_that_are_not_permitted_never_appear() -> None:
    database = np.array([[3.0], [2.0], [1.0]])
    permitted = np.array([[False, True, True], [False, False, False]])
    indices, scores = rank_by_similarity(np.ones((2, 1)), database, 3, permitted=permitted)
    assert indices.tolist() == [[1, 2, -1], [-1, -1, -1]]
    assert scores.tolist() == [[2.0, 1.0, -np.inf], [-np.inf] * 3]


def test_nothing_to_search() -> None:
    indices, scores = rank_by_similarity(np.zeros((2, 4)), np.zeros((0, 4)), 5)
    assert indices.shape == (2, 0) and scores.shape == (2, 0)
    indices, scores = rank_by_similarity(np.zeros((0, 4)), np.zeros((3, 4)), 5)
    assert indices.shape == (0, 3) and scores.shape == (0, 3)


def test_different_dimensions_are_refused() -> None:
    with pytest.raises(DataError, match="different dimensions"):
        rank_by_similarity(np.zeros((2, 4)), np.zeros((3, 5)), 1)
    with pytest.raises(DataError, match="different dimensions"):
        rank_by_similarity(np.zeros(4), np.zeros((3, 4)), 1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(value: float) -> None:
    bad = np.zeros((3, 4))
    bad[1, 2] = value
    with pytest.raises(DataError, match="not finite"):
        rank_by_similarity(bad, np.zeros((3, 4)), 1)
    with pytest.raises(DataError, match="not finite"):
        rank_by_similarity(np.zeros((3, 4)), bad, 1)
