"""Exact mutual nearest neighbours of local descriptors, blocked.

The mutual check needs no second search: the best row of a column is known by its value, so one
matrix product, one argmax over rows and one running maximum over columns suffice, and no block
is larger than the processor's cache likes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.values import Options

_BLOCK_ROWS = 512


class NearestNeighbourOptions(Options):
    """Options of nearest-neighbour matching; the defaults are measured in docs/choices.md."""

    mutual: bool = True
    max_ratio: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="largest distance to the best over distance to the second best; none: no test",
    )
    min_similarity: float | None = Field(default=None, description="smallest inner product kept")


def match_nearest(
    descriptors_a: NDArray[Any],
    descriptors_b: NDArray[Any],
    options: NearestNeighbourOptions | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Match descriptors by largest inner product (smallest distance for unit vectors).

    Parameters
    ----------
    descriptors_a, descriptors_b : (N, D) and (M, D), any real type; unit rows for a ratio test.

    Returns
    -------
    matches : int64 (K, 2), rows of a and b, sorted by a; ties go to the smaller index.
    similarities : float32 (K,), inner products.

    Raises
    ------
    DataError : different dimensions.
    """
    options = options or NearestNeighbourOptions()
    a = np.ascontiguousarray(descriptors_a, dtype=np.float32)
    b = np.ascontiguousarray(descriptors_b, dtype=np.float32)
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
    if a.shape[1] != b.shape[1]:
        raise DataError(f"descriptors have {a.shape[1]} and {b.shape[1]} dimensions")
    best, similarity, column_best, second = _search(a, b, with_second=options.max_ratio is not None)
    keep = np.ones(len(a), dtype=bool)
    if options.max_ratio is not None and len(b) > 1:
        keep &= _passes_ratio(similarity, second, options.max_ratio)
    if options.min_similarity is not None:
        keep &= similarity >= options.min_similarity
    if options.mutual:
        keep &= similarity >= column_best[best]
    rows = np.flatnonzero(keep)
    if options.mutual:
        # two rows with exactly the best value of one column: the first one has it
        _, first = np.unique(best[rows], return_index=True)
        rows = rows[np.sort(first)]
    return np.stack([rows, best[rows]], axis=1), similarity[rows]


def _search(
    a: NDArray[np.float32], b: NDArray[np.float32], *, with_second: bool
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Best column and its value per row, best value per column, second-best value per row."""
    best = np.empty(len(a), dtype=np.int64)
    similarity = np.empty(len(a), dtype=np.float32)
    second = np.full(len(a), -np.inf, dtype=np.float32)
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
        if with_second and len(b) > 1:
            block[rows, index] = -np.inf
            second[start:stop] = block.max(axis=1)
    return best, similarity, column_best, second


def _passes_ratio(
    best: NDArray[np.float32], second: NDArray[np.float32], max_ratio: float
) -> NDArray[np.bool_]:
    # squared distance of unit vectors is 2 - 2 s
    distance = np.maximum(2.0 - 2.0 * best.astype(np.float64), 0.0)
    other = np.maximum(2.0 - 2.0 * second.astype(np.float64), 0.0)
    return np.asarray(distance <= max_ratio**2 * other)


class NearestNeighbours:
    """The matcher plugin ``nn``: :func:`match_nearest` with its options."""

    Options = NearestNeighbourOptions

    def __init__(self, options: NearestNeighbourOptions | None = None) -> None:
        self.options = options or NearestNeighbourOptions()

    def match(
        self, descriptors_a: NDArray[Any], descriptors_b: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """See :func:`match_nearest`."""
        return match_nearest(descriptors_a, descriptors_b, self.options)
