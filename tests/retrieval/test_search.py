"""Retrieval against a full stable sort of all scores."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval import search
from megloc_kapture.retrieval.fusion import FusionOptions, fuse
from megloc_kapture.retrieval.search import (
    BestRows,
    Found,
    FusedSearch,
    QuantizedRows,
    short_lists,
)
from megloc_kapture.stages.candidates import Candidates, QueryPairsOptions, Retrieval
from megloc_kapture.values import RigidTransform


def rank_fused(
    queries: Any, database: Any, top_k: int, *, fusion: FusionOptions, weights: Any = None
) -> Found:
    search = FusedSearch(top_k, fusion, weights)
    return search.ranking([search.lists(queries, database)])


def rank_by_similarity(queries: Any, database: Any, top_k: int) -> Found:
    return rank_fused([queries], [database], top_k, fusion=FusionOptions())


def full_sort(
    queries: NDArray[np.float64], database: NDArray[np.float64], top_k: int
) -> tuple[list[list[int]], list[list[float]]]:
    indices, scores = [], []
    for query in queries:
        products = [float(np.dot(query, other)) for other in database]
        best = sorted(range(len(database)), key=lambda k: (-products[k], k))[:top_k]
        indices.append(best)
        scores.append([products[k] for k in best])
    return indices, scores


@st.composite
def problems(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    # small integers: exact products, and ties all over
    size = draw(st.integers(1, 3))
    queries = rng.integers(-2, 3, (draw(st.integers(1, 12)), size)).astype(np.float64)
    database = rng.integers(-2, 3, (draw(st.integers(1, 40)), size)).astype(np.float64)
    top_k, block = draw(st.integers(1, 45)), draw(st.integers(1, 60))
    return queries, database, top_k, block


@given(problems())
@settings(deadline=None)
def test_equal_to_a_full_stable_sort_whatever_the_blocks(
    problem: tuple[NDArray[np.float64], NDArray[np.float64], int, int],
) -> None:
    queries, database, top_k, block = problem
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_BLOCK_ELEMENTS", block)
        indices, scores = rank_by_similarity(queries, database, top_k)
    expected_indices, expected_scores = full_sort(queries, database, top_k)
    np.testing.assert_array_equal(indices, expected_indices)
    np.testing.assert_array_equal(scores, np.array(expected_scores, dtype=np.float32))
    assert indices.dtype == np.int64 and scores.dtype == np.float32


def test_real_vectors_agree_with_the_full_sort() -> None:
    rng = np.random.default_rng(1)
    queries, database = rng.normal(size=(600, 64)), rng.normal(size=(300, 64))
    indices, scores = rank_by_similarity(queries, database, 10)
    products = queries @ database.T
    order = np.argsort(-products, axis=1)[:, :10]
    best = np.take_along_axis(products, order, axis=1)
    np.testing.assert_allclose(scores, best, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.take_along_axis(products, indices, axis=1), best, atol=1e-4)


@pytest.mark.parametrize(("queries", "rows"), [(2, 0), (0, 3)])
def test_nothing_to_search(queries: int, rows: int) -> None:
    indices, scores = rank_by_similarity(np.zeros((queries, 4)), np.zeros((rows, 4)), 5)
    assert indices.shape == scores.shape == (queries, rows)


class Blocks:
    """A source that gives rows only as they are read, and remembers what was."""

    def __init__(self, rows: NDArray[np.float64]) -> None:
        self.rows, self.reads = rows, list[tuple[int, int]]()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def dimension(self) -> int:
        return int(self.rows.shape[1])

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        self.reads.append((start, stop))
        rows = np.empty((stop - start, self.dimension), np.float32) if out is None else out
        rows[:] = self.rows[start:stop]
        return rows


def test_a_source_is_read_once_in_blocks_and_gives_what_the_array_gives() -> None:
    rng = np.random.default_rng(2)
    queries, database = rng.integers(-3, 4, (9, 4)) * 1.0, rng.integers(-3, 4, (50, 4)) * 1.0
    source = Blocks(database)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_MOST_ROWS", 16)
        found = rank_by_similarity(queries, source, 7)
    assert source.reads == [(0, 16), (16, 32), (32, 48), (48, 50)]
    for ours, expected in zip(found, full_sort(queries, database, 7), strict=True):
        np.testing.assert_array_equal(ours, expected)


def by_ranks(matrices: Any, options: FusionOptions, weights: list[float]) -> NDArray[np.float64]:
    """Scores (M,) of one query by the ranks of all images."""
    fused = np.full(matrices[0].shape[1], -np.inf if options.method == "round_robin" else 0.0)
    for feature, ((row,), weight) in enumerate(zip(matrices, weights, strict=True)):
        ranks, share = np.argsort(np.argsort(-row, kind="stable")), weight / sum(weights)
        if options.method == "round_robin":
            fused = np.maximum(fused, -(ranks * len(matrices) + feature))
        elif options.method == "reciprocal_rank":
            fused += share / (options.rank_constant + 1 + ranks)
        else:
            fused += share * (len(row) - ranks)
    return fused


METHODS = [
    *("mean", "power", "maximum", "minimum", "mean_and_power", "mean_and_min", "min_and_max"),
    *("villena_roman", "harmonic_mean", "ghm", "round_robin", "reciprocal_rank", "borda"),
]


@pytest.mark.parametrize("method", METHODS)
def test_fused_ranking_is_that_of_the_whole_matrices(method: str) -> None:
    rng = np.random.default_rng(4)
    queries = [rng.normal(size=(7, d)) / 4 for d in (5, 9, 3)]
    database = [rng.normal(size=(60, d)) / 4 for d in (5, 9, 3)]
    options = FusionOptions.model_validate({"method": method})
    weights = [1.0, 2.0, 0.5]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_BLOCK_ELEMENTS", 48)
        patch.setattr(search, "_MOST_ROWS", 13)
        indices, scores = rank_fused(queries, database, 10, fusion=options, weights=weights)
    assert indices.shape == scores.shape == (7, 10)
    for row in range(7):
        matrices = [q[row : row + 1] @ m.T for q, m in zip(queries, database, strict=True)]
        fused = by_ranks(matrices, options, weights) if options.fuses_ranks() else None
        fused = fuse(matrices, options, weights)[0] if fused is None else fused
        expected = np.argsort(-fused, kind="stable")[:10]
        if method in ("power", "harmonic_mean", "villena_roman", "borda", "reciprocal_rank"):
            # of equal scores, which these have, rounding may turn the order
            np.testing.assert_allclose(fused[indices[row]], np.sort(fused)[::-1][:10], atol=1e-6)
        else:
            assert indices[row].tolist() == expected.tolist()


def test_features_that_do_not_fit_are_refused() -> None:
    one, more = np.zeros((2, 4)), np.zeros((3, 4))
    for queries, database, match in [
        ([one, more], [one, one], "2, 3 queries"),
        ([one, one], [one, more], r"\[2, 3\] rows"),
    ]:
        with pytest.raises(DataError, match=match):
            rank_fused(queries, database, 1, fusion=FusionOptions())
    with pytest.raises(OptionError, match="2 global features of the queries, 1 of the map"):
        rank_fused([one, one], [one], 1, fusion=FusionOptions())
    with pytest.raises(OptionError, match="weights"):
        rank_fused([one, one], [one, one], 1, fusion=FusionOptions(), weights=[1.0, 0.0])


@pytest.mark.parametrize(
    ("queries", "database", "match"),
    [
        (np.zeros((2, 4)), np.zeros((3, 5)), "different dimensions"),
        (np.zeros(4), np.zeros((3, 4)), "different dimensions"),
        (np.full((2, 4), np.nan), np.zeros((3, 4)), "not finite"),
        (np.full((2, 4), np.inf), np.zeros((3, 4)), "not finite"),
        (np.zeros((2, 4)), np.diag([0, np.nan, 0, 0]), "not finite, the first in row 1"),
        (np.zeros((2, 4)), np.diag([0, 0, np.inf, 0]), "not finite, the first in row 2"),
    ],
)
def test_descriptors_that_are_none_are_refused(queries: Any, database: Any, match: str) -> None:
    with pytest.raises(DataError, match=match):
        rank_by_similarity(queries, database, 1)


@given(
    st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 300), st.integers(0, 6), st.data()
)
def test_equal_to_a_stable_sort(
    seed: int, queries: int, rows: int, top_k: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    kind = data.draw(st.sampled_from(["few", "many", "masked", "zeros", "tiny"]))
    scores = rng.normal(size=(queries, rows)).astype(np.float32)
    if kind == "few":
        scores = scores.round()
    elif kind == "masked":
        scores[rng.uniform(size=scores.shape) < 0.7] = -np.inf
    elif kind == "zeros":
        scores = np.where(rng.uniform(size=scores.shape) < 0.5, np.float32(0), np.float32(-0.0))
    elif kind == "tiny":
        scores *= np.float32(1e-40)  # below the least normal number
    best = BestRows(queries, top_k)
    left = 0
    while left < rows:
        right = min(rows, left + data.draw(st.integers(1, 250)))
        best.add(0, left, scores[:, left:right])
        left = right
    indices, found = best.result()
    order = np.argsort(-scores, axis=1, kind="stable")[:, :top_k]
    expected = np.full((queries, top_k), -np.inf, dtype=np.float32)
    expected[:, : order.shape[1]] = np.take_along_axis(scores, order, axis=1)
    np.testing.assert_array_equal(found, expected)
    there = np.full((queries, top_k), -1)
    there[:, : order.shape[1]] = order
    np.testing.assert_array_equal(indices, np.where(expected == -np.inf, -1, there))


TOP = 10


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def planted(seed: int, dimension: int = 64) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """20 queries, and 3,000 rows of which each query has 30 near itself."""
    random = np.random.default_rng(seed)
    queries = unit(random.normal(size=(20, dimension)))
    rows = random.normal(size=(3000, dimension))
    near = np.repeat(queries, 30, axis=0) * dimension**0.5 + 0.8 * rows[:600]
    return queries, unit(random.permutation(np.concatenate([near, rows[600:]])))


@pytest.fixture
def quantized() -> type[QuantizedRows]:
    """The codes, where FAISS is installed."""
    pytest.importorskip("faiss")
    return QuantizedRows


@pytest.mark.parametrize("method", ["ghm", "early", "borda"])
def test_rankings_are_those_of_exact_search(quantized: type[QuantizedRows], method: str) -> None:
    fusion = FusionOptions(method=method)  # type: ignore[arg-type]
    queries, database = zip(planted(0), planted(1, 48), strict=True)
    codes = [quantized(rows) for rows in database]
    exact, exact_scores = rank_fused(queries, database, TOP, fusion=fusion)
    # all rows of the list: what every method must rank as the exact search does
    search = FusedSearch(TOP, fusion)
    lists = short_lists(search, queries, database, codes, length=3000)
    found, scores = search.ranking([lists])
    np.testing.assert_array_equal(found, exact)
    np.testing.assert_allclose(scores, exact_scores, rtol=1e-5)


def test_a_short_list_holds_planted_neighbours(quantized: type[QuantizedRows]) -> None:
    queries, rows = planted(2)
    exact, _ = rank_fused([queries], [rows], TOP, fusion=FusionOptions())
    codes = [quantized(rows)]
    search = FusedSearch(TOP, FusionOptions())
    found, scores = search.ranking([short_lists(search, [queries], [rows], codes, length=150)])
    np.testing.assert_array_equal(found, exact)
    assert (np.diff(scores) <= 0).all()
    coarse = codes[0].nearest(queries, TOP)  # it is the exact scores that make it right
    assert np.mean([len(set(a) & set(b)) for a, b in zip(coarse, exact, strict=True)]) < TOP


@pytest.mark.usefixtures("quantized")
def test_more_images_than_the_option_are_searched_so(monkeypatch: pytest.MonkeyPatch) -> None:
    queries, rows = planted(3)
    here = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    candidates = Candidates(lambda members: [rows[members]], [here] * 3000, Retrieval(("a",)))
    members = np.arange(100, 2900)
    quantized_found, exact = (
        candidates.of([queries], members, QueryPairsOptions(top_k=TOP, quantized_above=above))
        for above in (2799, 2800)
    )
    np.testing.assert_array_equal(quantized_found[0], exact[0])
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "faiss", None)
        candidates.of([queries], members, QueryPairsOptions(top_k=TOP, quantized_above=2800))
        candidates.of([queries], members, QueryPairsOptions(top_k=TOP, quantized_above=2799))
        with pytest.raises(OptionError, match="faiss"):  # other images need other codes
            candidates.of([queries], members[1:], QueryPairsOptions(quantized_above=2798))


def test_without_faiss_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    with pytest.raises(OptionError, match=r"faiss is not installed: .*megloc-kapture\[faiss\]"):
        QuantizedRows(planted(0)[1])
