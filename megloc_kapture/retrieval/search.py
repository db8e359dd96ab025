"""Exact nearest neighbours among global descriptors, as blocked matrix products."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError

_BLOCK_ELEMENTS = 1 << 22  # scores held at once: 16 MiB of float32


def rank_by_similarity(
    queries: NDArray[np.floating[Any]],
    database: NDArray[np.floating[Any]],
    top_k: int,
    *,
    permitted: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The ``top_k`` most similar database rows of each query row, by inner product.

    Parameters
    ----------
    queries, database : float (Q, D) and (M, D), rows of unit length for cosine similarity.
    top_k : at most this many per query.
    permitted : bool (Q, M) or None; rows that a query must not get.

    Returns
    -------
    indices : int64 (Q, min(top_k, M)), best first; equal scores keep the database's order;
        -1 where fewer than ``top_k`` rows are permitted.
    scores : float32 of the same shape; -inf where the index is -1.

    Raises
    ------
    DataError : different dimensions, or values that are not finite.
    """
    q = np.ascontiguousarray(queries, dtype=np.float32)
    m = np.ascontiguousarray(database, dtype=np.float32)
    if q.ndim != 2 or m.ndim != 2 or q.shape[1] != m.shape[1]:
        raise DataError(
            f"global descriptors of queries {q.shape} and map {m.shape} have different dimensions"
        )
    if not (np.isfinite(q).all() and np.isfinite(m).all()):
        raise DataError("global descriptors have values that are not finite")
    k = min(top_k, len(m))
    indices = np.full((len(q), k), -1, dtype=np.int64)
    scores = np.full((len(q), k), -np.inf, dtype=np.float32)
    if k == 0:
        return indices, scores
    rows = max(1, min(256, len(q)))
    columns = max(k, _BLOCK_ELEMENTS // rows)
    for start in range(0, len(q), rows):
        stop = min(start + rows, len(q))
        best_index = np.zeros((stop - start, 0), dtype=np.int64)
        best_score = np.zeros((stop - start, 0), dtype=np.float32)
        for left in range(0, len(m), columns):
            right = min(left + columns, len(m))
            block = q[start:stop] @ m[left:right].T
            if permitted is not None:
                block[~permitted[start:stop, left:right]] = -np.inf
            new_index, new_score = _top(block, k)
            # earlier blocks come first, so that stable sorting keeps the database's order
            best_index = np.concatenate([best_index, new_index + left], axis=1)
            best_score = np.concatenate([best_score, new_score], axis=1)
            order = np.argsort(-best_score, axis=1, kind="stable")[:, :k]
            best_index = np.take_along_axis(best_index, order, axis=1)
            best_score = np.take_along_axis(best_score, order, axis=1)
        valid = best_score > -np.inf
        indices[start:stop] = np.where(valid, best_index, -1)
        scores[start:stop] = best_score
    return indices, scores


def _top(block: NDArray[np.float32], k: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Top k of each row, ties by column, exactly as a full stable sort would give."""
    width = block.shape[1]
    if k < width:
        # everything at or above the k-th value, then a stable sort of those few
        threshold = -np.partition(-block, k - 1, axis=1)[:, k - 1]
        index = np.empty((len(block), k), dtype=np.int64)
        for row, bound in enumerate(threshold):
            candidates = np.flatnonzero(block[row] >= bound)
            order = np.argsort(-block[row, candidates], kind="stable")[:k]
            index[row] = candidates[order]
    else:
        index = np.argsort(-block, axis=1, kind="stable")[:, :k]
    return index, np.take_along_axis(block, index, axis=1)
