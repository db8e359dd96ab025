"""Exact nearest neighbours among global descriptors, as blocked matrix products.

Databases are read block by block, and no more than one block of similarities per feature is kept:
what the search needs does not grow with the database.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError, missing_extra
from megloc_kapture.retrieval.fusion import (
    FusionOptions,
    concatenate,
    fuse,
    fuse_rankings,
    normalized_weights,
)


class VectorBlocks(Protocol):
    """Global descriptors of a database, of which no more than a block has to be in memory.

    Rows are of unit length, so that the inner product is the cosine; a zero row, of an image
    without features, is similar to nothing. A source that refuses values that are not finite may
    have an attribute ``finite = True``: its rows are not looked at again.
    """

    def __len__(self) -> int:
        """Number of rows."""
        ...

    @property
    def dimension(self) -> int:
        """Length D of a row."""
        ...

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """The rows from ``start`` to ``stop``, float32 (stop - start, D).

        They may be in ``out``, a C-contiguous array of that shape: memory that is used again and
        again is much faster than new memory. They are not written to.
        """
        ...


VectorSource = VectorBlocks | NDArray[np.floating[Any]]


class ArrayBlocks:
    """An array (N, D) of unit or zero rows as a source of blocks; DataError if it is not 2-D."""

    def __init__(self, rows: NDArray[np.floating[Any]]) -> None:
        if rows.ndim != 2:
            raise DataError(f"global descriptors {rows.shape} are of different dimensions")
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def dimension(self) -> int:
        return self._rows.shape[1]

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        # a view where the array is float32 already
        return np.ascontiguousarray(self._rows[start:stop], dtype=np.float32)


class ConcatenatedBlocks:
    """Several features of the same images as one: early fusion, block by block.

    Raises DataError for sources of different lengths, OptionError for weights that cannot be used,
    see :func:`.fusion.concatenate`.
    """

    def __init__(
        self, sources: Sequence[VectorSource], weights: Sequence[float] | None = None
    ) -> None:
        self._sources = [as_blocks(source) for source in sources]
        self._weights = weights
        self._length = common_length(self._sources)
        self.read(0, 0)  # refuses weights now, not in the middle of a search

    def __len__(self) -> int:
        return self._length

    @property
    def dimension(self) -> int:
        return sum(source.dimension for source in self._sources)

    def read(
        self, start: int, stop: int, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        rows = [source.read(start, stop) for source in self._sources]
        return concatenate(rows, self._weights, out=out)


def as_blocks(source: VectorSource) -> VectorBlocks:
    """The source itself, or the array as one."""
    return ArrayBlocks(source) if isinstance(source, np.ndarray) else source


def common_length(sources: Sequence[VectorBlocks]) -> int:
    """Number of rows that all sources have; DataError where there is none, or they differ."""
    lengths = {len(source) for source in sources}
    if len(lengths) != 1:
        raise DataError(f"features of one set of images have {sorted(lengths)} rows")
    return lengths.pop()


# products of large blocks are faster: the matrix library's threads wait for each other less often
_BLOCK_ELEMENTS = 1 << 24  # similarities held at once, per feature: 64 MiB of float32
_VECTOR_ELEMENTS = 1 << 25  # of a block of database rows, per feature: 128 MiB of float32
_MOST_ROWS = 1 << 14  # of a block, however short they are
_CACHED_ELEMENTS = 1 << 18  # of similarities ranked at once: 1 MiB, which a cache holds
Matrices = Sequence[NDArray[np.floating[Any]]]
Float32 = NDArray[np.float32]
Found = tuple[NDArray[np.int64], Float32]
_GROUP = 8  # columns of which only the best is looked at first
_NOTHING = np.iinfo(np.int64).max  # sorts last
_SIGN = np.int32(0x7FFFFFFF)
_SUBVECTOR = 16  # values that share a code of 4 bits, one of 16 centroids
_SAMPLE = 16 * 39  # fewer rows than 39 for each centroid FAISS calls too few
_LENGTH = 1000  # rows of a query whose exact similarity is found


@dataclass(frozen=True)
class FusedSearch:
    """The ``top_k`` best database rows of queries by several features, part by part of a database.

    ``fusion`` is of similarities or of ranks; one feature alone is not fused. The weights are
    positive, one per feature; all equal by default.
    """

    top_k: int
    fusion: FusionOptions
    weights: Sequence[float] | None = None

    def lists(
        self, queries: Sequence[NDArray[np.floating[Any]]], database: Sequence[VectorSource]
    ) -> list[Found]:
        """Rank the rows of a part: one ranking, or of methods that fuse ranks one per feature.

        Parameters
        ----------
        queries : per feature float (Q, D_i), rows of unit length for cosine similarity. A zero row,
            of an image without features, has similarity 0 with everything.
        database : per feature float (M, D_i), or a source of blocks of them.

        Returns
        -------
        Of each ranking indices, int64 (Q, min(K, M)), best first, where equal scores keep the
        database's order, and scores float32; K is ``top_k``, or more of rankings that are fused.
        -1 and -inf where a score is -inf.

        Raises
        ------
        DataError : different dimensions or numbers of rows, or values that are not finite.
        OptionError : weights that cannot be used, or other features than those of the queries.
        """
        if len(queries) == 0 or len(queries) != len(database):
            raise OptionError(
                f"{len(queries)} global features of the queries, {len(database)} of the map"
            )
        normalized_weights(self.weights, len(queries))  # refused before anything is read
        several = len(queries) > 1
        if several and self.fusion.method == "early":
            rows = [np.asarray(rows, np.float32) for rows in queries]
            queries = [concatenate(rows, self.weights)]
            database = [ConcatenatedBlocks(database, self.weights)]
        elif several and self.fusion.fuses_ranks():
            lengths = [self._list_length()] * len(queries)
            return _search(queries, database, lengths, lambda matrices: matrices)
        elif several:
            return _search(
                queries,
                database,
                [self.top_k],
                lambda matrices: [fuse(matrices, self.fusion, self.weights)],
            )
        return _search(queries, database, [self.top_k], lambda matrices: matrices)

    def ranking(self, parts: Sequence[Sequence[Found]]) -> Found:
        """Rank the whole from the lists of its parts, whose rows are the whole's; scores are as the
        fusion makes them. Both are (Q, min(top_k, M))."""
        lists = [_merged(found, self._list_length()) for found in zip(*parts, strict=True)]
        if len(lists) == 1:
            indices, scores = lists[0]
            return indices[:, : self.top_k], scores[:, : self.top_k]
        rankings = [indices for indices, _ in lists]
        top_k = min(self.top_k, rankings[0].shape[1])
        return fuse_rankings(rankings, top_k, self.fusion, self.weights)

    def _list_length(self) -> int:
        # a turn of the round gives one image at most, so longer lists would change nothing
        if self.fusion.method == "round_robin" or not self.fusion.fuses_ranks():
            return self.top_k
        return max(self.top_k, self.fusion.list_length)


def _merged(parts: Sequence[Found], length: int) -> Found:
    """The best of the parts' rankings (Q, K), best first; of equal ones the earlier part's."""
    if len(parts) == 1:
        return parts[0]
    indices, scores = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
    best = np.argsort(-scores, axis=1, kind="stable")[:, :length]
    return np.take_along_axis(indices, best, axis=1), np.take_along_axis(scores, best, axis=1)


def _search(
    queries: Sequence[NDArray[np.floating[Any]]],
    database: Sequence[VectorSource],
    lengths: Sequence[int],
    combine: Callable[[Matrices], Matrices],
) -> list[Found]:
    """One ranking, of the length that is asked for, per matrix of scores that ``combine`` makes."""
    sources = [as_blocks(source) for source in database]
    vectors = [_checked(rows, source) for rows, source in zip(queries, sources, strict=True)]
    num_queries, num_rows = len(vectors[0]), common_length(sources)
    if any(len(rows) != num_queries for rows in vectors):
        raise DataError(f"features of {', '.join(str(len(rows)) for rows in vectors)} queries")
    best = [BestRows(num_queries, min(length, num_rows)) for length in lengths]
    step = _VECTOR_ELEMENTS // max(1, *(source.dimension for source in sources))
    step = max(1, min(step, _MOST_ROWS, _BLOCK_ELEMENTS))
    finites = [bool(getattr(source, "finite", False)) for source in sources]
    height = min(step, num_rows)
    buffers = [np.empty((height, source.dimension), dtype=np.float32) for source in sources]
    at_once = min(max(1, _BLOCK_ELEMENTS // step), num_queries)
    products = [np.empty(at_once * height, dtype=np.float32) for _ in sources]
    for left in range(0, num_rows, step) if num_queries else ():
        right = min(left + step, num_rows)
        blocks = [
            source.read(left, right, out=buffer[: right - left])
            for source, buffer in zip(sources, buffers, strict=True)
        ]
        for first in range(0, num_queries, at_once):
            some = slice(first, first + at_once)
            matrices = [
                _similarities(rows[some], block, left, out, finite)
                for rows, block, out, finite in zip(vectors, blocks, products, finites, strict=True)
            ]
            count, width = matrices[0].shape
            few = max(1, _CACHED_ELEMENTS // width)
            for start in range(0, count, few):
                fused = combine([matrix[start : start + few] for matrix in matrices])
                for scores, ranking in zip(fused, best, strict=True):
                    ranking.add(first + start, left, scores)
    return [ranking.result() for ranking in best]


def _checked(queries: NDArray[np.floating[Any]], source: VectorBlocks) -> Float32:
    rows = np.ascontiguousarray(queries, dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] != source.dimension:
        of_map = (len(source), source.dimension)
        raise DataError(
            f"global descriptors of queries {rows.shape} and map {of_map} have different dimensions"
        )
    if not np.isfinite(rows).all():
        raise DataError("global descriptors of queries have values that are not finite")
    return rows


def _similarities(
    queries: Float32, rows: Float32, first_row: int, out: Float32, finite: bool
) -> Float32:
    """Inner products (q, b), in the flat memory of ``out``; ``finite`` rows are known to be."""
    shape = (len(queries), len(rows))
    products = out[: shape[0] * shape[1]].reshape(shape)
    with np.errstate(over="ignore", invalid="ignore"):
        np.matmul(queries, rows.T, out=products)
        if finite:
            return products
        # a value that is not finite makes its whole column so, and thereby the column's sum: less
        # to look at than all values
        sums = np.ones(len(products), dtype=np.float32) @ products
    for column in np.flatnonzero(~np.isfinite(sums)).tolist():
        if not np.isfinite(rows[column]).all():
            raise DataError(
                "global descriptors have values that are not finite, the first in row "
                f"{first_row + column} of the map"
            )
    return products


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
            offsets = (query * width + group)[:, None] + groups * np.arange(_GROUP)
            values = scores.ravel()[offsets]
            reached = np.flatnonzero(values >= bound[query, None])
            query, columns = np.divmod(offsets.ravel()[reached], width)
            found = _keys(values.ravel()[reached], first_row + columns)
            parts.append(_padded(query, found, len(scores)))
        merged = np.concatenate(parts, axis=1)
        merged.sort(axis=1)
        keys[:] = merged[:, :top_k]

    def result(self) -> tuple[NDArray[np.int64], Float32]:
        """Indices int64 (Q, top_k), best first, and scores; -1 and -inf where fewer rows came."""
        indices = np.where(self._keys == _NOTHING, -1, self._keys & 0xFFFFFFFF)
        return indices, _scores(self._keys)


def _keys(scores: Float32, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Integers (..., b) in whose order scores fall and, of equal ones, database rows (b,) rise."""
    # the two zeros are equal; a negative number's other bits grow as it falls
    bits = (scores + np.float32(0)).view(np.int32)
    rising = bits ^ ((bits >> 31) & _SIGN)
    keys: NDArray[np.int64] = (np.invert(rising).astype(np.int64) << 32) | rows
    keys[scores == -np.inf] = _NOTHING
    return keys


