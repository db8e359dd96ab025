"""Retrieval against a full stable sort of all scores."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval import search
from megloc_kapture.retrieval.search import FusionOptions, Ranking, fuse, rank_rows


def rank_by_similarity(queries: Any, database: Any, top_k: int) -> Ranking:
    return rank_rows([queries], [database], top_k, FusionOptions())


@st.composite
def problems(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # small integers: exact products, many ties
    size = draw(st.integers(1, 3))
    queries = rng.integers(-2, 3, (draw(st.integers(1, 12)), size)).astype(np.float64)
    database = rng.integers(-2, 3, (draw(st.integers(1, 40)), size)).astype(np.float64)
    top_k, block = draw(st.integers(1, 45)), draw(st.integers(1, 60))
    return queries, database, top_k, block


@given(problems())
def test_search_equals_a_full_stable_sort(
    problem: tuple[NDArray[np.float64], NDArray[np.float64], int, int],
) -> None:
    queries, database, top_k, block = problem
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_BLOCK_ELEMENTS", block)
        indices, scores = rank_by_similarity(queries, database, top_k)
    products = queries @ database.T
    expected = np.argsort(-products, axis=1, kind="stable")[:, :top_k]
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_array_equal(scores, np.take_along_axis(products, expected, axis=1))
    assert indices.dtype == np.int64 and scores.dtype == np.float32


@pytest.mark.parametrize(("queries", "rows"), [(2, 0), (0, 3)])
def test_empty_queries_and_databases_give_empty_rankings(queries: int, rows: int) -> None:
    indices, scores = rank_by_similarity(np.zeros((queries, 4)), np.zeros((rows, 4)), 5)
    assert indices.shape == scores.shape == (queries, rows)


@pytest.mark.parametrize("method", ["ghm", "mean", "early", "reciprocal_rank"])
def test_fused_ranking_equals_whole_matrices(method: str) -> None:
    rng = np.random.default_rng(4)
    queries = [rng.normal(size=(7, d)) / 4 for d in (5, 9, 3)]
    database = [rng.normal(size=(60, d)) / 4 for d in (5, 9, 3)]
    options = FusionOptions.model_validate({"method": method})
    weights = [1.0, 2.0, 0.5]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_BLOCK_ELEMENTS", 48)
        patch.setattr(search, "_MOST_ROWS", 13)
        indices, scores = rank_rows(queries, database, 10, options, weights)
    assert indices.shape == scores.shape == (7, 10)
    for row in range(7):
        matrices = [q[row : row + 1] @ m.T for q, m in zip(queries, database, strict=True)]
        if method == "reciprocal_rank":
            ranks = [np.argsort(np.argsort(-m[0], kind="stable")) for m in matrices]
            shares = np.array(weights) / sum(weights)
            fused = sum(share / (61 + rank) for share, rank in zip(shares, ranks, strict=True))
        else:
            fused = fuse(matrices, options, weights)[0]
        # rounding may change the order of equal scores
        np.testing.assert_allclose(fused[indices[row]], np.sort(fused)[::-1][:10], atol=1e-6)
        np.testing.assert_allclose(scores[row], np.sort(fused)[::-1][:10], atol=1e-6)


TWO_ROWS, THREE_ROWS, WIDE = np.zeros((2, 4)), np.zeros((3, 4)), np.zeros((3, 5))


@pytest.mark.parametrize(
    ("queries", "database", "message"),
    [
        ([TWO_ROWS, TWO_ROWS], [TWO_ROWS, THREE_ROWS], r"number of rows: \[2, 3\]"),
        ([TWO_ROWS], [WIDE], "different dimensions"),
        ([TWO_ROWS, TWO_ROWS], [TWO_ROWS], "the queries have 2 global features, the map has 1"),
    ],
)
def test_inconsistent_features_are_refused(queries: Any, database: Any, message: str) -> None:
    with pytest.raises((DataError, OptionError), match=message):
        rank_rows(queries, database, 1, FusionOptions())
