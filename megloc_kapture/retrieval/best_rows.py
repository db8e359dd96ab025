"""The best of many columns of scores that come block by block, exactly and in a fixed order.

A score and its database row are kept as one integer that sorts as they do: best score first, then
the first row. Sorting integers is several times as fast as a stable sort of scores.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_GROUP = 8  # columns of which only the best is looked at first
_NOTHING = np.iinfo(np.int64).max  # sorts last
_SIGN = np.int32(0x7FFFFFFF)


class BestRows:
    """For each query the ``top_k`` best database rows so far; of equal ones the first.

    A database may have 2**31 rows.
    """

    def __init__(self, num_queries: int, top_k: int) -> None:
        self._keys = np.full((num_queries, top_k), _NOTHING, dtype=np.int64)

    def add(self, first_query: int, first_row: int, scores: NDArray[np.floating[Any]]) -> None:
        """Take the scores (q, b) of the queries and database rows from these on.

        Blocks may come in any order. A score of -inf never counts; there may be no NaN.
        """
        keys = self._keys[first_query : first_query + len(scores)]
        top_k = keys.shape[1]
        scores = np.ascontiguousarray(scores, dtype=np.float32)
        if top_k == 0 or scores.size == 0:
            return
        # what is not much wider than what is kept is sorted as a whole
        width = scores.shape[1]
        groups = width // _GROUP if width >= 2 * _GROUP * top_k else 0
        whole = groups * _GROUP
        parts = [keys, _keys(scores[:, whole:], np.arange(first_row + whole, first_row + width))]
        if groups:
            # strided groups: maxima of whole rows, which the processor takes many at a time
            best = scores[:, :whole].reshape(len(scores), _GROUP, groups).max(axis=1)
            # k groups have an element that reaches the k-th best of them
            bound = np.partition(best, groups - top_k, axis=1)[:, groups - top_k]
            np.maximum(bound, _scores(keys[:, -1]), out=bound)
            query, group = np.divmod(np.flatnonzero(best >= bound[:, None]), groups)
            places = (query * width + group)[:, None] + groups * np.arange(_GROUP)
            values = scores.ravel()[places]
            reached = np.flatnonzero(values >= bound[query, None])
            query, columns = np.divmod(places.ravel()[reached], width)
            found = _keys(values.ravel()[reached], first_row + columns)
            parts.append(_padded(query, found, len(scores)))
        merged = np.concatenate(parts, axis=1)
        merged.sort(axis=1)
        keys[:] = merged[:, :top_k]

    def result(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Indices int64 (Q, top_k), best first, and scores; -1 and -inf where fewer rows came."""
        indices = np.where(self._keys == _NOTHING, -1, self._keys & 0xFFFFFFFF)
        return indices, _scores(self._keys)


def _keys(scores: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Integers (..., b) in whose order scores fall and, of equal ones, database rows (b,) rise."""
    # the two zeros are equal; a negative number's other bits grow as it falls
    bits = (scores + np.float32(0)).view(np.int32)
    rising = bits ^ ((bits >> 31) & _SIGN)
    keys: NDArray[np.int64] = (np.invert(rising).astype(np.int64) << 32) | rows
    keys[scores == -np.inf] = _NOTHING
    return keys


def _scores(keys: NDArray[np.int64]) -> NDArray[np.float32]:
    rising = np.invert((keys >> 32).astype(np.int32))
    scores = (rising ^ ((rising >> 31) & _SIGN)).view(np.float32)
    return np.where(keys == _NOTHING, np.float32(-np.inf), scores)


def _padded(query: NDArray[np.int64], keys: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Keys (n,) of ascending queries as one row (count, most) per query."""
    starts = np.searchsorted(query, np.arange(count + 1))
    padded = np.full((count, int(np.diff(starts).max())), _NOTHING, dtype=np.int64)
    padded[query, np.arange(len(query)) - starts[query]] = keys
    return padded
