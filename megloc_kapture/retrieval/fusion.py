"""Fusion of several global features, by similarities or rankings; reranking by coverage.

With similarities ``s_i`` of n features and weights ``w_i`` that sum to one:

===============  ==================================================================================
ghm              ``1 / sum((1 / n) / (gamma + w_i s_i)) - gamma``, the generalized harmonic mean
mean             ``sum(w_i s_i)``
early            the cosine of the concatenated vectors, block i scaled by the square root of
                 ``w_i``: the same as ``mean``
reciprocal_rank  ``sum(w_i / (60 + rank_i))``, ranks from 1
===============  ==================================================================================

The generalized harmonic mean is an operator of Csurka and Clinchant, "An empirical study of fusion
operators for multimodal image retrieval", CBMI 2012, as kapture-localization has it, which MegLoc
uses. It is written for similarities that are not negative. A cosine may be below the pole at
``-gamma / w_i``, where the mean would jump from one infinity to the other: such an image counts as
one at the pole, so no image gains by being less similar. Reciprocal rank fusion: Cormack, Clarke
and Buettcher, "Reciprocal rank fusion outperforms Condorcet and individual rank learning methods",
SIGIR 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.values import Options

FusionMethod = Literal["ghm", "mean", "early", "reciprocal_rank"]
# added to each similarity by the generalized harmonic mean; kapture-localization's default
_GAMMA = 0.5
# added to each rank; the constant of Cormack et al.
_RANK_CONSTANT = 60
# images of each feature's ranking that count in reciprocal rank fusion
RANKED_IMAGES = 200
Similarities = NDArray[np.floating[Any]]
Ranking = tuple[NDArray[np.int64], NDArray[np.float32]]


class FusionOptions(Options):
    """Options of the fusion of several global features' similarities or rankings."""

    method: FusionMethod = Field(
        default="ghm",
        description="ghm: generalized harmonic mean; early: of concatenated vectors; "
        "reciprocal_rank: of ranks",
    )

    def fuses_ranks(self) -> bool:
        """True if only the order of each feature's similarities counts."""
        return self.method == "reciprocal_rank"


def fuse(
    similarities: Sequence[Similarities],
    options: FusionOptions,
    weights: Sequence[float] | None = None,
) -> Similarities:
    """Fuse the similarities of several features, element by element.

    Parameters
    ----------
    similarities : per feature float (Q, M), finite; all of one shape and dtype, which is the
        result's.
    options : of a method that fuses similarities; :func:`fuse_rankings` is for ranks.
    weights : one per feature, positive; all equal by default.
    """
    shares = normalized_weights(weights, len(similarities)).tolist()
    if len({matrix.shape for matrix in similarities}) != 1:
        shapes = ", ".join(str(matrix.shape) for matrix in similarities)
        raise DataError(f"similarities of different shapes: {shapes}")
    total = np.zeros_like(similarities[0])
    if options.method in ("mean", "early"):
        for matrix, share in zip(similarities, shares, strict=True):
            total += share * matrix
        return total
    with np.errstate(divide="ignore", over="ignore"):
        for matrix, share in zip(similarities, shares, strict=True):
            # 1 / 0 is infinite, and makes the mean zero
            total += (1 / len(similarities)) / np.maximum(_GAMMA + share * matrix, 0)
        fused: Similarities = 1 / total
    fused -= _GAMMA
    return fused


def normalized_weights(weights: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    """Weights (count,) that sum to one; all equal where none are given.

    Raises OptionError for another number of weights, or one that is not finite and positive.
    """
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
    """Fuse the ranked lists of several features by their reciprocal ranks.

    A list without the image adds nothing; equal sums are in the order of the images.

    Parameters
    ----------
    lists : per feature int64 (Q, K_i), best first, -1 where there are no more.
    weights : one per feature, positive; all equal by default.

    Returns
    -------
    indices : int64 (Q, top_k), best first, -1 where the lists have no more.
    scores : float32 (Q, top_k), the sums; -inf where -1.
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
    """Choose images one by one, each for the keypoints that those before it do not match.

    By the number of matches alone, neighbours of the best image come next, which see the same from
    nearly the same position. This is the greedy solution of maximum coverage, at least a share of 1
    - 1/e of the best one (Nemhauser, Wolsey and Fisher, "An analysis of approximations for
    maximizing submodular set functions", Mathematical Programming 1978).

    Of each image, the query's keypoints that it matches are given, each once. The result is at most
    ``keep`` indices, and the keypoints that each of them adds. Of images that add as many, the one
    with more matches comes first, of those the first.
    """
    size = max((int(ids.max()) + 1 for ids in keypoint_ids if len(ids)), default=0)
    missing = np.ones(size, dtype=bool)
    left = list(range(len(keypoint_ids)))
    order: list[int] = []
    added: list[int] = []
    while left and len(order) < keep:
        gains = {at: int(missing[keypoint_ids[at]].sum()) for at in left}
        best = max(left, key=lambda at: (gains[at], len(keypoint_ids[at]), -at))
        missing[keypoint_ids[best]] = False
        left.remove(best)
        order.append(best)
        added.append(gains[best])
    return order, added
