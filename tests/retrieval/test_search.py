"""Retrieval against a full sort of all scores, fusion against kapture-localization."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval import search
from megloc_kapture.retrieval.search import (
    FusionOptions,
    Ranking,
    fuse,
    fuse_rankings,
    greedy_coverage,
    rank_rows,
)


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
def test_search_equals_a_full_stable_sort(problem: Any) -> None:
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


needs_kapture_localization = pytest.mark.skipif(
    importlib.util.find_spec("kapture_localization") is None,
    reason="kapture-localization is not installed (make test installs it)",
)
OPERATORS = [FusionOptions(method="mean"), FusionOptions(method="ghm")]


def theirs(matrices: Any, options: FusionOptions, weights: Any) -> NDArray[np.float64]:
    from kapture_localization.image_retrieval.fusion import LateFusionMethod, fuse_similarities

    mean = options.method == "mean"
    method = LateFusionMethod("mean" if mean else "generalized_harmonic_mean")
    parameters = {"weights": weights} | ({} if mean else {"gamma": 0.5})
    with np.errstate(all="ignore"):
        fused: NDArray[np.float64] = fuse_similarities(matrices, method, parameters)
    return fused


@needs_kapture_localization
@pytest.mark.parametrize("options", OPERATORS)
@pytest.mark.parametrize("weights", [None, [1.0], [1.0, 3.0, 0.5]])
def test_operators_equal_kapture_localization(options: FusionOptions, weights: Any) -> None:
    rng = np.random.default_rng(0)
    matrices = [rng.uniform(-0.45, 1, (7, 40)) for _ in weights or range(3)]
    expected = theirs(matrices, options, weights)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(fuse(matrices, options, weights), expected, rtol=0, atol=1e-9)


def test_the_generalized_harmonic_mean_is_at_least_minus_gamma() -> None:
    # with equal weights the pole is at a similarity of -1, below which the formula falls
    matrices = [np.array([[-1.2, -1.01, -1.0, -0.999]]), np.full((1, 4), 0.5)]
    fused = fuse(matrices, FusionOptions())
    np.testing.assert_allclose(fused[0, :3], -0.5, atol=1e-12)
    expected = 1 / (0.5 / (0.5 - 0.5 * 0.999) + 0.5 / (0.5 + 0.5 * 0.5)) - 0.5
    np.testing.assert_allclose(fused[0, 3], expected, atol=1e-9)


def test_early_fusion_is_the_weighted_mean_of_cosines_in_float32() -> None:
    cosines = list(np.random.default_rng(0).uniform(-1, 1, (2, 3, 9)).astype(np.float32))
    fused = fuse(cosines, FusionOptions(method="early"), [3, 1])
    assert fused.dtype == np.float32
    np.testing.assert_allclose(fused, 0.75 * cosines[0] + 0.25 * cosines[1], atol=1e-6)


@pytest.mark.parametrize("weights", [[1.0], [1.0, 0.0], [1.0, -1.0], [1.0, np.nan]])
def test_invalid_weights_are_refused(weights: list[float]) -> None:
    with pytest.raises(OptionError, match="weights"):
        fuse([np.zeros((2, 4), np.float32)] * 2, FusionOptions(), weights)


def test_reciprocal_ranks_add_up_and_equal_sums_keep_the_order_of_the_images() -> None:
    # -1 ends a list that is shorter
    lists = [np.array([[5, 3, 9, -1], [-1] * 4]), np.array([[3, 5, 7], [0, -1, -1]])]
    images, sums = fuse_rankings(lists, 3, [1.0, 3.0])
    assert images.tolist() == [[3, 5, 7], [0, -1, -1]]
    by_hand = [0.25 / 62 + 0.75 / 61, 0.25 / 61 + 0.75 / 62, 0.75 / 63]
    np.testing.assert_allclose(sums, [by_hand, [0.75 / 61, -np.inf, -np.inf]], rtol=1e-6)
    equal = [np.array([[5, 3, 9]]), np.array([[3, 5, 7]])]
    assert fuse_rankings(equal, 5)[0].tolist() == [[3, 5, 7, 9, -1]]


def ids(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_coverage_prefers_images_that_add_more_points() -> None:
    images = [ids(0, 1, 2, 3), ids(0, 1), ids(7, 8), ids(1, 2, 3)]
    assert greedy_coverage(images, 2) == ([0, 2], [4, 2])
    # images that add nothing follow in order of their matches, then of their index
    assert greedy_coverage(images, 9) == ([0, 2, 3, 1], [4, 2, 0, 0])
    assert greedy_coverage([ids(), ids()], 9) == ([0, 1], [0, 0])
    assert greedy_coverage([], 3) == ([], [])
