"""The best rows of blocks against one stable sort of everything."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.retrieval.best_rows import BestRows


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


def test_queries_come_in_parts() -> None:
    scores = np.random.default_rng(0).normal(size=(6, 50)).astype(np.float32)
    best = BestRows(6, 3)
    best.add(4, 10, scores[4:])
    best.add(0, 10, scores[:4])
    np.testing.assert_array_equal(best.result()[0], np.argsort(-scores, axis=1)[:, :3] + 10)