def _scores(keys: NDArray[np.int64]) -> Float32:
    rising = np.invert((keys >> 32).astype(np.int32))
    scores = (rising ^ ((rising >> 31) & _SIGN)).view(np.float32)
    return np.where(keys == _NOTHING, np.float32(-np.inf), scores)


def _padded(query: NDArray[np.int64], keys: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Keys (n,) of ascending queries as one row (count, most) per query."""
    starts = np.searchsorted(query, np.arange(count + 1))
    padded = np.full((count, int(np.diff(starts).max())), _NOTHING, dtype=np.int64)
    padded[query, np.arange(len(query)) - starts[query]] = keys
    return padded


class QuantizedRows:
    """Codes of the rows of a source, for short lists of their nearest neighbours.

    Jégou, Douze, Schmid, "Product quantization for nearest neighbor search", TPAMI 2011; FAISS's
    implementation with asymmetric distances by shuffles (André, Kermarrec, Le Scouarnec, "Quicker
    ADC", TPAMI 2021), every code compared. A row takes a byte per 32 values in memory; the rows of
    a short list are read again for their exact similarities, so that a ranking is exact search's as
    long as the short list holds it. Raises OptionError where FAISS is not installed, or there are
    too few rows.
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
        step = max(1, _VECTOR_ELEMENTS // rows.dimension)
        for start in range(0, len(rows), step):
            self._index.add(rows.read(start, min(start + step, len(rows))))

    def nearest(self, queries: Float32, count: int) -> NDArray[np.int64]:
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

    Each feature's codes of the database give a short list of its own; of ``length`` rows, at least
    ``search.top_k``.
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


def _picked(source: VectorBlocks, rows: NDArray[np.int64]) -> Float32:
    """Some rows of a source, rising; neighbours are read at once."""
    found = np.empty((len(rows), source.dimension), np.float32)
    starts = np.flatnonzero(np.diff(rows, prepend=-2) != 1)
    for start, stop in zip(starts, [*starts[1:].tolist(), len(rows)], strict=True):
        found[start:stop] = source.read(int(rows[start]), int(rows[stop - 1]) + 1)
    return found
