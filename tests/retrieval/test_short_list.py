"""Product quantisation with exact re-scoring, beside exact search."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError
from megloc_kapture.retrieval.fusion import FusionOptions
from megloc_kapture.retrieval.search import FusedSearch, rank_fused
from megloc_kapture.retrieval.short_list import QuantizedRows, short_lists
from megloc_kapture.stages.candidates import Candidates, QueryPairsOptions, Retrieval
from megloc_kapture.values import RigidTransform

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
