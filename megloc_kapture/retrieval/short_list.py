"""Nearest neighbours among very many descriptors: a short list by product quantisation, then exact.

Jégou, Douze, Schmid, "Product quantization for nearest neighbor search", TPAMI 2011; FAISS's
implementation with asymmetric distances by shuffles (André, Kermarrec, Le Scouarnec, "Quicker ADC",
TPAMI 2021), every code compared. A row takes a byte per 32 values in memory; the rows of a short
list are read again for their exact similarities, so that a ranking is exact search's as long as the
short list holds it.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import OptionError, missing_extra
from megloc_kapture.retrieval.search import Found, FusedSearch
from megloc_kapture.retrieval.vectors import VectorBlocks, VectorSource, as_blocks

_SUBVECTOR = 16  # values that share a code of 4 bits, one of 16 centroids
_SAMPLE = 16 * 39  # fewer rows than 39 for each centroid FAISS calls too few
_LENGTH = 1000  # rows of a query whose exact similarity is found
_BLOCK_ELEMENTS = 1 << 25  # of rows held at once: 128 MiB of float32


class QuantizedRows:
    """Codes of the rows of a source.

    Raises
    ------
    OptionError : FAISS is not installed, or there are too few rows.
    """

    def __init__(self, source: VectorSource) -> None:
        try:
            faiss: Any = importlib.import_module("faiss")
        except ModuleNotFoundError as error:
            raise OptionError(missing_extra(error) or str(error)) from error
        rows = as_blocks(source)
        if len(rows) < _SAMPLE:
            raise OptionError(
                f"{len(rows)} map images are too few for product quantisation, which needs "
                f"{_SAMPLE}: query_pairs.quantized_above"
            )
        wanted = max(1, rows.dimension // _SUBVECTOR)
        parts = next(n for n in range(wanted, 0, -1) if rows.dimension % n == 0)
        self._index = faiss.IndexPQFastScan(rows.dimension, parts, 4, faiss.METRIC_INNER_PRODUCT)
        sample = np.linspace(0, len(rows) - 1, min(len(rows), 4 * _SAMPLE)).astype(np.int64)
        self._index.train(_picked(rows, np.unique(sample)))
        step = max(1, _BLOCK_ELEMENTS // rows.dimension)
        for start in range(0, len(rows), step):
            self._index.add(rows.read(start, min(start + step, len(rows))))

    def nearest(self, queries: NDArray[np.float32], count: int) -> NDArray[np.int64]:
        """The ``count`` rows (Q, count) whose codes are most similar to each query (Q, D)."""
        found: NDArray[np.int64] = self._index.search(np.ascontiguousarray(queries), count)[1]
        return found


def short_lists(
    search: FusedSearch,
    queries: Sequence[NDArray[np.floating[Any]]],
    database: Sequence[VectorSource],
    codes: Sequence[QuantizedRows],
    *,
    length: int = _LENGTH,
) -> list[Found]:
    """As :meth:`~.search.FusedSearch.lists`, among the short lists of each query.

    Parameters
    ----------
    codes : of the database, by feature; each feature has a short list of its own.
    length : of a short list; at least ``search.top_k`` are taken.
    """
    sources = [as_blocks(source) for source in database]
    length = min(max(length, search.top_k), len(sources[0]))
    asked = [np.asarray(rows, np.float32) for rows in queries]
    if not len(asked[0]):
        return search.lists(asked, sources)
    near = np.concatenate(
        [own.nearest(rows, length) for own, rows in zip(codes, asked, strict=True)], axis=1
    )
    of_queries = []
    for at, candidates in enumerate(near):
        rows = np.unique(candidates[candidates >= 0])  # equal scores keep the database's order
        of_rows = [_picked(source, rows) for source in sources]
        found = search.lists([own[at : at + 1] for own in asked], of_rows)
        of_queries.append([(np.where(i >= 0, rows[i], -1), scores) for i, scores in found])
    return [_stacked(one) for one in zip(*of_queries, strict=True)]


def _stacked(rankings: Sequence[Found]) -> Found:
    """Rankings of a query each as one of all; where one is shorter, -1 and -inf."""
    width = max(indices.shape[1] for indices, _ in rankings)
    found = np.full((len(rankings), width), -1, np.int64)
    scores = np.full((len(rankings), width), -np.inf, np.float32)
    for at, (indices, own) in enumerate(rankings):
        found[at, : indices.shape[1]], scores[at, : indices.shape[1]] = indices[0], own[0]
    return found, scores


def _picked(source: VectorBlocks, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Some rows of a source, rising; neighbours are read at once."""
    found = np.empty((len(rows), source.dimension), np.float32)
    starts = np.flatnonzero(np.diff(rows, prepend=-2) != 1)
    for start, stop in zip(starts, [*starts[1:].tolist(), len(rows)], strict=True):
        found[start:stop] = source.read(int(rows[start]), int(rows[stop - 1]) + 1)
    return found
