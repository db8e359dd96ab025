"""Exact nearest neighbours among global descriptors, as blocked matrix products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.values import Options

_BLOCK_ELEMENTS = 1 << 24  # similarities in memory, per feature: 64 MiB of float32
_VECTOR_ELEMENTS = 1 << 25  # elements of a block of database rows, per feature: 128 MiB of float32
_MOST_ROWS = 1 << 14  # largest number of rows in a block, even if vectors are short
_GROUP = 8  # scores per group; the groups' maxima give a lower bound on the best scores
Float32 = NDArray[np.float32]
Similarities = NDArray[np.floating[Any]]
Matrices = Sequence[Similarities]
Ranking = tuple[NDArray[np.int64], Float32]


class VectorRows(Protocol):
    """Unit-norm rows (M, D): an array, or read block by block; zero for images without features."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


def common_length(sources: Sequence[VectorRows]) -> int:
    """Return the common number of rows of the sources; DataError if they differ."""
    lengths = {source.shape[0] for source in sources}
    if len(lengths) != 1:
        raise DataError(
            f"global features of the same images differ in their number of rows: {sorted(lengths)}"
        )
    return lengths.pop()


def rank_rows(
    queries: Sequence[NDArray[np.floating[Any]]],
    database: Sequence[VectorRows],
    top_k: int,
    fusion: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Ranking:
    """Rank the rows of a database by one or several global features.

    ``queries`` and ``database`` are (Q, D_i) and (M, D_i) per feature. Returns indices int64
    (Q, min(top_k, M)), best first, ties in database order, and scores float32.
    """
    if len(queries) == 0 or len(queries) != len(database):
        raise OptionError(
            f"the queries have {len(queries)} global features, the map has {len(database)}"
        )
    normalized_weights(weights, len(queries))  # check before reading
    if len(queries) == 1:
        return _search(queries, database, top_k, lambda matrices: matrices)[0]
    if fusion.method == "reciprocal_rank":
        length = max(top_k, _RANKED_IMAGES)
        lists = _search(queries, database, length, lambda matrices: matrices)
        rankings = [indices for indices, _ in lists]
        return fuse_rankings(rankings, min(top_k, rankings[0].shape[1]), weights)
    return _search(queries, database, top_k, lambda matrices: [fuse(matrices, fusion, weights)])[0]


def _search(
    queries: Sequence[NDArray[np.floating[Any]]],
    database: Sequence[VectorRows],
    length: int,
    combine: Callable[[Matrices], Matrices],
) -> list[Ranking]:
    """Rank at most ``length`` rows by each matrix of scores that ``combine`` returns."""
    vectors = [_checked(rows, source) for rows, source in zip(queries, database, strict=True)]
    num_queries, num_rows = len(vectors[0]), common_length(database)
    step = _VECTOR_ELEMENTS // max(1, *(source.shape[1] for source in database))
    step = max(1, min(step, _MOST_ROWS, _BLOCK_ELEMENTS))
    queries_per_block = min(max(1, _BLOCK_ELEMENTS // step), num_queries)
    num_rankings = len(combine([np.zeros((0, 0), np.float32)] * len(database)))
    shape = num_queries, min(length, num_rows)
    best = [
        (np.full(shape, -1, np.int64), np.full(shape, -np.inf, np.float32))
        for _ in range(num_rankings)
    ]
    for left in range(0, num_rows, step) if num_queries else ():
        right = min(left + step, num_rows)
        blocks = [np.ascontiguousarray(source[left:right], np.float32) for source in database]
        for first in range(0, num_queries, queries_per_block):
            block_queries = slice(first, first + queries_per_block)
            products = [
                rows[block_queries] @ block.T for rows, block in zip(vectors, blocks, strict=True)
            ]
            for scores, ranking in zip(combine(products), best, strict=True):
                _merge(ranking, np.asarray(scores, np.float32), first, left)
    return best


def _checked(queries: NDArray[np.floating[Any]], source: VectorRows) -> Float32:
    rows = np.ascontiguousarray(queries, dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] != source.shape[1]:
        raise DataError(
            f"global descriptors of queries {rows.shape} and map {source.shape} have different "
            "dimensions"
        )
    return rows


def _merge(best: Ranking, scores: Float32, first_query: int, first_row: int) -> None:
    """Update the best rows so far with scores (q, b); blocks come in the database's order."""
    block = slice(first_query, first_query + len(scores))
    best_rows, best_scores = (array[block] for array in best)
    top_k = best_rows.shape[1]
    new_scores, columns = _first_best(scores, top_k)
    merged = np.concatenate([best_scores, new_scores], axis=1)
    rows = np.concatenate([best_rows, first_row + columns], axis=1)
    # previous rows come first, so that they win ties
    order = np.argsort(-merged, axis=1, kind="stable")[:, :top_k]
    best_scores[:] = np.take_along_axis(merged, order, axis=1)
    best_rows[:] = np.take_along_axis(rows, order, axis=1)


def _first_best(scores: Float32, count: int) -> tuple[Float32, NDArray[np.int64]]:
    """Return the ``count`` best of each row of scores (q, b), and columns; ties go to the first."""
    height, width = scores.shape
    if width <= count:
        return scores, np.broadcast_to(np.arange(width), scores.shape)
    # if ``count`` maxima of groups reach a bound, so do at least as many scores
    groups = width // _GROUP
    maxima = scores
    if groups > count:
        maxima = scores[:, : groups * _GROUP].reshape(height, _GROUP, groups).max(axis=1)
    bound = np.partition(maxima, -count, axis=1)[:, -count, None]
    rows, columns = np.nonzero(scores >= bound)
    values = scores[rows, columns]
    best_first = np.lexsort((-values, rows))
    start = np.searchsorted(rows, np.arange(height))
    chosen = best_first[start[:, None] + np.arange(count)]
    return values[chosen], columns[chosen]


FusionMethod = Literal["ghm", "mean", "early", "reciprocal_rank"]
_GAMMA = 0.5  # kapture-localization's default
_RANK_CONSTANT = 60  # the value of Cormack et al.
_RANKED_IMAGES = 200  # smallest length of the ranking per feature in reciprocal rank fusion


class FusionOptions(Options):
    """Options for fusing the similarities or rankings of several global features."""

    method: FusionMethod = Field(
        default="ghm",
        description="ghm: generalized harmonic mean of the similarities; mean or early: their "
        "weighted mean, as for concatenated vectors; reciprocal_rank: fusion of ranks",
    )


def fuse(
    similarities: Matrices,
    options: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Similarities:
    """Fuse the similarities (Q, M) of several features, with equal weights by default."""
    shares = normalized_weights(weights, len(similarities)).tolist()
    total = np.zeros_like(similarities[0])
    if options.method in ("mean", "early"):
        for matrix, share in zip(similarities, shares, strict=True):
            total += share * matrix
        return total
    with np.errstate(divide="ignore", over="ignore"):
        for matrix, share in zip(similarities, shares, strict=True):
            # 1 / 0 is infinite and makes the harmonic mean zero
            total += (1 / len(similarities)) / np.maximum(_GAMMA + share * matrix, 0)
        fused: Similarities = 1 / total
    fused -= _GAMMA
    return fused


def normalized_weights(weights: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    """Return weights (count,) that sum to one, equal by default; OptionError if invalid."""
    given = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if count == 0 or given.shape != (count,):
        raise OptionError(f"{given.size} weights for {count} global features")
    if not (np.isfinite(given).all() and (given > 0).all()):
        raise OptionError(f"weights {given.tolist()} are not all finite and positive")
    normalized: NDArray[np.float64] = given / given.sum()
    return normalized


def fuse_rankings(
    lists: Sequence[NDArray[np.int64]], top_k: int, weights: Sequence[float] | None = None
) -> Ranking:
    """Fuse ranked lists, int64 (Q, K_i) per feature, by their reciprocal ranks.

    Returns indices int64 (Q, top_k), best first, and sums float32. If the lists have fewer than
    ``top_k`` images, the rest is -1 and -inf. Ties are in the order of the indices.
    """
    shares = normalized_weights(weights, len(lists)).tolist()
    indices = np.full((len(lists[0]), top_k), -1, dtype=np.int64)
    scores = np.full((len(lists[0]), top_k), -np.inf, dtype=np.float32)
    points = [
        share / (_RANK_CONSTANT + 1 + np.arange(ranked.shape[1]))
        for ranked, share in zip(lists, shares, strict=True)
    ]
    for query, rankings in enumerate(zip(*lists, strict=True)):
        images, rows = np.unique(np.concatenate(rankings), return_inverse=True)
        sums = np.bincount(rows, np.concatenate(points), minlength=len(images))
        sums, images = sums[images >= 0], images[images >= 0]
        best = np.argsort(-sums, kind="stable")[:top_k]
        indices[query, : len(best)] = images[best]
        scores[query, : len(best)] = sums[best]
    return indices, scores


def greedy_coverage(
    keypoint_ids: Sequence[NDArray[np.int64]], keep: int
) -> tuple[list[int], list[int]]:
    """Choose images greedily by the number of matched keypoints that they add.

    A ranking by the number of matches would prefer neighbours of the best image. This is greedy
    maximum coverage (Nemhauser, Wolsey and Fisher, 1978). ``keypoint_ids`` are the query keypoints
    that each image matches. Returns at most ``keep`` indices of images, and the number of keypoints
    that each of them adds.
    """
    size = max((int(ids.max()) + 1 for ids in keypoint_ids if len(ids)), default=0)
    missing = np.ones(size, dtype=bool)
    remaining = list(range(len(keypoint_ids)))
    order: list[int] = []
    added: list[int] = []
    while remaining and len(order) < keep:
        gains = {row: int(missing[keypoint_ids[row]].sum()) for row in remaining}
        best = max(remaining, key=lambda row: (gains[row], len(keypoint_ids[row]), -row))
        missing[keypoint_ids[best]] = False
        remaining.remove(best)
        order.append(best)
        added.append(gains[best])
    return order, added
