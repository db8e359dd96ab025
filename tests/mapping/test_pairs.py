"""All pairs, and each once, against Python's own sets."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.mapping.pairs import each_once, exhaustive_pairs, unique_pairs


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_exhaustive_pairs(count: int) -> None:
    found = exhaustive_pairs(count)
    assert found.dtype == np.int64 and found.shape[1] == 2
    assert [tuple(pair) for pair in found.tolist()] == list(combinations(range(count), 2))


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=30))
def test_unique_pairs(given_pairs: list[tuple[int, int]]) -> None:
    found = unique_pairs(np.array(given_pairs, dtype=np.int64).reshape(-1, 2))
    expected = sorted({(min(p), max(p)) for p in given_pairs if p[0] != p[1]})
    assert found.dtype == np.int64 and found.shape == (len(expected), 2)
    assert [tuple(p) for p in found.tolist()] == expected


@given(st.lists(st.integers(-4, 4), max_size=30))
def test_each_once(keys: list[int]) -> None:
    assert each_once(np.array(keys, dtype=np.int64)).tolist() == sorted(set(keys))
