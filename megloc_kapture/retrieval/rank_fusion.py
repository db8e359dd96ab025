"""Fusion of ranked lists: only the order in which features rank images counts, no similarity.

A list is a row of image indices, best first, each at most once, filled up with -1 at its end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.retrieval.weights import normalized_weights

Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]


def round_robin(lists: Sequence[NDArray[np.int64]], top_k: int) -> Ranking:
    """The first of each list in turn, then the second of each, without what was there already.

    Parameters
    ----------
    lists : per feature int64 (Q, K_i).
    top_k : at most this many per row.

    Returns
    -------
    indices : int64 (Q, top_k), best first, -1 where the lists have no more.
    scores : float32 (Q, top_k), ``top_k`` for the first, then one less each; -inf where -1.

    Raises
    ------
    DataError : lists of different numbers of queries.
    OptionError : no list.
    """
    features = max(len(lists), 1)
    turns = [
        -(np.arange(ranked.shape[-1]) * features + feature) for feature, ranked in enumerate(lists)
    ]
    indices, _ = _best(lists, turns, top_k, np.maximum)
    scores = np.arange(top_k, 0, -1, dtype=np.float32)
    return indices, np.where(indices >= 0, scores, np.float32(-np.inf))


def reciprocal_rank(
    lists: Sequence[NDArray[np.int64]],
    top_k: int,
    weights: Sequence[float] | None = None,
    *,
    constant: float = 60.0,
) -> Ranking:
    """Reciprocal rank fusion: ``sum(w_i / (constant + rank_i))``, ranks from 1.

    Cormack, Clarke and Buettcher, "Reciprocal rank fusion outperforms Condorcet and individual
    rank learning methods", SIGIR 2009, whose constant is 60. A list without the image adds nothing.
    Equal sums are in the order of the images. Parameters as of :func:`round_robin`; the weights
    are positive and brought to a sum of one, scores are the sums.
    """
    shares = normalized_weights(weights, len(lists))
    points = [
        share / (constant + 1 + np.arange(ranked.shape[-1]))
        for ranked, share in zip(lists, shares, strict=True)
    ]
    return _best(lists, points, top_k, np.add)


def borda(
    lists: Sequence[NDArray[np.int64]], top_k: int, weights: Sequence[float] | None = None
) -> Ranking:
    """Borda count: the last of the longest list gets one point, each before it one more.

    Parameters and result as of :func:`reciprocal_rank`.
    """
    shares = normalized_weights(weights, len(lists))
    longest = max(ranked.shape[-1] for ranked in lists)
    points = [
        share * (longest - np.arange(ranked.shape[-1]))
        for ranked, share in zip(lists, shares, strict=True)
    ]
    return _best(lists, points, top_k, np.add)


def _best(
    lists: Sequence[NDArray[np.int64]],
    points: Sequence[NDArray[np.float64 | np.int64]],
    top_k: int,
    together: np.ufunc,
) -> Ranking:
    """The images with most points; ``together`` is what makes one of an image's points."""
    if not lists:
        raise OptionError("no ranked list to fuse")
    if any(ranked.ndim != 2 or len(ranked) != len(lists[0]) for ranked in lists):
        raise DataError(f"ranked lists of shapes {[ranked.shape for ranked in lists]}")
    every = np.concatenate(lists, axis=1)
    rows = np.repeat(np.arange(len(every)), every.shape[1])
    values = np.tile(np.concatenate(points).astype(np.float64), len(every))
    images = every.ravel()
    there = images >= 0
    rows, values, images = rows[there], values[there], images[there]
    indices = np.full((len(every), top_k), -1, dtype=np.int64)
    scores = np.full((len(every), top_k), -np.inf, dtype=np.float32)
    if len(images) == 0:
        return indices, scores
    order = np.lexsort((images, rows))
    rows, values, images = rows[order], values[order], images[order]
    starts = np.flatnonzero((np.diff(rows, prepend=-1) != 0) | (np.diff(images, prepend=-1) != 0))
    rows, images, values = rows[starts], images[starts], together.reduceat(values, starts)
    order = np.lexsort((images, -values, rows))
    rows, images, values = rows[order], images[order], values[order]
    ranks = np.arange(len(rows)) - np.searchsorted(rows, rows)
    kept = ranks < top_k
    indices[rows[kept], ranks[kept]] = images[kept]
    scores[rows[kept], ranks[kept]] = values[kept]
    return indices, scores
