"""Fusion of ranked lists against the definitions, written out for one query."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval.rank_fusion import borda, reciprocal_rank, round_robin


@st.composite
def ranked_lists(draw: st.DrawFn) -> list[NDArray[np.int64]]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    queries, lists = draw(st.integers(0, 4)), []
    for _ in range(draw(st.integers(1, 4))):
        length = draw(st.integers(0, 8))
        ranked = np.full((queries, length), -1, dtype=np.int64)
        for row in ranked:
            there = rng.integers(0, length + 1)
            row[:there] = rng.permutation(10)[:there]
        lists.append(ranked)
    return lists


def naive_round_robin(lists: list[list[int]], top_k: int) -> list[int]:
    taken: list[int] = []
    for turn in range(max(map(len, lists), default=0)):
        for ranked in lists:
            if turn < len(ranked) and ranked[turn] >= 0 and ranked[turn] not in taken:
                taken.append(ranked[turn])
    return (taken + [-1] * top_k)[:top_k]


@given(ranked_lists(), st.integers(0, 12))
def test_round_robin(lists: list[NDArray[np.int64]], top_k: int) -> None:
    indices, scores = round_robin(lists, top_k)
    assert indices.shape == scores.shape == (len(lists[0]), top_k)
    for row in range(len(lists[0])):
        expected = naive_round_robin([ranked[row].tolist() for ranked in lists], top_k)
        assert indices[row].tolist() == expected
        points = [float(top_k - k) if i >= 0 else -np.inf for k, i in enumerate(expected)]
        assert scores[row].tolist() == points


@given(ranked_lists(), st.integers(1, 12), st.booleans())
def test_points_add_up(lists: list[NDArray[np.int64]], top_k: int, reciprocal: bool) -> None:
    weights = [float(k + 1) for k in range(len(lists))]
    longest = max(ranked.shape[1] for ranked in lists)
    fused = (
        reciprocal_rank(lists, top_k, weights, constant=7)
        if reciprocal
        else borda(lists, top_k, weights)
    )
    for row in range(len(lists[0])):
        points: defaultdict[int, float] = defaultdict(float)
        for ranked, weight in zip(lists, weights, strict=True):
            for rank, image in enumerate(ranked[row].tolist()):
                if image >= 0:
                    point = 1 / (7 + rank + 1) if reciprocal else longest - rank
                    points[image] += weight / sum(weights) * point
        best = sorted(points, key=lambda image: (-round(points[image], 12), image))[:top_k]
        found = [image for image in fused[0][row].tolist() if image >= 0]
        assert len(found) == len(best)
        # of equal sums the order may hang on rounding: points are compared, not images
        np.testing.assert_allclose([points[i] for i in found], [points[i] for i in best])
        np.testing.assert_allclose(fused[1][row, : len(best)], [points[i] for i in best], rtol=1e-6)


def test_equal_sums_keep_the_order_of_the_images() -> None:
    lists = [np.array([[5, 3, 9]]), np.array([[3, 5, 7]])]
    assert reciprocal_rank(lists, 4)[0].tolist() == [[3, 5, 7, 9]]
    assert borda(lists, 4)[0].tolist() == [[3, 5, 7, 9]]


def test_the_papers_constant_is_the_default() -> None:
    _, scores = reciprocal_rank([np.array([[4]]), np.array([[4]])], 1)
    np.testing.assert_allclose(scores, 1 / 61, rtol=1e-6)


def test_what_cannot_be_fused_is_refused() -> None:
    one, other = np.zeros((1, 2), dtype=np.int64), np.zeros((2, 2), dtype=np.int64)
    for fused in (round_robin, borda, reciprocal_rank):
        with pytest.raises(OptionError):
            fused([], 3)
        with pytest.raises(DataError, match="shapes"):
            fused([one, other], 3)
