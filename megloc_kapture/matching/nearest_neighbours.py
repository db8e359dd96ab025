"""Exact mutual nearest neighbours of local descriptors, by blocked matrix products."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.values import ImageFeatures, Options

_BLOCK_ROWS = 512


class NearestNeighbourOptions(Options):
    """Options for nearest-neighbour matching; measurements: docs/experiments/matching.md."""

    mutual: bool = True
    max_ratio: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="largest ratio of the distances to the best and to the second-best descriptor; "
        "none: no test",
    )
    min_similarity: float | None = Field(
        default=None, description="smallest inner product of a match"
    )


def match_nearest(
    descriptors_a: NDArray[Any],
    descriptors_b: NDArray[Any],
    options: NearestNeighbourOptions | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Match descriptors (N, D) and (M, D) of about equal norms by the largest inner product.

    Returns
    -------
    matches : int64 (K, 2), sorted by the first column; ties go to the smaller index.
    scores : float32 (K,), 1 minus the squared ratio of the best to the second-best distance (Lowe,
        IJCV 2004, section 7.1), 0 if there is no second descriptor. This score ranks matches better
        than the similarity (docs/experiments/matching.md).
    """
    options = options or NearestNeighbourOptions()
    a = np.ascontiguousarray(descriptors_a, dtype=np.float32)
    b = np.ascontiguousarray(descriptors_b, dtype=np.float32)
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
    if a.shape[1] != b.shape[1]:
        raise DataError(f"descriptors have {a.shape[1]} and {b.shape[1]} dimensions")
    best, similarity, column_best, second = _search(a, b, mutual=options.mutual)
    keep = np.ones(len(a), dtype=bool)
    if options.min_similarity is not None:
        keep &= similarity >= options.min_similarity
    if options.mutual:
        keep &= similarity >= column_best[best]
    rows = np.flatnonzero(keep)
    to_best, to_second = (_squared_distance(a[rows], b[of[rows]]) for of in (best, second))
    if options.max_ratio is not None and len(b) > 1:
        clear = to_best <= options.max_ratio**2 * to_second
        rows, to_best, to_second = rows[clear], to_best[clear], to_second[clear]
    if options.mutual:
        # of rows with the same best column and value, keep the first
        first = np.sort(np.unique(best[rows], return_index=True)[1])
        rows, to_best, to_second = rows[first], to_best[first], to_second[first]
    ratio = np.divide(to_best, to_second, out=np.ones(len(rows)), where=to_second > 0)
    return np.stack([rows, best[rows]], axis=1), (1 - ratio).astype(np.float32)


def _search(
    a: NDArray[np.float32], b: NDArray[np.float32], *, mutual: bool
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Return each row's best column and its value, each column's best value, and each row's
    second-best column.

    With ``mutual``, the last is set only for rows whose match may still be mutual.
    """
    best = np.empty(len(a), dtype=np.int64)
    similarity = np.empty(len(a), dtype=np.float32)
    second = np.zeros(len(a), dtype=np.int64)
    column_best = np.full(len(b), -np.inf, dtype=np.float32)
    buffer = np.empty((min(_BLOCK_ROWS, len(a)), len(b)), dtype=np.float32)
    transposed = b.T
    for start in range(0, len(a), _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, len(a))
        block = np.matmul(a[start:stop], transposed, out=buffer[: stop - start])
        index = block.argmax(axis=1)
        rows = np.arange(stop - start)
        best[start:stop] = index
        similarity[start:stop] = block[rows, index]
        np.maximum(column_best, block.max(axis=0), out=column_best)
        if len(b) > 1:
            rows = np.flatnonzero(similarity[start:stop] >= column_best[index]) if mutual else rows
            block[rows, index[rows]] = -np.inf
            second[start + rows] = block[rows].argmax(axis=1)
    return best, similarity, column_best, second


def _squared_distance(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    difference = a - b
    return np.asarray(np.einsum("nd,nd->n", difference, difference), dtype=np.float64)


class NearestNeighbours:
    """Matcher plugin ``nn``: :func:`match_nearest`."""

    Options = NearestNeighbourOptions

    def __init__(self, options: NearestNeighbourOptions | None = None) -> None:
        self.options = options or NearestNeighbourOptions()

    def match(
        self, a: ImageFeatures, b: ImageFeatures
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        return match_nearest(a.descriptors, b.descriptors, self.options)
